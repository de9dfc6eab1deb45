"""The rays of one view, spread over its pixels: exactly where the labels look."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from realsim.geometry import camera
from realsim.records import CameraIntrinsics
from realsim.rendering.rays import rotated

Array = NDArray[np.float64]
Array32 = NDArray[np.float32]
LATTICE = (0.7548776662466927, 0.5698402909980532)
"""Steps of the R2 sequence (Roberts 2018): 1 / g and 1 / g^2 with g^3 = g + 1."""


@dataclass(frozen=True, eq=False, slots=True)
class ViewRays:
    """Rays of the pixels whose ray exists, in camera axes with z = 1."""

    known: NDArray[np.intp]
    """(N,) flat indices of those pixels; the lens model cannot reach the others."""
    through_centers: Array32
    """(N, 3) through the integer pixel centres."""
    along_u: Array32
    """(N, 3) change of the ray per pixel along u."""
    along_v: Array32
    """(N, 3) change of the ray per pixel along v."""

    def in_squares(self, shift: Array32, sample: int, rows: slice) -> Array32:
        """Return rays (M, 3) through one sample of each pixel's square, in camera axes.

        Over all samples a pixel's square is covered evenly: a lattice that each pixel shifts by an
        amount of its own (Cranley and Patterson 1976).

        Args:
            shift: (N, 2) in [0, 1), random per pixel.
            sample: which one, from 0.
            rows: which of the N pixels.
        """
        at = shift[rows] + np.float32(sample) * np.array(LATTICE, np.float32)
        at -= np.floor(at) + np.float32(0.5)
        out = at[:, :1] * self.along_u[rows]
        out += at[:, 1:] * self.along_v[rows]
        out += self.through_centers[rows]
        return np.asarray(out, np.float32)


def view_rays(intrinsics: CameraIntrinsics) -> ViewRays:
    """Return the rays of a camera's raw, distorted pixels."""
    table = camera.ray_table(intrinsics)
    known = np.flatnonzero(np.isfinite(table[..., 0].ravel()))
    slopes: list[Array32] = []
    for axis, f in ((1, intrinsics.fx), (0, intrinsics.fy)):
        # At the rim of the invertible region a neighbour is missing: the paraxial slope will do.
        paraxial = np.zeros(3, np.float32)
        paraxial[1 - axis] = 1.0 / f
        slope = np.broadcast_to(paraxial, table.shape)
        if table.shape[axis] > 1:
            steps = np.gradient(table, axis=axis)
            slope = np.where(np.isfinite(steps), steps, slope)
        slopes.append(slope.astype(np.float32).reshape(-1, 3)[known])
    return ViewRays(known, table.reshape(-1, 3)[known], slopes[0], slopes[1])


def in_world(rays: Array32, R_world_cam: Array) -> tuple[Array32, Array32]:
    """Return unit directions (N, 3) in world and the lengths (N,) of the rays they come from."""
    length = np.sqrt(np.einsum("ij,ij->i", rays, rays))
    return rotated(rays / length[:, None], R_world_cam), length
