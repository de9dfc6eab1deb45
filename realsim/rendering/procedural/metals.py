"""Metals: brushed, blasted, rusty, and the drilled plate of an optical table.

Base colours are the reflectances of the polished metals at normal incidence (linear; steel about
0.55 and aluminium about 0.91, after Lagarde's tables for metallic-roughness materials), dulled.
"""

import numpy as np

from realsim.rendering.appearance import Material
from realsim.rendering.procedural.noise import Field, cells, fine, fractal, grid, smooth, step
from realsim.rendering.procedural.texels import grey8, image8, mixed, normals8, shaded

METAL_PX = 512
HOLE_PITCH_M = 0.025
"""Grid of threaded holes on metric optical tables [m]."""
HOLE_RADIUS_M = 0.0033
"""Half the mouth of an M6 thread [m]."""


def _scratches(rng: np.random.Generator, n: int) -> Field:
    """Return the lines (n, n) of brushing along u: a long grain of all finenesses."""
    coarse = smooth(rng, n, 1.2, 60.0)
    hair = smooth(rng, n, 5.0, 400.0)
    return (0.5 * coarse + 0.87 * hair).astype(np.float32)


def brushed_steel(rng: np.random.Generator) -> Material:
    """Return stainless steel brushed along u."""
    n, period_m = METAL_PX, float(rng.uniform(0.12, 0.25))
    lines = _scratches(rng, n)
    tint = shaded(rng, (196, 194, 191), 5.0)
    color = tint + (4.5 * lines)[..., None]
    height = (2.2e-6 * lines).astype(np.float32)
    return Material(
        base_color=(1.0, 1.0, 1.0),
        base_color_image=image8(color),
        roughness=float(rng.uniform(0.28, 0.45)),
        roughness_image=grey8(np.clip(0.8 + 0.09 * lines, 0, 1)),
        metallic=1.0,
        normal_image=normals8(height, period_m),
        period_m=period_m,
        name="brushed steel",
    )


def aluminium(rng: np.random.Generator) -> Material:
    """Return aluminium: blasted and anodised, clear or black."""
    n, period_m = METAL_PX, 0.12
    black = rng.random() < 0.25
    tint = shaded(rng, (58, 59, 62) if black else (222, 223, 225), 4.0)
    grain = fine(rng, n, 150.0)
    color = tint + (2.0 * grain + 2.0 * fractal(rng, n, 1.5))[..., None]
    height = (2.5e-6 * grain).astype(np.float32)
    return Material(
        base_color=(1.0, 1.0, 1.0),
        base_color_image=image8(color),
        roughness=float(rng.uniform(0.3, 0.55)),
        roughness_image=grey8(np.clip(0.88 + 0.05 * smooth(rng, n, 12.0), 0, 1)),
        metallic=1.0,
        normal_image=normals8(height, period_m),
        period_m=period_m,
        name="black aluminium" if black else "aluminium",
    )


def rusty_metal(rng: np.random.Generator) -> Material:
    """Return iron under rust. Rust is no metal, so the whole is none: bare spots are dark grey."""
    n, period_m = METAL_PX, float(rng.uniform(0.25, 0.4))
    spread = fractal(rng, n, 1.3)
    rust = step(spread, -0.9 + float(rng.uniform(-0.5, 0.5)), 0.6)
    tone = fractal(rng, n, 1.0)
    brown = mixed((74, 38, 24), (172, 92, 44), 0.5 + 0.28 * tone)
    brown = mixed(brown, (206, 132, 62), step(fractal(rng, n, 1.1), 1.0, 2.4))
    iron = np.asarray((96, 96, 98), np.float32) + (5.0 * smooth(rng, n, 1.5, 120.0))[..., None]
    color = mixed(iron, brown, rust) + (5.0 * fine(rng, n, 150.0))[..., None]
    bumps = 0.7 * fractal(rng, n, 1.1, 6.0) + 0.5 * fine(rng, n, 90.0)
    height = (rust * (8e-5 + 5e-5 * bumps)).astype(np.float32)
    return Material(
        base_color=(1.0, 1.0, 1.0),
        base_color_image=image8(color),
        roughness=0.95,
        roughness_image=grey8(0.45 + 0.5 * rust),
        metallic=0.2,
        normal_image=normals8(height, period_m),
        period_m=period_m,
        name="rusty metal",
    )


def painted_metal(rng: np.random.Generator) -> Material:
    """Return powder-coated sheet: the orange-peel skin of melted powder."""
    n, period_m = METAL_PX, 0.12
    hues = (
        (38, 76, 130),
        (196, 60, 38),
        (232, 176, 28),
        (58, 112, 72),
        (196, 198, 196),
        (48, 50, 54),
    )
    tint = shaded(rng, hues[int(rng.integers(len(hues)))], 8.0)
    peel = smooth(rng, n, 45.0)
    color = tint + (0.8 * peel + 1.0 * fractal(rng, n, 1.8))[..., None]
    return Material(
        base_color=(1.0, 1.0, 1.0),
        base_color_image=image8(color),
        roughness=float(rng.uniform(0.2, 0.5)),
        normal_image=normals8((9e-6 * peel).astype(np.float32), period_m),
        period_m=period_m,
        name="painted metal",
    )


def galvanised_steel(rng: np.random.Generator) -> Material:
    """Return zinc-coated sheet: crystals of zinc, each as bright as it lies."""
    n, period_m = METAL_PX, float(rng.uniform(0.12, 0.22))
    cell, _ = cells(rng, n, 11, 1.0)
    of_cell = rng.normal(0, 13.0, 121).astype(np.float32)
    feather = smooth(rng, n, 9.0, 40.0) * of_cell[cell] * 0.35
    color = shaded(rng, (172, 176, 180), 4.0) + (of_cell[cell] + feather)[..., None]
    gloss = 0.8 + 0.008 * of_cell[cell] + 0.03 * fine(rng, n, 120.0)
    return Material(
        base_color=(1.0, 1.0, 1.0),
        base_color_image=image8(color),
        roughness=float(rng.uniform(0.35, 0.5)),
        roughness_image=grey8(np.clip(gloss, 0, 1)),
        metallic=1.0,
        period_m=period_m,
        name="galvanised steel",
    )


def optical_table(rng: np.random.Generator) -> Material:
    """Return the drilled plate robots are screwed to: M6 holes every 25 mm."""
    per_side = 8
    n, period_m = METAL_PX, per_side * HOLE_PITCH_M
    black = rng.random() < 0.5
    u, v = grid(n)
    from_middle = np.hypot(
        (u * per_side) % 1.0 - 0.5, (v * per_side) % 1.0 - 0.5
    ) * HOLE_PITCH_M  # fmt: skip
    texel_m = period_m / n
    hole = step(-from_middle.astype(np.float32), -HOLE_RADIUS_M - 0.7 * texel_m,
                -HOLE_RADIUS_M + 0.7 * texel_m)  # fmt: skip
    rim = np.exp(-(((from_middle - HOLE_RADIUS_M) / 5e-4) ** 2)).astype(np.float32)
    lines = fine(rng, n, 140.0) if black else _scratches(rng, n)
    plate = shaded(rng, (66, 67, 70) if black else (204, 204, 202), 4.0)
    color = plate + (3.0 * lines)[..., None] + (22.0 * rim)[..., None]
    color = mixed(color.astype(np.float32), (12, 12, 13), hole)
    height = (-4e-4 * step(-from_middle.astype(np.float32), -0.0042, -0.0030)).astype(np.float32)
    return Material(
        base_color=(1.0, 1.0, 1.0),
        base_color_image=image8(color),
        roughness=float(rng.uniform(0.4, 0.6)),
        roughness_image=grey8(np.clip(0.8 + 0.05 * lines + 0.2 * hole, 0, 1)),
        metallic=1.0,
        normal_image=normals8(height, period_m),
        period_m=period_m,
        name="optical table",
    )
