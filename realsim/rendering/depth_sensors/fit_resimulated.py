"""What only a simulation of the frames' own planes shows: typical noise, and resampling.

Both compare the frames with what the model makes of the same planes, so that rounding, holes and
the size of the planes have the same effect on both.
"""

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from realsim.arrays import Array32, Mask
from realsim.records import CameraIntrinsics
from realsim.rendering.depth_sensors.autocovariance import without_trend
from realsim.rendering.depth_sensors.model import DepthSensorModel
from realsim.rendering.depth_sensors.noise import whole_pixel
from realsim.rendering.depth_sensors.plane import PlaneView
from realsim.rendering.depth_sensors.plane_faults import Estimate
from realsim.rendering.depth_sensors.statistics import local_noise

MOST_FRAMES = 6
"""Frames that are simulated for the noise; half as many for resampling, the same in all."""
WINDOWS_PX = (9, 15, 25)
"""Sides of the small planes on which frames and simulation are to be equally noisy [px]."""
RADIUS_STEPS, WIDTH_LAW, LEAST_RADIUS_PX = 2, 0.6, 2.0
"""Times that the radius is mended, with which power of it the noise of the widest windows over that
of the narrowest grows at a radius of half the narrowest, and from where on it does."""
PHASES, LEAST_WINDOWS, LEAST_GAIN = 10, 500, 0.1
"""Parts of a pixel whose noise is told apart, the small planes that each needs, and how much
greater the noise at whole pixels must be to be taken in."""
LEAST_COLUMN, LATTICE = 60, 0.3
"""Pixels that a column needs, and columns; and how much unequal they must be to be resampled."""
LEAST_PITCH = 1.15
"""A smaller pitch is none: rounding and noise make a few neighbours equal, too."""

SEED = 0
"""Seed of the simulation of the frames' planes."""


def typical_noise(
    depths: Sequence[NDArray[Any]],
    planes: Sequence[PlaneView],
    intrinsics: CameraIntrinsics,
    model: DepthSensorModel,
) -> tuple[float, float]:
    """Return factors of the noise and of its radius that give the model what small windows have.

    A standard deviation is the larger the worse the worst places are, and its radius is theirs; the
    medians over small windows are not. Of a radius that is too great the wide windows have too
    much.
    """
    radius = noise = 1.0
    for rest in range(RADIUS_STEPS, -1, -1):
        tried = replace(model, correlation_px=radius * model.correlation_px)
        ratios: list[list[float]] = []
        for depth, plane in list(zip(depths, planes, strict=True))[:MOST_FRAMES]:
            simulated = _resimulated(tried, plane, intrinsics)
            on = plane.mask & (simulated > 0)
            ratios.append([
                local_noise(np.where(on, depth, 0), intrinsics, model.baseline_m, on, w).median_px
                / max(local_noise(simulated, intrinsics, model.baseline_m, on, w).median_px, 1e-9)
                for w in WINDOWS_PX
            ])  # fmt: skip
        logs = np.log(np.clip([r for r in ratios if np.all(np.isfinite(r))], 0.1, 3.0))
        if len(logs) == 0:
            return 1.0, 1.0
        least, *_, widest = logs.mean(0)
        noise = float(np.exp(logs.mean()))
        if model.slow_noise_px > 0 or model.correlation_px < LEAST_RADIUS_PX:
            break
        if rest:
            radius *= float(np.exp(np.clip((widest - least) / WIDTH_LAW, -0.4, 0.4)))
    return noise, radius


def whole_pixel_gain(
    planes: Sequence[PlaneView],
    intrinsics: CameraIntrinsics,
    baseline_m: float,
    quantum_px: float,
    rounding: float,
) -> Estimate:
    """Return by what share noise is greater at whole pixels of disparity than on average.

    Args:
        planes: of the frames.
        intrinsics: the camera.
        baseline_m: of the sensor [m].
        quantum_px: step of its disparity [px]; 0 = continuous.
        rounding: variance that rounding adds [px^2].
    """
    fB = intrinsics.fx * baseline_m
    noise: list[Array32] = []
    phase: list[Array32] = []
    jitter: list[float] = []
    for plane in planes:
        d = plane.disparity + plane.residual
        rms = local_noise(np.nan_to_num(fB / d), intrinsics, baseline_m, plane.mask).rms_px
        known = np.isfinite(rms)
        noise.append(rms[known])
        phase.append(d[known] / whole_pixel(quantum_px) % 1)
        jitter.append(1.4826 * float(np.nanmedian(np.abs(without_trend(plane.residual)[0]))))
    rms, at = np.concatenate(noise), (np.concatenate(phase) * PHASES).astype(int) % PHASES
    if np.bincount(at, minlength=PHASES).min() < LEAST_WINDOWS:
        note = "the planes do not show all fractions of a pixel: nearer or more tilted ones do."
        return Estimate(0.0, float("inf"), False, note)
    levels = np.array([np.median(rms[at == k]) for k in range(PHASES)], np.float64)
    level = np.sqrt(np.maximum(levels**2 - rounding, 1e-12))
    wave = np.cos(2 * np.pi * (np.arange(PHASES) + 0.5) / PHASES)
    mean, rise = float(level.mean()), float(2 * (level * wave).mean())
    rest = float(np.std(level - mean - rise * wave)) * np.sqrt(2 / PHASES)
    # The phase is read from the noisy disparity itself, which blurs it.
    mean *= float(np.exp(-2 * (np.pi * np.mean(jitter)) ** 2))
    gain, doubt = rise / mean, float(np.hypot(rest / mean, 0.02))
    return Estimate(gain if gain > max(LEAST_GAIN, 3 * doubt) else 0.0, doubt, True)


def scaled(estimate: Estimate, ratio: float) -> Estimate:
    """Return an estimate times a ratio, as unsure as the ratio is far from 1."""
    value = ratio * estimate.value
    doubt = float(np.hypot(ratio * estimate.uncertainty, 0.3 * abs(value - estimate.value)))
    return replace(estimate, value=value, uncertainty=doubt)


def _resimulated(
    model: DepthSensorModel, plane: PlaneView, intrinsics: CameraIntrinsics
) -> Array32:
    """Return what the model makes of a plane that was found."""
    exact = np.where(plane.area, intrinsics.fx * model.baseline_m / plane.disparity, 0)
    plain = replace(model, occlusion=False, bias_px=0.0)
    return plain.measure(np.nan_to_num(exact), intrinsics, np.random.default_rng(SEED))


def resampling_pitch(
    depths: Sequence[NDArray[Any]],
    planes: Sequence[PlaneView],
    intrinsics: CameraIntrinsics,
    model: DepthSensorModel,
    unit_m: float,
) -> Estimate:
    """Return over how many pixels one measurement is repeated.

    Cells of p pixels make a share 1 - 1/p of the neighbours equal, beside those that rounding makes
    equal; that share a simulation of the same planes gives, and the pitch at which it has as many
    equal neighbours as the frames is the answer.
    """
    found: list[float] = []
    for depth, plane in list(zip(depths, planes, strict=True))[: MOST_FRAMES // 2]:
        real = _equal_share(depth, plane.mask, unit_m)
        pitch = 1.0
        if not _has_lattice(depth, plane.mask, unit_m):
            found.append(pitch)
            continue
        for _ in range(4):
            tried = replace(model, native_pitch_px=max(pitch, 1.0))
            simulated = _resimulated(tried, plane, intrinsics)
            share = _equal_share(simulated, plane.mask & (simulated > 0), unit_m)
            pitch = float(np.clip(pitch * (1 - share) / max(1 - real, 1e-3), 1.0, 10.0))
        found.append(pitch)
    pitch = float(np.mean(found))
    spread = float(np.hypot(np.std(found), 0.1 * (pitch - 1) + 0.02))
    return Estimate(pitch if pitch > LEAST_PITCH else 1.0, spread, True)


def _equal_share(depth: NDArray[Any], mask: Mask, unit_m: float) -> float:
    """Return how many neighbours along rows and columns have the same count."""
    counts = np.round(np.asarray(depth, np.float64) / unit_m)
    equal = [
        (counts[:, 1:] == counts[:, :-1])[mask[:, 1:] & mask[:, :-1]],
        (counts[1:] == counts[:-1])[mask[1:] & mask[:-1]],
    ]
    return float(np.mean(np.concatenate(equal)))


def _has_lattice(depth: NDArray[Any], mask: Mask, unit_m: float) -> bool:
    """Return whether some columns equal their neighbours far more often than others.

    Smooth noise and rounding make neighbours equal everywhere; cells of p pixels do where a column
    lies in its neighbour's cell: in a share 1 - 1/p of the columns.
    """
    counts = np.round(np.asarray(depth, np.float64) / unit_m)
    both = mask[:, 1:] & mask[:, :-1]
    full = both.sum(0) >= LEAST_COLUMN
    if full.sum() < LEAST_COLUMN:
        return False
    different = (both & (counts[:, 1:] != counts[:, :-1]))[:, full].sum(0) / both[:, full].sum(0)
    around = np.convolve(different, np.ones(9) / 9, "valid")
    return bool(np.std(different[4:-4] - around) > LATTICE * max(float(different.mean()), 1e-6))
