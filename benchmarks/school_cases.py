"""The scenes of the school's benchmark: ten objects on a table, and grasps that the arm reaches.

Everything depends on the seed alone. Convex parts, which belong to the model library and take
seconds an object, are kept in a folder. Seeds from 100 on are for the published figures, those
below for development.
"""

import argparse
import multiprocessing
import os
import tempfile
import time
from collections.abc import Callable, Generator, Sequence
from concurrent.futures import ProcessPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from typing import TypeVar

import numpy as np
from registration_jobs import die_with_parent
from school_shapes import SHAPES

from realsim.geometry import se3
from realsim.geometry.parts import part
from realsim.models.convex import ConvexConfig, convex_parts
from realsim.models.model_records import KnownSolid
from realsim.models.properties import physical_properties
from realsim.records import ObjectModel, ObjectPose, Scene, SupportPlane
from realsim.registration.simulated import TableLabConfig, scatter_objects
from realsim_sim_bridge.grasping.antipodal import CandidateConfig
from realsim_sim_bridge.school.config import SchoolConfig
from realsim_sim_bridge.school.object_task import ObjectTask, prepare, trial_of
from realsim_sim_bridge.school.school import object_tasks
from realsim_sim_bridge.school.shards import stand_of
from realsim_sim_bridge.slip.engines import settings_of
from realsim_sim_bridge.slip.slip_test import SlipConfig, SlipTrial
from realsim_sim_bridge.slip.world import SlipBody

# --- Fresh processes for the parts of the school's benchmark, and what work costs ----------------
# Fresh ones, because the engines' and Open3D's threads do not survive a fork.


PAPER_GRASPS_PER_S = 100 * 2198 / (7 * 86400)
"""The paper: 100 scenes of 2198 candidates in a week on one RTX 6000."""
PROCESSES = 2
"""Processes of this benchmark, whatever the machine has."""
Job = TypeVar("Job")
Result = TypeVar("Result")


@dataclass(eq=False, kw_only=True, slots=True)
class Spent:
    """What something cost."""

    cpu_s: float = 0.0
    """CPU time of this process and of its children that ended within [s]."""
    wall_s: float = 0.0


@contextmanager
def spent() -> Generator[Spent]:
    """Measure what is done within."""
    cost = Spent()
    cpu, wall = _cpu_seconds(), time.perf_counter()
    try:
        yield cost
    finally:
        cost.cpu_s, cost.wall_s = _cpu_seconds() - cpu, time.perf_counter() - wall


def _cpu_seconds() -> float:
    """Return the CPU time of this process and of its ended children [s]."""
    t = os.times()
    return t.user + t.system + t.children_user + t.children_system


def in_processes(work: Callable[[Job], Result], jobs: Sequence[Job]) -> list[Result]:
    """Return what the work makes of each job, in their order; the first failure is raised.

    The two processes stay for the next call, with all that they have loaded.

    Args:
        work: a function of a module.
        jobs: the dearest first.
    """
    pool = _pool()
    try:
        return list(pool.map(work, jobs))
    except KeyboardInterrupt:
        for process in multiprocessing.active_children():
            process.terminate()
        pool.shutdown(wait=False, cancel_futures=True)
        raise


@cache
def _pool() -> ProcessPoolExecutor:
    """Return this process's pool."""
    context = multiprocessing.get_context("spawn")
    return ProcessPoolExecutor(PROCESSES, mp_context=context, initializer=die_with_parent)


def in_fresh_process(work: Callable[[Job], Result], job: Job) -> Result:
    """Return what the work makes of a job in a process that has done nothing else."""
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(1, mp_context=context, initializer=die_with_parent) as pool:
        return pool.submit(work, job).result()


# --- The two conditions under which the school's benchmark tries grasps --------------------------
# plain       the school's own: 70 N, friction 1, 1000 kg/m^3; almost anything that both fingers
#             touch is held.
# marginal    500 kg/m^3, friction 0.3, and for every object the force at which friction carries
#             a fixed multiple of its weight: a part drops it, as the load is off centre.


CONDITIONS = ("plain", "marginal")
MARGINAL_DENSITY = 500.0
"""[kg/m^3]."""
MARGINAL_FRICTION = 0.3
MARGINAL_FACTOR = 6.0
"""The force is this many weights over the friction, so two fingers carry twelve weights, and the
load's lever drops a third of these objects; with half of it, nearly half."""


def marginal_force_n(mass_kg: float) -> float:
    """Return the force of each finger [N]; never more than the hand's."""
    config = SlipConfig()
    force = MARGINAL_FACTOR * mass_kg * config.motion.gravity / MARGINAL_FRICTION
    return min(force, config.physics.force_n)


def slip_config(
    engine: str, condition: str, mass_kg: float, *, reference: bool = False
) -> SlipConfig:
    """Return the slip test of an object.

    Args:
        engine: 'pybullet' or 'mujoco'.
        condition: one of `CONDITIONS`.
        mass_kg: of the object.
        reference: with the slow settings.
    """
    config = SlipConfig(engine=settings_of(engine, reference=reference))
    if reference:
        config = replace(config, sure=None)
    if condition == "plain":
        return config
    force_n = marginal_force_n(mass_kg)
    physics = replace(config.physics, friction=MARGINAL_FRICTION, force_n=force_n)
    return replace(config, physics=physics)


CONVEX = ConvexConfig(thresholds=(0.05, 0.02), max_parts=32)
"""Cut until nine of the ten kinds have 16 to 32 parts."""
QUICK_KINDS = ("mug", "pipe", "ring")
"""The three objects of the short run."""
LAYOUT = TableLabConfig(disc_m=0.20, gap_m=0.01)
"""A table that is full, but on which fingers fit between the objects."""
FEW_POINTS = 250
"""Surface points of the short run."""
KEEP = Path(tempfile.gettempdir()) / "realsim_school_benchmark"
WIDER_M = 0.01
"""By so much the disc is widened until all objects find room [m]."""


def keep_option(parser: argparse.ArgumentParser) -> None:
    """Add where convex parts are kept."""
    parser.add_argument("--keep", type=Path, default=KEEP, help="folder of convex parts")


@cache
def library(keep: Path, quick: bool) -> dict[int, tuple[ObjectModel, KnownSolid]]:
    """Return the models and their convex parts by object id."""
    found: dict[int, tuple[ObjectModel, KnownSolid]] = {}
    for obj_id, (name, shape) in enumerate(SHAPES.items(), start=1):
        if quick and name not in QUICK_KINDS:
            continue
        model = ObjectModel(obj_id=obj_id, name=name, mesh=shape())
        parts = convex_parts(model.mesh, CONVEX, keep / "convex")
        matter = physical_properties(model.mesh, density=model.density, parts=parts)
        found[obj_id] = (model, KnownSolid(parts=parts, matter=matter))
    return found


@cache
def cut_shapes(keep: Path, quick: bool) -> None:
    """Put all objects' convex parts into the folder, once for all parts and runs."""
    keep.mkdir(parents=True, exist_ok=True)
    in_processes(_cut_shape, [(name, keep) for name in (QUICK_KINDS if quick else SHAPES)])


def _cut_shape(job: tuple[str, Path]) -> None:
    """Put one object's convex parts into the folder."""
    name, keep = job
    convex_parts(SHAPES[name](), CONVEX, keep / "convex")


def candidate_config(quick: bool) -> CandidateConfig:
    """Return how candidates are sampled; the short run has a tenth of the grasps."""
    return CandidateConfig(surface_points=FEW_POINTS) if quick else CandidateConfig()


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class SchoolCase:
    """A scene with everything that the school needs."""

    scene: Scene
    models: dict[int, ObjectModel]
    solids: dict[int, KnownSolid]

    def names(self) -> dict[int, str]:
        """Return the objects' kinds by instance."""
        return {o.instance: self.models[o.obj_id].name for o in self.scene.objects}

    def parts(self) -> dict[str, int]:
        """Return how many convex parts each kind has."""
        return {m.name: len(self.solids[i].parts.parts) for i, m in self.models.items()}

    def alone(self, instance: int) -> "SchoolCase":
        """Return the same scene with one object to be grasped; the others are obstacles."""
        objects = tuple(
            o if o.instance == instance else replace(o, verdict="rejected")
            for o in self.scene.objects
        )
        return replace(self, scene=replace(self.scene, objects=objects))

    def of_density(self, density: float) -> "SchoolCase":
        """Return the same scene with objects of another density [kg/m^3]."""
        models = {i: replace(m, density=density) for i, m in self.models.items()}
        solids = {
            i: replace(
                s, matter=physical_properties(models[i].mesh, density=density, parts=s.parts)
            )
            for i, s in self.solids.items()
        }
        return replace(self, models=models, solids=solids)


def school_case(seed: int, keep: Path, quick: bool) -> SchoolCase:
    """Return ten objects, one of each kind, that stand or lie about on a table."""
    known = library(keep, quick)
    rng = np.random.default_rng([seed, 1])
    ids = list(known)
    config = LAYOUT
    while True:
        put = scatter_objects({i: m.mesh for i, (m, _) in known.items()}, ids, config, rng)
        if not put.left_out:
            break
        config = replace(config, disc_m=config.disc_m + WIDER_M)
    return SchoolCase(
        scene=Scene(
            name=f"seed {seed}", objects=put.objects, plane=SupportPlane(T_world_table=np.eye(4))
        ),
        models={i: m for i, (m, _) in known.items()},
        solids={i: s for i, (_, s) in known.items()},
    )


def tasks_of(case: SchoolCase, config: SchoolConfig) -> list[ObjectTask]:
    """Return the school's own task of every object."""
    return object_tasks(case.scene, case.models, config, None, case.solids)


def two_boxes() -> SchoolCase:
    """Return two cubes on a table, for whatever has to be done once."""
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


# --- grasps without the school around them -----------------------------------------------------


@dataclass(frozen=True, kw_only=True, slots=True)
class TrialKey:
    """Whose grasps."""

    seed: int
    instance: int
    grasps: int
    """At most."""
    keep: Path
    quick: bool


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class NamedTrial:
    """The grasps of one object of the scene that the arm reaches."""

    name: str
    instance: int
    trial: SlipTrial


CANDIDATES_PER_GRASP = 2.5
"""Candidates from which the reachable ones are drawn."""


def reached_trial(key: TrialKey) -> NamedTrial | None:
    """Return grasps of an object that the arm reaches in the scene; None = there is none."""
    case = school_case(key.seed, key.keep, key.quick)
    most = round(CANDIDATES_PER_GRASP * key.grasps)
    config = SchoolConfig(
        seed=key.seed, max_candidates=most, candidates=candidate_config(key.quick)
    )
    task = next(t for t in tasks_of(case, config) if t.instance == key.instance)
    prepared = prepare(task)
    rows = prepared.tested
    if len(rows) == 0:
        return None
    rng = np.random.default_rng([key.seed, 2, key.instance])
    chosen = np.sort(rng.permutation(rows)[: key.grasps])
    # The world's frame is the table's.
    beside = [
        se3.transform(o.T_world_obj, part)
        for o in case.scene.objects
        if o.instance != task.instance
        for part in case.solids[o.obj_id].parts.parts
    ]
    stand = stand_of(config.slip, task.T_table_obj, prepared.body, beside)
    trial = trial_of(task, prepared, chosen, stand)
    return NamedTrial(name=task.name, instance=key.instance, trial=trial)


def of_density(trial: SlipTrial, density: float, now: float = 1000.0) -> SlipTrial:
    """Return the same grasps on an object of another density [kg/m^3]."""
    body, factor = trial.body, density / now
    light = SlipBody(
        parts=body.parts,
        mass_kg=factor * body.mass_kg,
        center_of_mass=body.center_of_mass,
        inertia=factor * body.inertia,
    )
    return replace(trial, body=light)
