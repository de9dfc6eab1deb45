"""A folder with everything that the examples in the commands' help speak of, small."""

import json
import shutil
from pathlib import Path

import numpy as np

from realsim.app.annotate.run import run_annotate
from realsim.app.console import Console
from realsim.app.register.files import write_result
from realsim.app.school.inputs import SchoolRequest
from realsim.app.school.run import run_in_session
from realsim.app.stages import save_starts
from realsim.arrays import Array32
from realsim.geometry.parts import part
from realsim.images import depth_counts, png_bytes
from realsim.records import CameraIntrinsics, Mesh
from realsim.rendering.depth_sensors.model import DepthSensorModel
from realsim.review.journal import append, new_entry
from realsim.store import SessionStore, load_scene
from realsim_capture_plans.collision.mount import d405_mount
from realsim_capture_plans.plan_files.plan_json import save_plan
from realsim_capture_plans.planning.make import hemisphere_plan
from realsim_capture_plans.planning.record import PlanConfig
from registered_sessions import CAMERA, models_of, registered_by_hand, table_session, true_poses
from upgradable_datasets import bop_dataset

GRASPS = 4
"""Tried on each object."""
D405 = DepthSensorModel.from_profile("d405", disparity_noise_px=0.06)


def make_inputs(root: Path, *, grasps: bool) -> None:
    """Write the inputs of the examples into a folder; grasps and labels take a few seconds."""
    session = root / "demo/session"
    store = table_session(session, views=4)
    save_starts(store, true_poses(), "by hand")
    write_result(store, registered_by_hand(store), models_of(), {})
    accepted = new_entry("accept", load_scene(store).objects[0], "anna")
    append(session / "review/journal.jsonl", accepted)
    if grasps:
        add_grasps(session)
    for name in ("monday", "tuesday"):
        shutil.copytree(session, root / name)
    bop_dataset(root / "dataset", views=2)
    shutil.copytree(session / "rgb", root / "frames/rgb")
    shutil.copytree(session / "depth", root / "frames/depth")
    camera_file(root / "camera.json", CAMERA)
    plan_file(root / "plan.json")
    walls(root / "wall", CAMERA)
    mesh_files(root)


def add_grasps(session: Path) -> None:
    """Try a few grasps and annotate the frames."""
    console = Console(quiet=True)
    run_in_session(SessionStore.open(session), SchoolRequest(grasps=GRASPS, where=1), console)
    run_annotate(session, console, maps="instance,depth", workers=1, check_depth=True)


def plan_file(path: Path) -> None:
    """Write a plan of a few views round the middle of the lab's table."""
    config, center = PlanConfig(), np.array([0.45, 0.0, 0.01])
    save_plan(hemisphere_plan(4, center, d405_mount(), config, np.random.default_rng(0)), path)


def camera_file(path: Path, camera: CameraIntrinsics) -> None:
    """Write intrinsics as BOP's camera.json."""
    names = ("fx", "fy", "cx", "cy", "width", "height")
    path.write_text(json.dumps({n: getattr(camera, n) for n in names} | {"depth_scale": 0.1}))


def wall(camera: CameraIntrinsics, z: float, tilt: float) -> Array32:
    """Return the depth of a slanted plane that is z away in the middle [m]."""
    v, u = np.mgrid[: camera.height, : camera.width]
    x, y = (u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy
    return (z / (1 + tilt * x + 0.2 * y)).astype(np.float32)


def walls(folder: Path, camera: CameraIntrinsics) -> None:
    """Write three depth images of a plane by a known D405."""
    folder.mkdir()
    for k, (z, tilt) in enumerate(((0.26, 0.2), (0.33, -0.2), (0.42, 0.1))):
        seen = D405.measure(wall(camera, z, tilt), camera, np.random.default_rng(k))
        (folder / f"{k:06d}.png").write_bytes(png_bytes(depth_counts(seen, 1e-4)))


def mesh_files(root: Path) -> None:
    """Write a mesh in millimetres, and one without a unit."""
    import trimesh

    mesh: Mesh = part("mug").mesh
    for name, scale in (("mug.stl", 1e3), ("generated.obj", 7.3)):
        trimesh.Trimesh(scale * mesh.vertices, mesh.faces, process=False).export(root / name)
