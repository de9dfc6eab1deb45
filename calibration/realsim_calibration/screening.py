"""Which views take part: found, sound, plausible; and the closed form that the fit starts from."""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from realsim.arrays import Array
from realsim.errors import DegenerateError, InputError
from realsim.geometry import se3
from realsim.geometry.camera import project
from realsim.geometry.dh import DhArm
from realsim.records import CameraIntrinsics, Check, Target
from realsim_calibration.faults import consequences
from realsim_calibration.faults.gates import (
    TWIN_RATIO,
    frame_gate,
    px_gate,
    rotation_mismatch_deg,
    screw_ratio,
)
from realsim_calibration.faults.motion_check import roll_range_deg
from realsim_calibration.fit.closed_forms import CLOSED_FORMS, MIN_VIEWS, check_observable
from realsim_calibration.fit.joint_solve import JointConfig
from realsim_calibration.fit.view_system import BoardPose, estimate_board_pose
from realsim_calibration.results import Mode
from realsim_calibration.views import BoardView, TargetDetection

TWIN_FLOOR_PX = 0.1
"""Poses that fit the corners to a tenth of a pixel are equally good."""


@dataclass(frozen=True, kw_only=True, slots=True)
class HandEyeConfig:
    """Everything the hand-eye calibration may be told."""

    mode: Mode = "eye_in_hand"
    joint: JointConfig = field(default_factory=JointConfig)
    robot_map: bool = True
    """Whether maps of the robot's error are tried."""
    min_points: int = 8
    """Fewest points of a usable view: two tags; one tag alone has a mirror twin and no lever. A
    target with fewer points is taken whole."""
    gate_rounds: int = 2
    """How often the pixel gate and the closed forms alternate: a bad view bends the first start."""


@dataclass(eq=False, kw_only=True, slots=True)
class Candidate:
    """A view on its way through the gates."""

    view: BoardView
    points: Array
    pose: BoardPose
    A: Array
    """(4, 4) the hand in the base, or the base in the hand where the camera stands still [m]."""


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Screened:
    """The views that take part, and what was found on the way."""

    candidates: list[Candidate]
    rejected: dict[int, str]
    """Reason of every other view, by index."""
    start: tuple[Array, Array]
    """(X, Z) of the best closed form."""
    starts: tuple[tuple[str, float], ...]
    """(closed form, its reprojection RMS [px])."""
    mismatch_deg: float
    screw_ratio: float
    roll_range_deg: float
    checks: tuple[Check, ...]


def screen(
    views: Sequence[BoardView], target: Target, intrinsics0: CameraIntrinsics,
    config: HandEyeConfig, arm: DhArm | None,
) -> Screened:  # fmt: skip
    """Return the views that can be trusted and a start.

    Raises:
        InputError: wrong conventions, mixed-up views, or views of another target.
        UnitError: hand poses or target in the wrong unit.
        DegenerateError: too few views, or a motion that does not determine the hand-eye.
    """
    in_hand = config.mode == "eye_in_hand"
    _require_joints_of(arm, views)
    candidates, rejected = _candidates(views, target, intrinsics0, config)
    candidates, turned = _counted_from_one_end(candidates, target, intrinsics0)
    A, C = stacks(candidates)
    check_observable(A)
    labels = [c.view.label for c in candidates]
    diagnosis = consequences.examine(
        _given(candidates), C, labels, target, config.mode, _nominal(candidates, arm),
    )  # fmt: skip
    conventions = consequences.check_of(diagnosis, [c.view.index for c in candidates])
    if diagnosis is not None and diagnosis.fault in consequences.SINGLE_VIEWS:
        rejected |= {candidates[k].view.index: diagnosis.sentence for k in diagnosis.views}
        keep = [k for k in range(len(candidates)) if k not in diagnosis.views]
        candidates, C = [candidates[k] for k in keep], C[keep]
    twins = [_plausible_twin(c.pose) for c in candidates]
    middle = target.points_board.mean(0)
    C, dropped, _ = frame_gate(_given(candidates), C, twins, middle, eye_in_hand=in_hand)
    rejected |= {candidates[k].view.index: reason for k, reason in dropped.items()}
    keep = [k for k in range(len(candidates)) if k not in dropped]
    candidates, C = [candidates[k] for k in keep], C[keep]
    A = stacks(candidates)[0]
    mismatch, ratio = rotation_mismatch_deg(A, C), screw_ratio(A, C)
    candidates, start, starts, more = _start(candidates, C, intrinsics0, config)
    used = stacks(candidates)[1]
    motion = consequences.motion_check_of(_given(candidates), used, middle, eye_in_hand=in_hand)
    return Screened(
        candidates=candidates,
        rejected=rejected | more,
        start=start,
        starts=starts,
        mismatch_deg=mismatch,
        screw_ratio=ratio,
        roll_range_deg=roll_range_deg(used),
        checks=(
            *(c for c in (conventions, turned, motion) if c is not None),
            *consequences.drawings_check([(v.index, v.detection) for v in views]),
        ),
    )


def joints_of(candidates: Sequence[Candidate]) -> Array | None:
    """Return the joints (views, n) [rad], None where a view has none."""
    found = [c.view.joints for c in candidates]
    return None if any(q is None for q in found) else np.array(found, dtype=np.float64)


def _require_joints_of(arm: DhArm | None, views: Sequence[BoardView]) -> None:
    """Raise if the views' joints are not as many as the arm's."""
    for view in views:
        if arm is not None and view.joints is not None and len(view.joints) != arm.joints:
            raise InputError(
                f"view {view.label} has {len(view.joints)} joint angles, and a {arm.name} has "
                f"{arm.joints} joints. Name the arm that the views were taken with, or none."
            )


def _given(candidates: list[Candidate]) -> Array:
    """Return the controller's poses (N, 4, 4) as they were given [m]."""
    return np.array([c.view.T_base_ee for c in candidates]).reshape(-1, 4, 4)


def _counted_from_one_end(
    candidates: list[Candidate], target: Target, intrinsics: CameraIntrinsics
) -> tuple[list[Candidate], Check | None]:
    """Return the candidates with boards that were counted from the wrong end counted anew."""
    A, C = stacks(candidates)
    turns = consequences.half_turned(A, C, target)
    if turns is None:
        return candidates, None
    mended: list[Candidate] = []
    for c, flip in zip(candidates, turns.flips, strict=True):
        if not flip:
            mended.append(c)
            continue
        view = replace(c.view, detection=consequences.renumbered(c.view.detection, target))
        points = view.detection.points(target)
        pose = estimate_board_pose(points, view.detection.uv, intrinsics)
        if pose is not None:
            mended.append(replace(c, view=view, points=points, pose=pose))
    names = [c.view.label for c, flip in zip(candidates, turns.flips, strict=True) if flip]
    check = Check(
        name="half turns",
        verdict="good",
        sentence=f"the target looks the same turned by 180 deg; in {len(names)} of "
        f"{len(candidates)} views it was counted from the other end; the robot's turns corrected "
        f"that (misfit {turns.before_deg:.1f} deg before, {turns.after_deg:.2f} after).",
        value=float(len(names)),
        views=tuple(c.view.index for c, f in zip(candidates, turns.flips, strict=True) if f),
    )
    return mended, check


def _nominal(candidates: list[Candidate], arm: DhArm | None) -> Array | None:
    """Return the flange by the arm's own kinematics (N, 4, 4), None where it is not known."""
    joints = joints_of(candidates)
    return None if arm is None or joints is None else arm.forward(joints)


def _candidates(
    views: Sequence[BoardView], target: Target, intrinsics: CameraIntrinsics, config: HandEyeConfig
) -> tuple[list[Candidate], dict[int, str]]:
    """Return the views that show the target, by index, and the others with the reason."""
    ordered = sorted(views, key=lambda v: v.index)
    indices = [v.index for v in ordered]
    if len(set(indices)) != len(indices):
        raise InputError("hand-eye: two views have the same index; every view needs its own.")
    candidates: list[Candidate] = []
    rejected: dict[int, str] = {}
    size = (intrinsics.width, intrinsics.height)
    for view in ordered:
        found = view.detection
        if len(found) and tuple(found.image_size) != size:
            raise InputError(
                f"hand-eye: the image of view {view.label} is {found.image_size[0]}x"
                f"{found.image_size[1]} px, the camera's are {size[0]}x{size[1]}. Images of one "
                "size are needed: leave this view out, and do not rescale images."
            )
        pose = board_pose(found, target, intrinsics, config)
        if isinstance(pose, str):
            rejected[view.index] = pose
            continue
        points = found.points(target)
        A = view.T_base_ee if config.mode == "eye_in_hand" else se3.invert(view.T_base_ee)
        candidates.append(Candidate(view=view, points=points, pose=pose, A=A))
    if len(candidates) < MIN_VIEWS:
        raise DegenerateError(
            f"hand-eye: {len(candidates)} of {len(ordered)} views show the target; at least "
            f"{MIN_VIEWS} are needed, 24 are advised. "
            + " ".join(f"View {i} {why}" for i, why in list(rejected.items())[:3])
        )
    return candidates, rejected


def board_pose(
    found: TargetDetection, target: Target, intrinsics: CameraIntrinsics, config: HandEyeConfig
) -> BoardPose | str:
    """Return the board's pose in a view, or why it has none."""
    least = min(config.min_points, len(target.points_board))
    if len(found) < least:
        why = f"shows {len(found)} points of the target; at least {least} are needed"
        return "; ".join([why, *found.rejected[:2]]) + "."
    pose = estimate_board_pose(found.points(target), found.uv, intrinsics)
    return pose or "no pose in front of the camera fits its points."


def stacks(candidates: list[Candidate]) -> tuple[Array, Array]:
    """Return (N, 4, 4) hand poses and board poses."""
    A = np.array([c.A for c in candidates]).reshape(-1, 4, 4)
    return A, np.array([c.pose.T_cam_board for c in candidates]).reshape(-1, 4, 4)


def _plausible_twin(pose: BoardPose) -> Array | None:
    """Return the mirror solution where it fits the image almost as well."""
    limit = TWIN_RATIO * max(pose.rms_px, TWIN_FLOOR_PX)
    return pose.twin if pose.twin_rms_px <= limit else None


def _start(
    candidates: list[Candidate], C: Array, intrinsics: CameraIntrinsics, config: HandEyeConfig
) -> tuple[list[Candidate], tuple[Array, Array], tuple[tuple[str, float], ...], dict[int, str]]:
    """Return the views that pass the pixel gate, the best closed form, all of them, the others."""
    rejected: dict[int, str] = {}
    tried = _closed_forms(candidates, C, intrinsics)
    for _ in range(config.gate_rounds):
        bad = px_gate(_best(tried)[2])
        if not bad:
            break
        rejected |= {candidates[k].view.index: reason for k, reason in bad.items()}
        keep = [k for k in range(len(candidates)) if k not in bad]
        candidates, C = [candidates[k] for k in keep], C[keep]
        tried = _closed_forms(candidates, C, intrinsics)
    X, Z, _ = _best(tried)
    starts = tuple((name, float(np.sqrt(np.mean(px**2)))) for name, (_, _, px) in tried.items())
    return candidates, (X, Z), starts, rejected


def _closed_forms(
    candidates: list[Candidate], C: Array, intrinsics: CameraIntrinsics
) -> dict[str, tuple[Array, Array, Array]]:
    """Return (X, Z, px per view) of every closed form."""
    A, _ = stacks(candidates)
    check_observable(A)
    tried: dict[str, tuple[Array, Array, Array]] = {}
    for name, solve_closed in CLOSED_FORMS.items():
        X, Z = solve_closed(A, C)
        tried[name] = (X, Z, view_px(candidates, X, Z, intrinsics))
    return tried


def _best(tried: dict[str, tuple[Array, Array, Array]]) -> tuple[Array, Array, Array]:
    """Return the closed form of least median px: a mean would follow the worst view."""
    return min(tried.values(), key=lambda entry: float(np.median(entry[2])))


def view_px(candidates: list[Candidate], X: Array, Z: Array, camera: CameraIntrinsics) -> Array:
    """Return each view's RMS through the robot pose [px], infinite behind the camera."""
    Ts = se3.invert(stacks(candidates)[0] @ X) @ Z
    seen = [se3.transform(T, c.points) for T, c in zip(Ts, candidates, strict=True)]
    measured = np.concatenate([c.view.detection.uv for c in candidates])
    error = project(camera, np.concatenate(seen)) - measured
    counts = np.array([len(c.points) for c in candidates])
    first = np.cumsum(counts) - counts
    px = np.sqrt(np.add.reduceat(np.sum(error**2, -1), first) / counts)
    return np.where(np.isfinite(px), px, np.inf)
