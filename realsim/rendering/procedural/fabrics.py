"""What is moulded, woven, tanned or pressed: plastics, rubber, cloth, leather, cork, cardboard."""

import numpy as np

from realsim.arrays import Array32
from realsim.rendering.appearance import Material
from realsim.rendering.procedural.noise import (
    Tint,
    blurred,
    cells,
    fine,
    finished,
    fractal,
    grid,
    hsv_tint,
    mixed,
    random_tint,
    shaded,
    smooth,
    step,
    warped,
)

CLOTH_PX = 768
PX = 512
EVEN_PX = 256
"""Even materials need few texels."""
MATS: tuple[Tint, ...] = ((38, 104, 82), (40, 74, 118), (70, 72, 76))
HIDES: tuple[Tint, ...] = (
    (92, 52, 32), (58, 38, 28), (140, 88, 50), (42, 40, 40), (120, 34, 30), (186, 158, 120),
)  # fmt: skip


def _moulded(rng: np.random.Generator) -> Array32:
    """Return a colour (3,) of moulded parts: mostly bright, sometimes white, grey or black."""
    if rng.random() < 0.3:
        tint = hsv_tint(rng.random(), rng.uniform(0.0, 0.08), rng.uniform(0.15, 0.95))
    else:
        tint = random_tint(rng, (0.5, 0.92), (0.4, 0.95))
    return np.asarray(tint, np.float32)


def glossy_plastic(rng: np.random.Generator) -> Material:
    """Return glossy plastic: one colour, slight flow marks, the shine of a polished mould."""
    n = EVEN_PX
    color = _moulded(rng) + (0.9 * fractal(rng, n, 1.8))[..., None]
    smudge = step(fractal(rng, n, 1.4), 0.2, 2.0)
    return finished(
        "glossy plastic", 0.12, color, rng.uniform(0.14, 0.3),
        gloss=0.72 + 0.28 * smudge, height_m=1.6e-5 * smooth(rng, n, 4.0),
    )  # fmt: skip


def matte_plastic(rng: np.random.Generator) -> Material:
    """Return matte plastic: the fine grain of an eroded mould."""
    grain = fine(rng, PX, 90.0)
    color = _moulded(rng) + (1.5 * grain)[..., None]
    return finished("matte plastic", 0.08, color, rng.uniform(0.5, 0.8), height_m=1.1e-5 * grain)


def printed_plastic(rng: np.random.Generator) -> Material:
    """Return a part off a 3D printer: layers along u, 0.2 mm each."""
    layers = 64
    _, v = grid(PX)
    wobble = 0.06 * smooth(rng, PX, 6.0, 24.0)
    ridge = np.abs(np.sin(np.pi * (layers * v + wobble))).astype(np.float32)
    color = _moulded(rng) * (0.9 + 0.1 * ridge)[..., None]
    color += (1.5 * smooth(rng, PX, 3.0, 40.0))[..., None]
    height = 3.5e-5 * np.sqrt(ridge)
    return finished(
        "3D-printed plastic", layers * 2e-4, color, rng.uniform(0.3, 0.5), height_m=height
    )


def rubber(rng: np.random.Generator) -> Material:
    """Return rubber: dark, dull, dusty."""
    dark = rng.random() < 0.7
    tint = (44, 44, 46) if dark else random_tint(rng, (0.4, 0.7), (0.35, 0.6))
    grain = fine(rng, PX, 70.0)
    dust = step(fractal(rng, PX, 1.0), 0.4, 3.0)
    color = mixed(shaded(rng, tint, 5.0) + (1.5 * grain)[..., None], (126, 122, 116), 0.35 * dust)
    return finished("rubber", 0.12, color, rng.uniform(0.75, 0.98), height_m=1.6e-5 * grain)


def carbon(rng: np.random.Generator) -> Material:
    """Return carbon fibre under clear resin: a 2/2 twill whose tows shine in turn."""
    n, tows = PX, 32
    u, v = grid(n)
    column, row = np.floor(u * tows).astype(int), np.floor(v * tows).astype(int)
    warp = (column - row) % 4 < 2
    across = np.where(warp, (u * tows) % 1.0 - 0.5, (v * tows) % 1.0 - 0.5).astype(np.float32)
    along_u = smooth(rng, n, 4.0, 240.0)
    fibres = np.where(warp, along_u.T, along_u).astype(np.float32)
    tone = np.where(warp, 46.0, 27.0) + 5.0 * fibres - 60.0 * across**2
    color = tone[..., None] * np.asarray((0.97, 1.0, 1.04), np.float32)
    return finished(
        "carbon fibre", tows * 2e-3, np.maximum(color, 6.0).astype(np.float32),
        rng.uniform(0.12, 0.35), gloss=np.where(warp, 0.8, 1.0).astype(np.float32),
        height_m=-1.6e-4 * across**2,
    )  # fmt: skip


def cutting_mat(rng: np.random.Generator) -> Material:
    """Return a cutting mat: green, blue or grey, with a printed grid of 1 and 5 cm."""
    n, period_m = 2 * PX, 0.2
    ground = shaded(rng, MATS[int(rng.integers(len(MATS)))], 5.0)
    share = np.zeros((n, n), np.float32)
    for per_side, width_m, ink in ((20, 3e-4, 0.5), (4, 6e-4, 0.85)):
        half = width_m * per_side / period_m / 2
        soft = per_side / n / 2
        for x in grid(n):
            away = np.abs((x * per_side) % 1.0 - 0.5)
            line = step(-away.astype(np.float32), -half - soft, -half + soft)
            share = np.maximum(share, ink * line)
    grain = fine(rng, n, 160.0)
    color = mixed(ground + (1.8 * grain)[..., None], (206, 208, 168), share)
    return finished("cutting mat", period_m, color, rng.uniform(0.55, 0.8), height_m=1.5e-5 * grain)


def _weave(rng: np.random.Generator, n: int, threads: int) -> tuple[Array32, Array32]:
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
    return over, np.where(over > 0, upright, lying).astype(np.float32)


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
    relief = 0.28 * period_m / threads * blurred(height, 1.0)
    return finished("woven fabric", period_m, color, rng.uniform(0.8, 1.0), height_m=relief)


def checked_cloth(rng: np.random.Generator) -> Material:
    """Return a checked table cloth: gingham, or a tartan of more stripes."""
    n, threads = CLOTH_PX, 96
    checks = int(rng.choice([2, 4, 6]))
    period_m = checks * float(rng.uniform(0.03, 0.06))
    over, height = _weave(rng, n, threads)
    ground = shaded(rng, (238, 235, 228), 5.0)
    dye = np.asarray(random_tint(rng, (0.5, 0.9), (0.3, 0.8)))
    # An eighth of a check off, so that no edge of a check lies on the edge of the tile.
    place = (np.arange(threads) * checks / threads + 0.125) % 1.0
    stripe = (place < 0.5).astype(np.float32)
    if rng.random() < 0.5:
        stripe[np.abs(place - 0.75) < 0.06] = 0.7
        stripe[np.abs(place - 0.25) < 0.06] = 0.25
    # Where two dyed yarns cross, the check is full; where one does, it is half.
    u, v = grid(n)
    along_v, along_u = (stripe[np.minimum((x * threads).astype(int), threads - 1)] for x in (u, v))
    share = np.where(over > 0, along_v, along_u).astype(np.float32)
    color = mixed(ground, dye, share) * (0.72 + 0.28 * height)[..., None]
    fold = fractal(rng, n, 2.2)
    relief = 0.2 * period_m / threads * blurred(height, 1.0) + 6e-4 * fold
    return finished("checked cloth", period_m, color, rng.uniform(0.8, 0.98), height_m=relief)


def leather(rng: np.random.Generator) -> Material:
    """Return leather: pebbles of skin between creases."""
    n, period_m = PX, float(rng.uniform(0.07, 0.12))
    cell, inside = cells(rng, n, 38, 1.0)
    bend = 0.004
    pebble = step(inside, 0.0, 0.34)
    pebble = warped(blurred(pebble, 1.2), bend * smooth(rng, n, 24.0), bend * smooth(rng, n, 24.0))
    tint = shaded(rng, HIDES[int(rng.integers(len(HIDES)))], 6.0)
    patch = rng.normal(0, 2.0, 38 * 38).astype(np.float32)[cell]
    tone = 5.0 * fractal(rng, n, 1.6) + blurred(patch, 1.5) + 1.2 * fine(rng, n, 140.0)
    color = tint * (0.66 + 0.34 * pebble)[..., None] + tone[..., None]
    height = 1.1e-4 * pebble + 3e-5 * fractal(rng, n, 1.5, 4.0)
    return finished(
        "leather", period_m, color, rng.uniform(0.5, 0.8), gloss=1.0 - 0.3 * pebble, height_m=height
    )


def cork(rng: np.random.Generator) -> Material:
    """Return pressed cork: granules of bark in two sizes, dark specks between."""
    n, period_m = PX, float(rng.uniform(0.12, 0.2))
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
    relief = 1.1e-4 * (height - speck)
    return finished("cork", period_m, color, rng.uniform(0.85, 1.0), height_m=relief)


def cardboard(rng: np.random.Generator) -> Material:
    """Return corrugated cardboard: brown fibres, the flutes showing faintly through."""
    n, flutes = PX, 24
    period_m = flutes * float(rng.uniform(5e-3, 8e-3))
    u, _ = grid(n)
    flute = np.broadcast_to(np.sin(2 * np.pi * flutes * u), (n, n)).astype(np.float32)
    fibre = 0.7 * smooth(rng, n, 14.0, 130.0) + 0.7 * smooth(rng, n, 90.0, 90.0)
    dark = step(smooth(rng, n, 40.0, 150.0), 2.2, 3.2)
    tint = shaded(rng, (184, 143, 100), 8.0)
    tone = 1.6 * flute + 3.4 * fibre + 4.0 * fractal(rng, n, 1.6)
    color = mixed(tint + tone[..., None], (112, 80, 52), 0.6 * dark)
    relief = 2.2e-5 * flute + 6e-6 * fibre
    return finished("cardboard", period_m, color, rng.uniform(0.8, 0.95), height_m=relief)


def carpet(rng: np.random.Generator) -> Material:
    """Return a looped carpet: tufts of mottled yarn."""
    n, period_m, per_side = PX, float(rng.uniform(0.3, 0.5)), 96
    cell, inside = cells(rng, n, per_side, 0.7)
    tint = shaded(rng, random_tint(rng, (0.03, 0.4), (0.25, 0.65)), 5.0)
    tone = rng.normal(0, 9.0, per_side**2).astype(np.float32)[cell]
    loop = step(inside, 0.0, 0.4)
    color = (tint + (tone + 5.0 * fractal(rng, n, 1.2))[..., None]) * (0.5 + 0.5 * loop)[..., None]
    return finished("carpet", period_m, color, 1.0, height_m=1.2e-3 * blurred(loop, 1.0))
