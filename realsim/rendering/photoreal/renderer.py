"""Photoreal pictures of placed meshes: Mitsuba 3 path tracing, Open Image Denoise.

The rays are our own, through the raw distorted pixels, so the picture lies on the pixel grid of
the labels under every lens.

Path tracing along given rays: all at once in the compiled variant, one by one in the scalar.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from realsim.arrays import Array, Array32, Int32
from realsim.errors import InputError
from realsim.geometry import camera, se3
from realsim.records import CameraIntrinsics
from realsim.rendering.appearance import Environment
from realsim.rendering.photo import Photo, developed
from realsim.rendering.photoreal.mitsuba_scene import mitsuba_scene
from realsim.rendering.photoreal.variant import MitsubaVariant, Wanted, load_mitsuba
from realsim.rendering.rays import BACKGROUND, PlacedMesh, rotated

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


RIM_PX = 16
"""Mirrored pixels around the picture while it is denoised: the network errs by a tenth of the
light in the last pixels of a corner."""


def has_denoiser() -> bool:
    """Return whether Open Image Denoise can be loaded."""
    try:
        import pyoidn  # noqa: F401  # pyright: ignore[reportUnusedImport]
    except (ImportError, OSError):
        return False
    return True


def denoised(color: Array32, albedo: Array32, normal: Array32) -> Array32:
    """Return a picture without the noise of its few samples.

    The picture must be made with a box filter: a wider one correlates the noise of neighbouring
    pixels, and the network takes that for texture.

    Args:
        color: (H, W, 3) linear radiance.
        albedo: (H, W, 3) mean reflectance of what the pixels see, [0, 1].
        normal: (H, W, 3) mean normal of what the pixels see.
    """
    import pyoidn

    around = ((RIM_PX, RIM_PX), (RIM_PX, RIM_PX), (0, 0))
    images = [np.pad(image, around, mode="symmetric") for image in (color, albedo, normal)]
    clean = pyoidn.denoise(images[0], albedo=images[1], normal=images[2], hdr=True)
    inside = np.asarray(clean, np.float32)[RIM_PX:-RIM_PX, RIM_PX:-RIM_PX]
    return np.maximum(inside, 0.0)


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
