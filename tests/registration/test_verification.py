"""Verification without ground truth: wrong poses are flagged, round axes are named."""

import numpy as np
import pytest

from realsim.geometry import se3
from realsim.records import ObjectPose
from realsim.registration.body import make_body
from realsim.registration.compare import CompareConfig, make_comparer
from realsim.registration.evidence import EvidenceConfig, average_cloud, gather, without_table
from realsim.registration.solver import SolverConfig, solve_pose
from realsim.registration.table_planes import PlaneConfig, find_support_plane
from realsim.registration.verify import VerifyConfig, verify_objects


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
