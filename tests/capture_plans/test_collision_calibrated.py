"""Links on a calibrated chain whose DH frames lie tens of metres away are where they are."""

from dataclasses import replace

import numpy as np
import pytest

from realsim.errors import InputError
from realsim.geometry import se3
from realsim.robots.arm import UR5, arm_of
from realsim.robots.kinematics import DhChain
from realsim.robots.link_shapes import link_placements
from realsim.robots.shapes import Box, WorkCell
from realsim_capture_plans.collision.model import GROUPS, CollisionModel
from realsim_capture_plans.collision.mount import d405_mount

CELL = WorkCell(
    table=Box(lower=(-0.6, -0.8, -np.inf), upper=(1.0, 0.8, 0.0)),
    keep_out=Box(lower=(0.225, -0.15, -np.inf), upper=(0.525, 0.15, 0.12)),
)


def unit(v: np.ndarray) -> np.ndarray:
    return v / np.linalg.norm(v)


def chain_through(axes: list[tuple[np.ndarray, np.ndarray]]) -> DhChain:
    """The UR5 whose joint axes 1-6 at zero are these lines (point, direction), in DH numbers.

    Standard DH leaves no choice: x_i is along the common normal of axes i and i + 1, however far
    away that is. The flange keeps its nominal place on axis 6.
    """
    nominal = UR5.link_frames(np.zeros(6))
    numbers = {name: getattr(UR5, name).copy() for name in ("theta", "d", "a", "alpha")}
    o, x, z = np.zeros(3), np.array([1.0, 0, 0]), axes[0][1]
    for i in range(5):
        p, z_next = axes[i + 1]
        normal = unit(np.cross(z, z_next))
        normal *= np.sign(normal @ nominal[i + 1][:3, 0]) or 1.0
        # Feet of the common normal: o + d z + a normal = p + s z_next.
        d, a, _ = np.linalg.solve(np.stack([z, normal, -z_next], axis=-1), p - o)
        theta = np.arctan2(np.cross(x, normal) @ z, x @ normal)
        alpha = np.arctan2(np.cross(z, z_next) @ normal, z @ z_next)
        for name, value in (("theta", theta), ("d", d), ("a", a), ("alpha", alpha)):
            numbers[name][i] = value
        o, x, z = o + d * z + a * normal, normal, z_next
    flange = nominal[6]
    numbers["d"][5] = (flange[:3, 3] - o) @ z
    numbers["theta"][5] = np.arctan2(np.cross(x, flange[:3, 0]) @ z, x @ flange[:3, 0])
    return replace(UR5, **{f"delta_{name}": numbers[name] - getattr(UR5, name) for name in numbers})


def factory_arm(seed: int, tilt_rad: float = 2e-4, shift_m: float = 3e-4) -> DhChain:
    """A UR5 as machined: every joint axis off by a fraction of a millimetre and a milliradian."""
    rng = np.random.default_rng(seed)
    axes: list[tuple[np.ndarray, np.ndarray]] = []
    for i, T in enumerate(UR5.link_frames(np.zeros(6))[:6]):
        by = rng.normal(0, tilt_rad, 3) if i else np.zeros(3)
        axes.append((T[:3, 3] + rng.normal(0, shift_m, 3) * (i > 0), se3.exp_so3(by) @ T[:3, 2]))
    return chain_through(axes)


ARMS = [factory_arm(seed) for seed in range(3)]


def test_links_stay_within_millimetres_of_the_nominal_ones() -> None:
    arm = max(ARMS, key=lambda a: np.abs(a.delta_d).max())
    placements = link_placements(arm_of(arm))
    q = np.random.default_rng(9).uniform(-np.pi, np.pi, (300, 6))
    at = arm.link_frames(q) @ placements
    nominal = UR5.link_frames(q)
    assert np.linalg.norm((at - nominal)[..., :3, 3], axis=-1).max() < 4e-3
    assert se3.angle(np.swapaxes(at, -1, -2)[..., :3, :3] @ nominal[..., :3, :3]).max() < 5e-3
    assert np.array_equal(placements[6], np.eye(4))  # the camera follows the calibrated flange
    assert np.linalg.norm((arm.link_frames(q) - nominal)[:, 2, :3, 3], axis=-1).min() > 0.9


def test_clearances_change_by_millimetres_only() -> None:
    arm = ARMS[0]
    q = np.random.default_rng(3).uniform(-np.pi, np.pi, (200, 6))
    mount = d405_mount()
    nominal, real = (CollisionModel(chain, mount, CELL, 0.01) for chain in (UR5, arm))
    assert real.pairs == nominal.pairs
    before, after = nominal.clearance(q), real.clearance(q)
    for group in GROUPS:
        assert np.abs(before[group] - after[group]).max() < 8e-3
    least = np.min([after[g] for g in GROUPS], axis=0)
    assert np.array_equal(real.free(q), least >= 0.01)


def test_another_arms_calibration_is_refused() -> None:
    other = replace(UR5, delta_a=np.array([0.0, -0.187, -0.18, 0.0, 0.0, 0.0]))
    with pytest.raises(InputError, match=r"moves the forearm of a nominal UR5 by up to \d+ mm"):
        CollisionModel(other, d405_mount(), CELL, 0.01)
    uncancelled = replace(UR5, delta_d=np.array([0.0, 11.198, -92.527, 0.0, 0.0, 0.0]))
    with pytest.raises(InputError, match="calibration file another arm's"):
        link_placements(arm_of(uncancelled))
