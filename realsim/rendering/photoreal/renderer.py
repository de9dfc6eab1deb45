"""Photoreal pictures of placed meshes: Mitsuba 3 path tracing, Open Image Denoise.

The rays are our own, through the raw distorted pixels, so the picture lies on the pixel grid of
the labels under every lens.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from realsim.arrays import Array32, Int32
from realsim.errors import InputError
from realsim.geometry import se3
from realsim.records import CameraIntrinsics
from realsim.rendering.appearance import Environment
from realsim.rendering.developing import developed
from realsim.rendering.photo import Photo
from realsim.rendering.photoreal.mitsuba_scene import mitsuba_scene
from realsim.rendering.photoreal.tracing import (
    PathTracer,
    denoised,
    has_denoiser,
    in_world,
    view_rays,
)
from realsim.rendering.photoreal.variant import Wanted, load_mitsuba
from realsim.rendering.rays import BACKGROUND, PlacedMesh

NO_DENOISER = (
    "photoreal pictures are not denoised, because Open Image Denoise is not installed "
    "(`pip install 'realsim[photo]'` brings it as pyoidn); 64 samples or more then look clean."
)


@dataclass(frozen=True, kw_only=True, slots=True)
class PhotorealConfig:
    """How many rays a pixel gets, and what is done with them."""

    samples: int = 8
    """Paths per pixel. With the denoiser 8 look clean; without it 64 or more are needed."""
    max_depth: int = 6
    """Segments of a path, the one from the camera included: 6 light the inside of a cup."""
    denoise: bool = True
    """Whether Open Image Denoise cleans the picture, where it is installed."""
    variant: Wanted = "auto"
    """`llvm`: compiled, needs LLVM 19 or newer; `scalar`: always works, several times slower;
    `auto`: the first if it works here, else the second with a note."""
    psf_px: float = 0.5
    """Standard deviation of the lens blur [px], as of the embedded renderer; 0 = none."""

    def __post_init__(self) -> None:
        """Check the ranges."""
        if self.samples < 1 or self.max_depth < 1 or not self.psf_px >= 0:
            raise InputError(
                f"photoreal: samples {self.samples}, max_depth {self.max_depth}, psf_px "
                f"{self.psf_px}; 1 or more samples and segments and a blur of 0 or more are "
                "accepted."
            )
        if self.variant not in ("auto", "llvm", "scalar"):
            raise InputError(
                f"photoreal: the variant is '{self.variant}'; auto, llvm or scalar is accepted."
            )


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class FirstHits:
    """What the rays through the pixel centres meet first, as the path tracer sees it."""

    instance: Int32
    """(H, W) instance; -1 = background or nothing."""
    geometry: Int32
    """(H, W) index of the placed mesh; -1 = nothing."""
    depth_m: Array32
    """(H, W) depth along z [m]; 0 = nothing."""


class PhotorealRenderer:
    """Renders photoreal pictures of one scene from any view; scene and kernels are kept."""

    def __init__(
        self,
        placed: Sequence[PlacedMesh],
        environment: Environment,
        config: PhotorealConfig | None = None,
    ) -> None:
        """Load Mitsuba and prepare the scene.

        Args:
            placed: the meshes; looks are chosen as by the embedded renderer.
            environment: panorama and sun.
            config: samples and variant (default: `PhotorealConfig()`).

        Raises:
            InputError: Mitsuba is not installed, or the variant `llvm` is asked for and no LLVM
                library works here.
        """
        self.placed = tuple(placed)
        self.environment = environment
        self.config = PhotorealConfig() if config is None else config
        loaded = load_mitsuba(self.config.variant)
        self._denoises = self.config.denoise and has_denoiser()
        self.variant: str = loaded.name
        """Mitsuba's variant in use: `llvm_ad_rgb` or `scalar_rgb`."""
        self.notes: tuple[str, ...] = loaded.notes
        """What a person should be told: slower or noisier than it could be, and what helps."""
        if self.config.denoise and not self._denoises:
            self.notes = (*self.notes, NO_DENOISER)
        self._scene = mitsuba_scene(loaded.activate(), self.placed, environment)
        self._tracer = PathTracer(loaded, self._scene.scene, self.config.max_depth)
        self._instances = np.array([*(p.instance for p in self.placed), BACKGROUND], np.int32)

    def render(
        self,
        intrinsics: CameraIntrinsics,
        T_world_cam: ArrayLike,
        rng: np.random.Generator | None = None,
    ) -> Photo:
        """Return the picture of a view.

        The value of a pixel is the mean over the square around its integer centre; pixels that
        the lens model cannot reach are black.

        Args:
            intrinsics: the raw (distorted) camera.
            T_world_cam: (4, 4) camera in world [m].
            rng: source of the paths and of the sensor noise; None = always the same paths and no
                sensor noise.
        """
        import cv2

        T = se3.check_rigid(T_world_cam, "T_world_cam")
        seed = 0 if rng is None else int(rng.integers(1 << 31))
        shape = (intrinsics.height, intrinsics.width, 3)
        rays = view_rays(intrinsics)
        images = np.zeros((3, shape[0] * shape[1], 3), np.float32)
        images[:, rays.known] = self._tracer.traced(
            rays, T[:3, :3], T[:3, 3] - self._scene.center, self.config.samples, seed
        )
        light, albedo, normal = images.reshape(3, *shape)
        light = light * np.float32(self.environment.exposure)
        if self._denoises:
            light = denoised(light, albedo, normal)
        if self.config.psf_px > 0:
            light = np.asarray(cv2.GaussianBlur(light, (0, 0), self.config.psf_px), np.float32)
        hits = self.first_hits(intrinsics, T)
        return Photo(rgb=developed(light, rng), depth_m=hits.depth_m, geometry=hits.geometry)

    def first_hits(self, intrinsics: CameraIntrinsics, T_world_cam: ArrayLike) -> FirstHits:
        """Return what the path tracer meets through the pixel centres; arguments as of `render`."""
        T = se3.check_rigid(T_world_cam, "T_world_cam")
        height, width = intrinsics.height, intrinsics.width
        rays = view_rays(intrinsics)
        directions, length = in_world(rays.through_centers, T[:3, :3])
        shape, t = self._tracer.first_hits(T[:3, 3] - self._scene.center, directions)
        of_known = self._scene.geometry_of_shape[shape]
        geometry = np.full(height * width, -1, np.int32)
        depth = np.zeros(height * width, np.float32)
        geometry[rays.known] = of_known
        depth[rays.known] = np.where(of_known >= 0, t, 0) / length
        return FirstHits(
            instance=self._instances[geometry].reshape(height, width),
            geometry=geometry.reshape(height, width),
            depth_m=depth.reshape(height, width),
        )
