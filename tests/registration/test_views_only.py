"""Cameras refined from the overlap of their depth images alone."""

import numpy as np
import pytest

from realsim.errors import InputError
from realsim.geometry import se3
from realsim.geometry.parts import object_model
from realsim.records import ObjectModel, ObjectPose
from realsim.registration.evidence import DepthFrame, DepthNoise, EvidenceConfig, measure_noise
from realsim.registration.refinement.config import CameraPrior
from realsim.registration.refinement.views_only import ViewsConfig, refine_views
from realsim.registration.simulated import TableLabConfig, TableScene, table_scene
from realsim.registration.views import SampleConfig, sample_views

LAB = TableLabConfig(
    views=12, width=320, height=180, focal_px=162.0, arm_mm=2.0, arm_deg=0.3, hand_eye_mm=0.0,
    hand_eye_deg=0.0,
)  # fmt: skip
CONFIG = ViewsConfig(partners=4, prior=CameraPrior(hand_eye_mm=0.05, hand_eye_deg=0.01))
QUICK = ViewsConfig(rounds=2, points_per_view=800, surface_points=2500)


@pytest.fixture(scope="module")
def scene() -> TableScene:
    known = ("bunny", "duck", "mug", "l_bracket")
    models = {
        k: ObjectModel(obj_id=k, name=n, mesh=object_model(n).mesh)
        for k, n in enumerate(known, start=1)
    }
    placed: list[ObjectPose] = []
    for k, model in models.items():
        turn = se3.exp_so3([0, 0, 1.7 * k])
        at = [0.09 * np.cos(1.6 * k), 0.09 * np.sin(1.6 * k), -model.mesh.vertices[:, 2].min()]
        placed.append(ObjectPose(obj_id=k, instance=k, T_world_obj=se3.from_rt(turn, at)))
    return table_scene(models, placed, LAB, np.random.default_rng(5))


def points_of(scene: TableScene, moved: np.ndarray | None = None):
    frames = [
        DepthFrame(
            index=f.index, depth_m=f.depth_m,
            T_world_cam=f.T_world_cam if moved is None else moved @ f.T_world_cam,
        )
        for f in scene.frames
    ]  # fmt: skip
    noise = measure_noise(frames, EvidenceConfig())
    return sample_views(scene.intrinsics, frames, noise, SampleConfig(stride=1)), noise


def steps(true: np.ndarray, cameras: np.ndarray) -> tuple[float, float]:
    """Return how far neighbouring cameras are off against each other: median [mm], [deg]."""
    a = se3.invert(true[:-1]) @ true[1:]
    b = se3.invert(cameras[:-1]) @ cameras[1:]
    D = se3.invert(a) @ b
    mm = 1e3 * np.linalg.norm(D[:, :3, 3], axis=1)
    return float(np.median(mm)), float(np.median(np.degrees(se3.angle(D[:, :3, :3]))))


def test_a_bad_arm_is_put_right(scene):
    views, noise = points_of(scene)
    before = steps(scene.Ts_world_cam, scene.Ts_base_ee @ scene.T_ee_cam)
    refined = refine_views(scene.intrinsics, views, noise, CONFIG)
    after = steps(scene.Ts_world_cam, refined.cameras)
    assert before[0] > 3.0
    assert before[1] > 0.4
    assert after[0] < 0.35 * before[0]
    assert after[1] < 0.35 * before[1]
    # The arm was said to be ten times as good as it is; the views say otherwise.
    assert 1.0 < refined.view_sigma[1] < 4.0
    assert 0.15 < refined.view_sigma[0] < 0.6
    assert refined.overlaps.min() >= 2
    assert len(refined.history) == CONFIG.rounds


def test_it_does_not_matter_where_the_world_is(scene):
    views, noise = points_of(scene)
    moved = se3.from_rt(se3.exp_so3([0.4, -0.2, 2.0]), np.array([3.0, -1.0, 0.5]))
    there, _ = points_of(scene, moved)
    a = refine_views(scene.intrinsics, views, noise, QUICK)
    b = refine_views(scene.intrinsics, there, noise, QUICK)
    np.testing.assert_allclose(moved @ a.cameras, b.cameras, atol=2e-6)


def test_one_view_cannot_be_aligned(scene):
    views, _ = points_of(scene)
    with pytest.raises(InputError, match="two that overlap"):
        refine_views(scene.intrinsics, views[:1], DepthNoise(per_m=0.007, floor_m=2e-4))
