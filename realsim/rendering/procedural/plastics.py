"""Plastics, rubber and carbon fibre."""

import numpy as np

from realsim.rendering.appearance import Material
from realsim.rendering.procedural.noise import fine, fractal, grid, smooth, step
from realsim.rendering.procedural.texels import (
    grey8,
    hsv_tint,
    image8,
    mixed,
    normals8,
    random_tint,
    shaded,
)

PLASTIC_PX = 256
"""Even materials need few texels."""
WEAVE_PX = 512


def _plastic_tint(rng: np.random.Generator) -> tuple[float, float, float]:
    """Return a colour of moulded parts: mostly bright, sometimes white, grey or black."""
    if rng.random() < 0.3:
        return hsv_tint(rng.random(), rng.uniform(0.0, 0.08), rng.uniform(0.15, 0.95))
    return random_tint(rng, (0.5, 0.92), (0.4, 0.95))


def glossy_plastic(rng: np.random.Generator) -> Material:
    """Return glossy plastic: one colour, slight flow marks, the shine of a polished mould."""
    n, period_m = PLASTIC_PX, 0.12
    color = np.asarray(_plastic_tint(rng), np.float32) + (0.9 * fractal(rng, n, 1.8))[..., None]
    smudge = step(fractal(rng, n, 1.4), 0.2, 2.0)
    return Material(
        base_color=(1.0, 1.0, 1.0),
        base_color_image=image8(color),
        roughness=float(rng.uniform(0.14, 0.3)),
        roughness_image=grey8(0.72 + 0.28 * smudge),
        normal_image=normals8((1.6e-5 * smooth(rng, n, 4.0)).astype(np.float32), period_m),
        period_m=period_m,
        name="glossy plastic",
    )


def matte_plastic(rng: np.random.Generator) -> Material:
    """Return matte plastic: the fine grain of an eroded mould."""
    n, period_m = WEAVE_PX, 0.08
    grain = fine(rng, n, 90.0)
    color = np.asarray(_plastic_tint(rng), np.float32) + (1.5 * grain)[..., None]
    return Material(
        base_color=(1.0, 1.0, 1.0),
        base_color_image=image8(color),
        roughness=float(rng.uniform(0.5, 0.8)),
        normal_image=normals8((1.1e-5 * grain).astype(np.float32), period_m),
        period_m=period_m,
        name="matte plastic",
    )


def printed_plastic(rng: np.random.Generator) -> Material:
    """Return a part off a 3D printer: layers along u, 0.2 mm each."""
    n, layers = WEAVE_PX, 64
    period_m = layers * 2e-4
    _, v = grid(n)
    wobble = 0.06 * smooth(rng, n, 6.0, 24.0)
    ridge = np.abs(np.sin(np.pi * (layers * v + wobble))).astype(np.float32)
    color = np.asarray(_plastic_tint(rng), np.float32) * (0.9 + 0.1 * ridge)[..., None]
    color += (1.5 * smooth(rng, n, 3.0, 40.0))[..., None]
    return Material(
        base_color=(1.0, 1.0, 1.0),
        base_color_image=image8(color),
        roughness=float(rng.uniform(0.3, 0.5)),
        normal_image=normals8((3.5e-5 * np.sqrt(ridge)).astype(np.float32), period_m),
        period_m=period_m,
        name="3D-printed plastic",
    )


def rubber(rng: np.random.Generator) -> Material:
    """Return rubber: dark, dull, dusty."""
    n, period_m = WEAVE_PX, 0.12
    dark = rng.random() < 0.7
    tint = (44, 44, 46) if dark else random_tint(rng, (0.4, 0.7), (0.35, 0.6))
    grain = fine(rng, n, 70.0)
    dust = step(fractal(rng, n, 1.0), 0.4, 3.0)
    color = mixed(shaded(rng, tint, 5.0) + (1.5 * grain)[..., None], (126, 122, 116), 0.35 * dust)
    return Material(
        base_color=(1.0, 1.0, 1.0),
        base_color_image=image8(color),
        roughness=float(rng.uniform(0.75, 0.98)),
        normal_image=normals8((1.6e-5 * grain).astype(np.float32), period_m),
        period_m=period_m,
        name="rubber",
    )


def carbon(rng: np.random.Generator) -> Material:
    """Return carbon fibre under clear resin: a 2/2 twill whose tows shine in turn."""
    n, tows = WEAVE_PX, 32
    period_m = tows * 2e-3
    u, v = grid(n)
    column, row = np.floor(u * tows).astype(int), np.floor(v * tows).astype(int)
    warp = (column - row) % 4 < 2
    across_u, across_v = (u * tows) % 1.0 - 0.5, (v * tows) % 1.0 - 0.5
    across = np.where(warp, np.broadcast_to(across_u, (n, n)), np.broadcast_to(across_v, (n, n)))
    along_u = smooth(rng, n, 4.0, 240.0)
    fibres = np.where(warp, along_u.T, along_u).astype(np.float32)
    tone = np.where(warp, 46.0, 27.0) + 5.0 * fibres - 60.0 * across.astype(np.float32) ** 2
    color = tone[..., None] * np.asarray((0.97, 1.0, 1.04), np.float32)
    height = (-1.6e-4 * across.astype(np.float32) ** 2).astype(np.float32)
    return Material(
        base_color=(1.0, 1.0, 1.0),
        base_color_image=image8(np.maximum(color, 6.0).astype(np.float32)),
        roughness=float(rng.uniform(0.12, 0.35)),
        roughness_image=grey8(np.where(warp, 0.8, 1.0).astype(np.float32)),
        normal_image=normals8(height, period_m),
        period_m=period_m,
        name="carbon fibre",
    )


def cutting_mat(rng: np.random.Generator) -> Material:
    """Return a cutting mat: green, blue or grey, with a printed grid of 1 and 5 cm."""
    n, period_m = WEAVE_PX * 2, 0.2
    grounds = ((38, 104, 82), (40, 74, 118), (70, 72, 76))
    ground = shaded(rng, grounds[int(rng.integers(len(grounds)))], 5.0)
    u, v = grid(n)
    share = np.zeros((n, n), np.float32)
    for per_side, width_m, ink in ((20, 3e-4, 0.5), (4, 6e-4, 0.85)):
        half = width_m * per_side / period_m / 2
        soft = per_side / n / 2
        for x in (u, v):
            away = np.abs((x * per_side) % 1.0 - 0.5)
            line = step(-away.astype(np.float32), -half - soft, -half + soft)
            share = np.maximum(share, ink * np.broadcast_to(line, (n, n)))
    grain = fine(rng, n, 160.0)
    color = mixed(ground + (1.8 * grain)[..., None], (206, 208, 168), share)
    return Material(
        base_color=(1.0, 1.0, 1.0),
        base_color_image=image8(color),
        roughness=float(rng.uniform(0.55, 0.8)),
        normal_image=normals8((1.5e-5 * grain).astype(np.float32), period_m),
        period_m=period_m,
        name="cutting mat",
    )
