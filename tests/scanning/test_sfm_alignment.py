"""The similarity to the robot's poses: laws, a slipped view, an honest sigma, degenerate motion."""

from dataclasses import replace

import numpy as np
import pytest

from realsim.errors import DegenerateError
from realsim.geometry import se3
from realsim.geometry.camera import project, ray_table
from realsim.records import CameraIntrinsics
from realsim.scanning.sfm.alignment import align_to_robot
from realsim.scanning.sfm.bundle import adjust, point_covariances, reprojection_errors
from realsim.scanning.sfm.config import AlignmentConfig, MappingConfig, RobotNoise, TrustConfig
from realsim.scanning.sfm.judging import depth_scale
from realsim.scanning.sfm.result import Geometry
from refusals import refused

VIEWS = 24


def cameras(rng: np.random.Generator, views: int = VIEWS) -> np.ndarray:
    """Return cameras (V, 4, 4) on a hemisphere of 0.25 to 0.45 m that look at the origin."""
    turn = rng.uniform(0, 2 * np.pi, views)
    rise = np.radians(rng.uniform(25, 85, views))
    ray = np.stack([np.cos(turn) * np.cos(rise), np.sin(turn) * np.cos(rise), np.sin(rise)], -1)
    eyes = rng.uniform(0.25, 0.45, views)[:, None] * ray
    return np.stack([se3.look_at(eye, np.zeros(3)) for eye in eyes])


def in_other_world(Ts: np.ndarray, scale: float, rng: np.random.Generator) -> np.ndarray:
    """Return cameras in a world whose unit is `scale` metres, turned and shifted."""
    moved = se3.random_transform(rng) @ Ts
    moved[:, :3, 3] /= scale
    return moved


def names(count: int) -> tuple[str, ...]:
    return tuple(f"{k:06d}.png" for k in range(count))


def test_exact_poses_give_the_exact_scale() -> None:
    rng = np.random.default_rng(1)
    T = cameras(rng)
    found = in_other_world(T, 240.0, rng)
    a = align_to_robot(names(VIEWS), found, T, AlignmentConfig(), rng)
    assert a.scale == pytest.approx(240.0, rel=1e-6)
    assert np.allclose(a.scale * found[:, :3, 3] @ a.R.T + a.t, T[:, :3, 3], atol=1e-7)
    assert max(v.offset_mm for v in a.views) < 1e-3
    assert not any(v.outlier for v in a.views)


def test_a_slipped_view_is_named_and_changes_nothing() -> None:
    rng = np.random.default_rng(2)
    T = cameras(rng)
    found = in_other_world(T, 0.1, rng)
    robot = T.copy()
    robot[5, :3, 3] += [0.03, 0.0, 0.0]
    robot[17] = robot[17] @ se3.exp([0.0, 0.2, 0.0, 0.0, 0.0, 0.0])
    a = align_to_robot(names(VIEWS), found, robot, AlignmentConfig(), rng)
    assert [v.name for v in a.views if v.outlier] == ["000005.png", "000017.png"]
    assert abs(a.scale / 0.1 - 1) < 1e-3


@pytest.mark.slow
def test_the_interval_covers_with_arm_and_hand_eye_errors() -> None:
    hits, runs, views = 0, 30, 12
    for seed in range(runs):
        rng = np.random.default_rng([3, seed])
        T = cameras(rng, views)
        noise = AlignmentConfig().noise
        s = np.repeat([np.radians(noise.rotation_deg), noise.position_mm / 1e3], 3)
        h = np.repeat([np.radians(noise.hand_eye_deg), noise.hand_eye_mm / 1e3], 3)
        errors = se3.exp(s * rng.standard_normal((views, 6)))
        robot = T @ se3.exp(h * rng.standard_normal(6)) @ errors
        # The arm's own metre is part of the sigma, so it errs here, too.
        robot[:, :3, 3] *= 1 + noise.arm_scale_percent / 100 * rng.standard_normal()
        a = align_to_robot(names(views), in_other_world(T, 0.1, rng), robot, AlignmentConfig(), rng)
        hits += abs(a.scale / 0.1 - 1) <= 1.96 * a.sigma / a.scale
    assert 0.87 <= hits / runs <= 1.0


def test_a_hand_eye_error_along_the_axis_is_in_the_sigma() -> None:
    rng = np.random.default_rng(4)
    turn = np.linspace(0, 2 * np.pi, VIEWS, endpoint=False)
    eyes = 0.4 * np.stack([np.cos(turn) * 0.7, np.sin(turn) * 0.7, np.full(VIEWS, 0.71)], -1)
    T = np.stack([se3.look_at(eye, np.zeros(3)) for eye in eyes])
    a = align_to_robot(names(VIEWS), T, T, AlignmentConfig(), rng)
    # A ring: nothing but its prior tells an outward error from the scale.
    assert a.parts_percent["hand_eye"] == pytest.approx(100 * 0.5e-3 / 0.28, rel=0.02)


def test_too_few_views_no_motion_and_other_lengths_are_refused() -> None:
    rng = np.random.default_rng(5)
    T = cameras(rng)
    with pytest.raises(DegenerateError, match="2 registered view"):
        align_to_robot(names(2), T[:2], T[:2], AlignmentConfig(), rng)
    still = T.copy()
    still[:, :3, 3] = [0.3, 0.1, 0.4]
    with pytest.raises(DegenerateError, match="turned on the spot"):
        align_to_robot(names(VIEWS), T, still, AlignmentConfig(), rng)
    refused("one of each", align_to_robot, names(VIEWS), T, T[:-1], AlignmentConfig(), rng)


# --- The bundle adjustment, the depth's scale and the choice of pairs on made-up geometry.

CAMERA = CameraIntrinsics(
    width=640, height=480, fx=500.0, fy=500.0, cx=319.5, cy=239.5,
    distortion=np.array([-0.05, 0.02]),
)  # fmt: skip


def scene(rng: np.random.Generator, views: int = 10, points: int = 200) -> Geometry:
    """Return an exact geometry: cameras around points, all seen by all."""
    turn = np.linspace(0, 2 * np.pi, views, endpoint=False)
    eyes = np.stack([0.25 * np.cos(turn), 0.25 * np.sin(turn), 0.3 + 0.05 * np.cos(3 * turn)], -1)
    T = np.stack([se3.look_at(eye, np.zeros(3)) for eye in eyes])
    X = rng.uniform(-0.08, 0.08, (points, 3))
    cam, pt = np.repeat(np.arange(views), points), np.tile(np.arange(points), views)
    local = se3.transform(se3.invert(T), X).reshape(-1, 3)
    return Geometry(
        intrinsics=CAMERA, names=names(views), Ts_world_cam=T,
        points=X, colors=np.zeros((points, 3), np.uint8), cameras_of=cam, points_of=pt,
        uv_px=project(CAMERA, local), point_ids=np.arange(points),
    )  # fmt: skip


def test_wrong_poses_are_pulled_to_the_pictures_at_the_robots_scale() -> None:
    rng = np.random.default_rng(1)
    true = scene(rng)
    noise = RobotNoise(position_mm=2.0, rotation_deg=0.3)
    s = np.repeat([np.radians(0.3), 2e-3], 3)
    robot = true.Ts_world_cam @ se3.exp(s * rng.standard_normal((len(true.names), 6)))
    points = true.points + 2e-3 * rng.standard_normal((200, 3))
    uv = true.uv_px + 0.2 * rng.standard_normal(true.uv_px.shape)
    start = replace(true, Ts_world_cam=robot, points=points, uv_px=uv)
    b = adjust(start, robot, noise, MappingConfig())
    assert np.median(np.abs(reprojection_errors(b.geometry))) < 0.2
    assert b.sigma_px == pytest.approx(0.2, rel=0.15)

    # What is left is the frame: relative poses are far better than the robot's.
    def relative(T: np.ndarray) -> np.ndarray:
        return se3.log(se3.invert(se3.invert(true.Ts_world_cam[:1]) @ true.Ts_world_cam[1:])
                       @ se3.invert(T[:1]) @ T[1:])  # fmt: skip

    before, after = (np.abs(relative(T)).mean() for T in (robot, b.geometry.Ts_world_cam))
    assert after < before / 5
    spread = np.linalg.norm(b.geometry.Ts_world_cam[:, :3, 3].std(0))
    assert spread == pytest.approx(np.linalg.norm(true.Ts_world_cam[:, :3, 3].std(0)), rel=0.01)


def test_wrong_matches_do_not_move_the_result() -> None:
    rng = np.random.default_rng(2)
    true = scene(rng)
    uv = true.uv_px + 0.1 * rng.standard_normal(true.uv_px.shape)
    uv[rng.choice(len(uv), len(uv) // 10, replace=False)] += rng.uniform(-60, 60, 2)
    T = true.Ts_world_cam
    b = adjust(replace(true, uv_px=uv), T, RobotNoise(), MappingConfig())
    assert 1e3 * np.abs(se3.log(se3.invert(T) @ b.geometry.Ts_world_cam)[:, 3:]).max() < 0.3


def test_point_sigmas_are_those_of_repeated_noise() -> None:
    rng = np.random.default_rng(3)
    true = scene(rng, points=60)
    tight = RobotNoise(position_mm=1e-4, rotation_deg=1e-5, hand_eye_mm=1e-4, hand_eye_deg=1e-5)
    said = np.sqrt(np.einsum("pii->p", point_covariances(true, 0.3)))
    noisy = replace(true, uv_px=true.uv_px + 0.3 * rng.standard_normal(true.uv_px.shape))
    moved = adjust(noisy, true.Ts_world_cam, tight, MappingConfig(robust_px=50.0)).geometry.points
    found = np.linalg.norm(moved - true.points, axis=1)
    assert np.sqrt(np.mean((found / said) ** 2)) == pytest.approx(1.0, abs=0.2)


def test_measured_depth_gives_the_ratio() -> None:
    true = scene(np.random.default_rng(4))
    flat = replace(true, points=true.points * [1.0, 1.0, 0.0])
    local = se3.transform(se3.invert(flat.Ts_world_cam), flat.points)
    flat = replace(flat, uv_px=project(CAMERA, local.reshape(-1, 3)))

    def table(name: str) -> np.ndarray:
        T = flat.Ts_world_cam[int(name[:6])]
        rays = ray_table(CAMERA) @ T[:3, :3].T
        return (-T[2, 3] / rays[..., 2] * 0.98).astype(np.float32)

    found = depth_scale(flat, table, TrustConfig())
    assert found is not None
    assert found.ratio == pytest.approx(0.98, rel=2e-3)
    assert found.views == 10
    assert depth_scale(flat, lambda name: None, TrustConfig()) is None
