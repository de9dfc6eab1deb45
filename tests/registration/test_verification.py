"""Verification without ground truth: wrong poses are flagged, round axes are named."""

import numpy as np
import pytest

from realsim.geometry import se3
from realsim.records import ObjectPose, SupportPlane
from realsim.registration.blind import CovarianceConfig, uncertainty
from realsim.registration.body import make_body
from realsim.registration.compare import CompareConfig, make_comparer
from realsim.registration.evidence import EvidenceConfig, average_cloud, gather, without_table
from realsim.registration.solver import SolverConfig, solve_pose
from realsim.registration.table_planes import PlaneConfig, find_support_plane
from realsim.registration.verify import (
    SinkingConfig,
    VerifyConfig,
    common_sinking,
    verify_objects,
)


@pytest.fixture(scope="module")
def checker(clutter):
    """(bodies, a function poses -> checks) on the cluttered scene."""
    bodies = [make_body(t, clutter.models[t.obj_id], 48, 300) for t in clutter.truth]
    evidence = gather(clutter.intrinsics, clutter.frames, bodies, EvidenceConfig())
    centers = np.stack([b.center(b.T_start) for b in bodies])
    cameras = np.stack([f.T_world_cam[:3, 3] for f in clutter.frames])
    plane, _ = find_support_plane(evidence.support, centers, cameras, PlaneConfig(), 0.001)
    comparer = make_comparer(
        clutter.intrinsics, clutter.frames, evidence.noise, plane, CompareConfig()
    )
    clouds = [
        average_cloud(without_table(c, plane, 0.003), np.eye(4), 0.003) for c in evidence.near
    ]

    def check(poses):
        return verify_objects(bodies, poses, clouds, comparer, VerifyConfig())

    return bodies, check


def test_true_poses_are_accepted(clutter, checker):
    for c in checker[1]([t.T_world_obj for t in clutter.truth]):
        assert c.verdict == "accepted", c.reasons
        assert c.checks["agree"] > 0.97
        assert abs(c.checks["plane_gap_mm"]) < 1
        assert c.checks["penetration_mm"] < 1


@pytest.mark.parametrize(
    ("move", "word"),
    [
        (se3.from_translation([0.0, 0.0, 0.03]), "over the table"),
        (se3.from_translation([0.0, 0.0, -0.025]), "sunk"),
        (se3.from_translation([0.02, 0.01, 0.0]), "agree"),
    ],
)
def test_wrong_poses_are_flagged_with_numbers(clutter, checker, move, word):
    poses = [t.T_world_obj for t in clutter.truth]
    for i in range(len(poses)):
        wrong = [move @ T if j == i else T for j, T in enumerate(poses)]
        checked = checker[1](wrong)[i]
        assert checked.verdict in ("rejected", "doubtful")
        assert any(ch.isdigit() for r in checked.reasons for ch in r)
        assert any(word in r for r in checked.reasons), checked.reasons


def test_objects_inside_each_other_are_flagged(clutter, checker):
    poses = [t.T_world_obj for t in clutter.truth]
    poses[1] = se3.from_translation(poses[0][:3, 3] - poses[1][:3, 3]) @ poses[1]
    checked = checker[1](poses)
    assert checked[0].checks["penetration_mm"] > 10
    assert checked[1].verdict == "rejected"


def test_sinking_by_one_share_of_the_height_is_told_from_sinking(clutter, checker):
    bodies, plane = checker[0], SupportPlane(T_world_table=np.eye(4))
    poses = [t.T_world_obj for t in clutter.truth]
    heights = [
        float(np.ptp(se3.transform(T, b.model.mesh.vertices)[:, 2]))
        for b, T in zip(bodies, poses, strict=True)
    ]

    def said(moves):
        moved = [se3.from_translation([0, 0, m]) @ T for m, T in zip(moves, poses, strict=True)]
        return common_sinking(bodies, moved, [True] * len(moved), plane, SinkingConfig())

    short = said([-0.04 * h for h in heights])
    assert short["consistent"]
    assert short["share_of_height"] == pytest.approx(-0.04, abs=1e-6)
    assert not said([0.0] * len(poses))["consistent"]
    assert not said([0.005, -0.005, 0.005, -0.005])["consistent"]
    assert not common_sinking(bodies, poses, [True] * 4, None, SinkingConfig())["consistent"]


def test_round_axis_is_reported_and_a_box_has_none(clutter, make_scene):
    scene = make_scene(
        [("cylinder_can", (0.05, 0.0), 0.3, (0, 0, 0)), ("box", (-0.06, 0.0), 0.3, (0, 0, 0))], 5, 2
    )
    for truth, expected in zip(scene.truth, (1, 0), strict=True):
        body = make_body(truth, scene.models[truth.obj_id], 64, 300)
        evidence = gather(scene.intrinsics, scene.frames, [body], EvidenceConfig())
        cloud = evidence.near[0].select(evidence.near[0].points[:, 2] > 0.003)
        config = SolverConfig()
        fit = solve_pose(
            body, average_cloud(cloud, np.eye(4), 0.002), body.T_start, config.fine, config
        )
        u = uncertainty(body, fit, 1, CovarianceConfig())
        assert len(u.unobservable) == expected, (u.unobservable, u.sensitivities)
        if expected:
            assert u.unobservable[0].startswith("turn about")
            assert np.sqrt(u.covariance[2, 2]) > 0.2 > np.sqrt(u.covariance[0, 0])


def test_plane_needs_to_agree_with_gravity():
    rng = np.random.default_rng(0)
    wall = np.column_stack(
        [np.full(3000, 0.1), rng.uniform(-0.3, 0.3, 3000), rng.uniform(0, 0.5, 3000)]
    )
    floor = np.column_stack([rng.uniform(-0.2, 0.1, (1500, 2)), np.zeros(1500)])
    points = np.concatenate([wall, floor])
    plane, _ = find_support_plane(
        points, [[0, 0, 0.03]], [[-0.3, 0, 0.4]], PlaneConfig(), 0.0, [0, 0, 1]
    )
    assert plane is not None
    np.testing.assert_allclose(plane.T_world_table[:3, 2], [0, 0, 1], atol=1e-6)


def test_solver_stays_at_the_truth_without_noise(make_scene):
    scene = make_scene([("wedge", (0.0, 0.0), 0.3, (0, 0, 0))], 5, 1, noise_per_m=0.0)
    truth = scene.truth[0]
    body = make_body(truth, scene.models[truth.obj_id], 96, 300)
    evidence = gather(scene.intrinsics, scene.frames, [body], EvidenceConfig(noise_per_m=0.001))
    cloud = evidence.near[0].select(evidence.near[0].points[:, 2] > 0.002)
    config = SolverConfig()
    rough = truth.T_world_obj @ se3.exp([0.05, -0.04, 0.06, 0.003, -0.002, 0.002])
    fit = solve_pose(body, cloud, rough, config.coarse + config.fine, config)
    error = se3.log(se3.invert(truth.T_world_obj) @ fit.T_world_obj)
    assert np.linalg.norm(error[3:]) < 5e-5
    assert np.linalg.norm(error[:3]) < 1e-3
    assert isinstance(body.start, ObjectPose)
