"""Objects of the scale benchmark: 30 watertight meshes in metres, 6 to 18 cm, and how they rest.

Imported by `scale_cases.py`. The shipped parts, two of PyBullet's meshes, and the shapes that are
known to be hard for a scale fit: thin walls, flat, ring-shaped, all round, elongated and bent.
"""

from collections.abc import Callable, Sequence
from functools import cache, partial
from typing import Any

import numpy as np

from realsim.arrays import Array
from realsim.geometry import parts_solids as solids
from realsim.geometry import se3
from realsim.geometry.mesh import to_trimesh, welded_mesh
from realsim.geometry.parts import object_model, part_names
from realsim.records import Mesh

FACETS = 96
"""Facets around a turned shape."""
RESIZED = {"cube": 1.3, "knob": 1.15}
"""Shipped parts that are below 6 cm, and by how much they are enlarged."""
REST_SHARE = 0.02
"""A resting pose of less probability is not drawn, unless all are below (a sphere)."""
HULL_GRID = 60
"""Vertices are rounded to this share of the size before the hull's resting poses are counted: a
finely turned body has thousands of facets otherwise, each a resting pose of its own."""
SETTLE_DEG = 10.0
"""How far the rounding may have tilted a resting pose [deg]; it is undone on the exact hull."""
FOOT_M = 5e-4
"""What is this near to the table touches it [m]."""


def welded(pieces: Sequence[Array]) -> Mesh:
    """Return the welded mesh of pieces (F, 3, 3) [m]."""
    vertices, faces = solids.weld(pieces)
    return Mesh(vertices=vertices, faces=faces)


def _shipped(name: str, factor: float = 1.0) -> Mesh:
    """Return a shipped or PyBullet object, seams welded."""
    mesh = welded_mesh(object_model(name).mesh)
    return Mesh(vertices=mesh.vertices * factor, faces=mesh.faces)


def cup() -> Mesh:
    """Return a cup without a handle, 76 x 90 mm, wall 2 mm."""
    profile = [[0.0, 0.0], [0.028, 0.0], [0.038, 0.09], [0.036, 0.09], [0.0262, 0.002], [0, 0.002]]
    cut = solids.cut_profile(profile, [0.015, 0.03, 0.045, 0.06, 0.075])
    return welded([solids.revolve(cut, FACETS)])


def disc() -> Mesh:
    """Return a disc of 100 x 12 mm."""
    r, h, c = 0.05, 0.012, 0.001
    profile = [[0.0, 0.0], [r - c, 0.0], [r, c], [r, h - c], [r - c, h], [0.0, h]]
    return welded([solids.revolve(profile, FACETS)])


def torus() -> Mesh:
    """Return a ring of 108 mm whose section is a circle of 28 mm."""
    t = np.linspace(0, 2 * np.pi, 49)
    profile = np.stack([0.04 + 0.014 * np.cos(t), 0.014 * np.sin(t)], -1)
    profile[-1] = profile[0]
    return welded([solids.revolve(profile, FACETS)])


def sphere() -> Mesh:
    """Return a ball of 80 mm."""
    profile = solids.arc((0.0, 0.0), 0.04, -np.pi / 2, np.pi / 2, 48)
    profile[[0, -1], 0] = 0.0
    return welded([solids.revolve(profile, FACETS)])


def pipe() -> Mesh:
    """Return a straight pipe, 40 x 140 mm, wall 3 mm."""
    outer, inner, h = 0.02, 0.017, 0.07
    ring = [[inner, h], [inner, -h], [outer, -h], [outer, h], [inner, h]]
    cut = solids.cut_profile(ring, [-0.056, -0.042, -0.028, -0.014, 0, 0.014, 0.028, 0.042, 0.056])
    return welded([solids.revolve(cut, FACETS)])


def _rings(centers: Array, headings: Array, section: Array, radii: Array) -> list[Array]:
    """Return rings (N, 3) about a path in the x-z plane.

    Args:
        centers: (K, 2) x and z of the path [m].
        headings: (K,) direction of travel, from x towards z [rad].
        section: (N, 2) unit outline, counter-clockwise: along y, and across in the plane.
        radii: (K,) factor of the section [m].
    """
    y = np.array([0.0, 1.0, 0.0])
    rings: list[Array] = []
    for center, angle, radius in zip(centers, headings, radii, strict=True):
        # y x across = heading, so the ring is counter-clockwise about the direction of travel.
        across = np.array([-np.sin(angle), 0.0, np.cos(angle)])
        middle = np.array([center[0], 0.0, center[1]])
        rings.append(middle + radius * (section[:, :1] * y + section[:, 1:] * across))
    return rings


def pipe2() -> Mesh:
    """Return a pipe of 30 mm, wall 3 mm, bent by 60 degrees between arms of 65 and 35 mm."""
    bend, first, second, angle = 0.04, 0.065, 0.035, np.radians(60)
    t = np.linspace(0, angle, 25)
    curve = np.stack([bend * np.sin(t), bend * (1 - np.cos(t))], -1)
    end = curve[-1] + second * np.array([np.cos(angle), np.sin(angle)])
    centers = np.concatenate([[[-first, 0.0]], curve, end[None]])
    headings = np.concatenate([[0.0], t, [angle]])
    unit = solids.circle(1.0, 64)
    outside = _rings(centers, headings, unit, np.full(len(centers), 0.015))
    inside = _rings(centers, headings, unit, np.full(len(centers), 0.012))
    return welded([solids.sweep([*outside, *inside[::-1], outside[0]])])


def banana() -> Mesh:
    """Return a banana of about 165 x 55 mm: a tapering arc with a rounded five-sided section."""
    t = np.linspace(0, 1, 49)
    heading = np.radians(-55) + np.radians(110) * t
    radius_m, thick, stalk = 0.092, 0.0175, 0.005
    centers = radius_m * np.stack([np.sin(heading), 1 - np.cos(heading)], -1)
    taper = np.sqrt(np.clip(1 - np.abs(2 * t - 0.95) ** 2.6, 0, None))
    radii = np.maximum(thick * taper, stalk)
    turn = 2 * np.pi * np.arange(60) / 60
    round5 = 1 + 0.05 * np.cos(5 * turn)
    section = np.stack([round5 * np.cos(turn), round5 * np.sin(turn)], -1)
    rings = _rings(centers, heading, section, radii)
    return welded([solids.sweep(rings), _fan(rings[0])[:, ::-1], _fan(rings[-1])])


def _fan(ring: Array) -> Array:
    """Return the flat cap (N, 3, 3) of a ring (N, 3), seen counter-clockwise from ahead."""
    middle = np.broadcast_to(ring.mean(0), ring.shape)
    return np.stack([ring, np.roll(ring, -1, axis=0), middle], 1)


def motor() -> Mesh:
    """Return a geared motor of 72 x 60 x 104 mm: terminal box, flange, boss, shaft off centre."""
    body = solids.circle(0.028, FACETS)
    first, last = 8, FACETS - 8
    box = [[0.038, body[last, 1]], [0.038, body[first, 1]]]
    boxed = np.concatenate([body[first : last + 1], box])
    bump = np.concatenate([body[last : last + 1], box, body[first::-1], body[: last - 1 : -1][:-1]])
    plate = solids.rectangle(0.068, 0.06)
    boss, shaft = solids.circle(0.017, FACETS), solids.circle(0.006, 48, (0.006, 0.0))
    z = [0.0, 0.012, 0.046, 0.068, 0.074, 0.081, 0.104]
    return welded([
        solids.cap(body, (), z[0], up=False),
        solids.wall(body, z[0], body, z[1]),
        solids.cap(bump, (), z[1], up=False),
        solids.wall(boxed, z[1], boxed, z[2]),
        solids.cap(bump, (), z[2], up=True),
        solids.wall(body, z[2], body, z[3]),
        solids.cap(plate, (body[::-1],), z[3], up=False),
        solids.wall(plate, z[3], plate, z[4]),
        solids.cap(plate, (boss[::-1],), z[4], up=True),
        solids.wall(boss, z[4], boss, z[5]),
        solids.cap(boss, (shaft[::-1],), z[5], up=True),
        solids.wall(shaft, z[5], shaft, z[6]),
        solids.cap(shaft, (), z[6], up=True),
    ])  # fmt: skip


SHAPES: dict[str, Callable[[], Mesh]] = {
    **{name: partial(_shipped, name, RESIZED.get(name, 1.0)) for name in part_names()},
    "cup": cup,
    "disc": disc,
    "torus": torus,
    "sphere": sphere,
    "pipe": pipe,
    "pipe2": pipe2,
    "banana": banana,
    "motor": motor,
    "bunny": partial(_shipped, "bunny"),
    "duck": partial(_shipped, "duck"),
}


def resting_rotation(mesh: Mesh, rng: np.random.Generator) -> Array:
    """Return R (3, 3) that turns the mesh into a resting pose on z = 0, drawn by probability."""
    Rs, share = _resting(mesh.vertices.tobytes(), mesh.faces.tobytes())
    return Rs[int(rng.choice(len(Rs), p=share))].copy()


@cache
def _resting(vertices: bytes, faces: bytes) -> tuple[Array, Array]:
    """Return resting rotations (N, 3, 3) and their probabilities (N,), most probable first."""
    import trimesh

    v = np.frombuffer(vertices, np.float64).reshape(-1, 3)
    mesh = Mesh(vertices=v.copy(), faces=np.frombuffer(faces, np.int32).reshape(-1, 3).copy())
    solid: Any = to_trimesh(mesh)
    center = np.asarray(solid.center_mass if solid.is_watertight else v.mean(0))
    step = float(mesh.extent.max()) / HULL_GRID
    coarse = np.unique(np.round((v - center) / step), axis=0) * step
    hull: Any = trimesh.convex.convex_hull(coarse)
    poses: Any = trimesh.poses.compute_stable_poses(hull, center_mass=np.zeros(3), sigma=0.0)
    Rs, share = np.asarray(poses[0])[:, :3, :3], np.asarray(poses[1], dtype=np.float64)
    keep = share >= min(REST_SHARE, float(share.max()))
    exact: Any = trimesh.convex.convex_hull(v - center)
    normals = np.asarray(exact.face_normals)
    height = np.einsum("fc,fc->f", normals, np.asarray(exact.triangles)[:, 0])
    settled = np.stack([_settled(R, normals, height) for R in Rs[keep]])
    bears = np.array([_bears(np.asarray(exact.vertices) @ R.T) for R in settled])
    share = share[keep] * (bears if bears.any() else 1.0)
    return settled[share > 0], share[share > 0] / share.sum()


def _bears(vertices: Array) -> bool:
    """Return whether the centre of mass, the origin, is above the box of the lowest vertices."""
    foot = vertices[vertices[:, 2] < vertices[:, 2].min() + FOOT_M][:, :2]
    return bool(np.all(foot.min(0) < FOOT_M) and np.all(foot.max(0) > -FOOT_M))


def _settled(R: Array, normals: Array, height: Array) -> Array:
    """Return R (3, 3) turned a little further, onto the facet nearby that bears the mass lowest.

    Args:
        R: a resting pose of the rounded hull.
        normals: (F, 3) outward normals of the exact hull's facets.
        height: (F,) of the centre of mass over each facet [m]; at rest it is least.
    """
    down = normals @ R.T @ np.array([0.0, 0.0, -1.0])
    near = np.flatnonzero(down > np.cos(np.radians(SETTLE_DEG)))
    if len(near) == 0:
        return R
    n = R @ normals[near[int(np.argmin(height[near]))]]
    axis = np.cross(n, [0.0, 0.0, -1.0])
    sine = float(np.linalg.norm(axis))
    return R if sine < 1e-12 else se3.exp_so3(np.arctan2(sine, -n[2]) * axis / sine) @ R
