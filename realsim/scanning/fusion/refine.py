"""The cameras' poses made to agree with each other, with the robot's accuracy as prior.

The fused surface is itself made of the views, so aligning every view to it as if it were true
would converge slowly and never move what is common to all. Instead each patch of surface has an
unknown offset m along its normal, common to the views that see it, and the views have twists xi:

    r_pi + J_pi xi_i - m_p = noise,    xi_i = h + f_i,    h ~ N(0, hand-eye),  f_i ~ N(0, arm)

The offsets are eliminated (Schur), which leaves one small dense system; the common part h is seen
because cameras that look from different sides move the surface differently. The table is one
patch with three unknowns (height and two slopes): it ties height and tilt of all views together.
"""

from dataclasses import dataclass, field
from typing import Any

import numpy as np

from realsim.arrays import Array, Int64, Mask
from realsim.geometry.robust import mad_sigma, tukey_weights
from realsim.scanning.fusion.patches import Observations
from realsim.scanning.fusion.result import FusionConfig

KERNEL = 4.0
"""Cut-off of Tukey's kernel in sigmas of a patch (robustly scaled)."""
KEPT = 0.2
"""A patch whose weight is above this agrees."""
LEAST_FREE = 0.05
"""Share of the variance that a residual has at least."""
LEAST_SCALE = 0.5
"""Residuals are not believed to be smaller than this many of their sigmas."""
SWEEPS = 4
"""Re-weighted solutions per round; weights settle in three."""
TABLE_PRIOR = (0.02, 0.1)
"""1-sigma of the plane's height [m] and slopes: free, but never singular."""


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class PoseState:
    """Where the refinement stands."""

    twists: Array
    """(F, 6) right twists of the cameras against the robot's word, rotation first [rad, m]."""
    common: Array
    """(6,) their common part: the hand-eye's error, in the camera frame."""
    covariance: Array
    """(6 F, 6 F) of the twists."""
    plane: Array
    """(3,) height [m] and slopes along x and y of the table, against the frame it was seen in."""
    rms_m: Array
    """(F,) RMS of the views' residuals on patches of the object that they share [m], or NaN."""
    misfit: Array
    """(F,) the same in sigmas of the patches."""
    support: Array
    """(F,) share of these patches that the kernel keeps; NaN without."""
    shared: Int64
    """(F,) number of patches of the object that the view shares with others."""
    surface_sigma_m: float = float("nan")
    """1-sigma by which the pose errors that are left move the surface [m]."""
    figures: dict[str, Any] = field(default_factory=dict[str, Any])
    """For the report."""


def start_state(frames: int) -> PoseState:
    """Return the state before refinement: nothing moved."""
    return PoseState(
        twists=np.zeros((frames, 6)), common=np.zeros(6),
        covariance=np.zeros((6 * frames, 6 * frames)), plane=np.zeros(3),
        rms_m=np.full(frames, np.nan), misfit=np.full(frames, np.nan),
        support=np.full(frames, np.nan), shared=np.zeros(frames, np.int64),
    )  # fmt: skip


def refined_twists(
    seen: Observations, table: Observations, state: PoseState, config: FusionConfig
) -> PoseState:
    """Return the state after one round: the least-squares twists given what the views see.

    Args:
        seen: distances to patches of the object at the current poses.
        table: heights of patches of the table likewise.
        state: the current poses.
        config: gives the priors.
    """
    frames = len(state.twists)
    prior, x = _prior(state, config)
    step = np.zeros(6 * frames + 9)
    H = prior
    weights = np.ones(len(seen.residual)), np.ones(len(table.residual))
    offsets = seen.residual
    scale = 1.0
    for _ in range(SWEEPS):
        H, b = prior.copy(), -prior @ x
        _add_patches(H, b, seen, weights[0])
        _add_table(H, b, table, weights[1])
        step = np.asarray(np.linalg.solve(H, b), dtype=np.float64)
        offsets = _patch_residuals(seen, step, weights[0])
        weights, scale = _weights(seen, offsets, table, _table_residuals(table, step))
    moved = x + step
    inverse = np.asarray(np.linalg.inv(H), dtype=np.float64)
    covariance = inverse[: 6 * frames, : 6 * frames] * max(1.0, scale**2)
    # Where a view is alone the patch's offset takes up everything: that says nothing of the view.
    several = _several(seen)
    n = np.bincount(seen.view[several], minlength=frames)

    def mean(values: Array | Mask) -> Array:
        total = np.bincount(seen.view[several], values[several], minlength=frames)
        return np.where(n > 0, total / np.maximum(n, 1), np.nan)

    return PoseState(
        twists=moved[: 6 * frames].reshape(frames, 6),
        common=moved[6 * frames : 6 * frames + 6],
        covariance=covariance,
        plane=moved[6 * frames + 6 :],
        rms_m=np.sqrt(mean(np.square(offsets))),
        misfit=np.sqrt(mean(np.square(offsets / seen.sigma))),
        support=mean(weights[0] > KEPT),
        shared=n,
        surface_sigma_m=_surface_sigma(seen, weights[0], covariance),
        figures={
            "patches": int(seen.patch.max(initial=-1)) + 1,
            "observations": len(seen.residual),
            "shared_observations": int(np.count_nonzero(several)),
            "rms_mm": float(
                1e3
                * np.sqrt(
                    np.average(np.square(offsets[several]), weights=weights[0][several] + 1e-9)
                )
            )
            if several.any()
            else float("nan"),
            "noise_scale": scale,
            "step_mm": float(1e3 * np.abs(step[: 6 * frames].reshape(-1, 6)[:, 3:]).max()),
        },
    )


def _prior(state: PoseState, config: FusionConfig) -> tuple[Array, Array]:
    """Return the prior's precision (6F+9, 6F+9) and the current values (6F+9,)."""
    frames = len(state.twists)
    n = 6 * frames
    P = np.zeros((n + 9, n + 9))

    def precision(sigma: tuple[float, float]) -> Array:
        return np.diag([1 / sigma[1] ** 2] * 3 + [1 / sigma[0] ** 2] * 3)

    arm = precision(config.arm_sigma)
    for i in range(frames):
        a = slice(6 * i, 6 * i + 6)
        P[a, a] = arm
        P[a, n : n + 6] = P[n : n + 6, a] = -arm
    P[n : n + 6, n : n + 6] = precision(config.hand_eye_sigma) + frames * arm
    height, slope = TABLE_PRIOR
    P[n + 6 :, n + 6 :] = np.diag([1 / height**2, 1 / slope**2, 1 / slope**2])
    return P, np.concatenate([state.twists.ravel(), state.common, np.zeros(3)])


def _add_patches(H: Array, b: Array, seen: Observations, weights: Array) -> None:
    """Add the patches' equations, their offsets eliminated."""
    frames = (len(b) - 9) // 6
    w = weights / np.square(seen.sigma)
    patches = int(seen.patch.max(initial=-1)) + 1
    total = np.maximum(np.bincount(seen.patch, w, minlength=patches), 1e-12)
    mean = np.bincount(seen.patch, w * seen.residual, minlength=patches) / total
    G = np.zeros((patches, 6 * frames))
    wJ = w[:, None] * seen.jacobian
    columns = 6 * seen.view[:, None] + np.arange(6)
    G[seen.patch[:, None], columns] = wJ
    b_views = np.zeros((frames, 6))
    np.add.at(b_views, seen.view, wJ * (seen.residual - mean[seen.patch])[:, None])
    b[: 6 * frames] -= b_views.ravel()
    for i in range(frames):
        rows = seen.view == i
        a = slice(6 * i, 6 * i + 6)
        H[a, a] += wJ[rows].T @ seen.jacobian[rows]
    H[: 6 * frames, : 6 * frames] -= (G / total[:, None]).T @ G


def _add_table(H: Array, b: Array, table: Observations, weights: Array) -> None:
    """Add the table's equations: height over a + b x + c y."""
    n = len(b) - 9
    w = weights / np.square(table.sigma)
    K = -np.concatenate([np.ones((len(w), 1)), table.place], axis=1)
    wK = w[:, None] * K
    q = slice(n + 6, n + 9)
    H[q, q] += wK.T @ K
    b[q] -= wK.T @ table.residual
    for i in range(n // 6):
        rows = table.view == i
        a = slice(6 * i, 6 * i + 6)
        wJ = w[rows, None] * table.jacobian[rows]
        H[a, a] += wJ.T @ table.jacobian[rows]
        cross = wJ.T @ K[rows]
        H[a, q] += cross
        H[q, a] += cross.T
        b[a] -= wJ.T @ table.residual[rows]


def _patch_residuals(seen: Observations, step: Array, weights: Array) -> Array:
    """Return what is left (N,) of the patches' residuals after a step [m]."""
    frames = (len(step) - 9) // 6
    twists = step[: 6 * frames].reshape(frames, 6)
    r = seen.residual + np.sum(seen.jacobian * twists[seen.view], axis=1)
    w = np.maximum(weights, 1e-3) / np.square(seen.sigma)
    total = np.bincount(seen.patch, w)
    return r - (np.bincount(seen.patch, w * r) / total)[seen.patch]


def _table_residuals(table: Observations, step: Array) -> Array:
    """Return what is left (N,) of the table's residuals after a step [m]."""
    n = len(step) - 9
    twists = step[:n].reshape(-1, 6)
    a, b, c = step[n + 6 :]
    moved = table.residual + np.sum(table.jacobian * twists[table.view], axis=1)
    return moved - (a + b * table.place[:, 0] + c * table.place[:, 1])


def _several(seen: Observations) -> Mask:
    """Return which observations (N,) are of a patch that other views see too."""
    return np.bincount(seen.patch)[seen.patch] > 1 if len(seen.patch) else np.zeros(0, dtype=bool)


def _weights(
    seen: Observations, left: Array, table: Observations, table_left: Array
) -> tuple[tuple[Array, Array], float]:
    """Return Tukey's weights of both kinds of patches and the robust scale of the object's.

    A view that is one of few in its patch pulls the patch's offset towards itself: its residual
    has the variance sigma^2 (1 - share of the weight) and is judged by that.
    """
    w = 1 / np.square(seen.sigma)
    total = np.bincount(seen.patch, w) if len(w) else np.zeros(0)
    free = np.sqrt(np.maximum(1 - w / total[seen.patch], LEAST_FREE))
    several = _several(seen)
    z, z_table = np.abs(left) / (seen.sigma * free), np.abs(table_left) / table.sigma
    scale, table_scale = _scale(z[several]), _scale(z_table)

    return (
        np.where(several, tukey_weights(np.square(z / (KERNEL * scale))), 1.0),
        tukey_weights(np.square(z_table / (KERNEL * table_scale))),
    ), scale


def _scale(z: Array) -> float:
    """Return the robust standard deviation of residuals in sigmas, not below LEAST_SCALE."""
    return max(LEAST_SCALE, mad_sigma(z)) if len(z) else 1.0


def _surface_sigma(seen: Observations, weights: Array, covariance: Array) -> float:
    """Return the RMS 1-sigma [m] of the patches' offsets because of the twists' covariance.

    The offset of a patch is the weighted mean of its views' distances; its derivative g by all
    twists has 6 entries per view, and its variance is g' C g.
    """
    w = weights / np.square(seen.sigma)
    patches = int(seen.patch.max(initial=-1)) + 1
    if patches == 0:
        return float("nan")
    total = np.maximum(np.bincount(seen.patch, w, minlength=patches), 1e-12)
    G = np.zeros((patches, len(covariance)))
    columns = 6 * seen.view[:, None] + np.arange(6)
    G[seen.patch[:, None], columns] = (w / total[seen.patch])[:, None] * seen.jacobian
    return float(np.sqrt(np.mean(np.sum((G @ covariance) * G, axis=1))))
