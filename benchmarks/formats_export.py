"""The memory of an export of 100,000 frames, and what going on with it costs.

Imported by `formats.py`. Exports of two sizes run in processes of their own, with 10 objects a
frame and their masks; every frame has other numbers. The peak beyond the level after the imports
grows by so much a frame, and is carried on to 100,000 frames: to write those takes 18 minutes of
CPU (`--frames 100000` of formats.py does it).
"""

import json
import subprocess
import sys
import tempfile
from pathlib import Path

from figures import Found

WORKER = Path(__file__).with_name("formats_export_worker.py")
TARGET = 100_000
"""Frames of the goal."""
SIZES = {"bop": (5_000, 20_000), "graspnet": (1_000, 4_000)}
QUICK_SIZES = {"bop": (100, 500), "graspnet": (32, 96)}
FRAMES = 0
"""Frames of the larger BOP export; 0 = as in SIZES. Set by formats.py."""


def export_memory(seed: int, quick: bool) -> Found:
    """Return the peak of memory of 100,000 frames, by the growth between two sizes."""
    found = Found()
    for form, sizes in (QUICK_SIZES if quick else SIZES).items():
        small, large = sizes
        if form == "bop" and FRAMES:
            large = FRAMES
        rows = [_run(form, n) for n in (small, large)]
        found.cases[f"export_{form}"] = rows
        grown = [r["peak_mb"] - r["level_mb"] for r in rows]
        kb = 1e3 * (grown[1] - grown[0]) / (large - small)
        peak = grown[1] + max(kb, 0.0) / 1e3 * (TARGET - large)
        prefix = "" if form == "bop" else "graspnet_"
        found.add(
            f"{prefix}export_peak_mb", peak,
            f"beyond the {rows[1]['level_mb']:.0f} MB after the imports; {small} frames "
            f"{grown[0]:.1f}, {large} frames {grown[1]:.1f} MB, measured; {kb:.2f} kB a frame "
            + ("" if large >= TARGET else f"carried on to {TARGET} frames"),
        )  # fmt: skip
        found.add(
            f"{prefix}resume_s", rows[1]["resume_s"],
            f"going on with {large} frames that are all there, {1e3 * rows[1]['cpu_s'] / large:.1f}"
            " ms of CPU each when they were written (10 objects, 64x48)",
        )  # fmt: skip
    return found


def _run(form: str, frames: int) -> dict[str, float]:
    with tempfile.TemporaryDirectory() as home:
        done = subprocess.run(
            [sys.executable, str(WORKER), form, str(frames), home],
            check=True, stdout=subprocess.PIPE, text=True,
        )  # fmt: skip
    return json.loads(done.stdout.splitlines()[-1])
