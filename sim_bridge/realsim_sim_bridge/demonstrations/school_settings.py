"""The school's configuration out of the parameters that every grasp set carries."""

import types
from dataclasses import fields, is_dataclass, replace
from pathlib import Path
from typing import Any, Literal, TypeVar, Union, get_args, get_origin, get_type_hints

import numpy as np

from realsim.arrays import Array
from realsim.errors import InputError
from realsim.geometry.mesh import mass_properties
from realsim.models.convex import convex_parts
from realsim.models.model_records import KnownSolid
from realsim.records import GraspSet, Mesh, ObjectModel
from realsim.robots.hand import Hand, hand_of_json
from realsim_sim_bridge.school.config import SchoolConfig
from realsim_sim_bridge.slip.score import limits_of
from realsim_sim_bridge.slip.world import SlipBody

T = TypeVar("T")
_RENAMED = {"joint7_samples": "held_values"}
"""Fields of older files by what they are called now."""


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
        config = _read(SchoolConfig, stored)
        # What older files do not say of closing was not done as it is now.
        if "table_friction" not in stored["slip"].get("closing", {}):
            closing = replace(config.slip.closing, table_friction=None)
            config = replace(config, slip=replace(config.slip, closing=closing))
        return replace(config, score=limits_of(grasps.parameters))
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
    given: dict[str, Any] = {_RENAMED.get(str(k), str(k)): v for k, v in value.items()}  # pyright: ignore[reportUnknownVariableType, reportUnknownArgumentType]
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
        kind: Any = hint
        return hand_of_json(value, name) if kind is Hand else _read(hint, value)
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


# --- An object as the school's engine had it, checked against what the school wrote down ---------


SAME_POSE = 1e-6
"""Largest difference of a pose's numbers that is rounding of the files it came through."""
SAME_MATTER = 1e-6
"""Largest relative difference of mass and centre of mass, likewise."""


def tried_body(
    grasps: GraspSet,
    model: ObjectModel,
    T_table_obj: Array,
    config: SchoolConfig,
    solid: KnownSolid | None,
    cache: Path | None,
) -> SlipBody:
    """Return an object as the slip test had it.

    Args:
        grasps: its set, which says where it stood and what it weighed.
        model: its mesh and density.
        T_table_obj: (4, 4) where it stands [m].
        config: the school's.
        solid: convex parts and matter where a library knows them.
        cache: folder of the school's convex parts.

    Raises:
        InputError: it stands elsewhere or weighs something else than when it was tried.
    """
    stored = grasps.parameters
    named = f"'{model.name}' (instance {grasps.instance})"
    then = np.array((stored.get("inputs") or {}).get("T_table_obj", np.nan), dtype=np.float64)
    if then.shape != (4, 4) or not np.allclose(then, T_table_obj, rtol=0.0, atol=SAME_POSE):
        moved = ""
        if then.shape == (4, 4):
            moved = f" by {1e3 * float(np.linalg.norm((then - T_table_obj)[:3, 3])):.1f} mm"
        raise InputError(
            f"{named} does not stand where its grasps were tried: it has been moved{moved} since. "
            "Run `realsim school --restart` on the scene as it is."
        )
    mesh = Mesh(vertices=model.mesh.vertices, faces=model.mesh.faces)
    density = float(stored.get("density", model.density))
    matter = solid.matter if solid else mass_properties(mesh, density)
    center = np.array(stored.get("center_of_mass_m", [np.nan] * 3), dtype=np.float64)
    mass = float(stored.get("mass_kg", np.nan))
    same = abs(mass - matter.mass_kg) <= SAME_MATTER * matter.mass_kg and np.allclose(
        center, matter.center_of_mass, rtol=0.0, atol=SAME_MATTER
    )
    if not same:
        raise InputError(
            f"{named} weighs {matter.mass_kg:.4g} kg by its model and {mass:.4g} kg when its "
            "grasps were tried: the mesh, its density or a weighed mass (--weighed) is another "
            "one. Give what the school was given, or run it again."
        )
    parts = solid.parts if solid else convex_parts(mesh, config.convex, cache)
    return SlipBody.of(parts, matter)
