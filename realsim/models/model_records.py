"""What is known of a model besides its mesh: condition, symmetries, matter, convex parts.

What the model library keeps of a model; in JSON by `realsim.untrusted.own_json`.
"""

from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np

from realsim.arrays import Array
from realsim.errors import InputError
from realsim.records import Mesh, ObjectModel, Verdict

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


PROPERTIES_FORMAT = 1
"""Version of the properties files; a newer one is refused, not guessed at."""


@dataclass(frozen=True, kw_only=True, slots=True)
class ScaleNote:
    """How large a mesh without metric scale is, who says so, and how sure that is."""

    scale: float
    """Metres per unit of the mesh."""
    sigma_percent: float | None = None
    """1-sigma of the scale [% of it]; None = not known."""
    verdict: Verdict = "unchecked"
    reasons: tuple[str, ...] = ()
    """Why the verdict is not 'accepted'."""
    session: str = ""
    """Name of the capture session that it comes from; empty = of none."""
    how: str = ""
    """'fit', 'measured edge', ...: what the scale was found by."""

    def __post_init__(self) -> None:
        """Check that the scale is a length and its sigma no nonsense."""
        if not (np.isfinite(self.scale) and self.scale > 0):
            raise InputError(f"the scale is {self.scale} m per unit; a positive number is needed.")
        sigma = self.sigma_percent
        if sigma is not None and not (np.isfinite(sigma) and sigma >= 0):
            raise InputError(
                f"the scale's sigma is {sigma} %; a number of 0 or more is needed, or None where "
                "it is not known."
            )


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class ScanSource:
    """The file a model was made of."""

    file: str
    """Its name, without the folder."""
    sha256: str
    unit: ScanUnit
    factor: float
    """What its numbers were multiplied by."""
    R_up: Array
    """(3, 3) by which its axes were turned: v = factor * R_up @ v_file."""
    declared: dict[str, str] = field(default_factory=dict[str, str])
    """What the file itself states."""
    notes: tuple[str, ...] = ()


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class ConvexNote:
    """What is known of a model's convex parts; their vertices are in collision/."""

    parts: int
    volume_ratio: float
    """Volume of the parts / volume of the mesh."""
    method: str
    notes: tuple[str, ...] = ()


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class ModelProperties:
    """Everything that is known of a model besides its mesh: properties/obj_%06d.json."""

    name: str
    verdict: Verdict
    """'accepted': everything is as it should be; 'doubtful': a person should look."""
    reasons: tuple[str, ...] = ()
    """Why the verdict is not 'accepted', one sentence each."""
    obj_id: int | None = None
    """BOP id; None where the model has no metric scale yet."""
    source: ScanSource | None = None
    before: MeshReport | None = None
    """The mesh as it came."""
    after: MeshReport | None = None
    """The mesh as it is kept."""
    actions: tuple[str, ...] = ()
    """What was repaired or made coarser, one sentence each."""
    symmetries: Symmetries | None = None
    matter: PhysicalProperties | None = None
    convex: ConvexNote | None = None
    scale: ScaleNote | None = None
    """None: the unit of the file is the scale."""
    notes: tuple[str, ...] = ()
    """What a user should know and need not act on."""
    files: dict[str, str] = field(default_factory=dict[str, str])
    """sha256 of the model's files, by their path in the library: what the properties are of."""
    versions: dict[str, str] = field(default_factory=dict[str, str])
    config: dict[str, Any] = field(default_factory=dict[str, Any])
    """The settings that everything was computed with."""


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class LibraryModel:
    """A model as the stages need it."""

    model: ObjectModel
    parts: ConvexParts | None
    """None: no convex parts are kept, or not of this mesh."""
    properties: ModelProperties | None
    """None: a models folder of another program has none."""
    notes: tuple[str, ...] = ()
    """What of the model is missing or damaged, and what to do about it."""

    @property
    def scale(self) -> ScaleNote | None:
        """How the metric scale was found; None: the unit of the file is the scale."""
        return None if self.properties is None else self.properties.scale


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class KnownSolid:
    """What a physics engine needs of a model, as the library knows it."""

    parts: ConvexParts
    matter: PhysicalProperties


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class UnscaledModel:
    """A model without metric scale."""

    name: str
    mesh: Mesh
    """In the file's own units, z up."""
    properties: ModelProperties
