"""One synthetic frame: the photograph, and the depth that a depth camera would report.

A frame's chance comes from (seed, number of the frame) alone, so its bytes do not depend on which
process renders it, or after which other frames.
"""

import pickle
import time
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from realsim.formats import images
from realsim.records import CameraIntrinsics
from realsim.rendering.depth_sensors.profiles import profile
from realsim.rendering.photo import Photo
from realsim_sim_bridge.synthetic.config import SyntheticConfig
from realsim_sim_bridge.synthetic.scene import SyntheticScene

Array32 = NDArray[np.float32]
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

    rgb: NDArray[np.uint8]
    """(H, W, 3) encoded colours."""
    depth_counts: NDArray[np.uint16]
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


class DepthSource(Protocol):
    """A depth camera that looks at the scene."""

    def measure(
        self,
        exact_m: Array32,
        intrinsics: CameraIntrinsics,
        T_world_cam: ArrayLike,
        rng: np.random.Generator,
    ) -> Array32:
        """Return what it reports (H, W) [m] where the exact depth is `exact_m`; 0 = none."""
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
        self._depth = depth_source(job.synthetic, job.config)

    def render(self, index: int, T_world_cam: ArrayLike) -> SyntheticFrame:
        """Return frame `index`, seen from a pose (4, 4) [m]."""
        job = self.job
        began = time.process_time()
        photo = self._pictures.render(job.intrinsics, T_world_cam, self._chance(index, PHOTO))
        between = time.process_time()
        depth_m = self._depth.measure(
            photo.depth_m, job.intrinsics, T_world_cam, self._chance(index, DEPTH)
        )
        return SyntheticFrame(
            rgb=photo.rgb,
            depth_counts=images.depth_counts(depth_m, job.config.unit_m),
            rgb_cpu_s=between - began,
            depth_cpu_s=time.process_time() - between,
            notes=tuple(getattr(self._pictures, "notes", ())),
        )

    def _chance(self, index: int, stream: int) -> np.random.Generator:
        return np.random.default_rng([self.job.seed, index, stream])


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


def depth_source(synthetic: SyntheticScene, config: SyntheticConfig) -> DepthSource:
    """Return the depth camera that the config names."""
    if config.depth == "clean":
        return _Clean()
    if config.depth == "stereo":
        return _Stereo(synthetic, config)
    return _Disparity(config)


class _Clean:
    """Reports exact depth."""

    def measure(
        self,
        exact_m: Array32,
        intrinsics: CameraIntrinsics,
        T_world_cam: ArrayLike,
        rng: np.random.Generator,
    ) -> Array32:
        return exact_m


class _Disparity:
    """The noise model on exact disparity."""

    def __init__(self, config: SyntheticConfig) -> None:
        from realsim.rendering.depth_sensors.model import DepthSensorModel

        self._model = DepthSensorModel.from_profile(profile(config.profile))

    def measure(
        self,
        exact_m: Array32,
        intrinsics: CameraIntrinsics,
        T_world_cam: ArrayLike,
        rng: np.random.Generator,
    ) -> Array32:
        return self._model.measure(exact_m, intrinsics, rng)


class _Stereo:
    """Both eyes' pictures, matched."""

    def __init__(self, synthetic: SyntheticScene, config: SyntheticConfig) -> None:
        from realsim.rendering.stereo import StereoCamera

        self._camera = StereoCamera(
            synthetic.placed(), profile(config.profile), environment=synthetic.environment
        )

    def measure(
        self,
        exact_m: Array32,
        intrinsics: CameraIntrinsics,
        T_world_cam: ArrayLike,
        rng: np.random.Generator,
    ) -> Array32:
        return self._camera.measure(intrinsics, T_world_cam, rng).depth_m


# --- in another process -----------------------------------------------------------------------


def keep_job(job: FrameJob, path: Path) -> None:
    """Write what all frames have in common where the workers find it."""
    path.write_bytes(pickle.dumps(job))


def frame_of_job(path: str, index: int, T_world_cam: ArrayLike) -> SyntheticFrame:
    """Return a frame of the job kept at `path`; a worker builds its renderer at the first one."""
    return _renderer_of(path).render(index, T_world_cam)


def forget_job() -> None:
    """Let this process's renderer go; a scene's structures can be hundreds of megabytes."""
    _renderer_of.cache_clear()


@lru_cache(maxsize=1)
def _renderer_of(path: str) -> FrameRenderer:
    # Only files that this run has written itself are unpickled.
    job: FrameJob = pickle.loads(Path(path).read_bytes())
    return FrameRenderer(job)
