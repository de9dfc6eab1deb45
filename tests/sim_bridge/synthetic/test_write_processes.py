"""Synthetic sessions written by several processes, and by processes that are killed."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

from realsim_sim_bridge.synthetic.config import SyntheticConfig
from realsim_sim_bridge.synthetic.write import write_session
from synthetic_scenes import INTRINSICS, cameras, content, synthetic_scene

SCRIPT = """
import sys
from synthetic_scenes import INTRINSICS, cameras, synthetic_scene
from realsim_sim_bridge.synthetic.write import write_session

if __name__ == "__main__":
    write_session(
        sys.argv[1], synthetic_scene(), INTRINSICS, cameras(3), workers=2,
        progress=lambda done, of: print(done, of, flush=True),
    )
"""


def write(folder, workers):
    return write_session(
        folder, synthetic_scene(), INTRINSICS, cameras(3), SyntheticConfig(), workers=workers
    )


@pytest.mark.slow
def test_a_killed_run_of_two_processes_ends_with_the_bytes_of_one_that_was_not(tmp_path):
    write(tmp_path / "whole", 1)
    (tmp_path / "script.py").write_text(SCRIPT)
    support = Path(__file__).parents[2] / "support"
    for steps in (2, 4):
        process = subprocess.Popen(
            [sys.executable, tmp_path / "script.py", tmp_path / "s"],
            env=os.environ | {"PYTHONPATH": str(support)}, stdout=subprocess.PIPE, text=True,
        )  # fmt: skip
        assert process.stdout is not None
        for _ in range(steps):
            process.stdout.readline()
        process.kill()
        process.wait()
    write(tmp_path / "s", 2)
    assert content(tmp_path / "s") == content(tmp_path / "whole")
