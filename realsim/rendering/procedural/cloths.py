"""What is woven, tanned or pressed: cloth, leather, cork, cardboard, carpet."""

import numpy as np

from realsim.rendering.appearance import Material
from realsim.rendering.procedural.noise import (
    Field,
    blurred,
    cells,
    fine,
    fractal,
    grid,
    smooth,
    step,
    warped,
)
from realsim.rendering.procedural.texels import (
    grey8,
    image8,
    mixed,
    normals8,
    random_tint,
    shaded,
)

CLOTH_PX = 768
SKIN_PX = 512


def _weave(rng: np.random.Generator, n: int, threads: int) -> tuple[Field, Field]:
    """Return a plain weave: 1 where the thread along v lies on top (n, n), and the height (n, n).

    Height is in widths of a thread, from 0 in the gaps to 1 on the crowns.
    """
    u, v = grid(n)
    sway_u, sway_v = 0.12 * smooth(rng, n, 3.0, 30.0), 0.12 * smooth(rng, n, 30.0, 3.0)
    x, y = u * threads + sway_v, v * threads + sway_u
    over = ((np.floor(x) + np.floor(y)) % 2).astype(np.float32)
    across_x, across_y = np.sin(np.pi * (x % 1.0)), np.sin(np.pi * (y % 1.0))
    # A thread is round across and arched along, down to where it dives under the next.
    upright = np.sqrt(across_x) * (0.35 + 0.65 * across_y)
    lying = np.sqrt(across_y) * (0.35 + 0.65 * across_x)
    height = np.where(over > 0, upright, lying).astype(np.float32)
    return over, height


def woven_fabric(rng: np.random.Generator) -> Material:
    """Return woven cloth of two yarns, warp and weft."""
    n, threads = CLOTH_PX, int(rng.integers(30, 46)) * 2
    period_m = threads * float(rng.uniform(0.9e-3, 1.6e-3))
    over, height = _weave(rng, n, threads)
    warp = np.asarray(random_tint(rng, (0.05, 0.6), (0.3, 0.9)))
    weft = np.clip(warp + rng.normal(0, 22.0) + rng.normal(0, 8.0, 3), 15, 245)
    slub = np.where(over > 0, smooth(rng, n, 90.0, 5.0), smooth(rng, n, 5.0, 90.0))
    color = mixed(weft, warp, over) * (0.42 + 0.58 * height)[..., None]
    color += (6.0 * slub)[..., None]
    return Material(
        base_color=(1.0, 1.0, 1.0),
        base_color_image=image8(color),
        roughness=float(rng.uniform(0.8, 1.0)),
        normal_image=normals8(
            (0.28 * period_m / threads * blurred(height, 1.0)).astype(np.float32), period_m
        ),
        period_m=period_m,
        name="woven fabric",
    )


def checked_cloth(rng: np.random.Generator) -> Material:
    """Return a checked table cloth: gingham, or a tartan of more stripes."""
    n, threads = CLOTH_PX, 96
    checks = int(rng.choice([2, 4, 6]))
    period_m = checks * float(rng.uniform(0.03, 0.06))
    over, height = _weave(rng, n, threads)
    ground = shaded(rng, (238, 235, 228), 5.0)
    dye = np.asarray(random_tint(rng, (0.5, 0.9), (0.3, 0.8)))
    stripe = np.zeros(threads, np.float32)
    # An eighth of a check off, so that no edge of a check lies on the edge of the tile.
    place = (np.arange(threads) * checks / threads + 0.125) % 1.0
    stripe[place < 0.5] = 1.0
    if rng.random() < 0.5:
        stripe[np.abs(place - 0.75) < 0.06] = 0.7
        stripe[np.abs(place - 0.25) < 0.06] = 0.25
    u, v = grid(n)
    along_v = stripe[np.minimum((u * threads).astype(int), threads - 1)]
    along_u = stripe[np.minimum((v * threads).astype(int), threads - 1)]
    # Where two dyed yarns cross, the check is full; where one does, it is half.
    share = np.where(over > 0, np.broadcast_to(along_v, (n, n)), np.broadcast_to(along_u, (n, n)))
    color = mixed(ground, dye, share.astype(np.float32)) * (0.72 + 0.28 * height)[..., None]
    fold = fractal(rng, n, 2.2)
    relief = 0.2 * period_m / threads * blurred(height, 1.0) + 6e-4 * fold
    return Material(
        base_color=(1.0, 1.0, 1.0),
        base_color_image=image8(color),
        roughness=float(rng.uniform(0.8, 0.98)),
        normal_image=normals8(relief.astype(np.float32), period_m),
        period_m=period_m,
        name="checked cloth",
    )


def leather(rng: np.random.Generator) -> Material:
    """Return leather: pebbles of skin between creases."""
    n, period_m = SKIN_PX, float(rng.uniform(0.07, 0.12))
    cell, inside = cells(rng, n, 38, 1.0)
    bend = 0.004
    pebble = step(inside, 0.0, 0.34)
    pebble = warped(blurred(pebble, 1.2), bend * smooth(rng, n, 24.0), bend * smooth(rng, n, 24.0))
    tints = (
        (92, 52, 32),
        (58, 38, 28),
        (140, 88, 50),
        (42, 40, 40),
        (120, 34, 30),
        (186, 158, 120),
    )
    tint = shaded(rng, tints[int(rng.integers(len(tints)))], 6.0)
    patch = rng.normal(0, 2.0, 38 * 38).astype(np.float32)[cell]
    tone = 5.0 * fractal(rng, n, 1.6) + blurred(patch, 1.5) + 1.2 * fine(rng, n, 140.0)
    color = tint * (0.66 + 0.34 * pebble)[..., None] + tone[..., None]
    height = (1.1e-4 * pebble + 3e-5 * fractal(rng, n, 1.5, 4.0)).astype(np.float32)
    return Material(
        base_color=(1.0, 1.0, 1.0),
        base_color_image=image8(color),
        roughness=float(rng.uniform(0.5, 0.8)),
        roughness_image=grey8(1.0 - 0.3 * pebble),
        normal_image=normals8(height, period_m),
        period_m=period_m,
        name="leather",
    )


def cork(rng: np.random.Generator) -> Material:
    """Return pressed cork: granules of bark in two sizes, dark specks between."""
    n, period_m = SKIN_PX, float(rng.uniform(0.12, 0.2))
    color = np.zeros((n, n, 3), np.float32)
    height = np.zeros((n, n), np.float32)
    for per_side, weight in ((34, 1.0), (84, 0.45)):
        cell, inside = cells(rng, n, per_side, 1.0)
        tone = rng.normal(0, 1.0, per_side**2).astype(np.float32)[cell]
        layer = mixed((150, 102, 62), (206, 162, 112), 0.55 + 0.24 * tone)
        layer *= (0.80 + 0.20 * step(inside, 0.0, 0.22))[..., None]
        color += weight * (layer - color)
        height += weight * (0.5 * step(inside, 0.0, 0.3) + 0.15 * tone)
    speck = step(fractal(rng, n, 0.7, 20.0), 1.7, 2.6)
    color = mixed(color, (76, 46, 28), 0.8 * speck) + (4.0 * fine(rng, n, 150.0))[..., None]
    return Material(
        base_color=(1.0, 1.0, 1.0),
        base_color_image=image8(color),
        roughness=float(rng.uniform(0.85, 1.0)),
        normal_image=normals8((1.1e-4 * (height - speck)).astype(np.float32), period_m),
        period_m=period_m,
        name="cork",
    )


def cardboard(rng: np.random.Generator) -> Material:
    """Return corrugated cardboard: brown fibres, the flutes showing faintly through."""
    n, flutes = SKIN_PX, 24
    period_m = flutes * float(rng.uniform(5e-3, 8e-3))
    u, _ = grid(n)
    flute = np.broadcast_to(np.sin(2 * np.pi * flutes * u), (n, n)).astype(np.float32)
    fibre = 0.7 * smooth(rng, n, 14.0, 130.0) + 0.7 * smooth(rng, n, 90.0, 90.0)
    dark = step(smooth(rng, n, 40.0, 150.0), 2.2, 3.2)
    tint = shaded(rng, (184, 143, 100), 8.0)
    tone = 1.6 * flute + 3.4 * fibre + 4.0 * fractal(rng, n, 1.6)
    color = mixed(tint + tone[..., None], (112, 80, 52), 0.6 * dark)
    height = (2.2e-5 * flute + 6e-6 * fibre).astype(np.float32)
    return Material(
        base_color=(1.0, 1.0, 1.0),
        base_color_image=image8(color),
        roughness=float(rng.uniform(0.8, 0.95)),
        normal_image=normals8(height, period_m),
        period_m=period_m,
        name="cardboard",
    )


def carpet(rng: np.random.Generator) -> Material:
    """Return a looped carpet: tufts of mottled yarn."""
    n, period_m = SKIN_PX, float(rng.uniform(0.3, 0.5))
    per_side = 96
    cell, inside = cells(rng, n, per_side, 0.7)
    tint = shaded(rng, random_tint(rng, (0.03, 0.4), (0.25, 0.65)), 5.0)
    tone = rng.normal(0, 9.0, per_side**2).astype(np.float32)[cell]
    loop = step(inside, 0.0, 0.4)
    color = (tint + (tone + 5.0 * fractal(rng, n, 1.2))[..., None]) * (0.5 + 0.5 * loop)[..., None]
    height = (1.2e-3 * blurred(loop, 1.0)).astype(np.float32)
    return Material(
        base_color=(1.0, 1.0, 1.0),
        base_color_image=image8(color),
        roughness=1.0,
        normal_image=normals8(height, period_m),
        period_m=period_m,
        name="carpet",
    )
