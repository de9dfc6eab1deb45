"""Exact depth of things on a table from all around."""

import numpy as np

from plain_meshes import square
from realsim.geometry import se3
from realsim.geometry.camera import ray_table
from realsim.records import CameraIntrinsics, Mesh
from realsim.rendering.rays import BACKGROUND, PlacedMesh, RayScene, rotated
from realsim.scanning.fusion.fuse import FusionFrame

TABLE = square(0.6)


def exact_frames(
    meshes: tuple[Mesh, ...], camera: CameraIntrinsics, count: int = 12, table: bool = True
) -> list[FusionFrame]:
    """Exact depth of meshes on the table from `count` places around, the first straight above.

    The others look from 20 and 55 degrees in turn, so that every side is seen by two.
    """
    scene = RayScene(
        [PlacedMesh(BACKGROUND, m, np.eye(4)) for m in (*meshes, *([TABLE] if table else []))]
    )
    rays = ray_table(camera)
    frames: list[FusionFrame] = []
    for k in range(count):
        around, above = 2.4 * k, np.radians(88 if k == 0 else 20 + 35 * (k % 2))
        eye = [np.cos(above) * np.cos(around), np.cos(above) * np.sin(around), np.sin(above)]
        T = se3.look_at(0.35 * np.array(eye) + [0, 0, 0.03], [0, 0, 0.03])
        t, _ = scene.first_hits(T[:3, 3], rotated(rays, T[:3, :3]).reshape(-1, 3))
        depth = np.where(np.isfinite(t), t, 0).reshape(rays.shape[:2]).astype(np.float32)
        frames.append(FusionFrame(index=k, depth_m=depth, T_world_cam=T))
    return frames
