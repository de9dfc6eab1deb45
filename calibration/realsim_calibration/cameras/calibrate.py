"""Several cameras calibrated together: lenses, start, joint fit, and what it says."""

from collections.abc import Sequence
from dataclasses import asdict, replace

import numpy as np

from realsim.errors import DegenerateError, InputError
from realsim.geometry import se3
from realsim.geometry.dh import DhArm
from realsim.geometry.normal_equations import inverse
from realsim.records import CameraIntrinsics
from realsim_calibration.calibrate import CalibrationConfig, determined_priors
from realsim_calibration.cameras import faults, results
from realsim_calibration.cameras.problem import RigProblem, first_state
from realsim_calibration.cameras.results import armless_checks, rig_checks
from realsim_calibration.cameras.rig import Rig, Sighting
from realsim_calibration.cameras.solve import (
    RigSolution,
    UnseenView,
    doubted_instants,
    solve_rig,
    unseen_views,
    without_arm,
)
from realsim_calibration.cameras.start import Start, board_poses, find_start
from realsim_calibration.checks import FOCAL_SHARE, given_camera_check, hand_eye_checks
from realsim_calibration.faults.consequences import drawings_check
from realsim_calibration.faults.motion_check import roll_range_deg
from realsim_calibration.fit.joint_solve import JointConfig
from realsim_calibration.fit.view_system import camera_record
from realsim_calibration.hand_eye import rms
from realsim_calibration.lens.intrinsics import calibrate_intrinsics
from realsim_calibration.lens.report import IntrinsicsReport
from realsim_calibration.results import BoardShape, HandEyeReport, ViewReport

NAN = float("nan")


def calibrate_cameras(
    rig: Rig, config: CalibrationConfig | None = None, arm: DhArm | None = None
) -> results.CamerasReport:
    """Return all cameras of a rig, calibrated in one joint fit.

    Args:
        rig: cameras, boards, instants, and what was seen.
        config: gates, priors and steps, those of one camera.
        arm: the arm's kinematics; with the joints of all instants its errors are modelled.

    Raises:
        InputError: a camera that sees nothing, exchanged cameras or boards, poses that do not
            belong to the images; says what to do.
        DegenerateError: the views do not determine a lens or a place; says what to add.
    """
    config = config or CalibrationConfig()
    faults.require_distinct(rig.boards)
    faults.require_sightings(rig)
    faults.require_sizes(rig)
    try:
        lenses, joints, own = _lenses(rig, config)
    except DegenerateError:
        # A board said to move that stands still tells no lens: then that is the cause to name.
        faults.require_motion(rig, board_poses(rig, _rough_lenses(rig), config.hand_eye)[0])
        raise
    faults.require_lenses(rig, own, FOCAL_SHARE[0])
    faults.require_motion(rig, board_poses(rig, lenses, config.hand_eye)[0])
    start = find_start(rig, lenses, config.hand_eye, arm)
    rows = sorted({s.instant for s in start.rig.sightings})
    used = _only_instants(start.rig, rows)
    loose = {(b, rows.index(i)): T for (b, i), T in start.loose.items() if i in rows}
    problem = RigProblem(used, lenses, joints, start.known[rows])
    state = first_state(start.X, start.Z, lenses, start.A[rows], loose)
    angles = [t.joints for t in used.instants]
    known = None if any(q is None for q in angles) else np.array(angles, dtype=np.float64)
    arm = arm if known is not None else None
    solution = solve_rig(problem, state, config.hand_eye, arm, known)
    doubted = doubted_instants(solution)
    if doubted:
        start.bad_arm += [rows[i] for i in doubted]
        believed = problem.known.copy()
        believed[doubted] = False
        problem = RigProblem(used, lenses, joints, believed)
        solution = solve_rig(problem, without_arm(solution.state, doubted), config.hand_eye, arm,
                             known)  # fmt: skip
    return _report(rig, start, rows, solution, own)


def _only_instants(rig: Rig, rows: Sequence[int]) -> Rig:
    """Return the rig without the instants at which nothing was seen."""
    place = {i: n for n, i in enumerate(rows)}
    return replace(
        rig, instants=tuple(rig.instants[i] for i in rows),
        sightings=tuple(replace(s, instant=place[s.instant]) for s in rig.sightings),
    )  # fmt: skip


def _rough_lenses(rig: Rig) -> list[CameraIntrinsics]:
    """Return the given lenses, of other cameras one by which turns are seen roughly."""
    lenses: list[CameraIntrinsics] = []
    for c, camera in enumerate(rig.cameras):
        w, h = next(s.detection.image_size for s in rig.of_camera(c))
        f, cx, cy = float(max(w, h)), (w - 1) / 2, (h - 1) / 2
        rough = CameraIntrinsics(width=w, height=h, fx=f, fy=f, cx=cx, cy=cy)
        lenses.append(camera.intrinsics0 or rough)
    return lenses


def _lenses(
    rig: Rig, config: CalibrationConfig
) -> tuple[list[CameraIntrinsics], list[JointConfig], list[CameraIntrinsics | None]]:
    """Return every camera's lens to start from, its priors, and the lens its own images show."""
    lenses: list[CameraIntrinsics] = []
    joints: list[JointConfig] = []
    found: list[CameraIntrinsics | None] = []
    for c, camera in enumerate(rig.cameras):
        report, views, said = _own_lens(rig, c, config)
        given = camera.intrinsics0
        if given is None and views < faults.FEW_VIEWS:
            raise InputError(
                f"camera '{camera.name}' sees a board in {views} of "
                f"{len({s.instant for s in rig.of_camera(c)})} images: its place can be found from "
                "that, its lens cannot. Give its intrinsics (--intrinsics FOLDER with a file "
                f"{camera.name}.yaml or .json), or add views of a tilted board."
            )
        if given is None and report is None:
            raise DegenerateError(
                f"camera '{camera.name}': {said} A board that stands still before a fixed camera "
                "shows one view only: then its intrinsics must be given (--intrinsics FOLDER with "
                f"a file {camera.name}.yaml or .json)."
            )
        found.append(None if report is None else report.intrinsics)
        joint = config.hand_eye.joint
        if given is None:
            assert report is not None
            joint = determined_priors(joint, report, config)
            given = report.intrinsics
        lenses.append(given)
        joints.append(joint)
    return lenses, joints, found


def _own_lens(
    rig: Rig, c: int, config: CalibrationConfig
) -> tuple[IntrinsicsReport | None, int, str]:
    """Return a camera's lens by its own images, how many show a board, and why there is none.

    Of several boards the one that it sees from most sides tells the lens: one that moves against
    it, then the one seen most often.
    """
    own = [s for s in rig.of_camera(c) if len(s.detection)]
    boards = [s.board for s in own]

    def worth(b: int) -> tuple[bool, int]:
        return rig.moves(c, b) or rig.boards[b].place == "free", boards.count(b)

    said = ""
    for b in sorted(set(boards), key=worth, reverse=True):
        views = [s for s in own if s.board == b]
        names = [s.name or rig.instants[s.instant].name for s in views]
        try:
            report = calibrate_intrinsics(
                [s.detection for s in views], rig.boards[b].target, names=names,
                config=config.intrinsics,
            )  # fmt: skip
        except DegenerateError as error:
            said = said or str(error)
        else:
            return report, len({s.instant for s in own}), ""
    return None, len({s.instant for s in own}), said


def _report(
    rig: Rig, start: Start, rows: list[int], solution: RigSolution,
    own: Sequence[CameraIntrinsics | None],
) -> results.CamerasReport:  # fmt: skip
    """Return everything that is known of the calibration."""
    problem, state = solution.problem, solution.state
    parts = dict(zip(start.taken, unseen_views(solution), strict=True))
    taken = dict(zip(start.taken, start.rig.sightings, strict=True))
    views = tuple(
        _sighting(rig, k, parts.get(k), start.rejected.get(k, ""), taken) for k in
        range(len(rig.sightings))
    )  # fmt: skip
    places = np.concatenate([c[:6] for c in problem.camera_columns])
    covariance = solution.covariance[np.ix_(places, places)]
    if not problem.arm_used:
        covariance[:6], covariance[:, :6] = 0.0, 0.0
    A = np.tile(np.eye(4), (len(rig.instants), 1, 1))
    A[rows] = state.A @ se3.exp(state.errors)
    cameras = tuple(
        _camera(rig, c, start, rows, solution, views, own[c]) for c in range(len(rig.cameras))
    )
    report = results.CamerasReport(
        rig=rig,
        reference=results.ROBOT_BASE if problem.arm_used else rig.cameras[0].name,
        cameras=cameras,
        covariance=covariance,
        boards=tuple(
            None if b.place == "free" else Z for b, Z in zip(rig.boards, state.Z, strict=True)
        ),
        pairs=tuple(results.pair_reports(rig, state.X, covariance, views, A, problem.middles)),
        views=views,
        robot_map=solution.robot_map,
        map_name="none" if solution.basis is None else solution.basis.name,
        bad_arm=tuple(rig.instants[i].name for i in start.bad_arm),
        checks=(),
    )
    return replace(report, checks=rig_checks(report))


def _sighting(
    rig: Rig, k: int, part: UnseenView | None, reason: str, taken: dict[int, Sighting]
) -> results.SightingReport:
    """Return one view's part."""
    given = rig.sightings[k]
    s = taken.get(k, given)
    return results.SightingReport(
        camera=rig.cameras[given.camera].name, board=rig.boards[given.board].name,
        instant=given.instant, used=part is not None, reason=reason,
        name=given.name or f"{rig.cameras[given.camera].name}/{rig.instants[given.instant].name}",
        detection=s.detection,
        **asdict(part or UnseenView()),
    )  # fmt: skip


def _camera(
    rig: Rig, c: int, start: Start, rows: list[int], solution: RigSolution,
    views: tuple[results.SightingReport, ...], own: CameraIntrinsics | None,
) -> HandEyeReport:  # fmt: skip
    """Return one camera's calibration as that of a camera alone.

    Its board is the one that it sees most, one that the arm moves against it before others.
    """
    problem, state, camera = solution.problem, solution.state, rig.cameras[c]
    mine = [v for v in views if v.camera == camera.name]
    names = [v.board for v in mine if v.used]
    b = max(
        range(len(rig.boards)),
        key=lambda b: (
            rig.moves(c, b) * names.count(rig.boards[b].name) >= faults.FEW_VIEWS,
            names.count(rig.boards[b].name),
            -b,
        ),
    )
    board = rig.boards[b]
    mine = [v for v in mine if v.board == board.name]
    used = [v for v in mine if v.used]
    at, on = problem.camera_columns[c], problem.board_columns[b]
    held = ~problem.free[at[6:]]
    lens = solution.covariance[np.ix_(at[6:], at[6:])].copy()
    lens[held], lens[:, held] = 0.0, 0.0
    sd = np.sqrt(np.diag(solution.covariance)[on[6:]])
    columns = np.concatenate([at[:6], on[:6], at[6:], on[6:]])
    known = inverse(solution.information)[np.ix_(columns, columns)]
    image = used[0].detection.image_size
    free = board.place == "free"
    place = state.loose[b, rows.index(used[0].instant)] if free else state.Z[b]
    errors = {i: e for i, e in zip(rows, state.errors, strict=True)}
    hands = {i: A for i, A in zip(rows, state.A, strict=True)}
    moves = rig.moves(c, b)
    report = HandEyeReport(
        mode="eye_in_hand" if camera.mount == "hand" else "eye_to_hand",
        target=board.target,
        X=state.X[c],
        X_covariance=solution.covariance[np.ix_(at[:6], at[:6])],
        X_here_covariance=solution.here[np.ix_(at[:6], at[:6])],
        Z=place,
        X_alone=solution.alone.X[c],
        X_alone_covariance=solution.alone_covariance[np.ix_(at[:6], at[:6])],
        Z_alone=place if free else solution.alone.Z[b],
        intrinsics_alone=camera_record(solution.alone.lens[c], image),
        intrinsics=camera_record(state.lens[c], image),
        intrinsics_covariance=lens,
        board=BoardShape.fitted(
            board.target, state.shape[b], np.where(problem.free[on[6:]], sd, 0.0)
        ),
        robot_map=solution.robot_map,
        map_name="none" if solution.basis is None else solution.basis.name,
        map_scores=tuple((n, v * float(solution.sigmas[c])) for n, v in solution.scores),
        joint_offsets=solution.joint_offsets,
        sigma_px=float(solution.sigmas[c]),
        robot_ratio=float(np.sqrt(np.prod(solution.ratio))),
        views=tuple(
            ViewReport(
                index=v.instant, label=v.name, used=v.used, reason=v.reason,
                T_base_ee=hands.get(v.instant, np.eye(4)), joints=rig.instants[v.instant].joints,
                point_ids=v.detection.point_ids, uv=v.detection.uv, residuals=v.residuals,
                seen_px=v.seen_px, unseen_px=v.unseen_px, unseen_mm=v.unseen_mm,
                unseen_deg=v.unseen_deg,
                robot_error=errors.get(v.instant, np.zeros(6)) if moves else np.zeros(6),
            )
            for v in mine
        ),
        seen_px=rms([v.seen_px for v in used]),
        held_out_px=rms([v.unseen_px for v in used]),
        held_out_mm=rms([v.unseen_mm for v in used]),
        held_out_deg=rms([v.unseen_deg for v in used]),
        starts=(),
        mismatch_deg=NAN,
        screw_ratio=NAN,
        roll_range_deg=roll_range_deg(np.array([v.T_cam_board for v in used])),
        checks=(),
        information=inverse(known),
    )  # fmt: skip
    checks = [check for camera_of, check in start.checks if camera_of == c]
    told = hand_eye_checks(report)
    if not problem.arm_used:
        told = armless_checks(told, report, "" if c == 0 else rig.cameras[0].name)
    checks += [
        check for check in told if moves or check.name not in {"roll", "robot poses", "joint zeros"}
    ]
    checks += drawings_check([(v.instant, v.detection) for v in mine])
    if camera.intrinsics0 is not None and own is not None:
        given, fitted = (
            float(np.sqrt(i.fx * i.fy)) for i in (camera.intrinsics0, report.intrinsics)
        )
        checks.append(given_camera_check(given, fitted))
    return replace(report, checks=tuple(checks))
