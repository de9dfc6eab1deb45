"""How margin, score and analytic quality rank the same grasps.

At 70 N and friction 1 most grasps pass, so the score has many ties; the margin, from the least
friction and the least force that a grasp survives, has few.
"""

from pathlib import Path

import numpy as np
from figures import Found
from school_cases import candidate_config, school_case
from school_conditions import slip_config
from school_processes import spent

from realsim.formats.grasps.scene_grasps import executed
from realsim_sim_bridge.school.config import SchoolConfig
from realsim_sim_bridge.school.measure_statistics import closure_confusions, rank_correlations
from realsim_sim_bridge.school.school import run_school
from realsim_sim_bridge.school.sweep import SweepConfig

ENGINE = "mujoco"
"""The fast one: a margin takes nine slip tests."""
FULL, QUICK = 42, 3
"""Candidates per object."""
KEYS = {
    ("score", "margin"): "rank_margin_score",
    ("margin", "ferrari_canny"): "rank_margin_closure",
    ("score", "ferrari_canny"): "rank_score_closure",
    ("margin", "closure_friction"): "rank_margin_closure_friction",
    ("score", "closure_friction"): "rank_score_closure_friction",
}


def margins(seed: int, keep: Path, quick: bool) -> Found:
    """Return the rank correlations with their intervals."""
    case = school_case(seed, keep, quick)
    config = SchoolConfig(
        seed=seed,
        max_candidates=QUICK if quick else FULL,
        candidates=candidate_config(quick),
        slip=slip_config(ENGINE, "plain", 1.0),
        sweep=SweepConfig(),
    )
    with spent() as cost:
        sets = run_school(case.scene, case.models, config, workers=2, solids=case.solids)
    # What the arm does not reach has no margin, which may be all of an object.
    swept = [s for s in sets if "margin" in s.measures]
    tried = sum(int(executed(s).sum()) for s in swept)
    found = Found()
    for c in rank_correlations(sets, np.random.default_rng([seed, 3])):
        key = KEYS.get((c.first, c.second))
        if key is not None:
            found.add(key, c.rho, f"Spearman, [{c.low:.2f}, {c.high:.2f}] of {c.grasps} grasps")
    scores = np.concatenate([s.scores[executed(s)] for s in swept])
    margin = np.concatenate([s.measures["margin"][executed(s)] for s in swept])
    found.notes.append(
        f"margins: {tried} grasps, {1e3 * cost.cpu_s / tried:.0f} CPU ms each; "
        f"{len(np.unique(scores))} different scores ({100 * np.mean(scores >= 1):.0f} % are 1), "
        f"{len(np.unique(margin))} different margins, of those with score 1 from "
        f"{margin[scores >= 1].min(initial=1):.2f} to {margin[scores >= 1].max(initial=0):.2f}"
    )
    for confusion in closure_confusions(sets):
        found.notes.append(
            f"margins: {confusion.closure} tells a score of 0.5 or more with a balanced accuracy "
            f"of {confusion.balanced_accuracy:.2f} ({confusion.grasps} grasps)"
        )
    return found
