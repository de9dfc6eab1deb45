"""Tiles with joints between them: glazed ceramics."""

import numpy as np

from realsim.rendering.appearance import Material
from realsim.rendering.procedural.noise import Field, fine, fractal, grid, smooth, step
from realsim.rendering.procedural.texels import grey8, image8, mixed, normals8, random_tint, shaded

TILES_PX = 768


def ceramic_tiles(rng: np.random.Generator) -> Material:
    """Return glazed tiles in cement: square, one or two colours, none quite like the next."""
    n = TILES_PX
    per_side = int(rng.choice([2, 4]))
    tile_m = float(rng.choice([0.05, 0.1, 0.15]))
    period_m = per_side * tile_m
    joint = float(rng.uniform(0.0015, 0.004)) / tile_m
    u, v = grid(n)
    column = np.floor(u * per_side).astype(int)
    row = np.floor(v * per_side).astype(int)
    # Half a tile off, so that the joints are not at the border of the image.
    away_u = np.minimum((u * per_side) % 1.0, 1.0 - (u * per_side) % 1.0)
    away_v = np.minimum((v * per_side) % 1.0, 1.0 - (v * per_side) % 1.0)
    away = np.minimum(away_u, away_v).astype(np.float32) + 0.0015 * smooth(rng, n, 40.0)
    glaze = step(away, joint / 2, joint / 2 + 0.012)
    first = shaded(rng, random_tint(rng, (0.0, 0.5), (0.35, 0.97)), 3.0)
    second = shaded(rng, random_tint(rng, (0.0, 0.5), (0.35, 0.97)), 3.0)
    two = rng.random() < 0.4
    odd = ((column + row) % 2).astype(np.float32) * float(two)
    tone = rng.normal(0, 4.0, (per_side, per_side)).astype(np.float32)[row, column]
    color = mixed(first, second, odd) + (tone + 2.5 * fractal(rng, n, 1.6))[..., None]
    cement = shaded(rng, (168, 164, 156), 10.0) + (5.0 * fine(rng, n, 120.0))[..., None]
    color = mixed(cement, color, glaze)
    pillow = step(away, joint / 2, joint / 2 + 0.09)
    height = tile_m * (0.006 * glaze + 0.004 * pillow) + 3e-5 * smooth(rng, n, 7.0)
    return Material(
        base_color=(1.0, 1.0, 1.0),
        base_color_image=image8(color),
        roughness=0.95,
        roughness_image=grey8(mixed_roughness(float(rng.uniform(0.1, 0.3)), glaze)),
        normal_image=normals8(height.astype(np.float32), period_m),
        period_m=period_m,
        name="ceramic tiles",
    )


def mixed_roughness(glazed: float, glaze: Field) -> Field:
    """Return the roughness (n, n): `glazed` on the tiles, 1 in the joints."""
    return (1.0 + (glazed - 1.0) * glaze).astype(np.float32)
