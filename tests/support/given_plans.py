"""Capture plans of joints that a test gives, joints of a camera that looks down, and stops."""

from collections.abc import Callable, Iterable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from numpy.typing import ArrayLike

from realsim.arrays import Array
from realsim.geometry import se3
from realsim.robots.arm import UR5, find_arm
from realsim.robots.kinematics import DhChain
from realsim.robots.shapes import Box, WorkCell
from realsim_capture_plans.capturing.look import CaptureConfig, SettleConfig
from realsim_capture_plans.collision.mount import d405_mount
from realsim_capture_plans.devices.interfaces import ArmStoppedError, Stop
from realsim_capture_plans.planning.record import CapturePlan, PlanConfig

HOME, CENTER = np.array([0.1, -1.6, 1.7, -1.7, -1.5, 0.3]), np.array([0.37, 0.02, 0.05])
MOUNT = d405_mount(se3.exp([0.02, -0.1, 0.3, 0.0, -0.065, 0.035]))
"""The mount of `a_plan`."""
UR5_HOME = find_arm("ur5").home
TURNED_HOME = UR5_HOME + np.pi * np.eye(6)[0]
"""On the side where the table is."""
BENCH = WorkCell(
    table=Box(lower=(-0.6, -0.8, -np.inf), upper=(1.0, 0.8, 0.0)),
    keep_out=Box(lower=(0.225, -0.15, -np.inf), upper=(0.525, 0.15, 0.12)),
)
"""A table in front of a UR5, with a box over the objects that is kept free."""
QUICK = CaptureConfig(still=SettleConfig(window_s=0.0))
"""For arms that stand at once."""


def plan_through(
    joints: Array, home: Array, center: ArrayLike, kind: Any = "hemisphere",
    obstacles: tuple[tuple[str, Box], ...] = (), config: PlanConfig | None = None, **more: Any,
) -> CapturePlan:  # fmt: skip
    """A UR5's plan with a D405, in the config's cell; `more` are other fields of it."""
    config = config or PlanConfig()
    given = {
        "chain": UR5, "mount": d405_mount(), "cell": config.work_cell(center, kind, obstacles),
        "vias": (), "reference_view": 0, "center_world": np.asarray(center),
    } | more  # fmt: skip
    return CapturePlan(kind=kind, home=home, joints=joints, config=config, **given)


def a_plan(chain: DhChain = UR5, n: int = 9, seed: int = 0) -> CapturePlan:
    """Views scattered round home, two moves over via points: files do not ask how it was made."""
    rng = np.random.default_rng(seed)
    lamp = Box(lower=(-np.inf, 0.5, 0.0), upper=(-0.6, 0.6, 0.8))
    return plan_through(
        HOME + rng.normal(0, 0.4, (n, 6)), HOME, CENTER, obstacles=(("lamp", lamp),), chain=chain,
        config=PlanConfig(settle_s=0.4, table_height_m=-0.02), mount=MOUNT, reference_view=3,
        vias=((0, HOME + rng.normal(0, 0.2, (2, 6))), (4, HOME + rng.normal(0, 0.2, (1, 6)))),
        metrics={"views": float(n), "seconds": 12.345678901234567},
    )  # fmt: skip


def calibrated(chain: DhChain, seed: int) -> DhChain:
    """A chain as a factory calibration leaves it: about 0.5 mm and 1 mrad off in every number."""
    rng = np.random.default_rng(seed)
    return replace(
        chain, delta_a=rng.normal(0, 5e-4, 6), delta_d=rng.normal(0, 5e-4, 6),
        delta_alpha=rng.normal(0, 1e-3, 6), delta_theta=rng.normal(0, 1e-3, 6),
    )  # fmt: skip


def driven_clear(plan: CapturePlan, path: Iterable[Array]) -> bool:
    """Return whether straight moves from station to station keep the plan's clearance."""
    corners, step = np.stack(list(path)), plan.config.edge_step_rad
    return bool(np.all(plan.collision_model().edges_free(corners[:-1], corners[1:], step)))


def joints_looking_at(center: Array, eyes: Iterable[Array], home: Array) -> list[Array]:
    """Joints of a UR5 whose D405 looks from each eye at the centre, turned as it is at home."""
    joints: list[Array] = []
    y = UR5.forward(home)[:3, 1]
    for eye in eyes:
        z = (center - eye) / np.linalg.norm(center - eye)
        x = np.cross(y, z) / np.linalg.norm(np.cross(y, z))
        T = se3.from_rt(np.stack([x, np.cross(z, x), z], axis=1), eye)
        q = UR5.inverse(T @ se3.invert(d405_mount().T_ee_cam))
        joints.append(q[np.argmin(np.abs(q - (joints[-1] if joints else home)).max(-1))])
    return joints


def ring_plan(center: Array, home: Array, views: int) -> CapturePlan:
    """A calibration plan of views on a narrow ring that look down at a point of the table."""
    turns = np.linspace(0.0, 2 * np.pi, views, endpoint=False)
    eyes = [center + 0.32 * np.array([0.25 * np.cos(a), 0.25 * np.sin(a), 1.0]) for a in turns]
    joints = np.stack(joints_looking_at(center, eyes, home))
    return plan_through(joints, home, center, "calibration")


def stopped(
    stop: Stop, why: str, call: Callable[..., object], *args: object, **options: object
) -> str:
    """Hold that `call(*args, **options)` ends in this stop of the arm and says `why`; return it."""
    with pytest.raises(ArmStoppedError, match=why) as caught:
        call(*args, **options)
    assert caught.value.stop == stop
    return str(caught.value)
