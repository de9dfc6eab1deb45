"""Which wrong views, or which change from a view on, explain the differences of the pairs.

A pair (i, j) measures how wrong its two poses are against each other: with T_true = T_claimed
exp(x), the twist of F^-1 Z (F claimed, Z measured T_i_j) is x_j - Ad(F^-1) x_i. Each kind of fault
is a choice of six numbers s and of how they enter every x: one view (x_k = s), a mount that slipped
(x_i = s for i >= k), a table or robot base that was moved (x_i = Ad(T_i^-1) s for i >= k). They are
fitted robustly to the pairs they touch, the best one is taken, its effect removed, and so on.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from realsim.arrays import Array
from realsim.geometry import se3
from realsim.registration.odometry.pairs import Edge, relative

Kind = Literal["view", "mount", "world"]
NOISE_QUANTILE = 0.3
"""Share of the pairs that are surely free of faults: after a slip half of them may not be."""
QUANTILE_OF_ONE = 0.3853
"""That quantile of the absolute value of a normal number of sigma 1."""
QUANTILE_TO_MEDIAN = 1.5382 / 1.1932
"""Median of the length of three such numbers over that quantile of it (chi, 3 degrees)."""
ROBUST_STEPS = 6
"""Re-weighted least squares settles within as many steps on six unknowns."""


@dataclass(frozen=True, kw_only=True, slots=True)
class FaultConfig:
    """From when a difference is a fault."""

    least_mm: float = 2.0
    """Smaller shifts of the camera are not named [mm]: depth alone measures a pair to 0.5 mm."""
    least_deg: float = 0.4
    """Smaller turns are not named [deg]: depth alone measures a pair to 0.1."""
    noise_factor: float = 3.0
    """A fault is at least as many times the noise, which is measured from the pairs themselves."""
    most_noise_mm: float = 1.2
    """Noise is not believed to be above this [mm], or a scene full of faults would hide them."""
    most_noise_deg: float = 0.25
    """Greatest noise of a turn that is believed [deg]."""
    screen_mm: float = 0.35
    """Sigma of a component at most while the gravest fault is sought [mm]; a mount that slipped
    early spoils most pairs, and noise measured from those would hide it."""
    screen_deg: float = 0.07
    """Greatest sigma of a component of a turn while the gravest fault is sought [deg]."""
    floor_mm: float = 0.15
    """Least sigma of a component of a pair's difference [mm]."""
    floor_deg: float = 0.03
    """Least sigma of a component of a pair's turn [deg]."""
    cauchy: float = 12.0
    """Squared whitened residual from which a pair counts less; a good one has 6 on average."""
    least_gain: float = 8.0
    """A fault lowers the robust cost by this much per pair of it."""
    explained: float = 0.35
    """A pair is explained if its squared residual falls below this part of what it was."""
    explained_share: float = 0.6
    """A fault explains at least this share of its pairs: a single wrong alignment does not."""
    nuisance: float = 0.6
    """Differences of this part of a nameable fault are taken out unnamed."""
    most_faults: int = 24
    """Faults looked for at most."""


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class PoseFault:
    """One wrong view, or what changed from a view on; numbers are places in the list of views."""

    kind: Kind
    place: int
    """The view, or the first one after the change."""
    twist: Array
    """(6,) of the camera (kinds view, mount) in its own axes, or of the world in its [rad, m]."""
    mm: float
    """How far the camera is off [mm]; after a change, on average over the views from there on."""
    deg: float
    """How far it is turned [deg]."""
    alternative: bool
    """Whether mount and world explain the change about equally well."""


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Noise:
    """How much the pairs differ where nothing is wrong."""

    mm: float
    """Median length of the shift [mm], faults left aside."""
    deg: float
    """Median turn [deg], faults left aside."""
    sigmas: Array
    """(6,) of the components [rad, m]."""


def differences(Ts_world_cam: Array, edges: Sequence[Edge]) -> Array:
    """Return the twists (E, 6) by which the measured relative poses differ from the claimed."""
    if not edges:
        return np.zeros((0, 6))
    F = np.stack([relative(Ts_world_cam, e.first, e.second) for e in edges])
    Z = np.stack([e.T_first_second for e in edges])
    return se3.log(se3.invert(F) @ Z)


def noise_of(r: Array, config: FaultConfig) -> Noise:
    """Return the noise of pair differences (E, 6) from the smaller ones, which faults spare.

    A quantile of the lengths, divided by what it is of a normal distribution with sigma 1: of one
    component (for `sigmas`), and of a vector of three over the median of such (for mm, deg).
    """
    low = np.repeat([np.radians(config.floor_deg), 1e-3 * config.floor_mm], 3)
    high = np.repeat([np.radians(config.most_noise_deg), 1e-3 * config.most_noise_mm], 3)
    if len(r) == 0:
        return Noise(mm=0.0, deg=0.0, sigmas=low)
    sigmas = np.quantile(np.abs(r), NOISE_QUANTILE, axis=0) / QUANTILE_OF_ONE
    turn, shift = (
        QUANTILE_TO_MEDIAN * float(np.quantile(np.linalg.norm(x, axis=1), NOISE_QUANTILE))
        for x in (r[:, :3], r[:, 3:])
    )
    return Noise(mm=1e3 * shift, deg=float(np.degrees(turn)), sigmas=np.clip(sigmas, low, high))


def find_faults(
    Ts_world_cam: Array, edges: Sequence[Edge], aim: Array, config: FaultConfig
) -> tuple[tuple[PoseFault, ...], Array]:
    """Return the faults, gravest first, and the poses (F, 4, 4) without them.

    What is too small to be named is taken out as well, or it would come back as another kind.

    Args:
        Ts_world_cam: (F, 4, 4) claimed.
        edges: the pairs whose alignment can be trusted.
        aim: (3,) what the views look at, world [m]: a moved table is measured there.
        config: settings.
    """
    Ts = Ts_world_cam.copy()
    faults: list[PoseFault] = []
    refuted: set[tuple[str, int]] = set()
    for _ in range(config.most_faults if edges else 0):
        before = noise_of(differences(Ts, edges), config)
        fault = _gravest(Ts, edges, aim, _screening(before, config), refuted, config)
        if fault is None:
            break
        mended = _correct_poses(Ts, fault)
        # What is left without the fault says what the noise is.
        noise = noise_of(differences(mended, edges), config)
        if not _explains(fault, Ts, mended, edges, noise, config):
            refuted.add((_group(fault.kind), fault.place))
            continue
        if _size(fault, noise, config) > 1.0:
            faults.append(fault)
        Ts = mended
    return tuple(faults), Ts


def _group(kind: str) -> str:
    """Return what a kind of fault is searched as: mount and world are told apart afterwards."""
    return "view" if kind == "view" else "change"


def _screening(noise: Noise, config: FaultConfig) -> Noise:
    """Return the noise with which the gravest fault is sought."""
    most = np.repeat([np.radians(config.screen_deg), 1e-3 * config.screen_mm], 3)
    return Noise(mm=noise.mm, deg=noise.deg, sigmas=np.minimum(noise.sigmas, most))


def _explains(
    fault: PoseFault, Ts: Array, mended: Array, edges: Sequence[Edge], noise: Noise,
    config: FaultConfig,
) -> bool:  # fmt: skip
    """Return whether a fault is still needed, given the noise that is left without it."""
    touched = np.array([
        (fault.place in (e.first, e.second)) if fault.kind == "view"
        else e.first < fault.place <= e.second
        for e in edges
    ])  # fmt: skip
    c = config.cauchy
    before, after = (
        np.sum(np.square(differences(x, edges)[touched] / noise.sigmas), axis=1)
        for x in (Ts, mended)
    )
    gain = np.sum(c * np.log1p(before / c) - c * np.log1p(after / c))
    return bool(gain > config.least_gain * np.count_nonzero(touched))


def _gravest(
    Ts: Array, edges: Sequence[Edge], aim: Array, noise: Noise,
    refuted: set[tuple[str, int]], config: FaultConfig,
) -> PoseFault | None:  # fmt: skip
    """Return the fault that lowers the cost of all pairs most, or None if none is one."""
    r = differences(Ts, edges)
    first = np.array([e.first for e in edges])
    second = np.array([e.second for e in edges])
    cost = np.sum(np.square(r / noise.sigmas), axis=1)
    best: tuple[float, PoseFault] | None = None
    for k in range(len(Ts)):
        incident = np.flatnonzero((first == k) | (second == k))
        crossing = np.flatnonzero((first < k) & (second >= k))
        for kind, which in (("view", incident), ("mount", crossing), ("world", crossing)):
            # A view alone at one end is a change from there on as well: the former says less.
            if len(which) == 0 or (kind != "view" and k in (0, len(Ts) - 1)):
                continue
            if np.median(cost[which]) < config.cauchy or (_group(kind), k) in refuted:
                continue
            found = _fit_fault(kind, k, Ts, edges, r, which, noise, config)
            if found is None:
                continue
            gain, twist = found
            fault = _size_of(kind, k, twist, aim)
            if (best is None or gain > best[0]) and _size(fault, noise, config) > config.nuisance:
                best = gain, fault
    if best is None:
        return None
    return best[1] if best[1].kind == "view" else _mount_or_world(
        best[1], Ts, edges, r, aim, noise, config
    )  # fmt: skip


def _fit_fault(
    kind: str, k: int, Ts: Array, edges: Sequence[Edge], r: Array,
    which: NDArray[np.intp], noise: Noise, config: FaultConfig,
) -> tuple[float, Array] | None:  # fmt: skip
    """Return the gain in robust cost and the twist (6,) of a fault, or None if it is not one.

    Cauchy's cost c log(1 + q / c) of the squared whitened residuals q, by re-weighting.
    """
    J = _jacobian(kind, k, Ts, edges, which)
    W = 1.0 / noise.sigmas
    A, b = J * W[None, :, None], r[which] * W
    s = np.zeros(6)
    q = np.sum(np.square(b), axis=1)
    before = q.copy()
    # From equal weights: the fault itself must not be taken for an outlier.
    weight = np.ones(len(which))
    for _ in range(ROBUST_STEPS):
        H = np.einsum("e,eab,eac->bc", weight, A, A)
        g = np.einsum("e,eab,ea->b", weight, A, b)
        s = np.linalg.lstsq(H, g, rcond=None)[0]
        q = np.sum(np.square(b - A @ s), axis=1)
        weight = 1.0 / (1.0 + q / config.cauchy)
    c = config.cauchy
    gain = float(np.sum(c * np.log1p(before / c) - c * np.log1p(q / c)))
    explained = np.mean(q < np.maximum(config.explained * before, c))
    if gain < config.least_gain * len(which) or explained < config.explained_share:
        return None
    return gain, s


def _jacobian(
    kind: str, k: int, Ts: Array, edges: Sequence[Edge], which: NDArray[np.intp]
) -> Array:
    """Return d(pair difference)/d(twist) (E, 6, 6) of a fault for some of the pairs."""
    out = np.zeros((len(which), 6, 6))
    for row, e in enumerate(which):
        i, j = edges[e].first, edges[e].second
        for place, sign in ((j, 1.0), (i, -1.0)):
            if place != k if kind == "view" else place < k:
                continue
            B = se3.adjoint(se3.invert(Ts[place])) if kind == "world" else np.eye(6)
            if place == i:
                B = se3.adjoint(se3.invert(relative(Ts, i, j))) @ B
            out[row] += sign * B
    return out


def _mount_or_world(
    fault: PoseFault, Ts: Array, edges: Sequence[Edge], r: Array, aim: Array, noise: Noise,
    config: FaultConfig,
) -> PoseFault:  # fmt: skip
    """Return the change as that of the mount or of the world, whichever fits all pairs better.

    Pairs after the change tell: they do not feel a moved world, but a mount that slipped.
    """
    later = np.flatnonzero([e.second >= fault.place for e in edges])
    # Pairs that feel nothing of the fault may take part.
    lenient = replace(config, least_gain=-np.inf, explained_share=0.0)
    costs: dict[str, tuple[float, PoseFault]] = {}
    kinds: tuple[Kind, ...] = ("mount", "world")
    for kind in kinds:
        found = _fit_fault(kind, fault.place, Ts, edges, r, later, noise, lenient)
        if found is not None:
            gain, twist = found
            costs[kind] = (gain, _size_of(kind, fault.place, twist, aim))
    if not costs:
        return fault
    ordered = sorted(costs.values(), key=lambda c: -c[0])
    alike = len(ordered) > 1 and ordered[0][0] - ordered[1][0] < config.cauchy
    chosen = ordered[0][1]
    return PoseFault(
        kind=chosen.kind, place=chosen.place, twist=chosen.twist, mm=chosen.mm, deg=chosen.deg,
        alternative=alike,
    )  # fmt: skip


def _size_of(kind: Kind | str, k: int, twist: Array, aim: Array) -> PoseFault:
    """Return a fault with its size [mm, deg]."""
    T = se3.exp(twist)
    deg = float(np.degrees(se3.angle(T)))
    shift = T[:3, 3]
    if kind == "world":
        shift = se3.transform(T, aim[None])[0] - aim
    named: Kind = "view" if kind == "view" else "mount" if kind == "mount" else "world"
    mm = float(1e3 * np.linalg.norm(shift))
    return PoseFault(kind=named, place=k, twist=twist, mm=mm, deg=deg, alternative=False)


def _size(fault: PoseFault, noise: Noise, config: FaultConfig) -> float:
    """Return the size of a fault over the size from which it is named."""
    mm = max(config.least_mm, config.noise_factor * min(noise.mm, config.most_noise_mm))
    deg = max(config.least_deg, config.noise_factor * min(noise.deg, config.most_noise_deg))
    return max(fault.mm / mm, fault.deg / deg)


def _correct_poses(Ts: Array, fault: PoseFault) -> Array:
    """Return the poses (F, 4, 4) without a fault."""
    out = Ts.copy()
    T, k = se3.exp(fault.twist), fault.place
    if fault.kind == "view":
        out[k] = Ts[k] @ T
    elif fault.kind == "mount":
        out[k:] = Ts[k:] @ T
    else:
        out[k:] = T @ Ts[k:]
    return out
