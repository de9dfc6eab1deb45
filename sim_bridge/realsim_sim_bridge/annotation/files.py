"""The files of the annotation: what is written, read back, and cleared away.

mask/000000_000001.png        silhouette of object 1 of view 0, also where something hides it
mask_visib/000000_000001.png  its visible part
labels/instance/000000.png    instances; labels/depth, coordinates, normals alike
grasps/views/000000.npz       grasps in that camera: pose, score, p_hold, seen, reachable
annotations/000000.json       camera, poses, boxes, counts, agreement with the measured depth
annotations/objects.json      per object: verdict, checks, mass properties, box
annotations/surfaces/         per model: points on its surface with normals
scene_gt.json  scene_gt_info.json  scene_gt_coco.json     BOP, made of the annotations above
"""

import io
import json
import re
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import asdict
from typing import Any

import numpy as np
from numpy.typing import NDArray

from realsim.arrays import Array
from realsim.errors import InputError
from realsim.formats.bop import labels as bop_labels
from realsim.records.grasps import LABEL_MEASURES, joined_measure
from realsim.rendering.labels import Labels
from realsim.store import SessionStore
from realsim.untrusted.own_json import to_json
from realsim_sim_bridge.annotation.config import MAPS
from realsim_sim_bridge.annotation.frame_grasps import GraspsInView
from realsim_sim_bridge.annotation.frame_labels import FrameLabel
from realsim_sim_bridge.annotation.frame_maps import map_path
from realsim_sim_bridge.annotation.inputs import FORMAT_VERSION, FrameInputs, FrameView

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
