"""The objects of the second lab (`outside_lab.py`): boxes, turned parts, prisms, plates."""

from collections.abc import Callable
from functools import cache
from typing import Any

import numpy as np
import trimesh
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from realsim.geometry.mesh import Mesh
from realsim.interop import import_open3d
from realsim.records import ObjectModel

o3d = import_open3d()
Array = NDArray[np.float64]
Triple = tuple[float, float, float]


def _revolved(*profile: tuple[float, float]) -> trimesh.Trimesh:
    """Return what a line of (radius, height) in mm, from axis to axis, sweeps about z."""
    return trimesh.creation.revolve(np.array(profile) / 1e3, sections=64)


def _plate(x: float, y: float, z: float) -> trimesh.Trimesh:
    """Return a box of so many mm."""
    return trimesh.creation.box(np.array([x, y, z]) / 1e3)


def _prism(points: list[tuple[float, float]], height: float) -> trimesh.Trimesh:
    """Return an outline in mm, all of it seen from its first point, pulled up."""
    n = len(points)
    flat = np.array(points)
    low, high = np.insert(flat, 2, 0.0, axis=1), np.insert(flat, 2, height, axis=1)
    fan = [(0, i, i + 1) for i in range(1, n - 1)]
    faces = [f[::-1] for f in fan] + [tuple(n + i for i in f) for f in fan]
    for i in range(n):
        k = (i + 1) % n
        faces += [(i, k, n + k), (i, n + k, n + i)]
    return trimesh.Trimesh(np.concatenate([low, high]) / 1e3, faces)


def _combined(a: trimesh.Trimesh, b: trimesh.Trimesh, how: str) -> trimesh.Trimesh:
    """Return 'boolean_union' or 'boolean_difference' of two bodies."""
    found = getattr(mesh_of(a), how)(mesh_of(b))
    return trimesh.Trimesh(found.vertex.positions.numpy(), found.triangle.indices.numpy())


def _joined(a: trimesh.Trimesh, b: trimesh.Trimesh) -> trimesh.Trimesh:
    return _combined(a, b, "boolean_union")


def _without(a: trimesh.Trimesh, b: trimesh.Trimesh) -> trimesh.Trimesh:
    return _combined(a, b, "boolean_difference")


def _at(body: trimesh.Trimesh, x: float, y: float, z: float) -> trimesh.Trimesh:
    """Return the body moved by so many mm."""
    return body.copy().apply_translation(np.array([x, y, z]) / 1e3)


def _mug() -> trimesh.Trimesh:
    cup = _revolved((0.0, 0), (40, 0), (40, 85), (37, 85), (37, 4), (0.0, 4))
    bow = trimesh.creation.torus(0.024, 0.005, major_sections=48, minor_sections=16)
    bow.apply_transform(trimesh.transformations.rotation_matrix(np.pi / 2, [1, 0, 0]))
    inside = trimesh.creation.cylinder(0.0385, 0.2)
    return _joined(cup, _without(_at(bow, 46, 0, 42), inside))


def _hexagon(radius: float) -> list[tuple[float, float]]:
    turn = np.radians(60 * np.arange(6))
    return [(radius * np.cos(a), radius * np.sin(a)) for a in turn]


def _bottle() -> trimesh.Trimesh:
    body = _revolved((0.0, 0), (30, 0), (32, 10), (32, 95), (12, 130), (12, 160), (0.0, 160))
    body.apply_transform(np.diag([1.35, 0.85, 1.0, 1.0]))
    return body


SHAPES: dict[str, tuple[Callable[[], trimesh.Trimesh], bool, str]] = {
    # name: (shape, dark, declared symmetry: '' = none, 'z' = any turn about z, 'zx' = and end for
    # end, 'box' = half turns, 'o' = any)
    "mug": (_mug, False, ""),
    "bowl": (
        lambda: _revolved((0.0, 0), (35, 0), (70, 45), (70, 50), (66, 50), (32, 5), (0.0, 5)),
        False, "z",
    ),
    "bottle": (_bottle, False, "half"),
    "can": (lambda: trimesh.creation.cylinder(0.033, 0.1, sections=64), False, "zx"),
    "ball": (lambda: trimesh.creation.icosphere(subdivisions=4, radius=0.035), False, "o"),
    "cone": (
        lambda: _revolved((0.0, 0), (40, 0), (14, 80), (0.0, 80)), False, "z",
    ),
    "carton": (lambda: _plate(62, 160, 90), False, "box"),
    "dark_box": (lambda: _plate(50, 90, 35), True, "box"),
    "notched_cube": (
        lambda: _prism([(0, 0), (55, 0), (55, 41), (41, 41), (41, 55), (0, 55)], 55),
        False, "notch",
    ),
    "hex_bar": (lambda: _prism(_hexagon(18), 130), False, "hex"),
    "bracket": (
        lambda: _prism([(0, 0), (80, 0), (80, 8), (8, 8), (8, 60), (0, 60)], 40), False, "",
    ),
    "wedge": (lambda: _prism([(0, 0), (80, 0), (0, 45)], 50), False, ""),
    "stairs": (
        lambda: _prism([(0, 0), (90, 0), (90, 20), (60, 20), (60, 40), (30, 40), (30, 60), (0, 60)],
                       45), True, "",
    ),
    "clamp": (
        lambda: _without(_plate(120, 24, 50), _at(_plate(84, 40, 60), -4, 0, 38)), False, "",
    ),
    "plate_2": (lambda: _prism([(0, 0), (110, 0), (110, 50), (60, 80), (0, 80)], 2.0), False, ""),
    "plate_3": (lambda: _prism([(0, 0), (90, 0), (90, 90), (50, 60), (0, 90)], 3.0), False, ""),
    "plate_5": (lambda: _prism([(0, 0), (120, 0), (80, 70), (0, 70)], 5.0), False, ""),
    "lid": (
        lambda: _revolved((0.0, 0), (45, 0), (45, 9), (42, 9), (42, 3), (0.0, 3)), False, "z",
    ),
}  # fmt: skip
"""The lab's objects; the last four are flat."""


def _symmetries(kind: str) -> tuple[Array, tuple[tuple[Triple, Triple], ...]]:
    """Return what a library would declare: discrete transforms (S, 4, 4), and axes with a point."""

    def turned(axis: str, *degrees: float) -> list[Array]:
        found = []
        for angle in degrees:
            T = np.eye(4)
            T[:3, :3] = Rotation.from_euler(axis, angle, degrees=True).as_matrix()
            found.append(T)
        return found

    z = ((0.0, 0.0, 1.0), (0.0, 0.0, 0.0))
    axes = {"z": (z,), "zx": (z,), "o": (z, ((1.0, 0.0, 0.0), (0.0, 0.0, 0.0)))}.get(kind, ())
    (flip,) = turned("x", 180)
    sixths = turned("z", 60, 120, 180, 240, 300)
    discrete = {
        "zx": [flip],
        "half": turned("z", 180),
        "box": [turned(a, 180)[0] for a in "xyz"],
        "hex": [*sixths, flip, *(T @ flip for T in sixths)],
        "notch": [turned("z", 90)[0] @ flip],
    }.get(kind, [])
    return np.stack([np.eye(4), *discrete]), axes


@cache
def objects() -> dict[int, tuple[ObjectModel, trimesh.Trimesh, bool]]:
    """Return the lab's objects by id: the model as a library has it, the body, whether it is dark.

    Origins are in the middle of the boxes, so that the symmetries pass through them.
    """
    found: dict[int, tuple[ObjectModel, trimesh.Trimesh, bool]] = {}
    for obj_id, (name, (make, dark, kind)) in enumerate(SHAPES.items(), start=1):
        body = make()
        body.apply_translation(-body.bounds.mean(axis=0))
        discrete, axes = _symmetries(kind)
        mesh = Mesh(vertices=np.array(body.vertices), faces=np.array(body.faces))
        model = ObjectModel(
            obj_id=obj_id, name=name, mesh=mesh, symmetries=discrete, symmetry_axes=axes
        )
        found[obj_id] = model, body, dark
    return found


def mesh_of(body: trimesh.Trimesh) -> Any:
    """Return the body as Open3D takes it."""
    return o3d.t.geometry.TriangleMesh(
        o3d.core.Tensor(np.asarray(body.vertices, np.float32)),
        o3d.core.Tensor(np.asarray(body.faces, np.int32)),
    )
