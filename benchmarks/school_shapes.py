"""Objects of the school's benchmark: ten kinds, in metres, that cut into 16 to 32 convex parts.

Hollow and toothed ones, because their parts are what costs time: a mug with a handle, vessels with
thin walls, rings, pipes, a gear. All are coarsely faceted, as collision meshes
are, so that the parts fill them well.
"""

from collections.abc import Callable, Sequence

import numpy as np
from scale_shapes import welded

from realsim.arrays import Array
from realsim.geometry import parts_solids as solids
from realsim.geometry.parts import part
from realsim.records import Mesh

FACETS = 16
"""Around a turned shape."""
FEWER = 12
"""Around those with slanted or bent walls, which fall into more parts."""


def _turned(profile: Sequence[Sequence[float]], facets: int = FACETS) -> Mesh:
    """Return the body that a profile (N, 2) of r and z [m] sweeps about z."""
    return welded([solids.revolve(profile, facets)])


def mug() -> Mesh:
    """Return a mug of 70 x 90 mm, wall 5 mm, with a handle of 14 x 9 mm that is square in outline.

    A facet's windows at two heights are left out of the wall, and the handle joins them.
    """
    radius, wall, upper, lower, thick = 0.035, 0.005, 0.068, 0.026, 0.009
    rows = [lower - thick / 2, lower + thick / 2, upper - thick / 2, upper + thick / 2]
    outside = [[radius, z] for z in (0.0, *rows, 0.09)]
    inside = [[radius - wall, 0.09], [radius - wall, wall], [0.0, wall]]
    body = solids.revolve([[0.0, 0.0], *outside, *inside], FACETS)
    middle = body.mean(axis=1)
    first_facet = (np.arctan2(middle[:, 1], middle[:, 0]) % (2 * np.pi)) < 2 * np.pi / FACETS
    out = np.hypot(body[..., 0], body[..., 1]).min(axis=1) > radius - 1e-6
    z = middle[:, 2]
    window = ((z > rows[0]) & (z < rows[1])) | ((z > rows[2]) & (z < rows[3]))
    return welded([body[~(first_facet & out & window)], _handle(radius, upper, lower, thick)])


def _handle(radius: float, upper: float, lower: float, thick: float) -> Array:
    """Return the handle (F, 3, 3): out of the upper window, down, and into the lower one [m]."""
    sides = solids.circle(radius, FACETS)[:2]
    across = sides[1] - sides[0]
    away = np.array([across[1], -across[0]]) / np.linalg.norm(across)
    out, h = 0.026, thick / 2
    # Outline of the handle seen from the side, as (distance from the wall, height): outer, inner.
    outline = [
        ((0.0, upper + h), (0.0, upper - h)),
        ((out + h, upper + h), (out - h, upper - h)),
        ((out + h, lower - h), (out - h, lower + h)),
        ((0.0, lower - h), (0.0, lower + h)),
    ]
    rings: list[Array] = []
    for outer, inner in outline:
        corners = [(sides[0], outer), (sides[0], inner), (sides[1], inner), (sides[1], outer)]
        rings.append(np.array([[*(s + d * away), z] for s, (d, z) in corners]))
    return solids.sweep(rings)


def cup() -> Mesh:
    """Return a cup of 72 x 90 mm that widens upwards, wall 4 mm."""
    return _turned([[0.0, 0.0], [0.027, 0.0], [0.036, 0.09], [0.032, 0.09], [0.0235, 0.005],
                    [0.0, 0.005]])  # fmt: skip


def bowl() -> Mesh:
    """Return a bowl of 130 x 45 mm, wall 6 mm."""
    return _turned([[0.0, 0.0], [0.03, 0.0], [0.065, 0.045], [0.0574, 0.045], [0.0275, 0.006],
                    [0.0, 0.006]], FEWER)  # fmt: skip


def bottle() -> Mesh:
    """Return an empty bottle without its cap: 62 x 140 mm, neck 36 mm, wall 8 mm."""
    return _turned([[0.0, 0.0], [0.031, 0.0], [0.031, 0.09], [0.018, 0.11], [0.018, 0.14],
                    [0.011, 0.14], [0.011, 0.106], [0.023, 0.086], [0.023, 0.006],
                    [0.0, 0.006]], FEWER)  # fmt: skip


def pipe() -> Mesh:
    """Return a piece of pipe of 50 x 110 mm, wall 6 mm."""
    r, wall, h = 0.025, 0.006, 0.11
    return _turned([[r - wall, h], [r - wall, 0.0], [r, 0.0], [r, h], [r - wall, h]])


def ring() -> Mesh:
    """Return a bearing ring of 96 x 24 mm, bore 60 mm."""
    return _turned([[0.03, 0.024], [0.03, 0.0], [0.048, 0.0], [0.048, 0.024], [0.03, 0.024]])


def pulley() -> Mesh:
    """Return a V-belt pulley of 72 x 26 mm, bore 16 mm."""
    return _turned([[0.008, 0.026], [0.008, 0.0], [0.036, 0.0], [0.036, 0.005], [0.026, 0.011],
                    [0.026, 0.015], [0.036, 0.021], [0.036, 0.026], [0.008, 0.026]])  # fmt: skip


def flange() -> Mesh:
    """Return a pipe flange of 90 mm with a collar of 44 mm, 36 mm high, bore 26 mm."""
    return _turned([[0.013, 0.036], [0.013, 0.0], [0.045, 0.0], [0.045, 0.012], [0.022, 0.012],
                    [0.022, 0.036], [0.013, 0.036]])  # fmt: skip


def elbow() -> Mesh:
    """Return a square duct of 40 mm, wall 6 mm, bent by 90 degrees."""
    outside, inside = solids.rectangle(0.04, 0.04), solids.rectangle(0.028, 0.028)
    turns = np.linspace(0.0, np.pi / 2, 5)
    bend, straight = 0.045, 0.03

    def ring_at(turn: float, ahead: float, section: Array) -> Array:
        along = np.array([np.cos(turn), 0.0, -np.sin(turn)])
        out = np.array([np.sin(turn), 0.0, np.cos(turn)])
        return bend * out + ahead * along + section[:, :1] * [0.0, 1.0, 0.0] + section[:, 1:] * out

    steps = [(0.0, -straight), *((t, 0.0) for t in turns), (np.pi / 2, straight)]
    shell = [ring_at(t, s, outside) for t, s in steps]
    hollow = [ring_at(t, s, inside) for t, s in steps]
    return welded([solids.sweep([*shell, *hollow[::-1], shell[0]])])


def gear() -> Mesh:
    """Return the shipped spur gear, 76 mm."""
    return part("gear").mesh


SHAPES: dict[str, Callable[[], Mesh]] = {
    "mug": mug,
    "cup": cup,
    "bowl": bowl,
    "bottle": bottle,
    "pipe": pipe,
    "ring": ring,
    "pulley": pulley,
    "flange": flange,
    "gear": gear,
    "elbow": elbow,
}
