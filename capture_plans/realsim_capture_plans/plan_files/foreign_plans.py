"""A capture plan for other programs: CSV, URScript, and camera poses for GraspNet.

GraspNet-1Billion stores camera poses in two npy files of a folder:
`camera_poses.npy` (N, 4, 4) holds every camera in the FIRST camera's frame, `cam0_wrt_table.npy`
(4, 4) the first camera in the table's frame, so that

    T_table_cam[i] = cam0_wrt_table @ camera_poses[i]

in metres, cameras as OpenCV's. The table's frame has its origin on the table's top straight below
the scene centre; its axes are those of the robot's base. GraspNet has no place for joints: the plan
itself lies beside the two files, so that a robot can drive it again.

A capture plan from other people's joint path: robot and units proven, every move checked.

Nothing is dropped: moves that collide in the model stay in the plan, are counted in its metrics
and named by `colliding_legs`.
"""

from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike, NDArray

from realsim.arrays import Array
from realsim.errors import DegenerateError, InputError
from realsim.formats.graspnet.cameras import FIRST, POSES
from realsim.geometry import se3
from realsim.robots.kinematics import DhChain
from realsim.robots.shapes import Box, Mount
from realsim_capture_plans.collision.model import interpolate
from realsim_capture_plans.plan_files.evidence import FITS_M
from realsim_capture_plans.plan_files.joint_paths import CAMERA_COLUMNS, JointPath
from realsim_capture_plans.plan_files.plan_json import save_plan
from realsim_capture_plans.planning.metrics import UR_JOINTS, Meaning, joint_names
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


AT_HOME_RAD = 0.05
"""The script starts only with every joint this near to home [rad]: nothing else was checked."""
JOINT_DIGITS = 15
"""Decimals of a joint in the script; URScript numbers are written without exponents."""


def export_csv(plan: CapturePlan, path: Path | str) -> None:
    """Write one row per configuration in driving order; `read_path` reads it back.

    Columns: view (of a via point: the view that it leads to), via (1 = only passed; the first one
    is home), q1_rad ... qn_rad, and at views the expected camera pose in base, cam_x_m ... cam_qz.
    Numbers come back bit for bit.
    """
    from realsim.store.atomic import write_text

    header = ["view", "via", *(f"q{j + 1}_rad" for j in range(plan.chain.joints)), *CAMERA_COLUMNS]
    quaternions = se3.quaternion_wxyz(plan.Ts_base_cam[:, :3, :3])
    lines = [",".join(header)]

    def row(view: int, via: bool, q: Array, camera: list[float]) -> None:
        numbers = [repr(v) for v in q.tolist()]
        pose = [repr(v) for v in camera] or [""] * len(CAMERA_COLUMNS)
        lines.append(",".join([str(view), str(int(via)), *numbers, *pose]))

    row(0, True, plan.home, [])
    for k in range(len(plan)):
        for q in plan.move(k)[1:-1]:
            row(k, True, q, [])
        row(
            k, False, plan.joints[k],
            [*plan.Ts_base_cam[k, :3, 3].tolist(), *quaternions[k].tolist()],
        )  # fmt: skip
    write_text(path, "\n".join(lines) + "\n")


def export_urscript(plan: CapturePlan, path: Path | str) -> None:
    """Write a program that drives the plan: a stop at every corner, a message at every view.

    It moves nothing unless the arm stands at the plan's home: only the moves from there on have
    been checked. Nothing is blended, so the path is the straight one in joint space. Where moves
    collide in the model (an imported plan's may), it says so and waits for the operator.

    Raises:
        InputError: the plan is not a Universal Robots arm's.
    """
    if joint_names(plan.chain) != UR_JOINTS:
        raise InputError(
            f"URScript drives Universal Robots' arms, and this plan is a {plan.robot}'s. Write a "
            "table instead (.csv: joints and expected camera poses in the order of the tour), and "
            "drive it with that arm's own program."
        )
    from realsim.store.atomic import write_text

    c = plan.config
    how = f"a={c.acceleration:.6f}, v={c.speed:.6f}"
    T = plan.mount.T_ee_cam
    pose = ", ".join(f"{v:.6f}" for v in [*T[:3, 3].tolist(), *se3.log_so3(T[:3, :3]).tolist()])
    legs = sum(len(plan.move(k)) - 1 for k in range(len(plan)))
    colliding = colliding_legs(plan)
    warning = f"{len(colliding)} moves of this plan collide in the model. Stop, or go on?"
    names = {"robot": plan.robot, "mount": plan.mount.name, "camera": plan.mount.camera}
    lines = [
        "# Capture plan written by realsim. Joints in rad, in the order base to wrist 3.",
        *(f"# {key}: {' '.join(value.split())}" for key, value in names.items()),
        f"# camera in the flange [m, rotation vector]: {pose}",
        f"# views: {len(plan)}, moves of the joints: {legs}",
        f"# sha256 of the plan: {plan.content_hash}",
        "# Checked for collisions with this mount and this table: the moves below, no others.",
        *(f"# NOT FREE: {leg}" for leg in colliding),
        "def realsim_plan():",
        *([f'  popup("{warning}", "realsim", True, False, True)'] if colliding else []),
        f"  home = {_list(plan.home)}",
        "  here = get_actual_joint_positions()",
        "  i = 0",
        "  while i < 6:",
        f"    if norm(here[i] - home[i]) > {AT_HOME_RAD}:",
        '      popup("Bring the arm to the home of the plan first.", "realsim", False, True, True)',
        "      halt",
        "    end",
        "    i = i + 1",
        "  end",
        f"  movej(home, {how})",
    ]
    for k in range(len(plan)):
        for q in plan.move(k)[1:]:
            lines.append(f"  movej({_list(q)}, {how})")
        lines.append(f"  sleep({c.settle_s:.6f})")
        lines.append(f'  textmsg("realsim view ", {k})')
    write_text(path, "\n".join([*lines, '  textmsg("realsim plan done")', "end", ""]))


def _list(q: Array) -> str:
    if not np.all(np.isfinite(q)):
        raise InputError(f"joints {q.tolist()} are not finite; such a plan is not written.")
    return "[" + ", ".join(f"{v:.{JOINT_DIGITS}f}" for v in q.tolist()) + "]"


PLAN = "plan.json"


def table_frame(plan: CapturePlan) -> Array:
    """Return T_base_table (4, 4) [m]: on the table's top below the scene centre, axes of base.

    Raises:
        InputError: the plan's table has no top.
    """
    x, y, _ = plan.center_world.tolist()
    top = float(plan.cell.table.upper[2])
    if not np.isfinite(top):
        raise InputError(
            "this plan's table has no top, and GraspNet's poses are relative to the table. Make "
            "the plan with --table-height."
        )
    return se3.from_translation([x, y, top])


def export_graspnet(plan: CapturePlan, folder: Path | str) -> list[Path]:
    """Write the poses, and the plan beside them; return the files.

    The files appear one by one, each whole; camera_poses.npy is the last one.

    Raises:
        InputError: the plan's table has no top.
    """
    folder = Path(folder)
    Ts_table_cam = se3.invert(table_frame(plan)) @ plan.Ts_base_cam
    relative = se3.invert(Ts_table_cam[0]) @ Ts_table_cam
    relative[0] = np.eye(4)
    save_plan(plan, folder / PLAN)
    _write_npy(folder / FIRST, Ts_table_cam[0])
    _write_npy(folder / POSES, relative)
    return [folder / PLAN, folder / FIRST, folder / POSES]


def _write_npy(path: Path, array: Array) -> None:
    import io

    from realsim.store.atomic import write_bytes

    buffer = io.BytesIO()
    np.save(buffer, np.ascontiguousarray(array))
    write_bytes(path, buffer.getvalue())
