"""The similarity between a reconstruction and the robot, from camera centres and orientations.

p_robot = s R p_sfm + t. Each registered view gives six equations,

    e_i = log( (P_i exp(xi))^-1 S(T_i) ),    S(T) = [R R_T, s R c_T + t],

with P_i the robot's camera pose, T_i the reconstructed one, and xi the constant error of the
hand-eye, which has a prior and is solved for together with the similarity. So the sigma of the
scale holds what a hand-eye error does to it: nothing sideways; along the optical axis error / r,
where all views look at one point from the same distance r, and less where the distances differ.

A start comes from pairs of views (their centres give s, one orientation gives R); the best one is
refined by re-weighted Gauss-Newton with Cauchy's loss. The jackknife over the views is the check
of the formal sigma: it asks the data, not the noise model.

Covariances of reconstructed cameras, and which of them disagree with the robot by more.

A free reconstruction may be moved, turned and scaled as a whole; its cameras' covariance is that
of what is left after a similarity to the robot ("inner constraints", Triggs et al., section 9).
"""

from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np

from realsim.arrays import Array
from realsim.errors import DegenerateError, InputError
from realsim.geometry import se3
from realsim.geometry.robust import MAD_TO_SIGMA
from realsim.scanning.sfm.bundle import Bundle, hand_eye_sigmas, picture_information, prior_sigmas
from realsim.scanning.sfm.config import AlignmentConfig, MappingConfig, RobotNoise
from realsim.scanning.sfm.result import Alignment, Geometry, ViewResidual

LEAST_REDUNDANCY = 0.05
"""Share of a prior's variance that a test of it is left with, at least: where the pictures know
nothing of a camera, its residual is zero and so is its variance."""
MIDDLE_CHI2 = 5.348
"""Median of chi^2 with six degrees of freedom."""


def view_residuals(
    names: tuple[str, ...], errors: Array, total: Array, weights: Array, config: AlignmentConfig
) -> tuple[ViewResidual, ...]:
    """Return every view's distance from the robot, tested against its covariance.

    Args:
        names: of the views.
        errors: (V, 6) of each camera against the robot's [rad, m].
        total: (V, 6, 6) their covariances; raised together until the median view fits.
        weights: (V,) with which the views count.
        config: probability of a false alarm.
    """
    from scipy.stats import chi2

    squares = np.einsum("vi,vi->v", errors, np.linalg.solve(total, errors[..., None])[..., 0])
    squares = squares / max(1.0, float(np.median(squares)) / MIDDLE_CHI2)
    limit = float(chi2.isf(config.outlier_probability / len(names), 6))
    mm = 1e3 * np.linalg.norm(errors[:, 3:], axis=1)
    deg = np.degrees(np.linalg.norm(errors[:, :3], axis=1))
    return tuple(
        ViewResidual(
            name=n, offset_mm=float(a), turn_deg=float(b), weight=float(w), chi2=float(q),
            outlier=bool(q > limit),
        )
        for n, a, b, w, q in zip(names, mm, deg, weights, squares, strict=True)
    )  # fmt: skip


def tested_freely(
    alignment: Alignment, found: Geometry, robot: dict[str, Array], config: AlignmentConfig,
    mapping: MappingConfig,
) -> tuple[Alignment, Array]:  # fmt: skip
    """Return the alignment with its views tested, and the cameras' covariances (V, 6, 6).

    Args:
        alignment: of a free reconstruction.
        found: the reconstruction in metres and in the robot's world.
        robot: camera poses by name, of those that have one.
        config: noise of the robot, probability.
        mapping: loss of the observations.
    """
    own = free_covariance(found, config.noise, mapping)
    place = {n: k for k, n in enumerate(found.names)}
    rows = [place[v.name] for v in alignment.views]
    prior = np.diag(prior_sigmas(config.noise) ** 2)
    hand = np.stack([robot[v.name] for v in alignment.views]) @ se3.exp(alignment.hand_eye_twist)
    errors = se3.log(se3.invert(hand) @ found.Ts_world_cam[rows])
    return _replaced(alignment, errors, own[rows] + prior, config), own


def tested_refined(
    alignment: Alignment, bundle: Bundle, priors: Array, config: AlignmentConfig
) -> Alignment:
    """Return the alignment with the views of a refinement tested.

    A residual of a prior has the covariance Sigma - C of the prior's less the result's (Baarda).

    Args:
        alignment: of the refined cameras to the robot's, in the order of the bundle's views.
        bundle: the refinement.
        priors: (V, 4, 4) the robot's camera poses.
        config: noise of the robot, probability.
    """
    sigmas = bundle.prior_factor * prior_sigmas(config.noise)
    hand = priors @ se3.exp(bundle.hand_eye_twist)
    errors = se3.log(se3.invert(hand) @ bundle.geometry.Ts_world_cam)
    relative = _relative_covariances(bundle) / sigmas / sigmas[:, None]
    values, vectors = np.linalg.eigh(np.eye(6) - relative)
    left = np.einsum("vij,vj,vkj->vik", vectors, np.maximum(values, LEAST_REDUNDANCY), vectors)
    return _replaced(alignment, errors, left * sigmas * sigmas[:, None], config)


def free_covariance(geometry: Geometry, noise: RobotNoise, config: MappingConfig) -> Array:
    """Return each camera's covariance (V, 6, 6) about the best similarity [rad, m].

    Args:
        geometry: metric.
        noise: gives the ratio of metres to radians.
        config: loss of the observations.
    """
    views = len(geometry.names)
    unit = np.tile(prior_sigmas(noise), views)
    G = np.linalg.qr(_gauge(geometry) / unit[:, None])[0]
    information = picture_information(geometry, config) * unit * unit[:, None]
    within = information + float(np.trace(information)) / len(unit) * (G @ G.T)
    values, vectors = np.linalg.eigh(within)
    # A camera that no point holds has no information at all: a metre, not infinity.
    values = np.maximum(values, float(unit[3:6].min()) ** 2)
    left = np.eye(len(unit)) - G @ G.T
    C = left @ (vectors / values) @ vectors.T @ left * unit * unit[:, None]
    blocks = C.reshape(views, 6, views, 6)
    return np.stack([blocks[k, :, k] for k in range(views)])


def _gauge(geometry: Geometry) -> Array:
    """Return the right perturbations (6 V, 7) that a turn, a shift and a growth amount to."""
    T = geometry.Ts_world_cam
    Rt = np.swapaxes(T[:, :3, :3], 1, 2)
    away = T[:, :3, 3] - T[:, :3, 3].mean(0)
    J = np.zeros((len(T), 6, 7))
    J[:, :3, :3] = Rt
    J[:, 3:, :3] = -Rt @ se3.hat(away)
    J[:, 3:, 3:6] = Rt
    J[:, 3:, 6] = np.einsum("vij,vj->vi", Rt, away)
    return J.reshape(-1, 7)


def _relative_covariances(bundle: Bundle) -> Array:
    """Return the covariances (V, 6, 6) of the cameras less the hand-eye that they share."""
    C, n = bundle.covariance, len(bundle.covariance) - 6
    shared = C[n:, n:]
    rows: list[Array] = []
    for k in range(0, n, 6):
        cross = C[k : k + 6, n:]
        rows.append(C[k : k + 6, k : k + 6] + shared - cross - cross.T)
    return np.stack(rows)


def _replaced(
    alignment: Alignment, errors: Array, total: Array, config: AlignmentConfig
) -> Alignment:
    names = tuple(v.name for v in alignment.views)
    weights = np.array([v.weight for v in alignment.views])
    return replace(alignment, views=view_residuals(names, errors, total, weights, config))


STEPS = 30
"""Gauss-Newton steps at most; four are usual."""
CONVERGED = 1e-7
"""Length of the last step [rad, m, log scale]."""
JACKKNIFE_STEPS = 4
"""Steps from the solution of all views to that without one."""
CAUCHY = 3.0
"""Sigmas at which a view has half of its weight."""
DIFFERENCE = 1e-6
"""Step of the numeric derivatives [rad, m, log scale]."""
TRUNCATE = 6.0
"""A view's square in the score of a start is cut at this many sigmas."""
SFM_MM, SFM_DEG = 1.0, 0.2
"""Errors that a reconstructed camera is allowed in the score of the starts [mm, deg]."""


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class _Problem:
    """Both sets of cameras and the sigmas of their differences."""

    found: Array
    """(V, 4, 4) reconstructed, centres about their mean."""
    robot: Array
    """(V, 4, 4) [m]."""
    sigmas: Array
    """(6,) [rad, m]"""
    hand_eye: Array
    """(6,) [rad, m]"""


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class _State:
    """A similarity about the mean of the reconstructed centres, and the hand-eye's correction.

    Several states are one whose every field has the same axes in front.
    """

    log_scale: Array
    R: Array
    t: Array
    twist: Array

    def moved(self, step: Array) -> "_State":
        """Return the state after a step (..., 13) [w, t, log s, xi]."""
        return _State(
            log_scale=self.log_scale + step[..., 6], R=se3.exp_so3(step[..., :3]) @ self.R,
            t=self.t + step[..., 3:6], twist=self.twist + step[..., 7:],
        )  # fmt: skip


def align_to_robot(
    names: tuple[str, ...],
    found: Array,
    robot: Array,
    config: AlignmentConfig,
    rng: np.random.Generator,
) -> Alignment:
    """Return the similarity from the reconstruction to the robot's camera poses.

    Args:
        names: of the views.
        found: (V, 4, 4) reconstructed cameras, in any unit.
        robot: (V, 4, 4) the same cameras by the robot [m].
        config: noise, thresholds.
        rng: picks the pairs of views for the start where there are many.

    Raises:
        InputError: the lists differ in length.
        DegenerateError: fewer than 3 views, or no motion on either side.
    """
    if not len(names) == len(found) == len(robot):
        raise InputError(
            f"{len(names)} names, {len(found)} reconstructed and {len(robot)} robot poses: one of "
            "each per view is expected."
        )
    _require_motion(found, robot, config)
    mean = found[:, :3, 3].mean(0)
    centred = found.copy()
    centred[:, :3, 3] -= mean
    problem = _Problem(
        found=centred, robot=robot, sigmas=prior_sigmas(config.noise),
        hand_eye=hand_eye_sigmas(config.noise),
    )  # fmt: skip
    state, weights = _refined(problem, _robust_start(problem, config, rng))
    scale = float(np.exp(state.log_scale))
    covariance, formal, noise_only = _covariance(problem, state, weights)
    knife = _jackknife(problem, state)
    hand_eye = float(np.sqrt(max(formal**2 - noise_only**2, 0.0)))
    arm = config.noise.arm_scale_percent / 100
    sigma = float(np.sqrt(max(noise_only, knife) ** 2 + hand_eye**2 + arm**2))
    return Alignment(
        scale=scale,
        sigma=scale * sigma,
        R=state.R,
        t=state.t - scale * state.R @ mean,
        hand_eye_twist=state.twist,
        covariance=covariance[:7, :7],
        views=_residuals(names, problem, state, weights, config),
        parts_percent={
            "noise": 100 * noise_only, "jackknife": 100 * knife, "hand_eye": 100 * hand_eye,
            "arm": 100 * arm,
        },
    )  # fmt: skip


def baseline_m(Ts_world_cam: Array) -> Array:
    """Return the spreads (3,) of the camera centres along their principal axes, greatest first."""
    centres = Ts_world_cam[:, :3, 3] - Ts_world_cam[:, :3, 3].mean(0)
    return np.linalg.svd(centres, compute_uv=False)[:3] / np.sqrt(len(centres))


def _require_motion(found: Array, robot: Array, config: AlignmentConfig) -> None:
    """Raise if there are too few views, or if either side stands still."""
    if len(found) < config.min_views:
        raise DegenerateError(
            f"{len(found)} registered view(s) have a robot pose; {config.min_views} are the least "
            "for a metric scale. Take more views, nearer to one another (15 degrees)."
        )
    moved = float(baseline_m(robot)[0])
    if moved < 2 * config.noise.position_mm / 1e3:
        raise DegenerateError(
            f"the robot's camera centres lie within {1e3 * moved:.2f} mm of one another: the "
            "camera turned on the spot, or one pose was written for all views. A scale needs "
            "views from different places, a tenth of the distance to the object apart or more."
        )
    if not float(baseline_m(found)[0]) > 0:
        raise DegenerateError(
            "the reconstructed cameras all stand at one point: there is no scale."
        )


def _predicted(problem: _Problem, state: _State) -> Array:
    """Return S(T_i) (..., V, 4, 4)."""
    scale = np.exp(state.log_scale)[..., None, None]
    R = state.R[..., None, :, :] @ problem.found[:, :3, :3]
    centres = scale * problem.found[:, :3, 3] @ np.swapaxes(state.R, -1, -2)
    return se3.from_rt(R, centres + state.t[..., None, :])


def _errors(problem: _Problem, state: _State) -> Array:
    """Return e_i (..., V, 6) [rad, m]."""
    hand = problem.robot @ se3.exp(state.twist)[..., None, :, :]
    return se3.log(se3.invert(hand) @ _predicted(problem, state))


def _jacobian(problem: _Problem, state: _State) -> Array:
    """Return d e / d [w, t, log s, xi] (V, 6, 13) by central differences."""
    steps = DIFFERENCE * np.eye(13)
    there, back = (_errors(problem, state.moved(s)) for s in (steps, -steps))
    return np.moveaxis(there - back, 0, -1) / (2 * DIFFERENCE)


def _robust_start(problem: _Problem, config: AlignmentConfig, rng: np.random.Generator) -> _State:
    """Return the similarity of the pair of views that most others agree with."""
    count = len(problem.found)
    pairs = list(combinations(range(count), 2))
    if len(pairs) > config.samples:
        chosen = np.sort(rng.choice(len(pairs), config.samples, replace=False))
        pairs = [pairs[k] for k in chosen]
    allowed = problem.sigmas + np.repeat([np.radians(SFM_DEG), SFM_MM / 1e3], 3)
    c, p = problem.found[:, :3, 3], problem.robot[:, :3, 3]
    best, best_cost = None, np.inf
    for i, j in pairs:
        length = float(np.linalg.norm(c[i] - c[j]))
        metric = float(np.linalg.norm(p[i] - p[j]))
        if length < 1e-9 or metric < 1e-6:
            continue
        scale = metric / length
        turns = problem.robot[[i, j], :3, :3] @ np.swapaxes(problem.found[[i, j], :3, :3], 1, 2)
        R = se3.mean_rotation(turns)
        t = p[[i, j]].mean(0) - scale * R @ c[[i, j]].mean(0)
        state = _State(log_scale=np.asarray(np.log(scale)), R=R, t=t, twist=np.zeros(6))
        squares = np.square(_errors(problem, state) / allowed).mean(-1)
        cost = float(np.minimum(squares, TRUNCATE**2).sum())
        if cost < best_cost:
            best, best_cost = state, cost
    if best is None:
        raise DegenerateError(
            "no two views stand at different places on both sides: there is no scale."
        )
    return best


def _spread(problem: _Problem, errors: Array) -> Array:
    """Return sigmas (6,): the robot's, raised to the robust spread of the views [rad, m]."""
    # 13 unknowns are fitted to 6 V numbers: what is left is that much too small.
    few = np.sqrt(len(errors) * 6 / max(len(errors) * 6 - 13, 1))
    robust = [MAD_TO_SIGMA * few * np.median(np.abs(errors[:, h])) for h in _HALVES]
    return np.maximum(problem.sigmas, np.repeat(robust, 3))


_HALVES = (slice(0, 3), slice(3, 6))


def _weights(errors: Array, sigmas: Array) -> Array:
    """Return Cauchy's weight of each view (V,)."""
    return 1 / (1 + np.square(errors / sigmas).mean(-1) / CAUCHY**2)


def _normal(problem: _Problem, state: _State, sigmas: Array, weights: Array) -> tuple[Array, Array]:
    """Return the information (13, 13) and the gradient (13,)."""
    J = _jacobian(problem, state) / sigmas[:, None]
    e = _errors(problem, state) / sigmas
    H = np.einsum("v,vai,vaj->ij", weights, J, J)
    g = np.einsum("v,vai,va->i", weights, J, e)
    H[7:, 7:] += np.diag(1 / problem.hand_eye**2)
    g[7:] += state.twist / problem.hand_eye**2
    return H, g


def _refined(problem: _Problem, state: _State, steps: int = STEPS) -> tuple[_State, Array]:
    """Return the re-weighted least squares solution and the views' weights."""
    weights = np.ones(len(problem.found))
    for _ in range(steps):
        errors = _errors(problem, state)
        sigmas = _spread(problem, errors)
        weights = _weights(errors, sigmas)
        H, g = _normal(problem, state, sigmas, weights)
        step = -np.linalg.lstsq(H, g, rcond=None)[0].astype(np.float64)
        state = state.moved(step)
        if float(np.abs(step).max()) < CONVERGED:
            break
    return state, weights


def _covariance(problem: _Problem, state: _State, weights: Array) -> tuple[Array, float, float]:
    """Return the covariance (13, 13), the sigma of log s, and that with the hand-eye known."""
    H, _ = _normal(problem, state, _spread(problem, _errors(problem, state)), weights)
    full: Array = np.linalg.pinv(H, hermitian=True).astype(np.float64)
    known = np.linalg.pinv(H[:7, :7], hermitian=True)
    return full, float(np.sqrt(full[6, 6])), float(np.sqrt(known[6, 6]))


def _jackknife(problem: _Problem, state: _State) -> float:
    """Return the jackknife's sigma of log s over the views; NaN-free: 0 with the fewest views."""
    count = len(problem.found)
    if count < 4:
        return 0.0
    values = np.empty(count)
    for k in range(count):
        rest = np.arange(count) != k
        part = _Problem(
            found=problem.found[rest], robot=problem.robot[rest], sigmas=problem.sigmas,
            hand_eye=problem.hand_eye,
        )  # fmt: skip
        values[k] = _refined(part, state, JACKKNIFE_STEPS)[0].log_scale
    return float(np.sqrt((count - 1) / count * np.square(values - values.mean()).sum()))


def _residuals(
    names: tuple[str, ...],
    problem: _Problem,
    state: _State,
    weights: Array,
    config: AlignmentConfig,
) -> tuple[ViewResidual, ...]:
    """Return every view's distance from the robot, those far from the others marked."""
    errors = _errors(problem, state)
    total = np.tile(np.diag(_spread(problem, errors) ** 2), (len(names), 1, 1))
    return view_residuals(names, errors, total, weights, config)
