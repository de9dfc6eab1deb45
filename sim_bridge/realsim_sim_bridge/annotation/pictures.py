"""Pictures of views: the photograph with the objects' outlines, verdicts and grasps.

What was taken out of a mask because something that is not in the scene hides it is magenta.
"""

from collections.abc import Iterator, Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from realsim.errors import InputError
from realsim.formats.bop_labels import mask_path
from realsim.geometry import se3
from realsim.records import GraspSet, ObjectModel, ObjectPose, Scene
from realsim.rendering.labels import LabelRenderer, PlacedMesh
from realsim.store import SessionStore
from realsim_sim_bridge.annotation.files import part_path

Rgb = NDArray[np.uint8]
VERDICT_RGB: dict[str, tuple[int, int, int]] = {
    "accepted": (58, 188, 92),
    "doubtful": (250, 180, 40),
    "rejected": (230, 60, 55),
    "unchecked": (170, 176, 190),
}
UNKNOWN_RGB = (255, 0, 200)
"""What hides an object and is not in the scene: a colour that no object and no verdict has."""
INK = (25, 27, 31)
"""Ground under the names: every verdict's colour is legible on it."""
TEXT_PER_ROW = 1 / 1400
"""Font scale per image row: legible at 720 rows, and not larger than a small object."""


def overlay_picture(
    store: SessionStore,
    view_index: int,
    scene: Scene,
    models: Mapping[int, ObjectModel],
    grasp_sets: Sequence[GraspSet],
    max_grasps: int = 30,
) -> Rgb:
    """Return the photograph of a view with everything that was annotated on it.

    Outlines of the visible masks and names have the colour of the verdict; the best and the worst
    grasps of every object are coloured by score. Rejected objects are drawn too: one should see
    why they were.

    Args:
        store: the session; the view must be calibrated.
        view_index: number of the view.
        scene: where the objects stand.
        models: obj_id -> model.
        grasp_sets: the scored grasps.
        max_grasps: grasps drawn in all, shared evenly by the objects.

    Raises:
        InputError: the view has no camera pose.
    """
    return next(overlay_pictures(store, [view_index], scene, models, grasp_sets, max_grasps))


def overlay_pictures(
    store: SessionStore,
    view_indices: Sequence[int],
    scene: Scene,
    models: Mapping[int, ObjectModel],
    grasp_sets: Sequence[GraspSet],
    max_grasps: int = 30,
) -> Iterator[Rgb]:
    """Yield the pictures of several views, the scene being prepared once; see `overlay_picture`.

    Raises:
        InputError: a view has no camera pose.
    """
    from realsim.rendering import overlay

    objects = [o for o in scene.objects if o.obj_id in models]
    renderer = LabelRenderer(
        [PlacedMesh(o.instance, models[o.obj_id].mesh, o.T_world_obj) for o in objects]
    )
    intrinsics = store.session.intrinsics
    colors = {o.instance: VERDICT_RGB[o.verdict] for o in objects}
    shown = [g for g in grasp_sets if any(o.instance == g.instance for o in objects)]
    for index in view_indices:
        view = store.session.view(index)
        if view.T_world_cam is None:
            raise InputError(f"view {index} has no camera pose; calibrate first.")
        ids = renderer.render(intrinsics, view.T_world_cam).ids
        hidden = _hidden_by_unknown(store, index, ids)
        picture = store.rgb(index)
        picture[hidden] = (0.5 * picture[hidden] + 0.5 * np.array(UNKNOWN_RGB)).astype(np.uint8)
        picture = overlay.draw_outlines(picture, np.where(hidden, -1, ids), colors)
        T_cam_world = se3.invert(view.T_world_cam)
        for grasps in shown:
            T_cam_obj = T_cam_world @ scene.object(grasps.instance).T_world_obj
            chosen = best_and_worst(grasps, max(1, max_grasps // len(shown)))
            picture = overlay.draw_grasps(picture, intrinsics, T_cam_obj, grasps, chosen)
        picture = np.ascontiguousarray(picture)
        for o in objects:
            rows, columns = np.nonzero(ids == o.instance)
            if len(rows):
                below = (round(float(columns.mean())), int(rows.max()))
                _write_name(picture, below, o, models[o.obj_id].name)
        yield picture


def _hidden_by_unknown(
    store: SessionStore, index: int, ids: NDArray[np.int32]
) -> NDArray[np.bool_]:
    """Return (H, W) what the annotation of a view took out of masks; nothing if there is none."""
    hidden = np.zeros(ids.shape, np.bool_)
    if not store.has(part_path(index)):
        return hidden
    for entry in store.read_json(part_path(index))["objects"]:
        if entry.get("px_hidden_by_unknown"):
            # `ids` is rendered without the table: what the table hides is not in either mask.
            amodal = store.read_image(mask_path(index, entry["mask"], visible=False)) > 0
            visible = store.read_image(mask_path(index, entry["mask"], visible=True)) > 0
            hidden |= (ids == entry["instance"]) & amodal & ~visible
    return hidden


def best_and_worst(grasps: GraspSet, most: int) -> NDArray[np.int64]:
    """Return the numbers of the grasps with the highest and the lowest scores, `most` in all.

    Grasps that were not tried are drawn only if none was.
    """
    tried = np.flatnonzero(~np.isnan(grasps.scores))
    if len(tried) == 0:
        return np.arange(min(most, len(grasps)), dtype=np.int64)
    ranked = tried[np.argsort(-grasps.scores[tried], kind="stable")]
    if len(ranked) <= most:
        return ranked
    worst = most // 2
    return np.concatenate([ranked[: most - worst], ranked[len(ranked) - worst :]])


def _write_name(picture: Rgb, below: tuple[int, int], placed: ObjectPose, name: str) -> None:
    """Write an object's name and verdict under a pixel of the picture, in place."""
    import cv2

    text = name if placed.verdict == "accepted" else f"{name} ({placed.verdict})"
    scale = max(0.35, picture.shape[0] * TEXT_PER_ROW)
    (width, height), _ = cv2.getTextSize(text, cv2.FONT_HERSHEY_SIMPLEX, scale, 1)
    pad = max(2, height // 3)
    x = int(np.clip(below[0] - width // 2, pad, max(pad, picture.shape[1] - width - pad)))
    y = min(below[1] + height + 3 * pad, picture.shape[0] - pad)
    cv2.rectangle(picture, (x - pad, y - height - pad), (x + width + pad, y + pad), INK, -1)
    color = VERDICT_RGB[placed.verdict]
    cv2.putText(picture, text, (x, y), cv2.FONT_HERSHEY_SIMPLEX, scale, color, 1, cv2.LINE_AA)
