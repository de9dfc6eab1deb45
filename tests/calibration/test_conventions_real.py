"""Conventions and faults named in the poses of a real UR5."""

import json
import os
from pathlib import Path

import numpy as np
import pytest

from realsim.geometry import se3
from realsim.robots.arm import UR5 as UR5_ARM
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


@real
@pytest.mark.real
def test_a_real_ur5_is_sound_and_its_tool_is_named(koch):
    A, C, joints = koch
    d = diagnose(A, C, nominal=UR5_ARM.forward(joints))
    assert d.fault == "tool_offset" and d.harmless and "mm along the flange's z" in d.sentence
    offset = tool_offset(A, UR5_ARM.forward(joints))
    assert np.allclose(offset.offsets[0][:3, 3], [0, 0, 0.2007], atol=1.5e-3)


@real
@pytest.mark.real
def test_millimetres_of_a_real_file_are_named(koch):
    A, C, _ = koch
    raw = A.copy()
    raw[:, :3, 3] *= 1000
    d = diagnose(raw, C)
    assert d.fault == "robot_unit" and np.allclose(d.repaired_base_ee, A)
