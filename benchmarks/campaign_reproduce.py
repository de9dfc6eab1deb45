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

from campaign_loop import demo, timed
from figures import Found


def reproduce(args: argparse.Namespace) -> Found:
    """Return whether every result of a demo is made again as it is."""
    found = Found()
    with tempfile.TemporaryDirectory(prefix="campaign_reproduce_") as place:
        out = Path(place) / "bop"
        session, *_ = demo(args.seed, *((8, 2, 6) if args.quick else (24, 5, 20)))
        timed("export", session, "--to", "bop", "--out", out)
        results = {stage: (session, stage) for stage in ("register", "school", "annotate")}
        codes = {name: _again(*words) for name, words in (results | {"export": (out,)}).items()}
    told = ", ".join(f"{stage} exit {code}" for stage, code in codes.items())
    found.add("reproduce_equal", float(not any(codes.values())), told)
    return found


def _again(*result: object) -> int:
    """Make a result again with two threads; return the exit code."""
    line = "from realsim.app.cli import main; main()"
    words = ["reproduce", *map(str, result), "--workers", "1"]
    threads = dict.fromkeys(("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS"), "2")
    command = [sys.executable, "-c", line, *words]
    return subprocess.run(command, check=False, env=os.environ | threads).returncode
