"""Benchmark of the whole loop in the simulated lab: CPU seconds and errors per stage.

    uv run python benchmarks/loop.py [--quick] [--json FILE] [--seed N] [--seeds COUNT]

Figures (keys of the JSON's "figures"): loop_cpu_s, handeye_mm, handeye_deg, object_mssd_mm,
mask_iou, school_grasps_per_s; and for comparison single_view_mssd_mm, the paper's way (ICP in one
top-down view) on the same data; box_slip_mm and box_slip_deg, the greatest slip of a 5 cm box over
all four stages, and default_world_score, the same box's score in a bare PyBullet world.
"""

import argparse
import tempfile
from pathlib import Path

import blas_threads  # noqa: F401
import numpy as np
from figures import Figure, Found, Goal, run

from realsim.app.console import Console
from realsim.app.demo.run import DemoConfig, run_demo
from realsim.app.truth import GOALS
from realsim.robots.hand import find_hand
from realsim_sim_bridge.slip.engines import BulletSettings
from realsim_sim_bridge.slip.score import ScoreLimits
from realsim_sim_bridge.slip.slip_test import SlipConfig, run_slip_test
from realsim_sim_bridge.slip.world import Replay, SlipPhysics
from realsim_sim_bridge.validation.specimens import DOWN, cube_trial

PACKAGES = ("realsim", "numpy", "open3d-cpu", "gtsam", "pybullet", "opencv-python-headless")
PAPER_GRASPS_PER_S = 100 * 2198 / (7 * 86400)
"""The paper: 100 scenes of 2198 candidates in less than a week on one RTX 6000."""


def demo_figures(config: DemoConfig) -> dict[str, float]:
    """Run one demo from nothing and return its figures."""
    with tempfile.TemporaryDirectory() as folder:
        result = run_demo(config, Path(folder) / "demo", Console(quiet=True))
    figures = result.errors.figures()
    tried = sum(int(np.isfinite(s.scores).sum()) for s in result.grasps)
    school = next(t for t in result.times if t.name == "school")
    figures["loop_cpu_s"] = sum(t.cpu_s for t in result.times)
    figures["school_grasps_per_s"] = tried / school.wall_s
    figures["school_grasps_per_cpu_s"] = tried / school.cpu_s
    single = list(result.errors.single_view_mssd_mm.values())
    figures["single_view_mssd_mm"] = float(np.median(single))
    for t in result.times:
        key = f"cpu_s_{t.name}"
        figures[key] = figures.get(key, 0.0) + t.cpu_s
    return figures


def loops(given: argparse.Namespace) -> Found:
    """Measure the loop on a few seeds: medians."""
    config = {"views": 6, "objects": 2, "grasps_per_object": 10} if given.quick else {}
    seeds = range(given.seed, given.seed + given.seeds)
    rows = [demo_figures(DemoConfig(seed=seed, **config)) for seed in seeds]
    medians = {key: float(np.median([r[key] for r in rows])) for key in rows[0]}
    return Found(figures=medians, cases={"seeds": rows})


def held_box(given: argparse.Namespace) -> Found:
    """Slip-test a 5 cm box of 0.125 kg in our setting and in a bare PyBullet world."""
    del given
    trial = cube_trial(0.125, DOWN[None], find_hand())  # grasped from above, through its middle
    bare = SlipConfig(
        sure=None,
        physics=SlipPhysics(pads=None, mass_floor_kg=0.0),
        engine=BulletSettings(iterations=50, friction_anchor=False, replay=Replay()),
    )
    ours, default = (run_slip_test(trial, config) for config in (SlipConfig(sure=None), bare))
    return Found(figures={
        "box_slip_mm": 1e3 * float(ours.slip_m.max()),
        "box_slip_deg": float(np.degrees(ours.slip_rad.max())),
        "default_world_score": float(default.scores(ScoreLimits())[1][0]),
    })  # fmt: skip


FIGURES = {
    "loop_cpu_s": Figure(unit="s"),
    **{k: Figure(unit="", goal=Goal(low=v) if k == "mask_iou" else Goal(high=v))
       for k, v in GOALS.items()},
    "single_view_mssd_mm": Figure(unit="mm"),
    "school_grasps_per_s": Figure(
        unit="1/s", goal=Goal(low=PAPER_GRASPS_PER_S), rival="the paper's rate"
    ),
    "box_slip_mm": Figure(unit="mm", goal=Goal(high=1.0)),
    "box_slip_deg": Figure(unit="deg"),
    "default_world_score": Figure(unit=""),
}  # fmt: skip


def seeds_option(parser: argparse.ArgumentParser) -> None:
    """Add how many loops there are."""
    parser.add_argument("--seeds", type=int, default=1, help="loops to run; figures are medians")


if __name__ == "__main__":
    parts = {"loop": loops, "box": held_box}
    run("loop", __doc__ or "", PACKAGES, FIGURES, parts, options=seeds_option)
