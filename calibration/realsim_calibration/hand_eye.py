"""Hand-eye calibration from views of a target: screening, joint fit, report.

The camera's place for programs that know no robot map, chosen by what unseen views say.

Such a program moves the arm to a pose, takes the controller's word for it, and multiplies with one
fixed X. Candidates are the joint fits without a map (`effective.plain_fits`) and the closed forms
with the lens as given and the board as drawn; each predicts views that it has not seen, without a
map. The closed forms are fitted anew without groups of views only where they might win: in sample
they are never worse than on unseen views.
"""

from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass, replace

import numpy as np

from realsim.arrays import Array
from realsim.errors import DegenerateError
from realsim.geometry import se3
from realsim.geometry.dh import DhArm
from realsim.records import CameraIntrinsics, HandEye, Target
from realsim_calibration.checks import given_camera_check, hand_eye_checks
from realsim_calibration.fit.closed_forms import CLOSED_FORMS
from realsim_calibration.fit.joint_solve import Setup, ViewCorners
from realsim_calibration.fit.robust_fit import Solution, SolvedView, solve
from realsim_calibration.fit.view_system import SHARED, camera_record
from realsim_calibration.results import BoardShape, HandEyeReport, ViewReport
from realsim_calibration.screening import (
    Candidate,
    HandEyeConfig,
    Screened,
    joints_of,
    screen,
    stacks,
    view_px,
)
from realsim_calibration.views import BoardView, target_middle

GROUPS = 20
"""Views are left out one by one, or in so many groups."""


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Plain:
    """X, Z and the lens that serve a program without a robot map."""

    name: str
    """The chosen one of `scores`."""
    scores: tuple[tuple[str, float], ...]
    """(candidate, RMS of the unseen views without a map [px])."""
    X: Array
    covariance: Array
    """(6, 6) of X, absolute."""
    here_covariance: Array
    """(6, 6) of X, for this arm as it moves here."""
    Z: Array
    intrinsics: CameraIntrinsics


def choose_plain(
    solution: Solution, screened: Screened, intrinsics0: CameraIntrinsics
) -> Plain:  # fmt: skip
    """Return the candidate of least held-out error.

    Covariances are those of the joint fit without a map; another candidate's distance from it is
    added as if it were an error.

    Args:
        solution: the joint fits.
        screened: the views that took part, and the closed forms' errors in sample.
        intrinsics0: the lens of the closed forms.
    """
    scores = {fit.name: fit.held_out_px for fit in solution.plain}
    fit = min(solution.plain, key=lambda f: f.held_out_px)
    X, Z = fit.state.X, fit.state.Z
    camera = camera_record(fit.state.camera, (intrinsics0.width, intrinsics0.height))
    name, best = fit.name, fit.held_out_px
    for closed, in_sample in screened.starts:
        scores[closed] = in_sample
        if in_sample >= best:
            continue
        scores[closed] = _held_out_px(closed, screened, intrinsics0)
        if scores[closed] < best:
            name, best, camera = closed, scores[closed], intrinsics0
            X, Z = CLOSED_FORMS[closed](*stacks(screened.candidates))
    off = se3.log(se3.invert(solution.alone.X) @ X)
    apart = np.outer(off, off)
    return Plain(
        name=name, scores=tuple(scores.items()), X=X, Z=Z, intrinsics=camera,
        covariance=solution.alone_covariance[:6, :6] + apart,
        here_covariance=solution.alone_here_covariance + apart,
    )  # fmt: skip


def _held_out_px(closed: str, screened: Screened, intrinsics: CameraIntrinsics) -> float:
    """Return the RMS [px] of all views, each predicted by a closed form without its group."""
    A, C = stacks(screened.candidates)
    groups = np.arange(len(A)) % min(GROUPS, len(A))
    px: list[Array] = []
    for group in range(int(groups.max()) + 1):
        try:
            X, Z = CLOSED_FORMS[closed](A[groups != group], C[groups != group])
        except DegenerateError:
            return float("inf")
        left = [c for c, g in zip(screened.candidates, groups, strict=True) if g == group]
        px.append(view_px(left, X, Z, intrinsics))
    return float(np.sqrt(np.mean(np.concatenate(px) ** 2)))


def calibrate_hand_eye(
    views: Sequence[BoardView],
    target: Target,
    intrinsics0: CameraIntrinsics,
    config: HandEyeConfig | None = None,
    arm: DhArm | None = None,
) -> HandEye:
    """Return the camera's place in the hand, with covariance, residuals and what was rejected.

    Args:
        views: views of a target that stands still, in any order.
        target: the target.
        intrinsics0: the camera as known before (factory values); refined within priors.
        config: gates, priors and steps.
        arm: the arm's kinematics; with the views' joints its errors are modelled.

    Raises:
        InputError: wrong conventions, mixed-up views, or views of another target.
        UnitError: hand poses or target in the wrong unit.
        DegenerateError: the views do not determine the hand-eye; says what to add.
    """
    return calibrate_hand_eye_report(views, target, intrinsics0, config, arm).hand_eye


def calibrate_hand_eye_report(
    views: Sequence[BoardView],
    target: Target,
    intrinsics0: CameraIntrinsics,
    config: HandEyeConfig | None = None,
    arm: DhArm | None = None,
) -> HandEyeReport:
    """Return the hand-eye calibration with its diagnosis; see `calibrate_hand_eye`."""
    config = config or HandEyeConfig()
    screened = screen(views, target, intrinsics0, config, arm)
    setup = setup_of(screened.candidates, target, intrinsics0, config)
    joints = joints_of(screened.candidates) if arm is not None else None
    solution = solve(setup, screened.start, config, arm if joints is not None else None, joints)
    return _report(views, target, intrinsics0, config, screened, solution)


def setup_of(
    candidates: list[Candidate],
    target: Target,
    intrinsics0: CameraIntrinsics,
    config: HandEyeConfig,
) -> Setup:
    """Return the joint fit's input."""
    points = target.points_board
    middle = target_middle(target)
    return Setup(
        views=tuple(
            ViewCorners(
                index=c.view.index,
                T_base_ee=np.ascontiguousarray(c.view.T_base_ee),
                xy=np.ascontiguousarray((c.points - middle)[:, :2]),
                uv=np.ascontiguousarray(c.view.detection.uv),
            )
            for c in candidates
        ),
        to_hand=config.mode == "eye_to_hand",
        middle=middle,
        half_extent=float(np.ptp(points, axis=0).max() / 2),
        intrinsics0=intrinsics0,
    )


def _report(
    views: Sequence[BoardView], target: Target, intrinsics0: CameraIntrinsics,
    config: HandEyeConfig, screened: Screened, solution: Solution,
) -> HandEyeReport:  # fmt: skip
    """Return everything that is known of the calibration."""
    state, problem = solution.state, solution.problem
    shape_sd = np.where(problem.free[12:], np.sqrt(np.diag(solution.covariance)[24:SHARED]), 0.0)
    lens = solution.covariance[12:24, 12:24].copy()
    held = ~problem.free[:12]
    lens[held], lens[:, held] = 0.0, 0.0
    plain = choose_plain(solution, screened, intrinsics0)
    used, size = solution.views, (intrinsics0.width, intrinsics0.height)
    report = HandEyeReport(
        mode=config.mode,
        target=target,
        X=state.X,
        X_covariance=solution.covariance[:6, :6],
        Z=state.Z,
        X_here=solution.here,
        X_here_covariance=solution.here_covariance,
        X_alone=plain.X,
        X_alone_covariance=plain.covariance,
        X_alone_here_covariance=plain.here_covariance,
        Z_alone=plain.Z,
        intrinsics_alone=plain.intrinsics,
        plain_name=plain.name,
        plain_scores=plain.scores,
        stretch=solution.stretch,
        intrinsics=camera_record(state.camera, size),
        intrinsics_covariance=lens,
        board=BoardShape.fitted(target, state.board, shape_sd),
        robot_map=solution.robot_map,
        map_name=solution.map_name,
        map_scores=solution.scores,
        joint_offsets=solution.joint_offsets,
        sigma_px=solution.sigma_px,
        robot_ratio=float(np.sqrt(np.prod(solution.ratio))),
        views=tuple(_view_reports(views, screened, solution)),
        seen_px=rms([v.seen_px for v in used]),
        held_out_px=rms([v.unseen_px for v in used]),
        held_out_mm=rms([v.unseen_mm for v in used]),
        held_out_deg=rms([v.unseen_deg for v in used]),
        starts=screened.starts,
        mismatch_deg=screened.mismatch_deg,
        screw_ratio=screened.screw_ratio,
        roll_range_deg=screened.roll_range_deg,
        checks=(),
        information=solution.information,
    )
    checks = screened.checks + hand_eye_checks(report)
    if config.joint.focal_sd > 0:
        given, fitted = (float(np.sqrt(c.fx * c.fy)) for c in (intrinsics0, report.intrinsics))
        checks = (*checks, given_camera_check(given, fitted))
    return replace(report, checks=checks)


def rms(values: Sequence[float]) -> float:
    """Return the root of the mean square of some numbers, NaN where there are none."""
    return float(np.sqrt(np.mean(np.square(values)))) if len(values) else float("nan")


def _view_reports(
    views: Sequence[BoardView], screened: Screened, solution: Solution
) -> Iterator[ViewReport]:
    """Yield every given view's part, by index."""
    used = {c.view.index: v for c, v in zip(screened.candidates, solution.views, strict=True)}
    for view in sorted(views, key=lambda v: v.index):
        yield ViewReport(
            index=view.index,
            label=view.label,
            used=view.index in used,
            reason=screened.rejected.get(view.index, ""),
            T_base_ee=view.T_base_ee,
            joints=view.joints,
            point_ids=view.detection.point_ids,
            uv=view.detection.uv,
            **asdict(used.get(view.index, SolvedView())),
        )
