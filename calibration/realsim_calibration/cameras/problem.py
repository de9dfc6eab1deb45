"""The joint problem of several cameras: every view's rows, put together instant by instant.

A view gives the 24 rows of `view_system` for its own X, Z, lens and board. All views of an instant
are stacked,

    rows_i = [ F_i | J_i | E_i | r_i ]     F: poses of boards moved by hand (and of an arm whose
                                           pose is not known), J: what all share, E: D_i's error

F has no prior and meets this instant only: an orthogonal turn confines it to its first rows, which
determine it and say nothing else. What is left is a view of the single-camera problem with more
shared unknowns, so that likelihood, maps of the robot's error and fits without one view are those
of `fit.linear_model`.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from realsim.arrays import Array, Int64, Mask
from realsim.errors import DegenerateError
from realsim.geometry import se3
from realsim.records import CameraIntrinsics
from realsim_calibration.cameras.rig import Rig, Sighting
from realsim_calibration.fit.joint_solve import (
    FLAT,
    JointConfig,
    JointProblem,
    Setup,
    ViewCorners,
    smooth_errors,
)
from realsim_calibration.fit.linear_model import LinearModel
from realsim_calibration.fit.robot_error import ErrorBasis
from realsim_calibration.fit.view_system import (
    BOARD_TERMS,
    CAMERA_TERMS,
    SHARED,
    camera_from_board,
    camera_vector,
    view_equations,
    view_rows,
)

CAMERA = 6 + CAMERA_TERMS
"""Unknowns of a camera: X, lens."""
BOARD = 6 + BOARD_TERMS
"""Unknowns of a board: Z, shape."""
HELD_POSE_SD = 1e-6
"""Prior of a pose that is held [rad, m]: the reference of a rig without an arm, a board of no
fixed place."""
STILL = np.eye(4)


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class RigState:
    """Everything that is estimated."""

    X: Array
    """(C, 4, 4) cameras in the tool or in the base [m]."""
    lens: Array
    """(C, 12) fx fy cx cy k1 k2 p1 p2 k3 k4 k5 k6."""
    Z: Array
    """(B, 4, 4) boards in the base or in the tool [m]; of one moved by hand not used."""
    shape: Array
    """(B, 5) scale, aspect, warps."""
    A: Array
    """(I, 4, 4) the controller's poses; estimated where the arm's is not known [m]."""
    loose: dict[tuple[int, int], Array]
    """(board, instant): place (4, 4) in the base of a board moved by hand [m]."""
    weights: Array
    """(p,) of the smooth robot error."""
    errors: Array
    """(I, 6) robot errors log D_i, smooth part included [rad, m]."""


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class _View:
    """A sighting ready for the compiled code."""

    camera: int
    board: int
    instant: int
    xy: Array
    uv: Array
    moved: bool
    """Whether the arm's pose enters."""
    to_hand: bool


class RigProblem:
    """The least-squares problem of a rig."""

    def __init__(
        self,
        rig: Rig,
        lenses: Sequence[CameraIntrinsics],
        joints: Sequence[JointConfig],
        known: Mask,
    ) -> None:
        """Prepare the views.

        Args:
            rig: what was seen; every camera and board at least once.
            lenses: every camera as known before: centre of its priors.
            joints: every camera's priors.
            known: (I,) whether the arm's pose at an instant is to be believed.
        """
        self.rig, self.known, self.joints = rig, known, tuple(joints)
        points = [b.target.points_board for b in rig.boards]
        self.middles = [(p.max(0) + p.min(0)) / 2 for p in points]
        self.halves = [float(np.ptp(p, axis=0).max() / 2) for p in points]
        self.views = [self._view(s) for s in rig.sightings]
        self.starts = np.cumsum([0, *(len(v.uv) for v in self.views)])
        self.at: list[list[int]] = [[] for _ in rig.instants]
        for k, view in enumerate(self.views):
            self.at[view.instant].append(k)
        C, B = len(rig.cameras), len(rig.boards)
        self.size = CAMERA * C + BOARD * B
        self.camera_columns = [np.arange(CAMERA * c, CAMERA * (c + 1)) for c in range(C)]
        self.board_columns = [CAMERA * C + np.arange(BOARD * b, BOARD * (b + 1)) for b in range(B)]
        self.arm_used = any(v.moved and rig.boards[v.board].place != "free" for v in self.views)
        """Whether the arm ties anything to its base; else the first camera is the reference."""
        self._priors(lenses, joints)

    def _view(self, s: Sighting) -> _View:
        points = s.detection.points(self.rig.boards[s.board].target)
        moved = self.rig.moves(s.camera, s.board)
        return _View(
            camera=s.camera, board=s.board, instant=s.instant, moved=moved,
            xy=np.ascontiguousarray((points - self.middles[s.board])[:, :2]),
            uv=np.ascontiguousarray(s.detection.uv),
            to_hand=not moved or self.rig.cameras[s.camera].mount == "fixed",
        )  # fmt: skip

    def _priors(self, lenses: Sequence[CameraIntrinsics], joints: Sequence[JointConfig]) -> None:
        """Note centre, information and determinant of all priors; which unknowns are free."""
        self.center, self.information = np.zeros(self.size), np.zeros((self.size, self.size))
        self.free = np.ones(self.size, dtype=bool)
        self.prior_log_det = 0.0
        seen = [next(v for v in self.views if v.camera == c) for c in range(len(lenses))]
        for c, (lens, config) in enumerate(zip(lenses, joints, strict=True)):
            columns = self.camera_columns[c][6:]
            center, covariance, free = self._single(seen[c], lens, config)
            self._put(columns, center[:CAMERA_TERMS], covariance[:CAMERA_TERMS, :CAMERA_TERMS])
            self.free[columns] = free[:CAMERA_TERMS]
        for b, columns in enumerate(self.board_columns):
            view = next(v for v in self.views if v.board == b)
            center, covariance, free = self._single(view, lenses[view.camera], joints[view.camera])
            self._put(columns[6:], FLAT, covariance[CAMERA_TERMS:, CAMERA_TERMS:])
            self.free[columns[6:]] = free[CAMERA_TERMS:]
            if self.rig.boards[b].place == "free":
                self._hold(columns[:6])
        if not self.arm_used:
            self._hold(self.camera_columns[0][:6])

    def _single(
        self, view: _View, lens: CameraIntrinsics, config: JointConfig
    ) -> tuple[Array, Array, Array]:
        """Return centre, covariance and free terms (17) of the single-camera fit's prior."""
        corners = ViewCorners(index=0, T_base_ee=STILL, xy=view.xy, uv=view.uv)
        one = JointProblem(
            Setup(views=(corners,), to_hand=True, middle=self.middles[view.board],
                  half_extent=self.halves[view.board], intrinsics0=lens),
            config,
        )  # fmt: skip
        return *one.prior(), one.free

    def _put(self, columns: Int64, center: Array, covariance: Array) -> None:
        self.center[columns] = center
        self.information[np.ix_(columns, columns)] = np.linalg.inv(covariance)
        self.prior_log_det += float(np.linalg.slogdet(covariance)[1])

    def _hold(self, columns: Int64) -> None:
        self.free[columns] = False
        self.information[columns, columns] = HELD_POSE_SD**-2

    # --- values at a state ------------------------------------------------------------------

    def place(self, state: RigState, view: _View) -> Array:
        """Return Z (4, 4) of a view's board."""
        loose = state.loose.get((view.board, view.instant))
        return state.Z[view.board] if loose is None else loose

    def _arguments(self, state: RigState, k: int, *more: Any) -> list[Any]:
        view = self.views[k]
        A = state.A[view.instant] if view.moved else STILL
        D = se3.exp(state.errors[view.instant]) if view.moved else STILL
        X, Z = state.X[view.camera], self.place(state, view)
        return [np.ascontiguousarray(X), np.ascontiguousarray(Z), np.ascontiguousarray(A), D,
                view.to_hand, state.lens[view.camera], state.shape[view.board],
                self.halves[view.board], self.middles[view.board], view.xy, view.uv,
                *more]  # fmt: skip

    def poses(self, state: RigState, views: Sequence[int] | None = None) -> Array:
        """Return T_cam_board (views, 4, 4) of views, by default of all."""
        chosen = range(len(self.views)) if views is None else views
        return np.stack([camera_from_board(*self._arguments(state, k)[:5]) for k in chosen])

    def residuals(self, state: RigState, views: Sequence[int] | None = None) -> list[Array]:
        """Return predicted minus measured (n, 2) [px] of views, by default of all."""
        found: list[Array] = []
        for k in range(len(self.views)) if views is None else views:
            ones = np.ones(len(self.views[k].uv))
            rows = view_rows(*self._arguments(state, k, ones))
            found.append(rows[:, -1].reshape(-1, 2))
        return found

    def view_blocks(
        self, state: RigState, sigmas: Array, roots: Sequence[Array], views: Sequence[int]
    ) -> list[Array]:
        """Return the compressed equations (24, 36) of views, over their cameras' sigmas."""
        return [
            view_equations(*self._arguments(state, k, roots[k])) / sigmas[self.views[k].camera]
            for k in views
        ]

    def instant_rows(self, i: int, blocks: Sequence[Array]) -> tuple[Array, Array]:
        """Return F_i (rows, f) and [J_i | E_i | r_i] (rows, S + 7) of an instant's blocks."""
        views, S = self.at[i], self.size
        height = len(blocks[0]) if blocks else 0
        unknowns = self.loose_of(i)
        F = np.zeros((height * len(views), 6 * len(unknowns)))
        M = np.zeros((height * len(views), S + 7))
        for n, k in enumerate(views):
            view, block = self.views[k], blocks[n]
            at = slice(height * n, height * (n + 1))
            camera, board = self.camera_columns[view.camera], self.board_columns[view.board]
            M[at, camera] = block[:, [*range(6), *range(12, 12 + CAMERA_TERMS)]]
            M[at, board[6:]] = block[:, 12 + CAMERA_TERMS : SHARED] * self.free[board[6:]]
            M[at, camera[6:]] *= self.free[camera[6:]]
            M[at, -1] = block[:, -1]
            if (view.board, i) in unknowns:
                f = 6 * unknowns.index((view.board, i))
                F[at, f : f + 6] = block[:, 6:12]
            else:
                M[at, board[:6]] = block[:, 6:12]
            if view.moved and self.known[i]:
                M[at, S : S + 6] = block[:, SHARED : SHARED + 6]
            elif view.moved:
                F[at, :6] = block[:, SHARED : SHARED + 6]
        return F, M

    def loose_of(self, i: int) -> list[tuple[int, int]]:
        """Return the poses that an instant has for itself: (board, i), the arm's as (-1, i)."""
        views = [self.views[k] for k in self.at[i]]
        arm = [(-1, i)] if not self.known[i] and any(v.moved for v in views) else []
        boards = {v.board for v in views if self.rig.boards[v.board].place == "free"}
        return [*arm, *((b, i) for b in sorted(boards))]

    def unit_robot_sd(self, state: RigState, sigmas: Array) -> Array:
        """Return the robot's 1-sigma (6,) for lambda = 1: what turns a view by one sigma."""
        T = self.poses(state)
        moved = [k for k, v in enumerate(self.views) if v.moved] or list(range(len(self.views)))
        turn: list[float] = []
        shift: list[float] = []
        for k in moved:
            view = self.views[k]
            away = float(np.linalg.norm(se3.transform(T[k], self.middles[view.board][None])))
            turn.append(float(sigmas[view.camera] / state.lens[view.camera, :2].mean()))
            shift.append(turn[-1] * away)
        return np.repeat([float(np.median(turn)), float(np.median(shift))], 3)

    def stepped(self, state: RigState, step: Array) -> RigState:
        """Return the state after a step (S, ...) of the shared unknowns."""
        X, Z, lens, shape = (a.copy() for a in (state.X, state.Z, state.lens, state.shape))
        for c, columns in enumerate(self.camera_columns):
            X[c] = X[c] @ se3.exp(step[columns[:6]])
            lens[c] += step[columns[6:]]
        for b, columns in enumerate(self.board_columns):
            Z[b] = Z[b] @ se3.exp(step[columns[:6]])
            shape[b] += step[columns[6:]]
        return replace(state, X=X, Z=Z, lens=lens, shape=shape)

    def vector(self, state: RigState) -> Array:
        """Return the shared unknowns (S,) that have priors; poses are zero."""
        v = np.zeros(self.size)
        for columns, lens in zip(self.camera_columns, state.lens, strict=True):
            v[columns[6:]] = lens
        for columns, shape in zip(self.board_columns, state.shape, strict=True):
            v[columns[6:]] = shape
        return v

    def ones(self) -> list[Array]:
        """Return unit corner weights."""
        return [np.ones(len(v.uv)) for v in self.views]


class RigModel(LinearModel):
    """The views linearised at a state: `LinearModel` whose views are the instants."""

    def __init__(
        self, problem: RigProblem, state: RigState, sigmas: Array, roots: Sequence[Array]
    ) -> None:
        """Linearise.

        Args:
            problem: the rig.
            state: where.
            sigmas: (C,) of a corner's coordinate [px]; lengths of residuals are in these.
            roots: of every view's corner weights.
        """
        self.rig_problem, self.rig_state = problem, state
        S = self.shared = problem.size
        parts = [
            problem.instant_rows(i, problem.view_blocks(state, sigmas, roots, views))
            for i, views in enumerate(problem.at)
        ]
        self.solved_rows: list[tuple[Array, Array]] = []
        """Per instant R (f, f) of F and the turned rows (f, S + 7) that determine F."""
        left: list[Array] = []
        for F, M in parts:
            f = F.shape[1]
            if f:
                Q, R = np.linalg.qr(F, mode="complete")
                M = Q.T @ M  # noqa: PLW2901
                self.solved_rows.append((R[:f], M[:f]))
            else:
                self.solved_rows.append((np.zeros((0, 0)), np.zeros((0, S + 7))))
            left.append(M[f:])
        height = max(6, *(len(M) for M in left))
        rows = np.stack([np.pad(M, ((0, height - len(M)), (0, 0))) for M in left])
        loose = sum(len(R) for R, _ in self.solved_rows)
        self.coordinates = 2 * sum(len(r) for r in roots) - loose
        weights = [sum(float(np.sum(roots[k] ** 2)) for k in views) for views in problem.at]
        self.weight_sums = np.maximum(np.array(weights), 1.0)
        self.J, self.D = rows[:, :, :S], rows[:, :, S : S + 6]
        self.r = rows[:, :, -1] - (self.D @ state.errors[..., None])[..., 0]
        self.unit_sd = problem.unit_robot_sd(state, sigmas)
        self._turn()
        self.prior, self.prior_log_det = problem.information, problem.prior_log_det
        self.offset = np.where(self.prior.any(0), problem.vector(state) - problem.center, 0.0)
        self.freedom = max(self.coordinates - int(problem.free.sum()), 1)

    def cost(self, basis: ErrorBasis | None, ratio: Array) -> float:
        """Return the cost at the state itself, the robot's noise following from the rest."""
        gram, prior, offset = self._normal(basis, ratio)
        at = np.concatenate([np.zeros(self.shared), self._weights(basis)])
        off = offset + at
        v = np.append(at, 1.0)
        return float(v @ gram @ v + off @ prior @ off)

    def _weights(self, basis: ErrorBasis | None) -> Array:
        p = 0 if basis is None else basis.columns.shape[-1]
        w = self.rig_state.weights
        return w if len(w) == p else np.zeros(p)

    def step(self, basis: ErrorBasis | None, ratio: Array, share: float = 1.0) -> RigState:
        """Return the state after a share of a Gauss-Newton step.

        Raises:
            DegenerateError: the views do not determine the parameters.
        """
        gram, prior, offset = self._normal(basis, ratio)
        H, g = gram[:-1, :-1] + prior, gram[:-1, -1] + prior @ offset
        scale = 1 / np.sqrt(np.maximum(np.diag(H), 1e-300))
        try:
            factor = np.linalg.cholesky(H * np.outer(scale, scale))
        except np.linalg.LinAlgError as error:
            raise DegenerateError(
                "cameras: the joint fit is not determined by these views. Add views that tilt and "
                "roll the hand, and instants at which several cameras see the same board."
            ) from error
        half = np.linalg.solve(factor, g * scale)
        step = -scale * np.linalg.solve(factor.T, half)
        w = self._weights(basis)
        step[self.shared :] = w + share * (step[self.shared :] - w)
        step[: self.shared] *= share
        return self.moved(step, basis, ratio)

    def moved(self, step: Array, basis: ErrorBasis | None, ratio: Array) -> RigState:
        """Return the state after a step (S + p,): what every instant has for itself follows."""
        problem, state, S = self.rig_problem, self.rig_state, self.shared
        weights = step[S:]
        smooth = smooth_errors(basis, weights, len(self.D))
        noise = np.repeat(ratio, 3) * self.unit_sd
        free = self.r + (self.J @ step[:S, None])[..., 0] + (self.D @ smooth[..., None])[..., 0]
        scaled = noise[:, None] * np.swapaxes(self.D, 1, 2)
        inner = np.eye(6) + scaled @ (self.D * noise)
        right = (scaled @ free[..., None])[..., 0]
        errors = smooth - noise * np.linalg.solve(inner, right[..., None])[..., 0]
        A = state.A.copy()
        loose = dict(state.loose)
        for i, (R, rows) in enumerate(self.solved_rows):
            if not len(R):
                continue
            change = np.concatenate([step[:S], errors[i] - state.errors[i], [1.0]])
            moves = -np.linalg.lstsq(R, rows @ change, rcond=None)[0]
            for (b, _), xi in zip(problem.loose_of(i), moves.reshape(-1, 6), strict=True):
                if b < 0:
                    A[i] = A[i] @ se3.exp(xi)
                else:
                    loose[b, i] = loose[b, i] @ se3.exp(xi)
        moved = problem.stepped(state, step)
        return replace(moved, A=A, loose=loose, weights=weights, errors=errors)


def first_state(
    X: Array, Z: Array, lenses: Sequence[CameraIntrinsics], A: Array,
    loose: dict[tuple[int, int], Array],
) -> RigState:  # fmt: skip
    """Return the state of a start: lenses as given, boards as drawn, a robot without errors."""
    return RigState(
        X=X, Z=Z, A=A, loose=loose, lens=np.stack([camera_vector(lens) for lens in lenses]),
        shape=np.tile(FLAT, (len(Z), 1)), weights=np.zeros(0), errors=np.zeros((len(A), 6)),
    )  # fmt: skip
