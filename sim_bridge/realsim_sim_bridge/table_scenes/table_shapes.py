"""The ten table models, each with sizes drawn within what is built [m]."""

from collections.abc import Callable

import numpy as np

from realsim.arrays import Array
from realsim.errors import InputError
from realsim.geometry import parts_solids as solids
from realsim_sim_bridge.table_scenes.tables import (
    TableModel,
    box,
    corners,
    ellipse,
    part,
    rod,
    rounded,
    turned,
)

Rng = np.random.Generator


def _slab(outline: Array, thick: float, bevel: float = 0.003) -> Array:
    """Return the plate under an outline whose upper face is z = 0."""
    return solids.extrude(outline, -thick, 0.0, chamfer=min(bevel, 0.3 * thick))


def _legs(width: float, depth: float, wide: float, top: float, height: float) -> list[Array]:
    """Return four square legs at the corners of a rectangle."""
    x, y = width / 2 - wide, depth / 2 - wide
    return [
        box((sx * x - wide / 2, sy * y - wide / 2, -height), (sx * x + wide / 2, sy * y + wide / 2,
            top), 0.002)
        for sx in (-1, 1) for sy in (-1, 1)
    ]  # fmt: skip


def _apron(width: float, depth: float, inset: float, thick: float, high: float) -> list[Array]:
    """Return the four boards under a top that join the legs."""
    x, y, t = width / 2 - inset, depth / 2 - inset, 0.018
    z = (-thick - high, -thick)
    return [
        box((-x, sy * y - t / 2, z[0]), (x, sy * y + t / 2, z[1])) for sy in (-1, 1)
    ] + [
        box((sx * x - t / 2, -y + t, z[0]), (sx * x + t / 2, y - t, z[1])) for sx in (-1, 1)
    ]  # fmt: skip


def rectangular(rng: Rng) -> TableModel:
    """Return a dining table: plate, four legs, apron."""
    width, depth = rng.uniform(1.1, 1.6), rng.uniform(0.7, 0.9)
    height, thick, leg = rng.uniform(0.72, 0.76), rng.uniform(0.02, 0.04), rng.uniform(0.05, 0.09)
    outline = solids.rectangle(width, depth)
    return TableModel(
        name="rectangular", outline=outline, height_m=height,
        parts=(
            part("top", "top", [_slab(outline, thick)]),
            part("legs", "frame", _legs(width, depth, leg, -thick, height)),
            part("apron", "frame", _apron(width, depth, leg, thick, 0.08)),
        ),
    )  # fmt: skip


def round_pedestal(rng: Rng) -> TableModel:
    """Return a round table on one turned column."""
    radius, height = rng.uniform(0.45, 0.65), rng.uniform(0.72, 0.76)
    thick, r = rng.uniform(0.02, 0.035), rng.uniform(0.04, 0.06)
    outline = solids.circle(radius, 96)
    foot, z = 0.55 * radius, -height
    column = [
        (0.0, z), (foot, z), (foot, z + 0.02), (0.3 * foot, z + 0.06), (r, z + 0.14),
        (0.8 * r, -0.5 * height), (1.3 * r, -0.45 * height), (r, -0.4 * height),
        (r, -thick - 0.1), (0.35 * radius, -thick - 0.01), (0.35 * radius, -thick), (0.0, -thick),
    ]  # fmt: skip
    return TableModel(
        name="round", outline=outline, height_m=height,
        parts=(
            part("top", "top", [_slab(outline, thick, 0.006)]),
            part("column", "frame", [turned(column)]),
        ),
    )  # fmt: skip


def oval(rng: Rng) -> TableModel:
    """Return an oval table on four round, tapered legs."""
    width, depth, height = rng.uniform(1.2, 1.7), rng.uniform(0.75, 0.95), rng.uniform(0.72, 0.76)
    thick, r = rng.uniform(0.022, 0.035), rng.uniform(0.022, 0.032)
    outline = ellipse(width, depth, rng.uniform(2.0, 3.0))
    x, y = 0.30 * width, 0.27 * depth
    profile = [(0.0, -height), (0.55 * r, -height), (r, -thick), (0.0, -thick)]
    legs = [turned(profile, sx * x, sy * y, 24) for sx in (-1, 1) for sy in (-1, 1)]
    return TableModel(
        name="oval", outline=outline, height_m=height,
        parts=(part("top", "top", [_slab(outline, thick, 0.007)]), part("legs", "frame", legs)),
    )  # fmt: skip


def glass_trestle(rng: Rng) -> TableModel:
    """Return a thin, glossy plate that lies on two trestles."""
    width, depth = rng.uniform(1.2, 1.6), rng.uniform(0.65, 0.85)
    height, thick, w = rng.uniform(0.71, 0.75), rng.uniform(0.008, 0.012), rng.uniform(0.03, 0.045)
    outline = rounded(width, depth, 0.03)
    pieces: list[Array] = []
    for side in (-1, 1):
        x, top = side * (0.5 * width - 0.25), -thick - w / 2
        pieces.append(rod((x, -0.42 * depth, top), (x, 0.42 * depth, top), w))
        for y in (-0.34 * depth, 0.34 * depth):
            pieces += [
                rod((x + dx, y, -height), (x + 0.1 * dx, y, top), 0.8 * w) for dx in (-0.16, 0.16)
            ]
        low = -0.72 * height
        pieces.append(rod((x - 0.13, -0.34 * depth, low), (x - 0.13, 0.34 * depth, low), 0.6 * w))
    return TableModel(
        name="glass_trestle", outline=outline, height_m=height,
        parts=(part("plate", "top", [_slab(outline, thick, 0.002)]),
               part("trestles", "frame", pieces)),
    )  # fmt: skip


def workbench(rng: Rng) -> TableModel:
    """Return a heavy bench with an edge along its back, a vice's jaw and a shelf below."""
    width, depth = rng.uniform(1.2, 1.6), rng.uniform(0.65, 0.8)
    height, thick, leg = rng.uniform(0.85, 0.92), rng.uniform(0.05, 0.08), rng.uniform(0.08, 0.1)
    rise, outline = rng.uniform(0.04, 0.12), solids.rectangle(width, depth)
    low, high = (-width / 2, depth / 2 - 0.03, 0.0), (width / 2, depth / 2, rise)
    shelf = -height + 0.18
    x, y = width / 2 - leg, depth / 2 - leg
    return TableModel(
        name="workbench", outline=outline, height_m=height,
        parts=(
            part("top", "top", [_slab(outline, thick, 0.004)]),
            part("edge", "detail", [box(low, high, 0.003)]),
            part("legs", "frame", _legs(width, depth, leg, -thick, height)),
            part("shelf", "frame", [box((-x, -y, shelf - 0.02), (x, y, shelf))]),
            part("vice", "detail", [
                box((-0.3 * width, -depth / 2 - 0.05, -0.14), (-0.3 * width + 0.2, -depth / 2,
                    -0.004), 0.004),
                rod((-0.3 * width + 0.1, -depth / 2 - 0.17, -0.08),
                    (-0.3 * width + 0.1, -depth / 2 - 0.05, -0.08), 0.024),
            ]),
        ),
        rims=(corners(low, high),),
    )  # fmt: skip


def drawer_desk(rng: Rng) -> TableModel:
    """Return a desk on two blocks of drawers with handles."""
    width, depth = rng.uniform(1.2, 1.6), rng.uniform(0.6, 0.8)
    height, thick, block = (
        rng.uniform(0.72, 0.76),
        rng.uniform(0.02, 0.035),
        rng.uniform(0.35, 0.42),
    )
    outline = rounded(width, depth, 0.012, 3)
    blocks, fronts, handles = list[Array](), list[Array](), list[Array]()
    n, front = int(rng.integers(3, 5)), -depth / 2 + 0.03
    for side in (-1, 1):
        x0, x1 = sorted((side * (width / 2 - 0.02), side * (width / 2 - 0.02 - block)))
        blocks.append(box((x0, front + 0.02, -height), (x1, depth / 2 - 0.03, -thick)))
        pitch = (height - thick - 0.06) / n
        for k in range(n):
            z = -height + 0.05 + k * pitch
            fronts.append(
                box((x0 + 0.006, front, z), (x1 - 0.006, front + 0.019, z + pitch - 0.006), 0.002)
            )
            middle, at = (x0 + x1) / 2, z + 0.6 * pitch
            handles.append(
                box((middle - 0.06, front - 0.022, at), (middle + 0.06, front - 0.012, at + 0.012))
            )
            handles += [
                box((middle + s * 0.05 - 0.005, front - 0.013, at + 0.001),
                    (middle + s * 0.05 + 0.005, front + 0.001, at + 0.011)) for s in (-1, 1)
            ]  # fmt: skip
    back = box((-width / 2 + 0.02 + block, depth / 2 - 0.06, -0.55 * height),
               (width / 2 - 0.02 - block, depth / 2 - 0.04, -thick))  # fmt: skip
    return TableModel(
        name="drawer_desk", outline=outline, height_m=height,
        parts=(
            part("top", "top", [_slab(outline, thick)]),
            part("blocks", "frame", [*blocks, back]),
            part("fronts", "frame", fronts),
            part("handles", "detail", handles),
        ),
    )  # fmt: skip


def lab_bench(rng: Rng) -> TableModel:
    """Return a laboratory bench: a lip around the plate, a panel behind it, a frame of tubes."""
    width, depth = rng.uniform(1.2, 1.8), rng.uniform(0.7, 0.85)
    height, thick, lip = (
        rng.uniform(0.85, 0.92),
        rng.uniform(0.025, 0.035),
        rng.uniform(0.006, 0.01),
    )
    outline, w, rise = solids.rectangle(width, depth), 0.02, rng.uniform(0.08, 0.2)
    x, y = width / 2, depth / 2
    rims = [
        ((-x, -y, 0.0), (x, -y + w, lip)),
        ((-x, -y + w, 0.0), (-x + w, y - w, lip)),
        ((x - w, -y + w, 0.0), (x, y - w, lip)),
        ((-x, y - w, 0.0), (x, y, rise)),
    ]
    tube, low = 0.04, -height + 0.12
    frame = _legs(width - 0.06, depth - 0.06, tube, -thick, height)
    frame += [
        rod((sx * (x - 0.07), -y + 0.07, low), (sx * (x - 0.07), y - 0.07, low), 0.8 * tube)
        for sx in (-1, 1)
    ]
    frame.append(rod((-x + 0.07, y - 0.07, low), (x - 0.07, y - 0.07, low), 0.8 * tube))
    return TableModel(
        name="lab_bench", outline=outline, height_m=height,
        parts=(
            part("top", "top", [_slab(outline, thick)]),
            part("lip", "top", [box(a, b, 0.002) for a, b in rims[:3]]),
            part("panel", "detail", [box(*rims[3], 0.002)]),
            part("frame", "frame", frame),
        ),
        rims=tuple(corners(a, b) for a, b in rims),
    )  # fmt: skip


def crate(rng: Rng) -> TableModel:
    """Return a shallow crate of boards on blocks: a bin to pick from."""
    width, depth = rng.uniform(0.8, 1.2), rng.uniform(0.6, 0.8)
    height, thick, t = rng.uniform(0.5, 0.8), rng.uniform(0.015, 0.022), rng.uniform(0.012, 0.02)
    rise, gap = rng.uniform(0.06, 0.12), 0.012
    outline, x, y = solids.rectangle(width, depth), width / 2, depth / 2
    boards: list[Array] = []
    for z0, z1 in ((0.0, rise / 2 - gap / 2), (rise / 2 + gap / 2, rise)):
        boards += [box((-x, s * (y - t / 2) - t / 2, z0), (x, s * (y - t / 2) + t / 2, z1), 0.001)
                   for s in (-1, 1)]  # fmt: skip
        boards += [
            box((s * (x - t / 2) - t / 2, -y + t, z0), (s * (x - t / 2) + t / 2, y - t, z1), 0.001)
            for s in (-1, 1)
        ]
    posts = [
        box((sx * (x - t - 0.015) - 0.015, sy * (y - t - 0.015) - 0.015, 0.0),
            (sx * (x - t - 0.015) + 0.015, sy * (y - t - 0.015) + 0.015, rise), 0.001)
        for sx in (-1, 1) for sy in (-1, 1)
    ]  # fmt: skip
    rims = [corners((-x, s * (y - t / 2) - t / 2, 0), (x, s * (y - t / 2) + t / 2, rise))
            for s in (-1, 1)]  # fmt: skip
    rims += [corners((s * (x - t / 2) - t / 2, -y + t, 0), (s * (x - t / 2) + t / 2, y - t, rise))
             for s in (-1, 1)]  # fmt: skip
    rims += [corners(p.reshape(-1, 3).min(axis=0).tolist(), p.reshape(-1, 3).max(axis=0).tolist())
             for p in posts]  # fmt: skip
    blocks = [box((-0.9 * x, k * 0.8 * y - 0.05, -height), (0.9 * x, k * 0.8 * y + 0.05, -thick))
              for k in (-1, 0, 1)]  # fmt: skip
    return TableModel(
        name="crate", outline=outline, height_m=height,
        parts=(
            part("bottom", "top", [_slab(outline, thick, 0.001)]),
            part("boards", "detail", boards),
            part("posts", "detail", posts),
            part("blocks", "frame", blocks),
        ),
        rims=tuple(rims),
    )  # fmt: skip


def coffee_table(rng: Rng) -> TableModel:
    """Return a low table with round corners and a shelf."""
    width, depth = rng.uniform(0.9, 1.2), rng.uniform(0.5, 0.7)
    height, thick, r = rng.uniform(0.38, 0.48), rng.uniform(0.03, 0.06), rng.uniform(0.02, 0.035)
    outline = rounded(width, depth, rng.uniform(0.04, 0.15), 10)
    x, y, shelf = 0.4 * width, 0.36 * depth, -0.7 * height
    profile = [(0.0, -height), (r, -height), (r, -thick), (0.0, -thick)]
    legs = [turned(profile, sx * x, sy * y, 24) for sx in (-1, 1) for sy in (-1, 1)]
    return TableModel(
        name="coffee_table", outline=outline, height_m=height,
        parts=(
            part("top", "top", [_slab(outline, thick, 0.008)]),
            part("legs", "frame", legs),
            part("shelf", "detail", [box((-x, -y, shelf - 0.015), (x, y, shelf), 0.002)]),
        ),
    )  # fmt: skip


def bar_table(rng: Rng) -> TableModel:
    """Return a small, high round table with a metal rim on a slim column."""
    radius, height = rng.uniform(0.35, 0.45), rng.uniform(1.0, 1.1)
    thick, r = rng.uniform(0.025, 0.04), rng.uniform(0.025, 0.04)
    outline, z = solids.circle(radius, 96), -height
    column = [
        (0.0, z), (0.6 * radius, z), (0.6 * radius, z + 0.012), (1.5 * r, z + 0.03), (r, z + 0.05),
        (r, -thick - 0.05), (3 * r, -thick), (0.0, -thick),
    ]  # fmt: skip
    R = radius + 0.004
    band = [
        (radius, -0.85 * thick),
        (R, -0.85 * thick),
        (R, -0.15 * thick),
        (radius, -0.15 * thick),
    ]
    rest = solids.arc((0.42 * radius, 0.35 * z), 0.012, 0.0, 2 * np.pi, 12)
    return TableModel(
        name="bar_table", outline=outline, height_m=height,
        parts=(
            part("top", "top", [_slab(outline, thick, 0.004)]),
            part("band", "detail", [turned([*band, band[0]], segments=96)]),
            part("column", "frame", [turned(column)]),
            part("foot rest", "detail", [
                turned(np.concatenate([rest[:-1], rest[:1]]), segments=48),
                rod((-0.42 * radius, 0.0, 0.35 * z), (0.42 * radius, 0.0, 0.35 * z), 0.012),
            ]),
        ),
    )  # fmt: skip


SHAPES = {
    "rectangular": rectangular,
    "round": round_pedestal,
    "oval": oval,
    "glass_trestle": glass_trestle,
    "workbench": workbench,
    "drawer_desk": drawer_desk,
    "lab_bench": lab_bench,
    "crate": crate,
    "coffee_table": coffee_table,
    "bar_table": bar_table,
}
"""Name -> how such a table is made."""


# --- by name ----------------------------------------------------------------------------------


def table_names() -> tuple[str, ...]:
    """Return the names of the table models."""
    return tuple(SHAPES)


def table(name: str, rng: np.random.Generator) -> TableModel:
    """Return a table of a kind, its sizes drawn.

    Raises:
        InputError: there is no such kind.
    """
    if name not in SHAPES:
        raise InputError(f"there is no table '{name}'; the tables are: {', '.join(SHAPES)}.")
    make: Callable[[np.random.Generator], TableModel] = SHAPES[name]
    return make(rng)
