"""Photographs of placed meshes on the CPU: same rays as the labels, sun, sky and shadows.

Not photoreal, but metrically right: the value of a pixel is the mean over the square around its
integer centre, in the raw distorted image, so printed edges lie where they are projected.
Pixels with contrast around them are supersampled, the others cost one ray.

Under a `Lighting` alone the picture is a linear sensor's in a soft even room, made for measuring.
Under an `Environment` it is lit by a panorama, materials are metallic-roughness, and the picture
is sRGB (see `environment_view`).

From linear light to the picture: exposure, noise of the sensor, highlights, sRGB.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from realsim.arrays import Array, Array32, Int32, UInt8
from realsim.compiled import njit
from realsim.errors import InputError
from realsim.geometry import camera, se3
from realsim.geometry.colors import srgb_encoded
from realsim.records import CameraIntrinsics
from realsim.rendering.appearance import Environment
from realsim.rendering.casting.pixel_caster import FirstHits, PixelCaster
from realsim.rendering.embedded import room_light
from realsim.rendering.embedded.edge_samples import world_rays
from realsim.rendering.embedded.environment_view import EnvironmentRenderer, LightSampling
from realsim.rendering.embedded.materials import check_projection
from realsim.rendering.rays import PlacedMesh, RayScene, rotated

SHOULDER = 0.8
"""Above this share of white the picture approaches white instead of clipping, so that highlights
keep their shape; below it, it is linear light in sRGB. A value of 1 becomes 247 of 255."""


def _encoding() -> Array32:
    """Return the 8-bit value (before rounding) at 4096 steps of the root of the light, to 4."""
    light = np.square(np.linspace(0.0, 2.0, 4096))
    bent = SHOULDER + (1 - SHOULDER) * (1 - np.exp(-(light - SHOULDER) / (1 - SHOULDER)))
    return (255.0 * srgb_encoded(np.where(light < SHOULDER, light, bent))).astype(np.float32)


ENCODING = _encoding()


def developed(
    light: Array32,
    rng: np.random.Generator | None = None,
    full_well: float = 9000.0,
    read_noise: float = 8.0,
) -> UInt8:
    """Return the picture (H, W, 3) of exposed linear light (H, W, 3), 1 = white.

    Args:
        light: radiance times exposure, not negative.
        rng: source of the sensor's noise; None = no noise.
        full_well: electrons at white; their square root is the shot noise.
        read_noise: electrons of noise in the dark.
    """
    noise = np.zeros((1, 1, 3), np.float32)
    if rng is not None:
        noise = rng.standard_normal(light.shape, dtype=np.float32)
    out = np.empty(light.shape, np.uint8)
    _develop(light, noise, rng is not None, (full_well, read_noise), ENCODING, out)
    return out


@njit(error_model="numpy")
def _develop(
    light: Array32,
    noise: Array32,
    is_noisy: bool,
    sensor: tuple[float, float],
    encoding: Array32,
    out: UInt8,
) -> None:
    """Fill the picture (H, W, 3); `noise` (H, W, 3) has the standard deviation 1."""
    full_well, dark = np.float32(sensor[0]), np.float32(sensor[1] * sensor[1])
    steps = np.float32(0.5 * (len(encoding) - 1))
    for y in range(light.shape[0]):
        for x in range(light.shape[1]):
            for k in range(3):
                value = min(max(light[y, x, k], np.float32(0)), np.float32(4))
                if is_noisy:
                    deviation = np.sqrt(value * full_well + dark) / full_well
                    value += noise[y, x, k] * deviation
                    value = min(max(value, np.float32(0)), np.float32(4))
                at = np.sqrt(value) * steps
                step = min(int(at), len(encoding) - 2)
                low = encoding[step]
                low += (at - np.float32(step)) * (encoding[step + 1] - low)
                out[y, x, k] = np.uint8(low + np.float32(0.5))


__all__ = ["Environment", "LightSampling", "Lighting", "Photo", "PhotoRenderer", "PlacedMesh"]

Color = tuple[float, float, float]
BLOCK_RAYS = 1 << 17
"""Rays shaded at a time: the working arrays stay near the processor's cache."""


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

    def rows(self) -> Array:
        """Return the light (7, 3) as the kernels take it, see `room_light.GROUND`."""
        gloss = (self.specular, self.shininess, 0.0)
        lights = (self.ground, self.sky, self.sun, self.horizon, self.zenith, self.floor, gloss)
        return np.array(lights)

    def R_sun_world(self) -> Array:
        """Return the rotation (3, 3) from world to the sun's frame, whose z is towards the sun."""
        T = se3.look_at(self.sun_direction, [0.0, 0.0, 0.0])
        return T[:3, :3].T * [[1.0], [-1.0], [-1.0]]


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Photo:
    """A rendered photograph."""

    rgb: UInt8
    """(H, W, 3) encoded colours."""
    depth_m: Array32
    """(H, W) exact depth along z at the pixel centres [m]; 0 = nothing."""
    geometry: Int32
    """(H, W) number of the placed mesh seen at the pixel centres; -1 = nothing."""


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
        self._surfaces = room_light.room_surfaces(self.placed, self.lighting.gamma)

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
            color, hits = self._in_the_room(intrinsics, T)
        if self.lighting.psf_px > 0:
            color = np.asarray(cv2.GaussianBlur(color, (0, 0), self.lighting.psf_px), np.float32)
        return color, hits

    def _in_the_room(self, intrinsics: CameraIntrinsics, T: Array) -> tuple[Array32, FirstHits]:
        """Return linear light (H, W, 3) under the `Lighting`, before the lens, and the hits."""
        light, n, i = self.lighting, self.lighting.samples, intrinsics
        hits, table = self._caster.cast(i, T), camera.ray_table(i)
        geometry, every = hits.geometry.ravel(), np.arange(i.height * i.width)
        # Far from the world's origin float32 would lose digits.
        to_center = se3.from_translation(-self._scene.center)
        Ts_center_obj = to_center @ np.array([p.T_world_obj for p in self.placed]).reshape(-1, 4, 4)
        view = room_light.room_view(light.rows(), light.R_sun_world(), Ts_center_obj, to_center @ T)
        pixel_rad = 1.0 / float(np.sqrt(i.fx * i.fy))
        color = self._lit(view, table.reshape(-1, 3), (geometry, hits.face.ravel()), pixel_rad)
        if n > 1:
            tone = np.empty(len(every), np.float32)
            room_light.tones(color, light.gamma, every, tone)
            busy = room_light.busy_among(tone, hits.geometry, light.contrast)
            rows = np.flatnonzero(busy & np.isfinite(table[..., 0]))
            offsets = ((np.arange(n) + 0.5) / n - 0.5).astype(np.float32)
            offsets = np.stack(np.meshgrid(offsets, offsets), -1).reshape(-1, 2)
            for of in np.array_split(rows, 1 + len(rows) * n * n // BLOCK_RAYS):
                parts, _, _ = world_rays(table, (np.eye(3), i.fx, i.fy), of, offsets, 1.0)
                seen = self._scene.cast(T[:3, 3], rotated(parts, T[:3, :3]))
                fine = self._lit(view, parts, (seen.geometry, seen.face), pixel_rad / n)
                color[of] = fine.reshape(len(of), n * n, 3).mean(1)
        return color.reshape(*table.shape[:2], 3), hits

    def _lit(
        self, view: room_light.RoomView, rays: Array32, hits: tuple[Int32, Int32], pixel_rad: float
    ) -> Array32:
        """Return the light (N, 3) that rays see: with one shadow ray each; see `sample_room`."""
        out, every = room_light.empty_samples(len(rays)), np.arange(len(rays))
        room_light.sample_room(self._surfaces, view, rays, hits, every, pixel_rad, out)
        lit = np.zeros(len(rays), np.bool_)
        to_sun, facing = room_light.sun_rays(out.toward_sun, view.R_sun_world.astype(np.float32))
        lit[facing] = ~self._scene.shadowed(to_sun)
        return room_light.lit_colors(out, lit)

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
