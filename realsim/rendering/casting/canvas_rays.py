"""The rays of BOP's canvas: the image and one image size more to each side.

How much of an object lies beyond the border is counted there. The rays are found in blocks, when
something reaches into them, because inverting a lens over nine images at once would take seconds.
"""

from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from realsim.geometry import camera
from realsim.records import CameraIntrinsics
from realsim.rendering.casting.pixel_caster import ProjectedMesh
from realsim.rendering.casting.triangle_rays import count_outside

Array32 = NDArray[np.float32]
CANVAS = 1
"""Image sizes that the canvas reaches beyond each border: BOP's 3x canvas."""
BLOCK_PX = 128
"""Edge of a block of rays [px]: 16,000 rays are inverted in 10 ms."""


class CanvasRays:
    """The rays of one camera's canvas."""

    def __init__(self, intrinsics: CameraIntrinsics) -> None:
        """Reserve the table; no ray is known yet."""
        self.intrinsics = intrinsics
        self.left, self.top = -CANVAS * intrinsics.width, -CANVAS * intrinsics.height
        self.width = (2 * CANVAS + 1) * intrinsics.width
        self.height = (2 * CANVAS + 1) * intrinsics.height
        self._table = np.empty((self.height, self.width, 2), np.float32)
        self._known = np.zeros((-(-self.height // BLOCK_PX), -(-self.width // BLOCK_PX)), bool)

    def window(self, u0: int, u1: int, v0: int, v1: int) -> Array32:
        """Return the rays (h, w, 2) of the pixels u0..u1-1, v0..v1-1 of the canvas; NaN = none."""
        c0, c1, r0, r1 = u0 - self.left, u1 - self.left, v0 - self.top, v1 - self.top
        for row in range(r0 // BLOCK_PX, -(-r1 // BLOCK_PX)):
            for column in range(c0 // BLOCK_PX, -(-c1 // BLOCK_PX)):
                if not self._known[row, column]:
                    self._fill(row, column)
        return self._table[r0:r1, c0:c1]

    def _fill(self, row: int, column: int) -> None:
        rows = slice(row * BLOCK_PX, min((row + 1) * BLOCK_PX, self.height))
        columns = slice(column * BLOCK_PX, min((column + 1) * BLOCK_PX, self.width))
        v, u = np.mgrid[rows, columns]
        uv = np.stack([u + self.left, v + self.top], -1).astype(np.float64)
        xy, _ = camera.undistort(self.intrinsics, uv)
        self._table[rows, columns] = xy
        self._known[row, column] = True

    def count_beyond(self, mesh: ProjectedMesh, bounds: tuple[float, float, float, float]) -> int:
        """Return how many canvas pixels outside the image a mesh covers.

        Args:
            mesh: the mesh.
            bounds: of its picture, as of `pixel_caster.Entered`.
        """
        u_low, u_high, v_low, v_high = bounds
        if u_low > u_high:
            return 0
        i = self.intrinsics
        right, bottom = self.left + self.width, self.top + self.height
        u0, u1 = int(np.ceil(max(u_low, self.left))), int(np.floor(min(u_high, right - 1))) + 1
        v0, v1 = int(np.ceil(max(v_low, self.top))), int(np.floor(min(v_high, bottom - 1))) + 1
        if u0 >= u1 or v0 >= v1 or (u0 >= 0 and v0 >= 0 and u1 <= i.width and v1 <= i.height):
            return 0
        rays = self.window(u0, u1, v0, v1)
        placed = (mesh.points, mesh.seen, mesh.faces)
        return int(count_outside(placed, mesh.lens, rays, (u0, v0), (i.width, i.height)))


@lru_cache(maxsize=4)
def _kept(key: tuple[float, ...]) -> CanvasRays:
    width, height, fx, fy, cx, cy = key[:6]
    intrinsics = CameraIntrinsics(
        width=int(width), height=int(height), fx=fx, fy=fy, cx=cx, cy=cy,
        distortion=np.array(key[6:]),
    )  # fmt: skip
    return CanvasRays(intrinsics)


def canvas_rays(intrinsics: CameraIntrinsics) -> CanvasRays:
    """Return the canvas of a camera, kept from view to view."""
    i = intrinsics
    key = (i.width, i.height, i.fx, i.fy, i.cx, i.cy, *i.distortion.tolist())
    return _kept(tuple(float(v) for v in key))
