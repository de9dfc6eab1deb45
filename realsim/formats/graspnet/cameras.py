"""Camera poses as GraspNet-1Billion stores them: two npy files in a camera's folder.

`camera_poses.npy` (N, 4, 4) holds every camera in the FIRST camera's frame, `cam0_wrt_table.npy`
(4, 4) the first camera in the table's frame, so that

    T_table_cam[i] = cam0_wrt_table @ camera_poses[i]

in metres, cameras as OpenCV's.
"""

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from realsim.errors import InputError
from realsim.geometry import se3

Array = NDArray[np.float64]

POSES, FIRST = "camera_poses.npy", "cam0_wrt_table.npy"
MOST_VIEWS = 100_000
"""A file with more is no camera poses."""


def read_camera_poses(folder: Path | str) -> Array:
    """Return T_table_cam (N, 4, 4) [m] of a camera's folder.

    Raises:
        InputError: a file is missing, or is not what it should be.
        NotRigidError: a matrix is not a rigid transform.
    """
    folder = Path(folder)
    first, relative = _read_npy(folder / FIRST), _read_npy(folder / POSES)
    if first.shape != (4, 4) or relative.ndim != 3 or relative.shape[1:] != (4, 4):
        raise InputError(
            f"{folder}: {FIRST} has the shape {first.shape} and {POSES} {relative.shape}; (4, 4) "
            "and (N, 4, 4) are needed."
        )
    if not 0 < len(relative) <= MOST_VIEWS:
        raise InputError(
            f"{folder / POSES} holds {len(relative)} poses; 1 to {MOST_VIEWS} are read."
        )
    first = se3.check_rigid(first, str(folder / FIRST))
    return first @ se3.check_rigid(relative, str(folder / POSES))


def _read_npy(path: Path) -> Array:
    """Return an array of numbers.

    Raises:
        InputError: no file there, or not one of numbers.
    """
    if not path.is_file():
        raise InputError(f"there is no {path}; a GraspNet camera folder holds {POSES} and {FIRST}.")
    try:
        # Mapped first: a header can claim any size, and pickles are refused.
        array: Any = np.load(path, mmap_mode="r", allow_pickle=False)
        return np.array(array, dtype=np.float64)
    except (ValueError, EOFError, TypeError, OSError) as error:
        raise InputError(f"{path} is not a numpy array of numbers ({error}).") from error
