"""The school's configuration out of the parameters that every grasp set carries."""

import types
from dataclasses import fields, is_dataclass
from typing import Any, Literal, TypeVar, Union, get_args, get_origin, get_type_hints

from realsim.errors import InputError
from realsim.records import GraspSet
from realsim_sim_bridge.school.config import SchoolConfig

T = TypeVar("T")


def school_config_of(grasps: GraspSet) -> SchoolConfig:
    """Return the configuration that a grasp set was made with.

    Raises:
        InputError: the set's parameters do not hold one that this version knows.
    """
    stored: Any = grasps.parameters.get("config")
    try:
        missing = [n for n in ("slip", "score", "hand", "reach") if n not in (stored or {})]
        if missing:
            raise TypeError(f"{missing[0]} is not there")
        return _read(SchoolConfig, stored)
    except (TypeError, ValueError, InputError) as error:
        raise InputError(
            f"the grasps of instance {grasps.instance} do not say what they were tried with "
            f"({error}), so that no attempt can be replayed. They come from another program or "
            "another version; run `realsim school` again."
        ) from error


def _read(kind: type[T], value: Any) -> T:
    """Return a dataclass out of what `asdict` and JSON made of it.

    A field that is not there takes its default: versions add fields whose defaults are what was
    done before, and a replay is compared with what is stored in any case.

    Raises:
        TypeError: a field is unknown, missing without a default, or of another kind.
    """
    if not isinstance(value, dict):
        raise TypeError(f"{kind.__name__} is {type(value).__name__}")
    given: dict[str, Any] = {str(k): v for k, v in value.items()}  # pyright: ignore[reportUnknownVariableType, reportUnknownArgumentType]
    hints = get_type_hints(kind)
    names = [f.name for f in fields(kind)]  # pyright: ignore[reportArgumentType]
    unknown = sorted(set(given) - set(names))
    if unknown:
        raise TypeError(f"{kind.__name__} has {', '.join(unknown)}, which is not known")
    return kind(**{n: _value(hints[n], given[n], n) for n in names if n in given})


def _value(hint: Any, value: Any, name: str) -> Any:
    """Return a field's value in its own type."""
    if get_origin(hint) in (Union, types.UnionType):
        return _one_of(get_args(hint), value, name)
    if is_dataclass(hint) and isinstance(hint, type):
        return _read(hint, value)
    if get_origin(hint) is Literal:
        if value not in get_args(hint):
            raise TypeError(f"{name} is {value!r}")
        return value
    if get_origin(hint) is tuple:
        if not isinstance(value, list):
            raise TypeError(f"{name} is no list")
        return _tuples(value)
    if hint is float and isinstance(value, int | float) and not isinstance(value, bool):
        return float(value)
    if isinstance(hint, type) and type(value) is hint:
        return value
    raise TypeError(f"{name} is {type(value).__name__}")


def _one_of(kinds: tuple[Any, ...], value: Any, name: str) -> Any:
    """Return a value of the first of several types that takes it."""
    if value is None and type(None) in kinds:
        return None
    refused: list[str] = []
    for kind in kinds:
        try:
            return _value(kind, value, name)
        except TypeError as error:
            refused.append(str(error))
    raise TypeError("; ".join(refused))


def _tuples(value: Any) -> Any:
    """Return nested lists as nested tuples."""
    return tuple(_tuples(v) for v in value) if isinstance(value, list) else value  # pyright: ignore[reportUnknownVariableType]
