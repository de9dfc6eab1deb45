"""Several cameras in one joint fit, on points of a simulated lab whose truth is known."""

from collections.abc import Callable
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest

from realsim.arrays import Array
from realsim.geometry import se3
from realsim.geometry.camera import project
from realsim.records import CameraIntrinsics, Chessboard, TagBoard
from realsim_calibration.calibrate import CalibrationConfig
from realsim_calibration.cameras.calibrate import calibrate_cameras
from realsim_calibration.cameras.files import read_cameras, write_cameras
from realsim_calibration.cameras.problem import RigModel, RigProblem, first_state
from realsim_calibration.cameras.results import CamerasReport
from realsim_calibration.cameras.rig import Instant, Place, Rig, RigBoard, RigCamera, Sighting
from realsim_calibration.fit.joint_solve import JointConfig
from realsim_calibration.lens.intrinsics import IntrinsicsConfig
from realsim_calibration.screening import HandEyeConfig
from realsim_calibration.views import TargetDetection
from refusals import refused, undetermined

LENS = CameraIntrinsics(
    width=1280, height=960, fx=1044.0, fy=1043.0, cx=643.0, cy=476.0,
    distortion=np.array([-0.05, 0.04, 6e-4, -4e-4]),
)  # fmt: skip
FACTORY = CameraIntrinsics(width=1280, height=960, fx=1040.0, fy=1040.0, cx=639.5, cy=479.5)
TABLE = TagBoard(rows=3, columns=4, tag_size_m=0.045, gap_m=0.01)
HELD = TagBoard(rows=3, columns=4, tag_size_m=0.045, gap_m=0.01, first_id=100)
Z_TABLE = se3.from_rt(np.diag([1.0, -1.0, -1.0]), [0.30, 0.08, 0.0])
Z_HELD = se3.from_rt(np.eye(3), [0.05, 0.04, 0.0])
PLACES = {
    "wrist": se3.from_rt(se3.exp_so3([0.02, -0.03, 0.9]), [0.01, -0.065, 0.035]),
    "left": se3.look_at([0.75, 0.5, 0.85], [0.42, 0.05, 0.35], 0.0),
    "right": se3.look_at([0.75, -0.45, 0.85], [0.42, 0.05, 0.35], 0.0),
    "top": se3.look_at([0.3, 0.05, 1.1], [0.42, 0.05, 0.35], 0.0),
}
VIEWS = 9
PLAIN = CalibrationConfig(
    hand_eye=HandEyeConfig(robot_map=False), intrinsics=IntrinsicsConfig(models=("k1 k2 p1 p2",))
)
"""White robot errors have no map, and the lens's model is known: looking for them takes long."""


def hands(rng: np.random.Generator, n: int) -> Array:
    """Return poses of the hand (n, 4, 4) above the table, tilted and rolled."""
    return np.array([
        se3.from_rt(
            se3.exp_so3([np.pi, 0, 0])
            @ se3.exp_so3([*rng.uniform(-0.4, 0.4, 2), rng.uniform(-1.6, 0.3)]),
            np.array([0.40, 0.0, 0.42]) + rng.uniform(-0.08, 0.08, 3),
        )
        for _ in range(n)
    ])  # fmt: skip


def lab(
    names: tuple[str, ...] = ("wrist", "left", "right"), seed: int = 0, views: int = VIEWS,
    robot: float = 1e-4, pixel: float = 0.1, moved: bool = False, given: bool = True,
) -> Rig:  # fmt: skip
    """Return what cameras see of a board on the table and one in the hand, or of one moved by hand.

    Args:
        names: the cameras.
        seed: of everything random.
        views: instants.
        robot: 1-sigma of the reported poses' errors [rad, m].
        pixel: 1-sigma of a corner's coordinate [px].
        moved: whether the boards are one that a person moves, and no other.
        given: whether the factory's intrinsics are given.
    """
    rng = np.random.default_rng([seed, 5])
    true = hands(rng, views)
    told = true @ se3.exp(rng.normal(scale=robot, size=(views, 6)))
    table = RigBoard(name="table", target=TABLE)
    boards = (table, RigBoard(name="held", target=HELD, place="hand"))
    if moved:
        boards = (RigBoard(name="moved", target=TABLE, place="free"),)
    sightings: list[Sighting] = []
    for i, hand in enumerate(true):
        turned = se3.exp([*rng.uniform(-0.4, 0.4, 3), *rng.uniform(-0.1, 0.1, 3)])
        by_hand = se3.from_rt(np.diag([1.0, -1.0, -1.0]), [0.35, 0.1, 0.2]) @ turned
        for b, board in enumerate(boards):
            place = {"table": Z_TABLE, "hand": hand @ Z_HELD, "free": by_hand}[board.place]
            for c, name in enumerate(names):
                T = se3.invert(hand @ PLACES[name] if name == "wrist" else PLACES[name]) @ place
                points = board.target.points_board
                noise = rng.normal(scale=pixel, size=(len(points), 2))
                p = se3.transform(T, points)
                if p[:, 2].min() < 0.1 or T[2, 2] < 0.3:
                    continue
                uv = project(LENS, p) + noise
                seen = np.flatnonzero(np.all((uv > 1) & (uv < [1278, 958]), -1))
                if len(seen) < 12:
                    continue
                found = TargetDetection(point_ids=seen, uv=uv[seen], image_size=(1280, 960))
                sightings.append(Sighting(camera=c, board=b, instant=i, detection=found))
    return Rig(
        cameras=tuple(
            RigCamera(name=n, mount="hand" if n == "wrist" else "fixed",
                      intrinsics0=FACTORY if given else None)
            for n in names
        ),
        boards=boards,
        instants=tuple(Instant(name=f"{i:03d}", T_base_ee=T) for i, T in enumerate(told)),
        sightings=tuple(sightings),
    )  # fmt: skip


@cache
def calibrated() -> CamerasReport:
    return calibrate_cameras(lab(), PLAIN)


def chi2(truth: Array, T: Array, covariance: Array) -> float:
    """Return the error of a pose in units of its covariance: chi^2 of 6."""
    e = se3.log(se3.invert(truth) @ T)
    return float(e @ np.linalg.solve(covariance, e))


def misfit(report: CamerasReport, name: str) -> float:
    own = report.camera(name)
    return chi2(PLACES[name], own.X, own.X_covariance)


def place_mm(report: CamerasReport, name: str) -> float:
    return 1e3 * float(np.linalg.norm(report.camera(name).X[:3, 3] - PLACES[name][:3, 3]))


# --- the fit --------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["wrist", "left", "right"])
def test_every_camera_is_where_its_sigma_says(name: str) -> None:
    report = calibrated()
    assert place_mm(report, name) < 1.0
    assert report.camera(name).sigma_mm < 1.5
    assert misfit(report, name) < 22.5  # 0.1 % of a chi^2 of 6 lies beyond


def test_the_covariance_of_all_holds_each_and_the_pairs() -> None:
    report = calibrated()
    for c, own in enumerate(report.cameras):
        at = slice(6 * c, 6 * c + 6)
        assert np.allclose(report.covariance[at, at], own.X_covariance)
    pair = next(p for p in report.pairs if p.names == ("left", "right"))
    assert chi2(se3.invert(PLACES["left"]) @ PLACES["right"], pair.T_a_b, pair.covariance) < 22.5
    assert pair.together == VIEWS
    # A view of a few tenths of a pixel is good, however good the others are.
    assert report.disagreeing(0.5, 0.0) and min(v.unseen_px for v in report.disagreeing(0.5)) > 0.3


def test_the_step_is_that_of_all_unknowns_solved_at_once() -> None:
    """Elimination against one dense least-squares problem of the same rows."""
    rig = lab(views=6, moved=True)
    loose = {(0, i): PLACES["left"] @ T for i, T in _boards_by(rig, 1).items()}
    rig = rig.only([s for s in rig.sightings if (0, s.instant) in loose])
    all_known = np.ones(len(rig.instants), dtype=bool)
    problem = RigProblem(rig, [FACTORY] * 3, [JointConfig()] * 3, all_known)
    A = np.stack([t.T_base_ee for t in rig.instants if t.T_base_ee is not None])
    eyes = np.stack([PLACES[n] for n in ("wrist", "left", "right")])
    state = first_state(eyes, np.eye(4)[None], [FACTORY] * 3, A, loose)
    sigmas, ratio = np.full(3, 0.3), np.array([0.4, 0.7])
    model = RigModel(problem, state, sigmas, problem.ones())
    step = model.fit(None, ratio, 1.0, rounds=0).step
    rows: list[Array] = []
    noise = np.repeat(ratio, 3) * model.unit_sd
    n, S = len(rig.instants), problem.size
    for i, views in enumerate(problem.at):
        F, M = problem.instant_rows(i, problem.view_blocks(state, sigmas, problem.ones(), views))
        full = np.zeros((len(M), S + 12 * n + 1))
        full[:, :S], full[:, -1] = M[:, :S], M[:, -1]
        full[:, S + 12 * i : S + 12 * i + 6] = M[:, S : S + 6] * noise
        if F.shape[1]:
            full[:, S + 12 * i + 6 : S + 12 * i + 12] = F
        unit = np.zeros((6, full.shape[1]))
        unit[:, S + 12 * i : S + 12 * i + 6] = np.eye(6)
        rows += [full, unit]
    root = np.linalg.cholesky(problem.information + 1e-12 * np.eye(S)).T
    prior = np.zeros((S, S + 12 * n + 1))
    prior[:, :S] = root
    prior[:, -1] = root @ np.where(problem.information.any(0),
                                   problem.vector(state) - problem.center, 0.0)  # fmt: skip
    whole = np.concatenate([*rows, prior])
    used = np.abs(whole[:, :-1]).max(0) > 0
    scale = np.linalg.norm(whole[:, :-1][:, used], axis=0)
    dense = -np.linalg.lstsq(whole[:, :-1][:, used] / scale, whole[:, -1], rcond=1e-13)[0] / scale
    free = problem.free
    sd = 1 / np.sqrt(np.diag(model.fit(None, ratio, 1.0, rounds=0).information))
    assert np.max(np.abs(dense[:S] - step)[free] / sd[free]) < 1e-3


def _boards_by(rig: Rig, camera: int) -> dict[int, Array]:
    from realsim_calibration.fit.view_system import estimate_board_pose

    found: dict[int, Array] = {}
    for s in rig.of_camera(camera):
        points = s.detection.points(rig.boards[s.board].target)
        pose = estimate_board_pose(points, s.detection.uv, LENS)
        assert pose is not None
        found[s.instant] = pose.T_cam_board
    return found


def test_lenses_are_found_where_none_are_given() -> None:
    report = calibrate_cameras(lab(given=False))
    for name in ("wrist", "left", "right"):
        assert report.camera(name).intrinsics.fx == pytest.approx(1044.0, abs=4.0)
        assert place_mm(report, name) < 2.5


def test_a_board_moved_by_hand_ties_fixed_cameras_without_a_robot() -> None:
    rig = lab(("left", "right", "top"), moved=True)
    bare = replace(rig, instants=tuple(Instant(name=t.name) for t in rig.instants))
    report = calibrate_cameras(bare, PLAIN)
    assert report.reference == "left"
    assert np.allclose(report.camera("left").X, np.eye(4), atol=1e-9)
    truth = se3.invert(PLACES["left"]) @ PLACES["top"]
    own = report.camera("top")
    assert chi2(truth, own.X, own.X_covariance) < 22.5
    # The board's own size is only known to its prior.
    assert np.linalg.norm((se3.invert(truth) @ own.X)[:3, 3]) < 0.01
    assert any(c.name == "reference" for c in report.checks)


def test_a_wrong_arm_pose_is_named_and_an_instant_without_one_counts_as_well() -> None:
    rig = lab()
    instants = list(rig.instants)
    T = instants[4].T_base_ee
    assert T is not None
    instants[3] = Instant(name="003")
    instants[4] = replace(instants[4], T_base_ee=T @ se3.from_translation([0.03, 0.0, 0.0]))
    report = calibrate_cameras(replace(rig, instants=tuple(instants)), PLAIN)
    assert report.bad_arm == ("004",)
    assert any(c.name == "arm poses" and "004" in c.sentence for c in report.checks)
    assert any(v.used and v.instant == 4 for v in report.views)
    assert {v.camera for v in report.views if v.instant == 3 and v.used} >= {"left", "right"}
    for name in ("wrist", "left", "right"):
        assert place_mm(report, name) < 1.0


def test_the_file_reads_back(tmp_path: Path) -> None:
    report = calibrated()
    path = write_cameras(report, tmp_path / "cameras.json")
    found = read_cameras(path)
    assert np.array_equal(found.camera("left").T, report.camera("left").X)
    assert np.array_equal(found.covariance, report.covariance)
    assert found.camera("wrist").mount == "hand"
    path.write_text(path.read_text().replace('"realsim.cameras"', '"other"'))
    refused("Is it another file", read_cameras, path)


# --- bad input ------------------------------------------------------------------------------------


def blind(rig: Rig) -> Rig:
    nothing = TargetDetection(point_ids=np.arange(0), uv=np.zeros((0, 2)), image_size=(1280, 960))
    return rig.only([replace(s, detection=nothing) if s.camera == 2 else s for s in rig.sightings])


def swapped_cameras(rig: Rig) -> Rig:
    return rig.only([replace(s, camera={0: 1, 1: 0, 2: 2}[s.camera]) for s in rig.sightings])


def one_mounted_otherwise(rig: Rig) -> Rig:
    cameras = list(rig.cameras)
    cameras[1] = replace(cameras[1], mount="hand")
    return replace(rig, cameras=tuple(cameras))


def boards_at(*places: Place) -> Callable[[Rig], Rig]:
    def fault(rig: Rig) -> Rig:
        boards = tuple(replace(b, place=p) for b, p in zip(rig.boards, places, strict=True))
        return replace(rig, boards=boards)

    return fault


def same_boards(rig: Rig) -> Rig:
    return replace(rig, boards=(rig.boards[0], replace(rig.boards[1], target=TABLE)))


def one_right_view(rig: Rig) -> Rig:
    first = next(s for s in rig.sightings if s.camera == 2)
    return rig.only([s for s in rig.sightings if s.camera != 2 or s is first])


def lone_camera(rig: Rig) -> Rig:
    """The right camera has one view only, and no intrinsics."""
    cameras = (*rig.cameras[:2], replace(rig.cameras[2], intrinsics0=None))
    return replace(one_right_view(rig), cameras=cameras)


def other_size(rig: Rig) -> Rig:
    small = CameraIntrinsics(width=640, height=480, fx=520.0, fy=520.0, cx=319.5, cy=239.5)
    return replace(rig, cameras=(*rig.cameras[:2], replace(rig.cameras[2], intrinsics0=small)))


def exchanged_lenses(rig: Rig) -> Rig:
    wrong = replace(FACTORY, fx=1100.0, fy=1100.0)
    cameras = (rig.cameras[0], replace(rig.cameras[1], intrinsics0=wrong), rig.cameras[2])
    # The left images are those of a lens of 1044 px, the right ones are made those of 1100 px.
    grown = [
        replace(s, detection=replace(s.detection, uv=(s.detection.uv - 640) * 1.054 + 640))
        if s.camera == 2 else s
        for s in rig.sightings
    ]  # fmt: skip
    kept = [s for s in grown if s.detection.uv.min() > 0 and np.all(s.detection.uv < [1279, 959])]
    return replace(rig.only(kept), cameras=cameras)


@pytest.mark.parametrize(
    ("fault", "words"),
    [
        (blind, ("camera 'right' never sees a board", "--cameras")),
        (swapped_cameras, ("cameras 'wrist' and 'left' are exchanged", "exchange their folders")),
        (one_mounted_otherwise, ("camera 'left' is standing still", "left=fixed")),
        (boards_at("hand", "hand"), ("board 'table' is on the table", "--board")),
        (boards_at("hand", "table"), ("boards 'table' and 'held' are exchanged",)),
        (same_boards, ("carry the same markers", "another first id")),
        (lone_camera, ("camera 'right' sees a board in 1 of 1 images", "right.yaml")),
        (exchanged_lenses, ("'left' and 'right' look exchanged",)),
        (other_size, ("camera 'right'", "640x480", "1280x960", "--intrinsics")),
    ],
)
def test_bad_input_is_named_with_what_to_do(
    fault: Callable[[Rig], Rig], words: tuple[str, ...]
) -> None:
    said = refused(".", calibrate_cameras, fault(lab()), PLAIN)
    assert all(word in said for word in words), said


def test_images_of_two_cameras_exchanged_at_one_instant() -> None:
    rig = lab()
    at, other = 6, {0: 0, 1: 2, 2: 1}
    sightings = [
        replace(s, camera=other[s.camera]) if s.instant == at else s for s in rig.sightings
    ]
    report = calibrate_cameras(rig.only(sightings), PLAIN)
    named = [v for v in report.rejected if "exchanged at this instant" in v.reason]
    assert {v.camera for v in named} == {"left", "right"}
    assert {v.instant for v in named} == {at}
    assert place_mm(report, "left") < 1.0


def test_one_view_of_a_known_lens_is_enough_and_said() -> None:
    report = calibrate_cameras(one_right_view(lab()), PLAIN)
    assert place_mm(report, "right") < 5.0
    assert misfit(report, "right") < 22.5
    few = [c for c in report.checks if c.name == "few views"]
    assert few and "'right'" in few[0].sentence


def test_a_camera_that_nothing_ties_is_named() -> None:
    rig = lab(("wrist", "left"))
    # The left camera sees a chessboard on the table that no other camera sees.
    extra = Chessboard(rows=6, columns=8, square_m=0.03)
    uv = project(LENS, se3.transform(se3.invert(PLACES["left"]) @ Z_TABLE, extra.points_board))
    seen = TargetDetection(point_ids=np.arange(len(uv)), uv=uv, image_size=(1280, 960))
    boards = (rig.boards[0], RigBoard(name="lone", target=extra))
    kept = [s for s in rig.sightings if s.camera == 0 and s.board == 0]
    kept += [Sighting(camera=1, board=1, instant=i, detection=seen) for i in range(VIEWS)]
    lonely = Rig(cameras=rig.cameras, boards=boards, instants=rig.instants, sightings=tuple(kept))
    refused("nothing ties camera 'left'", calibrate_cameras, lonely, PLAIN)


def test_a_hand_that_does_not_turn_is_refused() -> None:
    rig = lab()
    still = se3.from_translation([0.4, 0.0, 0.4])
    rig = replace(rig, instants=tuple(replace(t, T_base_ee=still) for t in rig.instants))
    undetermined("the hand does not turn", calibrate_cameras, rig, PLAIN)
