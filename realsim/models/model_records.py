"""What is known of a model besides its mesh: condition, symmetries, matter, convex parts."""

from dataclasses import dataclass, field
from typing import Literal

from realsim.arrays import Array
from realsim.records import Mesh

ScanUnit = Literal["m", "cm", "mm", "inch", "none"]
"""What one unit of a mesh file is; 'none': the file has no metric scale (a generated mesh)."""
METRES: dict[ScanUnit, float] = {"m": 1.0, "cm": 0.01, "mm": 0.001, "inch": 0.0254}
"""Length of each unit [m]."""
UpAxis = Literal["x", "y", "z", "-x", "-y", "-z"]
"""The axis of the file that points up when the object stands as its author drew it."""


@dataclass(frozen=True, kw_only=True, slots=True)
class Problem:
    """Something that is wrong with a mesh."""

    kind: str
    """'open', 'inside-out', 'non-manifold', 'several bodies', 'degenerate faces', ..."""
    count: int
    """How many edges, faces, bodies, ... are concerned."""
    text: str
    """One sentence for a person: what it is, and what it means for the work."""


@dataclass(frozen=True, kw_only=True, slots=True)
class MeshReport:
    """The condition of a mesh."""

    vertices: int
    """Positions after equal ones are merged."""
    faces: int
    bodies: int
    """Connected pieces of surface."""
    is_watertight: bool
    """Every edge is shared by two faces that run along it in opposite directions."""
    is_outward: bool
    """Normals point out of the solid (of every body, where there are several)."""
    boundary_edges: int
    """Edges with one face: rims of holes."""
    problems: tuple[Problem, ...] = ()
    """Empty: nothing is wrong."""


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Repair:
    """A mesh before and after its repair."""

    mesh: Mesh
    """The repaired mesh; colours and texture kept."""
    before: MeshReport
    after: MeshReport
    actions: tuple[str, ...] = ()
    """What was done, one sentence each; empty: nothing."""


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class ReadScan:
    """A mesh as it lies in a file, with what the file says about it."""

    mesh: Mesh
    """In metres; in the file's own units where `unit` is 'none'. Turned so that z is up."""
    unit: ScanUnit
    factor: float
    """What the file's numbers were multiplied by."""
    R_up: Array
    """(3, 3) by which the file's axes were turned: v = factor * R_up @ v_file."""
    sha256: str
    """SHA-256 of the file."""
    declared: dict[str, str] = field(default_factory=dict[str, str])
    """What the file itself states: format, unit, up axis, generator, ..."""
    notes: tuple[str, ...] = ()
    """What a user should know: mirrored node, ignored second texture, ..."""


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Symmetries:
    """The symmetries of a shape, as BOP's models_info wants them."""

    discrete: Array
    """(S, 4, 4) rigid motions T_obj_obj that map the surface onto itself, the identity first."""
    axes: tuple[tuple[tuple[float, float, float], tuple[float, float, float]], ...] = ()
    """Continuous symmetries: (unit axis, point on it [m])."""
    worst_m: float = 0.0
    """Greatest distance by which any of them misses the surface [m]."""
    near: tuple[str, ...] = ()
    """Motions that are nearly symmetries but were refused, with their deviation, for a person."""
    texture_breaks: bool = False
    """Whether the colours or the texture differ under a symmetry of the shape."""
    is_mirror_symmetric: bool = False
    """Whether the shape equals its mirror image: then a mirrored mesh cannot be told from it."""


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class PhysicalProperties:
    """Size and matter of an object."""

    extent_m: Array
    """(3,) size of the box along the object's axes [m]."""
    diameter_m: float
    """Greatest distance of two vertices [m]."""
    centroid: Array
    """(3,) centre of the surface's area [m]."""
    volume_m3: float
    """Volume of the solid, see `volume_of` [m^3]."""
    volume_of: Literal["mesh", "convex parts", "hull"]
    """What the volume, the centre of mass and the inertia are of: an open mesh has none itself."""
    hull_volume_fraction: float
    """Volume / volume of the convex hull."""
    density: float
    """[kg/m^3]."""
    mass_kg: float
    """[kg]."""
    mass_from: Literal["density", "weighed"]
    center_of_mass: Array
    """(3,) [m]."""
    inertia: Array
    """(3, 3) about the centre of mass, along the object's axes [kg m^2]."""


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class ConvexParts:
    """Convex parts and how well they fill the mesh."""

    parts: tuple[Array, ...]
    """Vertices (V, 3) of each part [m]."""
    volume_ratio: float
    """Volume of the parts / volume of the mesh: 1.33 is a third too fat. Where the mesh is not
    closed its hull's volume stands below the line."""
    method: str
    """'hull', 'coacd', or 'hull (out of time)'."""
    seconds: float = 0.0
    """CPU time of the decomposition [s]."""
    notes: tuple[str, ...] = ()
    """Why the parts are worse than wished, where they are."""
