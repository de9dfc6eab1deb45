"""The CAD parts that ship with the package, as object models at metric scale.

Each is a watertight, painted mesh in metres with its exact symmetries, 4 to 16 cm long, most of
them graspable by an 80 mm gripper. The ids are fixed for ever: a stored scene names them.

The parts that are turned on a lathe or bent from a tube: profiles swept about z or a path.
"""

import importlib.util
from collections.abc import Callable, Sequence
from functools import cache
from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from realsim.arrays import Array
from realsim.errors import InputError, MissingLibraryError
from realsim.geometry import parts_prismatic as prismatic
from realsim.geometry import parts_solids as solids
from realsim.geometry.parts_prismatic import Color, PartShape, cyclic
from realsim.geometry.parts_solids import weld
from realsim.records import Mesh, ObjectModel

FACETS = 96
"""Facets around a turned part: 0.02 mm off the circle at a radius of 38 mm."""


def _turned(
    profile: ArrayLike, edges: tuple[float, ...], colors: tuple[Color, ...], *, flips: bool = False
) -> PartShape:
    """Return a turned part whose paint changes at the heights `edges` [m]."""
    cut = solids.cut_profile(profile, edges)
    return PartShape(
        pieces=[solids.revolve(cut, FACETS)],
        bands=list(zip((*edges, np.inf), colors, strict=True)),
        symmetries=cyclic(2, (1.0, 0.0, 0.0)) if flips else np.eye(4)[None],
        turns_about_z=True,
    )


def cylinder_can() -> PartShape:
    """Return a drinks can of 66 x 104 mm with sunken lids and a printed label."""
    r, h, rim, sink = 0.033, 0.052, 0.0028, 0.004
    half = [[0.0, h - sink], [r - 3 * rim, h - sink], [r - 2 * rim, h], [r - rim, h], [r, h - rim]]
    lower = [[a, -z] for a, z in half]
    steel, red, cream = (178, 182, 186), (178, 34, 42), (240, 230, 208)
    return _turned(
        [*lower, *half[::-1]],
        (-0.046, -0.012, 0.012, 0.046),
        (steel, red, cream, red, steel),
        flips=True,
    )


def tube() -> PartShape:
    """Return a piece of pipe, 56 x 84 mm, wall 7 mm."""
    outer, inner, h, c = 0.028, 0.021, 0.042, 0.001
    ring = [[inner, h - c], [inner, c - h], [inner + c, -h], [outer - c, -h], [outer, c - h],
            [outer, h - c], [outer - c, h], [inner + c, h], [inner, h - c]]  # fmt: skip
    grey, blue = (206, 208, 204), (38, 92, 146)
    return _turned(ring, (-0.007, 0.007), (grey, blue, grey), flips=True)


def capsule() -> PartShape:
    """Return a two-coloured capsule of 40 x 92 mm."""
    r, straight = 0.02, 0.026
    lower = solids.arc((0.0, -straight), r, -np.pi / 2, 0.0, 20)
    upper = solids.arc((0.0, straight), r, 0.0, np.pi / 2, 20)
    profile = np.concatenate([lower, upper])
    profile[[0, -1], 0] = 0.0
    return _turned(profile, (0.0,), ((236, 232, 222), (220, 96, 40)), flips=True)


def bottle() -> PartShape:
    """Return a bottle of 60 x 158 mm with shoulder, neck and cap."""
    s = np.linspace(0, 1, 17)
    shoulder = np.stack([0.03 + (0.0125 - 0.03) * s * s * (3 - 2 * s), 0.03 + 0.03 * s], -1)
    foot = solids.arc((0.026, -0.075), 0.004, -np.pi / 2, 0.0, 6)
    top = [[0.0125, 0.064], [0.0155, 0.0645], [0.0155, 0.0775], [0.014, 0.079], [0.0, 0.079]]
    profile = np.concatenate([[[0.0, -0.079]], foot, shoulder, top])
    green, label = (44, 112, 74), (238, 222, 170)
    return _turned(profile, (-0.05, 0.012, 0.0642), (green, label, green, (224, 224, 220)))


def bowl() -> PartShape:
    """Return a bowl of 128 x 50 mm, wall 4 mm, on a foot ring."""
    center, outer, wall = (0.0, 0.045), 0.068, 0.004
    low, high = np.radians(-62), np.radians(-16.5)
    outside = solids.arc(center, outer, low, high, 28)
    floor = outside[0, 1] - 0.002
    bottom = -np.arccos((center[1] - floor) / (outer - wall)) - np.pi / 2
    inside = solids.arc(center, outer - wall, high, -np.pi - bottom, 28)
    foot = np.array([[0.0, floor - wall], [outside[0, 0], floor - wall]])
    profile = np.concatenate([foot, outside, inside, [[0.0, floor]]])
    profile[:, 1] -= (profile[:, 1].min() + profile[:, 1].max()) / 2
    sand, indigo = (222, 204, 176), (52, 62, 120)
    return _turned(profile, (-0.012, 0.016), (sand, indigo, sand))


def pulley() -> PartShape:
    """Return a V-belt pulley of 80 x 26 mm, bore 18 mm."""
    r, groove, bore, h, v = 0.04, 0.029, 0.009, 0.013, 0.0095
    ring = [[bore, h], [bore, -h], [0.018, -h], [0.019, -v], [0.032, -v], [0.033, -h], [r, -h],
            [r, -v], [groove, -0.003], [groove, 0.003], [r, v], [r, h], [0.033, h], [0.032, v],
            [0.019, v], [0.018, h], [bore, h]]  # fmt: skip
    alloy, dark = (186, 190, 196), (84, 88, 96)
    return _turned(ring, (-0.0092, 0.0092), (alloy, dark, alloy), flips=True)


def stepped_shaft() -> PartShape:
    """Return a shaft of three diameters (22, 34, 26 mm), 128 mm long."""
    c, h = 0.001, 0.064
    profile = [[0.0, -h], [0.011 - c, -h], [0.011, c - h], [0.011, -0.022], [0.017 - c, -0.022],
               [0.017, c - 0.022], [0.017, 0.014 - c], [0.017 - c, 0.014], [0.013, 0.014],
               [0.013, h - c], [0.013 - c, h], [0.0, h]]  # fmt: skip
    steel, brass = (164, 170, 178), (188, 146, 62)
    return _turned(profile, (-0.0225, 0.0145), (steel, brass, steel))


def cone() -> PartShape:
    """Return a blunt cone: 64 mm at the foot, 16 mm at the top, 74 mm high."""
    profile = [[0.0, -0.037], [0.031, -0.037], [0.032, -0.035], [0.009, 0.034], [0.007, 0.037],
               [0.0, 0.037]]  # fmt: skip
    orange, white = (226, 106, 30), (242, 240, 232)
    return _turned(profile, (-0.018, 0.0, 0.014), (orange, white, orange, white))


def elbow() -> PartShape:
    """Return a pipe bend of 90 degrees: outer diameter 34 mm, wall 5 mm, bend radius 34 mm."""
    bend, straight, outer, inner = 0.034, 0.02, 0.017, 0.012
    turn = np.linspace(-np.pi / 4, np.pi / 4, 33)
    steps = [(turn[0], -straight), *((t, 0.0) for t in turn), (turn[-1], straight)]
    unit = solids.circle(1.0, 64)

    def ring(angle: float, ahead: float, radius: float) -> Array:
        along = np.array([np.cos(angle), 0.0, -np.sin(angle)])
        out = np.array([np.sin(angle), 0.0, np.cos(angle)])
        # y then `out` is the right-hand order about the direction of travel.
        section = unit[:, :1] * np.array([0.0, 1.0, 0.0]) + unit[:, 1:] * out
        return bend * out + ahead * along + radius * section

    outside = [ring(t, s, outer) for t, s in steps]
    inside = [ring(t, s, inner) for t, s in steps]
    pieces = solids.sweep([*outside, *inside[::-1], outside[0]])
    z = pieces[..., 2]
    middle = np.array([0.0, 0.0, (z.min() + z.max()) / 2])
    copper, dark = (186, 104, 72), (140, 72, 50)
    return PartShape(
        pieces=[pieces - middle], bands=[(-0.019, dark), (np.inf, copper)], symmetries=cyclic(2)
    )


def mug() -> PartShape:
    """Return a mug of 76 x 92 mm with a handle: one closed surface of genus 1.

    Two windows of 4 x 4 facets are left out of the outer wall and the handle grows from their 16
    border vertices, so nothing overlaps and no boolean operation is needed.
    """
    radius, wall, facets = 0.038, 0.004, 72
    heights = np.linspace(-0.042, 0.042, 29)
    outside = np.stack([np.full(29, radius), heights], -1)
    rim = solids.arc((radius - wall / 2, 0.044), wall / 2, 0.0, np.pi, 8)
    inside = [[radius - wall, -0.034], [radius - 2 * wall, -0.04], [0.0, -0.04]]
    profile = np.concatenate([[[0.0, -0.046], [0.034, -0.046]], outside, rim, inside])
    body = solids.revolve(solids.cut_profile(profile, (0.0365, -0.0365)), facets)

    rows, columns = 4, np.arange(-2, 3)
    upper, lower = heights[21 : 22 + rows], heights[28 - 21 - rows : 29 - 21]
    middle = body.mean(1)
    angle = np.arctan2(middle[:, 1], middle[:, 0])
    on_wall = np.hypot(middle[:, 0], middle[:, 1]) > radius * np.cos(np.pi / facets) - 1e-4
    behind = on_wall & (np.abs(angle) < 2 * 2 * np.pi / facets)
    in_window = ((middle[:, 2] > upper[0]) & (middle[:, 2] < upper[-1])) | (
        (middle[:, 2] > lower[0]) & (middle[:, 2] < lower[-1])
    )
    nodes = solids.circle(1.0, facets)[columns % facets] * radius
    handle = _handle(nodes, upper, lower)
    return PartShape(
        pieces=[body[~(behind & in_window)], handle],
        bands=[(-0.0365, (74, 52, 44)), (0.0365, (228, 214, 186)), (np.inf, (74, 52, 44))],
    )


def _handle(nodes: Array, upper: Array, lower: Array) -> Array:
    """Return the tube (F, 3, 3) from a window in the wall to the one below it.

    Args:
        nodes: (5, 2) x, y of the window's columns [m].
        upper: (5,) heights of the upper window's rows [m].
        lower: (5,) of the lower one, mirrored [m].
    """
    # The border, counter-clockwise seen from outside: (column, row), first at the middle right.
    border = [(4, 2), (4, 3), (4, 4), (3, 4), (2, 4), (1, 4), (0, 4), (0, 3), (0, 2), (0, 1),
              (0, 0), (1, 0), (2, 0), (3, 0), (4, 0), (4, 1)]  # fmt: skip
    first = np.array([[*nodes[c], upper[r]] for c, r in border])
    last = np.array([[*nodes[c], lower[4 - r]] for c, r in border])
    x0, z0 = float(nodes[2, 0]), float(upper[2])
    knots = np.array([[x0, z0], [x0 + 0.036, z0 + 0.004], [x0 + 0.036, -z0 - 0.004], [x0, -z0]])
    phase = 2 * np.pi * np.arange(len(border)) / len(border)
    rings = [first]
    for t in np.linspace(0, 1, 25)[1:-1]:
        s = 1 - t
        weights = np.array([s**3, 3 * s * s * t, 3 * s * t * t, t**3])
        slope = np.array([-s * s, s * s - 2 * s * t, 2 * s * t - t * t, t * t])
        (x, z), (dx, dz) = weights @ knots, slope @ knots / np.linalg.norm(slope @ knots)
        section = np.outer(np.cos(phase), [0, 0.0058, 0]) + np.outer(
            np.sin(phase), [-0.0046 * dz, 0, 0.0046 * dx]
        )
        ring = section + np.array([x, 0.0, z])
        # The first and last eighth of the way flow from the square window into the oval.
        blend = min(1.0, min(t, s) / 0.125)
        window = (
            first + ring.mean(0) - first.mean(0) if t < s else last + ring.mean(0) - last.mean(0)
        )
        rings.append(blend * ring + (1 - blend) * window)
    return solids.sweep([*rings, last])


_PARTS: dict[str, tuple[int, Callable[[], PartShape]]] = {
    "box": (1, prismatic.box),
    "cube": (2, prismatic.cube),
    "hex_nut": (3, prismatic.hex_nut),
    "cylinder_can": (4, cylinder_can),
    "l_bracket": (5, prismatic.l_bracket),
    "t_profile": (6, prismatic.t_profile),
    "gear": (7, prismatic.gear),
    "wedge": (8, prismatic.wedge),
    "tube": (9, tube),
    "mug": (10, mug),
    "bottle": (11, bottle),
    "bowl": (12, bowl),
    "flange": (13, prismatic.flange),
    "pulley": (14, pulley),
    "knob": (15, prismatic.knob),
    "stepped_shaft": (16, stepped_shaft),
    "capsule": (17, capsule),
    "u_channel": (18, prismatic.u_channel),
    "cone": (19, cone),
    "elbow": (20, elbow),
}

_BULLET: dict[int, tuple[str, str, Literal["m", "mm"], float, tuple[int, int, int]]] = {
    # id: (name, file in pybullet_data, unit in which its numbers are plausible, factor to its real
    # size, RGB where the file has no texture). The factors of the duck and of the random objects
    # are those of their URDFs.
    101: ("duck", "duck.obj", "m", 0.05, (230, 200, 60)),
    102: ("bunny", "bunny.obj", "m", 0.045, (150, 120, 96)),
    103: ("teddy", "teddy2_VHACD_CHs.obj", "m", 0.09, (156, 98, 58)),
    104: ("blob_000", "random_urdfs/000/000.obj", "mm", 15.0, (70, 96, 178)),
    105: ("blob_004", "random_urdfs/004/004.obj", "mm", 15.0, (60, 140, 96)),
    106: ("blob_017", "random_urdfs/017/017.obj", "mm", 15.0, (186, 72, 90)),
    107: ("blob_025", "random_urdfs/025/025.obj", "mm", 15.0, (206, 146, 52)),
    108: ("blob_033", "random_urdfs/033/033.obj", "mm", 15.0, (122, 84, 160)),
}


def part_names() -> tuple[str, ...]:
    """Return the names of all parts, in the order of their ids."""
    return tuple(_PARTS)


def _painted(
    vertices: Array, bands: Sequence[tuple[float, tuple[int, int, int]]]
) -> NDArray[np.uint8]:
    """Return the RGB (V, 3) of the band that each vertex's height falls into."""
    limits = np.array([upper for upper, _ in bands])
    palette = np.array([color for _, color in bands], dtype=np.uint8)
    return palette[np.searchsorted(limits[:-1], vertices[:, 2])]


@cache
def part(name: str) -> ObjectModel:
    """Return a part of the shipped set.

    Raises:
        InputError: there is no part of this name.
    """
    if name not in _PARTS:
        raise InputError(f"there is no part '{name}'; there are: {', '.join(_PARTS)}.")
    obj_id, build = _PARTS[name]
    shape = build()
    vertices, faces = weld(shape.pieces)
    return ObjectModel(
        obj_id=obj_id,
        name=name,
        mesh=Mesh(vertices=vertices, faces=faces, colors=_painted(vertices, shape.bands)),
        symmetries=shape.symmetries,
        symmetry_axes=(((0.0, 0.0, 1.0), (0.0, 0.0, 0.0)),) if shape.turns_about_z else (),
    )


def object_names() -> tuple[str, ...]:
    """Return the names of all objects at hand: the shipped parts, then PyBullet's meshes."""
    return (*_PARTS, *(entry[0] for entry in _BULLET.values()))


def object_model(name: str) -> ObjectModel:
    """Return a shipped part or one of PyBullet's meshes by its name.

    Raises:
        InputError: neither has this name.
        MissingLibraryError: it is PyBullet's, and pybullet_data is not installed.
    """
    if name in _PARTS:
        return part(name)
    for obj_id, entry in _BULLET.items():
        if entry[0] == name:
            return pybullet_models([obj_id])[0]
    raise InputError(f"there is no object '{name}'; there are: {', '.join(object_names())}.")


def pybullet_models(ids: Sequence[int]) -> tuple[ObjectModel, ...]:
    """Return object models of meshes that come with PyBullet; PyBullet itself is not imported.

    Args:
        ids: obj_ids; a wrong one is answered with those that there are.

    Raises:
        InputError: an id is not known.
        MissingLibraryError: pybullet_data is not installed.
    """
    spec = importlib.util.find_spec("pybullet_data")
    if spec is None or spec.origin is None:
        raise MissingLibraryError(
            "pybullet_data is not installed, so its meshes cannot be read; install pybullet, or "
            f"use the shipped parts: {', '.join(_PARTS)}."
        )
    folder = Path(spec.origin).parent
    return tuple(_pybullet_model(folder, obj_id) for obj_id in ids)


@cache
def _pybullet_model(folder: Path, obj_id: int) -> ObjectModel:
    from realsim.geometry.mesh import load_mesh

    if obj_id not in _BULLET:
        raise InputError(
            f"{obj_id} is not the id of a pybullet_data mesh; the ids are: "
            f"{', '.join(f'{i} ({v[0]})' for i, v in _BULLET.items())}."
        )
    name, file, unit, factor, color = _BULLET[obj_id]
    # What is missing of the file's look is not told: the colour of the list stands for it.
    raw = load_mesh(folder / file, unit, notes=[])
    vertices = raw.vertices * factor
    vertices = vertices - (vertices.min(0) + vertices.max(0)) / 2
    if raw.texture is not None and raw.uv is not None:
        mesh = Mesh(vertices=vertices, faces=raw.faces, uv=raw.uv, texture=raw.texture)
    else:
        painted = np.tile(np.array(color, dtype=np.uint8), (len(vertices), 1))
        mesh = Mesh(vertices=vertices, faces=raw.faces, colors=painted)
    return ObjectModel(obj_id=obj_id, name=name, mesh=mesh)
