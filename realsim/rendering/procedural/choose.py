"""Any material at random, or of one kind, or of a kind that suits a table, an object, a floor."""

from collections.abc import Callable

import numpy as np

from realsim.errors import InputError
from realsim.rendering.appearance import Material
from realsim.rendering.procedural import cloths, metals, plastics, stones, tiles, woods

MAKERS: dict[str, Callable[[np.random.Generator], Material]] = {
    "oak": woods.oak,
    "walnut": woods.walnut,
    "birch": woods.birch,
    "pine": woods.pine,
    "laminate": woods.laminate,
    "painted wood": woods.painted_wood,
    "marble": stones.marble,
    "granite": stones.granite,
    "concrete": stones.concrete,
    "terrazzo": stones.terrazzo,
    "brushed steel": metals.brushed_steel,
    "aluminium": metals.aluminium,
    "galvanised steel": metals.galvanised_steel,
    "rusty metal": metals.rusty_metal,
    "painted metal": metals.painted_metal,
    "optical table": metals.optical_table,
    "glossy plastic": plastics.glossy_plastic,
    "matte plastic": plastics.matte_plastic,
    "printed plastic": plastics.printed_plastic,
    "rubber": plastics.rubber,
    "carbon": plastics.carbon,
    "cutting mat": plastics.cutting_mat,
    "ceramic tiles": tiles.ceramic_tiles,
    "woven fabric": cloths.woven_fabric,
    "checked cloth": cloths.checked_cloth,
    "leather": cloths.leather,
    "cork": cloths.cork,
    "cardboard": cloths.cardboard,
    "carpet": cloths.carpet,
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
        kind = KINDS[int(rng.integers(len(KINDS)))]
    if kind not in MAKERS:
        raise InputError(f"there is no material '{kind}'; {', '.join(KINDS)} can be made.")
    return MAKERS[kind](rng)


def table_material(rng: np.random.Generator) -> Material:
    """Return a material for the top of a table."""
    return random_material(rng, TABLE_KINDS[int(rng.integers(len(TABLE_KINDS)))])


def object_material(rng: np.random.Generator) -> Material:
    """Return a material for an object on the table."""
    return random_material(rng, OBJECT_KINDS[int(rng.integers(len(OBJECT_KINDS)))])


def floor_material(rng: np.random.Generator) -> Material:
    """Return a material for the floor, its tile at least 0.8 m."""
    from dataclasses import replace

    material = random_material(rng, FLOOR_KINDS[int(rng.integers(len(FLOOR_KINDS)))])
    return replace(material, period_m=max(material.period_m, LEAST_FLOOR_PERIOD_M))
