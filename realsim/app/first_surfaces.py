"""Which object every pixel of a view sees first, and how deep: labels without the hidden parts."""

from collections.abc import Sequence

import numpy as np

from realsim.arrays import Array, Int32
from realsim.records import CameraIntrinsics
from realsim.rendering.casting.pixel_caster import PixelCaster
from realsim.rendering.rays import BACKGROUND, PlacedMesh


class FirstSurfaces:
    """Placed meshes to look at from any view: less work than full labels."""

    def __init__(self, placed: Sequence[PlacedMesh]) -> None:
        """Prepare the scene."""
        self._caster = PixelCaster(placed)
        # The last entry answers "nothing".
        self._instances = np.array([*(p.instance for p in placed), BACKGROUND], np.int32)

    def look(self, intrinsics: CameraIntrinsics, T_world_cam: Array) -> tuple[Int32, Array]:
        """Return instance (H, W), -1 = none, and depth along z (H, W) [m], NaN = nothing.

        Args:
            intrinsics: the raw (distorted) camera.
            T_world_cam: (4, 4) camera in world [m].
        """
        hits = self._caster.cast(intrinsics, T_world_cam)
        depth = np.where(hits.geometry >= 0, hits.depth_m.astype(np.float64), np.nan)
        return self._instances[hits.geometry], depth
