"""The files of the annotation: what is written, read back, and cleared away.

mask/000000_000001.png        silhouette of object 1 of view 0, also where something hides it
mask_visib/000000_000001.png  its visible part
labels/instance/000000.png    instances; labels/depth, coordinates, normals alike
grasps/views/000000.npz       grasps in that camera: pose, score, p_hold, seen, reachable
annotations/000000.json       camera, poses, boxes, counts, agreement with the measured depth
annotations/objects.json      per object: verdict, checks, mass properties, box
annotations/surfaces/         per model: points on its surface with normals
scene_gt.json  scene_gt_info.json  scene_gt_coco.json     BOP, made of the annotations above

Grasps seen from one view: where they are in the camera, and which contacts it can see.

A grasp's two contacts lie at +-width/2 along its closing axis y. A contact is seen if it is in the
image and the straight line from the camera to it is free. The line is drawn to a point a clearance
outside the contact, where the finger's pad would stand: the two sides of a convex object are never
both in sight of one camera in the strict sense, yet the pads on both sides are what a camera above
the grasp sees. A contact behind something that the measured depth shows and the scene does not
have (a hand) is not seen either.
"""

import io
import json
import re
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass
from enum import IntEnum
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from realsim.arrays import Array, Mask, UInt8
from realsim.errors import InputError
from realsim.formats.bop import labels as bop_labels
from realsim.geometry import camera, se3
from realsim.records import CameraIntrinsics, GraspSet
from realsim.records.grasps import LABEL_MEASURES, joined_measure
from realsim.rendering.labels import LabelRenderer, Labels
from realsim.store import SessionStore
from realsim.untrusted.own_json import to_json
from realsim_sim_bridge.annotation.config import MAPS, SightConfig
from realsim_sim_bridge.annotation.frame_labels import FrameLabel, map_path
from realsim_sim_bridge.annotation.inputs import FORMAT_VERSION, FrameInputs, FrameView
from realsim_sim_bridge.annotation.unmodelled import UnmodelledRegion

LENS_ROUND_TRIP = 1e-3
"""How far [normalised] a projected point may come back from the lens model: a point far out of
view can be folded into the image by the distortion polynomial, and then does not come back."""


class GraspVisibility(IntEnum):
    """How much of a grasp a view sees."""

    HIDDEN = 0
    """Neither contact."""
    PARTLY = 1
    """One of the two contacts."""
    VISIBLE = 2
    """Both contacts."""


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class GraspsInView:
    """The grasps of one object instance in one view."""

    Ts_cam_grasp: Array
    """(N, 4, 4) grasp in camera [m]."""
    grasp_set: GraspSet
    """Widths, scores and measures of the same N grasps."""
    contact_seen: Mask
    """(N, 2) whether the contact at -y and at +y is seen."""

    @property
    def visibility(self) -> UInt8:
        """(N,) codes of `GraspVisibility`: how many contacts are seen."""
        return np.sum(self.contact_seen, axis=1).astype(np.uint8)


def contact_points(Ts_x_grasp: ArrayLike, widths_m: ArrayLike, clearance_m: float = 0.0) -> Array:
    """Return the contacts (N, 2, 3) at -y and +y in frame x [m].

    Args:
        Ts_x_grasp: (N, 4, 4) grasps.
        widths_m: (N,) distance of the contacts [m].
        clearance_m: how much further out the points lie [m].
    """
    T = np.asarray(Ts_x_grasp, dtype=np.float64).reshape(-1, 4, 4)
    reach = np.asarray(widths_m, dtype=np.float64) / 2 + clearance_m
    offset = T[:, :3, 1] * reach[:, None]
    return T[:, None, :3, 3] + offset[:, None] * np.array([-1.0, 1.0])[:, None]


def in_image(intrinsics: CameraIntrinsics, points_cam: ArrayLike) -> Mask:
    """Return (N,) which camera points (N, 3) [m] fall on a pixel of the image."""
    p = np.asarray(points_cam, dtype=np.float64)
    uv = camera.project(intrinsics, p)
    known = np.all(np.isfinite(uv), axis=1)
    inside = np.zeros(len(p), dtype=bool)
    u, v = uv[known, 0], uv[known, 1]
    inside[known] = (u >= -0.5) & (u < intrinsics.width - 0.5)
    inside[known] &= (v >= -0.5) & (v < intrinsics.height - 0.5)
    if intrinsics.is_distorted and np.any(inside):
        xy, valid = camera.undistort(intrinsics, uv[inside])
        back = np.abs(xy - p[inside, :2] / p[inside, 2:3]).max(-1)
        inside[inside] = valid & (np.nan_to_num(back, nan=np.inf) < LENS_ROUND_TRIP)
    return inside


def free_lines(
    renderer: LabelRenderer, eye_world: ArrayLike, points_world: ArrayLike, tolerance_m: float
) -> Mask:
    """Return (N,) whether the straight lines from `eye_world` (3,) to points (N, 3) are free."""
    eye = np.asarray(eye_world, dtype=np.float64)
    lines = np.asarray(points_world, dtype=np.float64).reshape(-1, 3) - eye
    length = np.linalg.norm(lines, axis=1)
    rays = np.concatenate([np.broadcast_to(eye, lines.shape), lines / length[:, None]], axis=1)
    return np.asarray(renderer.cast_rays(rays).t >= length - tolerance_m, dtype=bool)


def is_behind(
    region: UnmodelledRegion, intrinsics: CameraIntrinsics, points_cam: ArrayLike
) -> Mask:
    """Return (N,) which camera points (N, 3) [m] lie behind a thing that is not in the model."""
    p = np.asarray(points_cam, dtype=np.float64)
    rows, columns = region.window
    pixel = np.rint(np.nan_to_num(camera.project(intrinsics, p), nan=-1.0)).astype(np.int64)
    u, v = pixel[:, 0] - columns.start, pixel[:, 1] - rows.start
    height, width = region.mask.shape
    behind = (u >= 0) & (v >= 0) & (u < width) & (v < height)
    u, v = u[behind], v[behind]
    # Where it was not measured it is a hole inside the thing: as near as the rest of it.
    behind[behind] = region.mask[v, u] & (region.depth_m[v, u] < p[behind, 2])
    return behind


def grasps_in_view(
    renderer: LabelRenderer,
    intrinsics: CameraIntrinsics,
    T_world_cam: ArrayLike,
    grasp_sets: Sequence[tuple[ArrayLike, GraspSet]],
    config: SightConfig,
    region: UnmodelledRegion | None = None,
) -> list[GraspsInView]:
    """Return the objects' grasps in the camera, each contact marked as seen or not.

    Args:
        renderer: the scene that may stand in the way.
        intrinsics: the camera.
        T_world_cam: (4, 4) camera in world [m].
        grasp_sets: per object where it stands, T_world_obj (4, 4) [m], and its grasps.
        config: when a contact counts as seen.
        region: where something that is not in the scene stands in front; None = nowhere.
    """
    T = np.asarray(T_world_cam, dtype=np.float64)
    T_cam_world = se3.invert(T)
    Ts = [T_cam_world @ np.asarray(o, dtype=np.float64) @ g.Ts_obj_grasp for o, g in grasp_sets]
    # One cast for all objects: a cast has a price, whatever the number of its lines.
    widths_m = np.concatenate([np.zeros(0), *(g.widths_m for _, g in grasp_sets)])
    Ts_pads = [T_cam_world @ np.asarray(o, dtype=np.float64) @ g.Ts_obj_pads for o, g in grasp_sets]
    Ts_cam_pads = np.concatenate([np.zeros((0, 4, 4)), *Ts_pads])
    pads_cam = contact_points(Ts_cam_pads, widths_m, config.clearance_m).reshape(-1, 3)
    seen = in_image(intrinsics, pads_cam)
    if region is not None:
        seen &= ~is_behind(region, intrinsics, pads_cam)
    if np.any(seen):
        pads_world = se3.transform(T, pads_cam[seen])
        seen[seen] = free_lines(renderer, T[:3, 3], pads_world, config.tolerance_m)
    ends = np.cumsum([len(g) for _, g in grasp_sets])
    contact_seen = np.split(seen.reshape(-1, 2), ends[:-1])
    return [
        GraspsInView(Ts_cam_grasp=Ts_of, grasp_set=grasps, contact_seen=seen_of)
        for (_, grasps), Ts_of, seen_of in zip(grasp_sets, Ts, contact_seen, strict=False)
    ]


OBJECTS_FILE = "annotations/objects.json"
INFO_KEYS = (
    "bbox_obj", "bbox_visib", "px_count_all", "px_count_valid", "px_count_visib", "visib_fract"
)  # fmt: skip
"""What scene_gt_info.json says of an object."""


# --- names ------------------------------------------------------------------------------------


def grasps_path(view: int) -> str:
    """Return where the grasps of a view are."""
    return f"grasps/views/{view:06d}.npz"


def part_path(view: int) -> str:
    """Return where the annotation of a view is."""
    return f"annotations/{view:06d}.json"


def surface_path(obj_id: int) -> str:
    """Return where the surface cloud of a model is."""
    return f"annotations/surfaces/{obj_id:06d}.npz"


# --- one view ---------------------------------------------------------------------------------


def grasps_bytes(grasps: Sequence[GraspsInView]) -> bytes:
    """Return the grasps of all objects in one view's camera, object after object, as npz.

    Arrays: instance (N,), obj_id (N,), Ts_cam_grasp (N, 4, 4) [m], widths_m (N,), scores (N,),
    base_scores (N,), visibility (N,) 0 hidden 1 partly 2 visible, contact_seen (N, 2), reachable
    (N,), and those of LABEL_MEASURES that a set has: (N,), safety (N, 4); NaN = not known.
    """
    sets = [g.grasp_set for g in grasps]

    def joined(parts: Sequence[Any], shape: tuple[int, ...], dtype: Any) -> NDArray[Any]:
        return np.concatenate([np.zeros((0, *shape), dtype), *parts]).astype(dtype)

    buffer = io.BytesIO()
    # Not compressed: poses have no pattern, and deflating them would cost more than the masks do.
    np.savez(
        buffer,
        allow_pickle=False,
        instance=joined([np.full(len(s), s.instance) for s in sets], (), np.int32),
        obj_id=joined([np.full(len(s), s.obj_id) for s in sets], (), np.int32),
        Ts_cam_grasp=joined([g.Ts_cam_grasp for g in grasps], (4, 4), np.float64),
        widths_m=joined([s.widths_m for s in sets], (), np.float64),
        scores=joined([s.scores for s in sets], (), np.float64),
        base_scores=joined([s.base_scores for s in sets], (), np.float64),
        visibility=joined([g.visibility for g in grasps], (), np.uint8),
        contact_seen=joined([g.contact_seen for g in grasps], (2,), np.bool_),
        reachable=joined([s.reachable for s in sets], (), np.bool_),
        **{
            name: joined_measure(sets, name)
            for name in LABEL_MEASURES
            if any(name in s.measures for s in sets)
        },
    )
    return buffer.getvalue()


def part_of_view(
    inputs: FrameInputs,
    view: FrameView,
    labels: Labels,
    frame: Sequence[FrameLabel],
    grasp_counts: Mapping[int, Mapping[str, int]],
) -> dict[str, Any]:
    """Return one view's annotation as JSON values [m, px]."""
    entries = [
        {
            "mask": k,
            "instance": placed.instance,
            "obj_id": placed.obj_id,
            "name": inputs.models[placed.obj_id].name,
            "verdict": placed.verdict,
            "reasons": list(placed.reasons),
            "T_cam_obj": label.T_cam_obj.tolist(),
            "corners_px": _pixels(label.corners_px),
            **label.info,
            "px_hidden_by_unknown": label.unknown.px if label.unknown.is_removed else 0,
            "unknown_occluder": _json(label.unknown),
            "depth": _json(label.agreement),
            "grasps": dict(grasp_counts.get(placed.instance, {})),
            "mask_visib_rle": label.visible_rle,
        }
        for k, (placed, label) in enumerate(zip(inputs.objects, frame, strict=True))
    ]
    return {
        "format_version": FORMAT_VERSION,
        "view": view.index,
        "inputs": view.digest,
        "camera": to_json(inputs.intrinsics),
        "T_world_cam": view.T_world_cam.tolist(),
        "maps": list(inputs.config.maps),
        "is_empty": not any(label.info["px_count_visib"] for label in frame),
        "px_without_ray": int(np.count_nonzero(labels.unknown)),
        "camera_inside": [int(i) for i in labels.camera_inside],
        "objects": entries,
    }


def _json(record: Any) -> dict[str, Any]:
    """Return a record's fields as JSON values."""
    return {
        name: to_json(value) if isinstance(value, float) else value
        for name, value in asdict(record).items()
    }


def _pixels(uv: Array) -> list[list[float] | None]:
    """Return pixels (N, 2) to a thousandth; null = behind the camera."""
    return [
        [round(float(u), 3), round(float(v), 3)] if np.isfinite(u) and np.isfinite(v) else None
        for u, v in uv
    ]


def part_bytes(part: Mapping[str, Any]) -> bytes:
    """Return one view's annotation as the content of its file."""
    text = json.dumps(part, allow_nan=False)
    # One line per object: readable, and a tenth of the lines of an indented matrix.
    return (text.replace('{"mask": ', '\n{"mask": ') + "\n").encode()


def write_view(store: SessionStore, view: int, files: Mapping[str, bytes]) -> None:
    """Write the files of a view, its annotation last: that marks the view as complete.

    The old annotation goes first. Else a kill in between would leave it, digest and all, beside new
    masks, and going back to the old inputs would take it for complete.
    """
    store.remove(part_path(view))
    store.write_derived({p: data for p, data in files.items() if p != part_path(view)})
    store.write_bytes(part_path(view), files[part_path(view)])


def finished_part(
    store: SessionStore, view: int, digest: str, damaged: Collection[str] = ()
) -> dict[str, Any] | None:
    """Return the view's annotation if it was made from these inputs and all its files are whole.

    Args:
        store: the session.
        view: number of the view.
        digest: of the inputs.
        damaged: files that are not as they were written.
    """
    if not store.has(part_path(view)):
        return None
    try:
        part = store.read_json(part_path(view))
    except InputError:
        return None  # a broken file is made again
    if not isinstance(part, dict) or part.get("inputs") != digest:
        return None
    paths = _paths_of(view, part)
    is_whole = all(store.has(p) for p in paths) and not {*paths, part_path(view)} & set(damaged)
    return part if is_whole else None


def _paths_of(view: int, part: Mapping[str, Any]) -> list[str]:
    """Return the files of a view beside its annotation."""
    masks = [
        bop_labels.mask_path(view, int(entry["mask"]), visible=visible)
        for entry in part["objects"]
        for visible in (False, True)
    ]
    return [*masks, *(map_path(name, view) for name in part["maps"]), grasps_path(view)]


# --- all views --------------------------------------------------------------------------------


def write_bop(
    store: SessionStore, parts: Mapping[int, Mapping[str, Any]], names: Mapping[int, str]
) -> None:
    """Write scene_gt.json, scene_gt_info.json and scene_gt_coco.json out of all views' parts.

    Args:
        store: the session.
        parts: view -> its annotation.
        names: object id -> name.
    """
    poses: dict[int, list[tuple[int, Any]]] = {}
    infos: dict[int, list[dict[str, Any]]] = {}
    masks: dict[int, list[tuple[int, Any]]] = {}
    for view, part in parts.items():
        entries = part["objects"]
        poses[view] = [(int(e["obj_id"]), np.array(e["T_cam_obj"])) for e in entries]
        infos[view] = [{name: e[name] for name in INFO_KEYS} for e in entries]
        masks[view] = [(int(e["obj_id"]), e["mask_visib_rle"]) for e in entries]
    bop_labels.write_scene_gt(store, poses)
    bop_labels.write_scene_gt_info(store, infos)
    bop_labels.write_scene_gt_coco(store, masks, names)


def remove_stale(
    store: SessionStore, parts: Mapping[int, Mapping[str, Any]], obj_ids: Iterable[int]
) -> list[str]:
    """Remove what a former run wrote and this one does not have, and return it.

    A former run may have had more objects or maps, or views that have left the session since.
    """
    wanted = {p for view, part in parts.items() for p in _paths_of(view, part)}
    wanted |= {part_path(view) for view in parts} | {surface_path(i) for i in obj_ids}
    written_by_us = {
        "mask": r"\d{6}_\d{6}\.png",
        "mask_visib": r"\d{6}_\d{6}\.png",
        "grasps/views": r"\d{6}\.npz",
        "annotations": r"\d{6}\.json",
        "annotations/surfaces": r"\d{6}\.npz",
    }
    written_by_us |= {f"labels/{name}": r"\d{6}\.png" for name in MAPS}
    stale = [
        f"{folder}/{name}"
        for folder, pattern in written_by_us.items()
        for name in _names(store, folder)
        if re.fullmatch(pattern, name) and f"{folder}/{name}" not in wanted
    ]
    for path in stale:
        store.remove(path)
    return stale


def _names(store: SessionStore, folder: str) -> Iterable[str]:
    """Return the names of the files in a folder of the session, sorted."""
    path = store.path(folder)
    return sorted(p.name for p in path.iterdir()) if path.is_dir() else []
