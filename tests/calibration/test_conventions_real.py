"""Conventions and faults named in the poses of a real UR5."""

import json
import os
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from fault_sessions import faults
from realsim.geometry import se3
from realsim_calibration.faults.diagnose import diagnose
from realsim_calibration.faults.tool_offset import tool_offset

ROOT = Path(__file__).parents[2]
KOCH = Path(os.environ.get("REALSIM_DATA", ROOT / "../shared/data")) / "handeye" / "koch_ur5"
real = pytest.mark.skipif(not KOCH.is_dir(), reason=f"no real data at {KOCH} (set REALSIM_DATA)")


@pytest.fixture(scope="module")
def koch():
    meta = json.loads((KOCH / "meta.json").read_text())
    stacks = []
    for key in ("robot_poses", "cam_poses"):
        T = np.array(meta[key]).reshape(-1, 4, 4)
        T[:, :3, 3] /= 1000.0
        stacks.append(se3.check_rigid(T, key))
    return stacks[0], stacks[1], np.radians(meta["joints"])


def ur5_flange(joints):
    """Nominal kinematics of a UR5: d, a, alpha of every joint."""
    quarter = np.pi / 2
    links = [
        (0.089159, 0, quarter), (0, -0.425, 0), (0, -0.39225, 0), (0.10915, 0, quarter),
        (0.09465, 0, -quarter), (0.0823, 0, 0),
    ]  # fmt: skip
    T = np.repeat(np.eye(4)[None], len(joints), 0)
    for (d, a, alpha), q in zip(links, np.asarray(joints).T, strict=True):
        turn = se3.from_rt(se3.exp_so3(q[:, None] * [0.0, 0.0, 1.0]), np.zeros(3))
        link = se3.from_rt(se3.exp_so3([alpha, 0.0, 0.0]), np.zeros(3))
        T = T @ turn @ se3.from_translation([a, 0, d]) @ link
    return T


@real
@pytest.mark.real
def test_a_real_ur5_is_sound_and_its_tool_is_named(koch):
    A, C, joints = koch
    assert diagnose(A, C).fault == "none"
    d = diagnose(A, C, nominal=ur5_flange(joints))
    assert d.fault == "tool_offset" and d.harmless and "mm along the flange's z" in d.sentence
    offset = tool_offset(A, ur5_flange(joints))
    assert np.allclose(offset.offsets[0][:3, 3], [0, 0, 0.2007], atol=1.5e-3)


@real
@pytest.mark.real
def test_millimetres_of_a_real_file_are_named(koch):
    A, C, _ = koch
    raw = A.copy()
    raw[:, :3, 3] *= 1000
    d = diagnose(raw, C)
    assert d.fault == "robot_unit" and np.allclose(d.repaired_base_ee, A)


NOT_OF_KOCH = {"flipped", "tool_left_active", "base_turned", "degrees_as_radians"}
QUICK = {"board_moved", "camera_inverted", "duplicated", "swapped"}
"""Faults of place, convention, copies and pairs; those of the rotation take seconds each."""


@real
@pytest.mark.real
@pytest.mark.parametrize(
    "fault",
    [
        pytest.param(fault, marks=() if fault in QUICK else pytest.mark.slow)
        for fault in sorted(faults.FAULTS.keys() - NOT_OF_KOCH)
    ],
)
def test_faults_in_real_poses_are_named(koch, fault):
    A, C, _ = koch
    rng = np.random.default_rng(3)
    s = faults.Session(T=A, C=C, nominal=None, eye_in_hand=True)
    d = faults.ask(replace(faults.FAULTS[fault](s, rng), target=faults.BOARD))
    expected = faults.FAULTS[fault](s, np.random.default_rng(3))
    assert faults.named(expected, d), (expected.expected, expected.views, d.fault, d.sentence)
