"""Benchmark of the Robot School: speed, physics that can be believed, labels that agree.

    uv run python benchmarks/school.py [--quick] [--json FILE] [--seed N] [--part NAME]

Scenes of ten generated objects of 16 to 32 convex parts (three with --quick); seeds from 100 on are
those of the published figures, use lower ones while developing. Parts and the figures they give
(keys of the JSON's "figures"):
  speed       bullet_grasps_per_s, mujoco_grasps_per_s
                      candidates, the arm's reach and four stages, per second of two processes on
                      two cores, counted in CPU seconds
              mujoco_marginal_grasps_per_s, marginal_speed_dropped_share
                      the same at 500 kg/m^3, friction 0.3 and twelve weights carried
  steps       plans_per_s (the Panda's; other arms: benchmarks/robots.py),
                      candidates_per_s, candidates_above_table_per_s
                      of one core: collision-free trajectories; turned hands, those not in the table
  validation  coulomb_worst_pct, torque_worst_pct, box_score, box_slip_mm, box_slip_deg,
              light_convergence_share, suite_checks_failed
                      the worst of both engines; `realsim school validate` tells the rest
  agreement   fast_agree_share
                      held labels at fast and at reference settings, the worst of both engines and
                      both conditions
              sure_agree_share
                      passed where sure stages are not simulated, and where all are; likewise
              engines_agree_share, engines_agree_marginal_share, marginal_dropped_share
                      held labels of PyBullet and MuJoCo
  reference   reference_agree_share
                      held labels of an independent contact model and of the engines, the worse
  margins     rank_margin_score, rank_margin_closure, rank_score_closure
                      Spearman's rank correlation of margin, score and Ferrari-Canny quality
  acronym     acronym_balacc
                      our held labels against ACRONYM's (REALSIM_DATA); reported, no goal
  scaling     workers_scaling, ray_nodes_scaling
                      two processes, two Ray nodes, over one; and days for the paper's data set
Shares are 0 to 1. Convex parts are cut once and kept in the folder --keep.
"""

import argparse
from collections.abc import Callable
from importlib import import_module

import blas_threads  # noqa: F401
from figures import Figure, Found, Goal, run
from school_cases import PAPER_GRASPS_PER_S, cut_shapes, keep_option

RATE = f"paper {PAPER_GRASPS_PER_S:.2f}, a GPU"
FIGURES = {
    "bullet_grasps_per_s": Figure(unit="1/s", goal=Goal(low=20.0), rival=RATE),
    "mujoco_grasps_per_s": Figure(unit="1/s", goal=Goal(low=100.0), rival=RATE),
    "mujoco_marginal_grasps_per_s": Figure(unit="1/s", goal=Goal(low=25.0)),
    "plans_per_s": Figure(unit="1/s core", goal=Goal(low=400.0)),
    "candidates_per_s": Figure(unit="1/s core", goal=Goal(low=5000.0)),
    "candidates_above_table_per_s": Figure(unit="1/s core", goal=Goal(low=5000.0)),
    "coulomb_worst_pct": Figure(unit="%", goal=Goal(high=3.0)),
    "torque_worst_pct": Figure(unit="%", goal=Goal(high=10.0)),
    "box_score": Figure(unit="", goal=Goal(low=1.0)),
    "box_slip_mm": Figure(unit="mm", goal=Goal(high=0.2)),
    "box_slip_deg": Figure(unit="deg", goal=Goal(high=0.5)),
    "light_convergence_share": Figure(unit="", goal=Goal(low=0.97)),
    "suite_checks_failed": Figure(unit="", goal=Goal(high=0.0)),
    "fast_agree_share": Figure(unit="", goal=Goal(low=0.96)),
    "sure_agree_share": Figure(unit="", goal=Goal(low=0.98)),
    "engines_agree_share": Figure(unit="", goal=Goal(low=0.95)),
    "engines_agree_marginal_share": Figure(unit="", goal=Goal(low=0.87)),
    "reference_agree_share": Figure(unit="", goal=Goal(low=0.95)),
    "marginal_dropped_share": Figure(unit="", goal=Goal(low=0.20, high=0.45)),
    "marginal_speed_dropped_share": Figure(unit="", goal=Goal(low=0.20, high=0.45)),
    "acronym_balacc": Figure(unit=""),
    "rank_margin_score": Figure(unit=""),
    "rank_margin_closure": Figure(unit=""),
    "rank_score_closure": Figure(unit=""),
    "workers_scaling": Figure(unit="x"),
    "ray_nodes_scaling": Figure(unit="x"),
}


def part(where: str) -> Callable[[argparse.Namespace], Found]:
    """Return a part, "module:function", that finds its objects cut into convex parts."""

    def measure(given: argparse.Namespace) -> Found:
        cut_shapes(given.keep, given.quick)
        module, function = where.split(":")
        return getattr(import_module(module), function)(given.seed, given.keep, given.quick)

    return measure


PARTS = {
    "speed": part("school_speed:speed"),
    "steps": part("school_speed:first_steps"),
    "validation": part("school_validation:validation"),
    "agreement": part("school_agreement:agreement"),
    "reference": "school_agreement:reference",
    "margins": part("school_agreement:margins"),
    "acronym": part("school_acronym:acronym"),
    "scaling": part("school_scaling:scaling"),
}


def extrapolate(found: Found) -> None:
    """Note how long the paper's data set would take."""
    from school_scaling import extrapolation

    found.notes += extrapolation(found.figures)


if __name__ == "__main__":
    packages = ("realsim", "numpy", "scipy", "numba", "pybullet", "mujoco", "coacd", "ray")
    run("school", __doc__, packages, FIGURES, PARTS, seed=100, options=keep_option, end=extrapolate)
