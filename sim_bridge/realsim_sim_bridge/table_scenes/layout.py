"""What a scene is made of: table, objects, sizes and poses, as it is kept in the scene's folder."""

from dataclasses import asdict, dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from realsim.errors import InputError

Array = NDArray[np.float64]
LAYOUT_FORMAT = 1


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class LaidObject:
    """An object of a pool that lies in a scene."""

    source: int
    """Number of the pool's source."""
    key: str
    """Which object of it."""
    name: str
    scale: float
    """Metres per unit of the mesh's numbers."""
    size_m: float
    """Its largest extent [m]."""
    T_table_obj: Array
    """(4, 4) [m]."""


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Layout:
    """A scene's table, and what came to rest on it."""

    number: int
    """Of the scene."""
    seed: int
    table: str
    """Kind of the table; its sizes follow from seed and number."""
    side_m: float
    """Longer side of the table [m]."""
    objects: tuple[LaidObject, ...]
    drawn: int
    """How many objects were wanted."""
    tried: int
    """How many were let go."""
    fell: tuple[str, ...] = ()
    """Names of those that left the table."""
    overhung: tuple[str, ...] = ()
    """Names of those that came to rest over the rim, and were taken off."""
    restless: tuple[str, ...] = ()
    """Names of those that did not come to rest, and were taken off."""
    skipped: tuple[str, ...] = ()
    """Meshes that could not be used, and why, a sentence each."""
    figures: dict[str, float] = field(default_factory=dict[str, float])
    """moved_mm and penetration_mm of the final state, simulated_s."""


def layout_to_json(layout: Layout) -> dict[str, Any]:
    """Return plain JSON values; poses come back bit for bit."""
    value = asdict(layout)
    value["objects"] = [o | {"T_table_obj": o["T_table_obj"].tolist()} for o in value["objects"]]
    return {"format": LAYOUT_FORMAT} | value


def layout_from_json(value: dict[str, Any], where: str) -> Layout:
    """Return a layout.

    Raises:
        InputError: it is of another format, or incomplete.
    """
    if value.get("format") != LAYOUT_FORMAT:
        raise InputError(
            f"{where} has the format {value.get('format')!r}; {LAYOUT_FORMAT} is known. Delete it: "
            "the scene is laid out again from its seed."
        )
    try:
        objects = tuple(
            LaidObject(**(row | {"T_table_obj": np.array(row["T_table_obj"], dtype=np.float64)}))
            for row in value["objects"]
        )
        rest = {k: v for k, v in value.items() if k not in ("format", "objects")}
        for name in ("fell", "overhung", "restless", "skipped"):
            rest[name] = tuple(rest[name])
        return Layout(objects=objects, **rest)
    except (KeyError, TypeError, ValueError) as error:
        raise InputError(
            f"{where} is damaged ({error}). Delete it: the scene is laid out again from its seed."
        ) from error
