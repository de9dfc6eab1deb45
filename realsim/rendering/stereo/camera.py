"""A stereo depth camera, simulated from the light up: two pictures, matched.

Nothing is told to the matcher but the pictures: shadows at the left of things, fattened edges,
holes on blank surfaces and noise that grows with the square of the distance come about by
themselves. The left eye is the depth picture's camera, the right one stands at +baseline along x.

The rectified pair in which a stereo camera matches, and the way back to a distorted image.

What an eye sees: grey brightness of the first hits, and the bytes its sensor makes of it.

One compiled pass per eye: base colour, micro texture, room light, highlights and the projected
dots. Shadows of the room's own lamps are left out: they are soft, and they move no match. The
projector's shadow is nearly exact (from what both eyes see).
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import ArrayLike

from realsim.arrays import Array, Array32, Int32, UInt8, UInt16
from realsim.compiled import njit
from realsim.geometry import camera, se3
from realsim.records import CameraIntrinsics
from realsim.rendering.appearance import Environment
from realsim.rendering.casting.pixel_caster import FirstHits, PixelCaster
from realsim.rendering.depth_sensors.noise import correlated
from realsim.rendering.depth_sensors.profiles import DepthProfile
from realsim.rendering.rays import PlacedMesh
from realsim.rendering.stereo.config import StereoConfig
from realsim.rendering.stereo.matcher import matched
from realsim.rendering.stereo.shading import depth_between, dot_pattern, even_field, shade
from realsim.rendering.stereo.stripes import decoded
from realsim.rendering.stereo.surfaces import (
    RoomLight,
    SurfaceTables,
    block_axes,
    packed_noise,
    packed_surfaces,
    room_light,
)


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Projector:
    """The dot projector as one eye sees it."""

    pattern: Array32
    """(h, w) brightness over the tangent plane."""
    offset_m: float
    """Where it stands along this eye's x axis [m]."""
    power: float
    """Light of a dot on white at 1 m."""
    depth_m: Array32
    """(H, W) first hits from the projector with the eyes' intrinsics; 0 = nothing."""


def no_projector(shape: tuple[int, int]) -> Projector:
    """Return a projector that is off."""
    off = np.zeros((2, 2), np.float32)
    return Projector(pattern=off, offset_m=0.0, power=0.0, depth_m=np.zeros(shape, np.float32))


def radiance(
    hits: tuple[Array32, Int32, Int32],
    pinhole: tuple[float, float, float, float],
    Ts_obj_cam: Array,
    R_world_cam: Array,
    scene: tuple[SurfaceTables, RoomLight],
    projector: Projector,
    ambient: float,
) -> Array32:
    """Return the light (H, W) that comes in at every pixel, before lens and sensor.

    Args:
        hits: depth [m], placed mesh and face (H, W) of this eye; mesh -1 = nothing.
        pinhole: fx, fy, cx, cy [px].
        Ts_obj_cam: (G, 4, 4) this eye in each mesh's frame.
        R_world_cam: (3, 3).
        scene: what the surfaces look like, and the light.
        projector: the dots.
        ambient: factor of the room's light.
    """
    surfaces, light = scene
    grain = np.einsum("ij,gjk->gik", block_axes(), Ts_obj_cam[:, :3])
    grain[:, :, 3] += surfaces.looks[:, 5:8]
    placed = np.concatenate([Ts_obj_cam[:, :3], grain], 1).astype(np.float32)
    out = np.empty(hits[0].shape, np.float32)
    shade(
        hits,
        (np.array(pinhole, np.float32), placed, R_world_cam.astype(np.float32)),
        (surfaces.faces, surfaces.first_face, surfaces.looks, surfaces.images),
        (surfaces.texels, surfaces.levels, packed_noise()),
        (light.harmonics, light.reflections, light.sun_direction, np.float32(light.sun)),
        (
            projector.pattern,
            projector.depth_m,
            np.float32(projector.offset_m),
            np.float32(projector.power),
        ),
        np.float32(ambient),
        out,
    )
    return out


def exposed(light: Array32, gain: float, config: StereoConfig, rng: np.random.Generator) -> UInt8:
    """Return the sensor's bytes (H, W) uint8 of incoming light, times `gain` 1 = white.

    Lens blur, photon noise (Poisson's is Gaussian at tens of electrons and more), read noise.
    """
    import cv2

    if config.psf_px > 0:
        light = np.asarray(cv2.GaussianBlur(light, (0, 0), config.psf_px), np.float32)
    noise = rng.integers(0, 1 << 16, light.shape, dtype=np.uint16)
    dark, per_value = config.electron_noise
    out = np.empty(light.shape, np.uint8)
    _to_bytes(light, noise, _quantiles(), np.array([gain, dark, per_value], np.float32), out)
    return out


@lru_cache(maxsize=1)
def _quantiles() -> Array32:
    """Return the normal distribution at 65536 equal steps of probability: to 4.3 deviations.

    Looked up by sixteen random bits it costs a quarter of a normal random number.
    """
    from scipy.special import ndtri

    return np.asarray(ndtri((np.arange(1 << 16) + 0.5) / (1 << 16)), np.float32)


@njit(fastmath=True)
def _to_bytes(light: Array32, noise: UInt16, normal: Array32, sensor: Array32, out: UInt8) -> None:
    """Write bytes from light: value + sqrt(dark + value per_value) noise, clipped and rounded."""
    gain, dark, per_value = sensor
    white, half = np.float32(255.0), np.float32(0.5)
    for v in range(light.shape[0]):
        for u in range(light.shape[1]):
            value = min(max(light[v, u] * gain, np.float32(0.0)), np.float32(1.0))
            value += np.sqrt(dark + value * per_value) * normal[noise[v, u]]
            out[v, u] = np.uint8(min(max(value * white + half, np.float32(0.0)), white))


GREATEST_GROWTH = 1.5
"""The rectified picture is at most this many times as wide and high as the raw one: the rim of a
strong lens would need a boundless one, and is left without depth."""
SAME_SURFACE_PX = 1.0
"""Neighbouring disparities that differ by more are not blended [px]."""


def rectified_pinhole(intrinsics: CameraIntrinsics) -> CameraIntrinsics:
    """Return the undistorted camera at the same place that sees what `intrinsics` sees.

    The focal lengths stay, so a disparity means the same; without distortion nothing changes.
    """
    i = intrinsics
    if not i.is_distorted:
        return i
    rays = camera.ray_table(i)
    grow_x, grow_y = (GREATEST_GROWTH - 1) / 2 * i.width, (GREATEST_GROWTH - 1) / 2 * i.height
    u, v = rays[..., 0] * i.fx + i.cx, rays[..., 1] * i.fy + i.cy
    left = int(np.floor(max(float(np.nanmin(u)), -grow_x)))
    top = int(np.floor(max(float(np.nanmin(v)), -grow_y)))
    right = int(np.ceil(min(float(np.nanmax(u)), i.width - 1 + grow_x)))
    bottom = int(np.ceil(min(float(np.nanmax(v)), i.height - 1 + grow_y)))
    return CameraIntrinsics(
        width=right - left + 1, height=bottom - top + 1,
        fx=i.fx, fy=i.fy, cx=i.cx - left, cy=i.cy - top,
    )  # fmt: skip


def on_raw_grid(
    disparity: Array32, pinhole: CameraIntrinsics, intrinsics: CameraIntrinsics
) -> Array32:
    """Return a rectified disparity (H', W') on the raw image's pixels (H, W), 0 = none.

    Between four measured pixels of one surface it is interpolated; at edges and holes the nearest
    pixel counts, so that nothing is invented between two surfaces. Depth along z is the same in
    both, because they share the optical axis.
    """
    import cv2

    if not intrinsics.is_distorted:
        return disparity
    rays = camera.ray_table(intrinsics)
    x = (rays[..., 0] * pinhole.fx + pinhole.cx).astype(np.float32)
    y = (rays[..., 1] * pinhole.fy + pinhole.cy).astype(np.float32)
    outside = ~np.isfinite(x)
    x[outside] = y[outside] = -2.0
    kernel = np.ones((3, 3), np.uint8)
    even = cv2.dilate(disparity, kernel) - cv2.erode(disparity, kernel) < SAME_SURFACE_PX
    smooth = cv2.remap(disparity, x, y, cv2.INTER_LINEAR, borderValue=0)
    nearest = cv2.remap(disparity, x, y, cv2.INTER_NEAREST, borderValue=0)
    blend = cv2.remap(even.astype(np.uint8), x, y, cv2.INTER_NEAREST, borderValue=0) > 0
    return np.where(blend & (nearest > 0), smooth, nearest).astype(np.float32)


FULL_WIDTH_PX = 1280
"""Width for which a profile's nearest depth holds; the chip's search ends at a disparity, so at
fewer pixels it sees nearer (D400 data sheet, min-Z by resolution)."""
METER_EVERY_PX = 8
"""Automatic exposure looks at every eighth pixel of every eighth row."""
GLARE = 4.0
"""Highlights count for at most this many times the median in the exposure."""


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class StereoDepth:
    """What a stereo camera reports, and what its eyes saw."""

    depth_m: Array32
    """(H, W) depth along z [m]; 0 = no measurement."""
    disparity_px: Array32
    """(H, W) disparity [px]; 0 = none."""
    left: UInt8
    """(H', W') the left eye, rectified; H', W' = H, W where the camera has no distortion."""
    right: UInt8
    """(H', W') the right eye. Structured light: the scene in the projector's even light."""


class StereoCamera:
    """A stereo or structured-light camera in one scene, at any pose."""

    def __init__(
        self,
        placed: Sequence[PlacedMesh],
        profile: DepthProfile,
        config: StereoConfig | None = None,
        environment: Environment | None = None,
    ) -> None:
        """Prepare the scene, its surfaces and its light.

        Args:
            placed: the meshes.
            profile: baseline, range, pattern and step of the disparity.
            config: texture, light, sensor and matcher; None = the defaults.
            environment: the room's light; None = a grey room with a lamp.
        """
        self.profile = profile
        self.config = StereoConfig() if config is None else config
        self._placed = tuple(placed)
        self._caster = PixelCaster(self._placed)
        self._surfaces = packed_surfaces(self._placed, self.config.texture_contrast)
        self._light = room_light(environment)

    def measure(
        self, intrinsics: CameraIntrinsics, T_world_cam: ArrayLike, rng: np.random.Generator
    ) -> StereoDepth:
        """Return what the camera reports of a view.

        Args:
            intrinsics: the depth picture's camera, raw. With distortion the eyes are a rectified
                pair that covers it, as in the real device, and depth is resampled.
            T_world_cam: (4, 4) left eye in world [m].
            rng: source of all chance; the same state gives the same bytes.
        """
        T = se3.check_rigid(T_world_cam, "T_world_cam")
        pinhole = rectified_pinhole(intrinsics)
        hits = self._caster.cast(pinhole, T)
        fB = pinhole.fx * self.profile.baseline_m
        if self.profile.second_eye == "projector":
            disparity, left, right = self._decoded(pinhole, T, hits, rng)
        else:
            disparity, left, right = self._matched(pinhole, T, hits, rng)
        if self.config.noise_floor_px > 0:
            noise = correlated(rng, disparity.shape, self.config.window_px / 3.5)
            disparity += np.float32(self.config.noise_floor_px) * noise * (disparity > 0)
        disparity = on_raw_grid(disparity, pinhole, intrinsics)
        if self.profile.quantum_px > 0:
            quantum = np.float32(self.profile.quantum_px)
            disparity = np.round(disparity / quantum) * quantum
        nearest, farthest = self._range(intrinsics.width)
        keep = (disparity >= fB / farthest) & (disparity <= fB / nearest) & (disparity > 0)
        disparity = np.where(keep, disparity, np.float32(0)).astype(np.float32)
        depth = np.where(keep, np.float32(fB) / np.where(keep, disparity, 1), 0)
        return StereoDepth(
            depth_m=depth.astype(np.float32), disparity_px=disparity, left=left, right=right
        )

    def _range(self, width: int) -> tuple[float, float]:
        """Return the nearest and farthest depth [m] at an image width."""
        nearest = self.profile.min_z_m
        if self.profile.second_eye == "camera":
            nearest *= min(1.0, width / FULL_WIDTH_PX)
        return max(nearest, 1e-3), self.profile.max_z_m

    def _matched(
        self, pinhole: CameraIntrinsics, T: Array, hits: FirstHits, rng: np.random.Generator
    ) -> tuple[Array32, UInt8, UInt8]:
        """Return the matched disparity [px] and both eyes' pictures."""
        baseline = self.profile.baseline_m
        T_right = _shifted(T, baseline)
        config, fB = self.config, pinhole.fx * baseline
        hits_right = self._caster.cast(pinhole, T_right)
        emitter = no_projector(hits.depth_m.shape)
        second = emitter
        if self.profile.pattern == "dots" and config.dot_power > 0:
            at = config.projector_at
            shadow = depth_between(hits.depth_m, hits_right.depth_m, fB, at)
            pattern = dot_pattern(config.dot_spacing_mrad, config.dot_radius_mrad)
            emitter, second = (
                Projector(
                    pattern=pattern, offset_m=share * baseline, power=config.dot_power,
                    depth_m=shadow,
                )
                for share in (at, at - 1)
            )  # fmt: skip
        light = self._seen(pinhole, T, hits, emitter, config.ambient)
        gain = _exposure(light, hits, config.mean_level)
        left = exposed(light, gain, config, rng)
        light = self._seen(pinhole, T_right, hits_right, second, config.ambient)
        right = exposed(light, gain, config, rng)
        nearest, farthest = self._range(pinhole.width)
        z = hits.depth_m
        exact = np.zeros_like(z)
        np.divide(np.float32(fB), z, out=exact, where=(z >= nearest) & (z <= farthest))
        return matched(left, right, exact, config), left, right

    def _decoded(
        self, pinhole: CameraIntrinsics, T: Array, hits: FirstHits, rng: np.random.Generator
    ) -> tuple[Array32, UInt8, UInt8]:
        """Return the decoded disparity [px], the eye's picture and that in even pattern light."""
        config, baseline = self.config, self.profile.baseline_m
        shadow = self._caster.cast(pinhole, _shifted(T, baseline)).depth_m
        room = self._seen(pinhole, T, hits, no_projector(shadow.shape), config.ambient)
        lamp = Projector(pattern=even_field(), offset_m=baseline, power=1.0, depth_m=shadow)
        signal = self._seen(pinhole, T, hits, lamp, 0.0)
        disparity = decoded(hits.depth_m, shadow, signal, room, pinhole.fx * baseline, config, rng)
        left, right = (
            exposed(light, _exposure(light, hits, config.mean_level), config, rng)
            for light in (room, signal)
        )
        return disparity, left, right

    def _seen(
        self,
        pinhole: CameraIntrinsics,
        T_world_eye: Array,
        hits: FirstHits,
        projector: Projector,
        ambient: float,
    ) -> Array32:
        """Return the light (H, W) that reaches an eye."""
        poses = np.array([p.T_world_obj for p in self._placed]).reshape(-1, 4, 4)
        return radiance(
            (hits.depth_m, hits.geometry, hits.face),
            (pinhole.fx, pinhole.fy, pinhole.cx, pinhole.cy),
            se3.invert(poses) @ T_world_eye,
            T_world_eye[:3, :3],
            (self._surfaces, self._light),
            projector,
            ambient,
        )


def _shifted(T_world_cam: Array, along_x_m: float) -> Array:
    """Return a camera (4, 4) moved along its own x axis."""
    T = T_world_cam.copy()
    T[:3, 3] += along_x_m * T[:3, 0]
    return T


def _exposure(light: Array32, hits: FirstHits, mean_level: float) -> float:
    """Return the gain that gives what is in view the wanted mean, glare aside."""
    step = slice(None, None, METER_EVERY_PX)
    metered = light[step, step][hits.geometry[step, step] >= 0]
    if len(metered) == 0:
        metered = light[step, step].ravel()
    limit = GLARE * float(np.median(metered))
    mean = float(np.minimum(metered, limit).mean()) if limit > 0 else float(metered.mean())
    return mean_level / max(mean, 1e-6)
