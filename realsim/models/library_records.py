"""What the model library keeps of a model, and how it stands in JSON.

Records become JSON objects with the names of their fields and come back by the types of their
fields, so that a file that does not fit is named with the field that is wrong.
"""

import dataclasses
import types
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cache
from typing import Any, Literal, TypeVar, Union, cast, get_args, get_origin, get_type_hints

import numpy as np
from numpy.typing import NDArray

from realsim.errors import InputError
from realsim.models.model_records import (
    ConvexParts,
    MeshReport,
    PhysicalProperties,
    ScanUnit,
    Symmetries,
)
from realsim.records import Mesh, ObjectModel, Verdict

Array = NDArray[np.float64]
T = TypeVar("T")
PROPERTIES_FORMAT = 1
"""Of the properties files; a newer one is refused, not guessed at."""


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


def to_json(value: Any) -> Any:
    """Return a record as plain JSON values."""
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        return {f.name: to_json(getattr(value, f.name)) for f in dataclasses.fields(value)}
    if isinstance(value, np.ndarray):
        return cast(Any, value).tolist()
    if isinstance(value, np.generic):
        return value.item()
    if isinstance(value, Mapping):
        items = cast("Mapping[Any, Any]", value)
        return {str(k): to_json(v) for k, v in items.items()}
    if isinstance(value, tuple | list):
        return [to_json(v) for v in cast("tuple[Any, ...]", value)]
    return value


def from_json(kind: type[T], value: Any, where: str) -> T:
    """Return the record of this kind from the values of `to_json`.

    Raises:
        InputError: a field is missing or does not fit; `where` and the field are named.
    """
    return cast(T, _value(kind, value, where))


@cache
def _hints(kind: type[Any]) -> dict[str, Any]:
    return get_type_hints(kind)


def _value(kind: Any, value: Any, where: str) -> Any:  # noqa: PLR0911 - one line per kind of type
    """Return a plain value as the type that is written at its field."""
    origin, args = get_origin(kind), get_args(kind)
    if kind is Any:
        return value
    if origin in (Union, types.UnionType):
        return None if value is None else _value(args[0], value, where)
    if origin is Literal:
        return _one_of(args, value, where)
    if origin is np.ndarray:
        return _numbers(value, where)
    if origin is tuple:
        return _tuple(args, value, where)
    if origin is dict:
        _require(isinstance(value, dict), value, where, "an object")
        return {k: _value(args[1], v, f"{where}.{k}") for k, v in value.items()}
    if dataclasses.is_dataclass(kind):
        return _record(cast("type[Any]", kind), value, where)
    if kind is float:
        _require(isinstance(value, int | float) and not isinstance(value, bool), value, where, kind)
        return float(value)
    _require(isinstance(value, kind), value, where, kind)
    return value


def _one_of(choices: tuple[Any, ...], value: Any, where: str) -> Any:
    _require(value in choices, value, where, f"one of {', '.join(map(str, choices))}")
    return value


def _numbers(value: Any, where: str) -> Array:
    try:
        return np.asarray(value, dtype=np.float64)
    except (TypeError, ValueError):
        raise _misfit(value, where, "numbers") from None


def _tuple(args: tuple[Any, ...], value: Any, where: str) -> tuple[Any, ...]:
    _require(isinstance(value, list), value, where, "a list")
    kinds = [args[0]] * len(value) if args[-1] is Ellipsis else list(args)
    _require(len(kinds) == len(value), value, where, f"{len(kinds)} entries")
    return tuple(_value(k, v, f"{where}[{i}]") for i, (k, v) in enumerate(zip(kinds, value)))  # noqa: B905


def _record(kind: type[Any], value: Any, where: str) -> Any:
    _require(isinstance(value, dict), value, where, "an object")
    given: dict[str, Any] = {}
    for f in dataclasses.fields(kind):
        if f.name in value:
            given[f.name] = _value(_hints(kind)[f.name], value[f.name], f"{where}.{f.name}")
        elif f.default is dataclasses.MISSING and f.default_factory is dataclasses.MISSING:
            raise InputError(f"{where} has no '{f.name}'. {_WHAT_TO_DO}")
    return kind(**given)


_WHAT_TO_DO = "Restore the file, or import the model again with --overwrite."


def _require(fits: bool, value: Any, where: str, expected: Any) -> None:
    if not fits:
        raise _misfit(value, where, expected)


def _misfit(value: Any, where: str, expected: Any) -> InputError:
    name = expected if isinstance(expected, str) else f"a {expected.__name__}"
    return InputError(f"{where} is {str(value)[:60]!r}; {name} is expected. {_WHAT_TO_DO}")
