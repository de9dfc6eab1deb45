"""Hand-eye calibration from views of a tag board: gates, starts, joint fit, uncertainty."""

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from realsim.errors import DegenerateError, InputError
from realsim.geometry import se3
from realsim.geometry.camera import project
from realsim.records import CameraIntrinsics, HandEye, TagBoard
from realsim_calibration.board_pose import BoardPose, board_points, estimate_board_pose
from realsim_calibration.closed_forms import CLOSED_FORMS, MotionConfig, check_observable
from realsim_calibration.detection import TagDetections
from realsim_calibration.gates import GateConfig, angle_gate, check_conventions, px_gate
from realsim_calibration.joint_solve import (
    JointConfig,
    JointState,
    ViewCorners,
    camera_of,
    camera_vector,
    solve_joint,
)
from realsim_calibration.uncertainty import Uncertainty, estimate_uncertainty

Array = NDArray[np.float64]


@dataclass(frozen=True, kw_only=True, slots=True)
class HandEyeConfig:
    """Everything the hand-eye calibration may be told."""

    gates: GateConfig = field(default_factory=GateConfig)
    motion: MotionConfig = field(default_factory=MotionConfig)
    joint: JointConfig = field(default_factory=JointConfig)
    min_tags: int = 2
    """Fewest tags of a usable view: one tag alone has a mirror twin and no lever."""
    gate_rounds: int = 2
    """How often the pixel gate and the closed forms alternate: a bad view bends the first start."""
    advised_views: int = 8
    """Fewer views than this give a warning: the covariance then rests on too few of them."""
    advised_roll_deg: float = 60.0
    """Range of camera roll about the optical axis below which a warning is given [deg]: without
    roll the error was 2 to 6 times larger in simulation."""


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class BoardView:
    """One view of the board and where the controller says the hand was."""

    index: int
    T_base_ee: Array
    """(4, 4) the controller's tool pose in its base [m]."""
    detections: TagDetections

    def __post_init__(self) -> None:
        """Check that the pose is rigid and freeze it."""
        T = se3.check_rigid(self.T_base_ee, f"T_base_ee of view {self.index}")
        if T.shape != (4, 4):
            raise InputError(f"T_base_ee of view {self.index} has shape {T.shape}, not (4, 4).")
        T.setflags(write=False)
        object.__setattr__(self, "T_base_ee", T)


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class HandEyeReport:
    """A hand-eye calibration with its diagnosis."""

    hand_eye: HandEye
    sigma_px: float
    """Unit-weight standard deviation of a corner coordinate in the joint fit [px]."""
    board_scale: float
    """Size of the board relative to the given one."""
    board_scale_sd: float
    mismatch_deg: float
    """Median mismatch of the turns of hand and camera over all pairs, before any gate [deg]."""
    screw_ratio: float
    """Slide of the hand / slide of the camera along the screw axes; NaN = hardly any slide."""
    roll_range_deg: float
    """Range of camera roll about the optical axis [deg]."""
    inflation: float
    """Variance of X over what the graph's noise model claims."""
    unseen_px: Array
    """(views used,) RMS of each view predicted without it [px]."""
    robot_errors: Array
    """(views used, 6) estimated robot error, right of T_base_ee, rotation first [rad, m]."""
    twins_used: tuple[int, ...]
    """Views whose planar pose was replaced by its mirror twin for the start."""
    warnings: tuple[str, ...]


@dataclass(eq=False, kw_only=True, slots=True)
class _Candidate:
    """A view on its way through the gates."""

    view: BoardView
    points: Array
    uv: Array
    pose: BoardPose


def calibrate_hand_eye(
    views: Sequence[BoardView],
    board: TagBoard,
    intrinsics0: CameraIntrinsics,
    config: HandEyeConfig | None = None,
) -> HandEye:
    """Return the camera's place in the hand, with covariance, residuals and what was rejected.

    Args:
        views: views of a board that stands still, in any order.
        board: the board.
        intrinsics0: the camera as known before (factory values); refined within priors.
        config: gates, priors and steps.

    Raises:
        InputError: wrong conventions, mixed-up views, or views of another board.
        UnitError: hand poses or board in the wrong unit.
        DegenerateError: the views do not determine the hand-eye; says what to add.
    """
    return calibrate_hand_eye_report(views, board, intrinsics0, config).hand_eye


def calibrate_hand_eye_report(
    views: Sequence[BoardView],
    board: TagBoard,
    intrinsics0: CameraIntrinsics,
    config: HandEyeConfig | None = None,
) -> HandEyeReport:
    """Return the hand-eye calibration with its diagnosis; see `calibrate_hand_eye`."""
    config = config or HandEyeConfig()
    candidates, rejected = _candidates(views, board, intrinsics0, config)
    A, C = _stacks(candidates)
    if len(A) >= config.motion.min_views:
        mismatch, ratio = check_conventions(A, C, board, config.gates)
    else:
        check_observable(A, config.motion)
        raise DegenerateError("hand-eye: too few usable views.")
    twins = [_plausible_twin(c.pose, config.gates) for c in candidates]
    C, dropped, swapped = angle_gate(A, C, twins, config.gates)
    rejected += [(candidates[k].view.index, reason) for k, reason in dropped.items()]
    twin_views = tuple(candidates[k].view.index for k in swapped)
    keep = [k for k in range(len(candidates)) if k not in dropped]
    candidates, C = [candidates[k] for k in keep], C[keep]

    candidates, start, starts, more = _start(candidates, C, intrinsics0, config)
    rejected += more
    middle = np.array([*board.size_m, 0.0]) / 2
    corners = [
        ViewCorners(
            index=c.view.index, T_base_ee=c.view.T_base_ee, points=c.points, uv=c.uv, middle=middle
        )
        for c in candidates
    ]
    fit = solve_joint(corners, start, intrinsics0, config.joint)
    spread = estimate_uncertainty(fit, corners, intrinsics0)
    roll = roll_range_deg([c.pose.T_cam_board for c in candidates])
    warnings = _warnings(len(candidates), roll, spread, config)
    return HandEyeReport(
        hand_eye=_record(fit.state, spread, candidates, intrinsics0, config, rejected, starts,
                         warnings),
        sigma_px=fit.sigma_px,
        board_scale=fit.state.scale,
        board_scale_sd=float(np.sqrt(spread.covariance[24, 24])),
        mismatch_deg=mismatch,
        screw_ratio=ratio,
        roll_range_deg=roll,
        inflation=spread.inflation,
        unseen_px=spread.unseen_px,
        robot_errors=fit.state.errors,
        twins_used=twin_views,
        warnings=warnings,
    )  # fmt: skip


def _candidates(
    views: Sequence[BoardView], board: TagBoard, intrinsics: CameraIntrinsics, config: HandEyeConfig
) -> tuple[list[_Candidate], list[tuple[int, str]]]:
    """Return the views that show the board, by index, and the others with the reason."""
    ordered = sorted(views, key=lambda v: v.index)
    indices = [v.index for v in ordered]
    if len(set(indices)) != len(indices):
        raise InputError("hand-eye: two views have the same index; every view needs its own.")
    candidates: list[_Candidate] = []
    rejected: list[tuple[int, str]] = []
    for view in ordered:
        if len(view.detections) < config.min_tags:
            rejected.append((
                view.index,
                f"shows {len(view.detections)} tags; at least {config.min_tags} are needed.",
            ))  # fmt: skip
            continue
        points, uv = board_points(view.detections, board)
        pose = estimate_board_pose(view.detections, board, intrinsics)
        if pose is None:
            rejected.append((view.index, "no pose in front of the camera fits its tags."))
            continue
        candidates.append(_Candidate(view=view, points=points, uv=uv, pose=pose))
    return candidates, rejected


def _stacks(candidates: list[_Candidate]) -> tuple[Array, Array]:
    """Return (N, 4, 4) hand poses and board poses."""
    A = np.array([c.view.T_base_ee for c in candidates]).reshape(-1, 4, 4)
    return A, np.array([c.pose.T_cam_board for c in candidates]).reshape(-1, 4, 4)


def _plausible_twin(pose: BoardPose, gates: GateConfig) -> Array | None:
    """Return the mirror solution where it fits the image almost as well."""
    return pose.twin if pose.twin_rms_px <= gates.twin_ratio * max(pose.rms_px, 0.1) else None


def _start(
    candidates: list[_Candidate], C: Array, intrinsics: CameraIntrinsics, config: HandEyeConfig
) -> tuple[list[_Candidate], JointState, tuple[tuple[str, float], ...], list[tuple[int, str]]]:
    """Return the views that pass the pixel gate, the best closed form, all of them, the others."""
    rejected: list[tuple[int, str]] = []
    tried = _closed_forms(candidates, C, intrinsics, config)
    for _ in range(config.gate_rounds):
        bad = px_gate(_best(tried)[2], config.gates)
        if not bad:
            break
        rejected += [(candidates[k].view.index, reason) for k, reason in bad.items()]
        keep = [k for k in range(len(candidates)) if k not in bad]
        candidates, C = [candidates[k] for k in keep], C[keep]
        tried = _closed_forms(candidates, C, intrinsics, config)
    X, Z, _ = _best(tried)
    state = JointState(
        T_ee_cam=X,
        T_base_board=Z,
        camera=camera_vector(intrinsics),
        scale=1.0,
        errors=np.zeros((len(candidates), 6)),
    )
    starts = tuple((name, float(np.sqrt(np.mean(px**2)))) for name, (_, _, px) in tried.items())
    return candidates, state, starts, rejected


def _closed_forms(
    candidates: list[_Candidate], C: Array, intrinsics: CameraIntrinsics, config: HandEyeConfig
) -> dict[str, tuple[Array, Array, Array]]:
    """Return (T_ee_cam, T_base_board, px per view) of every closed form."""
    A, _ = _stacks(candidates)
    check_observable(A, config.motion)
    tried: dict[str, tuple[Array, Array, Array]] = {}
    for name, solve in CLOSED_FORMS.items():
        X, Z = solve(A, C)
        tried[name] = (X, Z, np.array([_view_px(c, X, Z, intrinsics) for c in candidates]))
    return tried


def _best(tried: dict[str, tuple[Array, Array, Array]]) -> tuple[Array, Array, Array]:
    """Return the closed form of least median px: a mean would follow the worst view."""
    return min(tried.values(), key=lambda entry: float(np.median(entry[2])))


def _view_px(c: _Candidate, X: Array, Z: Array, intrinsics: CameraIntrinsics) -> float:
    """Return a view's reprojection RMS through the robot pose [px], infinite behind the camera."""
    T_cam_board = se3.invert(c.view.T_base_ee @ X) @ Z
    error = project(intrinsics, se3.transform(T_cam_board, c.points)) - c.uv
    px = float(np.sqrt(np.mean(np.sum(error**2, -1))))
    return px if np.isfinite(px) else np.inf


def roll_range_deg(Ts_cam_board: Sequence[Array]) -> float:
    """Return the range of camera roll about the optical axis [deg]: 360 less the largest gap."""
    angles = np.sort(np.degrees([np.arctan2(T[1, 0], T[0, 0]) for T in Ts_cam_board]) % 360.0)
    gaps = np.diff(np.append(angles, angles[0] + 360.0))
    return float(360.0 - gaps.max())


def _warnings(n: int, roll: float, spread: Uncertainty, config: HandEyeConfig) -> tuple[str, ...]:
    """Return what the user should do better next time."""
    found: list[str] = []
    if n < config.advised_views:
        found.append(
            f"only {n} views were used; take {config.advised_views} or more (24 are advised), the "
            "covariance rests on their scatter."
        )
    if roll < config.advised_roll_deg:
        found.append(
            f"the camera rolls by only {roll:.0f} deg about its optical axis; roll the hand by "
            f"{config.advised_roll_deg:g} deg or more between views, it improves the result more "
            "than further views do."
        )
    seen, unseen = (float(np.sqrt(np.mean(v**2))) for v in (spread.seen_px, spread.unseen_px))
    if unseen > 2 * seen:
        found.append(
            f"unseen views are predicted to {unseen:.2f} px, seen ones fit to {seen:.2f} px: the "
            "fit follows single views; take more."
        )
    return tuple(found)


def _record(
    state: JointState,
    spread: Uncertainty,
    candidates: list[_Candidate],
    intrinsics0: CameraIntrinsics,
    config: HandEyeConfig,
    rejected: list[tuple[int, str]],
    starts: tuple[tuple[str, float], ...],
    warnings: tuple[str, ...],
) -> HandEye:
    """Return the public record."""
    sd = np.sqrt(np.diag(spread.covariance)[12:24])
    sd[4:][np.array(config.joint.distortion_sd) <= 0] = 0.0
    method = (
        "joint reprojection fit (hand-eye, board, lens, board scale, robot error per view); "
        "covariance: jackknife over views averaged with the scaled marginal of the graph"
    )
    return HandEye(
        T_ee_cam=state.T_ee_cam,
        covariance=spread.covariance[:6, :6],
        T_base_board=state.T_base_board,
        intrinsics=camera_of(state.camera, intrinsics0),
        intrinsics_sd=sd,
        view_indices=tuple(c.view.index for c in candidates),
        view_rms_px=spread.seen_px,
        held_out_px=float(np.sqrt(np.mean(spread.unseen_px**2))),
        rejected=tuple(sorted(rejected)),
        method="; ".join([method, *(f"WARNING: {w}" for w in warnings)]),
        starts=starts,
    )
