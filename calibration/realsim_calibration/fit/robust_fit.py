"""From a closed form to the calibration: noise scales, the robot's error map, covariances.

1. joint fit without robot errors, then with them at lambda = 0.3; corners re-weighted
2. linearise there: is the corner noise independent inside views, how large may lambda be
3. candidates for the robot's smooth error: none, maps in tool and base axes, the arm's own
numbers; each judged by predicting every view without it
4. joint fit with the chosen one, lambda and sigma re-estimated
5. covariance from noise and from what the arm may still hide
"""

from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING

import numpy as np

from realsim.arrays import Array
from realsim.geometry import se3
from realsim.geometry.dh import DhArm
from realsim.records import ArmErrorMap, RobotErrorMap
from realsim_calibration.fit import noise_scale
from realsim_calibration.fit.joint_solve import (
    JointProblem,
    JointState,
    Setup,
    shaped_points,
    smooth_errors,
)
from realsim_calibration.fit.linear_model import (
    LinearFit,
    LinearModel,
    PlainFit,
    plain_fits,
    projection,
    stretch,
)
from realsim_calibration.fit.robot_error import (
    ErrorBasis,
    arm_basis,
    map_basis,
    map_record,
    pose_features,
)
from realsim_calibration.fit.view_system import SHARED, refine_board_pose
from realsim_calibration.results import Stretch

if TYPE_CHECKING:
    from realsim_calibration.screening import HandEyeConfig

X = slice(0, 6)

MAP_UNIT = 5e-4
"""A weight of a map at strength 1 [rad and m per unit feature]."""
MAP_STRENGTHS = (0.1, 0.3, 1.0)
"""Ridges that are tried: half a millimetre at the edge of the poses, times these."""
MAP_GAIN = 1.0
"""A map must predict unseen views better than no map by so many standard errors."""
WORTH = 0.05
"""It must predict better by this share, too: with hundreds of views a gain of one percent is
beyond chance and not worth 72 more numbers, which tripled the error where the robot's errors
were white."""
ARM_GAIN = 2.0
"""It must be better than the arm's own numbers by so many standard errors, which cannot bend as
freely."""


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class SolvedView:
    """One view's part, by default that of one not used; the fields are those of ViewReport."""

    residuals: Array = field(default_factory=lambda: np.zeros((0, 2)))
    seen_px: float = float("nan")
    unseen_px: float = float("nan")
    unseen_mm: float = float("nan")
    unseen_deg: float = float("nan")
    robot_error: Array = field(default_factory=lambda: np.zeros(6))


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Solution:
    """The calibration."""

    problem: JointProblem
    state: JointState
    sigma_px: float
    ratio: Array
    """(2,) lambda of rotation and of translation."""
    covariance: Array
    """(29, 29) of the shared parameters."""
    information: Array
    """(29, 29), the map held."""
    here: Array
    """(4, 4) X for this arm as it moves here: see `effective`."""
    here_covariance: Array
    """(6, 6) of its right perturbation; what the arm gets wrong everywhere cancels."""
    alone: JointState
    """The joint fit without a map."""
    alone_covariance: Array
    """(29, 29)."""
    alone_here_covariance: Array
    """(6, 6) of its X, for this arm."""
    plain: tuple[PlainFit, ...]
    """Joint fits for programs that know no map, `alone` first."""
    stretch: Stretch | None
    """How the map does beyond its poses; None without a map of the poses."""
    robot_map: RobotErrorMap | ArmErrorMap | None
    map_name: str
    scores: tuple[tuple[str, float], ...]
    joint_offsets: Array | None
    views: tuple[SolvedView, ...]


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Choice:
    """A candidate with its fit."""

    basis: ErrorBasis | None
    ratio: Array
    fit: LinearFit

    @property
    def name(self) -> str:
        """Name of the basis, "none" without one."""
        return "none" if self.basis is None else self.basis.name


def solve(
    setup: Setup, start: tuple[Array, Array], config: "HandEyeConfig",
    arm: DhArm | None, joints: Array | None,
) -> Solution:  # fmt: skip
    """Return the calibration from a closed-form start (X, Z).

    Raises:
        DegenerateError: the views do not determine the parameters.
    """
    problem = JointProblem(setup, config.joint)
    state, sigma, roots = _first_fit(problem, start, config)
    model = LinearModel(problem, state, roots)
    fixed = config.joint.robot_ratio
    white, most, ratio = _robot_share(problem, model, state, sigma, config)
    none = Choice(basis=None, ratio=ratio, fit=model.fit(None, ratio, sigma))
    choices = [none]
    Ts = np.stack([v.T_base_ee for v in setup.views])
    known: ErrorBasis | None = None
    if config.robot_map:
        bounded = ratio if fixed else np.minimum(ratio, noise_scale.BOUND)
        choices += map_choices(model, Ts, sigma, bounded)
    if arm is not None and joints is not None:
        # What is left of the robot's error beside the arm's own is noise: lambda needs no bound.
        basis = arm_basis(arm, joints, Ts)
        arm_ratio, known = noise_scale.estimate_arm(model, basis, sigma, fixed)
        fit = model.fit(known, arm_ratio, sigma)
        if config.robot_map:
            choices.append(Choice(basis=known, ratio=arm_ratio, fit=fit))
    best = chosen_of(choices)
    if best.basis is not None and best.basis.kind != "arm":
        basis = _mean_strength(best.basis, choices)
        if not fixed:
            ratio = noise_scale.estimate_ratio(model, basis, sigma, most)
        used = ratio if not fixed else best.ratio
        best = Choice(basis=basis, ratio=used, fit=model.fit(basis, used, sigma))
    alone = state.moved(none.fit.step)
    plain = plain_fits(model, none.fit, sigma, best.fit, best.basis)
    beyond = None
    if best.basis is not None and best.basis.kind != "arm":
        beyond = stretch(model, best.fit, best.basis, none.fit, pose_features(Ts)[0])
    independent = white.excess <= 0
    alone_here = here_covariance(model, none, independent=independent)
    state, sigma, roots = _final_fit(problem, state, best, roots)
    model = LinearModel(problem, state, roots)
    final = model.fit(best.basis, best.ratio, sigma)
    columns = hidden_errors(model, none, known, Ts, sigma)
    best = replace(best, fit=final)
    here = here_covariance(model, best, independent=independent)
    covariance = at_least(_covariance(model, final, best, columns, known, independent), here)
    alone_covariance = _covariance(model, none.fit, none, columns, known, independent)
    moved = projection(model, best.basis)[:6, SHARED:] @ state.weights
    return Solution(
        problem=problem,
        state=state,
        sigma_px=sigma,
        ratio=best.ratio,
        covariance=covariance[:SHARED, :SHARED],
        information=final.information[:SHARED, :SHARED],
        here=state.X @ se3.exp(moved),
        here_covariance=here,
        alone=alone,
        alone_here_covariance=alone_here,
        plain=tuple(plain),
        stretch=beyond,
        alone_covariance=at_least(alone_covariance, alone_here)[:SHARED, :SHARED],
        robot_map=None if best.basis is None else map_record(best.basis, state.weights, Ts, arm),
        map_name=best.name,
        scores=tuple((c.name, c.fit.score) for c in choices),
        joint_offsets=_offsets(best, state, covariance),
        views=_views(problem, state, best.basis, final),
    )


def _first_fit(
    problem: JointProblem, start: tuple[Array, Array], config: "HandEyeConfig"
) -> tuple[JointState, float, Array]:
    """Return the fit at the bounded lambda, sigma, and the roots of the corner weights."""
    joint = config.joint
    ratio = np.full(2, joint.robot_ratio or noise_scale.BOUND)
    state, roots = problem.start(*start), problem.ones()
    state = problem.optimize(state, joint.start_sigma_px, np.zeros(2), roots, None)
    sigma, roots = problem.spread(state, joint.start_sigma_px, ratio, None)
    for _ in range(joint.rounds - 1):
        state = problem.optimize(state, sigma, ratio, roots, None)
        sigma, roots = problem.spread(state, sigma, ratio, None)
    return state, sigma, roots


def _robot_share(
    problem: JointProblem, model: LinearModel, state: JointState, sigma: float,
    config: "HandEyeConfig",
) -> tuple[noise_scale.Whiteness, float, Array]:  # fmt: skip
    """Return whether corners are independent, the largest lambda, and lambda (2,) without a map."""
    if config.joint.robot_ratio:
        white = noise_scale.whiteness(problem, state)
        return white, config.joint.robot_ratio, np.full(2, config.joint.robot_ratio)
    free = noise_scale.estimate_ratio(model, None, sigma, noise_scale.MOST)
    # Judged where the lens is fitted with the robot's share as it would like to be.
    white = noise_scale.whiteness(problem, state.moved(model.fit(None, free, sigma).step))
    most = noise_scale.largest_ratio(white)
    if most < noise_scale.MOST:
        free = noise_scale.estimate_ratio(model, None, sigma, most)
    return white, most, free


def _final_fit(
    problem: JointProblem, state: JointState, best: Choice, roots: Array
) -> tuple[JointState, float, Array]:
    """Return the joint fit with the chosen robot error, from the linear solution."""
    weights = best.fit.step[29:]
    moved = replace(state.moved(best.fit.step[:29]), weights=weights)
    state = problem.optimize(moved, best.fit.sigma_px, best.ratio, roots, best.basis)
    sigma, roots = problem.spread(state, best.fit.sigma_px, best.ratio, best.basis)
    return state, sigma, roots


def map_choices(model: LinearModel, Ts: Array, sigma: float, ratio: Array) -> Iterator[Choice]:
    """Yield the fits with a map in tool or base axes, weakest first."""
    for strength in MAP_STRENGTHS:
        for kind in ("ee", "base"):
            basis = map_basis(Ts, kind, strength, MAP_UNIT)
            yield Choice(basis=basis, ratio=ratio, fit=model.fit(basis, ratio, sigma))


def chosen_of(choices: list[Choice]) -> Choice:
    """Return the candidate that predicts unseen views best; sounder ones win within the noise.

    A map must beat no map, and the arm's own numbers, by so many standard errors of the paired
    logarithms of the unseen views' errors.
    """
    none = choices[0]
    arms = [c for c in choices if c.basis is not None and c.basis.kind == "arm"]
    maps = [c for c in choices if c.basis is not None and c.basis.kind != "arm"]
    best = min(maps, key=lambda c: c.fit.score) if maps else none
    if best is not none:
        worth_it = best.fit.score < (1 - WORTH) * none.fit.score
        if not worth_it or _gain_in_errors(none, best) < MAP_GAIN:
            best = none
    for arm in arms:
        if _gain_in_errors(arm, best) < ARM_GAIN:
            best = arm
    return best


def _mean_strength(best: ErrorBasis, choices: list[Choice]) -> ErrorBasis:
    """Return the chosen kind of map at the mean strength of its candidates.

    Views tell a map's strength roughly, so the likeliest one is a matter of luck: each strength
    counts by its predictive density, score^-views (pseudo-Bayesian model averaging, Yao et al.
    2018).
    """
    fits = [(c.basis, c.fit) for c in choices if c.basis is not None and c.basis.kind == best.kind]
    scores = np.array([fit.score for _, fit in fits])
    weights = (scores / scores.min()) ** -float(len(best.columns))
    logs = np.log([basis.unit[0] / best.unit[0] for basis, _ in fits])
    factor = float(np.exp(weights @ logs / weights.sum()))
    return best.scaled(np.full(len(best.unit), factor))


def _gain_in_errors(sound: Choice, other: Choice) -> float:
    """Return by how many standard errors another candidate predicts unseen views better."""
    gain = np.log(sound.fit.unseen_px) - np.log(other.fit.unseen_px)
    return float(np.mean(gain)) / max(float(np.std(gain)) / np.sqrt(len(gain)), 1e-12)


def hidden_errors(
    model: LinearModel, none: Choice, known: ErrorBasis | None, Ts: Array, sigma: float
) -> Array:
    """Return errors (views, 6, q) that the arm may have, per standard deviation."""
    if known is not None:
        return known.columns
    scaled = noise_scale.estimate_scale(model, map_basis(Ts, "base", 1.0, 1e-4), none.ratio, sigma)
    fit = model.fit(scaled, none.ratio, sigma)
    spread = np.asarray(
        np.linalg.inv(fit.information)[model.shared :, model.shared :], dtype=np.float64
    )
    return noise_scale.unknown_arm_columns(scaled, fit.step[model.shared :], spread)


def _covariance(
    model: LinearModel, fit: LinearFit, choice: Choice, columns: Array,
    known: ErrorBasis | None, independent: bool,
) -> Array:  # fmt: skip
    """Return the covariance of all parameters of a fit."""
    covariance = _noise(fit, np.eye(len(fit.step)), independent)
    if known is not None and choice.basis is known:
        return covariance  # the arm's errors are parameters of the fit
    return with_arm(covariance, model.influence(fit, choice.ratio, columns))


def _offsets(best: Choice, state: JointState, covariance: Array) -> Array | None:
    """Return the joint zero offsets and their 1-sigma (n, 2) [rad] of an arm's fit."""
    if best.basis is None or best.basis.kind != "arm":
        return None
    joints = len(best.basis.unit) // 4
    unit = best.basis.unit[:joints]
    sd = np.sqrt(np.diag(covariance)[SHARED : SHARED + joints])
    return np.stack([state.weights[:joints] * unit, sd * unit], -1)


def _views(
    problem: JointProblem, state: JointState, basis: ErrorBasis | None, fit: LinearFit
) -> tuple[SolvedView, ...]:
    """Return the part of every view that took part.

    The board as a view alone sees it is held against where the fit without the view expects it.
    """
    views, away = problem.setup.views, fit.away
    smooth = smooth_errors(basis, state.weights, len(views))
    residuals = np.split(problem.residuals(state, smooth), problem.starts[1:-1])
    without = state.moved(away)
    if basis is not None:
        smooth = smooth + (basis.columns @ away[:, SHARED:, None])[..., 0]
    expected = problem.poses(without, smooth)
    seen = np.empty_like(expected)
    for n, view in enumerate(views):
        points = shaped_points(
            without.board[n], view.xy, problem.setup.middle, problem.setup.half_extent
        )
        seen[n] = refine_board_pose(expected[n], points, view.uv, without.camera[n])[0]
    middle = problem.setup.middle[None]
    apart = (se3.transform(seen, middle) - se3.transform(expected, middle))[:, 0]
    mm = 1e3 * np.linalg.norm(apart, axis=-1)
    deg = np.degrees(se3.angle(se3.invert(expected) @ seen))
    return tuple(
        SolvedView(
            residuals=r,
            seen_px=float(np.sqrt(np.mean(np.sum(r**2, -1)))),
            unseen_px=float(fit.unseen_px[n]),
            unseen_mm=float(mm[n]),
            unseen_deg=float(deg[n]),
            robot_error=state.errors[n],
        )
        for n, r in enumerate(residuals)
    )


# --- how far the camera's place may be off -------------------------------------------------------
#
# Three things move it. (1) Noise: corners and the robot's repeatability, H^-1 of the fit, which
# also holds the ridge of the robot's map. (2) Corner errors that are common to a view: then views,
# not corners, are the independent observations, and the fits without one view each (jackknife, CR3)
#
#     J = sum (theta_-i - theta)(theta_-i - theta)^T + H^-1 Lambda H^-1
#
# say more than H^-1; from few views J itself is noisy and is averaged with H^-1 scaled to its size.
# So noisy are they that the place for this arm could come out less sure than the absolute one, of
# which it is a part: the absolute covariance is at least the other.
# (3) Smooth errors of the arm that the fit does not model: an error that is the same in all tool
# poses looks exactly like another place of the camera. They are considered (Schmidt): errors
# e_i = B_i w, w ~ N(0, I), move the estimate by M w, M = d theta / d w, and add M M^T. B is the
# arm's own basis where joints are known, its scales estimated from the views; else a generic one.


def here_covariance(model: LinearModel, choice: Choice, *, independent: bool) -> Array:
    """Return the covariance (6, 6) of X for this arm as it moves here (`effective`)."""
    return _noise(choice.fit, projection(model, choice.basis)[X], independent)


def at_least(covariance: Array, least: Array) -> Array:
    """Return a covariance (n, n) whose first six rows are nowhere surer than another (6, 6).

    What is missing is added along the directions in which the other is larger.
    """
    root = np.linalg.cholesky(covariance[X, X])
    ratio, axes = np.linalg.eigh(np.linalg.solve(root, np.linalg.solve(root, least).T))
    missing = root @ axes * np.sqrt(np.maximum(ratio - 1.0, 0.0))
    lifted = covariance.copy()
    lifted[X, X] += missing @ missing.T
    return lifted


def _noise(fit: LinearFit, P: Array, independent: bool) -> Array:
    """Return the covariance (q, q) of P theta from noise; X or its like comes first."""
    marginal: Array = np.asarray(np.linalg.inv(fit.information), dtype=np.float64)
    plain = P @ marginal @ P.T
    if independent:
        return plain
    data = np.einsum("nrc,nrd->cd", fit.view_rows, fit.view_rows)
    prior = fit.information - data
    jackknife = fit.swings.T @ fit.swings
    full = P @ (jackknife + marginal @ prior @ marginal) @ P.T
    kappa = float(np.trace(np.linalg.solve(plain[X, X], full[X, X])) / 6)
    covariance = (full + max(kappa, 1.0) * plain) / 2
    return (covariance + covariance.T) / 2


def with_arm(covariance: Array, influence: Array) -> Array:
    """Return the covariance (29 + p, ...) with unmodelled errors of the arm considered.

    Args:
        covariance: from noise.
        influence: (29 + p, q) d theta / d w of errors with unit variance.
    """
    return covariance + influence @ influence.T
