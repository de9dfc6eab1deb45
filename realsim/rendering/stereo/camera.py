"""A stereo depth camera, simulated from the light up: two pictures, matched.

Nothing is told to the matcher but the pictures: shadows at the left of things, fattened edges,
holes on blank surfaces and noise that grows with the square of the distance come about by
themselves. The left eye is the depth picture's camera, the right one stands at +baseline along x.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from realsim.arrays import Array, Array32, UInt8
from realsim.geometry import se3
from realsim.records import CameraIntrinsics
from realsim.rendering.appearance import Environment
from realsim.rendering.casting.pixel_caster import FirstHits, PixelCaster
from realsim.rendering.depth_sensors.noise import correlated
from realsim.rendering.depth_sensors.profiles import DepthProfile
from realsim.rendering.rays import PlacedMesh
from realsim.rendering.stereo.config import StereoConfig
from realsim.rendering.stereo.eyes import Projector, exposed, no_projector, radiance
from realsim.rendering.stereo.light import room_light
from realsim.rendering.stereo.matcher import matched
from realsim.rendering.stereo.projector import depth_between, dot_pattern, even_field
from realsim.rendering.stereo.rectified import on_raw_grid, rectified_pinhole
from realsim.rendering.stereo.stripes import decoded
from realsim.rendering.stereo.surfaces import packed_surfaces

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
