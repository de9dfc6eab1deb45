"""What a depth sensor loses at edges and on materials, from frames whose true depth is known.

Where objects of known shape stand at known poses (a registered scene), the exact depth and the
instances can be rendered. Two things then explain the holes on an object: what happens at its
edges, the same for all objects, and how much light its material returns. The first is searched on
a grid so that the holes along the edges agree; the second is solved for each kind of object, in the
law of depth_loss (distance, obliquity, reflectance), so that as much is lost as measured.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import product

import numpy as np

from realsim.arrays import Array, Array32, Int32, Mask
from realsim.errors import InputError
from realsim.records import CameraIntrinsics
from realsim.rendering.depth_sensors.loss import cosine_of_view, require_same_size, shadow_mask
from realsim.rendering.depth_sensors.model import DepthSensorModel
from realsim.rendering.rays import BACKGROUND, RayScene

LARGEST_LOSS = 0.95
"""More than this share is not given to a material: a whole object without depth was no measure."""
ROUNDS = 4
"""Times that the shares are mended by what the simulation still lacks."""
DARKEST = 1e-3
"""Least reflectance that is tried; 1 is the greatest."""
RANGES = 2.5
"""Range of the light over the farthest object, where the model has none: white surfaces then lose
nothing. Only reflectance times the square of the range can be told."""


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class KnownView:
    """A frame of a sensor, and what it should have seen."""

    measured_m: Array32
    """(H, W) the sensor's depth [m], 0 = no measurement."""
    exact_m: Array32
    """(H, W) rendered depth [m], 0 = unknown there."""
    ids: Int32
    """(H, W) instance, -1 = background."""
    kinds: Mapping[int, str]
    """What each instance is: the same name in several views is the same material."""
    intrinsics: CameraIntrinsics
    scene: RayScene
    """The scene that was rendered, with the table, for the shadows."""
    T_world_cam: Array
    """(4, 4) the camera in that scene [m]."""

    def __post_init__(self) -> None:
        """Check that the pictures have the camera's size."""
        for picture in (self.measured_m, self.exact_m, self.ids):
            require_same_size(np.asarray(picture), self.intrinsics)


@dataclass(frozen=True, kw_only=True, slots=True)
class LossFitConfig:
    """What is tried."""

    edge_width_px: tuple[int, ...] = (1, 2, 3)
    """Pixels on either side of an edge."""
    edge_dropout: tuple[float, ...] = (0.2, 0.5, 0.8)
    """Share lost there."""
    eye_offset_share: tuple[float, ...] = (0.0,)
    """Where the first eye stands, in baselines; more than 0.0 is tried for depth that was
    registered to a camera beside the eyes."""
    rim_px: int = 10
    """Pixels from a depth edge that belong to it: less than the least object is wide."""
    seed: int = 0
    """Seed of the simulations."""


@dataclass(frozen=True, kw_only=True, slots=True)
class FittedLosses:
    """The model with its edges fitted, and the share that each kind of object loses."""

    model: DepthSensorModel
    reflectance: dict[str, float]
    """By kind of object: what it returns of the sensor's light, relative to what the model's
    `signal_range_m` was taken for."""
    mean_reflectance: float
    """What all objects together would need: for one that was not seen while fitting."""
    share_by_kind: dict[str, float]
    """Share of its pixels that each kind loses for its material."""
    zone_error: float
    """Root mean square difference of the hole shares, simulated less real, over the zones."""

    def reflectance_of(self, view: KnownView) -> Array32:
        """Return the reflectance (H, W) of a view, for `DepthSensorModel.measure`."""
        return reflectance_map(view, self.reflectance, self.mean_reflectance)


def fit_losses(
    model: DepthSensorModel, views: Sequence[KnownView], config: LossFitConfig | None = None
) -> FittedLosses:
    """Return edges and material losses that make simulated holes as many as measured ones.

    Args:
        model: with its noise fitted already.
        views: frames of registered scenes.
        config: what is tried.

    Raises:
        InputError: there are no views, or no object in them.
    """
    config = config or LossFitConfig()
    if not views or not any((v.ids > BACKGROUND).any() for v in views):
        raise InputError(
            "losses are fitted to frames with objects of known shape and pose; found none."
        )
    if model.signal_range_m == 0:
        far = max(float(v.exact_m[v.ids > BACKGROUND].max(initial=0.1)) for v in views)
        model = replace(model, signal_range_m=RANGES * far)
    zones = [_zones(v, config) for v in views]
    real = _shares([v.measured_m for v in views], zones)
    signals = [_White.of(v, model) for v in views]
    best: tuple[float, DepthSensorModel, dict[str, float]] | None = None
    for offset in config.eye_offset_share:
        moved = replace(model, eye_offset_m=offset * model.baseline_m)
        shadows = [_shadow(v, moved) for v in views]
        for width, dropout in product(config.edge_width_px, config.edge_dropout):
            flying = min(moved.edge_flying, 1 - dropout)
            trial = replace(moved, edge_width_px=width, edge_dropout=dropout, edge_flying=flying)
            shares = _material_shares(views, _simulated(trial, views, shadows, None, config.seed))
            dark = _reflectances(views, signals, shares, model.signal_spread)
            lossy = _simulated(trial, views, shadows, dark, config.seed)
            error = float(np.sqrt(np.nanmean(np.square(_shares(lossy, zones) - real))))
            if best is None or error < best[0]:
                best = (error, trial, shares)
    assert best is not None
    error, chosen, shares = best
    shadows = [_shadow(v, chosen) for v in views]
    for _ in range(ROUNDS):
        # What is lost for want of light lies at the rims, where edges lose the same pixels.
        dark = _reflectances(views, signals, shares, model.signal_spread)
        lacking = _lacking(views, _simulated(chosen, views, shadows, dark, config.seed))
        shares = {k: float(np.clip(s + lacking[k], 0, LARGEST_LOSS)) for k, s in shares.items()}
    mean = _mean_share(views, shares)
    everything = dict.fromkeys(shares, mean)
    return FittedLosses(
        model=chosen,
        reflectance=_reflectances(views, signals, shares, model.signal_spread),
        mean_reflectance=_pooled(views, signals, everything, model.signal_spread),
        share_by_kind=shares,
        zone_error=error,
    )


def reflectance_map(view: KnownView, by_kind: Mapping[str, float], otherwise: float) -> Array32:
    """Return the reflectance (H, W) of a view: the kinds' on objects, white elsewhere."""
    rho = np.ones(view.ids.shape, np.float32)
    for instance, kind in view.kinds.items():
        rho[view.ids == instance] = by_kind.get(kind, otherwise)
    return rho


@dataclass(frozen=True, eq=False, slots=True)
class _White:
    """The signal of one view if all of it were white."""

    log_signal: Array32
    """(H, W) natural logarithm of the signal over the threshold."""

    @classmethod
    def of(cls, view: KnownView, model: DepthSensorModel) -> "_White":
        known = view.exact_m > 0
        inverse = np.where(known, 1 / np.where(known, view.exact_m, 1), 0).astype(np.float32)
        cosine = np.maximum(cosine_of_view(inverse, view.intrinsics), 1e-6)
        z = np.where(known, view.exact_m, model.signal_range_m)
        signal = np.square(model.signal_range_m / z) * cosine
        return cls(np.log(signal).astype(np.float32))

    def loss(self, on: Mask, reflectance: float, spread: float) -> float:
        """Return the mean share lost of a region (H, W)."""
        from scipy.special import ndtr

        return float(np.mean(ndtr(-(self.log_signal[on] + np.log(reflectance)) / spread)))


def _reflectances(
    views: Sequence[KnownView], white: Sequence[_White], shares: Mapping[str, float], spread: float
) -> dict[str, float]:
    """Return the reflectance at which each kind of object loses its share."""
    return {
        kind: _solved(
            [(w, v.ids == i) for v, w in zip(views, white, strict=True)
             for i, k in v.kinds.items() if k == kind and (v.ids == i).any()],
            share, spread,
        )
        for kind, share in shares.items()
    }  # fmt: skip


def _pooled(
    views: Sequence[KnownView], white: Sequence[_White], shares: Mapping[str, float], spread: float
) -> float:
    """Return the one reflectance at which all objects together lose the mean of the shares."""
    parts = [(w, v.ids > BACKGROUND) for v, w in zip(views, white, strict=True)]
    parts = [(w, on) for w, on in parts if on.any()]
    return _solved(parts, next(iter(shares.values()), 0.0), spread)


def _solved(parts: Sequence[tuple[_White, Mask]], share: float, spread: float) -> float:
    """Return the reflectance that loses a share of the parts, by bisection in its logarithm."""
    weights = np.array([on.sum() for _, on in parts], dtype=np.float64)
    low, high = np.log(DARKEST), 0.0
    for _ in range(24):
        middle = (low + high) / 2
        lost = [w.loss(on, float(np.exp(middle)), spread) for w, on in parts]
        if float(np.average(lost, weights=weights)) > share:
            low = middle
        else:
            high = middle
    return float(np.exp(high))


def _shadow(view: KnownView, model: DepthSensorModel) -> Mask:
    return shadow_mask(
        view.scene, view.exact_m, view.intrinsics, view.T_world_cam,
        baseline_m=model.baseline_m, eye_offset_m=model.eye_offset_m, border=model.border,
    )  # fmt: skip


def _simulated(
    model: DepthSensorModel,
    views: Sequence[KnownView],
    shadows: Sequence[Mask],
    dark: Mapping[str, float] | None,
    seed: int,
) -> list[Array32]:
    """Return what the model makes of the exact depth of each view."""
    return [
        model.measure(
            v.exact_m, v.intrinsics, np.random.default_rng((seed, k)), shadow=shadows[k],
            reflectance=None if dark is None else reflectance_map(v, dark, 1.0),
        )
        for k, v in enumerate(views)
    ]  # fmt: skip


def _zones(view: KnownView, config: LossFitConfig) -> list[Mask]:
    """Return regions (H, W) where holes are compared.

    Inside the objects, their rims towards the left and towards the right, and the strips of
    background to the left and right of them, where shadows lie.
    """
    objects = view.ids > BACKGROUND
    far = ~objects & (view.exact_m > 0)
    left_of, right_of = _nearby(objects, config.rim_px)
    from_left, from_right = _nearby(far | (view.exact_m == 0), config.rim_px)
    inside = objects & ~from_left & ~from_right
    return [inside, objects & from_right, objects & from_left, far & right_of, far & left_of]


def _nearby(mask: Mask, reach_px: int) -> tuple[Mask, Mask]:
    """Return the pixels that have the mask within reach on their left, and on their right."""
    width = mask.shape[1]
    left, right = np.zeros_like(mask), np.zeros_like(mask)
    for step in range(1, min(reach_px, width - 1) + 1):
        left[:, step:] |= mask[:, :-step]
        right[:, :-step] |= mask[:, step:]
    return left, right


def _shares(depths: Sequence[Array32], zones: Sequence[Sequence[Mask]]) -> Array:
    """Return the share of holes in each zone, over all views."""
    lost = np.zeros(len(zones[0]))
    total = np.zeros(len(zones[0]))
    for depth, view_zones in zip(depths, zones, strict=True):
        for k, zone in enumerate(view_zones):
            total[k] += zone.sum()
            lost[k] += (depth[zone] <= 0).sum()
    return np.where(total > 0, lost / np.maximum(total, 1), np.nan)


def _material_shares(views: Sequence[KnownView], plain: Sequence[Array32]) -> dict[str, float]:
    """Return the loss by kind that a simulation without it lacks: (h - h0) / (1 - h0)."""
    holes: dict[str, list[float]] = {}
    for view, simulated in zip(views, plain, strict=True):
        for instance, kind in view.kinds.items():
            on = view.ids == instance
            row = holes.setdefault(kind, [0.0, 0.0, 0.0])
            row[0] += float(on.sum())
            row[1] += float((view.measured_m[on] <= 0).sum())
            row[2] += float((simulated[on] <= 0).sum())
    return {
        kind: float(np.clip((real - sim) / max(n - sim, 1), 0, LARGEST_LOSS))
        for kind, (n, real, sim) in holes.items()
        if n > 0
    }


def _lacking(views: Sequence[KnownView], simulated: Sequence[Array32]) -> dict[str, float]:
    """Return the share of its pixels by which each kind is lost more often than simulated."""
    counts: dict[str, list[float]] = {}
    for view, picture in zip(views, simulated, strict=True):
        for instance, kind in view.kinds.items():
            on = view.ids == instance
            row = counts.setdefault(kind, [0.0, 0.0])
            row[0] += float(on.sum())
            row[1] += float((view.measured_m[on] <= 0).sum()) - float((picture[on] <= 0).sum())
    return {kind: more / max(n, 1.0) for kind, (n, more) in counts.items()}


def _mean_share(views: Sequence[KnownView], shares: Mapping[str, float]) -> float:
    """Return the mean loss over all objects' pixels."""
    total = lost = 0.0
    for view in views:
        for instance, kind in view.kinds.items():
            n = float((view.ids == instance).sum())
            total += n
            lost += n * shares.get(kind, 0.0)
    return lost / max(total, 1.0)
