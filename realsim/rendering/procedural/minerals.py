"""Stone and what is cast like it, glazed tiles, and metals.

Base colours of metals are the reflectances of the polished ones at normal incidence (linear; steel
about 0.55 and aluminium about 0.91, after Lagarde's tables for metallic-roughness), dulled.
"""

import numpy as np

from realsim.arrays import Array32
from realsim.rendering.appearance import Material
from realsim.rendering.procedural.noise import (
    Tint,
    cells,
    fine,
    finished,
    fractal,
    grid,
    mixed,
    random_tint,
    shaded,
    smooth,
    step,
    warped,
)

LARGE_PX = 768
PX = 512
MARBLES: tuple[tuple[str, Tint, Tint, Tint], ...] = (
    ("white marble", (236, 234, 230), (214, 214, 214), (132, 136, 142)),
    ("cream marble", (232, 218, 194), (216, 198, 168), (158, 126, 88)),
    ("black marble", (34, 34, 37), (48, 48, 52), (205, 203, 198)),
    ("green marble", (42, 70, 58), (64, 96, 80), (188, 204, 188)),
    ("rose marble", (214, 176, 162), (196, 152, 140), (132, 88, 84)),
)  # fmt: skip
"""Name, ground, cloud and vein (sRGB)."""
GRANITES: tuple[tuple[str, tuple[Tint, ...]], ...] = (
    ("grey granite", ((196, 194, 190), (152, 150, 148), (104, 103, 103), (44, 43, 44))),
    ("red granite", ((186, 124, 104), (160, 96, 80), (204, 176, 160), (52, 44, 42))),
    ("black granite", ((38, 39, 41), (56, 57, 60), (26, 26, 28), (116, 118, 122))),
    ("yellow granite", ((206, 178, 134), (184, 150, 104), (228, 210, 178), (84, 66, 50))),
)
"""Name and minerals (sRGB), the commonest first."""
POWDERS: tuple[Tint, ...] = (
    (38, 76, 130), (196, 60, 38), (232, 176, 28), (58, 112, 72), (196, 198, 196), (48, 50, 54),
)  # fmt: skip
"""Colours of powder coating (sRGB)."""
HOLE_PITCH_M = 0.025
"""Grid of threaded holes on metric optical tables [m]."""
HOLE_RADIUS_M = 0.0033
"""Half the mouth of an M6 thread [m]."""


def _veins(rng: np.random.Generator, n: int, slope: float, width: float) -> Array32:
    """Return thin wandering lines (n, n), 1 in their middle: where a cloud crosses zero."""
    cloud = fractal(rng, n, slope, 1.5)
    swirl = 0.05
    cloud = warped(cloud, swirl * fractal(rng, n, 2.0), swirl * fractal(rng, n, 2.0))
    # Veins thicken and fade along their way.
    broad = width * np.exp(0.8 * smooth(rng, n, 3.0))
    present = step(smooth(rng, n, 2.5), -0.9, 1.0)
    return (np.exp(-np.abs(cloud) / broad) * present).astype(np.float32)


def marble(rng: np.random.Generator) -> Material:
    """Return polished marble: clouds, broad veins and hairlines."""
    n, period_m = LARGE_PX, float(rng.uniform(0.6, 1.0))
    name, ground, cloud, vein = MARBLES[int(rng.integers(len(MARBLES)))]
    clouds = fractal(rng, n, 1.7)
    color = mixed(shaded(rng, ground, 3.0), cloud, 0.45 + 0.4 * clouds)
    share = 0.75 * _veins(rng, n, 1.9, 0.035)
    fine_veins = np.kron(_veins(rng, n // 2, 1.5, 0.012), np.ones((2, 2), np.float32))
    color = mixed(color, vein, np.maximum(share, 0.5 * fine_veins).astype(np.float32))
    color += (1.2 * fine(rng, n, 160.0))[..., None]
    return finished(name, period_m, color, rng.uniform(0.08, 0.3), gloss=0.85 + 0.05 * clouds)


def granite(rng: np.random.Generator) -> Material:
    """Return polished granite: grains of four minerals in two sizes."""
    n, period_m = PX, float(rng.uniform(0.2, 0.35))
    name, minerals = GRANITES[int(rng.integers(len(GRANITES)))]
    table = np.asarray(minerals, np.float32)
    color = np.zeros((n, n, 3), np.float32)
    for per_side, weight in ((46, 1.0), (110, 0.55)):
        cell, _ = cells(rng, n, per_side, 1.0)
        of_cell = rng.choice(len(table), per_side**2, p=np.array([0.42, 0.27, 0.19, 0.12]))
        tone = table[of_cell] + rng.normal(0, 9.0, (per_side**2, 1))
        color += weight * (tone[cell].astype(np.float32) - color)
    color += (5.0 * fine(rng, n, 150.0) + 4.0 * fractal(rng, n, 1.2))[..., None]
    gloss = 0.8 + 0.08 * smooth(rng, n, 40.0)
    return finished(name, period_m, color, rng.uniform(0.12, 0.45), gloss=gloss)


def concrete(rng: np.random.Generator) -> Material:
    """Return smoothed concrete: clouds of moisture, sand, and pits where air was."""
    n, period_m = PX, float(rng.uniform(0.5, 0.9))
    clouds = fractal(rng, n, 1.5)
    sand = fine(rng, n, 140.0)
    cell, inside = cells(rng, n, 26, 1.0)
    pitted = rng.random(26 * 26) < 0.16
    depth = np.asarray(step(inside, 0.30, 0.46) * pitted[cell], np.float32)
    tint = shaded(rng, (168, 166, 161), 14.0)
    color = tint + (9.0 * clouds + 3.5 * sand)[..., None] - (48.0 * depth)[..., None]
    height = -8e-4 * depth + 3.5e-5 * sand + 6e-5 * fractal(rng, n, 1.3, 8.0)
    return finished(
        "concrete", period_m, color, rng.uniform(0.65, 0.95),
        gloss=0.92 + 0.05 * clouds, height_m=height,
    )  # fmt: skip


def terrazzo(rng: np.random.Generator) -> Material:
    """Return terrazzo: stone chips of two sizes in a ground of cement, polished."""
    n, period_m = PX, float(rng.uniform(0.25, 0.45))
    light = rng.random() < 0.7
    ground = shaded(rng, (222, 218, 210) if light else (74, 74, 78), 6.0)
    palette = np.stack(
        [shaded(rng, random_tint(rng, (0.05, 0.45), (0.3, 0.95)), 8.0) for _ in range(5)]
    )
    color = np.broadcast_to(ground, (n, n, 3)) + (2.5 * fractal(rng, n, 1.2))[..., None]
    color = (color + (2.0 * fine(rng, n, 150.0))[..., None]).astype(np.float32)
    bend = 0.004
    shift_u, shift_v = bend * smooth(rng, n, 30.0), bend * smooth(rng, n, 30.0)
    for per_side, share in ((34, 0.55), (13, 0.5)):
        cell, inside = cells(rng, n, per_side, 1.0)
        there = rng.random(per_side**2) < share
        rim = rng.uniform(0.05, 0.24, per_side**2).astype(np.float32)
        soft = np.float32(1.2 * per_side / n)
        chip = step(inside - rim[cell], 0.0, float(soft)) * there[cell]
        of_cell = palette[rng.integers(len(palette), size=per_side**2)]
        of_cell = of_cell + rng.normal(0, 7.0, (per_side**2, 1))
        chip = warped(chip.astype(np.float32), shift_u, shift_v)
        color = mixed(color, of_cell[cell].astype(np.float32), chip)
    return finished("terrazzo", period_m, color, rng.uniform(0.12, 0.4))


def ceramic_tiles(rng: np.random.Generator) -> Material:
    """Return glazed tiles in cement: square, one or two colours, none quite like the next."""
    n = LARGE_PX
    per_side = int(rng.choice([2, 4]))
    tile_m = float(rng.choice([0.05, 0.1, 0.15]))
    joint = float(rng.uniform(0.0015, 0.004)) / tile_m
    u, v = grid(n)
    column = np.floor(u * per_side).astype(int)
    row = np.floor(v * per_side).astype(int)
    # Half a tile off, so that the joints are not at the border of the image.
    away_u = np.minimum((u * per_side) % 1.0, 1.0 - (u * per_side) % 1.0)
    away_v = np.minimum((v * per_side) % 1.0, 1.0 - (v * per_side) % 1.0)
    away = np.minimum(away_u, away_v).astype(np.float32) + 0.0015 * smooth(rng, n, 40.0)
    glaze = step(away, joint / 2, joint / 2 + 0.012)
    first, second = (shaded(rng, random_tint(rng, (0.0, 0.5), (0.35, 0.97)), 3.0) for _ in range(2))
    two = rng.random() < 0.4
    odd = ((column + row) % 2).astype(np.float32) * float(two)
    tone = rng.normal(0, 4.0, (per_side, per_side)).astype(np.float32)[row, column]
    color = mixed(first, second, odd) + (tone + 2.5 * fractal(rng, n, 1.6))[..., None]
    cement = shaded(rng, (168, 164, 156), 10.0) + (5.0 * fine(rng, n, 120.0))[..., None]
    pillow = step(away, joint / 2, joint / 2 + 0.09)
    height = tile_m * (0.006 * glaze + 0.004 * pillow) + 3e-5 * smooth(rng, n, 7.0)
    return finished(
        "ceramic tiles", per_side * tile_m, mixed(cement, color, glaze), 0.95,
        gloss=1.0 + (float(rng.uniform(0.1, 0.3)) - 1.0) * glaze, height_m=height,
    )  # fmt: skip


def _scratches(rng: np.random.Generator, n: int) -> Array32:
    """Return the lines (n, n) of brushing along u: a long grain of all finenesses."""
    coarse = smooth(rng, n, 1.2, 60.0)
    hair = smooth(rng, n, 5.0, 400.0)
    return (0.5 * coarse + 0.87 * hair).astype(np.float32)


def brushed_steel(rng: np.random.Generator) -> Material:
    """Return stainless steel brushed along u."""
    period_m = float(rng.uniform(0.12, 0.25))
    lines = _scratches(rng, PX)
    color = shaded(rng, (196, 194, 191), 5.0) + (4.5 * lines)[..., None]
    return finished(
        "brushed steel", period_m, color, rng.uniform(0.28, 0.45),
        gloss=0.8 + 0.09 * lines, height_m=2.2e-6 * lines, metallic=1.0,
    )  # fmt: skip


def aluminium(rng: np.random.Generator) -> Material:
    """Return aluminium: blasted and anodised, clear or black."""
    black = rng.random() < 0.25
    tint = shaded(rng, (58, 59, 62) if black else (222, 223, 225), 4.0)
    grain = fine(rng, PX, 150.0)
    color = tint + (2.0 * grain + 2.0 * fractal(rng, PX, 1.5))[..., None]
    return finished(
        "black aluminium" if black else "aluminium", 0.12, color, rng.uniform(0.3, 0.55),
        gloss=0.88 + 0.05 * smooth(rng, PX, 12.0), height_m=2.5e-6 * grain, metallic=1.0,
    )  # fmt: skip


def rusty_metal(rng: np.random.Generator) -> Material:
    """Return iron under rust. Rust is no metal, so the whole is none: bare spots are dark grey."""
    n, period_m = PX, float(rng.uniform(0.25, 0.4))
    spread = fractal(rng, n, 1.3)
    rust = step(spread, -0.9 + float(rng.uniform(-0.5, 0.5)), 0.6)
    tone = fractal(rng, n, 1.0)
    brown = mixed((74, 38, 24), (172, 92, 44), 0.5 + 0.28 * tone)
    brown = mixed(brown, (206, 132, 62), step(fractal(rng, n, 1.1), 1.0, 2.4))
    iron = np.asarray((96, 96, 98), np.float32) + (5.0 * smooth(rng, n, 1.5, 120.0))[..., None]
    color = mixed(iron, brown, rust) + (5.0 * fine(rng, n, 150.0))[..., None]
    bumps = 0.7 * fractal(rng, n, 1.1, 6.0) + 0.5 * fine(rng, n, 90.0)
    return finished(
        "rusty metal", period_m, color, 0.95,
        gloss=0.45 + 0.5 * rust, height_m=rust * (8e-5 + 5e-5 * bumps), metallic=0.2,
    )  # fmt: skip


def painted_metal(rng: np.random.Generator) -> Material:
    """Return powder-coated sheet: the orange-peel skin of melted powder."""
    tint = shaded(rng, POWDERS[int(rng.integers(len(POWDERS)))], 8.0)
    peel = smooth(rng, PX, 45.0)
    color = tint + (0.8 * peel + 1.0 * fractal(rng, PX, 1.8))[..., None]
    return finished("painted metal", 0.12, color, rng.uniform(0.2, 0.5), height_m=9e-6 * peel)


def galvanised_steel(rng: np.random.Generator) -> Material:
    """Return zinc-coated sheet: crystals of zinc, each as bright as it lies."""
    n, period_m = PX, float(rng.uniform(0.12, 0.22))
    cell, _ = cells(rng, n, 11, 1.0)
    bright = rng.normal(0, 13.0, 121).astype(np.float32)[cell]
    feather = smooth(rng, n, 9.0, 40.0) * bright * 0.35
    color = shaded(rng, (172, 176, 180), 4.0) + (bright + feather)[..., None]
    gloss = 0.8 + 0.008 * bright + 0.03 * fine(rng, n, 120.0)
    return finished(
        "galvanised steel", period_m, color, rng.uniform(0.35, 0.5), gloss=gloss, metallic=1.0
    )


def optical_table(rng: np.random.Generator) -> Material:
    """Return the drilled plate robots are screwed to: M6 holes every 25 mm."""
    n, per_side = PX, 8
    period_m = per_side * HOLE_PITCH_M
    black = rng.random() < 0.5
    u, v = grid(n)
    from_middle = HOLE_PITCH_M * np.hypot((u * per_side) % 1.0 - 0.5, (v * per_side) % 1.0 - 0.5)
    inwards = -from_middle.astype(np.float32)
    soft = 0.7 * period_m / n
    hole = step(inwards, -HOLE_RADIUS_M - soft, -HOLE_RADIUS_M + soft)
    rim = np.exp(-(((from_middle - HOLE_RADIUS_M) / 5e-4) ** 2)).astype(np.float32)
    lines = fine(rng, n, 140.0) if black else _scratches(rng, n)
    plate = shaded(rng, (66, 67, 70) if black else (204, 204, 202), 4.0)
    color = plate + (3.0 * lines)[..., None] + (22.0 * rim)[..., None]
    return finished(
        "optical table", period_m, mixed(color.astype(np.float32), (12, 12, 13), hole),
        rng.uniform(0.4, 0.6), gloss=0.8 + 0.05 * lines + 0.2 * hole,
        height_m=-4e-4 * step(inwards, -0.0042, -0.0030), metallic=1.0,
    )  # fmt: skip
