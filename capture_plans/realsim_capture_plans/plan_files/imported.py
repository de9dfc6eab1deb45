"""A capture plan from other people's joint path: robot and units proven, every move checked.

Nothing is dropped: moves that collide in the model stay in the plan, are counted in its metrics
and named by `colliding_legs`.
"""

from dataclasses import replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from realsim.arrays import Array
from realsim.errors import DegenerateError, InputError
from realsim.geometry import se3
from realsim.robots.kinematics import DhChain
from realsim.robots.shapes import Box, Mount
from realsim_capture_plans.collision.model import interpolate
from realsim_capture_plans.plan_files.evidence import FITS_M
from realsim_capture_plans.plan_files.joint_paths import JointPath
from realsim_capture_plans.planning.metrics import Meaning, joint_names
from realsim_capture_plans.planning.record import CapturePlan, PlanConfig
from realsim_capture_plans.planning.task import checked_center
from realsim_capture_plans.planning.tour_time import TourTime

LEAST_AXIS_SPREAD = 0.02
"""Least eigenvalue, relative to the number of views, of the system for the point that the optical
axes meet at: axes within 8 degrees of each other do not determine it."""

IMPORT_MEANINGS = {
    "rows_after_last_view": Meaning(
        "rows of the file after its last view, left out", "", "0", "less"
    ),
    "tool_pose_gap_m": Meaning(
        "what is left between the file's tool poses and the arm's, middle row",
        "m", "< 0.005 nominal, < 0.001 calibrated", "less",
    ),
    "tool_offset_m": Meaning(
        "length of the tool offset that the file's poses were of", "m", "as configured then",
        "as asked",
    ),
}  # fmt: skip
"""What the metrics say that only imported plans have."""


def plan_of_path(
    path: JointPath,
    *,
    chain: DhChain,
    mount: Mount,
    config: PlanConfig,
    center: ArrayLike | None = None,
    obstacles: tuple[tuple[str, Box], ...] = (),
) -> CapturePlan:
    """Return the plan of kind "imported" of a joint path.

    Rows with a via flag become via points of the move to the next view; the first one is home. What
    comes after the last view is left out and counted (`rows_after_last_view`).

    Args:
        path: of `read_path`.
        chain: the arm that will drive it.
        mount: the camera on the flange.
        config: clearances, speeds, the table and the keep-out box.
        center: (3,) what the views look at, in base [m]; by default where the optical axes meet.
        obstacles: further named boxes in base.

    Raises:
        InputError: another robot's path, or joints beyond the limits.
        UnitError: a centre in another unit.
        DegenerateError: no centre is given and the optical axes meet nowhere.
    """
    _check_limits(path, chain)
    views = np.flatnonzero(~path.via)
    if not len(views):
        raise InputError(f"{path.source}: all of its {len(path.via)} rows are via points.")
    joints = path.joints[views]
    Ts_base_cam = chain.forward(joints) @ mount.T_ee_cam
    _check_camera(path, views, Ts_base_cam)
    aim = axes_meeting_point(Ts_base_cam) if center is None else checked_center(center)
    starts = [1, *(views[:-1] + 1)]  # the first row is home, whatever it is
    vias = tuple(
        (k, path.joints[first:last])
        for k, (first, last) in enumerate(zip(starts, views, strict=True))
        if last > first
    )
    plan = CapturePlan(
        kind="imported",
        chain=chain,
        mount=mount,
        cell=config.work_cell(aim, "imported", obstacles),
        home=path.joints[0],
        joints=joints,
        center_world=aim,
        vias=vias,
        reference_view=int(np.argmin(Ts_base_cam[:, 2, 2])),
        config=config,
    )
    metrics = {
        "colliding_legs": float(len(colliding_legs(plan))),
        "rows_after_last_view": float(len(path.joints) - 1 - views[-1]),
    }
    if path.reading is not None:
        metrics["tool_pose_gap_m"] = path.reading.gap_m
        metrics["tool_offset_m"] = float(np.linalg.norm(path.reading.T_ee_tcp[:3, 3]))
    return replace(plan, metrics=metrics)


def colliding_legs(plan: CapturePlan) -> tuple[str, ...]:
    """Return one line for every straight piece of a move that does not keep the clearance."""
    model, step = plan.collision_model(), plan.config.edge_step_rad
    tour = TourTime.of(plan)
    lines: list[str] = []
    for i in np.flatnonzero(~model.edges_free(tour.start, tour.goal, step)).tolist():
        samples, _ = interpolate(tour.start[i], tour.goal[i], step)
        least = np.min(np.stack(list(model.clearance(samples).values())), axis=0)
        at = int(np.argmin(least))
        _, part, other, distance = model.nearest(samples[at])
        how = (
            f"{-1e3 * distance:.0f} mm inside" if distance < 0 else f"{1e3 * distance:.0f} mm from"
        )
        k = int(tour.move[i])
        legs = np.flatnonzero(tour.move == k)
        source = "home" if k == 0 else f"view {k - 1}"
        piece = "" if len(legs) == 1 else f" (piece {i - legs[0] + 1} of {len(legs)})"
        share = at / max(len(samples) - 1, 1)
        lines.append(f"{source} -> view {k}{piece}, {share:.0%} of the way: {part} {how} {other}")
    return tuple(lines)


def axes_meeting_point(Ts_base_cam: Array) -> Array:
    """Return the point (3,) [m] nearest to the optical axes of cameras (N, 4, 4), least squares.

    Raises:
        DegenerateError: the axes are parallel, or nearly.
    """
    axis, eye = Ts_base_cam[:, :3, 2], Ts_base_cam[:, :3, 3]
    across = np.eye(3) - axis[:, :, None] * axis[:, None, :]
    total = across.sum(axis=0)
    if float(np.linalg.eigvalsh(total)[0]) < LEAST_AXIS_SPREAD * len(axis):
        raise DegenerateError(
            "the cameras all look the same way, so what they look at cannot be found. Give it with "
            "--center x,y,z [m]."
        )
    return np.linalg.solve(total, np.einsum("nij,nj->i", across, eye))


def _check_limits(path: JointPath, chain: DhChain) -> None:
    """Raise if a row is beyond the joints' limits."""
    low, high = chain.limits.lower, chain.limits.upper
    beyond = np.argwhere((path.joints < low) | (path.joints > high))
    if len(beyond):
        i, j = beyond[0]
        raise InputError(
            f"{path.source}, {path.rows[i]}: {joint_names(chain)[j]} is "
            f"{np.degrees(path.joints[i, j]):.1f} deg; a {chain.name} goes from "
            f"{np.degrees(low[j]):.0f} to {np.degrees(high[j]):.0f} deg ({len(beyond)} such "
            "values in all). Subtract a whole turn, or delete the row."
        )


def _check_camera(path: JointPath, views: NDArray[np.intp], Ts_base_cam: Array) -> None:
    """Raise if the camera poses that the file expects are not those of this arm and mount."""
    if path.Ts_base_cam is None:
        return
    written = path.Ts_base_cam[views]
    has = np.isfinite(written).all(axis=(-2, -1))
    if not has.any():
        return
    offset = se3.invert(Ts_base_cam[has]) @ written[has]
    gap = np.linalg.norm(offset[:, :3, 3], axis=-1)
    if float(np.median(gap)) > FITS_M:
        raise InputError(
            f"{path.source}: its camera poses are {1e3 * float(np.median(gap)):.0f} mm from those "
            "of this robot and this mount. Give the robot (--arm) and the mount (--mount) that "
            "the file was written for, or take out the cam_ columns."
        )
