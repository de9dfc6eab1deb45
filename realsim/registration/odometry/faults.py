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


LEAST_MM = 2.0
"""Smaller shifts of the camera are not named [mm]: depth alone measures a pair to 0.5 mm."""
LEAST_DEG = 0.4
"""Smaller turns are not named [deg]: depth alone measures a pair to 0.1."""
NOISE_FACTOR = 3.0
"""A fault is at least as many times the noise, which is measured from the pairs themselves."""
MOST_NOISE_MM = 1.2
"""Noise is not believed to be above this [mm], or a scene full of faults would hide them."""
MOST_NOISE_DEG = 0.25
"""Greatest noise of a turn that is believed [deg]."""
SCREEN_MM = 0.35
"""Sigma of a component at most while the gravest fault is sought [mm]; a mount that slipped
early spoils most pairs, and noise measured from those would hide it."""
SCREEN_DEG = 0.07
"""Greatest sigma of a component of a turn while the gravest fault is sought [deg]."""
FLOOR_MM = 0.15
"""Least sigma of a component of a pair's difference [mm]."""
FLOOR_DEG = 0.03
"""Least sigma of a component of a pair's turn [deg]."""
CAUCHY = 12.0
"""Squared whitened residual from which a pair counts less; a good one has 6 on average."""
LEAST_GAIN = 8.0
"""A fault lowers the robust cost by this much per pair of it."""
EXPLAINED = 0.35
"""A pair is explained if its squared residual falls below this part of what it was."""
EXPLAINED_SHARE = 0.6
"""A fault explains at least this share of its pairs: a single wrong alignment does not."""
NUISANCE = 0.6
"""Differences of this part of a nameable fault are taken out unnamed."""
MOST_FAULTS = 24
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


def noise_of(r: Array) -> Noise:
    """Return the noise of pair differences (E, 6) from the smaller ones, which faults spare.

    A quantile of the lengths, divided by what it is of a normal distribution with sigma 1: of one
    component (for `sigmas`), and of a vector of three over the median of such (for mm, deg).
    """
    low = np.repeat([np.radians(FLOOR_DEG), 1e-3 * FLOOR_MM], 3)
    high = np.repeat([np.radians(MOST_NOISE_DEG), 1e-3 * MOST_NOISE_MM], 3)
    if len(r) == 0:
        return Noise(mm=0.0, deg=0.0, sigmas=low)
    sigmas = np.quantile(np.abs(r), NOISE_QUANTILE, axis=0) / QUANTILE_OF_ONE
    turn, shift = (
        QUANTILE_TO_MEDIAN * float(np.quantile(np.linalg.norm(x, axis=1), NOISE_QUANTILE))
        for x in (r[:, :3], r[:, 3:])
    )
    return Noise(mm=1e3 * shift, deg=float(np.degrees(turn)), sigmas=np.clip(sigmas, low, high))


def find_faults(
    Ts_world_cam: Array, edges: Sequence[Edge], aim: Array
) -> tuple[tuple[PoseFault, ...], Array]:
    """Return the faults, gravest first, and the poses (F, 4, 4) without them.

    What is too small to be named is taken out as well, or it would come back as another kind.

    Args:
        Ts_world_cam: (F, 4, 4) claimed.
        edges: the pairs whose alignment can be trusted.
        aim: (3,) what the views look at, world [m]: a moved table is measured there.
    """
    Ts = Ts_world_cam.copy()
    faults: list[PoseFault] = []
    refuted: set[tuple[str, int]] = set()
    for _ in range(MOST_FAULTS if edges else 0):
        before = noise_of(differences(Ts, edges))
        fault = _gravest(Ts, edges, aim, _screening(before), refuted)
        if fault is None:
            break
        mended = _correct_poses(Ts, fault)
        # What is left without the fault says what the noise is.
        noise = noise_of(differences(mended, edges))
        if not _explains(fault, Ts, mended, edges, noise):
            refuted.add((_group(fault.kind), fault.place))
            continue
        if _size(fault, noise) > 1.0:
            faults.append(fault)
        Ts = mended
    return tuple(faults), Ts


def _group(kind: str) -> str:
    """Return what a kind of fault is searched as: mount and world are told apart afterwards."""
    return "view" if kind == "view" else "change"


def _screening(noise: Noise) -> Noise:
    """Return the noise with which the gravest fault is sought."""
    most = np.repeat([np.radians(SCREEN_DEG), 1e-3 * SCREEN_MM], 3)
    return Noise(mm=noise.mm, deg=noise.deg, sigmas=np.minimum(noise.sigmas, most))


def _explains(
    fault: PoseFault, Ts: Array, mended: Array, edges: Sequence[Edge], noise: Noise,
) -> bool:  # fmt: skip
    """Return whether a fault is still needed, given the noise that is left without it."""
    touched = np.array([
        (fault.place in (e.first, e.second)) if fault.kind == "view"
        else e.first < fault.place <= e.second
        for e in edges
    ])  # fmt: skip
    c = CAUCHY
    before, after = (
        np.sum(np.square(differences(x, edges)[touched] / noise.sigmas), axis=1)
        for x in (Ts, mended)
    )
    gain = np.sum(c * np.log1p(before / c) - c * np.log1p(after / c))
    return bool(gain > LEAST_GAIN * np.count_nonzero(touched))


def _gravest(
    Ts: Array, edges: Sequence[Edge], aim: Array, noise: Noise,
    refuted: set[tuple[str, int]],
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
        kinds: tuple[tuple[Kind, NDArray[np.intp]], ...] = (
            ("view", incident), ("mount", crossing), ("world", crossing)
        )  # fmt: skip
        for kind, which in kinds:
            # A view alone at one end is a change from there on as well: the former says less.
            if len(which) == 0 or (kind != "view" and k in (0, len(Ts) - 1)):
                continue
            if np.median(cost[which]) < CAUCHY or (_group(kind), k) in refuted:
                continue
            gain, explained, twist = _fit_fault(kind, k, Ts, edges, r, which, noise)
            if gain < LEAST_GAIN * len(which) or explained < EXPLAINED_SHARE:
                continue
            fault = _size_of(kind, k, twist, aim)
            if (best is None or gain > best[0]) and _size(fault, noise) > NUISANCE:
                best = gain, fault
    if best is None:
        return None
    return best[1] if best[1].kind == "view" else _mount_or_world(
        best[1], Ts, edges, r, aim, noise
    )  # fmt: skip


def _fit_fault(
    kind: Kind, k: int, Ts: Array, edges: Sequence[Edge], r: Array,
    which: NDArray[np.intp], noise: Noise,
) -> tuple[float, float, Array]:  # fmt: skip
    """Return the gain in robust cost, the share of explained pairs, and the twist (6,) of a fault.

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
        weight = 1.0 / (1.0 + q / CAUCHY)
    c = CAUCHY
    gain = float(np.sum(c * np.log1p(before / c) - c * np.log1p(q / c)))
    return gain, float(np.mean(q < np.maximum(EXPLAINED * before, c))), s


def _jacobian(
    kind: Kind, k: int, Ts: Array, edges: Sequence[Edge], which: NDArray[np.intp]
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
) -> PoseFault:  # fmt: skip
    """Return the change as that of the mount or of the world, whichever fits all pairs better.

    Pairs after the change tell: they do not feel a moved world, but a mount that slipped.
    """
    later = np.flatnonzero([e.second >= fault.place for e in edges])
    kinds: tuple[Kind, ...] = ("mount", "world")
    found: list[tuple[float, PoseFault]] = []
    for kind in kinds:
        # Pairs that feel nothing of the fault take part: it need not explain most of them.
        gain, _, twist = _fit_fault(kind, fault.place, Ts, edges, r, later, noise)
        found.append((gain, _size_of(kind, fault.place, twist, aim)))
    (best, chosen), (other, _) = sorted(found, key=lambda f: -f[0])
    return replace(chosen, alternative=best - other < CAUCHY)


def _size_of(kind: Kind, k: int, twist: Array, aim: Array) -> PoseFault:
    """Return a fault with its size [mm, deg]."""
    T = se3.exp(twist)
    deg = float(np.degrees(se3.angle(T)))
    shift = T[:3, 3]
    if kind == "world":
        shift = se3.transform(T, aim[None])[0] - aim
    mm = float(1e3 * np.linalg.norm(shift))
    return PoseFault(kind=kind, place=k, twist=twist, mm=mm, deg=deg, alternative=False)


def _size(fault: PoseFault, noise: Noise) -> float:
    """Return the size of a fault over the size from which it is named."""
    mm = max(LEAST_MM, NOISE_FACTOR * min(noise.mm, MOST_NOISE_MM))
    deg = max(LEAST_DEG, NOISE_FACTOR * min(noise.deg, MOST_NOISE_DEG))
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
