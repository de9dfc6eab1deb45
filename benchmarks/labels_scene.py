"""The scene of the labels' benchmark: 15 real CAD meshes, 350,000 faces, and 256 views of it.

The meshes are robot parts out of pybullet_data: scanned-like fineness, many of them not closed.
"""

from functools import lru_cache
from pathlib import Path

import numpy as np

from realsim.arrays import Array, Int64
from realsim.geometry import se3
from realsim.records import CameraIntrinsics, Mesh
from realsim.rendering.rays import BACKGROUND, PlacedMesh

PARTS = (
    "differential/diff_ring.stl", "quadruped/microtaur/channel.stl",
    "xarm/xarm_description/meshes/xarm6/visual/link2.stl", "xarm/xarm_gripper/meshes/base_link.STL",
    "quadruped/microtaur/xavier.stl", "quadruped/microtaur/d435i.stl",
    "quadruped/microtaur/xm430w210.stl", "quadruped/microtaur/plate.stl",
    "differential/diff_pinion.stl", "franka_panda/meshes/visual/link6.obj",
    "franka_panda/meshes/visual/link5.obj", "franka_panda/meshes/visual/hand.obj",
    "mini_cheetah/meshes/mini_upper_link.obj", "a1/meshes/trunk.obj", "soccerball.obj",
)  # fmt: skip
LENS = np.array([-0.055, 0.062, 0.0005, -0.0007, -0.02])
"""Brown-Conrady coefficients as a D405's factory calibration has them."""
SPREAD_M = 0.17
"""The objects stand within this of the table's middle [m]: one hides the other."""


def _read(path: Path) -> tuple[Array, Int64]:
    import trimesh

    loaded = trimesh.load(path, process=False)
    parts = loaded.dump() if isinstance(loaded, trimesh.Scene) else [loaded]
    whole = trimesh.util.concatenate(parts)
    return np.asarray(whole.vertices, np.float64), np.asarray(whole.faces, np.int64)


@lru_cache(maxsize=1)
def scene() -> tuple[PlacedMesh, ...]:
    """Return the table and the 15 objects on it."""
    import pybullet_data

    root = Path(pybullet_data.getDataPath())
    rng = np.random.default_rng(8)
    slab = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)]) * 0.5
    faces = [[0, 1, 3], [0, 3, 2], [4, 6, 7], [4, 7, 5], [0, 4, 5], [0, 5, 1],
             [2, 3, 7], [2, 7, 6], [0, 2, 6], [0, 6, 4], [1, 5, 7], [1, 7, 3]]  # fmt: skip
    table = Mesh(vertices=slab * [1.6, 1.6, 0.02], faces=np.array(faces))
    placed = [PlacedMesh(BACKGROUND, table, se3.from_translation([0, 0, -0.011]))]
    for i, name in enumerate(PARTS):
        vertices, triangles = _read(root / name)
        size = np.ptp(vertices, axis=0).max()
        vertices = (vertices - vertices.mean(0)) * (rng.uniform(0.09, 0.15) / size)
        R = se3.exp_so3(rng.normal(size=3) * 2)
        lowest = float((vertices @ R.T)[:, 2].min())
        angle = 2.399963 * i
        at = SPREAD_M * np.sqrt((i + 0.5) / len(PARTS)) * np.array([np.cos(angle), np.sin(angle)])
        T = se3.from_rt(R, [*at, -lowest])
        placed.append(PlacedMesh(i, Mesh(vertices=vertices, faces=triangles), T))
    return tuple(placed)


def faces_of(placed: tuple[PlacedMesh, ...]) -> int:
    """Return how many faces the objects have together."""
    return sum(len(p.mesh.faces) for p in placed if p.instance != BACKGROUND)


def cameras(n: int, near_m: float, far_m: float) -> list[Array]:
    """Return n cameras (4, 4) evenly on the hemisphere over the table, looking at its middle."""
    rng = np.random.default_rng(3)
    views: list[Array] = []
    for k in range(n):
        elevation = np.arcsin(0.26 + 0.72 * (k + 0.5) / n)
        around = 2.399963 * k
        eye = rng.uniform(near_m, far_m) * np.array([
            np.cos(around) * np.cos(elevation),
            np.sin(around) * np.cos(elevation),
            np.sin(elevation),
        ])  # fmt: skip
        views.append(se3.look_at(eye, [*rng.uniform(-0.02, 0.02, 2), 0.03]))
    return views


def camera_720p(distorted: bool = False) -> CameraIntrinsics:
    """Return a D405's camera at 1280x720."""
    return CameraIntrinsics(
        width=1280, height=720, fx=650, fy=650, cx=638.2, cy=361.4,
        distortion=LENS if distorted else np.zeros(5),
    )  # fmt: skip


def camera_1080p(distorted: bool = False) -> CameraIntrinsics:
    """Return a camera at 1920x1080 with the view of the paper's simulated one."""
    return CameraIntrinsics(
        width=1920, height=1080, fx=1380, fy=1380, cx=958.7, cy=541.1,
        distortion=LENS if distorted else np.zeros(5),
    )  # fmt: skip
