"""What a calibration is made of: the target's points found in an image, and the robot's pose."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from realsim.arrays import Array, Int64
from realsim.errors import InputError
from realsim.records import Target
from realsim_calibration.inputs.readings import PoseReading


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class TargetDetection:
    """The points of a target that were found in one image; integer pixels are pixel centres."""

    point_ids: Int64
    """(n,) rows of `target.points_board`, ascending."""
    uv: Array
    """(n, 2) where they are in the image [px]."""
    image_size: tuple[int, int]
    """Width and height of the image [px]."""
    sd_px: Array | None = None
    """(n,) predicted 1-sigma of a coordinate [px]; None = not predicted."""
    rejected: tuple[str, ...] = ()
    """What was seen and not used, with the reason."""

    def __post_init__(self) -> None:
        """Sort by point, check shapes, freeze."""
        ids = np.array(self.point_ids, dtype=np.int64).ravel()
        uv = np.array(self.uv, dtype=np.float64).reshape(-1, 2)
        if len(ids) != len(uv):
            raise InputError(f"target detection: {len(ids)} point numbers for {len(uv)} points.")
        if len(set(ids.tolist())) != len(ids):
            raise InputError("target detection: a point occurs twice in one image.")
        if not np.all(np.isfinite(uv)):
            raise InputError("target detection: a point is not a finite number.")
        order = np.argsort(ids)
        for name, value in (("point_ids", ids[order]), ("uv", uv[order])):
            value.setflags(write=False)
            object.__setattr__(self, name, value)
        if self.sd_px is not None:
            sd = np.array(self.sd_px, dtype=np.float64).ravel()
            if len(sd) != len(ids):
                raise InputError(f"target detection: {len(sd)} sigmas for {len(ids)} points.")
            sd = sd[order]
            sd.setflags(write=False)
            object.__setattr__(self, "sd_px", sd)

    def __len__(self) -> int:
        """Return the number of points."""
        return len(self.point_ids)

    def points(self, target: Target) -> Array:
        """Return the points (n, 3) in the board frame [m].

        Raises:
            InputError: a point is not on the target.
        """
        known = target.points_board
        if len(self) and (self.point_ids[0] < 0 or self.point_ids[-1] >= len(known)):
            raise InputError(
                f"point {int(self.point_ids[-1])} is not on the target, which has {len(known)}."
            )
        return known[self.point_ids]


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class BoardView:
    """One view of the target and where the controller says the hand was."""

    index: int
    T_base_ee: Array
    """(4, 4) the controller's tool pose in its base [m]."""
    detection: TargetDetection
    name: str = ""
    """File name of the image, for messages; the index where it is empty."""
    joints: Array | None = None
    """(n,) joint angles [rad]; None where they are not known."""

    def __post_init__(self) -> None:
        """Check that the pose is rigid and freeze it."""
        T = measured_poses(self.T_base_ee, [f"T_base_ee of view {self.label}"])[0]
        T.setflags(write=False)
        object.__setattr__(self, "T_base_ee", T)

    @property
    def label(self) -> str:
        """The name, or the index where there is none."""
        return self.name or str(self.index)


def target_middle(target: Target) -> Array:
    """Return the middle (3,) of a target's points [m]."""
    points = target.points_board
    return (points.min(0) + points.max(0)) / 2


def measured_poses(Ts: ArrayLike, names: Sequence[str]) -> Array:
    """Return poses (n, 4, 4) as controllers and detectors print them, made exactly rigid.

    Rotations may be rounded to three decimals, as in pose files; the nearest rotation is taken.

    Args:
        Ts: (n, 4, 4) poses, or one (4, 4) [m].
        names: what each is called in the error.

    Raises:
        InputError: another shape, or numbers that are not finite.
        NotRigidError: mirrored, scaled, or no rotation at all.
    """
    T = np.asarray(Ts, dtype=np.float64)
    if T.shape not in ((4, 4), (len(names), 4, 4)):
        raise InputError(f"{names[0] if names else 'the poses'}: shape {T.shape}, not (4, 4) each.")
    return PoseReading(rotation="matrix").apply(T.reshape(-1, 16), rows=names, reach_m=np.inf)


def detection_of(
    target: Target, uv: ArrayLike, image_size: tuple[int, int], point_ids: ArrayLike | None = None
) -> TargetDetection:
    """Return a detection of all points of a target, or of those named."""
    ids = np.arange(len(target.points_board)) if point_ids is None else np.asarray(point_ids)
    return TargetDetection(
        point_ids=ids, uv=np.asarray(uv, dtype=np.float64), image_size=image_size
    )
