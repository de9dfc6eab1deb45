"""Anything at random: a material of one kind or for one purpose, a sky outside, a room inside.

Wood cut from trunks: growth rings, pores and boards; and what imitates it or hides it.

A board is a flat cut near the axis of a trunk, so its growth rings are hyperbola-like arches
("cathedrals") in the middle and straight lines at the sides. The grain runs along u.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from realsim.arrays import Array32, Int64
from realsim.errors import InputError
from realsim.rendering.appearance import Environment, Material
from realsim.rendering.procedural import fabrics, minerals, noise
from realsim.rendering.procedural.rooms import room
from realsim.rendering.procedural.skies import balanced, exposed, overcast_sky, sunny_sky

WOOD_PX = 1024
"""Side of wooden tiles [px]: 0.6 mm a texel, about a pixel of a view from a metre."""
LAMINATE_PX = 512


@dataclass(frozen=True, kw_only=True, slots=True)
class Timber:
    """What tells one kind of wood from another."""

    name: str
    early: noise.Tint
    """sRGB of the light wood of spring."""
    late: noise.Tint
    """sRGB of the dark line that ends the year."""
    rings_per_m: float
    """Growth rings across a board."""
    contrast: float
    """How much darker the late wood is [0, 1]."""
    pores: float
    """Share of the early wood that is open pores [0, 1]."""
    pore_m: float
    """Length of a pore along the grain [m]."""


TIMBERS = {t.name: t for t in (
    Timber(name="oak", early=(205, 167, 118), late=(148, 106, 64), rings_per_m=210,
           contrast=0.62, pores=0.30, pore_m=0.016),
    Timber(name="walnut", early=(126, 90, 62), late=(66, 43, 29), rings_per_m=150,
           contrast=0.75, pores=0.18, pore_m=0.012),
    Timber(name="birch", early=(231, 205, 165), late=(204, 168, 120), rings_per_m=130,
           contrast=0.55, pores=0.05, pore_m=0.006),
    Timber(name="pine", early=(232, 197, 138), late=(188, 124, 62), rings_per_m=170,
           contrast=0.8, pores=0.0, pore_m=0.006),
)}  # fmt: skip


def boards(name: str) -> Callable[[np.random.Generator], Material]:
    """Return the maker of boards of a timber, each from its own trunk, glued side by side."""
    return lambda rng: _boards(rng, TIMBERS[name])


def _boards(rng: np.random.Generator, timber: Timber) -> Material:
    n = WOOD_PX
    period_m = float(rng.uniform(0.45, 0.75))
    count = int(rng.integers(3, 7))
    u, v = noise.grid(n)
    board, across = _board_of(rng, v, count)
    rings = _rings(rng, u, across, board, count, timber.rings_per_m * period_m)
    year = rings - np.floor(rings)
    # Spring wood darkens slowly; the year ends at once.
    line = (year**2.2 * noise.step(1.0 - year, 0.0, 0.12)).astype(np.float32)
    fibre = noise.smooth(rng, n, 7.0, 260.0)
    tone = timber.contrast * line + 0.07 * fibre + 0.09 * noise.smooth(rng, n, 2.0, 30.0)
    color = noise.mixed(timber.early, timber.late, (0.08 + tone).astype(np.float32))

    pore = np.zeros((n, n), np.float32)
    if timber.pores > 0:
        streak = noise.smooth(rng, n, 0.5 * period_m / timber.pore_m, 340.0)
        # Ring-porous wood has its pores where the year begins.
        needed = np.float32(2.6 - 2.2 * timber.pores) + 0.9 * np.minimum(year / 0.45, 1.0)
        pore = noise.step(streak - needed.astype(np.float32), 0.0, 0.8)
        color = noise.mixed(color, 0.62 * np.asarray(timber.late), 0.8 * pore)
    tint = 1.0 + 0.075 * rng.standard_normal((count, 1)) + 0.02 * rng.standard_normal((count, 3))
    color *= tint[board[:, 0]][:, None, :].astype(np.float32)
    line_between = (board != np.roll(board, 1, 0)).astype(np.float32)
    joint = np.maximum(line_between, 0.5 * np.roll(line_between, -1, 0))
    color *= (1.0 - 0.55 * joint)[..., None]

    roughness = float(rng.uniform(0.28, 0.6)) / 0.8
    height = -6e-5 * pore - 1.2e-4 * joint - 1.5e-5 * line + 4e-6 * fibre
    return noise.finished(
        timber.name, period_m, color, roughness,
        gloss=0.80 + 0.05 * fibre + 0.2 * pore + 0.2 * joint,
        height_m=noise.blurred(height.astype(np.float32), 0.8),
    )  # fmt: skip


def _board_of(rng: np.random.Generator, v: Array32, count: int) -> tuple[Int64, Array32]:
    """Return the board (n, 1) of every row and the place (n, 1) across it, -0.5 to 0.5."""
    width = rng.uniform(0.8, 1.2, count)
    edges = np.concatenate([[0.0], np.cumsum(width / width.sum())])
    board = np.clip(np.searchsorted(edges, v, side="right") - 1, 0, count - 1)
    across = (v - edges[board]) / (edges[board + 1] - edges[board]) - 0.5
    return board, across.astype(np.float32)


def _rings(
    rng: np.random.Generator, u: Array32, across: Array32, board: Int64, count: int, per_tile: float
) -> Array32:
    """Return the age (n, n) in years at every texel, by the distance to the trunk's axis."""
    n = u.shape[1]
    axis = rng.uniform(-0.9, 0.9, (count, 1))[board[:, 0]]
    depth = np.zeros((n, n), np.float32)
    for waves in (1, 2, 3):
        # The trunk bends, so that the cut leaves and enters rings: closed under the tile's edge.
        size = rng.normal(0.0, 0.30 / waves**1.4, (count, 1))[board[:, 0]]
        phase = rng.uniform(0, 2 * np.pi, (count, 1))[board[:, 0]]
        depth += (size * np.sin(2 * np.pi * waves * u + phase)).astype(np.float32)
    wobble = 0.035 * noise.smooth(rng, n, 3.0, 8.0) + 0.006 * noise.smooth(rng, n, 14.0, 30.0)
    lift = rng.uniform(0.25, 0.8, (count, 1))[board[:, 0]]
    sideways = (across - axis).astype(np.float32) + wobble
    radius = np.sqrt(sideways**2 + (depth + lift).astype(np.float32) ** 2)
    start = rng.uniform(0, 50, (count, 1))[board[:, 0]]
    return (radius * (per_tile / count) + start).astype(np.float32)


LAMINATES: tuple[tuple[str, noise.Tint], ...] = (
    ("white", (236, 236, 232)), ("light grey", (200, 203, 205)), ("grey", (146, 150, 153)),
    ("anthracite", (62, 65, 69)), ("black", (34, 34, 36)), ("beige", (216, 203, 180)),
    ("blue grey", (126, 146, 164)), ("sage", (150, 166, 146)),
)  # fmt: skip


def laminate(rng: np.random.Generator) -> Material:
    """Return a laminated board: one colour, hardly any pattern, the fine grain of the press."""
    n = LAMINATE_PX
    name, tint = LAMINATES[int(rng.integers(len(LAMINATES)))]
    speckle = noise.fine(rng, n, 60.0)
    cloud = noise.fractal(rng, n, 1.6)
    color = noise.shaded(rng, tint, 4.0) + (1.4 * speckle + 1.8 * cloud)[..., None]
    height = 6e-6 * noise.fine(rng, n, 130.0) + 6e-6 * noise.smooth(rng, n, 40.0)
    return noise.finished(f"{name} laminate", 0.25, color, rng.uniform(0.22, 0.55), height_m=height)


def painted_wood(rng: np.random.Generator) -> Material:
    """Return wood under paint: the colour of the paint, the relief of the grain."""
    n, period_m = LAMINATE_PX, float(rng.uniform(0.3, 0.5))
    grain = noise.smooth(rng, n, 4.0, 110.0)
    stroke = noise.smooth(rng, n, 3.0, 60.0)
    tint = np.asarray(noise.random_tint(rng, (0.1, 0.55), (0.45, 0.95)), np.float32)
    color = tint + (1.2 * stroke - 3.5 * np.maximum(grain - 0.8, 0))[..., None]
    height = -3.0e-5 * np.maximum(grain - 0.3, 0) + 1.0e-5 * stroke
    return noise.finished(
        "painted wood", period_m, color, rng.uniform(0.3, 0.6),
        gloss=0.9 + 0.05 * grain, height_m=height,
    )  # fmt: skip


MAKERS: dict[str, Callable[[np.random.Generator], Material]] = {
    "oak": boards("oak"),
    "walnut": boards("walnut"),
    "birch": boards("birch"),
    "pine": boards("pine"),
    "laminate": laminate,
    "painted wood": painted_wood,
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
