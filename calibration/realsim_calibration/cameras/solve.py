"""From a start to the calibration of a rig: the steps of `fit.robust_fit` for several cameras.

1. joint fit without robot errors, then with them at lambda = 0.3; every camera's own sigma and
   corner weights
2. candidates for the robot's smooth error, judged by predicting every instant without it
3. joint fit with the chosen one, lambda re-estimated; covariance of all cameras from noise and from
   what the arm may still hide, which moves all of them at once
"""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from realsim.arrays import Array
from realsim.geometry import se3
from realsim.geometry.dh import DhArm
from realsim.records import ArmErrorMap, RobotErrorMap
from realsim_calibration.cameras.problem import RigModel, RigProblem, RigState
from realsim_calibration.fit import joint_solve, noise_scale
from realsim_calibration.fit.linear_model import LinearFit
from realsim_calibration.fit.robot_error import ErrorBasis, arm_basis, map_record
from realsim_calibration.fit.robust_fit import (
    Choice,
    chosen_of,
    hidden_errors,
    map_choices,
    with_arm,
)
from realsim_calibration.fit.view_system import camera_record, refine_board_pose
from realsim_calibration.screening import HandEyeConfig

SAG_RAD = 5e-4
"""How far the most loaded joint gives way under the arm's own weight, 1-sigma [rad]: 10 to 20 N m
over some 2e4 N m/rad, the stiffness of gears of this size."""
DOUBT_RATIO = 8.0
"""An arm pose that is so many times further off than the median one is wrong: of noise in six
coordinates the largest of a million is 3.1 times the median."""
BASE_FACTOR = 2.0
"""Constant error in the axes of the base over the one in the tool's: an arm near one posture sags,
and is off by its first joints' zeros, alike in all poses. Chosen on simulated labs."""
LEAST_SHARE = 0.25
"""A Gauss-Newton step that is still no gain when cut to this share is none: the fit has ended."""


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class RigSolution:
    """The calibration of a rig."""

    problem: RigProblem
    state: RigState
    sigmas: Array
    """(C,) 1-sigma of a corner's coordinate of every camera [px]."""
    ratio: Array
    fit: LinearFit
    model: RigModel
    covariance: Array
    """(S, S) of all shared unknowns."""
    information: Array
    """(S, S), the robot's map held."""
    here: Array
    """(S, S) covariance without what the arm hides: for this arm as it moves here."""
    alone: RigState
    """The fit without a map of the robot's error."""
    alone_covariance: Array
    basis: ErrorBasis | None
    robot_map: RobotErrorMap | ArmErrorMap | None
    scores: tuple[tuple[str, float], ...]
    joint_offsets: Array | None


def solve_rig(
    problem: RigProblem, start: RigState, config: HandEyeConfig, arm: DhArm | None,
    joints: Array | None,
) -> RigSolution:  # fmt: skip
    """Return the calibration from a start.

    Args:
        problem: the rig.
        start: where the fit begins.
        config: priors, noise, maps.
        arm: the arm's kinematics.
        joints: (I, n) joint angles [rad] of all instants; None where some have none.

    Raises:
        DegenerateError: the views do not determine the parameters.
    """
    bound = np.full(2, noise_scale.BOUND)
    sigmas = np.full(len(problem.rig.cameras), config.joint.start_sigma_px)
    state = optimize(problem, start, None, np.zeros(2), sigmas, problem.ones(), config)
    sigmas, roots = spread(problem, state, sigmas, config)
    for _ in range(config.joint.rounds):
        state = optimize(problem, state, None, bound, sigmas, roots, config)
        sigmas, roots = spread(problem, state, sigmas, config)
    model = RigModel(problem, state, sigmas, roots)
    whites = _whiteness(problem, state)
    most = min(noise_scale.largest_ratio(w) for w in whites)
    ratio = noise_scale.estimate_ratio(model, None, 1.0, most)
    none = Choice(basis=None, ratio=ratio, fit=model.fit(None, ratio, 1.0))
    choices, known = [none], None
    Ts = state.A
    if config.robot_map and problem.arm_used:
        choices += map_choices(model, Ts, 1.0, np.minimum(ratio, noise_scale.BOUND))
        if arm is not None and joints is not None:
            basis = arm_basis(arm, joints, Ts)
            arm_ratio, known = noise_scale.estimate_arm(model, basis, 1.0, None)
            fit = model.fit(known, arm_ratio, 1.0)
            choices.append(Choice(basis=known, ratio=arm_ratio, fit=fit))
    best = chosen_of(choices)
    ratio = best.ratio
    if best.basis is not None and best.basis.kind != "arm":
        ratio = noise_scale.estimate_ratio(model, best.basis, 1.0, most)
    alone = model.moved(none.fit.step, None, none.ratio)
    state = model.moved(best.fit.step, best.basis, ratio)
    state = optimize(problem, state, best.basis, ratio, sigmas, roots, config)
    sigmas, roots = spread(problem, state, sigmas, config)
    model = RigModel(problem, state, sigmas, roots)
    # sigma was estimated camera by camera: 1 is what remains.
    final = model.fit(best.basis, ratio, 1.0, rounds=0)
    none_fit = model.fit(None, none.ratio, none.fit.sigma_px, rounds=0)
    columns = None
    if problem.arm_used:
        columns = _hidden(model, none, known, Ts, config, arm, joints)
    covariance = _covariance(problem, model, final, best, ratio, columns, known)
    alone_covariance = _covariance(problem, model, none_fit, none, none.ratio, columns, known)
    S = problem.size
    return RigSolution(
        problem=problem, state=state, sigmas=sigmas, ratio=ratio, fit=final, model=model,
        covariance=covariance[:S, :S], here=_noise_covariance(problem, final)[:S, :S],
        information=final.information[:S, :S], alone=alone,
        alone_covariance=alone_covariance[:S, :S], basis=best.basis,
        robot_map=None if best.basis is None else map_record(best.basis, state.weights, Ts, arm),
        scores=tuple((c.name, c.fit.score) for c in choices),
        joint_offsets=_offsets(best.basis, state, covariance, S),
    )  # fmt: skip


def optimize(
    problem: RigProblem, state: RigState, basis: ErrorBasis | None, ratio: Array, sigmas: Array,
    roots: Sequence[Array], config: HandEyeConfig,
) -> RigState:  # fmt: skip
    """Return the least-squares state for fixed sigmas, lambda (2,) and corner weights.

    Raises:
        DegenerateError: the views do not determine the parameters.
    """
    model = RigModel(problem, state, sigmas, roots)
    cost, share = model.cost(basis, ratio), 1.0
    for _ in range(config.joint.max_iterations):
        trial = model.step(basis, ratio, share)
        moved = RigModel(problem, trial, sigmas, roots)
        new = moved.cost(basis, ratio)
        if not new < cost:
            share /= 2
            if share < LEAST_SHARE:
                break
            continue
        gain = (cost - new) / max(cost, 1e-12)
        model, cost, share = moved, new, 1.0
        if gain < config.joint.step_tolerance:
            break
    return model.rig_state


def spread(
    problem: RigProblem, state: RigState, sigmas: Array, config: HandEyeConfig
) -> tuple[Array, list[Array]]:
    """Return every camera's sigma (C,) [px] and the roots of the Huber weights of all views.

    An instant's own poses are fitted to its views alone: they take their share of the coordinates.
    """
    total, count = np.zeros(len(sigmas)), np.zeros(len(sigmas))
    roots: list[Array] = []
    shared = [len(c) for c in problem.camera_columns]
    count -= shared
    for k, r in enumerate(problem.residuals(state)):
        view = problem.views[k]
        c = view.camera
        away = np.linalg.norm(r, axis=-1)
        limit = config.joint.huber_sigmas * sigmas[c]
        w = np.minimum(1.0, limit / np.maximum(away, 1e-12))
        own = 6 * len(problem.loose_of(view.instant)) + 6 * (view.moved and state.errors.any())
        total[c] += float(np.sum(w * away**2))
        count[c] += 2 * len(r) - own / len(problem.at[view.instant])
        roots.append(np.sqrt(w))
    return np.sqrt(np.maximum(total, 1e-12) / np.maximum(count, 1.0)), roots


def _whiteness(problem: RigProblem, state: RigState) -> list[noise_scale.Whiteness]:
    """Return whether corners are independent inside the views of every camera and board.

    A free pose a view is fitted, so that only lens and board matter: its pose stands for the arm's.
    """
    Ts = problem.poses(state)
    groups: dict[tuple[int, int], list[int]] = {}
    for k, view in enumerate(problem.views):
        groups.setdefault((view.camera, view.board), []).append(k)
    found: list[noise_scale.Whiteness] = []
    for (c, b), ks in sorted(groups.items()):
        size = ks[0]
        image = problem.rig.sightings[size].detection.image_size
        corners = tuple(
            joint_solve.ViewCorners(index=k, T_base_ee=np.ascontiguousarray(Ts[k]),
                        xy=problem.views[k].xy, uv=problem.views[k].uv)
            for k in ks
        )  # fmt: skip
        one = joint_solve.JointProblem(
            joint_solve.Setup(views=corners, to_hand=True, middle=problem.middles[b],
                  half_extent=problem.halves[b],
                  intrinsics0=camera_record(state.lens[c], image)),
            problem.joints[c],
        )  # fmt: skip
        at = joint_solve.JointState(
            X=np.eye(4), Z=np.eye(4), camera=state.lens[c], board=state.shape[b],
            weights=np.zeros(0), errors=np.zeros((len(ks), 6)),
        )  # fmt: skip
        white = noise_scale.whiteness(one, at)
        if np.isfinite(white.ratio):
            found.append(white)
    return found or [noise_scale.Whiteness(ratio=float("nan"), sd=float("nan"))]


def _hidden(
    model: RigModel, none: Choice, known: ErrorBasis | None, Ts: Array, config: HandEyeConfig,
    arm: DhArm | None, joints: Array | None,
) -> Array:  # fmt: skip
    """Return errors (I, 6, q) that the arm may have, per standard deviation.

    Beside those of one camera, where no joints are known: an error that is the same in all poses
    in the axes of the base (about the middle of the hand's places), larger than the one in the
    axes of the tool. It looks like other places of all fixed cameras, and of the table, at once.
    """
    if known is not None and arm is not None and joints is not None:
        return np.concatenate([known.columns, sag_columns(arm, joints, known)], -1)
    columns = hidden_errors(model, none, known, Ts, 1.0)
    middle = se3.from_translation(Ts[:, :3, 3].mean(0))
    base = np.stack([se3.adjoint(se3.invert(T) @ middle) for T in Ts]) @ columns[0, :, :6]
    base = base * BASE_FACTOR
    return np.concatenate([columns, base], -1)


def sag_columns(arm: DhArm, joints: Array, basis: ErrorBasis) -> Array:
    """Return errors (I, 6, n) of joints that give way under the arm's weight, per 1-sigma.

    A joint turns in proportion to the torque about it, by `SAG_RAD` where the torque is as large
    as that of the joint that bears most (RMS); links weigh alike, each at its frame. No error of
    the Denavit-Hartenberg numbers looks like it, so it is considered, not estimated.
    """
    frames = arm.link_frames(joints)
    axes, at = frames[:, :-1, :3, 2], frames[:, :-1, :3, 3]
    down = np.array([0.0, 0.0, -1.0])
    torque = np.zeros(axes.shape[:2])
    for j in range(arm.joints):
        lever = (frames[:, j + 1 :, :3, 3] - at[:, j, None]).sum(1)
        torque[:, j] = np.sum(axes[:, j] * np.cross(lever, down), -1)
    most = float(np.sqrt(np.mean(torque**2, 0)).max())
    G = np.eye(4) if basis.T_flange_tool is None else basis.T_flange_tool
    turned = se3.adjoint(se3.invert(G)) @ arm.jacobian(joints)
    return turned * (SAG_RAD * torque / max(most, 1e-9))[:, None, :]


def _noise_covariance(problem: RigProblem, fit: LinearFit) -> Array:
    """Return the covariance of all parameters from what the instants say apart from each other.

    The mean of the jackknife over instants and of H^-1 scaled to its size, as in `fit.robust_fit`;
    here also where corners are independent, for what an arm does beyond its basis is not.
    """
    marginal = np.asarray(np.linalg.inv(fit.information), dtype=np.float64)
    n = len(fit.away)
    data = np.einsum("nrc,nrd->cd", fit.view_rows, fit.view_rows, optimize=True)
    prior = fit.information - data
    jackknife = (n - 1) / n * fit.away.T @ fit.away + marginal @ prior @ marginal
    places = np.concatenate([c[:6] for c in problem.camera_columns if problem.free[c[0]]])
    at = np.ix_(places, places)
    kappa = float(np.trace(np.linalg.solve(marginal[at], jackknife[at])) / len(places))
    covariance = (jackknife + max(kappa, 1.0) * marginal) / 2
    return np.asarray((covariance + covariance.T) / 2, dtype=np.float64)


def _covariance(
    problem: RigProblem, model: RigModel, fit: LinearFit, choice: Choice, ratio: Array,
    columns: Array | None, known: ErrorBasis | None,
) -> Array:  # fmt: skip
    """Return the covariance of all parameters of a fit, as `fit.robust_fit` puts it together."""
    covariance = _noise_covariance(problem, fit)
    if columns is None:
        return covariance
    if known is not None and choice.basis is known:
        columns = columns[..., known.columns.shape[-1] :]  # the others are parameters of the fit
    return with_arm(covariance, model.influence(fit, ratio, columns))


def _offsets(
    basis: ErrorBasis | None, state: RigState, covariance: Array, shared: int
) -> Array | None:
    """Return the joint zero offsets and their 1-sigma (n, 2) [rad] of an arm's fit."""
    if basis is None or basis.kind != "arm":
        return None
    n = len(basis.unit) // 4
    sd = np.sqrt(np.diag(covariance)[shared : shared + n])
    return np.stack([state.weights[:n] * basis.unit[:n], sd * basis.unit[:n]], -1)


def doubted_instants(solution: RigSolution) -> list[int]:
    """Return the instants whose arm pose is further off than it is elsewhere, beyond any noise.

    Several cameras, or one and the board's shape, place the hand there; the pose is not needed.
    """
    problem, state = solution.problem, solution.state
    smooth = joint_solve.smooth_errors(solution.basis, state.weights, len(problem.at))
    sd = np.repeat(solution.ratio, 3) * solution.model.unit_sd
    off = np.linalg.norm((state.errors - smooth) / np.where(sd > 0, sd, np.inf), axis=-1)
    arm = [
        i for i, views in enumerate(problem.at)
        if problem.known[i] and any(problem.views[k].moved for k in views)
        and not any(problem.views[k].moved and problem.rig.boards[problem.views[k].board].place
                    == "free" for k in views)
    ]  # fmt: skip
    if not arm or not off.any():
        return []
    limit = DOUBT_RATIO * float(np.median(off[arm]))
    return [i for i in arm if off[i] > limit]


def without_arm(state: RigState, instants: Sequence[int]) -> RigState:
    """Return the start of a fit in which the arm's poses at some instants are not believed."""
    A = state.A.copy()
    A[instants] = A[instants] @ se3.exp(state.errors[instants])
    errors = state.errors.copy()
    errors[instants] = 0.0
    return replace(state, A=A, errors=errors, weights=np.zeros(0))


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class UnseenView:
    """One view's part, by default that of one not used; fields of `results.SightingReport`."""

    residuals: Array = field(default_factory=lambda: np.zeros((0, 2)))
    seen_px: float = float("nan")
    unseen_px: float = float("nan")
    unseen_mm: float = float("nan")
    unseen_deg: float = float("nan")
    T_cam_board: Array = field(default_factory=lambda: np.full((4, 4), np.nan))


def unseen_views(solution: RigSolution) -> list[UnseenView]:
    """Return every view's part, seen and as predicted by the fit without its instant.

    Both go through the robot's pose and its map; a board moved by hand is placed by the instant's
    own views, all of them.
    """
    problem, state, basis = solution.problem, solution.state, solution.basis
    smooth = joint_solve.smooth_errors(basis, state.weights, len(problem.at))
    seen = problem.residuals(_settled(problem, state, smooth, solution.sigmas))
    found: dict[int, UnseenView] = {}
    S = problem.size
    for i, views in enumerate(problem.at):
        away = solution.fit.away[i]
        errors = smooth if basis is None else smooth + basis.columns @ away[S:]
        moved = _settled(problem, problem.stepped(state, away), errors, solution.sigmas, only=i)
        unseen = problem.residuals(moved, views)
        for k, r, expected in zip(views, unseen, problem.poses(moved, views), strict=True):
            view = problem.views[k]
            points = joint_solve.shaped_points(
                moved.shape[view.board], view.xy, problem.middles[view.board],
                problem.halves[view.board],
            )  # fmt: skip
            alone, _ = refine_board_pose(expected, points, view.uv, moved.lens[view.camera])
            middle = problem.middles[view.board][None]
            apart = se3.transform(alone, middle) - se3.transform(expected, middle)
            found[k] = UnseenView(
                residuals=seen[k],
                seen_px=_rms(seen[k]),
                unseen_px=_rms(r),
                unseen_mm=1e3 * float(np.linalg.norm(apart)),
                unseen_deg=float(np.degrees(se3.angle(se3.invert(expected) @ alone))),
                T_cam_board=alone,
            )
    return [found[k] for k in range(len(problem.views))]


def _rms(r: Array) -> float:
    return float(np.sqrt(np.mean(np.sum(r**2, -1))))


def _settled(
    problem: RigProblem, state: RigState, errors: Array, sigmas: Array, only: int | None = None
) -> RigState:
    """Return the state with these robot errors, what instants have for themselves fitted anew."""
    state = replace(state, errors=errors)
    wanted = [i for i in range(len(problem.at)) if problem.loose_of(i) and only in {None, i}]
    if not wanted:
        return state
    A, loose = state.A.copy(), dict(state.loose)
    for i in wanted:
        for _ in range(2):
            state = replace(state, A=A, loose=loose)
            blocks = problem.view_blocks(state, sigmas, problem.ones(), problem.at[i])
            F, M = problem.instant_rows(i, blocks)
            moves = -np.linalg.lstsq(F, M[:, -1], rcond=None)[0]
            for (b, _), xi in zip(problem.loose_of(i), moves.reshape(-1, 6), strict=True):
                if b < 0:
                    A[i] = A[i] @ se3.exp(xi)
                else:
                    loose[b, i] = loose[b, i] @ se3.exp(xi)
    return replace(state, A=A, loose=loose)
