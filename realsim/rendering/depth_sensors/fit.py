"""A depth sensor's parameters from a user's own frames of a plane: a wall, or a bare table.

What a plane shows: the noise and how it is correlated, the step of the disparity, stripes and slow
errors that stay, holes and how they grow with obliquity, and whether noise follows z^2. What it
does not show is said and kept from the profile: depth edges, shadows, materials, and (because a
constant error of the disparity turns a plane into another plane) the bias, unless the true depth
is given.
"""

from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from realsim.arrays import Array, Array32, Mask
from realsim.errors import InputError
from realsim.records import CameraIntrinsics
from realsim.rendering.depth_sensors import autocovariance, fit_resimulated
from realsim.rendering.depth_sensors.edges import edges_of
from realsim.rendering.depth_sensors.model import DepthSensorModel
from realsim.rendering.depth_sensors.plane import PlaneView, find_plane
from realsim.rendering.depth_sensors.plane_faults import (
    Estimate,
    HoleCount,
    bands_of,
    blobs_of,
    count_holes,
    grazing_of,
    warp_of,
    without_bands,
)
from realsim.rendering.depth_sensors.profiles import DepthProfile, profile
from realsim.rendering.depth_sensors.statistics import Step, disparity_step

HEAVY_TAILS = 1.15
"""Typical noise that differs by more than this factor from the standard deviation's."""
LEAST_TILES = 8
"""Tiles of 64 px that all planes together must fill: with fewer the spread between them says
nothing about the uncertainty."""
DISTANCE_RATIO = 1.3
"""Farthest over nearest plane, from which on the law of noise and distance is checked."""


@dataclass(frozen=True, kw_only=True, slots=True)
class FrameFit:
    """What one frame showed."""

    name: str
    distance_m: float
    pixels: int
    """On the plane."""
    sigma_px: float
    """Standard deviation of the fast part of the residual [px]."""
    sigma_m: float
    """The same as depth [m], at the plane's distance."""
    angle_deg: tuple[float, float]
    """Least and greatest angle between ray and normal [deg]."""
    hole_share: float


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class FittedDepthModel:
    """A fitted depth sensor: the model, how sure it is, and what it was fitted to."""

    model: DepthSensorModel
    profile: str
    estimates: dict[str, Estimate]
    """By field of the model; and `distance_exponent`: k of sigma_z ~ z^k, 2 for stereo."""
    frames: tuple[FrameFit, ...]
    holes: HoleCount
    covariance_px2: Array
    """(2, lags) autocovariance of the residuals along rows and columns [px^2]."""
    trend_px: float
    """Errors slower than this were taken out before [px]."""
    planes: tuple[PlaneView, ...]
    notes: tuple[str, ...]
    """What the frames do not determine, in sentences."""

    def document(self) -> dict[str, Any]:
        """Return what `DepthSensorModel.load` reads, with all that is known of the fit."""
        return {
            **self.model.document(),
            "fit": {
                "profile": self.profile,
                "parameters": {name: e.document() for name, e in self.estimates.items()},
                "frames": [asdict(f) for f in self.frames],
                "holes_by_angle": self.holes.rows(),
                "notes": list(self.notes),
            },
        }


def fit_depth_model(
    frames: Sequence[ArrayLike],
    intrinsics: CameraIntrinsics,
    profile_: DepthProfile | str,
    *,
    unit_m: float | None = None,
    regions: Sequence[Mask | None] | None = None,
    truths: Sequence[ArrayLike] | None = None,
    names: Sequence[str] | None = None,
    tick: Callable[[int, int], None] | None = None,
) -> FittedDepthModel:
    """Return the parameters of a depth sensor from frames of a plane.

    Args:
        frames: (H, W) measured depth [m] each, 0 = no measurement.
        intrinsics: the camera of the depth images.
        profile_: the kind of camera, for its baseline and all that a plane does not show.
        unit_m: metres per count of the depth files; None = the profile's.
        regions: (H, W) each, where to look for the plane; None = everywhere.
        truths: (H, W) exact depth [m] each (from a board, or a registered table), for the bias.
        names: of the frames, for messages.
        tick: called with (done, total) after each frame's plane, and at the end.

    Raises:
        InputError: no frames, sizes or units that do not fit, or a frame without a plane.
    """
    kind = profile(profile_) if isinstance(profile_, str) else profile_
    unit = kind.depth_unit_m if unit_m is None else unit_m
    names = names or [f"frame {k}" for k in range(len(frames))]
    _require_equal_lengths(frames, names, regions, truths)
    depths = [np.asarray(f) for f in frames]
    planes: list[PlaneView] = []
    for k, depth in enumerate(depths):
        planes.append(
            find_plane(
                depth, intrinsics, kind.baseline_m, region=None if regions is None else regions[k],
                name=names[k],
            )
        )  # fmt: skip
        _require_in_reach(planes[-1].distance_m, kind, unit, names[k])
        if tick:
            tick(k + 1, len(depths) + 1)
    fit = _of_planes(depths, planes, intrinsics, kind, unit, names, truths)
    if tick:
        tick(len(depths) + 1, len(depths) + 1)
    return fit


OUT_OF_REACH = 1.5
"""A plane at so many times the farthest depth of a camera, or nearer than the nearest by as much,
was not measured by it: a unit is wrong, or the profile."""


def _require_in_reach(distance_m: float, kind: DepthProfile, unit_m: float, name: str) -> None:
    """Refuse a plane where this kind of camera measures nothing.

    Raises:
        InputError: its distance is far beyond the range of the profile.
    """
    if kind.min_z_m / OUT_OF_REACH <= distance_m <= kind.max_z_m * OUT_OF_REACH:
        return
    raise InputError(
        f"{name}: the plane is at {distance_m:.3g} m, read with {unit_m:g} m per count; a "
        f"{kind.name} measures from {kind.min_z_m:g} to {kind.max_z_m:g} m. Check --depth-unit "
        "(0.001 for millimetres, 0.0001 for a D405's tenths) and --sensor."
    )


def _of_planes(
    depths: Sequence[NDArray[Any]],
    planes: Sequence[PlaneView],
    intrinsics: CameraIntrinsics,
    kind: DepthProfile,
    unit: float,
    names: Sequence[str],
    truths: Sequence[ArrayLike] | None,
) -> FittedDepthModel:
    """Return the fit to planes that were found in their frames."""
    fB = intrinsics.fx * kind.baseline_m
    on_plane = np.stack([np.where(p.mask, d, 0) for p, d in zip(planes, depths, strict=True)])
    # The step that most of the planes show, measured on all of them together.
    step = disparity_step(on_plane, intrinsics, kind.baseline_m, unit)
    bands = bands_of(planes)
    flat = [without_bands(p, bands) for p in planes]
    sums, trend = autocovariance.steady_sums(flat)
    if len(sums.products) == 0:
        raise InputError(
            "the planes are too small or too torn to measure noise on: no square of 64x64 px is a "
            "fifth full. Go nearer, or take a larger wall."
        )
    fast = [autocovariance.without_trend(r, trend)[0] for r in flat]
    shown = [_frame(*x, fB) for x in zip(names, planes, fast, strict=True)]
    found = _step_estimate(step, kind)
    rounding = _rounding(found["quantum_px"].value, unit, fB, planes)
    shape, spread = autocovariance.fit_noise(sums, rounding, trend)
    notes: list[str] = []
    if trend < autocovariance.TRENDS_PX[0]:
        notes.append(
            f"the surfaces are not flat to the noise: only what is faster than {trend:.0f} px "
            "was taken for noise. A flatter wall says more."
        )
    found |= _noise_estimates(shape, spread, shown, step, rounding, len(sums.products))
    found["distance_exponent"] = _distance_law(shown)
    holes = count_holes(planes)
    found |= blobs_of(planes) | grazing_of(holes)
    found |= bands | {"warp_px": warp_of(planes)}
    found["whole_pixel_gain"] = fit_resimulated.whole_pixel_gain(
        planes, intrinsics, kind.baseline_m, found["quantum_px"].value, rounding
    )
    found["bias_px"] = _bias(planes, truths, fB)
    found |= edges_of(depths, intrinsics, DepthSensorModel.from_profile(kind))
    model, more = _as_simulated(depths, planes, intrinsics, kind, unit, found)
    notes += more
    notes += [f"{name}: {e.note}" for name, e in found.items() if e.note]
    return FittedDepthModel(
        model=model, profile=kind.name, estimates=found, frames=tuple(shown), holes=holes,
        covariance_px2=sums.covariance(), trend_px=trend, planes=tuple(planes), notes=tuple(notes),
    )  # fmt: skip


def _as_simulated(
    depths: Sequence[NDArray[Any]],
    planes: Sequence[PlaneView],
    intrinsics: CameraIntrinsics,
    kind: DepthProfile,
    unit: float,
    found: dict[str, Estimate],
) -> tuple[DepthSensorModel, list[str]]:
    """Return the model, and notes, after comparing the frames with a simulation of their planes.

    `found` is changed: its noise is that of typical places, and the pitch of resampling is added.
    """
    notes: list[str] = []
    model = _model(kind, unit, found)
    ratio, wider = fit_resimulated.typical_noise(depths, planes, intrinsics, model)
    found["correlation_px"] = fit_resimulated.scaled(found["correlation_px"], wider)
    found |= {
        n: fit_resimulated.scaled(found[n], ratio) for n in ("disparity_noise_px", "slow_noise_px")
    }
    model = _model(kind, unit, found)
    if abs(np.log(ratio)) > np.log(HEAVY_TAILS):
        notes.append(
            f"the noise has heavy tails (bumps, or patches that are worse than the rest): half of "
            f"the places have {ratio:.2f} x what the standard deviation says, and the model has "
            "what they have."
        )
    pitch = fit_resimulated.resampling_pitch(depths, planes, intrinsics, model, unit)
    found["native_pitch_px"] = pitch
    return replace(model, native_pitch_px=pitch.value if pitch.determined else 1.0), notes


def _require_equal_lengths(
    frames: Sequence[ArrayLike],
    names: Sequence[str],
    regions: Sequence[Mask | None] | None,
    truths: Sequence[ArrayLike] | None,
) -> None:
    """Refuse no frames, and lists that do not belong together."""
    if len(frames) == 0:
        raise InputError("there are no frames to fit a depth sensor to; one or more are needed.")
    for what, given in (("names", names), ("regions", regions), ("true depths", truths)):
        if given is not None and len(given) != len(frames):
            raise InputError(f"there are {len(frames)} frames and {len(given)} {what}.")


def _rounding(step_px: float, unit_m: float, fB: float, planes: Sequence[PlaneView]) -> float:
    """Return the variance [px^2] that rounding disparity and depth adds: step^2 / 12 each."""
    by_unit = [fB * unit_m / p.distance_m**2 for p in planes]
    return (step_px**2 + float(np.mean(np.square(by_unit)))) / 12


def _frame(name: str, plane: PlaneView, fast: Array32, fB: float) -> FrameFit:
    angles = plane.angle_deg[plane.area]
    sigma = float(np.nanstd(fast))
    area = int(plane.area.sum())
    return FrameFit(
        name=name,
        distance_m=plane.distance_m,
        pixels=int(plane.mask.sum()),
        sigma_px=sigma,
        sigma_m=sigma * plane.distance_m**2 / fB,
        angle_deg=(float(np.nanmin(angles)), float(np.nanmax(angles))),
        hole_share=float(plane.holes.sum()) / max(area, 1),
    )


def _noise_estimates(
    shape: autocovariance.NoiseShape,
    spread: autocovariance.NoiseShape | None,
    frames: Sequence[FrameFit],
    step: Step,
    rounding: float,
    tiles: int,
) -> dict[str, Estimate]:
    """Return the noise's size, radius and aspect, and those of its slow part."""
    note = ""
    if spread is None or tiles < LEAST_TILES:
        note = (
            f"the planes fill only {tiles} squares of 64 px; {LEAST_TILES} are needed to "
            "know the noise and its uncertainty. Go nearer, or add frames."
        )
    u = spread or autocovariance.NoiseShape(
        sigma_px=np.inf, radius_px=np.inf, aspect=np.inf, slow_sigma_px=np.inf, slow_radius_px=0.0
    )
    frame_sigmas = [f.sigma_px for f in frames]
    between = float(np.std(frame_sigmas) / np.sqrt(len(frames))) if len(frames) > 1 else 0.0
    # Rounding is white and independent only while the noise is greater than the step.
    model_error = 0.005 * shape.sigma_px + 0.1 * rounding / max(shape.sigma_px, 1e-6)
    sure = not note
    if sure and 0 < step.quantum_px > 3 * shape.sigma_px:
        sure = False
        note = (
            f"the step of the disparity ({step.quantum_px:.3f} px) hides the noise: less than a "
            "third of it."
        )
    white = shape.radius_px == 0
    return {
        "disparity_noise_px": Estimate(
            shape.sigma_px, float(np.hypot(np.hypot(u.sigma_px, model_error), between)), sure, note
        ),
        "correlation_px": Estimate(
            shape.radius_px, float(np.hypot(u.radius_px, 0.3 if white else 0.02)), sure
        ),
        "correlation_aspect": Estimate(shape.aspect, float(np.hypot(u.aspect, 0.01)), sure),
        "slow_noise_px": Estimate(
            shape.slow_sigma_px,
            float(np.hypot(u.slow_sigma_px, 0.03 * shape.slow_sigma_px + 0.1 * shape.sigma_px)),
            sure,
        ),
        "slow_correlation_px": Estimate(
            shape.slow_radius_px if shape.slow_radius_px > 0 else 10.0,
            float(np.hypot(u.slow_radius_px, 0.05 * shape.slow_radius_px)),
            sure and shape.slow_sigma_px > 0,
        ),
    }


def _step_estimate(step: Step, kind: DepthProfile) -> dict[str, Estimate]:
    """Return the step of the disparity, or why it is not known."""
    if step.quantum_px > 0:
        return {"quantum_px": Estimate(step.quantum_px, 0.005 * step.quantum_px, True)}
    if step.least_px < 0.9 * kind.quantum_px:
        note = f"the counts show no step of {step.least_px:.3f} px or more: taken as continuous."
        return {"quantum_px": Estimate(0.0, step.least_px, True, note)}
    note = (
        f"the depth unit of the files hides steps below {step.least_px:.3f} px; the profile's "
        f"{kind.quantum_px:.4f} px is kept."
    )
    return {"quantum_px": Estimate(kind.quantum_px, float("inf"), False, note)}


def _distance_law(frames: Sequence[FrameFit]) -> Estimate:
    """Return k of sigma_z ~ z^k: 2 + the slope of ln sigma_d over ln z."""
    z = np.array([f.distance_m for f in frames])
    s = np.array([f.sigma_px for f in frames])
    if z.max() / z.min() < DISTANCE_RATIO or len(z) < 2:
        return Estimate(
            2.0, float("inf"), False,
            f"the planes lie at {z.min():.2f} to {z.max():.2f} m: one distance only. That noise "
            f"grows with z^2 is assumed, not measured; add frames at {1.5 * z.max():.2f} m.",
        )  # fmt: skip
    x = np.log(z) - np.log(z).mean()
    slope = float(x @ np.log(s) / (x @ x))
    rest = np.log(s) - np.log(s).mean() - slope * x
    spread = float(np.sqrt(rest @ rest / max(len(z) - 2, 1)))
    return Estimate(2 + slope, float(np.hypot(spread, 0.01) / np.sqrt(x @ x)), True)


def _bias(planes: Sequence[PlaneView], truths: Sequence[ArrayLike] | None, fB: float) -> Estimate:
    """Return the constant error of the disparity, against the true depth if it is known."""
    if truths is None:
        return Estimate(
            0.0, float("inf"), False,
            "a plane's pictures do not show it: a plane with a constant error of the disparity is "
            "another plane. Give the true depth (a calibrated board or table) to fit it.",
        )  # fmt: skip
    offsets: list[float] = []
    for plane, truth in zip(planes, truths, strict=True):
        t = np.asarray(truth, np.float64)
        on = plane.mask & (t > 0)
        measured = plane.disparity[on] + plane.residual[on]
        offsets.append(float(np.median(measured - fB / t[on])))
    spread = float(np.std(offsets) / np.sqrt(len(offsets))) if len(offsets) > 1 else 0.0
    noise = float(np.nanmedian([np.nanstd(p.residual) for p in planes]))
    return Estimate(float(np.mean(offsets)), float(np.hypot(spread, 0.05 * noise)), True)


def _model(kind: DepthProfile, unit_m: float, found: dict[str, Estimate]) -> DepthSensorModel:
    """Return the profile's model with what the frames determined."""
    known = {n: e.value for n, e in found.items() if e.determined and n != "distance_exponent"}
    return DepthSensorModel.from_profile(kind, **known, depth_unit_m=unit_m)
