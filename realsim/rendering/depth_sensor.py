"""What a stereo depth camera makes of exact depth: a model in disparity space.

A stereo camera measures d = f B / z in pixels, so everything that goes wrong goes wrong there:
noise of constant size in d becomes sigma_z = z^2 sigma_d / (f B), surfaces that only one eye sees
have no match, matches smear over depth edges. The defaults are those of a RealSense D405.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from realsim.errors import InputError
from realsim.records import CameraIntrinsics

Array = NDArray[np.float64]
Array32 = NDArray[np.float32]
Mask = NDArray[np.bool_]


@dataclass(frozen=True, kw_only=True, slots=True)
class DepthSensorModel:
    """A stereo depth camera. Every fault can be switched off by its zero."""

    baseline_m: float = 0.018
    """Distance of the two eyes [m]; the D405's 18 mm."""
    disparity_noise_px: float = 0.08
    """Standard deviation of the disparity [px]; the usual figure for RealSense stereo."""
    correlation_px: float = 2.0
    """Gaussian radius over which the noise is correlated [px]: the matching window. 0 = white."""
    quantum_px: float = 1 / 32
    """Step of the disparity [px]; the D4 chip interpolates to 1/32. 0 = continuous."""
    bias_px: float = 0.0
    """Constant error of the disparity [px]: a rectification that is off."""
    min_z_m: float = 0.07
    """Nearest depth [m]; the D405's at 848x480 (0.10 at 1280x720)."""
    max_z_m: float = 1.5
    """Farthest depth kept [m]; beyond it a D405 is wrong by centimetres."""
    occlusion: bool = True
    """Whether what only one eye sees is lost: shadows to the left of things, a left border band."""
    edge_jump_px: float = 1.0
    """Step of the disparity between neighbours that counts as a depth edge [px]."""
    edge_width_px: int = 1
    """Pixels on either side of a depth edge where matches go wrong [px]."""
    edge_dropout: float = 0.35
    """Share of the pixels at depth edges that are lost."""
    edge_flying: float = 0.25
    """Share of the pixels at depth edges that get a depth between the two surfaces."""
    grazing_from_deg: float = 72.0
    """Angle between ray and surface normal from which pixels begin to be lost [deg]."""
    grazing_to_deg: float = 88.0
    """Angle from which all pixels are lost [deg]; 90 or more with grazing_from_deg 90 = none."""
    blobs_per_megapixel: float = 5.0
    """Mean number of holes without cause (no texture, glare) per million pixels."""
    blob_radius_px: float = 5.0
    """Mean half-width of such a hole [px]."""

    def __post_init__(self) -> None:
        """Check the ranges."""
        if not (0.001 <= self.baseline_m <= 1.0):
            raise InputError(
                f"the depth sensor's baseline is {self.baseline_m} m; 0.001 to 1 m is accepted "
                "(0.018 for a D405). Were millimetres given?"
            )
        if not (0 <= self.min_z_m < self.max_z_m):
            raise InputError(f"the depth range {self.min_z_m} to {self.max_z_m} m is empty.")
        for name in ("disparity_noise_px", "correlation_px", "quantum_px", "blobs_per_megapixel",
                     "edge_dropout", "edge_flying"):  # fmt: skip
            if getattr(self, name) < 0:
                raise InputError(f"{name} is {getattr(self, name)}; 0 (off) or more is accepted.")
        if self.edge_dropout + self.edge_flying > 1:
            raise InputError("edge_dropout and edge_flying are shares: together at most 1.")

    @classmethod
    def noiseless(cls, quantum_px: float = 0.0) -> "DepthSensorModel":
        """Return a camera without faults: depth in range, rounded to `quantum_px` if not 0."""
        return cls(
            disparity_noise_px=0.0, quantum_px=quantum_px, occlusion=False, edge_dropout=0.0,
            edge_flying=0.0, grazing_from_deg=90.0, grazing_to_deg=90.0, blobs_per_megapixel=0.0,
        )  # fmt: skip

    def sigma_z(self, z_m: ArrayLike, intrinsics: CameraIntrinsics) -> Array:
        """Return the standard deviation of depth [m] at depths [m]: z^2 sigma_d / (f B)."""
        z = np.asarray(z_m, dtype=np.float64)
        return z * z * (self.disparity_noise_px / (intrinsics.fx * self.baseline_m))

    def measure(
        self, depth_m: ArrayLike, intrinsics: CameraIntrinsics, rng: np.random.Generator
    ) -> Array32:
        """Return what the camera reports for an exact depth picture.

        Args:
            depth_m: (H, W) depth along z [m], 0 = nothing.
            intrinsics: the camera; fx turns depth into disparity.
            rng: source of all chance; the same state gives the same bytes.

        Returns:
            (H, W) float32 depth [m], 0 = no measurement.
        """
        depth = np.asarray(depth_m, dtype=np.float32)
        if depth.shape != (intrinsics.height, intrinsics.width):
            raise InputError(
                f"the depth picture is {depth.shape[1]}x{depth.shape[0]}, the camera "
                f"{intrinsics.width}x{intrinsics.height}."
            )
        # All chance is drawn first and always, so that a pixel's fate depends on its own only.
        shape = depth.shape
        jitter = _correlated(rng, shape, self.correlation_px)
        fate = _uniform(_correlated(rng, shape, max(1.0, self.correlation_px / 2)))
        mix = rng.random(shape, dtype=np.float32)
        holes = self._blobs(rng, shape)

        fB = np.float32(intrinsics.fx * self.baseline_m)
        valid = depth > 0
        exact = np.where(valid, fB / np.where(valid, depth, 1), 0).astype(np.float32)
        disparity = exact
        if self.edge_dropout > 0 or self.edge_flying > 0:
            far, near = _neighbourhood(exact, valid, self.edge_width_px)
            edge = valid & (near - far > self.edge_jump_px)
            flying = edge & (fate > 1 - self.edge_flying)
            disparity = np.where(flying, far + mix * (near - far), disparity)
            valid = valid & ~(edge & (fate < self.edge_dropout))
        if self.grazing_from_deg < 90.0:
            valid = valid & (fate >= self._grazing_loss(exact, intrinsics))
        if self.occlusion:
            valid = valid & ~_half_occluded(exact)
        valid = valid & ~holes

        disparity = disparity + np.float32(self.bias_px)
        disparity = disparity + np.float32(self.disparity_noise_px) * jitter
        if self.quantum_px > 0:
            q = np.float32(self.quantum_px)
            disparity = np.round(disparity / q) * q
        valid = valid & (disparity > 0)
        z = np.where(valid, fB / np.where(valid, disparity, 1), 0).astype(np.float32)
        return np.where((z >= self.min_z_m) & (z <= self.max_z_m), z, np.float32(0))

    def _grazing_loss(self, disparity: Array32, intrinsics: CameraIntrinsics) -> Array32:
        """Return the share (H, W) of pixels lost because the surface is seen edge-on.

        On a plane n . X = 1 inverse depth is w = n . ray, linear in the pixel: with its slopes
        n = (fx w_u, fy w_v, w - (u - cx) w_u - (v - cy) w_v) and cos = w / (|n| |ray|). Disparity
        is w times a constant, which cancels.
        """
        i = intrinsics
        u = np.arange(i.width, dtype=np.float32)[None] - np.float32(i.cx)
        v = np.arange(i.height, dtype=np.float32)[:, None] - np.float32(i.cy)
        du, dv = _smooth_slope(disparity, 1), _smooth_slope(disparity, 0)
        nx, ny, nz = np.float32(i.fx) * du, np.float32(i.fy) * dv, disparity - u * du - v * dv
        ray = np.sqrt((u / np.float32(i.fx)) ** 2 + (v / np.float32(i.fy)) ** 2 + 1)
        cosine = disparity / np.maximum(np.sqrt(nx * nx + ny * ny + nz * nz) * ray, 1e-9)
        angle = np.degrees(np.arccos(np.clip(cosine, 0, 1)))
        span = max(self.grazing_to_deg - self.grazing_from_deg, 1e-6)
        return np.clip((angle - self.grazing_from_deg) / span, 0, 1).astype(np.float32)

    def _blobs(self, rng: np.random.Generator, shape: tuple[int, int]) -> Mask:
        """Return where (H, W) holes without cause lie: ellipses at random."""
        import cv2

        height, width = shape
        mask = np.zeros(shape, np.uint8)
        for _ in range(int(rng.poisson(self.blobs_per_megapixel * height * width / 1e6))):
            center = (int(rng.integers(width)), int(rng.integers(height)))
            half = np.maximum(1, np.round(rng.gamma(4.0, self.blob_radius_px / 4.0, 2)))
            angle = float(rng.uniform(0, 180))
            cv2.ellipse(mask, center, (int(half[0]), int(half[1])), angle, 0, 360, 1, -1)
        return mask > 0


def _correlated(rng: np.random.Generator, shape: tuple[int, int], sigma_px: float) -> Array32:
    """Return normal noise (H, W) of unit variance, correlated over a Gaussian radius."""
    import cv2

    pad = int(np.ceil(3 * sigma_px)) if sigma_px > 0 else 0
    noise = rng.standard_normal((shape[0] + 2 * pad, shape[1] + 2 * pad), dtype=np.float32)
    if pad == 0:
        return noise
    kernel: Any = cv2.getGaussianKernel(2 * pad + 1, sigma_px)
    # Scaled to unit length the kernel keeps the variance of white noise.
    kernel = np.asarray(kernel, np.float32) / np.float32(np.linalg.norm(kernel))
    smooth = np.asarray(cv2.sepFilter2D(noise, -1, kernel, kernel), np.float32)
    return np.ascontiguousarray(smooth[pad:-pad, pad:-pad])


def _uniform(normal: Array32) -> Array32:
    """Return numbers uniform in (0, 1) of the same rank as standard normal ones."""
    from scipy.special import ndtr

    return np.asarray(ndtr(normal), np.float32)


def _neighbourhood(disparity: Array32, valid: Mask, radius_px: int) -> tuple[Array32, Array32]:
    """Return the least and the greatest measured disparity (H, W) around each pixel."""
    import cv2

    kernel = np.ones((2 * radius_px + 1, 2 * radius_px + 1), np.uint8)
    big = np.float32(1e9)
    least = cv2.erode(np.where(valid, disparity, big), kernel)
    greatest = cv2.dilate(np.where(valid, disparity, -big), kernel)
    return np.asarray(least, np.float32), np.asarray(greatest, np.float32)


def _smooth_slope(values: Array32, axis: int) -> Array32:
    """Return the slope per pixel, the smaller of both sides', so that edges do not count."""
    if values.shape[axis] < 2:
        return np.zeros_like(values)
    step = np.diff(values, axis=axis)
    first, last = np.take(step, [0], axis=axis), np.take(step, [-1], axis=axis)
    ahead = np.concatenate([step, last], axis=axis)
    behind = np.concatenate([first, step], axis=axis)
    return np.where(np.abs(ahead) < np.abs(behind), ahead, behind)


def _half_occluded(disparity: Array32) -> Mask:
    """Return where (H, W) the right eye cannot see what the left eye, the picture, sees.

    Pixel u appears in the right eye at u - d. Along a row that order is kept unless something to
    the right is so near that it jumps in front: u' > u with u' - d' < u - d hides u. One running
    minimum from the right finds all such pixels. What leaves the right picture (u < d) has no
    match either.
    """
    width = disparity.shape[1]
    u = np.arange(width, dtype=np.float32)
    known = disparity > 0
    right = np.where(known, u - disparity, np.float32(1e9))
    least = np.minimum.accumulate(right[:, ::-1], axis=1)[:, ::-1]
    hidden = np.zeros(disparity.shape, dtype=bool)
    hidden[:, :-1] = least[:, 1:] < right[:, :-1]
    return known & (hidden | (right < -0.5))
