"""Stone and what is cast like it: marble, granite, concrete, terrazzo."""

import numpy as np

from realsim.rendering.appearance import Material
from realsim.rendering.procedural.noise import Field, cells, fine, fractal, smooth, step, warped
from realsim.rendering.procedural.texels import (
    Tint,
    grey8,
    image8,
    mixed,
    normals8,
    random_tint,
    shaded,
)

MARBLE_PX = 768
STONE_PX = 512

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


def _veins(rng: np.random.Generator, n: int, slope: float, width: float) -> Field:
    """Return thin wandering lines (n, n), 1 in their middle: where a cloud crosses zero."""
    cloud = fractal(rng, n, slope, 1.5)
    swirl = 0.05
    cloud = warped(cloud, swirl * fractal(rng, n, 2.0), swirl * fractal(rng, n, 2.0))
    gap = np.abs(cloud)
    # Veins thicken and fade along their way.
    broad = width * np.exp(0.8 * smooth(rng, n, 3.0))
    present = step(smooth(rng, n, 2.5), -0.9, 1.0)
    return (np.exp(-gap / broad) * present).astype(np.float32)


def marble(rng: np.random.Generator) -> Material:
    """Return polished marble: clouds, broad veins and hairlines."""
    n, period_m = MARBLE_PX, float(rng.uniform(0.6, 1.0))
    name, ground, cloud, vein = MARBLES[int(rng.integers(len(MARBLES)))]
    half = n // 2
    clouds = fractal(rng, n, 1.7)
    color = mixed(shaded(rng, ground, 3.0), cloud, 0.45 + 0.4 * clouds)
    share = 0.75 * _veins(rng, n, 1.9, 0.035)
    fine_veins = np.kron(_veins(rng, half, 1.5, 0.012), np.ones((2, 2), np.float32))
    share = np.maximum(share, 0.5 * fine_veins)
    color = mixed(color, vein, share.astype(np.float32))
    color += (1.2 * fine(rng, n, 160.0))[..., None]
    return Material(
        base_color=(1.0, 1.0, 1.0),
        base_color_image=image8(color),
        roughness=float(rng.uniform(0.08, 0.3)),
        roughness_image=grey8(np.clip(0.85 + 0.05 * clouds, 0, 1)),
        period_m=period_m,
        name=name,
    )


def granite(rng: np.random.Generator) -> Material:
    """Return polished granite: grains of four minerals in two sizes."""
    n, period_m = STONE_PX, float(rng.uniform(0.2, 0.35))
    name, minerals = GRANITES[int(rng.integers(len(GRANITES)))]
    table = np.asarray(minerals, np.float32)
    chances = np.array([0.42, 0.27, 0.19, 0.12])
    color = np.zeros((n, n, 3), np.float32)
    for per_side, weight in ((46, 1.0), (110, 0.55)):
        cell, _ = cells(rng, n, per_side, 1.0)
        of_cell = rng.choice(len(table), per_side**2, p=chances)
        tone = table[of_cell] + rng.normal(0, 9.0, (per_side**2, 1))
        color += weight * (tone[cell].astype(np.float32) - color)
    color += (5.0 * fine(rng, n, 150.0) + 4.0 * fractal(rng, n, 1.2))[..., None]
    gloss = np.clip(0.8 + 0.08 * smooth(rng, n, 40.0), 0, 1)
    return Material(
        base_color=(1.0, 1.0, 1.0),
        base_color_image=image8(color),
        roughness=float(rng.uniform(0.12, 0.45)),
        roughness_image=grey8(gloss),
        period_m=period_m,
        name=name,
    )


def concrete(rng: np.random.Generator) -> Material:
    """Return smoothed concrete: clouds of moisture, sand, and pits where air was."""
    n, period_m = STONE_PX, float(rng.uniform(0.5, 0.9))
    clouds = fractal(rng, n, 1.5)
    sand = fine(rng, n, 140.0)
    cell, inside = cells(rng, n, 26, 1.0)
    pit_of = rng.random(26 * 26)
    depth = step(inside, 0.30, 0.46) * (pit_of[cell] < 0.16)
    depth = np.asarray(depth, np.float32)
    tint = shaded(rng, (168, 166, 161), 14.0)
    color = tint + (9.0 * clouds + 3.5 * sand)[..., None] - (48.0 * depth)[..., None]
    height = (-8e-4 * depth + 3.5e-5 * sand + 6e-5 * fractal(rng, n, 1.3, 8.0)).astype(np.float32)
    return Material(
        base_color=(1.0, 1.0, 1.0),
        base_color_image=image8(color),
        roughness=float(rng.uniform(0.65, 0.95)),
        roughness_image=grey8(np.clip(0.92 + 0.05 * clouds, 0, 1)),
        normal_image=normals8(height, period_m),
        period_m=period_m,
        name="concrete",
    )


def terrazzo(rng: np.random.Generator) -> Material:
    """Return terrazzo: stone chips of two sizes in a ground of cement, polished."""
    n, period_m = STONE_PX, float(rng.uniform(0.25, 0.45))
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
        layer = of_cell[cell].astype(np.float32)
        chip = warped(chip.astype(np.float32), shift_u, shift_v)
        color = mixed(color, layer, chip)
    return Material(
        base_color=(1.0, 1.0, 1.0),
        base_color_image=image8(color),
        roughness=float(rng.uniform(0.12, 0.4)),
        period_m=period_m,
        name="terrazzo",
    )
