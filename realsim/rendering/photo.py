"""Photographs of placed meshes on the CPU: same rays as the labels, sun, sky and shadows.

Not photoreal, but metrically right: the value of a pixel is the mean over the square around its
integer centre, in the raw distorted image, so printed edges lie where they are projected.
Pixels with contrast around them are supersampled, the others cost one ray.

Under a `Lighting` alone the picture is a linear sensor's in a soft even room, made for measuring.
Under an `Environment` it is lit by a panorama, materials are metallic-roughness, and the picture
is sRGB (see `environment_view`).
"""

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import ArrayLike, NDArray

from realsim.arrays import Array, Array32, Int32, Mask, UInt8
from realsim.errors import InputError
from realsim.geometry import camera, se3
from realsim.records import CameraIntrinsics
from realsim.rendering.appearance import Environment
from realsim.rendering.casting.pixel_caster import FirstHits, PixelCaster
from realsim.rendering.developing import developed
from realsim.rendering.embedded.environment_view import EnvironmentRenderer, LightSampling
from realsim.rendering.embedded.materials import Surface, check_projection
from realsim.rendering.rays import PlacedMesh, RayScene, rotated

__all__ = ["Environment", "LightSampling", "Lighting", "Photo", "PhotoRenderer", "PlacedMesh"]

Color = tuple[float, float, float]
BLOCK_RAYS = 1 << 17
"""Rays shaded at a time: the working arrays stay near the processor's cache."""
SHADOW_LIFT_M = 1e-4
"""Shadow rays start this far off the surface, or rounding would shade it by itself."""


@dataclass(frozen=True, kw_only=True, slots=True)
class Lighting:
    """Light, lens and sensor of a photograph. Colours are linear, 1 = white paper in full light.

    Under an `Environment` only lens and sensor count: `psf_px`, `full_well` and `read_noise`.
    """

    sun_direction: Color = (0.35, -0.45, 1.0)
    """World direction towards the sun; oblique, so that shapes and contacts can be seen."""
    sun: Color = (0.50, 0.48, 0.44)
    """Radiance that a white surface facing the sun returns; with the sky just under 1."""
    sky: Color = (0.48, 0.49, 0.52)
    """Ambient light on a surface that faces up."""
    ground: Color = (0.26, 0.25, 0.23)
    """Ambient light on a surface that faces down."""
    horizon: Color = (0.42, 0.43, 0.45)
    """Background at eye level, for rays that meet nothing."""
    zenith: Color = (0.62, 0.65, 0.70)
    """Background straight up."""
    floor: Color = (0.20, 0.20, 0.21)
    """Background straight down."""
    specular: float = 0.10
    """Strength of the highlight on objects: satin plastic. Boards and tables are matte."""
    shininess: float = 40.0
    """Exponent of the highlight (Blinn-Phong)."""
    gamma: float = 1.0
    """Encoding exponent. 1 is a linear sensor, in which a blurred edge keeps its place; 2.2 looks
    like a monitor picture and pushes edges 0.1 to 0.2 px into the dark side, as cameras do."""
    samples: int = 4
    """Pixels with contrast get samples x samples rays; 4 leaves 1/16 of an edge's height."""
    contrast: float = 0.06
    """Range of brightness within 3x3 pixels from which a pixel is supersampled [1 = white]."""
    psf_px: float = 0.5
    """Standard deviation of the lens blur [px]; 0 = none. A good lens in focus."""
    full_well: float = 9000.0
    """Electrons at white: sets the shot noise, 1 % of white there."""
    read_noise: float = 8.0
    """Electrons of noise in the dark."""

    def __post_init__(self) -> None:
        """Check the ranges."""
        if self.samples < 1 or self.gamma <= 0 or self.full_well <= 0 or self.psf_px < 0:
            raise InputError(
                f"lighting: samples {self.samples}, gamma {self.gamma}, full_well "
                f"{self.full_well} must be positive and psf_px {self.psf_px} not negative."
            )
        if not np.linalg.norm(self.sun_direction) > 0:
            raise InputError("lighting: the sun has no direction; (0, 0, 1) is overhead.")


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Photo:
    """A rendered photograph."""

    rgb: UInt8
    """(H, W, 3) encoded colours."""
    depth_m: Array32
    """(H, W) exact depth along z at the pixel centres [m]; 0 = nothing."""
    geometry: Int32
    """(H, W) number of the placed mesh seen at the pixel centres; -1 = nothing."""


@dataclass(frozen=True, eq=False, slots=True)
class _Frame:
    """One view's rays and how they change from pixel to pixel."""

    eye: Array
    directions: Array32 = field()
    """(N, 3) through the pixel centres, in world, z = 1 in camera axes."""
    along_u: Array32 = field()
    """(N, 3) change of the direction per pixel along u."""
    along_v: Array32 = field()
    """(N, 3) change of the direction per pixel along v."""


class PhotoRenderer:
    """Renders photographs of one scene from any view."""

    def __init__(
        self,
        placed: Sequence[PlacedMesh],
        lighting: Lighting | None = None,
        environment: Environment | None = None,
        sampling: LightSampling | None = None,
    ) -> None:
        """Prepare the scene, its materials and its light.

        Args:
            placed: the meshes.
            lighting: light, lens and sensor; default `Lighting()`.
            environment: panorama and sun that light the scene instead.
            sampling: rays per pixel under an environment; default `LightSampling()`.

        Raises:
            InputError: a material with the projection 'uv' on a mesh without coordinates.
        """
        self.placed = tuple(placed)
        for number, p in enumerate(self.placed):
            check_projection(number, p)
        self.lighting = Lighting() if lighting is None else lighting
        self.environment = environment
        self._under_sky: EnvironmentRenderer | None = None
        if environment is not None:
            sampling = LightSampling() if sampling is None else sampling
            self._under_sky = EnvironmentRenderer(self.placed, environment, sampling)
            return
        self._scene = RayScene(self.placed)
        self._caster = PixelCaster(self.placed)
        self._surfaces = [Surface(p, self.lighting.gamma) for p in self.placed]
        sun = np.array(self.lighting.sun_direction)
        self._sun: Array32 = (sun / np.linalg.norm(sun)).astype(np.float32)

    def render(
        self,
        intrinsics: CameraIntrinsics,
        T_world_cam: ArrayLike,
        rng: np.random.Generator | None = None,
    ) -> Photo:
        """Return the photograph of a view.

        Args:
            intrinsics: the raw (distorted) camera.
            T_world_cam: (4, 4) camera in world [m].
            rng: source of the sensor noise; None = no noise.
        """
        light, hits = self.radiance(intrinsics, T_world_cam)
        if self.environment is None:
            rgb = self._expose(light, rng)
        else:
            lens = self.lighting
            light *= np.float32(self.environment.exposure)
            rgb = developed(light, rng, lens.full_well, lens.read_noise)
        return Photo(rgb=rgb, depth_m=hits.depth_m, geometry=hits.geometry)

    def radiance(
        self, intrinsics: CameraIntrinsics, T_world_cam: ArrayLike
    ) -> tuple[Array32, FirstHits]:
        """Return linear light (H, W, 3) behind the lens, before exposure and noise, and the hits.

        The hits are those at the pixel centres. Pixels that the lens model cannot reach are black.
        """
        import cv2

        T = se3.check_rigid(T_world_cam, "T_world_cam")
        if self._under_sky is not None:
            color, hits = self._under_sky.radiance(intrinsics, T)
        else:
            color, hits = self._in_the_room(intrinsics, T), self._caster.cast(intrinsics, T)
        if self.lighting.psf_px > 0:
            color = np.asarray(cv2.GaussianBlur(color, (0, 0), self.lighting.psf_px), np.float32)
        return color, hits

    def _in_the_room(self, intrinsics: CameraIntrinsics, T: Array) -> Array32:
        """Return linear light (H, W, 3) under the `Lighting`, before the lens."""
        height, width = intrinsics.height, intrinsics.width
        frame, known = _frame(intrinsics, T)
        pixel_rad = 1.0 / float(np.sqrt(intrinsics.fx * intrinsics.fy))
        seen, _, geometry = self._shade(frame.eye, frame.directions, pixel_rad)

        color = np.zeros((height * width, 3), np.float32)
        hit = np.full(height * width, -1, np.int32)
        color[known], hit[known] = seen, geometry
        color = color.reshape(height, width, 3)
        if self.lighting.samples > 1:
            busy = self._busy(color, hit.reshape(height, width)).ravel()
            rows = np.flatnonzero(busy[known])
            color.reshape(-1, 3)[known[rows]] = self._supersampled(frame, rows, pixel_rad)
        return color

    def _busy(self, color: Array32, geometry: Int32) -> Mask:
        """Return (H, W) where the neighbourhood has contrast or the edge of a mesh."""
        import cv2

        kernel = np.ones((3, 3), np.uint8)
        encoded = np.clip(color.mean(-1), 0.0, 1.0) ** np.float32(1.0 / self.lighting.gamma)
        span = cv2.dilate(encoded, kernel) - cv2.erode(encoded, kernel)
        mesh = geometry.astype(np.float32)
        edge = cv2.dilate(mesh, kernel) != cv2.erode(mesh, kernel)
        return (np.asarray(span) > self.lighting.contrast) | np.asarray(edge)

    def _supersampled(self, frame: _Frame, rows: NDArray[np.intp], pixel_rad: float) -> Array32:
        """Return the mean colours (M, 3) of the squares around the pixels `rows` (M,)."""
        n = self.lighting.samples
        offsets = ((np.arange(n) + 0.5) / n - 0.5).astype(np.float32)
        du, dv = (a.ravel() for a in np.meshgrid(offsets, offsets))
        step = max(1, BLOCK_RAYS // (n * n))
        out = np.empty((len(rows), 3), np.float32)
        for first in range(0, len(rows), step):
            of = rows[first : first + step]
            directions = np.repeat(frame.directions[of][:, None], n * n, axis=1)
            directions += du[:, None] * frame.along_u[of][:, None]
            directions += dv[:, None] * frame.along_v[of][:, None]
            color, _, _ = self._shade(frame.eye, directions.reshape(-1, 3), pixel_rad / n)
            out[first : first + step] = color.reshape(len(of), n * n, 3).mean(1)
        return out

    def _shade(
        self, eye: Array, directions: Array32, pixel_rad: float
    ) -> tuple[Array32, Array32, Int32]:
        """Return linear colours (N, 3), t (N,) and placed meshes (N,) seen along rays."""
        n = len(directions)
        color = np.empty((n, 3), np.float32)
        t = np.empty(n, np.float32)
        geometry = np.empty(n, np.int32)
        for first in range(0, n, BLOCK_RAYS):
            block = slice(first, first + BLOCK_RAYS)
            color[block], t[block], geometry[block] = self._shade_block(
                eye, directions[block], pixel_rad
            )
        return color, t, geometry

    def _shade_block(
        self, eye: Array, directions: Array32, pixel_rad: float
    ) -> tuple[Array32, Array32, Int32]:
        """Return what `_shade` does, for one block of rays."""
        hits = self._scene.cast(eye, directions)
        distance = np.sqrt(np.einsum("ij,ij->i", directions, directions))
        view = directions / distance[:, None]
        color = np.empty((len(view), 3), np.float32)
        for g in np.flatnonzero(np.bincount(hits.geometry + 1)) - 1:
            rows = np.flatnonzero(hits.geometry == g)
            if g < 0:
                color[rows] = self._background(view[rows])
                continue
            surface, toward = self._surfaces[g], -view[rows]
            face, uv = hits.face[rows], hits.uv[rows]
            weights = np.stack([1.0 - uv[:, 0] - uv[:, 1], uv[:, 0], uv[:, 1]], -1)
            flat = hits.normal[rows]
            # An open surface is lit from the side it is seen from.
            flat = flat * np.sign(np.einsum("ij,ij->i", flat, toward))[:, None]
            normal = surface.normal(face, weights)
            normal /= np.maximum(np.linalg.norm(normal, axis=-1, keepdims=True), 1e-12)
            normal = normal * np.sign(np.einsum("ij,ij->i", normal, flat))[:, None]
            at = eye + directions[rows].astype(np.float64) * hits.t[rows, None]
            paint = surface.reflectance(face, weights, hits.t[rows] * np.float32(pixel_rad))
            color[rows] = self._lit(at, flat, normal, toward, paint, surface.is_glossy)
        return color, hits.t, hits.geometry

    def _lit(
        self,
        at: Array,
        flat: Array32,
        normal: Array32,
        toward: Array32,
        paint: Array32,
        gloss: bool,
    ) -> Array32:
        """Return the light (N, 3) that points `at` send towards the eye.

        Lambert under hemispheric ambient light and a sun with one shadow ray, plus the highlight.
        """
        light = self.lighting
        up = 0.5 + 0.5 * normal[:, 2:3]
        ground, sky = np.array(light.ground, np.float32), np.array(light.sky, np.float32)
        facing = normal @ self._sun
        lit = np.flatnonzero((facing > 0) & (flat @ self._sun > 0))
        start = at[lit] + SHADOW_LIFT_M * flat[lit]
        free = ~self._scene.occluded(start, np.broadcast_to(self._sun, (len(lit), 3)))
        lit = lit[free]
        sun = np.array(light.sun, np.float32)
        out = np.asarray(ground + up * (sky - ground), np.float32)
        out[lit] += facing[lit, None] * sun
        out *= paint
        if gloss and light.specular > 0:
            half = toward[lit] + self._sun
            half /= np.maximum(np.linalg.norm(half, axis=-1, keepdims=True), 1e-12)
            shine = np.maximum(np.einsum("ij,ij->i", half, normal[lit]), 0) ** light.shininess
            out[lit] += (light.specular * shine)[:, None] * sun
        return out

    def _background(self, view: Array32) -> Array32:
        """Return the soft room (N, 3) behind everything, by the elevation of the ray."""
        light = self.lighting
        horizon = np.array(light.horizon, np.float32)
        up = np.sqrt(np.clip(view[:, 2:3], 0, 1))
        down = np.sqrt(np.clip(-view[:, 2:3], 0, 1))
        color = horizon + up * (np.array(light.zenith, np.float32) - horizon)
        color = color + down * (np.array(light.floor, np.float32) - horizon)
        return np.asarray(color, np.float32)

    def _expose(self, color: Array32, rng: np.random.Generator | None) -> UInt8:
        """Return the encoded picture: shot and read noise, saturation, gamma."""
        light = self.lighting
        value = np.clip(color, 0.0, 1.0)
        if rng is not None:
            variance = (value * light.full_well + light.read_noise**2) / light.full_well**2
            noise = rng.standard_normal(value.shape, dtype=np.float32)
            value = np.clip(value + np.sqrt(variance) * noise, 0.0, 1.0)
        if light.gamma != 1.0:
            value = value ** np.float32(1.0 / light.gamma)
        return np.round(255.0 * value).astype(np.uint8)


def _frame(intrinsics: CameraIntrinsics, T_world_cam: Array) -> tuple[_Frame, NDArray[np.intp]]:
    """Return the rays of the pixels whose ray exists, and those pixels' flat indices (N,)."""
    table = camera.ray_table(intrinsics)
    slopes: list[Array32] = []
    for axis, f in ((1, intrinsics.fx), (0, intrinsics.fy)):
        if table.shape[axis] > 1:
            slope = np.gradient(table, axis=axis).astype(np.float32)
        else:
            slope = np.full_like(table, np.nan)
        # At the rim of the invertible region a neighbour is missing: the paraxial slope will do.
        fallback = np.zeros(3, np.float32)
        fallback[1 - axis] = 1.0 / f
        slopes.append(np.where(np.isfinite(slope), slope, fallback))
    known = np.flatnonzero(np.isfinite(table[..., 0].ravel()))
    R = T_world_cam[:3, :3]
    directions, along_u, along_v = (
        rotated(a.reshape(-1, 3)[known], R) for a in (table, slopes[0], slopes[1])
    )
    return _Frame(T_world_cam[:3, 3], directions, along_u, along_v), known
