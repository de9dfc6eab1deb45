import json
from dataclasses import replace

import numpy as np
import pytest

from realsim.errors import InputError, NotRigidError
from realsim.geometry import se3
from realsim.geometry.camera import project, undistort
from realsim.records import CameraIntrinsics, Chessboard
from realsim.robots.arm import find_arm, known_chains
from realsim_calibration import (
    HandEyeConfig,
    TargetDetection,
    calibrate,
    calibrate_from_poses,
    calibrate_hand_eye_report,
)
from realsim_calibration.exports import FrameNames, read_calibration, write_exports
from realsim_calibration.fit.robot_error import matching_arm
from realsim_calibration.report.summary import viewpoint
from realsim_calibration.results import Clock
from refusals import refused

CLOCK = Clock(offset_s=0.035, sigma_s=0.0004, applied=True)


def seen_from(sim, T_cam_board, target):
    uv = project(sim.intrinsics, se3.transform(T_cam_board, target.points_board))
    size = (sim.intrinsics.width, sim.intrinsics.height)
    inside = np.all((uv > 0) & (uv < np.array(size) - 1), axis=1)
    return TargetDetection(point_ids=np.flatnonzero(inside), uv=uv[inside], image_size=size)


def test_a_camera_that_stands_still_is_placed_in_the_base(simulate):
    sim = simulate(3, views=14, robot=(0.0, 0.0), pixel=0.0)
    # The same pictures: the hand carries the board, the base carries the camera.
    views = [replace(v, T_base_ee=se3.invert(v.T_base_ee)) for v in sim.views]
    r = calibrate_hand_eye_report(
        views, sim.board, sim.intrinsics0, HandEyeConfig(mode="eye_to_hand")
    )
    assert np.abs(se3.log(se3.invert(r.X) @ sim.T_ee_cam)).max() < 1e-5
    assert np.abs(se3.log(se3.invert(r.Z) @ sim.T_base_board)).max() < 1e-5
    with pytest.raises(InputError, match="has no place in the hand"):
        _ = r.hand_eye
    refused("inverted", calibrate_hand_eye_report, views, sim.board, sim.intrinsics0)


def test_boards_counted_from_the_wrong_end_are_mended(simulate):
    sim = simulate(4, views=14)
    target = Chessboard(rows=6, columns=8, square_m=0.03)
    assert target.half_turn
    views = []
    for v, ee in zip(sim.views, sim.truth_ee, strict=True):
        T = se3.invert(ee @ sim.T_ee_cam) @ sim.T_base_board
        views.append(replace(v, detection=seen_from(sim, T, target)))
    plain = calibrate_hand_eye_report(views, target, sim.intrinsics0)
    flipped = []
    for k, v in enumerate(views):
        d = v.detection
        turned = replace(d, point_ids=47 - d.point_ids) if k in (2, 5, 9) else d
        flipped.append(replace(v, detection=turned))
    mended = calibrate_hand_eye_report(flipped, target, sim.intrinsics0)
    assert np.allclose(mended.X, plain.X, atol=1e-9)
    check = next(c for c in mended.checks if c.name == "half turns")
    assert check.views == (2, 5, 9) and "3 of 14" in check.sentence
    assert "half turns" not in {c.name for c in plain.checks}


@pytest.mark.parametrize("factor", [1.2, 0.8])
def test_a_given_camera_of_another_focal_length_is_named_and_not_the_board(simulate, factor):
    """Every board seems too far by as much: the target's size would be blamed."""
    sim = simulate(3, views=12, robot=(0.0, 0.0), pixel=0.1)
    lens = sim.intrinsics
    wrong = replace(lens, fx=factor * lens.fx, fy=factor * lens.fy)
    with pytest.raises(InputError, match=r"given camera has a focal length.*Leave --intrinsics"):
        calibrate(sim.views, sim.board, intrinsics0=wrong)


def test_the_lens_of_pose_pairs_is_the_given_one_or_is_said_to_be_none(tmp_path):
    rng = np.random.default_rng(0)
    X, Z = se3.random_transform(rng, spread=0.1), se3.random_transform(rng)
    C = np.array([se3.exp([*rng.normal(scale=0.4, size=3), 0, 0, 0]) for _ in range(9)])
    C[:, :3, 3] = np.array([0.0, 0.0, 0.6]) + rng.normal(scale=0.05, size=(9, 3))
    A = Z @ se3.invert(C) @ se3.invert(X)
    lens = CameraIntrinsics(
        width=1280, height=720, fx=910.0, fy=911.0, cx=641.0, cy=357.0, distortion=[0.1, -0.2]
    )
    for camera in (lens, None):
        report = replace(calibrate_from_poses(A, C, camera=camera), clock=CLOCK)
        folder = tmp_path / str(camera is None)
        names = {p.name for p in write_exports(report, folder, frames=FrameNames())}
        known = {"camera_info.yaml", "opencv.yml", "calibration.npz"}
        assert known <= names if camera else not known & names
        written = json.loads((folder / "calibration.json").read_text())
        assert written["nominal_lens"] == (camera is None)
        for key in ("intrinsics", "intrinsics_alone"):
            assert ("do NOT use" in written[key]["use"]) == (camera is None)
            assert camera is None or (written[key]["fx"] == 910.0 and written[key]["width"] == 1280)
        back = read_calibration(folder / "calibration.json")
        assert back.clock == CLOCK and np.array_equal(back.Z_points, report.Z_points)
        assert "+35.00 ms +-0.40 ms" in (folder / "camera.urdf").read_text()
        assert np.abs(se3.log(se3.invert(X) @ back.X)).max() < 1e-6


def test_perfect_poses_alone_give_the_truth():
    rng = np.random.default_rng(0)
    X, Z = se3.random_transform(rng, spread=0.1), se3.random_transform(rng)
    away = np.array([se3.exp([*rng.normal(scale=0.5, size=3), 0, 0, 0]) for _ in range(12)])
    C = away @ se3.from_rt(np.eye(3), [0.0, 0.0, 0.6])
    C[:, :3, 3] = np.array([0.0, 0.0, 0.6]) + rng.normal(scale=0.05, size=(12, 3))
    A = Z @ se3.invert(C) @ se3.invert(X)
    r = calibrate_from_poses(A, C)
    assert np.abs(se3.log(se3.invert(X) @ r.X)).max() < 1e-6
    assert np.abs(se3.log(se3.invert(Z) @ r.Z)).max() < 1e-6
    assert np.abs(se3.log(se3.invert(Z) @ r.Z_alone)).max() < 1e-6
    outwards = np.diag([1.0, -1.0, -1.0, 1.0])  # a board's frame with z out of the print
    flipped = calibrate_from_poses(A, C @ outwards)
    assert np.abs(se3.log(se3.invert(Z @ outwards) @ flipped.Z)).max() < 1e-6
    flat = next(c for c in r.checks if c.name == "board flatness")
    assert flat.verdict == "unknown" and "held flat" in flat.sentence
    for record in (r, flipped):
        seen = [viewpoint(record, v) for v in record.used]
        distances = np.linalg.norm(C[:, :3, 3], axis=-1)
        assert np.allclose([p.distance_m for p in seen], distances, atol=1e-5)
        assert max(p.tilt_deg for p in seen) < 90
    refused("12 hand poses and 11 camera poses", calibrate_from_poses, A, C[1:])
    with pytest.raises(InputError, match="behind the camera"):
        calibrate_from_poses(A, se3.invert(C) @ np.diag([1.0, -1.0, -1.0, 1.0]))


def test_white_robot_errors_get_no_map(simulate):
    # With many views a map's gain of one percent was beyond chance, and the map tripled the error.
    sim = simulate(0, views=90)
    r = calibrate_hand_eye_report(sim.views, sim.board, sim.intrinsics0)
    assert r.map_name == "none" and r.robot_map is None
    assert np.allclose(r.X, r.X_alone, atol=2e-5)


@pytest.mark.parametrize("name", ["ur5e", "panda"])
def test_the_arm_is_told_by_joints_and_poses(name):
    rng = np.random.default_rng(5)
    arm = find_arm(name).chain
    joints = rng.uniform(arm.limits.lower, arm.limits.upper, (12, arm.joints)) / 3
    tool = se3.from_rt(se3.exp_so3([0.3, 0.1, -0.2]), [0.01, 0.02, 0.15])
    bent = arm.corrected(rng.normal(size=4 * arm.joints) * 3e-4)
    Ts = bent.forward(joints) @ tool
    # A Panda and an FR3 are one arm by their numbers; those of other joint counts are passed over.
    arms = [arm, *(c for c in known_chains().values() if c is not arm)]
    assert matching_arm(joints, Ts, arms) is arm
    other = se3.random_transform(rng, 12)
    assert matching_arm(joints, other, arms) is None
    assert matching_arm(joints[:3], Ts[:3], arms) is None


def test_a_bent_pandas_errors_are_found_in_its_views(simulate):
    arm = find_arm("panda").chain
    sim = simulate(1, views=60, robot=(0.0, 0.0))
    rng = np.random.default_rng(1)
    bent = arm.corrected(rng.normal(size=28) * np.repeat([1e-3, 3e-4], 14))
    # The pictures stay: the hand is really there, so the bent arm's joints are those that reach it.
    T_base = se3.from_translation([0.0, 0.0, 0.1])
    views, real = [], []
    for k, ee in enumerate(sim.truth_ee):
        q, of = bent.inverse_branches((T_base @ ee)[None])
        if len(of):
            joints = q[int(np.argmin(np.abs(q - find_arm("panda").home).max(-1)))]
            told = arm.forward(joints) @ se3.exp(rng.normal(scale=5e-5, size=6))
            views.append(replace(sim.views[k], T_base_ee=told, joints=joints))
            real.append(T_base @ ee)
    assert len(views) > 30
    plain = calibrate_hand_eye_report(views, sim.board, sim.intrinsics0)
    found = calibrate_hand_eye_report(views, sim.board, sim.intrinsics0, arm=arm.bare())
    assert found.map_name == "arm" and found.joint_offsets.shape == (7, 2)
    Ts = np.array([v.T_base_ee for v in views])
    mended = found.robot_map.corrected(Ts, np.array([v.joints for v in views])) @ found.X

    def apart_mm(cameras):
        # What is left after the best common move: where the base lies is no error of the arm.
        gap = se3.invert(np.array(real) @ sim.T_ee_cam) @ cameras
        return 1e3 * np.linalg.norm(gap[:, :3, 3] - np.median(gap[:, :3, 3], axis=0), axis=1).mean()

    assert apart_mm(mended) < 0.5 * apart_mm(Ts @ plain.X_alone)


def test_terms_that_the_lens_refused_cannot_fold_the_image(simulate):
    # Freed in the hand-eye fit, k2 and k3 of a board seen in the image's middle folded the lens.
    sim = simulate(2, views=12)
    views = []
    for v in sim.views:
        near = np.linalg.norm(v.detection.uv - [640.0, 360.0], axis=1) < 260
        d = v.detection
        part = TargetDetection(point_ids=d.point_ids[near], uv=d.uv[near], image_size=d.image_size)
        views.append(replace(v, detection=part))
    result = calibrate(views, sim.board)
    assert result.lens is not None and "k3" not in result.lens.terms
    camera = result.hand_eye.intrinsics
    corner = np.array([[0.0, 0.0], [1279.0, 0.0], [0.0, 719.0], [1279.0, 719.0]])
    _, valid = undistort(camera, corner)
    assert valid.all()


def test_joints_of_another_arm_are_named(simulate):
    sim = simulate(1, views=12)
    views = [replace(v, joints=np.zeros(6)) for v in sim.views]
    with pytest.raises(InputError, match="6 joint angles, and a Panda has 7"):
        calibrate_hand_eye_report(
            views, sim.board, sim.intrinsics0, arm=find_arm("panda").chain.bare()
        )


def test_matrices_that_a_controller_rounded_are_taken(simulate):
    sim = simulate(4, views=12)
    rng = np.random.default_rng(6)
    C = np.array([se3.invert(v.T_base_ee @ sim.T_ee_cam) @ sim.T_base_board for v in sim.views])
    A = np.array([v.T_base_ee for v in sim.views])
    rounded = np.round(A, 4)  # R^T R is off by up to 1e-4
    assert (
        np.abs(np.swapaxes(rounded, 1, 2)[:, :3, :3] @ rounded[:, :3, :3] - np.eye(3)).max() > 2e-5
    )
    exact, close = calibrate_from_poses(A, C), calibrate_from_poses(rounded, np.round(C, 4))
    assert np.abs(se3.log(se3.invert(exact.X) @ close.X)).max() < 2e-4
    view = replace(sim.views[0], T_base_ee=rounded[0])
    assert np.abs(view.T_base_ee[:3, :3] @ view.T_base_ee[:3, :3].T - np.eye(3)).max() < 1e-14
    A[3, :3, :3] *= 1.0 + rng.uniform(0.02, 0.03)
    said = refused(r"view 3.*not a rotation", calibrate_from_poses, A, C, error=NotRigidError)
    assert "mesh" not in said
