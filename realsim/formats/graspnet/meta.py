"""meta/%04d.mat of GraspNet-1Billion: the objects of one image as graspnet-baseline reads them.

poses             (3, 4, N) object in the image's camera, as single precision [m]
cls_indexes       (1, N) object numbers + 1, the values of the label image
intrinsic_matrix  (3, 3) [px]
factor_depth      (1, 1) counts of the depth image per metre, 1000
"""

import io
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from realsim.arrays import Array
from realsim.errors import InputError, UnitError
from realsim.formats.graspnet.annotations import FARTHEST_M, LARGEST_NUMBER
from realsim.geometry import se3
from realsim.untrusted.mat_files import read_mat

META = "meta"
NAMES = ("poses", "cls_indexes", "intrinsic_matrix", "factor_depth")
LARGEST_MAT = 10e6
"""[bytes]: nine objects have 1 kB."""
FACTORS = (1.0, 1e6)
"""Least and most counts per metre: 1 m and 1 micrometre a count."""
HEADER = b"MATLAB 5.0 MAT-file Platform: posix, Created by: realsim".ljust(116)
"""What stands before the data; the library's own has the time of day, and the same scene should
give the same bytes."""


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Meta:
    """What a meta file says."""

    numbers: tuple[int, ...]
    """GraspNet's object numbers, from 0: cls_indexes - 1."""
    poses: Array
    """(N, 3, 4) as they stand there [m]."""
    Ts_cam_obj: Array
    """(N, 4, 4) the same, exactly rigid."""
    K: Array
    """(3, 3) [px]."""
    factor_depth: float
    """Counts per metre."""


def read_meta(path: Path) -> Meta:
    """Return what a meta file says.

    Raises:
        InputError: missing, damaged, without one of the four, or of counts that differ.
        NotRigidError: a pose that is no rigid transform.
        UnitError: the poses are in millimetres.
    """
    found = read_mat(path, NAMES, most_bytes=LARGEST_MAT)
    missing = [name for name in NAMES if name not in found]
    if missing:
        raise InputError(f"{path} has no {', '.join(missing)}; GraspNet's meta has all four.")
    numbers = _numbers(found["cls_indexes"], path)
    poses = _poses(found["poses"], len(numbers), path)
    K = _real(found["intrinsic_matrix"], f"intrinsic_matrix of {path}")
    if K.shape != (3, 3):
        raise InputError(f"intrinsic_matrix of {path} has the shape {K.shape}; (3, 3) is needed.")
    factor = _real(found["factor_depth"], f"factor_depth of {path}").ravel()
    if len(factor) != 1 or not FACTORS[0] <= factor[0] <= FACTORS[1]:
        raise InputError(
            f"factor_depth of {path} is {factor.tolist()[:4]}; one number of counts per metre, "
            f"{FACTORS[0]:g} to {FACTORS[1]:g}, is needed (GraspNet's is 1000)."
        )
    Ts = se3.from_rt(poses[..., :3], poses[..., 3])
    return Meta(
        numbers=numbers, poses=poses, K=K, factor_depth=float(factor[0]),
        Ts_cam_obj=se3.check_rigid(Ts, f"poses of {path}") if len(Ts) else Ts,
    )  # fmt: skip


def meta_bytes(numbers: Sequence[int], poses: Array, K: Array, factor_depth: float) -> bytes:
    """Return a meta file; the same values give the same bytes.

    Args:
        numbers: of the objects, from 0.
        poses: (N, 3, 4) objects in the camera [m]; single precision is kept (0.03 um at 0.5 m).
        K: (3, 3) [px].
        factor_depth: counts per metre.
    """
    from scipy.io import savemat

    content = {
        "poses": np.moveaxis(np.asarray(poses, np.float64), 0, -1).astype(np.float32),
        "cls_indexes": np.array(numbers, np.int64)[None] + 1,
        "intrinsic_matrix": np.asarray(K, np.float64),
        "factor_depth": np.array([[factor_depth]], np.float64),
    }
    buffer = io.BytesIO()
    savemat(buffer, content, do_compression=True)
    return HEADER + buffer.getvalue()[len(HEADER) :]


def _numbers(value: NDArray[Any], path: Path) -> tuple[int, ...]:
    indexes = _real(value, f"cls_indexes of {path}").ravel()
    low, high = 1, LARGEST_NUMBER + 1
    if np.any(indexes != np.rint(indexes)) or np.any((indexes < low) | (indexes > high)):
        raise InputError(
            f"cls_indexes of {path} are {indexes.tolist()[:12]}; object numbers + 1 are needed, "
            f"{low} to {high}."
        )
    return tuple(int(i) - 1 for i in indexes)


def _poses(value: NDArray[Any], count: int, path: Path) -> Array:
    """Return poses (N, 3, 4); MATLAB's files leave a last axis of one away."""
    poses = _real(value, f"poses of {path}")
    if poses.shape == (3, 4):
        poses = poses[..., None]
    if poses.size == 0 and count == 0:
        return np.zeros((0, 3, 4))
    if poses.shape != (3, 4, count):
        raise InputError(
            f"poses of {path} have the shape {np.shape(value)} and cls_indexes {count} objects; "
            f"(3, 4, {count}) is needed."
        )
    far = float(np.max(np.linalg.norm(poses[:, 3], axis=0)))
    if far > FARTHEST_M:
        raise UnitError(
            f"poses of {path} put an object {far:g} from the camera; they are in metres, and no "
            f"grasped object is farther than {FARTHEST_M:g} m. If they are in millimetres, divide "
            "the translations by 1000."
        )
    return np.ascontiguousarray(np.moveaxis(poses, -1, 0))


def _real(value: NDArray[Any], name: str) -> Array:
    """Return numbers in this machine's byte order.

    Raises:
        InputError: not real numbers, or not finite.
    """
    if value.dtype.kind not in "fiub":
        raise InputError(f"{name} has the type {value.dtype}; numbers are needed.")
    numbers = np.array(value, dtype=np.float64)
    if not np.all(np.isfinite(numbers)):
        raise InputError(f"{name} holds NaN or infinite numbers.")
    return numbers
