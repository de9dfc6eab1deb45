"""What a stereo depth camera makes of exact depth: a model in disparity space.

A stereo camera measures d = f B / z in pixels, so everything that goes wrong goes wrong there:
noise of constant size in d becomes sigma_z = z^2 sigma_d / (f B), surfaces that only one eye sees
have no match, matches smear over depth edges. The defaults are what was assumed of a RealSense D405
before one was measured; `from_profile("d405")` is as measured.

What the steps of `DepthSensorModel.measure` need stands beside this file: which surfaces only one
eye sees (shadow), what is lost (loss), and noise (noise).
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from realsim.arrays import Array, Array32, Mask
from realsim.errors import InputError
from realsim.records import CameraIntrinsics
from realsim.rendering.depth_sensors.loss import (
    blob_mask,
    cosine_of_view,
    grazing_loss,
    half_occluded,
    require_same_size,
    shadow_mask,
    signal_loss,
)
from realsim.rendering.depth_sensors.noise import (
    correlated,
    fixed_pattern,
    native_pixels,
    slow,
    uniform,
    whole_pixel,
)
from realsim.rendering.depth_sensors.profiles import DepthProfile, SensorRecord, profile
from realsim.rendering.rays import RayScene

ASSUMED_BY_PATTERN: dict[str, dict[str, float]] = {
    "none": {},
    "dots": {"disparity_noise_px": 0.06, "correlation_px": 2.5},
    "stripes": {
        "disparity_noise_px": 0.06, "correlation_px": 1.5, "edge_width_px": 2,
        "column_band_px": 0.03, "grazing_from_deg": 68.0, "grazing_to_deg": 85.0,
    },
}  # fmt: skip
"""What differs from the defaults with each pattern: assumptions, to be replaced by a fit."""
MEASURED: dict[str, dict[str, float]] = {
    "d405": {
        "disparity_noise_px": 0.094, "correlation_px": 4.1, "correlation_aspect": 0.74,
        "whole_pixel_gain": 0.52, "edge_width_px": 2, "edge_dropout": 0.5,
        "border_margin_px": 6.6, "blobs_per_megapixel": 80.0, "blob_radius_px": 1.1,
        "min_z_m": 0.05, "most_disparity_px": 126.0,
    },
}  # fmt: skip
"""What `realsim depth-fit` found on frames of a camera of the kind (docs/decisions/0024)."""


@dataclass(frozen=True, kw_only=True, slots=True)
class DepthSensorModel(SensorRecord):
    """A stereo depth camera. Every fault can be switched off by its zero."""

    FORMAT = "realsim depth sensor 1"
    KEY = "model"
    NAME = "a depth sensor model"
    COMMAND = "realsim depth-fit FRAMES --out FILE"

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

    # Faults that a D405 at hand's reach shows little of: off unless a profile or a fit says so.
    correlation_aspect: float = 1.0
    """Radius of correlation along columns over that along rows: below 1 where the matching window
    is wider than high, as in most structured light."""
    slow_noise_px: float = 0.0
    """Standard deviation of a second, slower part of the noise [px]. 0 = none."""
    slow_correlation_px: float = 10.0
    """Gaussian radius of the slower part [px]."""
    native_pitch_px: float = 1.0
    """Pixels of the picture over which one measurement is repeated: more than 1 where depth was
    resampled into a finer colour image (a Xtion's 570 px of focal length into 1066)."""
    depth_unit_m: float = 0.0
    """Step of the depth itself [m]: what a count of the 16-bit image is worth. 0 = continuous."""
    fattening_px: int = 0
    """Pixels by which near surfaces grow over far ones: half the matching window. 0 = none."""
    eye_offset_m: float = 0.0
    """Where the first eye stands on the picture's x axis [m]; the second stands `baseline_m` to its
    right. 0 = the picture is the first eye's own; otherwise depth was registered to a camera beside
    it, and things have shadows on both sides."""
    border: bool = True
    """Whether the band that the second eye's picture does not cover is lost, with occlusion."""
    border_margin_px: float = 0.0
    """By how much that band is wider than the disparity [px]: half of the matching window."""
    most_disparity_px: float = 0.0
    """Largest disparity that is searched [px]: what is nearer is lost. 0 = no limit."""
    whole_pixel_gain: float = 0.0
    """By what share the noise is greater at disparities of whole pixels than on average, and
    smaller halfway between two: what matchers that fit a parabola to three costs do."""
    signal_range_m: float = 0.0
    """Depth at which half of a white surface seen frontally is lost for want of light [m]; loss
    grows with distance, obliquity and darkness from there (see loss). 0 = never."""
    signal_spread: float = 0.4
    """How soft that limit is [standard deviation in the natural logarithm of the signal]."""
    loss_patch_px: float = 3.0
    """Gaussian radius of the patches that are lost by material or signal [px]. 0 = pixel by pixel:
    speckle."""
    warp_px: float = 0.0
    """Standard deviation of the slow error that stays the same in every frame [px]."""
    column_band_px: float = 0.0
    """Standard deviation of upright stripes that stay the same in every frame [px]."""
    row_band_px: float = 0.0
    """Standard deviation of lying stripes that stay the same in every frame [px]."""
    band_width_px: float = 60.0
    """Mean width of a stripe [px]."""
    specimen: int = 0
    """Which unit of its kind: seed of what stays the same in every frame."""

    def __post_init__(self) -> None:
        """Check the ranges."""
        if not (0.001 <= self.baseline_m <= 1.0):
            raise InputError(
                f"the depth sensor's baseline is {self.baseline_m} m; 0.001 to 1 m is accepted "
                "(0.018 for a D405). Were millimetres given?"
            )
        if not (0 <= self.min_z_m < self.max_z_m):
            raise InputError(f"the depth range {self.min_z_m} to {self.max_z_m} m is empty.")
        for name in NOT_NEGATIVE:
            value = getattr(self, name)
            if not 0 <= value < 2**63:
                raise InputError(f"{name} is {value!r:.60}; 0 (off) or more is accepted.")
        if self.edge_dropout + self.edge_flying > 1:
            raise InputError("edge_dropout and edge_flying are shares: together at most 1.")
        for name, least in (("correlation_aspect", 0.05), ("native_pitch_px", 1.0),
                            ("signal_spread", 0.01), ("band_width_px", 1.0)):  # fmt: skip
            if not getattr(self, name) >= least:
                raise InputError(f"{name} is {getattr(self, name)}; {least} or more is accepted.")
        if not abs(self.eye_offset_m) <= 1.0 or not np.isfinite(self.bias_px):
            raise InputError(
                f"eye_offset_m is {self.eye_offset_m} and bias_px {self.bias_px}; an offset of at "
                "most 1 m and a finite bias are accepted."
            )
        if self.depth_unit_m > 0.02:
            raise InputError(
                f"depth_unit_m is {self.depth_unit_m} m a count; at most 0.02 is accepted. Were "
                "millimetres given (1 mm is 0.001)?"
            )

    @classmethod
    def noiseless(cls, quantum_px: float = 0.0) -> "DepthSensorModel":
        """Return a camera without faults: depth in range, rounded to `quantum_px` if not 0."""
        return cls(
            disparity_noise_px=0.0, quantum_px=quantum_px, occlusion=False, edge_dropout=0.0,
            edge_flying=0.0, grazing_from_deg=90.0, grazing_to_deg=90.0, blobs_per_megapixel=0.0,
        )  # fmt: skip

    @classmethod
    def from_profile(cls, profile_: DepthProfile | str, **overrides: Any) -> "DepthSensorModel":
        """Return a camera of a kind: its geometry and range, and usual figures for its noise.

        Args:
            profile_: a profile or its name (d405, d415, d435, structured_light).
            **overrides: fields of the model that are known better, such as from a fit.

        Raises:
            InputError: there is no such profile or field, or a value is out of range.
        """
        p = profile(profile_) if isinstance(profile_, str) else profile_
        values: dict[str, Any] = {
            "baseline_m": p.baseline_m, "min_z_m": p.min_z_m, "max_z_m": p.max_z_m,
            "quantum_px": p.quantum_px, "depth_unit_m": p.depth_unit_m,
            **ASSUMED_BY_PATTERN[p.pattern], **MEASURED.get(p.name, {}),
        }  # fmt: skip
        return cls.from_fields(values | overrides, f"depth profile '{p.name}'")

    def sigma_z(self, z_m: ArrayLike, intrinsics: CameraIntrinsics) -> Array:
        """Return the standard deviation of depth [m] at depths [m]: z^2 sigma_d / (f B)."""
        z = np.asarray(z_m, dtype=np.float64)
        sigma_d = float(np.hypot(self.disparity_noise_px, self.slow_noise_px))
        return z * z * (sigma_d / (intrinsics.fx * self.baseline_m))

    def shadow(
        self,
        depth_m: ArrayLike,
        intrinsics: CameraIntrinsics,
        scene: RayScene,
        T_world_cam: ArrayLike,
    ) -> Mask:
        """Return where (H, W) an eye of this camera is blocked, exactly (see shadow)."""
        return shadow_mask(
            scene, depth_m, intrinsics, T_world_cam,
            baseline_m=self.baseline_m, eye_offset_m=self.eye_offset_m, border=self.border,
            border_margin_px=self.border_margin_px,
        )  # fmt: skip

    def measure(
        self,
        depth_m: ArrayLike,
        intrinsics: CameraIntrinsics,
        rng: np.random.Generator,
        *,
        scene: RayScene | None = None,
        T_world_cam: ArrayLike | None = None,
        shadow: Mask | None = None,
        loss: ArrayLike | None = None,
        reflectance: ArrayLike | None = None,
    ) -> Array32:
        """Return what the camera reports for an exact depth picture.

        Args:
            depth_m: (H, W) depth along z [m], 0 = nothing.
            intrinsics: the camera; fx turns depth into disparity.
            rng: source of all chance; the same state gives the same bytes.
            scene: what can hide a surface from an eye, for exact shadows; needs `T_world_cam`.
            T_world_cam: (4, 4) the camera in that scene [m].
            shadow: (H, W) where an eye is blocked, in place of `scene`. Without both the shadows
                are found from the depth picture alone.
            loss: (H, W) share of pixels lost because of their material (see loss).
            reflectance: (H, W) linear, for `signal_range_m`; None = white.

        Returns:
            (H, W) float32 depth [m], 0 = no measurement.

        Raises:
            InputError: sizes differ, or a scene without the camera's pose.
        """
        depth = np.asarray(depth_m, dtype=np.float32)
        require_same_size(depth, intrinsics)
        blocked = None
        if self.occlusion:
            blocked = self._blocked(depth, intrinsics, scene, T_world_cam, shadow)
        # All chance is drawn first and always, so that a pixel's fate depends on its own only.
        shape = depth.shape
        jitter = correlated(rng, shape, self.correlation_px, self.correlation_aspect)
        fate = uniform(correlated(rng, shape, max(1.0, self.correlation_px / 2)))
        mix = rng.random(shape, dtype=np.float32)
        holes = blob_mask(rng, shape, self.blobs_per_megapixel, self.blob_radius_px)

        fB = np.float32(intrinsics.fx * self.baseline_m)
        valid = depth > 0
        exact = np.where(valid, fB / np.where(valid, depth, 1), 0).astype(np.float32)
        if blocked is None and self.occlusion:
            first = self.eye_offset_m / self.baseline_m
            blocked = half_occluded(
                exact, second_eye=1 + first, first_eye=first, border=self.border,
                border_margin_px=self.border_margin_px,
            )  # fmt: skip
        lost = self._material_loss(depth, exact, intrinsics, rng, loss, reflectance)
        if blocked is not None:
            lost = blocked if lost is None else lost | blocked
        disparity, covered = self._fattened(exact, valid)
        smeared, torn = self._edges(disparity, valid, fate, mix)
        if self.grazing_from_deg < 90.0:
            cosine = cosine_of_view(exact, intrinsics)
            grazing = grazing_loss(cosine, self.grazing_from_deg, self.grazing_to_deg)
            valid = valid & (fate >= grazing)
        if lost is not None:
            # Where a near surface's match has spread, its own depth stands.
            valid = valid & ~(lost if covered is None else lost & ~covered)
        valid = valid & ~torn & ~holes
        return self._depth_of(self._noisy(smeared, jitter, rng), valid, fB)

    def _blocked(
        self,
        depth: Array32,
        intrinsics: CameraIntrinsics,
        scene: RayScene | None,
        T_world_cam: ArrayLike | None,
        shadow: Mask | None,
    ) -> Mask | None:
        """Return the shadow that was given or that the scene casts, None where neither is known."""
        if shadow is not None:
            require_same_size(np.asarray(shadow), intrinsics)
            return np.asarray(shadow, dtype=bool)
        if scene is None:
            return None
        if T_world_cam is None:
            raise InputError("shadows of a scene need the camera's place in it: give T_world_cam.")
        return self.shadow(depth, intrinsics, scene, T_world_cam)

    def _material_loss(
        self,
        depth: Array32,
        exact: Array32,
        intrinsics: CameraIntrinsics,
        rng: np.random.Generator,
        loss: ArrayLike | None,
        reflectance: ArrayLike | None,
    ) -> Mask | None:
        """Return what (H, W) material and want of signal lose; None = nothing."""
        if loss is None and self.signal_range_m == 0:
            return None
        chance = uniform(correlated(rng, depth.shape, self.loss_patch_px))
        kept = np.ones(depth.shape, np.float32)
        if loss is not None:
            share = np.asarray(loss, np.float32)
            require_same_size(share, intrinsics)
            kept *= 1 - share
        if self.signal_range_m > 0:
            rho = None if reflectance is None else np.asarray(reflectance, np.float32)
            if rho is not None:
                require_same_size(rho, intrinsics)
            cosine = cosine_of_view(exact, intrinsics)
            kept *= 1 - signal_loss(depth, cosine, self.signal_range_m, self.signal_spread, rho)
        return chance < 1 - kept

    def _fattened(self, exact: Array32, valid: Mask) -> tuple[Array32, Mask | None]:
        """Return the disparity with near surfaces grown, and where (H, W) they cover others."""
        if self.fattening_px == 0:
            return exact, None
        _, near = _neighbourhood(exact, valid, self.fattening_px)
        covered = valid & (near - exact > self.edge_jump_px)
        return np.where(covered, near, exact), covered

    def _edges(
        self, disparity: Array32, valid: Mask, fate: Array32, mix: Array32
    ) -> tuple[Array32, Mask]:
        """Return the disparity with pixels between two surfaces, and what (H, W) edges lose."""
        if self.edge_dropout == 0 and self.edge_flying == 0:
            return disparity, np.zeros(disparity.shape, dtype=bool)
        edge, far, near = depth_edges(disparity, valid, self.edge_width_px, self.edge_jump_px)
        flying = edge & (fate > 1 - self.edge_flying)
        smeared = np.where(flying, far + mix * (near - far), disparity)
        return smeared, edge & (fate < self.edge_dropout)

    def _noisy(self, exact: Array32, jitter: Array32, rng: np.random.Generator) -> Array32:
        """Return the disparity with bias, what stays in every frame, and noise."""
        disparity = exact + np.float32(self.bias_px)
        if self.warp_px > 0 or self.column_band_px > 0 or self.row_band_px > 0:
            disparity = disparity + fixed_pattern(
                disparity.shape, warp_px=self.warp_px, column_band_px=self.column_band_px,
                row_band_px=self.row_band_px, band_width_px=self.band_width_px, seed=self.specimen,
            )  # fmt: skip
        noise = np.float32(self.disparity_noise_px) * jitter
        if self.slow_noise_px > 0:
            field = slow(rng, disparity.shape, self.slow_correlation_px, self.correlation_aspect)
            noise = noise + np.float32(self.slow_noise_px) * field
        if self.whole_pixel_gain > 0:
            turn = np.float32(2 * np.pi / whole_pixel(self.quantum_px))
            noise = noise * (1 + np.float32(self.whole_pixel_gain) * np.cos(turn * disparity))
        return (disparity + noise).astype(np.float32, copy=False)

    def _depth_of(self, disparity: Array32, valid: Mask, fB: np.float32) -> Array32:
        """Return depth (H, W) of a measured disparity: rounded, and cut to the range."""
        if self.native_pitch_px > 1:
            rows = native_pixels(disparity.shape[0], self.native_pitch_px)
            columns = native_pixels(disparity.shape[1], self.native_pitch_px)
            disparity = disparity[rows[:, None], columns]
            valid = valid[rows[:, None], columns]
        if self.quantum_px > 0:
            q = np.float32(self.quantum_px)
            disparity = np.round(disparity / q) * q
        valid = valid & (disparity > 0)
        if self.most_disparity_px > 0:
            valid = valid & (disparity <= self.most_disparity_px)
        z = np.where(valid, fB / np.where(valid, disparity, 1), 0).astype(np.float32)
        if self.depth_unit_m > 0:
            z = np.round(z / np.float32(self.depth_unit_m)) * np.float32(self.depth_unit_m)
        return np.where((z >= self.min_z_m) & (z <= self.max_z_m), z, np.float32(0))


NOT_NEGATIVE = (
    "disparity_noise_px", "correlation_px", "quantum_px", "blobs_per_megapixel", "edge_dropout",
    "edge_flying", "slow_noise_px", "slow_correlation_px", "depth_unit_m", "fattening_px",
    "signal_range_m", "loss_patch_px", "warp_px", "column_band_px", "row_band_px", "specimen",
    "border_margin_px", "most_disparity_px", "whole_pixel_gain",
)  # fmt: skip


def depth_edges(
    disparity: Array32, valid: Mask, width_px: int, jump_px: float
) -> tuple[Mask, Array32, Array32]:
    """Return which pixels (H, W) lie at depth edges, and the least and greatest disparity there."""
    far, near = _neighbourhood(disparity, valid, width_px)
    return valid & (near - far > jump_px), far, near


def _neighbourhood(disparity: Array32, valid: Mask, radius_px: int) -> tuple[Array32, Array32]:
    """Return the least and the greatest measured disparity (H, W) around each pixel."""
    import cv2

    kernel = np.ones((2 * radius_px + 1, 2 * radius_px + 1), np.uint8)
    big = np.float32(1e9)
    least = cv2.erode(np.where(valid, disparity, big), kernel)
    greatest = cv2.dilate(np.where(valid, disparity, -big), kernel)
    return np.asarray(least, np.float32), np.asarray(greatest, np.float32)
