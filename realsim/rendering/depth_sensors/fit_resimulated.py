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
from realsim.rendering.depth_sensors.model import DepthSensorModel
from realsim.rendering.depth_sensors.plane import PlaneView
from realsim.rendering.depth_sensors.plane_faults import Estimate
from realsim.rendering.depth_sensors.statistics import local_noise

MOST_FRAMES = 3
"""Frames that are simulated: resampling is the same in all."""
LEAST_PITCH = 1.15
"""A smaller pitch is none: rounding and noise make a few neighbours equal, too."""


def typical_ratio(
    depths: Sequence[NDArray[Any]],
    planes: Sequence[PlaneView],
    intrinsics: CameraIntrinsics,
    model: DepthSensorModel,
    seed: int,
) -> float:
    """Return the noise of 9x9 windows of the frames over that of the model, both as medians.

    A standard deviation is the larger the worse the worst places are; a median is not.
    """
    ratios: list[float] = []
    for depth, plane in list(zip(depths, planes, strict=True))[:MOST_FRAMES]:
        simulated = _resimulated(model, plane, intrinsics, seed)
        on = plane.mask & (simulated > 0)
        real = local_noise(np.where(on, depth, 0), intrinsics, model.baseline_m, on).median_px
        own = local_noise(simulated, intrinsics, model.baseline_m, on).median_px
        if np.isfinite(real) and np.isfinite(own) and real > 0 and own > 0:
            ratios.append(real / own)
    return float(np.clip(np.median(ratios), 0.1, 3.0)) if ratios else 1.0


def scaled(estimate: Estimate, ratio: float) -> Estimate:
    """Return an estimate times a ratio, as unsure as the ratio is far from 1."""
    value = ratio * estimate.value
    doubt = float(np.hypot(ratio * estimate.uncertainty, 0.3 * abs(value - estimate.value)))
    return replace(estimate, value=value, uncertainty=doubt)


def _resimulated(
    model: DepthSensorModel, plane: PlaneView, intrinsics: CameraIntrinsics, seed: int
) -> Array32:
    """Return what the model makes of a plane that was found."""
    exact = np.where(plane.area, intrinsics.fx * model.baseline_m / plane.disparity, 0)
    plain = replace(model, occlusion=False, bias_px=0.0)
    return plain.measure(np.nan_to_num(exact), intrinsics, np.random.default_rng(seed))


def resampling_pitch(
    depths: Sequence[NDArray[Any]],
    planes: Sequence[PlaneView],
    intrinsics: CameraIntrinsics,
    model: DepthSensorModel,
    unit_m: float,
    seed: int,
) -> Estimate:
    """Return over how many pixels one measurement is repeated.

    Cells of p pixels make a share 1 - 1/p of the neighbours equal, beside those that rounding makes
    equal; that share a simulation of the same planes gives, and the pitch at which it has as many
    equal neighbours as the frames is the answer.
    """
    found: list[float] = []
    for depth, plane in list(zip(depths, planes, strict=True))[:MOST_FRAMES]:
        real = _equal_share(depth, plane.mask, unit_m)
        pitch = 1.0
        for _ in range(4):
            tried = replace(model, native_pitch_px=max(pitch, 1.0))
            simulated = _resimulated(tried, plane, intrinsics, seed)
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
