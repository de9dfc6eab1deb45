"""What the model library keeps of a model; in JSON by `realsim.untrusted.own_json`."""

from dataclasses import dataclass, field
from typing import Any

import numpy as np

from realsim.arrays import Array
from realsim.errors import InputError
from realsim.models import model_records
from realsim.records import Mesh, ObjectModel, Verdict

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
    unit: model_records.ScanUnit
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
    before: model_records.MeshReport | None = None
    """The mesh as it came."""
    after: model_records.MeshReport | None = None
    """The mesh as it is kept."""
    actions: tuple[str, ...] = ()
    """What was repaired or made coarser, one sentence each."""
    symmetries: model_records.Symmetries | None = None
    matter: model_records.PhysicalProperties | None = None
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
    parts: model_records.ConvexParts | None
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

    parts: model_records.ConvexParts
    matter: model_records.PhysicalProperties


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class UnscaledModel:
    """A model without metric scale."""

    name: str
    mesh: Mesh
    """In the file's own units, z up."""
    properties: ModelProperties
