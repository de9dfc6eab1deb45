"""The parts that are cut from a plate or a bar: outlines pushed along z, painted face by face."""

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from realsim.arrays import Array
from realsim.geometry import parts_solids as solids
from realsim.geometry import se3

Color = tuple[int, int, int]


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class PartShape:
    """A part before it becomes a model: its surface, its symmetries, its paint."""

    pieces: Sequence[Array]
    """Loose triangles (F, 3, 3) that weld to a closed surface [m]."""
    bands: Sequence[tuple[float, Color]]
    """(upper height [m], RGB) from bottom to top: every vertex takes the first band it is under."""
    symmetries: Array = field(default_factory=lambda: np.eye(4)[None])
    """(S, 4, 4) the discrete rotations that map the surface onto itself, the identity first."""
    turns_about_z: bool = False
    """Whether every turn about z is a symmetry."""


def cyclic(n: int, axis: Sequence[float] = (0.0, 0.0, 1.0)) -> Array:
    """Return the n turns (n, 4, 4) about an axis through the origin."""
    angles = 2 * np.pi * np.arange(n) / n
    return se3.from_rt(se3.exp_so3(angles[:, None] * np.asarray(axis)), np.zeros(3))


def dihedral(n: int) -> Array:
    """Return the 2n rotations (2n, 4, 4) of a regular prism: n turns about z, each also flipped."""
    flip = cyclic(2, (1.0, 0.0, 0.0))
    return np.concatenate([cyclic(n), cyclic(n) @ flip[1]])


def cube_rotations() -> Array:
    """Return the 24 rotations (24, 4, 4) of a cube: signed permutations of the axes."""
    quarter = np.round(se3.exp_so3([0.0, 0.0, np.pi / 2])), np.round(se3.exp_so3([np.pi / 2, 0, 0]))
    found: list[Array] = [np.eye(3)]
    for R in found:  # grows while it is read: the group closes at 24
        for q in quarter:
            if not any(np.array_equal(q @ R, other) for other in found):
                found.append(q @ R)
    return se3.from_rt(np.array(found), np.zeros(3))


def _sided(height: float, chamfer: float, side: Color, face: Color) -> list[tuple[float, Color]]:
    """Return bands that paint the two flat faces of a prism unlike its sides."""
    rim = height / 2 - chamfer / 2
    return [(-rim, face), (rim, side), (np.inf, face)]


def _prism(outline: Array, height: float, holes: Sequence[Array] = (), chamfer: float = 0.0,
           bands: Sequence[float] = ()) -> list[Array]:  # fmt: skip
    h = height / 2
    return [solids.extrude(outline, -h, h, holes, chamfer=chamfer, bands=bands)]


def box() -> PartShape:
    """Return a carton of 66 x 42 x 104 mm with two printed bands."""
    edges = -0.026, -0.018, 0.024, 0.03
    card, teal, white = (176, 137, 92), (31, 122, 122), (232, 228, 216)
    return PartShape(
        pieces=_prism(solids.rectangle(0.066, 0.042), 0.104, bands=edges),
        bands=list(zip((*edges, np.inf), (card, teal, white, teal, card), strict=True)),
        symmetries=dihedral(2),
    )


def cube() -> PartShape:
    """Return a cube of 50 mm in three stripes."""
    edges = -0.0085, 0.0085
    plum = (126, 58, 104)
    return PartShape(
        pieces=_prism(solids.rectangle(0.05, 0.05), 0.05, bands=edges),
        bands=list(zip((*edges, np.inf), (plum, (226, 200, 168), plum), strict=True)),
        symmetries=cube_rotations(),
    )


def hex_nut() -> PartShape:
    """Return a hexagon nut, 52 mm across flats, 26 mm high, bore 28 mm."""
    outline = solids.circle(0.026 / np.cos(np.pi / 6), 6)
    bore = solids.circle(0.014, 72)[::-1]
    return PartShape(
        pieces=_prism(outline, 0.026, [bore], 0.002),
        bands=_sided(0.026, 0.002, (98, 104, 112), (172, 176, 180)),
        symmetries=dihedral(6),
    )


def l_bracket() -> PartShape:
    """Return an angle bracket with legs of 84 and 56 mm, 12 mm thick, 40 mm wide."""
    long, short, t = 0.084, 0.056, 0.012
    outline = np.array([[0, 0], [long, 0], [long, t], [t, t], [t, short], [0, short]])
    return PartShape(
        pieces=_prism(outline - [long / 2, short / 2], 0.04, (), 0.0012),
        bands=_sided(0.04, 0.0012, (46, 98, 160), (120, 160, 205)),
    )


def t_profile() -> PartShape:
    """Return a piece of T bar: flange 70 mm, height 58 mm, 12 mm thick, 46 mm long."""
    w, h, t = 0.035, 0.029, 0.006
    top = h - 2 * t
    outline = np.array(
        [[-t, -h], [t, -h], [t, top], [w, top], [w, h], [-w, h], [-w, top], [-t, top]]
    )
    return PartShape(
        pieces=_prism(outline, 0.046, (), 0.0012),
        bands=_sided(0.046, 0.0012, (74, 124, 66), (160, 190, 120)),
        symmetries=cyclic(2, (0.0, 1.0, 0.0)),
    )


def u_channel() -> PartShape:
    """Return a piece of U channel: 52 x 40 mm, 8 mm thick, 72 mm long."""
    w, h, t = 0.026, 0.02, 0.008
    outline = np.array(
        [[-w, -h], [w, -h], [w, h], [w - t, h], [w - t, t - h], [t - w, t - h], [t - w, h], [-w, h]]
    )
    return PartShape(
        pieces=_prism(outline, 0.072, (), 0.001),
        bands=_sided(0.072, 0.001, (196, 112, 44), (228, 170, 110)),
        symmetries=cyclic(2, (0.0, 1.0, 0.0)),
    )


def wedge() -> PartShape:
    """Return a door wedge: 96 mm long, 44 mm high at the back, 36 mm wide."""
    outline = np.array([[-0.048, -0.022], [0.048, -0.022], [0.048, -0.016], [-0.048, 0.022]])
    return PartShape(
        pieces=_prism(outline, 0.036, (), 0.001),
        bands=_sided(0.036, 0.001, (206, 92, 70), (232, 148, 116)),
    )


def gear() -> PartShape:
    """Return a spur gear of 16 trapezoid teeth: tip diameter 76 mm, 22 mm wide, bore 20 mm."""
    teeth, root, tip = 16, 0.0305, 0.038
    # Half angles of a tooth at its foot and at its tip, as shares of the pitch.
    marks = np.array([-0.30, -0.14, 0.14, 0.30]) * 2 * np.pi / teeth
    radii = np.array([root, tip, tip, root])
    angles = (2 * np.pi * np.arange(teeth)[:, None] / teeth + marks).ravel()
    outline = np.stack([np.cos(angles), np.sin(angles)], -1) * np.tile(radii, teeth)[:, None]
    return PartShape(
        pieces=_prism(outline, 0.022, [solids.circle(0.01, 64)[::-1]], 0.0012),
        bands=_sided(0.022, 0.0012, (150, 118, 58), (214, 178, 96)),
        symmetries=dihedral(teeth),
    )


def _step(
    lower: tuple[Array, float], upper: tuple[Array, float], holes: Sequence[Array], bore: Array
) -> list[Array]:
    """Return a wide plate under a narrower boss: (outline, height [m]) each; z from 0.

    Args:
        lower: the plate; `holes` go through it alone.
        upper: the boss, whose outline lies inside the plate's, clear of the holes.
        holes: clockwise rings.
        bore: clockwise ring through both, or an empty array for none.
    """
    through = [bore] if len(bore) else []
    (wide, h0), (narrow, h1) = lower, upper
    top = h0 + h1
    pieces = [
        solids.cap(wide, [*holes, *through], 0.0, up=False),
        solids.wall(wide, 0.0, wide, h0),
        solids.cap(wide, [*holes, narrow[::-1]], h0, up=True),
        solids.wall(narrow, h0, narrow, top),
        solids.cap(narrow, through, top, up=True),
    ]
    pieces += [solids.wall(hole, 0.0, hole, h0) for hole in holes]
    pieces += [solids.wall(b, 0.0, b, top) for b in through]
    return pieces


def flange() -> PartShape:
    """Return a pipe flange of 92 mm with six bolt holes and a collar of 46 mm, 34 mm high."""
    angles = np.pi / 3 * np.arange(6)
    holes = [
        solids.circle(0.0048, 24, (0.0335 * np.cos(a), 0.0335 * np.sin(a)))[::-1] for a in angles
    ]
    bore = solids.circle(0.015, 72)[::-1]
    pieces = _step(
        (solids.circle(0.046, 96), 0.013), (solids.circle(0.023, 96), 0.021), holes, bore
    )
    return PartShape(
        pieces=[p - [0, 0, 0.017] for p in pieces],
        bands=[(-0.0041, (92, 112, 128)), (0.0168, (70, 86, 100)), (np.inf, (190, 198, 204))],
        symmetries=cyclic(6),
    )


def knob() -> PartShape:
    """Return a knob of five lobes (60 mm) on a stem of 26 mm, 46 mm high in all."""
    t = 2 * np.pi * np.arange(160) / 160
    lobes = solids.circle(1.0, 160) * (0.0268 + 0.0032 * np.cos(5 * t))[:, None]
    stem = solids.circle(0.013, 80)
    grip, foot, rim = 0.026, 0.02, 0.003
    pieces = [
        solids.cap(stem, [], 0.0, up=False),
        solids.wall(stem, 0.0, stem, foot),
        solids.cap(lobes, [stem[::-1]], foot, up=False),
        solids.wall(lobes, foot, lobes, foot + grip - rim),
        solids.wall(lobes, foot + grip - rim, solids.inset(lobes, rim), foot + grip),
        solids.cap(solids.inset(lobes, rim), [], foot + grip, up=True),
    ]
    return PartShape(
        pieces=[p - [0, 0, 0.023] for p in pieces],
        bands=[(-0.0031, (168, 172, 176)), (0.0215, (40, 42, 48)), (np.inf, (188, 44, 48))],
        symmetries=cyclic(5),
    )
