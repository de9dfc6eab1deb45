"""Convex shapes fixed in a frame: what links, cameras, mounts and obstacles are made of.

The bodies of an arm's links: convex shapes fixed in the frames of the nominal links.

`link_placements` says where the links are on a chain with its controller's calibration. Two joint
axes that are parallel but for a milliradian have their common normal tens of metres away, and the
calibrated DH frames 2 and 3 sit there, turned by as much as they like, while the links themselves
are where they always were. So the links are placed from the nominal chain: link i's nominal frame
is moved rigidly with the calibrated frame i, from where both agree best.
"""

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Literal, cast

import numpy as np
from scipy.spatial import ConvexHull, QhullError

from realsim.arrays import Array
from realsim.errors import InputError, UnitError
from realsim.geometry import se3
from realsim.geometry.mesh_files import load_mesh
from realsim.records.checked_arrays import frozen, rigid
from realsim.robots.urdf import UrdfShape

if TYPE_CHECKING:
    from realsim.robots.arm import RobotArm


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


Axis = Literal["x", "y", "z"]
Rod = tuple[
    str, int, Literal["cylinder", "capsule"], Axis, float, float, float, tuple[float, float]
]
"""Part, DH frame, kind, axis, from and to along the axis, radius, the two other coordinates in
the order of the axes [mm]."""
Block = tuple[str, int, tuple[float, float, float], tuple[float, float, float]]
"""Part, DH frame, least and greatest corner [mm]."""
PLACEMENT_SAMPLES = 64
"""Joint vectors over which nominal and calibrated link frames are brought together."""
LARGEST_MM_SCALE = 0.02
"""A URDF whose meshes are in millimetres scales them by 0.001."""
BOX_REACH_M = 5.0
"""Infinite bounds of boxes end here: several times the reach of any arm."""
CALIBRATION_LIMIT_M = 0.020
"""A controller's calibration moves a link by 1-5 mm; another arm's calibration by 100 mm."""


def rod_shape(rod: Rod) -> Shape:
    """Return a round body."""
    part, frame, kind, axis, start, end, radius, across = rod
    k = "xyz".index(axis)
    center = np.insert(np.array(across, dtype=np.float64), k, (start + end) / 2)
    axes = np.roll(np.eye(3), k + 1, axis=0)  # its third column is the rod's axis
    return Shape(
        part=part,
        frame=frame,
        kind=kind,
        size_m=(radius / 1e3, (end - start) / 1e3),
        T_frame_shape=se3.from_rt(axes, center / 1e3),
    )


def block_shape(block: Block) -> Shape:
    """Return a box."""
    part, frame, low, high = block
    return _box_shape(part, frame, np.array(low) / 1e3, np.array(high) / 1e3)


def _box_shape(part: str, frame: int, lower: Array, upper: Array) -> Shape:
    return Shape(
        part=part,
        frame=frame,
        kind="box",
        size_m=tuple((upper - lower).tolist()),
        T_frame_shape=se3.from_translation((lower + upper) / 2),
    )


def link_shape(shape: UrdfShape, part: str, frame: int, T_frame_link: Array) -> Shape:
    """Return a URDF's shape as a convex body; a mesh becomes its convex hull.

    Raises:
        InputError: the mesh cannot be read, or is flat.
        UnitError: its size contradicts metres.
    """
    T = T_frame_link @ shape.T_link_shape
    if shape.file is None and shape.points is None:
        kind = cast(Kind, shape.kind)
        return Shape(part=part, frame=frame, kind=kind, size_m=shape.size_m, T_frame_shape=T)
    points = _mesh_points(shape.file, shape.size_m) if shape.points is None else shape.points
    try:
        corners = points[ConvexHull(points).vertices]
    except (QhullError, ValueError) as error:
        raise InputError(
            f"{shape.file or shape.link}, the shape of {part}, has no volume; a solid is needed."
        ) from error
    return Shape(part=part, frame=frame, kind="convex", size_m=(), T_frame_shape=T, points=corners)


def _mesh_points(file: Path | None, scale: tuple[float, ...]) -> Array:
    assert file is not None  # a shape of no kind is a mesh
    unit = "mm" if max(map(abs, scale)) < LARGEST_MM_SCALE else "m"
    try:
        mesh = load_mesh(file, unit, [])  # what it looks like does not matter
    except UnitError as error:
        raise UnitError(
            f"{file}, a mesh of a URDF with scale {scale}, would have an extent that no link has. "
            'A mesh in millimetres needs scale="0.001 0.001 0.001" in the URDF, one in metres '
            '"1 1 1".'
        ) from error
    return mesh.vertices * np.array(scale) * (1e3 if unit == "mm" else 1.0)


def link_placements(arm: "RobotArm") -> Array:
    """Return (n + 1, 4, 4): where link i's nominal frame is in the calibrated DH frame i [m].

    The identity for base and flange: what is fixed to the flange is placed by the calibrated
    chain exactly. In between the mean of `C_i(q)^-1 N_i(q)` over joint vectors q, which is the
    same for all q but for the calibration's millimetres.

    Raises:
        InputError: the calibration moves a link farther than any calibration does.
    """
    chain, n = arm.chain, arm.joints
    nominal = chain.nominal()
    placements = np.tile(np.eye(4), (n + 1, 1, 1))
    if np.array_equal(chain.link_frames(np.ones(n)), nominal.link_frames(np.ones(n))):
        return placements
    q = np.random.default_rng(0).uniform(-np.pi, np.pi, (PLACEMENT_SAMPLES, n))
    is_at, should = chain.link_frames(q), nominal.link_frames(q)
    for i in range(1, n + 1):
        between = se3.invert(is_at[:, i]) @ should[:, i]
        if i < n:
            R = se3.mean_rotation(between[:, :3, :3])
            # The rotations' scatter swings the far-away origin; the mean keeps what is common.
            off = (should - is_at)[:, i, :3, 3, None]
            at = np.mean(is_at[:, i, :3, :3].swapaxes(-1, -2) @ off, axis=0)
            placements[i] = se3.from_rt(R, at[:, 0])
        moved = is_at[:, i] @ placements[i]
        shift = float(np.linalg.norm(moved[:, :3, 3] - should[:, i, :3, 3], axis=-1).max())
        if shift > CALIBRATION_LIMIT_M:
            raise InputError(
                f"the calibration moves the {arm.link_names[i]} of a nominal {chain.name} by up to "
                f"{shift * 1e3:.0f} mm; an arm's own calibration moves it by 1 to 5 mm. Is the "
                "calibration file another arm's, or the model another?"
            )
    return placements


def finite_box(name: str, box: Box) -> Shape:
    """Return a box as a shape in base; bounds beyond `BOX_REACH_M` end there."""
    lower, upper = np.clip([box.lower, box.upper], -BOX_REACH_M, BOX_REACH_M)
    if np.any(upper <= lower):
        raise InputError(
            f"'{name}' from {box.lower} to {box.upper} m lies beyond {BOX_REACH_M} m of the arm's "
            "base. Boxes are in metres in the controller's base; were millimetres given?"
        )
    return _box_shape(name, 0, lower, upper)
