"""What one whole loop takes, and the upgrade of real frames.

whole_loop  whole_loop_min    `realsim demo` of 256 views of 15 objects, 134 grasps on each, from
                              the plan to the labels (--quick: 8 views, 2 objects, 6 grasps)
            whole_loop_cpu_min   the same in CPU time
upgrade     upgrade_cpu_s     `realsim upgrade` of the YCB-V frames in REALSIM_DATA with 10 grasps
                              on each object (--quick: one frame, 2 grasps)
"""

import argparse
import atexit
import os
import shutil
import subprocess
import sys
import tempfile
import time
from functools import cache
from pathlib import Path

import blas_threads  # noqa: F401
from figures import Found, children_cpu_s

from realsim.compiled import cache_folder


def whole_loop(args: argparse.Namespace) -> Found:
    """Measure the loop by the clock and in CPU time."""
    found = Found()
    _, wall_s, cpu_s = demo(args.seed, *((8, 2, 6) if args.quick else (256, 15, 134)))
    load = f"load {os.getloadavg()[1]:.1f}"
    found.add("whole_loop_min", wall_s / 60, load)
    found.add("whole_loop_cpu_min", cpu_s / 60, load)
    return found


@cache
def demo(seed: int, views: int, objects: int, grasps: int) -> tuple[Path, float, float]:
    """Run a demo, once for all parts that ask for it; it lasts as long as this process.

    Returns:
        Its session, its time by the clock and its CPU time [s].
    """
    place = Path(tempfile.mkdtemp(prefix="campaign_loop_"))
    atexit.register(shutil.rmtree, place, ignore_errors=True)
    size = ("--views", views, "--objects", objects, "--grasps", grasps)
    return place / "session", *timed("demo", "--out", place, "--seed", seed, *size)


def upgrade(args: argparse.Namespace) -> Found:
    """Measure the upgrade of the real frames."""
    found = Found()
    frames = found.real_data("upgrade", "scenes/ycbv_mini")
    if frames is None:
        return found
    size = ("--grasps", 2, "--only-scenes", "50") if args.quick else ("--grasps", 10)
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
