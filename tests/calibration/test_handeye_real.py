import json
import os
import re
from pathlib import Path

import numpy as np
import pytest

from realsim.geometry import se3
from realsim_calibration import CLOSED_FORMS, calibrate_from_poses
from realsim_calibration.faults.gates import (
    GateConfig,
    rotation_mismatch_deg,
    screw_ratio,
)
from realsim_calibration.fit.closed_forms import mean_board

ROOT = Path(os.environ.get("REALSIM_DATA", Path(__file__).parents[2] / "../shared/data"))
KOCH = ROOT / "handeye" / "koch_ur5"
pytestmark = [
    pytest.mark.real,
    pytest.mark.skipif(not KOCH.is_dir(), reason=f"no real data at {KOCH} (set REALSIM_DATA)"),
]


def poses(name):
    import cv2

    stored = cv2.FileStorage(str(KOCH / name), cv2.FileStorage_READ)
    T = stored.getNode("poses").mat().reshape(-1, 4, 4).copy()
    T[:, :3, 3] /= 1000.0
    return se3.check_rigid(T, name)


@pytest.fixture(scope="module")
def data():
    return poses("robot_poses.yaml"), poses("cam_poses.yaml")


def left_out(solve, A, C):
    """Return (N, 2) translation [mm] and rotation [deg] of every view predicted without it."""
    errors = []
    for k in range(len(A)):
        others = np.arange(len(A)) != k
        X, Z = solve(A[others], C[others])
        e = se3.log(se3.invert(Z) @ A[k] @ X @ C[k])
        errors.append([1e3 * np.linalg.norm(e[3:]), np.degrees(np.linalg.norm(e[:3]))])
    return np.array(errors)


def test_conventions_of_a_real_ur5_are_recognised(data):
    A, C = data
    assert rotation_mismatch_deg(A, C) < 1.0 < 20 < rotation_mismatch_deg(se3.invert(A), C)
    assert 0.8 < screw_ratio(A, C, GateConfig()) < 1.25


@pytest.mark.parametrize("name", sorted(CLOSED_FORMS))
def test_closed_forms_predict_unseen_views_of_a_real_ur5(data, name):
    A, C = data
    mm, deg = np.sqrt(np.mean(left_out(CLOSED_FORMS[name], A, C) ** 2, 0))
    print(f"koch_ur5 {name}: {mm:.2f} mm, {deg:.2f} deg left out")
    assert mm < 3.0 and deg < 1.2


def test_closed_forms_are_more_consistent_than_the_stored_result(data):
    A, C = data
    stored = np.array(json.loads((KOCH / "handEye_tf.json").read_text())["tf"]).reshape(4, 4)
    stored[:3, 3] /= 1000.0
    stored = se3.check_rigid(np.array(stored), "tf") if _is_rigid(stored) else stored

    def spread(X):
        e = se3.log(se3.invert(mean_board(A, X, C)) @ A @ X @ C)
        return np.sqrt(np.mean(np.sum(e[:, 3:] ** 2, -1)))

    X, _ = CLOSED_FORMS["park"](A, C)
    assert spread(X) < spread(stored)
    assert np.linalg.norm(X[:3, 3] - stored[:3, 3]) < 0.01


def _is_rigid(T):
    return np.abs(T[:3, :3].T @ T[:3, :3] - np.eye(3)).max() < 1e-5


def test_the_rotation_outlier_is_named(data):
    rejected = calibrate_from_poses(*data).hand_eye.rejected
    assert [k for k, _ in rejected] == [9]
    assert re.search(r"2\.6\d deg from where the other views put it", rejected[0][1])
