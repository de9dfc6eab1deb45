"""Real single frames of YCB-Video: repeatable ends, and starts of a neighbouring frame exposed."""

import json
import os
from pathlib import Path

import cv2
import numpy as np
import pytest

from realsim.geometry import se3
from realsim.geometry.mesh import load_mesh
from realsim.geometry.metrics import mssd
from realsim.records import CameraIntrinsics, ObjectModel, ObjectPose
from realsim.registration.blind import twist_rad
from realsim.registration.register import DepthFrame, RegistrationConfig, register_scene

ROOT = Path(__file__).resolve().parents[2]
DATA = Path(os.environ.get("REALSIM_DATA", ROOT.parent / "shared" / "data"))
YCBV = DATA / "scenes" / "ycbv_mini"
ROUND = {1, 4, 6, 13}
"""Cans and the bowl: bodies of revolution about z in their own frame, to about a millimetre."""
CONFIG = RegistrationConfig(with_single_view=False)

pytestmark = [
    pytest.mark.real,
    pytest.mark.skipif(not YCBV.is_dir(), reason=f"no ycbv_mini under {DATA} (set REALSIM_DATA)"),
]


def load(scene: int):
    """Return camera, frame, models and annotated poses of one frame (BOP: mm, depth in 0.1 mm)."""
    folder = YCBV / "test" / f"{scene:06d}"
    camera = next(iter(json.loads((folder / "scene_camera.json").read_text()).values()))
    annotation = next(folder.glob("scene_gt*.json"))
    poses = next(iter(json.loads(annotation.read_text()).values()))
    png = next((folder / "depth").iterdir())
    counts = cv2.imread(str(png), cv2.IMREAD_UNCHANGED)
    depth = (counts * (camera["depth_scale"] / 1000)).astype(np.float32)
    intrinsics = CameraIntrinsics.from_K(camera["cam_K"], depth.shape[1], depth.shape[0])
    starts, models = [], {}
    for i, p in enumerate(poses):
        R, t = np.reshape(p["cam_R_m2c"], (3, 3)), np.array(p["cam_t_m2c"]) / 1000
        starts.append(ObjectPose(obj_id=p["obj_id"], instance=i, T_world_obj=se3.from_rt(R, t)))
        mesh = load_mesh(YCBV / "models" / f"obj_{p['obj_id']:06d}.ply", unit="mm")
        models[p["obj_id"]] = ObjectModel(obj_id=p["obj_id"], name=str(p["obj_id"]), mesh=mesh)
    frame = DepthFrame(index=int(png.stem), depth_m=depth, T_world_cam=np.eye(4))
    return intrinsics, frame, models, starts


def symmetries(obj_id: int):
    turns = np.radians(np.arange(0, 360, 1 if obj_id in ROUND else 360))
    return se3.from_rt(se3.exp_so3(turns[:, None] * np.array([0.0, 0.0, 1.0])), np.zeros(3))


@pytest.mark.slow
@pytest.mark.parametrize("scene", [50, 51, 54])
def test_annotated_and_perturbed_starts_end_alike(scene, move_start):
    intrinsics, frame, models, starts = load(scene)
    rng = np.random.default_rng(scene)
    rough = [move_start(s, models[s.obj_id], rng, 10, 10) for s in starts]
    first = register_scene("a", intrinsics, [frame], models, starts, CONFIG)
    second = register_scene("b", intrinsics, [frame], models, rough, CONFIG)
    apart = [
        1e3
        * mssd(
            a.T_world_obj,
            b.T_world_obj,
            models[a.obj_id].mesh.vertices,
            symmetries(a.obj_id),
        )
        for a, b in zip(first.scene.objects, second.scene.objects, strict=True)
    ]
    assert np.median(apart) < 1.0, apart
    assert max(apart) < 4.0, apart
    assert all(o.verdict != "rejected" for o in first.scene.objects)
    assert first.scene.plane is not None
    assert not first.report["common_offset_mm"]["consistent"]
    # The depth of these frames reads short: all objects sink by 4 to 5 % of their height.
    sinking = first.report["common_sinking"]
    assert sinking["consistent"], sinking
    assert -0.06 < sinking["share_of_height"] < -0.03


@pytest.mark.slow
@pytest.mark.parametrize(("scene", "can"), [(50, 4), (51, 1), (51, 4), (52, 6)])
def test_a_can_keeps_the_turn_of_its_annotation(scene, can):
    intrinsics, frame, models, starts = load(scene)
    objects = register_scene("a", intrinsics, [frame], models, starts, CONFIG).scene.objects
    (start,) = [s for s in starts if s.obj_id == can]
    end = objects[start.instance]
    R = start.T_world_obj[:3, :3].T @ end.T_world_obj[:3, :3]
    assert end.checks["blind_axes"] == 1
    assert abs(np.degrees(twist_rad(R, np.array([0.0, 0.0, 1.0])))) < 0.5


@pytest.mark.slow
def test_poses_of_a_neighbouring_frame_are_exposed():
    intrinsics, frame, models, starts = load(53)
    report = register_scene("53", intrinsics, [frame], models, starts, CONFIG).report
    common = report["common_offset_mm"]
    assert common["consistent"], common
    np.testing.assert_allclose(common["offset_mm"], [12.0, 0.6, 3.0], atol=1.5)
    assert common["spread_mm"] < 2.0
