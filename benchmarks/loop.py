"""Benchmark of the whole loop in the simulated lab: CPU seconds and errors per stage.

    uv run python benchmarks/loop.py [--quick] [--json FILE] [--seeds N]

Figures (keys of the JSON's "figures"): loop_cpu_s, handeye_mm, handeye_deg, object_mssd_mm,
mask_iou, school_grasps_per_s; and for comparison single_view_mssd_mm, the paper's way (ICP in one
top-down view) on the same data; box_slip_mm and box_slip_deg, the greatest slip of a 5 cm box over
all four stages, and default_world_score, the same box's score in a bare PyBullet world.
"""

import os

for name in ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS"):
    os.environ.setdefault(name, "1")

import argparse
import json
import platform
import tempfile
from importlib.metadata import version
from pathlib import Path

import numpy as np

from realsim.app.console import Console
from realsim.app.demo.run import DemoConfig, DemoResult, run_demo
from realsim.app.truth import GOALS
from realsim_sim_bridge.slip.engines import BulletSettings
from realsim_sim_bridge.slip.score import ScoreLimits, score_stages
from realsim_sim_bridge.slip.slip_test import SlipConfig, run_slip_test
from realsim_sim_bridge.slip.world import Replay, SlipPhysics
from realsim_sim_bridge.validation.specimens import DOWN, cube_trial

PACKAGES = ("realsim", "numpy", "open3d-cpu", "gtsam", "pybullet", "opencv-python-headless")
PAPER_GRASPS_PER_S = 100 * 2198 / (7 * 86400)
"""The paper: 100 scenes of 2198 candidates in less than a week on one RTX 6000."""


def run(config: DemoConfig) -> tuple[DemoResult, dict[str, float]]:
    """Run one demo from nothing and return it with its figures."""
    with tempfile.TemporaryDirectory() as folder:
        console = Console(quiet=True)
        result = run_demo(config, Path(folder) / "demo", console)
        figures = result.errors.figures()
        tried = sum(int(np.isfinite(s.scores).sum()) for s in result.grasps)
        school = next(t for t in result.times if t.name == "school")
        figures["loop_cpu_s"] = sum(t.cpu_s for t in result.times)
        figures["school_grasps_per_s"] = tried / school.wall_s
        figures["school_grasps_per_cpu_s"] = tried / school.cpu_s
        figures["single_view_mssd_mm"] = float(
            np.median(list(result.errors.single_view_mssd_mm.values()))
        )
        for t in result.times:
            key = f"cpu_s_{t.name}"
            figures[key] = figures.get(key, 0.0) + t.cpu_s
        return result, figures


def held_box() -> dict[str, float]:
    """Slip-test a 5 cm box of 0.125 kg in our setting and in a bare PyBullet world."""
    trial = cube_trial(0.125, DOWN[None])  # grasped from above, through its middle
    bare = SlipConfig(
        physics=SlipPhysics(pads=None, mass_floor_kg=0.0),
        engine=BulletSettings(iterations=50, friction_anchor=False, replay=Replay()),
    )
    ours, default = (run_slip_test(trial, config) for config in (SlipConfig(), bare))
    tried = np.ones(1, dtype=bool)
    return {
        "box_slip_mm": 1e3 * float(ours.slip_m.max()),
        "box_slip_deg": float(np.degrees(ours.slip_rad.max())),
        "default_world_score": float(
            score_stages(default.slip_m, default.slip_rad, tried, ScoreLimits())[1][0]
        ),
    }


def main() -> None:
    """Run the loop on a few seeds, print the table, write the JSON."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawTextHelpFormatter
    )
    parser.add_argument("--json", type=Path, help="write the figures here")
    parser.add_argument("--quick", action="store_true", help="one small loop, about a minute")
    parser.add_argument("--seeds", type=int, default=1, help="loops to run; figures are medians")
    args = parser.parse_args()
    config = {"views": 6, "objects": 2, "grasps_per_object": 10} if args.quick else {}
    rows = [run(DemoConfig(seed=seed, **config))[1] for seed in range(args.seeds)]
    figures = {key: float(np.median([r[key] for r in rows])) for key in rows[0]}

    figures |= held_box()
    goals = GOALS | {"school_grasps_per_s": PAPER_GRASPS_PER_S, "box_slip_mm": 1.0}
    table = [
        [key, f"{value:.4g}", f"{goals[key]:.3g}" if key in goals else ""]
        for key, value in figures.items()
    ]
    Console().table("The loop in the simulated lab", ["figure", "value", "goal or paper"], table)
    if args.json:
        document = {
            "benchmark": "loop",
            "machine": {"cpu": platform.machine(), "cores": os.cpu_count()},
            "versions": {name: version(name) for name in PACKAGES},
            "seed": list(range(args.seeds)),
            "quick": args.quick,
            "figures": figures,
        }
        args.json.write_text(json.dumps(document, indent=1))


if __name__ == "__main__":
    main()
