"""Which view would help the hand-eye calibration most, predicted before the arm moves.

A view at the robot pose A adds information about theta = (X, Z, camera, board's shape):

    H <- H + J^T J / s^2 - J^T E (E^T E + s^2 S^-1)^-1 E^T J / s^2,
    S = (lambda s)^2 diag(1/f^2 I, (d/f)^2 I)

J, E: Jacobians of the projected points by theta and by the robot's error at that pose (right of A),
which is eliminated; s the corner noise, lambda the robot's share, d the median distance. Views are
ranked by the expected RMS displacement of a point seen in the image at the working distance:
sqrt(tr(M Cov_X)), M the mean of [-hat(p) I]^T [-hat(p) I]. It weighs radians against metres.

Information says how the noise shrinks, the report how large the covariance C of X is now. What C
has beyond the inverse information N = (H^-1)_X are errors of the arm that look like another X: a
floor that no view lowers. With N = L L^T and eigenvalues w, V of L^-1 C L^-T (free of units)

    Cov_X(after) = A (H + H_view)^-1_X A^T + F
    F = L V diag(max(w - 1, 0)) V^T L^T,    A = L V diag(min(w, 1)^1/2) V^T L^-1

A is 1 unless the report knows X better than the information says. Before any view this is C; a view
never increases it, and never lowers it below F.
"""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from realsim.arrays import Array, Mask
from realsim.errors import DegenerateError, InputError
from realsim.geometry import se3
from realsim.geometry.camera import projection_jacobian, undistort
from realsim.records import Chessboard, CircleGrid, RobotErrorMap, Target
from realsim.records.calibration import worst_sigmas
from realsim_calibration.results import HandEyeReport
from realsim_calibration.views import target_middle

SHARED = 29
"""X 6, Z 6, camera 12, board 5."""


WORKING_DISTANCE_M = 0.4
"""Distance at which the camera will be used: where points are to move least [m]."""
BORDER_PX = 8.0
"""Points nearer than this to the image border are not counted on [px]: the arm arrives a few
millimetres off."""
MIN_VISIBLE_SHARE = 0.4
"""Least share of the target's points in the image; chessboards and circle grids, which are
found whole or not at all, need all."""
MAX_TILT_DEG = 60.0
"""Largest angle between line of sight and board normal: corners blur beyond [deg]."""
DISTANCE_M = (0.12, 1.5)
"""Least and greatest distance at which the target is found [m]."""
GRID = 3
"""Points per image side at the working distance whose displacement is averaged."""


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class NextView:
    """A pose that the arm may go to, and what a view there is expected to bring."""

    plan_index: int
    """Row of the plan."""
    T_base_ee: Array
    """(4, 4) the controller's tool pose [m]."""
    visible: bool
    """Whether the target is expected to be found."""
    reason: str
    """Why not; empty where it is."""
    visible_share: float
    """Share of the target's points in the image."""
    distance_m: float
    """Camera to the target's middle [m]."""
    tilt_deg: float
    """Angle between line of sight and board normal [deg]."""
    roll_deg: float
    """Roll of the target in the image about the optical axis [deg]."""
    sigma_mm: float
    """Largest 1-sigma of X's translation after this view [mm]."""
    sigma_deg: float
    """Largest 1-sigma of X's rotation after this view [deg]."""
    rms_mm: float
    """Expected RMS displacement of a point at the working distance after this view [mm]."""
    gain: float
    """Share by which this view lowers `rms_mm`; 0 where it is not visible."""


@dataclass(frozen=True, kw_only=True, slots=True)
class BoardGeometry:
    """How the target stands before the camera."""

    distance_m: float
    """Camera to the target's middle [m]."""
    tilt_deg: float
    """Angle between line of sight and board normal [deg]; above 90 the back is seen."""
    azimuth_deg: float
    """Side of the board on which the camera stands, in the board's axes [deg]."""
    roll_deg: float
    """Turn of the board about the optical axis [deg] (twist part of its rotation)."""


def board_geometry(T_cam_board: Array, target: Target) -> BoardGeometry:
    """Return distance, tilt, azimuth and roll of the target in a camera."""
    R = T_cam_board[:3, :3]
    middle = R @ target_middle(target) + T_cam_board[:3, 3]
    distance = float(np.linalg.norm(middle))
    to_camera = -(R.T @ middle) / distance
    # The board's z points into the paper: from the printed side the camera is at negative z.
    return BoardGeometry(
        distance_m=distance,
        tilt_deg=float(np.degrees(np.arccos(np.clip(-to_camera[2], -1, 1)))),
        azimuth_deg=float(np.degrees(np.arctan2(to_camera[1], to_camera[0]))),
        roll_deg=float(np.degrees(np.arctan2(R[1, 0] - R[0, 1], R[0, 0] + R[1, 1]))),
    )


def predicted_boards(report: HandEyeReport, Ts_base_ee: ArrayLike) -> Array:
    """Return T_cam_board (n, 4, 4) that the calibration expects at controller poses [m].

    A map that needs joints is left out: the millimetre that it moves the target changes no choice.
    """
    A = np.asarray(Ts_base_ee, dtype=np.float64).reshape(-1, 4, 4)
    if isinstance(report.robot_map, RobotErrorMap):
        A = report.robot_map.corrected(A)
    A = se3.invert(A) if report.mode == "eye_in_hand" else A
    return se3.invert(report.X) @ A @ report.Z_points


def rank_next_views(report: HandEyeReport, Ts_planned: ArrayLike) -> tuple[NextView, ...]:
    """Return planned poses with what each ALONE would bring, the best first, unseen ones last.

    Args:
        report: the calibration so far.
        Ts_planned: (n, 4, 4) planned tool poses T_base_ee [m].

    Raises:
        InputError: there is no pose, or one is not rigid.
        DegenerateError: the calibration so far does not determine X.
    """
    planned = _Planned(report, Ts_planned)
    state = _Knowledge(report, planned.metric)
    rows = planned.rate(state, np.ones(len(planned.Ts), bool))
    return tuple(sorted(rows, key=lambda v: (not v.visible, v.rms_mm, v.plan_index)))


def choose_next_views(
    report: HandEyeReport, Ts_planned: ArrayLike, count: int
) -> tuple[NextView, ...]:
    """Return at most `count` planned poses chosen greedily, each given the ones before it.

    Sigmas are those after this and all earlier ones; `gain` is this view's own share.

    Raises:
        InputError: there is no pose, or one is not rigid, or count is not positive.
        DegenerateError: the calibration so far does not determine X.
    """
    if count < 1:
        raise InputError(f"{count} next views were asked for; at least 1 is accepted.")
    planned = _Planned(report, Ts_planned)
    state, left = _Knowledge(report, planned.metric), np.ones(len(planned.Ts), bool)
    chosen: list[NextView] = []
    for _ in range(count):
        rows = [v for v in planned.rate(state, left) if v.visible]
        if not rows:
            break
        best = min(rows, key=lambda v: (v.rms_mm, v.plan_index))
        chosen.append(best)
        left[best.plan_index] = False
        state.add(planned.informations[best.plan_index])
    return tuple(chosen)


def estimated_terms(report: HandEyeReport) -> Mask:
    """Return which of the 29 terms (29,) are estimated; the information of held ones is filling."""
    camera = np.diag(report.intrinsics_covariance) > 0
    known = np.concatenate([np.ones(12, bool), camera, report.board.sd > 0])
    return np.asarray(known & (np.diag(report.information) > 0), np.bool_)


def displacement_metric(report: HandEyeReport) -> Array:
    """Return M (6, 6) with E|dp|^2 = tr(M Cov_X) over points at the working distance [m]."""
    i = report.intrinsics
    u, v = np.meshgrid(np.linspace(0, i.width - 1, GRID),
                       np.linspace(0, i.height - 1, GRID))  # fmt: skip
    xy, valid = undistort(i, np.stack([u.ravel(), v.ravel()], -1))
    xy = xy[valid] if valid.any() else np.zeros((1, 2))
    points = WORKING_DISTANCE_M * np.concatenate([xy, np.ones((len(xy), 1))], -1)
    moved = np.concatenate([-se3.hat(points), np.broadcast_to(np.eye(3), (len(xy), 3, 3))], -1)
    return np.asarray(np.mean(np.swapaxes(moved, -1, -2) @ moved, axis=0), np.float64)


def shaped_points(report: HandEyeReport) -> tuple[Array, Array]:
    """Return the printed points (p, 3) [m] and their derivatives (p, 3, 5) by the shape."""
    b, middle = report.board, target_middle(report.target)
    arm = report.target.points_board - middle
    L = b.half_extent_m
    x, y = arm[:, 0] / L, arm[:, 1] / L
    powers = L * np.stack([x * x, x * y, y * y], -1)
    flat = np.stack([arm[:, 0], (1 + b.aspect) * arm[:, 1], powers @ b.warp], -1)
    d = np.zeros((len(arm), 3, 5))
    d[:, :, 0] = flat
    d[:, 1, 1] = b.scale * arm[:, 1]
    d[:, 2, 2:] = b.scale * powers
    return middle + b.scale * flat, d


class _Knowledge:
    """The information so far, and what of X's covariance it can lower."""

    def __init__(self, report: HandEyeReport, metric: Array) -> None:
        self._free = estimated_terms(report)
        self._H = np.array(report.information[np.ix_(self._free, self._free)])
        if not np.all(self._free[:6]):
            raise DegenerateError(
                "next view: the calibration so far holds no information about X. Capture a few "
                "views that tilt the hand about two axes and roll it about the optical axis."
            )
        # Terms of different units: unit diagonal for the inverse.
        self._unit = 1 / np.sqrt(np.diag(self._H))
        self._metric = metric
        try:
            L = np.linalg.cholesky(self._inverse(self._H[None])[0])
            to_unit = np.linalg.inv(L)
            w, V = np.linalg.eigh(to_unit @ report.place_covariance @ to_unit.T)
        except np.linalg.LinAlgError as error:
            raise DegenerateError(
                "next view: the views so far do not determine X (its information is singular). "
                "Capture views that tilt the hand about two axes and roll it."
            ) from error
        root = L @ V
        self.floor: Array = root * np.maximum(w - 1, 0) @ root.T
        self._map = root * np.sqrt(np.clip(w, 0, 1)) @ V.T @ to_unit

    def _inverse(self, H: Array) -> Array:
        """Return the X block (n, 6, 6) of the inverses of (n, k, k)."""
        scaled = H * np.outer(self._unit, self._unit)
        rhs = np.zeros((H.shape[-1], 6))
        rhs[:6] = np.eye(6)
        block = np.linalg.solve(scaled, np.broadcast_to(rhs, (len(H), *rhs.shape)))[:, :6]
        block = (block + np.swapaxes(block, -1, -2)) / 2
        return np.asarray(block * np.outer(self._unit[:6], self._unit[:6]), np.float64)

    def covariances(self, added: Array) -> Array:
        """Return Cov_X (n, 6, 6) after each of the informations (n, 29, 29)."""
        more = added[:, self._free][:, :, self._free]
        return self._map @ self._inverse(self._H + more) @ self._map.T + self.floor

    def rms(self, covariances: Array) -> Array:
        """Return the expected RMS displacement (n,) [m]."""
        return np.sqrt(np.einsum("ij,nji->n", self._metric, covariances))

    def add(self, information: Array) -> None:
        """Take a view (29, 29) for captured."""
        self._H = self._H + information[np.ix_(self._free, self._free)]


class _Planned:
    """Planned poses, what is seen from them, and what they would add."""

    def __init__(self, report: HandEyeReport, Ts: ArrayLike) -> None:
        Ts = np.asarray(Ts, dtype=np.float64)
        if Ts.ndim != 3 or not len(Ts):
            raise InputError(
                f"planned poses have shape {Ts.shape}; (n, 4, 4) with at least one is accepted."
            )
        self.Ts = se3.check_rigid(Ts, "planned T_base_ee")
        self.report = report
        self.metric = displacement_metric(report)
        self.boards = predicted_boards(report, self.Ts)
        self.geometry = [board_geometry(T, report.target) for T in self.boards]
        self._project()
        self.reasons = [self._reason(k) for k in range(len(Ts))]
        seen = np.array([not r for r in self.reasons])
        self.informations = np.zeros((len(Ts), SHARED, SHARED))
        if seen.any():
            self.informations[seen] = self._informations(seen)

    def _project(self) -> None:
        i = self.report.intrinsics
        points, _ = shaped_points(self.report)
        self.in_cam = se3.transform(self.boards, points)
        front = self.in_cam[..., 2] > 1e-3
        safe = np.where(front[..., None], self.in_cam, [0.0, 0.0, 1.0])
        uv, d_point, d_cam = projection_jacobian(i, safe.reshape(-1, 3))
        shape = self.in_cam.shape[:2]
        uv = uv.reshape(*shape, 2)
        self.d_point, self.d_cam = d_point.reshape(*shape, 2, 3), d_cam.reshape(*shape, 2, 12)
        border = BORDER_PX
        last = np.array([i.width - 1, i.height - 1]) - border
        self.inside: Mask = front & np.all((uv >= border) & (uv <= last), axis=-1)

    def _reason(self, k: int) -> str:
        """Return why pose k does not see the target, '' where it does."""
        g, share = self.geometry[k], float(self.inside[k].mean())
        whole = isinstance(self.report.target, Chessboard | CircleGrid)
        least = 1.0 if whole else MIN_VISIBLE_SHARE
        low, high = DISTANCE_M
        if g.tilt_deg > MAX_TILT_DEG:
            return f"the line of sight is {g.tilt_deg:.0f} deg off the board's normal"
        if not low <= g.distance_m <= high:
            return f"the target is {g.distance_m:.2f} m away ({low:g} to {high:g} m is accepted)"
        if share < least:
            return f"only {share:.0%} of the target lies in the image"
        return ""

    def _informations(self, seen: Mask) -> Array:
        """Return the information (m, 29, 29) of the poses that see the target."""
        r = self.report
        points, d_shape = shaped_points(r)
        eye = np.broadcast_to(np.eye(3), (len(points), 3, 3))
        R = self.boards[seen][:, None, :3, :3]
        in_cam, d_point = self.in_cam[seen], self.d_point[seen]
        by_x = np.concatenate(
            [se3.hat(in_cam), np.broadcast_to(-np.eye(3), (*in_cam.shape, 3))], -1
        )
        by_z = R @ np.concatenate([-se3.hat(points), eye], -1)
        J = np.concatenate(
            [d_point @ by_x, d_point @ by_z, self.d_cam[seen], d_point @ (R @ d_shape)], -1
        )
        E = d_point @ self._by_robot(seen, in_cam, points)
        keep = self.inside[seen][..., None, None]
        J = np.where(keep, J, 0.0).reshape(len(J), -1, SHARED) / r.sigma_px
        E = np.where(keep, E, 0.0).reshape(len(J), -1, 6) / r.sigma_px
        J = J * estimated_terms(r)
        H = np.swapaxes(J, 1, 2) @ J
        if r.robot_ratio > 0:
            JE = np.swapaxes(J, 1, 2) @ E
            EE = np.swapaxes(E, 1, 2) @ E + np.diag(self._robot_sd() ** -2)
            H = H - JE @ np.linalg.solve(EE, np.swapaxes(JE, 1, 2))
        return (H + np.swapaxes(H, 1, 2)) / 2

    def _by_robot(self, seen: Mask, in_cam: Array, points: Array) -> Array:
        """Return d point / d robot error (m, p, 3, 6), the error right of T_base_ee."""
        X, Z = self.report.X, self.report.Z_points
        if self.report.mode == "eye_in_hand":
            in_hand = se3.transform(X, in_cam)
            minus = np.broadcast_to(-np.eye(3), (*in_cam.shape, 3))
            return X[:3, :3].T @ np.concatenate([se3.hat(in_hand), minus], -1)
        in_hand = se3.transform(Z, points)
        eye = np.broadcast_to(np.eye(3), (len(points), 3, 3))
        to_cam = (self.boards[seen] @ se3.invert(Z))[:, None, :3, :3]
        return to_cam @ np.concatenate([-se3.hat(in_hand), eye], -1)

    def _robot_sd(self) -> Array:
        """Return the 1-sigma (6,) of a robot error, lambda sigma (1/f, d/f)."""
        r = self.report
        used = [v.T_base_ee for v in r.used]
        boards = predicted_boards(r, np.stack(used)) if used else self.boards
        distance = np.median([board_geometry(T, r.target).distance_m for T in boards])
        f = (r.intrinsics.fx + r.intrinsics.fy) / 2
        return r.robot_ratio * r.sigma_px / f * np.array([1.0] * 3 + [float(distance)] * 3)

    def rate(self, state: _Knowledge, left: Mask) -> Iterator[NextView]:
        """Yield what each remaining pose would bring, in plan order."""
        where = np.flatnonzero(left)
        if not len(where):
            return
        none = np.zeros((1, SHARED, SHARED))
        covariances = state.covariances(np.concatenate([none, self.informations[where]]))
        rms = state.rms(covariances)
        for k, C, after in zip(where, covariances[1:], rms[1:], strict=True):
            g, reason, (mm, deg) = self.geometry[k], self.reasons[k], worst_sigmas(C)
            yield NextView(
                plan_index=int(k), T_base_ee=self.Ts[k], visible=not reason, reason=reason,
                visible_share=float(self.inside[k].mean()), distance_m=g.distance_m,
                tilt_deg=g.tilt_deg, roll_deg=g.roll_deg,
                sigma_mm=mm, sigma_deg=deg,
                rms_mm=float(1e3 * after), gain=float(1 - after / rms[0]),
            )  # fmt: skip
