"""Camera poses as GraspNet-1Billion stores them: two npy files in a folder.

`camera_poses.npy` (N, 4, 4) holds every camera in the FIRST camera's frame, `cam0_wrt_table.npy`
(4, 4) the first camera in the table's frame, so that

    T_table_cam[i] = cam0_wrt_table @ camera_poses[i]

in metres, cameras as OpenCV's. The table's frame has its origin on the table's top straight below
the scene centre; its axes are those of the robot's base. GraspNet has no place for joints: the plan
itself lies beside the two files, so that a robot can drive it again.
"""

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from realsim.errors import InputError
from realsim.formats.graspnet.cameras import FIRST, POSES
from realsim.geometry import se3
from realsim_capture_plans.plan_files.plan_json import save_plan
from realsim_capture_plans.planning.record import CapturePlan

Array = NDArray[np.float64]
PLAN = "plan.json"
GRASPNET_VIEWS = 256
"""graspnetAPI reads scenes of exactly this many views."""


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
