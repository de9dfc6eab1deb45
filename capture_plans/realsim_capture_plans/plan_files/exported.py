"""A capture plan for other programs: CSV, URScript, and camera poses for GraspNet.

GraspNet-1Billion stores camera poses in two npy files of a folder:
`camera_poses.npy` (N, 4, 4) holds every camera in the FIRST camera's frame, `cam0_wrt_table.npy`
(4, 4) the first camera in the table's frame, so that

    T_table_cam[i] = cam0_wrt_table @ camera_poses[i]

in metres, cameras as OpenCV's. The table's frame has its origin on the table's top straight below
the scene centre; its axes are those of the robot's base. GraspNet has no place for joints: the plan
itself lies beside the two files, so that a robot can drive it again.
"""

from pathlib import Path

import numpy as np

from realsim.arrays import Array
from realsim.errors import InputError
from realsim.formats.graspnet.cameras import FIRST, POSES
from realsim.geometry import se3
from realsim_capture_plans.plan_files.joint_paths import CAMERA_COLUMNS
from realsim_capture_plans.plan_files.plan_json import save_plan
from realsim_capture_plans.planning.metrics import UR_JOINTS, joint_names
from realsim_capture_plans.planning.record import CapturePlan

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
    from realsim_capture_plans.plan_files.imported import colliding_legs

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
