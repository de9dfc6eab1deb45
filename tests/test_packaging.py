"""What the packages promise: every exported name exists, and importing realsim stays light."""

import importlib
import subprocess
import sys

import pytest

PACKAGES = ("realsim", "realsim_calibration", "realsim_capture_plans", "realsim_sim_bridge")


@pytest.mark.parametrize("name", PACKAGES)
def test_every_promised_name_exists(name: str) -> None:
    module = importlib.import_module(name)
    missing = [n for n in getattr(module, "__all__", []) if not hasattr(module, n)]
    assert missing == []


def test_importing_realsim_loads_numpy_and_nothing_heavier() -> None:
    code = (
        "import sys, realsim\n"
        "print([m for m in ('open3d','cv2','scipy','numba','gtsam','pybullet','trimesh','viser')"
        " if m in sys.modules])"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=60)
    assert done.stdout.strip() == "[]", done.stdout + done.stderr
