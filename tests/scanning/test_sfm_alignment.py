"""The similarity to the robot's poses: laws, a slipped view, an honest sigma, degenerate motion."""

import numpy as np
import pytest

from realsim.errors import DegenerateError, InputError
from realsim.geometry import se3
from realsim.scanning.sfm.alignment import align_to_robot
from realsim.scanning.sfm.config import AlignmentConfig

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
    with pytest.raises(InputError, match="one of each"):
        align_to_robot(names(VIEWS), T, T[:-1], AlignmentConfig(), rng)
