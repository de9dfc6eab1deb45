"""How fast the school is: the whole chain in a scene of ten objects.

A grasp counts when physics has tried it; candidates that the arm does not reach cost time and do
not count. Rates are of CPU seconds, children included: two processes on two cores do

    grasps/s = 2 * grasps / CPU seconds,

which is what the clock shows on an idle machine. Starting two processes costs some seconds once,
whatever they do then; that is measured by a school of two small boxes and taken off.
"""

import time
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from figures import Found
from school_cases import (
    MARGINAL_DENSITY,
    PROCESSES,
    SchoolCase,
    Spent,
    candidate_config,
    in_processes,
    school_case,
    slip_config,
    spent,
    tasks_of,
    two_boxes,
)

from realsim.formats.grasps.scene_grasps import executed
from realsim.robots.hand import find_hand
from realsim_sim_bridge.arm.reach_config import ReachConfig, chosen_arm
from realsim_sim_bridge.school.config import SchoolConfig
from realsim_sim_bridge.school.object_task import candidates_of, chance_of, reach_of
from realsim_sim_bridge.school.school import run_school
from realsim_sim_bridge.slip.slip_test import SlipConfig


@dataclass(frozen=True, kw_only=True, slots=True)
class Size:
    """How much is run."""

    seed: int
    keep: Path
    quick: bool
    candidates: dict[str, int]
    """Per object: of 'pybullet', 'mujoco' and 'marginal'."""

    def config(self, name: str, slip: SlipConfig) -> SchoolConfig:
        """Return the school's configuration with so many candidates per object."""
        return SchoolConfig(
            seed=self.seed,
            max_candidates=self.candidates[name],
            candidates=candidate_config(self.quick),
            slip=slip,
        )


FULL = {"pybullet": 40, "mujoco": 120, "marginal": 60}
QUICK = {"pybullet": 3, "mujoco": 12, "marginal": 6}


def speed(seed: int, keep: Path, quick: bool) -> Found:
    """Return the rates of both engines."""
    size = Size(seed=seed, keep=keep, quick=quick, candidates=QUICK if quick else FULL)
    case = school_case(seed, keep, quick)
    found = Found()
    start = _started(size)
    for engine in ("mujoco", "pybullet"):
        found.take(_chain(engine, case, size, start))
    found.take(_marginal(case, size))
    return found


# --- the whole chain ---------------------------------------------------------------------------


def _started(size: Size) -> Spent:
    """Return what two processes cost before they do anything of note."""
    boxes = two_boxes()
    config = replace(size.config("mujoco", slip_config("mujoco", "plain", 1.0)), max_candidates=2)
    with spent() as cost:
        run_school(boxes.scene, boxes.models, config, workers=PROCESSES, solids=boxes.solids)
    return cost


def pair_rate(seed: int, keep: Path, quick: bool, arm: str, hand: str) -> tuple[float, str]:
    """Return how many grasps of an arm with a hand MuJoCo tries a second, and what it was of."""
    size = Size(seed=seed, keep=keep, quick=quick, candidates=QUICK if quick else FULL)
    robot = {"hand": find_hand(hand), "reach": ReachConfig(arm=chosen_arm(arm))}
    found = _chain("mujoco", school_case(seed, keep, quick), size, _started(size), **robot)
    return found.figures["mujoco_grasps_per_s"], found.over["mujoco_grasps_per_s"]


def _chain(engine: str, case: SchoolCase, size: Size, start: Spent, **robot: Any) -> Found:
    """Return the rate at 70 N and friction 1, two processes in one scene."""
    slip = slip_config(engine, "plain", 1.0)
    with spent() as cost:
        sets = run_school(
            case.scene, case.models, replace(size.config(engine, slip), **robot), workers=PROCESSES,
            solids=case.solids,
        )  # fmt: skip
    tried = sum(int(executed(s).sum()) for s in sets)
    candidates = sum(len(s) for s in sets)
    passed = np.mean(np.concatenate([s.scores[executed(s)] >= 1.0 for s in sets]))
    cpu_s = max(cost.cpu_s - start.cpu_s, 1e-9)
    short = "bullet" if engine == "pybullet" else engine
    found = Found()
    found.add(
        f"{short}_grasps_per_s",
        PROCESSES * tried / cpu_s,
        f"{tried} grasps of {candidates} candidates, {1e3 * cpu_s / tried:.0f} CPU ms each; "
        f"{100 * passed:.0f} % passed",
    )
    found.add(f"{short}_candidates_judged_per_s", PROCESSES * candidates / cpu_s)
    found.cases[f"{engine} chain"] = {
        "cpu_s": cost.cpu_s,
        "start_cpu_s": start.cpu_s,
        "wall_s": cost.wall_s,
        "tried": tried,
        "candidates": candidates,
    }
    return found


@dataclass(frozen=True, kw_only=True, slots=True)
class _Tried:
    """What one object in the marginal condition cost."""

    cpu_s: float
    tried: int
    dropped: int
    passed: int


def _marginal(case: SchoolCase, size: Size) -> Found:
    """Return MuJoCo's rate where many grasps slip: each object with a force of its own."""
    jobs = [(size, o.instance) for o in case.scene.objects]
    with spent() as cost:
        rows = in_processes(marginal_object, jobs)
    tried, cpu_s = sum(r.tried for r in rows), sum(r.cpu_s for r in rows)
    dropped = sum(r.dropped for r in rows) / tried
    found = Found()
    found.add(
        "mujoco_marginal_grasps_per_s",
        PROCESSES * tried / cpu_s,
        f"{tried} grasps, {1e3 * cpu_s / tried:.0f} CPU ms each; by the clock, with the start of "
        f"the processes, {tried / cost.wall_s:.3g}/s; "
        f"{100 * sum(r.passed for r in rows) / tried:.0f} % passed",
    )
    found.add(
        "marginal_speed_dropped_share",
        dropped,
        "lost, by MuJoCo under the paper's limits: who slipped 2 cm is not tried further",
    )
    return found


def marginal_object(job: tuple[Size, int]) -> _Tried:
    """Try one object of the scene in this process, the others being obstacles."""
    size, instance = job
    _warm_up()
    case = school_case(size.seed, size.keep, size.quick).of_density(MARGINAL_DENSITY)
    alone = case.alone(instance)
    obj_id = next(o.obj_id for o in case.scene.objects if o.instance == instance)
    slip = slip_config("mujoco", "marginal", case.solids[obj_id].matter.mass_kg)
    begin = time.process_time()
    (found,) = run_school(
        alone.scene, case.models, size.config("marginal", slip), workers=1, solids=case.solids
    )
    cpu_s = time.process_time() - begin
    mine = executed(found)
    lost = np.isinf(found.slip_m).any(axis=1)
    return _Tried(
        cpu_s=cpu_s,
        tried=int(mine.sum()),
        dropped=int(np.sum(mine & lost)),
        passed=int(np.sum(found.scores[mine] >= 1.0)),
    )


@cache
def _warm_up() -> None:
    """Load what is loaded once a process."""
    boxes = two_boxes()
    config = SchoolConfig(max_candidates=2, slip=slip_config("mujoco", "plain", 1.0))
    run_school(boxes.scene, boxes.models, config, workers=1, solids=boxes.solids)


# --- How many candidates and how many arm trajectories one core makes per second -----------------
# Candidates are turned hands that are tested for collision with object, neighbours and table; most
# of those that come from below end in the table, which is quickly told, so the others are counted
# too. A plan is the search for one grasp: inverse kinematics, approach, lift, the way there, and
# the joints over time of all four stages where the arm gets there.


PLANNED, PLANNED_QUICK = 220, 120
"""Grasps per object that are planned; the paper has 220."""


def first_steps(seed: int, keep: Path, quick: bool) -> Found:
    """Return how many candidates and plans a core makes per second."""
    return in_processes(_rates, [(seed, keep, quick, "panda")])[0]


def plan_rate(seed: int, keep: Path, quick: bool, arm: str) -> tuple[float, str]:
    """Return how many trajectories of an arm with Franka's hand a core plans a second."""
    found = in_processes(_rates, [(seed, keep, quick, arm)])[0]
    return found.figures["plans_per_s"], found.over["plans_per_s"]


def _rates(job: tuple[int, Path, bool, str]) -> Found:
    """Return both rates of this process, compiled code warm."""
    seed, keep, quick, arm = job
    config = SchoolConfig(
        seed=seed,
        max_candidates=PLANNED_QUICK if quick else PLANNED,
        candidates=candidate_config(quick),
        reach=ReachConfig(arm=chosen_arm(arm)),
    )
    _stepped(two_boxes(), config, objects=1)
    found = Found()
    total = _stepped(school_case(seed, keep, quick), config)
    turned, above = total["turned"], total["turned"] - total["hand_in_table"]
    sample_s = total["sample_s"]
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
        total["plans"] / total["plan_s"],
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
