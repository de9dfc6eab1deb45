"""Pictures of views: photograph, outlines, axes, names, grasps, and what hides objects.

Outlines and names have the colour of the verdict, grasps that of their p_hold, of sets without it
that of their score; the legend says which. What was taken out of a mask because something that is
not in the scene hides it is hatched in magenta.
"""

from collections.abc import Iterator, Mapping, Sequence

import numpy as np

from realsim.arrays import Array, Int32, Mask, Rgb
from realsim.errors import InputError
from realsim.formats.bop.labels import mask_path
from realsim.geometry import se3
from realsim.records import CameraIntrinsics, GraspSet, ObjectModel, ObjectPose, Scene
from realsim.records.grasps import label_words
from realsim.rendering.labels import LabelRenderer, PlacedMesh
from realsim.rendering.overlay import VERDICT_RGB, Color
from realsim.store import SessionStore
from realsim_sim_bridge.annotation.files import part_path

UNKNOWN_RGB = (255, 0, 200)
"""What hides an object and is not in the scene: a colour that no object and no verdict has."""
AXIS_SHARE = 0.3
"""Length of a drawn axis as a share of the object's longest side."""
MOST_NAMED = 4
"""Number of invisible objects that the legend names."""


def overlay_pictures(
    store: SessionStore,
    view_indices: Sequence[int],
    scene: Scene,
    models: Mapping[int, ObjectModel],
    grasp_sets: Sequence[GraspSet],
    max_grasps: int,
) -> Iterator[Rgb]:
    """Yield the photographs of views with everything that was annotated on them.

    Colours are explained, and objects out of sight named, in a corner.

    Outlines of the visible masks and names have the colour of the verdict; axes are x red, y green,
    z blue; grasps of every object, evenly from its best to its worst, are coloured by p_hold or
    score, dashed where p_hold is not sure. Rejected objects are drawn too: one should see why they
    were.

    Args:
        store: the session; the views must be calibrated.
        view_indices: numbers of the views.
        scene: where the objects stand; it is prepared once.
        models: obj_id -> model.
        grasp_sets: the scored grasps.
        max_grasps: grasps drawn in all, shared evenly by the objects.

    Raises:
        InputError: a view has no camera pose.
    """
    objects = [o for o in scene.objects if o.obj_id in models]
    renderer = LabelRenderer(
        [PlacedMesh(o.instance, models[o.obj_id].mesh, o.T_world_obj) for o in objects]
    )
    instances = {o.instance for o in objects}
    shown = [g for g in grasp_sets if g.instance in instances and len(g)]
    for index in view_indices:
        view = store.session.view(index)
        if view.T_world_cam is None:
            raise InputError(f"view {index} has no camera pose; calibrate first.")
        ids = renderer.render(store.session.intrinsics, view.T_world_cam).ids
        hidden = _hidden_by_unknown(store, index, ids)
        poses = {o.instance: se3.invert(view.T_world_cam) @ o.T_world_obj for o in objects}
        picture = _with_scene(store.rgb(index), store.session.intrinsics, objects, models, poses,
                              ids, hidden)  # fmt: skip
        picture = _with_grasps(picture, store.session.intrinsics, shown, poses, max_grasps)
        picture = _with_names(picture, objects, models, ids)
        yield _with_legend(picture, objects, models, ids, hidden, shown)


def _with_scene(
    picture: Rgb,
    intrinsics: CameraIntrinsics,
    objects: Sequence[ObjectPose],
    models: Mapping[int, ObjectModel],
    poses: Mapping[int, Array],
    ids: Int32,
    hidden: Mask,
) -> Rgb:
    """Return a photograph with the outlines and axes of objects, and what hides them hatched."""
    from realsim.rendering import overlay

    colors = {o.instance: VERDICT_RGB[o.verdict] for o in objects}
    picture = overlay.draw_hatched(picture, hidden, UNKNOWN_RGB)
    picture = overlay.draw_outlines(picture, np.where(hidden, -1, ids), colors)
    thickness = 2 if picture.shape[0] < 900 else 3
    seen = set(np.unique(ids).tolist())
    for o in objects:
        if o.instance in seen:
            length_m = AXIS_SHARE * float(models[o.obj_id].mesh.extent.max())
            picture = overlay.draw_axes(picture, intrinsics, poses[o.instance], length_m, thickness)
    return picture


def _with_grasps(
    picture: Rgb,
    intrinsics: CameraIntrinsics,
    grasp_sets: Sequence[GraspSet],
    poses: Mapping[int, Array],
    most: int,
) -> Rgb:
    """Return the picture with grasps of every object, `most` in all.

    Grasps without a label are drawn only if none has one.
    """
    from realsim.rendering import overlay

    for grasps in grasp_sets:
        known = np.flatnonzero(~np.isnan(grasps.labels))
        rows = known if len(known) else None
        chosen = overlay.evenly_ranked(grasps, max(2, most // len(grasp_sets)), rows)
        picture = overlay.draw_grasps(picture, intrinsics, poses[grasps.instance], grasps, chosen)
    return picture


def _with_names(
    picture: Rgb, objects: Sequence[ObjectPose], models: Mapping[int, ObjectModel], ids: Int32
) -> Rgb:
    """Return the picture with the objects' names, and their verdicts where not accepted."""
    from realsim.rendering.overlay_words import write_names

    names = {
        o.instance: models[o.obj_id].name + ("" if o.verdict == "accepted" else f" ({o.verdict})")
        for o in objects
    }
    return write_names(picture, ids, names, {o.instance: VERDICT_RGB[o.verdict] for o in objects})


def _with_legend(
    picture: Rgb,
    objects: Sequence[ObjectPose],
    models: Mapping[int, ObjectModel],
    ids: Int32,
    hidden: Mask,
    grasp_sets: Sequence[GraspSet],
) -> Rgb:
    """Return the picture with its colours explained, and the objects that are not to be seen."""
    from realsim.rendering.overlay_words import write_legend

    seen = set(np.unique(ids[~hidden]).tolist())
    verdicts = [v for v in VERDICT_RGB if any(o.verdict == v for o in objects)]
    entries: list[tuple[str, Color]] = [(v, VERDICT_RGB[v]) for v in verdicts]
    if hidden.any():
        entries.append(("hidden by something unknown", UNKNOWN_RGB))
    unseen = [models[o.obj_id].name for o in objects if o.instance not in seen]
    lines = [f"not visible: {name}" for name in unseen[:MOST_NAMED]]
    if len(unseen) > MOST_NAMED:
        lines.append(f"and {len(unseen) - MOST_NAMED} more not visible")
    if any(s.unsure.any() for s in grasp_sets):
        lines.insert(0, "dashed: p_hold of few draws")
    ramp = label_words(grasp_sets) if grasp_sets else ""
    return write_legend(picture, entries, ids >= 0, ramp=ramp, lines=lines)


def _hidden_by_unknown(store: SessionStore, index: int, ids: Int32) -> Mask:
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
