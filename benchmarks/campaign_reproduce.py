"""Whether results come back bit for bit when they are made again from their record.

reproduce   reproduce_equal    1 = register, school, annotate and export of a simulated session
                               are equal to what `realsim reproduce` makes of their records, with
                               another number of threads and workers

  uv run python benchmarks/campaign.py --part reproduce [--quick]
"""

import argparse
import os
import subprocess
import sys
import tempfile
from pathlib import Path

from figures import Found

STAGES = ("register", "school", "annotate")


def reproduce(args: argparse.Namespace) -> Found:
    """Return whether every result of a demo is made again as it is."""
    found = Found()
    with tempfile.TemporaryDirectory(prefix="campaign_reproduce_") as place:
        out, demo = Path(place) / "bop", Path(place) / "demo"
        views, objects, grasps = (8, 3, 4) if args.quick else (24, 5, 20)
        size = ("--views", views, "--objects", objects, "--grasps", grasps)
        _realsim("1", "demo", "--out", demo, *size, "--quiet")
        _realsim("1", "export", demo / "session", "--to", "bop", "--out", out, "--quiet")
        results = [(demo / "session", stage) for stage in STAGES] + [(out, "")]
        codes = {
            stage or "export": _realsim(
                "2", "reproduce", result, *([stage] if stage else []), "--workers", "1", check=False
            )
            for result, stage in results
        }
    told = ", ".join(f"{stage} exit {code}" for stage, code in codes.items())
    found.add("reproduce_equal", float(not any(codes.values())), told)
    return found


def _realsim(threads: str, *words: object, check: bool = True) -> int:
    """Run the command line with a number of threads; return its exit code."""
    names = ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS")
    command = [sys.executable, "-c", "from realsim.app.cli import main; main()", *map(str, words)]
    return subprocess.run(
        command, check=check, env=os.environ | dict.fromkeys(names, threads)
    ).returncode
