"""How many candidates and how many arm trajectories one core makes per second.

Candidates are turned hands that are tested for collision with object, neighbours and table; most of
those that come from below end in the table, which is quickly told, so the others are counted too.
A plan is the search for one grasp: inverse kinematics, approach, lift, the way there, and the
joints over time of all four stages where the arm gets there.
"""

import time
from pathlib import Path

from figures import Found
from school_cases import SchoolCase, candidate_config, school_case, tasks_of, two_boxes
from school_processes import in_processes

from realsim_sim_bridge.school.config import SchoolConfig
from realsim_sim_bridge.school.object_task import candidates_of, chance_of, reach_of

FULL, QUICK = 220, 120
"""Grasps per object that are planned; the paper has 220."""


def first_steps(seed: int, keep: Path, quick: bool) -> Found:
    """Return how many candidates and plans a core makes per second."""
    return in_processes(_rates, [(seed, keep, quick)])[0]


def _rates(job: tuple[int, Path, bool]) -> Found:
    """Return both rates of this process, compiled code warm."""
    seed, keep, quick = job
    config = SchoolConfig(
        seed=seed,
        max_candidates=QUICK if quick else FULL,
        candidates=candidate_config(quick),
    )
    _stepped(two_boxes(), config, objects=1)
    found = Found()
    total = _stepped(school_case(seed, keep, quick), config)
    turned, above = total["turned"], total["turned"] - total["hand_in_table"]
    sample_s, plan_s = total["sample_s"], total["plan_s"]
    found.add(
        "candidates_per_s",
        turned / sample_s,
        f"all {turned:.0f} turned hands; {total['pairs']:.0f} antipodal pairs",
    )
    found.add(
        "candidates_above_table_per_s",
        above / sample_s,
        f"the {above:.0f} that are not stopped by the table; {total['free']:.0f} are free",
    )
    found.add(
        "plans_per_s",
        total["plans"] / plan_s,
        f"{total['plans']:.0f} grasps, {total['reachable']:.0f} reached, with joints over time; "
        f"{total['planned']:.0f} round obstacles",
    )
    return found


def _stepped(
    case: SchoolCase, config: SchoolConfig, objects: int | None = None
) -> dict[str, float]:
    """Return counts and CPU seconds of sampling and planning over the objects of a scene."""
    total: dict[str, float] = {}
    for task in tasks_of(case, config)[:objects]:
        rng = chance_of(task)
        begin = time.process_time()
        found = candidates_of(task, rng)
        sampled = time.process_time()
        reach = reach_of(task, found, rng)
        planned = time.process_time()
        counts = {
            "sample_s": sampled - begin,
            "plan_s": planned - sampled,
            "turned": found.counts["turned"],
            "hand_in_table": found.counts["hand_in_table"],
            "free": found.counts["free"],
            "pairs": found.counts["antipodal_pairs"],
            "plans": len(found.widths_m),
            "reachable": int(reach.reachable.sum()),
            "planned": reach.planned,
        }
        total = {k: total.get(k, 0.0) + v for k, v in counts.items()}
    return total
