"""Which object every pixel of a view sees first, and how deep: labels without the hidden parts."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from realsim.geometry import camera
from realsim.records import CameraIntrinsics
from realsim.rendering.rays import BACKGROUND, PlacedMesh, RayScene, rotated

Array = NDArray[np.float64]


class FirstSurfaces:
    """Placed meshes to look at from any view; a tenth of the work of full labels."""

    def __init__(self, placed: Sequence[PlacedMesh]) -> None:
        """Prepare the scene."""
        self._scene = RayScene(placed)
        self._instances = np.array([*(p.instance for p in placed), BACKGROUND], np.int32)

    def look(
        self, intrinsics: CameraIntrinsics, T_world_cam: Array
    ) -> tuple[NDArray[np.int32], Array]:
        """Return instance (H, W), -1 = none, and depth along z (H, W) [m], NaN = nothing.

        Args:
            intrinsics: the raw (distorted) camera.
            T_world_cam: (4, 4) camera in world [m].
        """
        rays = rotated(camera.ray_table(intrinsics), T_world_cam[:3, :3])
        shape = rays.shape[:2]
        flat = rays.reshape(-1, 3)
        known = np.isfinite(flat[:, 0])
        ids = np.full(len(flat), BACKGROUND, np.int32)
        depth = np.full(len(flat), np.nan)
        t, hit = self._scene.first_hits(T_world_cam[:3, 3], flat[known])
        ids[known] = self._instances[hit]
        depth[known] = np.where(np.isfinite(t), t, np.nan)
        return ids.reshape(shape), depth.reshape(shape)
