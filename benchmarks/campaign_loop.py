"""What one whole loop takes, and the upgrade of real frames.

whole_loop  whole_loop_min    `realsim demo` of 256 views of 15 objects, 134 grasps on each, from
                              the plan to the labels (--quick: 16 views, 3 objects, 12 grasps)
            whole_loop_cpu_min   the same in CPU time
upgrade     upgrade_cpu_s     `realsim upgrade` of the YCB-V frames in REALSIM_DATA with 10 grasps
                              on each object (--quick: one frame, 2 grasps)
"""

import argparse
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from figures import Found, children_cpu_s

from realsim.compiled import cache_folder


def whole_loop(args: argparse.Namespace) -> Found:
    """Measure the loop by the clock and in CPU time."""
    found = Found()
    size = (16, 3, 12) if args.quick else (256, 15, 134)
    with tempfile.TemporaryDirectory(prefix="campaign_loop_") as place:
        names = ("--views", "--objects", "--grasps")
        options = [w for pair in zip(names, size, strict=True) for w in pair]
        wall_s, cpu_s = timed("demo", "--out", Path(place) / "demo", "--seed", args.seed, *options)
    load = f"load {os.getloadavg()[1]:.1f}"
    found.add("whole_loop_min", wall_s / 60, load)
    found.add("whole_loop_cpu_min", cpu_s / 60, load)
    return found


def upgrade(args: argparse.Namespace) -> Found:
    """Measure the upgrade of the real frames."""
    found = Found()
    frames = found.real_data("upgrade", "scenes/ycbv_mini")
    if frames is None:
        return found
    size = ("--grasps", 2, "--scenes", "50") if args.quick else ("--grasps", 10)
    with tempfile.TemporaryDirectory(prefix="campaign_upgrade_") as place:
        _, cpu_s = timed("upgrade", frames, "--out", Path(place) / "upgraded", *size)
    found.add("upgrade_cpu_s", cpu_s, f"load {os.getloadavg()[1]:.1f}")
    return found


def timed(*words: object) -> tuple[float, float]:
    """Run a command; return its time by the clock and the CPU time of all its processes [s].

    Convex parts of earlier runs are not known to it; compiled loops are. Exit code 1 is a finding
    of the command, no failure of it.
    """
    line = "from realsim.app.cli import main; main()"
    before, start = children_cpu_s(), time.monotonic()
    with tempfile.TemporaryDirectory() as nothing:
        done = subprocess.run(
            [sys.executable, "-c", line, *map(str, words), "--quiet"], check=False,
            env={**os.environ, "NUMBA_CACHE_DIR": str(cache_folder()), "XDG_CACHE_HOME": nothing},
        )  # fmt: skip
    if done.returncode not in (0, 1):
        raise RuntimeError(f"realsim {words[0]} ended with exit code {done.returncode}")
    return time.monotonic() - start, children_cpu_s() - before
