"""Whether the camera still sits where it was calibrated: known slips, false alarms, sigma."""

import numpy as np
import pytest

from realsim.arrays import Array
from realsim.geometry import se3
from realsim_calibration.pairs.drift import Drift, estimate_drift
from refusals import refused

SLIP = np.array([0.004, -0.006, 0.002, 0.003, -0.001, 0.002])


def cameras(n: int, seed: int) -> Array:
    """Return T_world_cam of cameras around a table, tilted and rolled."""
    rng = np.random.default_rng(seed)
    Ts: list[Array] = []
    for k in range(n):
        a = 2 * np.pi * k / n
        eye = [0.35 * np.cos(a), 0.35 * np.sin(a), 0.25 + 0.1 * (k % 3)]
        Ts.append(se3.look_at(eye, rng.normal(scale=0.02, size=3), rng.uniform(-1, 1)))
    return np.array(Ts)


def drift(slip: Array, seed: int = 0, noise: tuple[float, float] = (5e-4, 3e-4)) -> Drift:
    """Return what is found of a slip; the objects' frame is off by a centimetre, too."""
    rng = np.random.default_rng(50 + seed)
    now = cameras(12, seed)
    claimed = now @ se3.exp(-slip)
    claimed = claimed @ se3.exp(rng.normal(size=(12, 6)) * np.repeat(noise, 3))
    frame = se3.exp([0.01, -0.02, 0.03, 0.01, 0.005, -0.01])
    return estimate_drift(claimed, frame @ now, 0.45)


def test_a_known_slip_is_found() -> None:
    """Without noise the slip comes back whatever the objects' frame is."""
    found = drift(SLIP, noise=(1e-8, 1e-8))
    np.testing.assert_allclose(found.twist, SLIP, atol=2e-5)
    assert found.moved


def test_sigma_and_false_alarms() -> None:
    """None of 24 sessions without a slip is called moved; the squared distance is that of F."""
    found = [drift(np.zeros(6), seed) for seed in range(24)]
    assert not any(f.moved for f in found)
    distance = [float(f.twist @ np.linalg.solve(f.covariance, f.twist)) for f in found]
    assert 4.0 < np.mean(distance) < 10.0


@pytest.mark.parametrize("seed", range(3))
def test_three_millimetres_are_told_from_noise(seed: int) -> None:
    """A slip of 3.7 mm and 0.43 deg is named, with a size that fits its sigma."""
    found = drift(SLIP, seed)
    assert found.moved
    off = found.twist - SLIP
    assert off @ np.linalg.solve(found.covariance, off) < 25.0


def test_a_slip_within_the_tolerance_holds() -> None:
    """What shifts the objects by a fifth of a millimetre is seen and is of no matter."""
    now = cameras(24, 1)
    claimed = now @ se3.exp([0, 0, 0, -2e-4, 0, 0])
    found = estimate_drift(claimed, now, 0.45, tolerance_mm=1.0)
    assert not found.moved
    assert estimate_drift(claimed, now, 0.45, tolerance_mm=0.1).moved


def test_a_short_scan_says_that_it_cannot_tell() -> None:
    """Cameras that only slide have a sigma of many millimetres and raise no alarm."""
    now = np.array([se3.from_rt(np.eye(3), [0.02 * k, 0.01 * (k % 3), 0.0]) for k in range(8)])
    rng = np.random.default_rng(0)
    slip = se3.from_translation(SLIP[3:])
    claimed = now @ slip @ se3.exp(rng.normal(scale=2e-4, size=(8, 6)))
    found = estimate_drift(claimed, now, 0.45)
    assert found.sigmas[1] > 20.0
    assert not found.moved


def test_few_views_are_named() -> None:
    """Four views do not determine slip and frame."""
    now = cameras(4, 0)
    refused("at least 5 views", estimate_drift, now, now, 0.4)
