"""Path tracing along given rays: all at once in the compiled variant, one by one in the scalar."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from realsim.rendering.photoreal.pixel_samples import ViewRays, in_world
from realsim.rendering.photoreal.variant import MitsubaVariant

Array = NDArray[np.float64]
Array32 = NDArray[np.float32]
Int32 = NDArray[np.int32]
BLOCK_RAYS = 1 << 20
"""Rays traced at a time: 100 MB of working arrays."""
KEPT = (0, 1, 2, 4, 5, 6, 7, 8, 9)
"""Channels of the integrator: the picture's RGB (alpha is left out), then the two guides of the
denoiser, albedo and normal."""


class PathTracer:
    """Light, albedo and normal along rays."""

    def __init__(self, variant: MitsubaVariant, scene: Any, max_depth: int) -> None:
        """Prepare the integrator.

        Args:
            variant: Mitsuba.
            scene: mitsuba.Scene of that variant.
            max_depth: segments of a path, the one from the camera included.
        """
        self._variant = variant
        self._scene = scene
        mi = variant.activate()
        self._integrator: Any = mi.load_dict(
            {
                "type": "aov",
                "aovs": "albedo:albedo,normal:sh_normal",
                "picture": {"type": "path", "max_depth": max_depth},
            }
        )
        self._sampler: Any = mi.load_dict({"type": "independent"})

    def traced(
        self, rays: ViewRays, R_world_cam: Array, eye: Array, samples: int, seed: int
    ) -> Array32:
        """Return the means (3, N, 3) of radiance, albedo and normal over the pixels' squares.

        Args:
            rays: the N pixels.
            R_world_cam: (3, 3) camera in world.
            eye: (3,) camera in the scene's coordinates [m].
            samples: paths per pixel.
            seed: of the paths.
        """
        n = len(rays.known)
        rng = np.random.default_rng(seed)
        shift = rng.random((n, 2), dtype=np.float32)
        total = np.zeros((3, n, 3), np.float32)
        for first in range(0, n, BLOCK_RAYS):
            rows = slice(first, min(first + BLOCK_RAYS, n))
            for sample in range(samples):
                in_camera = rays.in_squares(shift, sample, rows)
                directions, _ = in_world(in_camera, R_world_cam)
                total[:, rows] += self._sampled(eye, directions, int(rng.integers(1 << 31)))
        return total / np.float32(samples)

    def _sampled(self, eye: Array, directions: Array32, seed: int) -> Array32:
        """Return radiance, albedo and normal (3, N, 3) along one path per direction (N, 3)."""
        mi = self._variant.activate()
        n = len(directions)
        out = np.empty((3, n, 3), np.float32)
        if self._variant.is_compiled:
            self._sampler.seed(seed, n)
            ray = mi.RayDifferential3f(self._point(eye), self._vectors(directions))
            _, _, values = self._integrator.sample(self._scene, self._sampler, ray)
            import drjit

            # All at once: a channel that is read alone has its paths traced for itself.
            drjit.eval(values)
            for i, channel in enumerate(KEPT):
                out[i // 3, :, i % 3] = _filled(values[channel], n)
        else:
            self._sampler.seed(seed)
            point, sample = self._point(eye), self._integrator.sample
            for i, d in enumerate(directions.tolist()):
                ray = mi.RayDifferential3f(point, mi.Vector3f(d))
                values = sample(self._scene, self._sampler, ray)[2]
                out[:, i] = np.take(values, KEPT).reshape(3, 3)
        return np.nan_to_num(out, copy=False, nan=0.0, posinf=0.0, neginf=0.0)

    def first_hits(self, eye: Array, directions: Array32) -> tuple[Int32, Array32]:
        """Return shape (N,), -1 = nothing, and distance (N,) [m] along unit directions (N, 3)."""
        mi = self._variant.activate()
        n = len(directions)
        if self._variant.is_compiled:
            ray = mi.Ray3f(self._point(eye), self._vectors(directions))
            hit = self._scene.ray_intersect_preliminary(ray)
            valid = _filled(hit.is_valid(), n)
            shape = np.where(valid, _filled(hit.shape_index, n).astype(np.int64), -1)
            return shape.astype(np.int32), np.where(valid, _filled(hit.t, n), np.inf)
        shape, distance = np.full(n, -1, np.int32), np.full(n, np.inf, np.float32)
        point, meet = self._point(eye), self._scene.ray_intersect_preliminary
        for i, d in enumerate(directions.tolist()):
            hit = meet(mi.Ray3f(point, mi.Vector3f(d)))
            if hit.is_valid():
                shape[i], distance[i] = hit.shape_index, hit.t
        return shape, distance

    def _point(self, eye: Array) -> Any:
        """Return the eye as Mitsuba's point, opaque to the compiler: a camera is not a constant."""
        mi = self._variant.module
        if not self._variant.is_compiled:
            return mi.ScalarPoint3f(eye.tolist())
        import drjit

        point = mi.Point3f(eye.tolist())
        drjit.make_opaque(point)
        return point

    def _vectors(self, directions: Array32) -> Any:
        """Return directions (N, 3) as Mitsuba's array of vectors."""
        return self._variant.module.Vector3f(np.ascontiguousarray(directions.T))


def _filled(values: Any, n: int) -> NDArray[Any]:
    """Return a compiled array as (N,): the compiler keeps constants as one value."""
    return np.broadcast_to(np.array(values).reshape(-1), (n,))
