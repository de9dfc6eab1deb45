"""What `realsim register` leaves in SESSION/registration, and how other stages read it.

    scene.json          objects in world with covariance, checks and verdict; the table
    scene_table.json    the same in the table's frame: the one reference frame of the scene
    views.json          every object in every view: pose, covariance, sigma in mm and px
    cameras.json        where the cameras were said to be, and where they are
    scene_gt.json, scene_camera.json      the views in BOP's form [mm]
    single_view.json    the baseline: one view from above
    report.json         how it came about, what was not placed, what is wrong with views
    next.json           only while a result is being put in place

A result is many files, and a kill may come between two of them. So all values are first written to
next.json, whole or not at all; from then on the new result counts, and whoever comes next puts it
in place.
"""

from collections.abc import Mapping
from dataclasses import asdict
from typing import Any

import numpy as np

from realsim.app.register import results
from realsim.app.register.results import CameraChange, Json, Registered, sigmas
from realsim.arrays import Array
from realsim.geometry import se3
from realsim.json_values import json_value
from realsim.records import ObjectModel, Scene, bop_units
from realsim.store import SessionStore, atomic
from realsim.store.cameras import open_cameras
from realsim.untrusted.own_json import to_json

# --- to JSON ----------------------------------------------------------------------------------


def documents(
    result: Registered, store: SessionStore, models: Mapping[int, ObjectModel]
) -> dict[str, Any]:
    """Return the values of every file of a registration, by its path in the session."""
    report = result.report | {
        "not_placed": [asdict(n) for n in result.not_placed],
        "findings": [asdict(r) for r in result.remarks],
    }
    return {
        results.CAMERAS_FILE: _cameras_to_json(result.cameras),
        results.VIEWS_FILE: _seen_to_json(result, models),
        results.TABLE_FILE: _table_to_json(result.scene, models),
        f"{results.FOLDER}/scene_gt.json": _bop_objects(result),
        f"{results.FOLDER}/scene_camera.json": _bop_cameras(result, store),
        results.SINGLE_FILE: to_json(result.single_view),
        results.REPORT_FILE: json_value(_without_costs(report)),
        results.SCENE_FILE: to_json(result.scene),
    }


COSTS = "cpu_s"
"""In a report's parts: what is told apart from it, since it differs from run to run."""


def _without_costs(report: Json) -> Json:
    """Return a report without what its parts cost."""
    return {
        name: {k: v for k, v in part.items() if k != COSTS} if isinstance(part, dict) else part
        for name, part in report.items()
    }


def costs_of(report: Json) -> list[Json]:
    """Return what the parts of a report cost."""
    return [
        {"name": name, COSTS: json_value(part[COSTS])}
        for name, part in report.items()
        if isinstance(part, dict) and COSTS in part
    ]


def _cameras_to_json(cameras: CameraChange) -> Json:
    """Return the cameras before and after."""
    return {
        "format_version": results.FORMAT_VERSION,
        "claimed": _poses_to_json(cameras.claimed),
        "refined": _poses_to_json(cameras.refined),
    }


def _poses_to_json(poses: Mapping[int, Array]) -> Json:
    """Return poses by view."""
    return {str(k): to_json(poses[k]) for k in sorted(poses)}


def _seen_to_json(result: Registered, models: Mapping[int, ObjectModel]) -> Json:
    """Return every object in every view."""
    views: Json = {}
    seen, scene = result.seen, result.scene
    for index in sorted(seen):
        rows: Json = {}
        for instance, pose in sorted(seen[index].items()):
            mm, deg = sigmas(pose.covariance, models.get(scene.object(instance).obj_id))
            rows[str(instance)] = {
                "sigma_px": to_json(pose.sigma_px),
                "sigma_mm": to_json(mm),
                "sigma_deg": to_json(deg),
                "T_cam_obj": to_json(pose.T_cam_obj),
                "covariance": to_json(pose.covariance),
            }
        views[str(index)] = rows
    return {
        "format_version": results.FORMAT_VERSION,
        "covariance_of": "right perturbation of T_cam_obj, rotation first [rad, m]",
        "views": views,
    }


def _table_to_json(scene: Scene, models: Mapping[int, ObjectModel]) -> Json:
    """Return the scene in the table's frame; in world where no table was found.

    A covariance is of the right perturbation, in the object's own frame: it does not change.
    """
    plane = scene.plane
    T_world_table = np.eye(4) if plane is None else plane.T_world_table
    rows: list[Json] = []
    for o in scene.objects:
        row = to_json(o)
        T_world_obj = row.pop("T_world_obj")
        T = se3.invert(T_world_table) @ np.asarray(T_world_obj)
        name = models[o.obj_id].name if o.obj_id in models else ""
        rows.append({"name": name} | row | {"T_table_obj": to_json(T)})
    return {
        "format_version": results.FORMAT_VERSION,
        "name": scene.name,
        "frame": "world" if plane is None else "table",
        "T_world_table": to_json(T_world_table),
        "rms_m": None if plane is None else to_json(plane.rms_m),
        "inliers": None if plane is None else int(plane.inliers),
        "objects": rows,
    }


def _bop_objects(result: Registered) -> Json:
    """Return BOP's scene_gt [mm] of the views that took part, rejected objects left out."""
    scene: Json = {}
    for index, T_world_cam in sorted(result.cameras.refined.items()):
        rows: list[Json] = []
        for o in result.scene.objects:
            T_cam_obj = se3.invert(T_world_cam) @ o.T_world_obj
            if o.verdict == "rejected" or T_cam_obj[2, 3] <= 0:
                continue
            rotation, translation = bop_units.lists_from_rigid(T_cam_obj)
            bop_units.object_in_camera(rotation, translation, f"instance {o.instance}")
            rows.append({"cam_R_m2c": rotation, "cam_t_m2c": translation, "obj_id": o.obj_id})
        scene[str(index)] = rows
    return scene


def _bop_cameras(result: Registered, store: SessionStore) -> Json:
    """Return BOP's scene_camera [mm] of the views that took part."""
    session = store.session
    return {
        str(k): bop_units.camera_entry(session.intrinsics, session.depth_unit_m, T)
        for k, T in sorted(result.cameras.refined.items())
    }


# --- writing ----------------------------------------------------------------------------------


def write_result(
    store: SessionStore,
    result: Registered,
    models: Mapping[int, ObjectModel],
    pictures: Mapping[str, bytes],
) -> None:
    """Put a registration into its session; a kill leaves the old one or the new one.

    Args:
        store: the session; its cameras become the refined ones, those that stand still, too.
        result: what was found.
        models: obj_id -> model, for the names.
        pictures: path -> bytes of pictures and page.
    """
    before = store.session.Ts_world_cam
    value = {"before": _poses_to_json(before), "files": documents(result, store, models)}
    store.remove(results.STAGE_FILE)  # from here on the old result is not known to be whole
    store.write_bytes(results.NEXT_FILE, atomic.json_bytes(value, indent=None))
    finish_interrupted(store)
    cameras = open_cameras(store) if result.fixed else {}
    for name, change in result.fixed.items():
        cameras[name].write_json(results.CAMERAS_FILE, _cameras_to_json(change))
        cameras[name].set_cameras(cameras[name].session.intrinsics, change.session)
    for path, data in pictures.items():
        store.write_bytes(path, data)


def write_claims(store: SessionStore, claimed: Mapping[int, Array]) -> None:
    """Give a session without cameras those that were found for it, before any refinement."""
    change = CameraChange(claimed=dict(claimed), refined={})
    store.write_json(results.CAMERAS_FILE, _cameras_to_json(change))
    store.set_cameras(store.session.intrinsics, claimed)


def finish_interrupted(store: SessionStore) -> bool:
    """Put a result in place that a kill left in next.json; return whether there was one.

    Not where the cameras have been calibrated anew since: the result is of the old ones.
    """
    if not store.has(results.NEXT_FILE):
        return False
    value = store.read_json(results.NEXT_FILE)
    files: Json = value["files"]
    change = results.cameras_from_json(files[results.CAMERAS_FILE])
    now = store.session.Ts_world_cam
    known = any(
        results.is_same_cameras(now, cameras)
        for cameras in (results.poses_from_json(value["before"]), change.session)
    )
    if known:
        # The order is that of trust: the scene comes last, when its cameras are in place.
        for path, content in files.items():
            if path == results.SCENE_FILE:
                store.set_cameras(store.session.intrinsics, change.session)
            # On one line: covariances, a number a line, would be a hundred thousand lines.
            indent = None if path in (results.VIEWS_FILE, f"{results.FOLDER}/scene_gt.json") else 1
            store.write_bytes(path, atomic.json_bytes(content, indent=indent))
    store.remove(results.NEXT_FILE)
    return known
