"""How fast the school is: the whole chain in a scene of ten objects, and its first two steps alone.

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

import numpy as np
from school_cases import SchoolCase, cut_shape, school_case, shapes_by_time, tasks_of
from school_conditions import (
    MARGINAL_DENSITY,
    slip_config,
)
from school_figures import Found
from school_processes import in_processes, spent

from realsim.formats.scene_grasps import executed
from realsim.geometry import se3
from realsim.geometry.parts import part
from realsim.records import ObjectPose, Scene, SupportPlane
from realsim_sim_bridge.arm.reach import ReachTask, check_reach
from realsim_sim_bridge.grasping.candidate_config import CandidateConfig
from realsim_sim_bridge.grasping.candidates import sample_candidates
from realsim_sim_bridge.grasping.surroundings import standing_object
from realsim_sim_bridge.school.config import SchoolConfig
from realsim_sim_bridge.school.school import run_school
from realsim_sim_bridge.slip.slip_test import SlipConfig

PROCESSES = 2
FEW_POINTS = 250
"""Surface points of the short run, which has a tenth of the grasps."""


@dataclass(frozen=True, kw_only=True, slots=True)
class Size:
    """How much is run."""

    seed: int
    keep: Path
    quick: bool
    candidates: dict[str, int]
    """Per object: of 'pybullet', 'mujoco', 'marginal' and 'plans'."""

    def config(self, name: str, slip: SlipConfig | None = None) -> SchoolConfig:
        """Return the school's configuration with so many candidates per object."""
        points = CandidateConfig(surface_points=FEW_POINTS) if self.quick else CandidateConfig()
        return SchoolConfig(
            seed=self.seed,
            max_candidates=self.candidates[name],
            candidates=points,
            slip=slip or SlipConfig(),
        )


FULL = {"pybullet": 40, "mujoco": 120, "marginal": 60, "plans": 200}
QUICK = {"pybullet": 4, "mujoco": 16, "marginal": 10, "plans": 60}


def speed(seed: int, keep: Path, quick: bool) -> Found:
    """Return all rates."""
    size = Size(seed=seed, keep=keep, quick=quick, candidates=QUICK if quick else FULL)
    in_processes(cut_shape, [(name, keep) for name in shapes_by_time(quick)], PROCESSES)
    case = school_case(seed, keep, quick)
    found = Found()
    counts = case.parts()
    within = sum(16 <= n <= 32 for n in counts.values())
    words = ", ".join(f"{name} {n}" for name, n in counts.items())
    found.notes.append(
        f"speed: {len(case.scene.objects)} objects; convex parts: {words} "
        f"({within} of {len(counts)} kinds have 16 to 32)"
    )
    for engine in ("mujoco", "pybullet"):
        found.take(_chain(engine, case, size))
    found.take(_marginal(case, size))
    found.take(in_processes(first_steps, [size], 1)[0])
    return found


# --- the whole chain ---------------------------------------------------------------------------


def _chain(engine: str, case: SchoolCase, size: Size) -> Found:
    """Return the rate at 70 N and friction 1, two processes in one scene."""
    slip = slip_config(engine, "plain", 1.0)
    with spent() as start:
        boxes = _two_boxes()
        run_school(
            boxes.scene,
            boxes.models,
            replace(size.config(engine, slip), max_candidates=2),
            workers=PROCESSES,
            solids=boxes.solids,
        )
    with spent() as cost:
        sets = run_school(
            case.scene,
            case.models,
            size.config(engine, slip),
            workers=PROCESSES,
            solids=case.solids,
        )
    tried = sum(int(executed(s).sum()) for s in sets)
    candidates = sum(len(s) for s in sets)
    passed = np.mean(np.concatenate([s.scores[executed(s)] >= 1.0 for s in sets]))
    cpu_s = max(cost.cpu_s - start.cpu_s, 1e-9)
    wall_s = max(cost.wall_s - start.wall_s, 1e-9)
    short = "bullet" if engine == "pybullet" else engine
    found = Found()
    found.add(
        f"{short}_grasps_per_s",
        PROCESSES * tried / cpu_s,
        f"{tried} grasps of {candidates} candidates, {1e3 * cpu_s / tried:.0f} CPU ms each; by "
        f"the clock {tried / wall_s:.3g}/s; {100 * passed:.0f} % passed",
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


def _two_boxes() -> SchoolCase:
    """Return two cubes on a table, for whatever has to be done once."""
    from realsim.models.convex import ConvexConfig, convex_parts
    from realsim.models.library_records import KnownSolid
    from realsim.models.properties import physical_properties

    model = part("cube")
    height = float(model.mesh.extent[2]) / 2
    parts = convex_parts(model.mesh, ConvexConfig())
    matter = physical_properties(model.mesh, density=model.density)
    objects = tuple(
        ObjectPose(
            obj_id=model.obj_id,
            instance=k,
            T_world_obj=se3.from_translation([0.2 * k, 0.0, height]),
        )
        for k in range(2)
    )
    return SchoolCase(
        scene=Scene(name="boxes", objects=objects, plane=SupportPlane(T_world_table=np.eye(4))),
        models={model.obj_id: model},
        solids={model.obj_id: KnownSolid(parts=parts, matter=matter)},
    )


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
        rows = in_processes(marginal_object, jobs, PROCESSES)
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
    boxes = _two_boxes()
    config = SchoolConfig(max_candidates=2, slip=slip_config("mujoco", "plain", 1.0))
    run_school(boxes.scene, boxes.models, config, workers=1, solids=boxes.solids)


# --- its first steps ---------------------------------------------------------------------------


def first_steps(size: Size) -> Found:
    """Return how many candidates and plans a core makes per second."""
    boxes = _two_boxes()
    config = size.config("plans")
    _stepped(boxes, config, objects=1)
    found = Found()
    total = _stepped(school_case(size.seed, size.keep, size.quick), config)
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


def _stepped(case: SchoolCase, config: SchoolConfig, objects: int | None = None) -> dict[str, float]:
    """Return counts and CPU seconds of sampling and planning over the objects of a scene."""
    total: dict[str, float] = {}
    for task in tasks_of(case, config)[:objects]:
        rng = np.random.default_rng([config.seed, task.instance])
        begin = time.process_time()
        found = sample_candidates(
            task.mesh,
            task.T_table_obj,
            task.neighbours,
            config.candidates,
            config.hand,
            rng,
            config.max_candidates,
        )
        sampled = time.process_time()
        reach = check_reach(
            ReachTask(
                Ts_table_grasp=task.T_table_obj @ found.Ts_obj_grasp,
                widths_m=found.widths_m,
                openings_m=found.openings_m,
                obj=standing_object(
                    task.mesh, task.T_table_obj, task.instance, config.candidates.object_points
                ),
                neighbours=task.neighbours,
                middle_xy=task.middle_xy,
            ),
            config.reach,
            config.hand,
            rng,
            config.slip.motion,
        )
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
