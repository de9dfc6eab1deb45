"""Anything at random: a material of one kind or for one purpose, a sky outside, a room inside."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from realsim.errors import InputError
from realsim.rendering.appearance import Environment, Material
from realsim.rendering.procedural import fabrics, minerals, woods
from realsim.rendering.procedural.rooms import room
from realsim.rendering.procedural.skies import balanced, exposed, overcast_sky, sunny_sky

MAKERS: dict[str, Callable[[np.random.Generator], Material]] = {
    "oak": woods.boards("oak"),
    "walnut": woods.boards("walnut"),
    "birch": woods.boards("birch"),
    "pine": woods.boards("pine"),
    "laminate": woods.laminate,
    "painted wood": woods.painted_wood,
    "marble": minerals.marble,
    "granite": minerals.granite,
    "concrete": minerals.concrete,
    "terrazzo": minerals.terrazzo,
    "brushed steel": minerals.brushed_steel,
    "aluminium": minerals.aluminium,
    "galvanised steel": minerals.galvanised_steel,
    "rusty metal": minerals.rusty_metal,
    "painted metal": minerals.painted_metal,
    "optical table": minerals.optical_table,
    "glossy plastic": fabrics.glossy_plastic,
    "matte plastic": fabrics.matte_plastic,
    "printed plastic": fabrics.printed_plastic,
    "rubber": fabrics.rubber,
    "carbon": fabrics.carbon,
    "cutting mat": fabrics.cutting_mat,
    "ceramic tiles": minerals.ceramic_tiles,
    "woven fabric": fabrics.woven_fabric,
    "checked cloth": fabrics.checked_cloth,
    "leather": fabrics.leather,
    "cork": fabrics.cork,
    "cardboard": fabrics.cardboard,
    "carpet": fabrics.carpet,
}
KINDS: tuple[str, ...] = tuple(MAKERS)
"""Every kind of material that can be asked for."""
TABLE_KINDS: tuple[str, ...] = (
    "oak", "walnut", "birch", "pine", "laminate", "painted wood", "marble", "granite", "concrete",
    "terrazzo", "brushed steel", "aluminium", "optical table", "matte plastic", "cutting mat",
    "ceramic tiles", "woven fabric", "checked cloth", "cork", "cardboard", "rubber",
)  # fmt: skip
"""What table tops are made of or covered with."""
OBJECT_KINDS: tuple[str, ...] = (
    "glossy plastic", "matte plastic", "printed plastic", "painted metal", "brushed steel",
    "aluminium", "galvanised steel", "rusty metal", "oak", "birch", "walnut", "painted wood",
    "leather", "cork", "cardboard", "rubber", "carbon", "woven fabric", "marble", "granite",
)  # fmt: skip
"""What things are made of."""
FLOOR_KINDS: tuple[str, ...] = (
    "oak", "pine", "walnut", "concrete", "terrazzo", "ceramic tiles", "carpet", "laminate",
    "marble",
)  # fmt: skip
"""What is under a table."""
LEAST_FLOOR_PERIOD_M = 0.8
"""Floors are seen from afar: smaller tiles would show as a grid [m]."""


def random_material(rng: np.random.Generator, kind: str | None = None) -> Material:
    """Return a procedural material; its images tile without a seam.

    Args:
        rng: decides on everything; the same state gives the same bytes.
        kind: one of `KINDS`; None = any.

    Raises:
        InputError: no such kind.
    """
    if kind is None:
        return _one_of(KINDS, rng)
    if kind not in MAKERS:
        raise InputError(f"there is no material '{kind}'; {', '.join(KINDS)} can be made.")
    return MAKERS[kind](rng)


def table_material(rng: np.random.Generator) -> Material:
    """Return a material for the top of a table."""
    return _one_of(TABLE_KINDS, rng)


def object_material(rng: np.random.Generator) -> Material:
    """Return a material for an object on the table."""
    return _one_of(OBJECT_KINDS, rng)


def floor_material(rng: np.random.Generator) -> Material:
    """Return a material for the floor, its tile at least 0.8 m."""
    material = _one_of(FLOOR_KINDS, rng)
    return replace(material, period_m=max(material.period_m, LEAST_FLOOR_PERIOD_M))


def _one_of(kinds: tuple[str, ...], rng: np.random.Generator) -> Material:
    return random_material(rng, kinds[int(rng.integers(len(kinds)))])


def random_environment(rng: np.random.Generator) -> Environment:
    """Return a clear, clouded or overcast sky, a golden hour, or a room.

    Rooms are drawn half of the time, because robots stand in them. White is balanced by most of
    the way, as cameras do, and the exposure shows a grey card that lies flat as mid-grey.

    Args:
        rng: decides on everything; the same state gives the same bytes.
    """
    kind = rng.random()
    if kind < 0.5:
        made = room(rng)
    elif kind < 0.65:
        made = overcast_sky(rng)
    elif kind < 0.8:
        made = sunny_sky(rng, rng.uniform(3.0, 12.0), rng.uniform(2.2, 5.0),
                         float(rng.choice([0.0, rng.uniform(0.1, 0.4)])))  # fmt: skip
    else:
        made = sunny_sky(rng, rng.uniform(15.0, 70.0), rng.uniform(2.2, 6.0),
                         float(rng.choice([0.0, rng.uniform(0.15, 0.7)])))  # fmt: skip
    return exposed(balanced(made, float(rng.uniform(0.5, 0.95))))
