"""The joint fit in its linear neighbourhood: all that needs many fits, at the price of one.

At a fitted state every view i gives rows r_i + J_i dtheta + D_i d, d = B_i w + e its robot error,
e ~ N(0, S sigma^2). With D_i = Q_i R_i, turning the rows by Q_i confines robot noise to the first
six, whose covariance is 1 + R_i S R_i^T; whitening these leaves an ordinary ridge regression in
theta = (X, Z, camera, board, w). Another lambda, another basis, another sigma, the fit without one
view are one small linear solve each; robot errors are milliradians, so the linear answer differs
from a new fit by a hundredth of a sigma.

    theta_-i = theta + (H - H_i)^-1 g_i,    H_i = U_i^T U_i of rank 24 (Woodbury)

lambda and the scales of a basis maximise the marginal likelihood (restricted maximum likelihood,
Patterson & Thompson 1971):

    -2 log L = N log sigma^2 + sum_i log |1 + R_i S R_i^T| + quadratic terms + log |H|

The camera's place for this arm as it moves here: what the arm gets wrong everywhere cancels.

An error that is the same in all poses looks like another place of camera and target, and the fit
shares it out among X, Z and the robot's map as their priors like it: X alone is known no better
than this share. Where the camera looks from at the calibrated poses does not depend on it. Its
representative is the X (with a Z) that shows every view where fit and map together show it,

    (x, z) = argmin sum_i |J_i (x, z) - E_i B_i w|^2  =  K w,        X_here = X Exp(x)

with the derivatives of the views' pixels by X and Z (J) and by the robot's errors (E) of
`view_system`. It is linear in w, so its covariance is P C P^T, P = [1 0 K], C that of the fit's
noise. Smooth errors of the arm that the fit does not model move the estimate about as they move
the true X_here, and what they leave differs from view to view, which the jackknife counts.
"""

from dataclasses import dataclass

import numpy as np

from realsim.arrays import Array, Rows
from realsim.errors import DegenerateError
from realsim_calibration.fit.joint_solve import JointProblem, JointState
from realsim_calibration.fit.robot_error import ErrorBasis
from realsim_calibration.fit.view_system import SHARED
from realsim_calibration.results import Stretch

ROBOT = slice(SHARED, SHARED + 6)
SIGMA_ROUNDS = 3
"""Rounds of sigma inside one evaluation of the likelihood; the fourth changes it by 1e-4."""

LEAST_LEFT = 0.1
"""1 - leverage is taken for no less: of 7 views one that alone holds a direction says nothing of
its noise, and its jackknife step has no bound."""


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class LinearFit:
    """A solution of the linear problem for one basis of the robot's error."""

    step: Array
    """(29 + p,) from the state of the linearisation."""
    sigma_px: float
    information: Array
    """(29 + p, 29 + p) H, priors included."""
    view_rows: Array
    """(views, 24, 29 + p) U_i, whitened: H = sum U_i^T U_i + prior."""
    away: Array
    """(views, 29 + p) step from the solution to the fit without view i."""
    swings: Array
    """(views, 29 + p) `away`, backwards and bounded: no view counts more than ten times over."""
    pulls: Array
    """(views, 29 + p) U_i^T rho_i: how hard each view pulls at the solution."""
    seen_px: Array
    """(views,) RMS through the robot's pose and its map [px]."""
    unseen_px: Array
    """(views,) the same predicted without the view [px]."""

    @property
    def score(self) -> float:
        """Geometric mean of the unseen views' RMS [px]."""
        return float(np.exp(np.mean(np.log(np.maximum(self.unseen_px, 1e-9)))))

    def without(self, views: Rows) -> Array:
        """Return the step (29 + p,) from the solution to the fit without some views.

        Raises:
            DegenerateError: without them the rest is not determined.
        """
        rows = self.view_rows[views].reshape(-1, len(self.step))
        rest = self.information - rows.T @ rows
        if np.linalg.eigvalsh(rest)[0] <= 0:
            raise DegenerateError("hand-eye: without these views the rest is not determined.")
        return np.asarray(np.linalg.solve(rest, self.pulls[views].sum(0)), dtype=np.float64)


class LinearModel:
    """The views linearised at one state.

    `ratio` (2,) is lambda for rotation and for translation everywhere.
    """

    def __init__(self, problem: JointProblem, state: JointState, roots: Array) -> None:
        self.problem, self.state = problem, state
        self.shared = SHARED
        rows = problem.equations(state, roots)
        self.coordinates = 2 * len(roots)
        self.weight_sums = np.add.reduceat(roots**2, problem.starts[:-1])
        self.J, self.D = rows[:, :, :SHARED], rows[:, :, ROBOT]
        # The residual as it would be without robot errors.
        self.r = rows[:, :, -1] - (self.D @ state.errors[..., None])[..., 0]
        self.unit_sd = problem.unit_robot_sd(state)
        self._turn()
        center, covariance = problem.prior()
        self.prior = np.zeros((SHARED, SHARED))
        self.prior[12:, 12:] = np.linalg.inv(covariance)
        self.prior_log_det = float(np.linalg.slogdet(covariance)[1])
        self.offset = np.zeros(SHARED)
        self.offset[12:] = np.concatenate([state.camera, state.board]) - center
        self.freedom = max(self.coordinates - 12 - int(problem.free.sum()), 1)

    def _turn(self) -> None:
        """Turn every view's rows so that its robot error is in the first six of them alone."""
        Q, R = np.linalg.qr(self.D, mode="complete")
        turned = np.swapaxes(Q, 1, 2) @ np.concatenate([self.J, self.r[..., None]], -1)
        self.robot, self.rest = turned[:, :6], turned[:, 6:]
        self.turned_D = R[:, :6]
        flat = self.rest.reshape(-1, self.shared + 1)
        self.rest_gram = flat.T @ flat

    def _factors(self, ratio: Array) -> Array:
        """Return the Cholesky factors (views, 6, 6) of 1 + R S R^T."""
        scaled = self.turned_D * (np.repeat(ratio, 3) * self.unit_sd)
        factors = np.linalg.cholesky(np.eye(6) + scaled @ np.swapaxes(scaled, 1, 2))
        return np.asarray(factors, dtype=np.float64)

    def _robot_rows(self, basis: ErrorBasis | None, ratio: Array) -> Array:
        """Return the whitened robot rows (views, 6, 29 + p + 1), residual last."""
        rows = self.robot
        if basis is not None:
            smooth = self.turned_D @ basis.columns
            rows = np.concatenate([rows[..., :-1], smooth, rows[..., -1:]], -1)
        return np.linalg.inv(self._factors(ratio)) @ rows

    def _normal(self, basis: ErrorBasis | None, ratio: Array) -> tuple[Array, Array, Array]:
        """Return the Gram matrix (29 + p + 1, ...) of all rows, the prior and its offset."""
        rows = self._robot_rows(basis, ratio)
        flat = rows.reshape(-1, rows.shape[-1])
        gram = flat.T @ flat
        n = len(gram) - 1
        at = np.append(np.arange(self.shared), n)
        gram[np.ix_(at, at)] += self.rest_gram
        prior = np.eye(n)
        prior[: self.shared, : self.shared] = self.prior
        return gram, prior, np.concatenate([self.offset, np.zeros(n - self.shared)])

    def _solve(
        self, basis: ErrorBasis | None, ratio: Array, sigma: float, rounds: int
    ) -> tuple[Array, float, Array, float, float]:
        """Return step, sigma, H, residual sum and prior quadratic; sigma re-estimated in rounds."""
        gram, prior, offset = self._normal(basis, ratio)
        G, g, c = gram[:-1, :-1], gram[:-1, -1], float(gram[-1, -1])
        # Without noise the views outweigh the prior by more than the digits of a double: what only
        # the prior determines would be lost in the rounding of G, and H be singular.
        G_held = G + np.diag(len(G) * np.finfo(np.float64).eps * np.diag(G))
        step, rest = np.zeros(len(G)), c
        for _ in range(rounds):
            step = np.linalg.solve(G_held / sigma**2 + prior, -g / sigma**2 - prior @ offset)
            rest = max(float(step @ G @ step + 2 * step @ g + c), 1e-12)
            sigma = float(np.sqrt(rest / self.freedom))
        H = G_held / sigma**2 + prior
        step = np.asarray(np.linalg.solve(H, -g / sigma**2 - prior @ offset), np.float64)
        moved = offset + step
        return step, sigma, H, rest, float(moved @ prior @ moved)

    def deviance(self, basis: ErrorBasis | None, ratio: Array, sigma: float) -> float:
        """Return -2 log marginal likelihood, up to a constant."""
        _, sigma, H, rest, quadratic = self._solve(basis, ratio, sigma, SIGMA_ROUNDS)
        noise = 2 * float(np.sum(np.log(np.diagonal(self._factors(ratio), axis1=1, axis2=2))))
        log_det = float(np.linalg.slogdet(H)[1]) + self.prior_log_det
        scale = 2.0 * self.coordinates * float(np.log(sigma))
        return scale + noise + rest / sigma**2 + quadratic + log_det

    def fit(
        self, basis: ErrorBasis | None, ratio: Array, sigma: float, rounds: int = SIGMA_ROUNDS
    ) -> LinearFit:
        """Return the ridge solution with this basis.

        Raises:
            DegenerateError: without one of the views the rest is not determined.
        """
        step, sigma, H, _, _ = self._solve(basis, ratio, sigma, rounds)
        robot = self._robot_rows(basis, ratio)
        U = np.zeros((len(robot), self.J.shape[1], robot.shape[-1]))
        U[:, :6] = robot
        U[:, 6:, : self.shared], U[:, 6:, -1] = self.rest[..., :-1], self.rest[..., -1]
        U /= sigma
        U, residual = U[..., :-1], U[..., -1] + U[..., :-1] @ step
        try:
            away, swings = _left_out(H, U, residual)
        except np.linalg.LinAlgError as error:
            raise DegenerateError(
                "hand-eye: without one of the views the fit is no longer determined. Add views."
            ) from error
        return LinearFit(
            step=step, sigma_px=sigma, information=H, view_rows=U, away=away,
            pulls=np.einsum("nrc,nr->nc", U, residual), swings=swings,
            seen_px=self.predicted(basis, np.broadcast_to(step, away.shape)),
            unseen_px=self.predicted(basis, step + away),
        )  # fmt: skip

    def predicted(self, basis: ErrorBasis | None, steps: Array) -> Array:
        """Return the RMS (views,) [px] of every view through the robot's pose at its own step."""
        r = self.r + (self.J @ steps[:, : self.shared, None])[..., 0]
        if basis is not None:
            smooth = basis.columns @ steps[:, self.shared :, None]
            r = r + (self.D @ smooth)[..., 0]
        return np.sqrt(np.sum(r**2, -1) / self.weight_sums)

    def influence(self, fit: LinearFit, ratio: Array, columns: Array) -> Array:
        """Return d theta / d w (29 + p, q): what errors columns (views, 6, q) do to a fit.

        The estimate moves by H^-1 U^T times the whitened rows that the error changes (with minus:
        an error of the robot is a change of the prediction that the fit undoes).
        """
        whitened = np.linalg.inv(self._factors(ratio)) @ self.turned_D / fit.sigma_px
        effect = whitened @ columns
        pulled = np.einsum("nrc,nrq->cq", fit.view_rows[:, :6], effect)
        return -np.linalg.solve(fit.information, pulled)


def _left_out(H: Array, U: Array, residual: Array) -> tuple[Array, Array]:
    """Return (H - U_i^T U_i)^-1 U_i^T rho_i (views, dim) by Woodbury's identity.

    The second one has the views' leverage bounded: no eigenvalue of what is left of a view's rows
    is below the bound. Where their leverages' sum is not above it, none of them is.
    """
    V = np.linalg.solve(H, np.swapaxes(U, 1, 2).transpose(1, 0, 2).reshape(len(H), -1))
    V = V.reshape(len(H), len(U), -1).transpose(1, 0, 2)  # H^-1 U_i^T (views, dim, 24)
    inner = np.eye(U.shape[1]) - U @ V
    away = (V @ np.linalg.solve(inner, residual[..., None]))[..., 0]
    swings = away.copy()
    at = np.trace(inner, axis1=1, axis2=2) < U.shape[1] - 1 + LEAST_LEFT
    left, axes = np.linalg.eigh(inner[at])
    along = np.swapaxes(axes, 1, 2) @ residual[at, :, None]
    swings[at] = (V[at] @ axes @ (along / np.maximum(left, LEAST_LEFT)[..., None]))[..., 0]
    return away, swings


PLACES = 12
"""X and Z."""
OUTER_SHARE = 0.25
"""Views that are held out to see how far a map may be stretched."""
FEW_OUTER = 2
"""Fewer outer views say nothing."""


def places_of(model: LinearModel, columns: Array) -> Array:
    """Return K (12, q): twists of X and Z that show the views as errors (views, 6, q) do."""
    J = model.J[:, :, :PLACES]
    seen = np.einsum("nrs,nsq->nrq", model.D, columns)
    normal = np.einsum("nra,nrb->ab", J, J)
    return np.asarray(np.linalg.solve(normal, np.einsum("nra,nrq->aq", J, seen)), np.float64)


def projection(model: LinearModel, basis: ErrorBasis | None) -> Array:
    """Return P (12, 29 + p): twists of X and Z for this arm per parameter of a fit."""
    smooth = np.zeros((PLACES, 0)) if basis is None else places_of(model, basis.columns)
    rest = np.zeros((PLACES, model.shared - PLACES))
    return np.concatenate([np.eye(PLACES), rest, smooth], -1)


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class PlainFit:
    """A calibration for programs that know no robot map."""

    name: str
    state: JointState
    held_out_px: float
    """RMS of the views, each predicted without it and without a map [px]."""


def plain_fits(
    model: LinearModel, none: LinearFit, sigma: float, mapped: LinearFit, basis: ErrorBasis | None
) -> list[PlainFit]:
    """Return the joint fits that need no map, the one with the robot's noise first.

    "joint" weighs the robot's noise, "pixels" takes the robot for exact, and "effective" is the fit
    with a map, the map's mean effect put into X and Z.
    """
    steps = {"joint": none, "pixels": model.fit(None, np.zeros(2), sigma)}
    shared = {name: (fit.step, fit.step + fit.away) for name, fit in steps.items()}
    if basis is not None:
        P = projection(model, basis)
        shared["effective"] = (_folded(P, mapped.step), _folded(P, mapped.step + mapped.away))
    return [
        PlainFit(
            name=name, state=model.state.moved(step),
            held_out_px=float(np.sqrt(np.mean(model.predicted(None, without) ** 2))),
        )
        for name, (step, without) in shared.items()
    ]  # fmt: skip


def _folded(P: Array, steps: Array) -> Array:
    """Return steps (..., 29) of shared parameters, the map's part put into X and Z."""
    return np.concatenate([steps @ P.T, steps[..., PLACES:SHARED]], -1)


def stretch(
    model: LinearModel, mapped: LinearFit, basis: ErrorBasis, none: LinearFit, features: Array
) -> Stretch | None:
    """Return how map and no map predict the outermost views, None where the rest is too few.

    Args:
        model: the views.
        mapped: the fit with the map.
        basis: the map's basis.
        none: the fit without one.
        features: (views, 12) of the poses, centred: outermost is furthest from the middle.
    """
    count = int(OUTER_SHARE * len(features))
    if count < FEW_OUTER:
        return None
    outer = np.sort(np.argsort(np.linalg.norm(features, axis=-1))[-count:])
    px: list[float] = []
    for fit, errors in ((mapped, basis), (none, None)):
        try:
            step = fit.step + fit.without(outer)
        except DegenerateError:
            return None
        seen = model.predicted(errors, np.broadcast_to(step, fit.away.shape))[outer]
        px.append(float(np.sqrt(np.mean(seen**2))))
    views = tuple(model.problem.setup.views[k].index for k in outer)
    return Stretch(views=views, map_px=px[0], plain_px=px[1])
