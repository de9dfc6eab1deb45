"""The files of the label transfer: what is written, read back, and cleared away."""

import json
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict
from typing import Any

import numpy as np
from numpy.typing import NDArray

from realsim.errors import InputError
from realsim.formats import bop_labels
from realsim.records import ObjectModel, ObjectPose
from realsim.store import SessionStore
from realsim.store.records_json import number_to_json
from realsim_sim_bridge.frame_labels import FrameLabel
from realsim_sim_bridge.transfer_grasps import GraspsInView

FORMAT_VERSION = 1
"""Part of every digest: a new version annotates anew."""
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


# --- one view ---------------------------------------------------------------------------------


def write_grasps(store: SessionStore, view: int, grasps: Sequence[GraspsInView]) -> None:
    """Write the grasps of all objects in one view's camera, object after object.

    Arrays: instance (N,), obj_id (N,), Ts_cam_grasp (N, 4, 4) [m], widths_m (N,), scores (N,),
    visibility (N,) 0 hidden 1 partly 2 visible, contact_seen (N, 2), reachable (N,).
    """
    counts = [len(g.scores) for g in grasps]

    def joined(name: str, shape: tuple[int, ...], dtype: Any) -> NDArray[Any]:
        empty = np.zeros((0, *shape), dtype)
        return np.concatenate([empty, *(np.asarray(getattr(g, name), dtype) for g in grasps)])

    store.write_npz(
        grasps_path(view),
        instance=np.repeat(np.array([g.instance for g in grasps], np.int32), counts),
        obj_id=np.repeat(np.array([g.obj_id for g in grasps], np.int32), counts),
        Ts_cam_grasp=joined("Ts_cam_grasp", (4, 4), np.float64),
        widths_m=joined("widths_m", (), np.float64),
        scores=joined("scores", (), np.float64),
        visibility=joined("visibility", (), np.uint8),
        contact_seen=joined("contact_seen", (2,), np.bool_),
        reachable=joined("reachable", (), np.bool_),
    )


def part_of_view(
    view: int,
    digest: str,
    T_world_cam: NDArray[np.float64],
    objects: Sequence[tuple[ObjectPose, ObjectModel]],
    frame: Sequence[FrameLabel],
    grasp_counts: Mapping[int, Mapping[str, int]],
) -> dict[str, Any]:
    """Return one view's annotation as JSON values [m, px]."""
    entries = [
        {
            "mask": k,
            "instance": label.instance,
            "obj_id": label.obj_id,
            "name": model.name,
            "verdict": placed.verdict,
            "reasons": list(placed.reasons),
            "T_cam_obj": label.T_cam_obj.tolist(),
            **label.info,
            "depth": {n: number_to_json(v) for n, v in asdict(label.agreement).items()},
            "grasps": dict(grasp_counts.get(label.instance, {})),
            "mask_visib_rle": label.visible_rle,
        }
        for k, ((placed, model), label) in enumerate(zip(objects, frame, strict=True))
    ]
    return {
        "format_version": FORMAT_VERSION,
        "view": view,
        "inputs": digest,
        "T_world_cam": T_world_cam.tolist(),
        "objects": entries,
    }


def reopen_view(store: SessionStore, view: int) -> None:
    """Take away a view's old annotation before its other files are replaced.

    Else a kill in between would leave the old annotation, digest and all, beside new masks, and
    going back to the old inputs would take it for complete.
    """
    store.remove(part_path(view))


def write_part(store: SessionStore, view: int, part: Mapping[str, Any]) -> None:
    """Write one view's annotation, which marks the view as complete."""
    text = json.dumps(part, allow_nan=False)
    # One line per object: readable, and a tenth of the lines of an indented matrix.
    text = text.replace('{"mask": ', '\n{"mask": ')
    store.write_bytes(part_path(view), (text + "\n").encode())


def finished_part(store: SessionStore, view: int, digest: str) -> dict[str, Any] | None:
    """Return the view's annotation if it was made from these inputs and all its files are there."""
    if not store.has(part_path(view)):
        return None
    try:
        part = store.read_json(part_path(view))
    except InputError:
        return None  # a broken file is made again
    if not isinstance(part, dict) or part.get("inputs") != digest:
        return None
    needed = (*_mask_paths(view, part), grasps_path(view))
    return part if all(store.has(p) for p in needed) else None


def _mask_paths(view: int, part: Mapping[str, Any]) -> list[str]:
    """Return where the masks of a view's annotation are."""
    return [
        bop_labels.mask_path(view, int(entry["mask"]), visible=visible)
        for entry in part["objects"]
        for visible in (False, True)
    ]


# --- all views --------------------------------------------------------------------------------


def write_objects(store: SessionStore, entries: Sequence[Mapping[str, Any]]) -> None:
    """Write what holds for the objects in every view."""
    store.write_json(
        "annotations/objects.json", {"format_version": FORMAT_VERSION, "objects": list(entries)}
    )


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


def remove_stale(store: SessionStore, parts: Mapping[int, Mapping[str, Any]]) -> list[str]:
    """Remove what a former run wrote and this one does not have, and return it.

    A former run may have had more objects, or views that have left the session since.
    """
    wanted = {p for view, part in parts.items() for p in _mask_paths(view, part)}
    wanted |= {p for view in parts for p in (grasps_path(view), part_path(view))}
    written_by_us = {
        "mask": r"\d{6}_\d{6}\.png",
        "mask_visib": r"\d{6}_\d{6}\.png",
        "grasps/views": r"\d{6}\.npz",
        "annotations": r"\d{6}\.json",
    }
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
