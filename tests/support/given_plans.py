"""Capture plans of joints that a test gives, and joints of a camera that looks down."""

from collections.abc import Iterable
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from realsim.arrays import Array
from realsim.geometry import se3
from realsim.robots.arm import UR5
from realsim.robots.kinematics import DhChain
from realsim.robots.shapes import Box
from realsim_capture_plans.collision.mount import d405_mount
from realsim_capture_plans.planning.record import CapturePlan, PlanConfig


def plan_through(
    joints: Array,
    home: Array,
    center: ArrayLike,
    kind: Any = "hemisphere",
    obstacles: tuple[tuple[str, Box], ...] = (),
    config: PlanConfig | None = None,
    **more: Any,
) -> CapturePlan:
    """A UR5's plan with a D405, in the config's cell; `more` are other fields of it."""
    config = config or PlanConfig()
    given = {
        "chain": UR5, "mount": d405_mount(), "cell": config.work_cell(center, kind, obstacles),
        "vias": (), "reference_view": 0,
    } | more  # fmt: skip
    return CapturePlan(
        kind=kind, home=home, joints=joints, center_world=np.asarray(center), config=config, **given
    )


def calibrated(chain: DhChain, seed: int) -> DhChain:
    """A chain as a factory calibration leaves it: about 0.5 mm and 1 mrad off in every number."""
    rng = np.random.default_rng(seed)
    return replace(
        chain,
        delta_a=rng.normal(0, 5e-4, 6),
        delta_d=rng.normal(0, 5e-4, 6),
        delta_alpha=rng.normal(0, 1e-3, 6),
        delta_theta=rng.normal(0, 1e-3, 6),
    )


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
