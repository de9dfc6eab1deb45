"""Views of placed meshes under a panorama and a sun, in linear radiance.

One primary ray per pixel, further ones where pixels are busy; rays to the sun; few ambient rays
per cell of pixels that look for gaps to the sky and for light off neighbours; reflected rays for
what is smooth. Everything but the casts is compiled, and nothing is random.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from realsim.arrays import Array, Array32, Int32, Mask, Rows
from realsim.compiled import njit
from realsim.errors import InputError
from realsim.geometry import camera
from realsim.records import CameraIntrinsics
from realsim.rendering.appearance import Environment
from realsim.rendering.casting.pixel_caster import FirstHits, PixelCaster
from realsim.rendering.embedded import ambient_cells, bounce_light
from realsim.rendering.embedded.edge_samples import (
    borrow_light,
    busy_pixels,
    pixel_lattice,
    settle_by_neighbours,
    world_rays,
)
from realsim.rendering.embedded.shading import MIRROR_UNTIL, shade
from realsim.rendering.embedded.sky_light import SkyArrays, background_level, map_at, sky_arrays
from realsim.rendering.embedded.surface_table import (
    SurfacePoints,
    empty_points,
    fill_points,
    surface_arrays,
)
from realsim.rendering.rays import HitBuffer, PlacedMesh, RayScene

BLOCK_RAYS = 1 << 18
"""Rays cast at a time: their arrays stay below 30 MB."""
LIFT_M = 1e-4
"""Secondary rays start this far off the surface, or rounding would let it shade itself."""
SMALL_SUN_RAD = 0.0175
"""Half the angle of a sun (1 deg) whose penumbrae are too narrow to need a ray in every pixel."""
FILTER_TAPS = ((2, 1, 1e9), (2, 3, 0.25))
"""A box of 4 cells (8 px) gathers the rays of one window; a coarser pass evens out what they leave,
except where the open share changes by this much: in contacts."""


@dataclass(frozen=True, kw_only=True, slots=True)
class LightSampling:
    """How many rays a view under an environment costs."""

    ambient_rays: int = 2
    """Rays per cell of 2 x 2 pixels towards sky and neighbours. A filter shares them over at least
    16 cells: against 64 rays without a filter, heaps of objects under lamps differ by 0.8 grey
    levels on average. 0 = nothing hides the sky."""
    edge_samples: int = 8
    """Rays per busy pixel: edges have so many levels, before the lens blurs them."""
    contrast: float = 0.10
    """Difference of neighbours from which a pixel is busy [1 = white, square-root scale]."""
    reflections: bool = True
    """Whether smooth surfaces mirror the scene, by one more ray; else the panorama only."""

    def __post_init__(self) -> None:
        """Check the ranges."""
        if not 0 <= self.ambient_rays <= 64 or not 1 <= self.edge_samples <= 64:
            raise InputError(
                f"light sampling: {self.ambient_rays} ambient rays and {self.edge_samples} edge "
                "samples; 0 to 64 and 1 to 64 are accepted."
            )
        if not self.contrast > 0:
            raise InputError(f"light sampling: the contrast {self.contrast} must be positive.")


@dataclass(frozen=True, eq=False, slots=True)
class _View:
    """One camera in one place."""

    eye: Array
    camera: tuple[Array, float, float]
    table: Array32
    pixel_rad: float
    exposure: float


@dataclass(frozen=True, eq=False, slots=True)
class _Seen:
    """What a bundle of rays sees."""

    points: SurfacePoints
    geometry: Int32
    directions: Array32


class EnvironmentRenderer:
    """Renders views of one scene under one environment."""

    def __init__(
        self, placed: Sequence[PlacedMesh], environment: Environment, sampling: LightSampling
    ) -> None:
        """Prepare surfaces, textures and the averaged panorama."""
        self._scene = RayScene(placed)
        self._caster = PixelCaster(placed)
        self._sampling = sampling
        self._environment = environment
        self._sky = sky_arrays(environment)
        self._surfaces, self._textures = surface_arrays(placed, self._scene.center)
        self._face_light = np.zeros((int(self._surfaces.first_face[-1]), 6), np.float32)
        bounce_light.face_light(self._sky, self._surfaces, self._face_light)
        self._has_sun = bool(np.any(self._sky.sun > 0))

    def radiance(
        self, intrinsics: CameraIntrinsics, T_world_cam: Array
    ) -> tuple[Array32, FirstHits]:
        """Return linear radiance (H, W, 3) of a view, and what its pixel centres see.

        Pixels without a ray are black.
        """
        height, width = intrinsics.height, intrinsics.width
        view = _View(
            eye=np.ascontiguousarray(T_world_cam[:3, 3]),
            camera=(np.ascontiguousarray(T_world_cam[:3, :3]), intrinsics.fx, intrinsics.fy),
            table=camera.ray_table(intrinsics),
            pixel_rad=1.0 / float(np.sqrt(intrinsics.fx * intrinsics.fy)),
            exposure=self._environment.exposure,
        )
        hits = self._caster.cast(intrinsics, T_world_cam)
        known = np.isfinite(view.table[..., 0]).ravel()
        rows = np.flatnonzero(known)
        rays = world_rays(view.table, view.camera, rows, np.zeros((1, 2), np.float32), 1.0)
        rays = _spread_rows(rays, rows, height * width)
        geometry = hits.geometry.ravel()
        seen = self._points(view, rays, (geometry, hits.face.ravel()))
        hit_rows = np.flatnonzero(geometry >= 0)

        ambient = self._ambient(seen, height, width)
        sunlit = self._sun_on_pixels(seen, hit_rows, height, width)
        mirrored = self._mirrored(view, seen, hit_rows)
        color = np.zeros((height * width, 3), np.float32)
        shade(self._sky, seen.points, geometry, rays[0], (ambient, sunlit, mirrored), color)
        _fill_background(self._sky, self._level(view), (geometry, rays[0]), color)
        color[~known] = 0.0
        if self._sampling.edge_samples > 1:
            size = (height, width, view.exposure, self._sampling.contrast)
            busy = busy_pixels(color, seen.points.base, geometry, sunlit, size) & known
            self._refine(view, seen, (ambient, mirrored), np.flatnonzero(busy), color)
        return color.reshape(height, width, 3), hits

    def _level(self, view: _View) -> int:
        """Return the halving of the panorama that suits the view's pixels."""
        return background_level(self._sky, view.pixel_rad)

    def _points(
        self,
        view: _View,
        rays: tuple[Array32, Array32, Array32],
        hits: tuple[Int32, Int32],
        pixels: tuple[SurfacePoints, Int32, Rows] | None = None,
    ) -> _Seen:
        """Return what rays see that meet these faces of these meshes; see `fill_points`."""
        points = empty_points(len(hits[0]))
        bundle = (view.eye, self._scene.center, *rays)
        fill_points(self._surfaces, self._textures, bundle, hits, points, pixels)
        return _Seen(points, hits[0], rays[0])

    def _sunlit(self, points: SurfacePoints, rows: Rows, share: tuple[Rows, int, int]) -> Array32:
        """Return (N,) 1 where the points `rows` see their part of the sun's disk, else 0."""
        out = np.zeros(len(points.roughness), np.float32)
        self._cast_to_sun(points, rows, share, out)
        return out

    def _sun_on_pixels(self, seen: _Seen, rows: Rows, height: int, width: int) -> Array32:
        """Return what `_sunlit` does for the pixels `rows` of a view, one ray each.

        Under a small sun every second pixel, like a chessboard's white squares, needs none if its
        four neighbours are on its mesh and agree.
        """
        every = np.arange(height * width)
        if self._sky.sun_radius > SMALL_SUN_RAD:
            return self._sunlit(seen.points, rows, (every, 1, width))
        out = np.zeros(height * width, np.float32)
        white = (rows // width + rows % width) % 2 == 0
        self._cast_to_sun(seen.points, rows[~white], (every, 1, width), out)
        rows = settle_by_neighbours(seen.geometry, rows[white], (height, width), out)
        self._cast_to_sun(seen.points, rows, (every, 1, width), out)
        return out

    def _cast_to_sun(
        self, points: SurfacePoints, rows: Rows, share: tuple[Rows, int, int], out: Array32
    ) -> None:
        """Fill `out` (N,) as `_sunlit` says."""
        if not self._has_sun:
            return
        s = self._sky.sun_direction.astype(np.float32)
        smooth = points.smooth
        toward = (smooth[:, 0] * s[0] + smooth[:, 1] * s[1] + smooth[:, 2] * s[2])[rows] > 0
        rows = rows[toward]
        for first in range(0, len(rows), BLOCK_RAYS):
            of = rows[first : first + BLOCK_RAYS]
            rays = _ray_buffers(len(of))
            bounce_light.sun_rays(self._sky, points, (of, *share), LIFT_M, rays)
            out[of] = ~self._scene.occluded(*rays)

    def _ambient(self, seen: _Seen, height: int, width: int) -> Array32:
        """Return the light (N, 4) from sky and neighbours on each point, and the open share."""
        n = self._sampling.ambient_rays
        pixels = ambient_cells.cell_pixels(seen.geometry, height, width)
        points, geometry = ambient_cells.taken(seen.points, pixels), seen.geometry[pixels]
        columns = -(-width // ambient_cells.CELL_PX)
        size = (len(pixels) // columns, columns)
        gathered = np.zeros((len(pixels), 5), np.float32)
        gathered[:, :2] = 1.0
        if n:
            self._gather(points, np.flatnonzero(geometry >= 0), columns, gathered)
            for taps in FILTER_TAPS:
                gathered = ambient_cells.edge_filtered(gathered, points, geometry, size, taps)
                ambient_cells.divide_by_whole(gathered)
        out = np.zeros((len(seen.geometry), 4), np.float32)
        cells = (points, geometry, gathered)
        ambient_cells.spread_cells(
            self._sky, cells, (seen.points, seen.geometry), (height, width), out
        )
        return out

    def _gather(self, points: SurfacePoints, rows: Rows, columns: int, out: Array32) -> None:
        """Fill the rows of `out` (R * C, 5) with what the ambient rays of these cells meet."""
        n = self._sampling.ambient_rays
        step = max(1, BLOCK_RAYS // n)
        for first in range(0, len(rows), step):
            of = rows[first : first + step]
            rays = _ray_buffers(len(of) * n)
            weights = np.empty(len(of) * n, np.float32)
            cells = (of, columns, n)
            bounce_light.ambient_rays(self._sky, points, cells, LIFT_M, (*rays, weights))
            face, lit, _ = self._neighbours(rays)
            met = (rays[1], weights, face, lit)
            bounce_light.gather_ambient(self._sky, self._face_light, met, (of, n), out)

    def _neighbours(self, rays: tuple[Array, Array32]) -> tuple[Int32, Mask, HitBuffer]:
        """Return face in the scene (N,), -1 = sky, whether the sun shines there, and the hits."""
        hits = self._scene.cast(*rays)
        face = np.full(len(hits.t), -1, np.int32)
        _number_faces(self._surfaces.first_face, hits.geometry, hits.face, face)
        lit = np.zeros(len(face), np.bool_)
        if self._has_sun:
            facing = np.empty(len(face), np.bool_)
            _find_facing(self._face_light, face, facing)
            rows = np.flatnonzero(facing)
            origins = np.empty((len(rows), 3))
            sun = self._sky.sun_direction.astype(np.float32)
            _arrivals(rays, (hits.t, hits.normal), rows, LIFT_M, origins)
            toward = np.ascontiguousarray(np.broadcast_to(sun, (len(rows), 3)))
            lit[rows] = ~self._scene.occluded(origins, toward)
        return face, lit, hits

    def _mirrored(self, view: _View, seen: _Seen, rows: Rows) -> Array32:
        """Return radiance (N, 4) that reflected rays of smooth points meet, and 1; else zeros."""
        out = np.zeros((len(seen.geometry), 4), np.float32)
        if not self._sampling.reflections:
            return out
        rows = rows[seen.points.roughness[rows] < MIRROR_UNTIL]
        for first in range(0, len(rows), BLOCK_RAYS):
            of = rows[first : first + BLOCK_RAYS]
            rays = _ray_buffers(len(of))
            bounce_light.mirror_rays(seen.points, of, view.eye, LIFT_M, rays)
            face, lit, hits = self._neighbours(rays)
            # A lobe of GGX is about alpha = roughness^2 wide on either side.
            lobe = 2 * np.square(seen.points.roughness[of]) + np.float32(view.pixel_rad)
            tint = np.empty((len(of), 3), np.float32)
            met = (hits.geometry, hits.face, hits.uv)
            bounce_light.fill_tints(self._surfaces, self._textures, met, hits.t * lobe, tint)
            _fill_mirrored(self._face_light, (face, lit, tint), of, out)
        return out

    def _refine(
        self, view: _View, pixels: _Seen, light: tuple[Array32, Array32], busy: Rows, color: Array32
    ) -> None:
        """Replace the colours of the pixels `busy` by the means over their squares."""
        height, width = view.table.shape[:2]
        n = self._sampling.edge_samples
        offsets = pixel_lattice(n)
        step = max(1, BLOCK_RAYS // n)
        scale = 1.0 / float(np.sqrt(n))
        for first in range(0, len(busy), step):
            of = busy[first : first + step]
            rays = world_rays(view.table, view.camera, of, offsets, scale)
            hits = self._scene.cast(view.eye, rays[0])
            owner = np.repeat(of, n)
            whole = (pixels.points, pixels.geometry, owner)
            seen = self._points(view, rays, (hits.geometry, hits.face), whole)
            rows = np.flatnonzero(hits.geometry >= 0)
            sunlit = self._sunlit(seen.points, rows, (owner, n, width))
            ambient = np.zeros((len(owner), 4), np.float32)
            mirrored = np.zeros((len(owner), 4), np.float32)
            borrow_light(
                self._sky, (seen.points, seen.geometry, owner),
                (pixels.points, pixels.geometry, *light), (height, width), (ambient, mirrored),
            )  # fmt: skip
            fine = np.zeros((len(owner), 3), np.float32)
            shade(self._sky, seen.points, seen.geometry, rays[0], (ambient, sunlit, mirrored), fine)
            _fill_background(self._sky, self._level(view), (seen.geometry, rays[0]), fine)
            color[of] = fine.reshape(len(of), n, 3).mean(1)


def _ray_buffers(n: int) -> tuple[Array, Array32]:
    """Return buffers of origins and directions for n rays."""
    return np.empty((n, 3)), np.empty((n, 3), np.float32)


def _spread_rows(
    rays: tuple[Array32, Array32, Array32], rows: Rows, n: int
) -> tuple[Array32, Array32, Array32]:
    """Return arrays of n rows with the given ones in their places, zeros elsewhere."""
    if len(rows) == n:
        return rays
    full = [np.zeros((n, 3), np.float32) for _ in rays]
    for target, source in zip(full, rays, strict=True):
        target[rows] = source
    return full[0], full[1], full[2]


@njit(error_model="numpy")
def _fill_background(sky: SkyArrays, level: int, rays: tuple[Int32, Array32], out: Array32) -> None:
    """Fill the radiance (N, 3) of rays that meet nothing: the panorama itself."""
    geometry, directions = rays
    for i in range(len(geometry)):
        if geometry[i] >= 0:
            continue
        x, y, z = directions[i, 0], directions[i, 1], directions[i, 2]
        length = np.sqrt(x * x + y * y + z * z)
        if length > 0:
            out[i, 0], out[i, 1], out[i, 2] = map_at(
                sky.panorama, level, x / length, y / length, z / length
            )


@njit(error_model="numpy")
def _number_faces(first_face: Rows, geometry: Int32, face: Int32, out: Int32) -> None:
    """Fill the number of each face in the scene (N,); -1 stays where there is none."""
    for i in range(len(geometry)):
        if geometry[i] >= 0:
            out[i] = first_face[geometry[i]] + face[i]


@njit(error_model="numpy")
def _find_facing(face_light: Array32, face: Int32, out: Mask) -> None:
    """Fill whether each face (N,) looks towards the sun."""
    for i in range(len(face)):
        f = face[i]
        out[i] = f >= 0 and face_light[f, 3] + face_light[f, 4] + face_light[f, 5] > 0


@njit(error_model="numpy")
def _arrivals(
    rays: tuple[Array, Array32], hits: tuple[Array32, Array32], rows: Rows, lift: float, out: Array
) -> None:
    """Fill where the rays `rows` (M,) arrive (M, 3), lifted off the face."""
    origins, directions = rays
    t, normal = hits
    for m in range(len(rows)):
        i = rows[m]
        for k in range(3):
            out[m, k] = origins[i, k] + t[i] * directions[i, k] + lift * normal[i, k]


@njit(error_model="numpy")
def _fill_mirrored(
    face_light: Array32, hits: tuple[Int32, Mask, Array32], rows: Rows, out: Array32
) -> None:
    """Fill the rows (M,) of `out` (N, 4) with what faces send back, and 1; the sky stays zero."""
    face, lit, tint = hits
    for m in range(len(rows)):
        f, i = face[m], rows[m]
        if f < 0:
            continue
        for k in range(3):
            light = face_light[f, k] + (face_light[f, 3 + k] if lit[m] else 0.0)
            out[i, k] = light * tint[m, k]
        out[i, 3] = 1.0
