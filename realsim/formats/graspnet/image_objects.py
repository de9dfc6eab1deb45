"""The objects of one image: its annotation and its meta file, which say the same thing twice.

meta/%04d.mat of GraspNet-1Billion: the objects of one image as graspnet-baseline reads them.

poses             (3, 4, N) object in the image's camera, as single precision [m]
cls_indexes       (1, N) object numbers + 1, the values of the label image
intrinsic_matrix  (3, 3) [px]
factor_depth      (1, 1) counts of the depth image per metre, 1000
"""

import io
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from realsim.arrays import Array
from realsim.errors import InputError, UnitError
from realsim.formats.graspnet.annotations import (
    ANNOTATIONS,
    FARTHEST_M,
    LARGEST_NUMBER,
    AnnotatedObject,
    read_objects,
)
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


SAME_POSITION_M = 1.01e-4
"""Greatest difference along one axis: half of the fourth decimal for each of the two files, and
single precision."""
SAME_ROTATION_RAD = 4e-4
"""Half of the fourth decimal on four components is 2e-4 rad at most, for each of the two files."""


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class ImageObject:
    """One object of an image."""

    number: int
    """GraspNet's, from 0."""
    T_cam_obj: Array
    """(4, 4) [m]: of the meta file where there is one, which has seven digits, else of the XML."""
    xyzw_R_cam_obj: Array | None
    """(3, 3) the XML's rotation if its numbers were x y z w; None without XML."""
    entry: dict[str, Any]
    """What the files have, for a writer of the same format."""


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class ImageObjects:
    """What the two files of an image say."""

    objects: tuple[ImageObject, ...]
    """In the files' order."""
    meta: Meta | None
    has_annotation: bool


def read_image_objects(folder: Path, index: int) -> ImageObjects:
    """Return the objects of an image.

    Args:
        folder: of the camera.
        index: of the image.

    Raises:
        InputError: neither file is there, one is damaged, or the two contradict each other.
        UnitError: millimetres.
    """
    annotation = folder / ANNOTATIONS / f"{index:04d}.xml"
    meta = folder / META / f"{index:04d}.mat"
    seen = read_objects(annotation) if annotation.is_file() else None
    said = read_meta(meta) if meta.is_file() else None
    if seen is None and said is None:
        raise InputError(f"there is neither {annotation} nor {meta}: the poses are in there.")
    return ImageObjects(
        objects=joined_objects(seen, said, f"{annotation} and {meta}"),
        meta=said,
        has_annotation=seen is not None,
    )


def joined_objects(
    seen: tuple[AnnotatedObject, ...] | None, said: Meta | None, where: str
) -> tuple[ImageObject, ...]:
    """Return the objects of the annotation, with the poses of the meta file.

    Raises:
        InputError: the two do not have the same objects, or not the same poses.
    """
    if seen is None:
        numbers = () if said is None else said.numbers
        return tuple(_joined(n, None, said, k) for k, n in enumerate(numbers))
    if said is None:
        return tuple(_joined(o.number, o, None, 0) for o in seen)
    rows = _rows_in_meta([o.number for o in seen], list(said.numbers), where)
    for o, row in zip(seen, rows, strict=True):
        _require_same_pose(o, said.Ts_cam_obj[row], where)
    return tuple(_joined(o.number, o, said, row) for o, row in zip(seen, rows, strict=True))


def _joined(number: int, seen: AnnotatedObject | None, said: Meta | None, row: int) -> ImageObject:
    if said is not None:
        T = said.Ts_cam_obj[row]
    else:
        assert seen is not None
        T = seen.T_cam_obj
    entry = {
        "fields": None if seen is None else dict(seen.fields),
        "pose": None if said is None else said.poses[row].tolist(),
        "T_cam_obj": T.tolist(),
    }
    xyzw = None if seen is None else seen.xyzw_R_cam_obj
    return ImageObject(number=number, T_cam_obj=T, xyzw_R_cam_obj=xyzw, entry=entry)


def _rows_in_meta(seen: list[int], said: list[int], where: str) -> list[int]:
    """Return for each object of the annotation its row in the meta file."""
    if seen == said:
        return list(range(len(seen)))
    counts = Counter(seen)
    if counts != Counter(said) or max(counts.values(), default=1) > 1:
        raise InputError(
            f"{where} do not have the same objects: {seen} and {said} (cls_indexes - 1). Restore "
            "the file that is wrong, or take one of the two away."
        )
    return [said.index(n) for n in seen]


def _require_same_pose(seen: AnnotatedObject, T: Array, where: str) -> None:
    off = float(np.max(np.abs(seen.T_cam_obj[:3, 3] - T[:3, 3])))
    turn = float(se3.angle(seen.T_cam_obj[:3, :3].T @ T[:3, :3]))
    if off <= SAME_POSITION_M and turn <= SAME_ROTATION_RAD:
        return
    hint = ""
    if turn > SAME_ROTATION_RAD and (
        float(se3.angle(seen.xyzw_R_cam_obj.T @ T[:3, :3])) <= SAME_ROTATION_RAD
    ):
        hint = " Read as x y z w the quaternion agrees; the format's order is w x y z."
    raise InputError(
        f"{where} disagree about object {seen.number:03d} by {1e3 * off:.2f} mm and "
        f"{np.degrees(turn):.3f} deg; the four decimals of the XML explain "
        f"{1e3 * SAME_POSITION_M:.1f} mm and {np.degrees(SAME_ROTATION_RAD):.3f} deg. Restore the "
        f"file that is wrong, or take one of the two away.{hint}"
    )
