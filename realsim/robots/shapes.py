"""Convex shapes fixed in a frame: what links, cameras, mounts and obstacles are made of."""

from dataclasses import dataclass
from typing import Literal

import numpy as np

from realsim.arrays import Array
from realsim.errors import InputError
from realsim.records.checked_arrays import frozen, rigid

Kind = Literal["box", "capsule", "cylinder", "sphere", "convex"]
SIZES = {"box": 3, "capsule": 2, "cylinder": 2, "sphere": 1, "convex": 0}
"""How many lengths each kind has: box x y z; capsule and cylinder radius and length (of the
capsule's axis segment, without its caps) along z; sphere radius."""


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Shape:
    """One convex shape."""

    part: str
    """What it is, for messages: 'forearm', 'camera', 'bracket'."""
    frame: int
    """The DH frame that it is fixed in: 0 = base, i = frame i, 6 = the flange."""
    kind: Kind
    size_m: tuple[float, ...]
    """Lengths of the kind [m], see `SIZES`."""
    T_frame_shape: Array
    """(4, 4) the shape's own frame (its centre; z is a capsule's axis) in the DH frame [m]."""
    points: Array | None = None
    """(P, 3) corners [m] in the shape's own frame, of a 'convex' shape only."""

    def __post_init__(self) -> None:
        """Check kind, sizes and pose."""
        if self.kind not in SIZES:
            raise InputError(
                f"shape '{self.part}' is a '{self.kind}'; there are {', '.join(SIZES)}."
            )
        size = tuple(float(s) for s in self.size_m)
        if len(size) != SIZES[self.kind] or not all(np.isfinite(s) and s > 0 for s in size):
            raise InputError(
                f"shape '{self.part}', a {self.kind}, has the lengths {size}; "
                f"{SIZES[self.kind]} positive lengths [m] are needed."
            )
        object.__setattr__(self, "size_m", size)
        T = rigid(self.T_frame_shape, f"the pose of shape '{self.part}'")
        object.__setattr__(self, "T_frame_shape", T)
        if (self.kind == "convex") != (self.points is not None):
            raise InputError(f"shape '{self.part}': corners belong to 'convex' shapes, only there.")
        if self.points is not None:
            points = frozen(self.points, np.float64, (None, 3), f"corners of shape '{self.part}'")
            if len(points) < 4:
                raise InputError(f"shape '{self.part}' has {len(points)} corners; 4 are needed.")
            object.__setattr__(self, "points", points)


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Box:
    """An axis-aligned box in base; infinite bounds make it a half-space."""

    lower: tuple[float, float, float]
    """Least corner [m]."""
    upper: tuple[float, float, float]
    """Greatest corner [m]."""

    def __post_init__(self) -> None:
        """Check the order of the corners."""
        if not all(a < b for a, b in zip(self.lower, self.upper, strict=True)):
            raise InputError(f"a box from {self.lower} to {self.upper} m has no volume.")


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class WorkCell:
    """What stands round the arm, in base: the arm keeps its clearance to all of it."""

    table: Box
    """The table's volume, its top the upper z."""
    keep_out: Box
    """The volume that only the objects (or the board) may fill."""
    obstacles: tuple[tuple[str, Box], ...] = ()
    """Named boxes: walls, a lamp, a second table."""


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Mount:
    """A camera on the flange: where it looks from, and what it and its bracket fill."""

    name: str
    camera: str
    """Key of `mount.CAMERA_BODIES`."""
    T_ee_cam: Array
    """(4, 4) nominal camera frame (colour image) in the flange [m]."""
    bracket: tuple[Shape, ...]
    """Shapes between flange and camera, in frame 6; the camera's body is added by the model."""
    cover_m: float = 0.0
    """Added round camera and bracket [m]: cable, screws."""

    def __post_init__(self) -> None:
        """Check the pose and that the bracket moves with the flange."""
        T = rigid(self.T_ee_cam, f"mount '{self.name}': T_ee_cam")
        object.__setattr__(self, "T_ee_cam", T)
        if wrong := [s.part for s in self.bracket if s.frame != 6]:
            raise InputError(f"mount '{self.name}': {wrong} are not fixed in the flange (frame 6).")
