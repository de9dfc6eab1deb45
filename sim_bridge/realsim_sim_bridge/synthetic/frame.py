"""One synthetic frame: the photograph, and the depth that a depth camera would report.

A frame's chance comes from (seed, number of the frame) alone, so its bytes do not depend on which
process renders it, or after which other frames.
"""

import time
from dataclasses import dataclass
from functools import lru_cache
from importlib.util import find_spec
from typing import Protocol

import numpy as np
from numpy.typing import ArrayLike

from realsim import images
from realsim.arrays import UInt8, UInt16
from realsim.errors import InputError
from realsim.interop import offer
from realsim.records import CameraIntrinsics
from realsim.rendering.depth_camera import DepthCamera
from realsim.rendering.depth_sensors.profiles import profile
from realsim.rendering.photo import Photo
from realsim_sim_bridge.synthetic.config import SyntheticConfig
from realsim_sim_bridge.synthetic.scene import SyntheticScene

PHOTO, DEPTH = 0, 1
"""Streams of chance of a frame: another depth camera leaves the photograph as it is."""


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class FrameJob:
    """What all frames of a session have in common."""

    synthetic: SyntheticScene
    intrinsics: CameraIntrinsics
    config: SyntheticConfig
    seed: int


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class SyntheticFrame:
    """One frame as it is stored."""

    rgb: UInt8
    """(H, W, 3) encoded colours."""
    depth_counts: UInt16
    """(H, W) what the depth camera reports, in the session's unit; 0 = none."""
    rgb_cpu_s: float
    """Cost of the photograph [s]."""
    depth_cpu_s: float
    """Cost of the depth image [s]."""
    notes: tuple[str, ...] = ()
    """What the renderer wants a person to know: that it is slower than it could be, say."""


class PictureSource(Protocol):
    """A renderer of photographs: the embedded or the photoreal one, which also has `notes`."""

    def render(
        self,
        intrinsics: CameraIntrinsics,
        T_world_cam: ArrayLike,
        rng: np.random.Generator | None = None,
    ) -> Photo:
        """Return the photograph of a view."""
        ...


class FrameRenderer:
    """Renders the frames of one scene; what can be built once is built once."""

    def __init__(self, job: FrameJob) -> None:
        """Build renderer and depth camera.

        Raises:
            InputError: the photoreal renderer cannot run here; the message names the fallback.
        """
        self.job = job
        self._pictures = picture_source(job.synthetic, job.config)
        self._depth = depth_camera(job.synthetic, job.config)

    def render(self, index: int, T_world_cam: ArrayLike) -> SyntheticFrame:
        """Return frame `index`, seen from a pose (4, 4) [m]."""
        job = self.job
        began = time.process_time()
        photo = self._pictures.render(job.intrinsics, T_world_cam, self._chance(index, PHOTO))
        between = time.process_time()
        chance = self._chance(index, DEPTH)
        depth_m = self._depth.measure(job.intrinsics, T_world_cam, chance, photo)
        return SyntheticFrame(
            rgb=photo.rgb,
            depth_counts=images.depth_counts(depth_m, job.config.unit_m),
            rgb_cpu_s=between - began,
            depth_cpu_s=time.process_time() - between,
            notes=tuple(getattr(self._pictures, "notes", ())),
        )

    def _chance(self, index: int, stream: int) -> np.random.Generator:
        return np.random.default_rng([self.job.seed, index, stream])


def require_renderer(config: SyntheticConfig) -> None:
    """Refuse a renderer that is not installed, before anything is made for it.

    Raises:
        InputError: it is not; the message names what to install and the fallback.
    """
    if config.renderer == "photoreal" and find_spec("mitsuba") is None:
        raise InputError(
            f"the photoreal renderer needs Mitsuba, which is not installed. {offer('photo')}, or "
            "use the embedded renderer, which needs no extra (--renderer embedded)."
        )


def picture_source(synthetic: SyntheticScene, config: SyntheticConfig) -> PictureSource:
    """Return the renderer that the config names."""
    placed = synthetic.placed()
    if config.renderer == "photoreal":
        from realsim.rendering.photoreal import PhotorealConfig, PhotorealRenderer

        return PhotorealRenderer(
            placed, synthetic.environment, PhotorealConfig(samples=config.samples)
        )
    from realsim.rendering.photo import PhotoRenderer

    return PhotoRenderer(placed, environment=synthetic.environment)


def depth_camera(synthetic: SyntheticScene, config: SyntheticConfig) -> DepthCamera:
    """Return the depth camera that the config names, before the scene.

    The noise model is told what only the scene knows: which surfaces the second eye cannot see, by
    rays to it, and which materials return too little light or mirror it away.
    """
    return DepthCamera(
        synthetic.placed(),
        config.depth_sensor(),
        profile=profile(config.profile),
        environment=synthetic.environment,
        exact_shadows=True,
        material_loss=True,
    )


# --- in another process -----------------------------------------------------------------------


def frame_of_job(job: FrameJob, index: int, T_world_cam: ArrayLike) -> SyntheticFrame:
    """Return a frame of a job; a worker builds its renderer at the first one."""
    return _renderer_of(job).render(index, T_world_cam)


def forget_job() -> None:
    """Let this process's renderer go; a scene's structures can be hundreds of megabytes."""
    _renderer_of.cache_clear()


@lru_cache(maxsize=1)
def _renderer_of(job: FrameJob) -> FrameRenderer:
    return FrameRenderer(job)
