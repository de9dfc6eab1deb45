"""Robot School: every object of a registered scene, every grasp, through reach and slip test."""

from collections.abc import Callable, Mapping
from concurrent.futures import FIRST_COMPLETED, Executor, Future, wait
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from realsim.errors import InputError
from realsim.geometry import se3
from realsim.models.library_records import KnownSolid
from realsim.records import GraspSet, Mesh, ObjectModel, Scene, names_of
from realsim.store.arrays_on_disk import is_whole
from realsim_sim_bridge.grasping.candidates import Surroundings
from realsim_sim_bridge.school.config import SchoolConfig
from realsim_sim_bridge.school.kept_sets import read_grasp_set, write_grasp_set
from realsim_sim_bridge.school.object_slips import grasp_set_of, rows_path, slips_of_rows
from realsim_sim_bridge.school.object_task import ObjectTask, Prepared, prepare, surface_points
from realsim_sim_bridge.slip.slip_test import Slips, batches
from realsim_sim_bridge.school.workers import executor

Progress = Callable[[int, int], None]


def run_school(
    scene: Scene,
    models: Mapping[int, ObjectModel],
    config: SchoolConfig | None = None,
    *,
    workers: int = 2,
    cache: Path | None = None,
    progress: Progress | None = None,
    solids: Mapping[int, KnownSolid] | None = None,
) -> list[GraspSet]:
    """Return the scored grasps of every object whose pose was not rejected.

    A rejected object is not grasped, but stays an obstacle: something stands there. Every finished
    piece of work is kept in `cache` under a hash of all it depends on; running the same again after
    a crash goes on from there.

    Args:
        scene: the registered scene; its plane is the table, its normal is up.
        models: the objects by id.
        config: everything the scores depend on.
        workers: processes; 1 = this one. More need the caller's script to guard its start with
            `if __name__ == "__main__"`.
        cache: folder for results, or None to keep nothing.
        progress: called with (grasps judged, grasps expected).
        solids: convex parts and matter by object id, as a model library knows them; of other
            objects they are computed from the mesh.

    Raises:
        InputError: the scene has no plane, or an object without a model.
    """
    tasks = object_tasks(scene, models, config or SchoolConfig(), cache, solids)
    pupils = [_Pupil(task) for task in tasks]
    with executor(workers) as pool:
        _Day(pool, pupils, progress).run()
    return [pupil.result() for pupil in pupils]


def object_tasks(
    scene: Scene,
    models: Mapping[int, ObjectModel],
    config: SchoolConfig,
    cache: Path | None,
    solids: Mapping[int, KnownSolid] | None = None,
) -> list[ObjectTask]:
    """Return the task of every object that is tried.

    Raises:
        InputError: the scene has no plane, or an object without a model.
    """
    if scene.plane is None:
        raise InputError(
            f"scene '{scene.name}' has no supporting plane, so neither the table nor up is known; "
            "register the scene with one, or give plane=SupportPlane(T_world_table=...)."
        )
    for obj in scene.objects:
        if obj.obj_id not in models:
            raise InputError(
                f"object {obj.obj_id} of scene '{scene.name}' has no model; there are: "
                f"{names_of(list(models.values()))}."
            )
    T_table_world = se3.invert(scene.plane.T_world_table)
    Ts = {o.instance: T_table_world @ o.T_world_obj for o in scene.objects}
    count = config.candidates.object_points
    surfaces = {
        o.instance: surface_points(models[o.obj_id].mesh, Ts[o.instance], o.instance, count)
        for o in scene.objects
    }
    middle = np.mean([T[:2, 3] for T in Ts.values()], axis=0) if Ts else np.zeros(2)
    tasks: list[ObjectTask] = []
    for obj in scene.objects:
        if obj.verdict == "rejected":
            continue
        model = models[obj.obj_id]
        tasks.append(
            ObjectTask(
                obj_id=obj.obj_id,
                instance=obj.instance,
                name=model.name,
                mesh=Mesh(vertices=model.mesh.vertices, faces=model.mesh.faces),
                density=model.density,
                T_table_obj=Ts[obj.instance],
                neighbours=_together([s for i, s in surfaces.items() if i != obj.instance]),
                middle_xy=(float(middle[0]), float(middle[1])),
                config=config,
                cache=cache,
                solid=(solids or {}).get(obj.obj_id),
            )
        )
    return tasks


def _together(surfaces: list[Surroundings]) -> Surroundings:
    """Return the points of all surfaces."""
    nothing = Surroundings()
    return Surroundings(
        points=np.concatenate([nothing.points, *(s.points for s in surfaces)]),
        instances=np.concatenate([nothing.instances, *(s.instances for s in surfaces)]),
    )


@dataclass(eq=False, slots=True)
class _Pupil:
    """One object on its way through the school."""

    task: ObjectTask
    grasp_set: GraspSet | None = None
    prepared: Prepared | None = None
    slips: list[tuple[NDArray[np.int64], Slips]] = field(
        default_factory=list[tuple[NDArray[np.int64], Slips]]
    )
    open_jobs: int = 0

    def __post_init__(self) -> None:
        """Take the finished set from the cache if it is there."""
        path = self.task.path("grasps")
        if path is not None and is_whole(path):
            self.grasp_set = read_grasp_set(path)

    @property
    def judged(self) -> int:
        """How many grasps are done."""
        if self.grasp_set is not None:
            return len(self.grasp_set)
        if self.prepared is None:
            return 0
        n, tested = len(self.prepared.widths_m), len(self.prepared.tested)
        return n - tested + sum(len(rows) for rows, _ in self.slips)

    @property
    def expected(self) -> int:
        """How many there will be, as far as it is known."""
        if self.grasp_set is not None:
            return len(self.grasp_set)
        if self.prepared is None:
            return self.task.config.max_candidates
        return len(self.prepared.widths_m)

    def finish(self) -> None:
        """Put the set together, keep it, and drop the pieces it was made of."""
        assert self.prepared is not None, "a pupil finishes after its preparation"
        self.grasp_set = grasp_set_of(self.task, self.prepared, self.slips)
        path = self.task.path("grasps")
        if path is None:
            return
        write_grasp_set(path, self.grasp_set)
        pieces = [self.task.path("prepared"), *(rows_path(self.task, r) for r, _ in self.slips)]
        for piece in pieces:
            if piece is not None:
                piece.unlink(missing_ok=True)

    def result(self) -> GraspSet:
        """Return the finished set."""
        assert self.grasp_set is not None, "the day ends when all sets are finished"
        return self.grasp_set


class _Day:
    """Hands out the jobs: first each object's preparation, then its grasps in worlds' worth."""

    def __init__(self, pool: Executor, pupils: list[_Pupil], progress: Progress | None) -> None:
        self._pool, self._pupils, self._progress = pool, pupils, progress
        self._jobs: dict[Future[Any], tuple[_Pupil, NDArray[np.int64] | None]] = {}

    def run(self) -> None:
        """Work until every pupil has its set."""
        for pupil in self._pupils:
            if pupil.grasp_set is None:
                self._jobs[self._pool.submit(prepare, pupil.task)] = (pupil, None)
        self._report()
        while self._jobs:
            done, _ = wait(self._jobs, return_when=FIRST_COMPLETED)
            for future in done:
                pupil, rows = self._jobs.pop(future)
                if rows is None:
                    self._hand_out(pupil, future.result())
                else:
                    pupil.slips.append((rows, future.result()))
                    pupil.open_jobs -= 1
                if pupil.open_jobs == 0:
                    pupil.finish()
            self._report()

    def _hand_out(self, pupil: _Pupil, prepared: Prepared) -> None:
        """Submit the slip tests of a prepared object."""
        pupil.prepared = prepared
        size = pupil.task.config.slip.pairs_per_world
        for part in batches(len(prepared.tested), size):
            rows = prepared.tested[part]
            job = self._pool.submit(slips_of_rows, pupil.task, prepared, rows)
            self._jobs[job] = (pupil, rows)
            pupil.open_jobs += 1

    def _report(self) -> None:
        """Tell how many grasps are judged."""
        if self._progress is not None:
            judged = sum(pupil.judged for pupil in self._pupils)
            self._progress(judged, sum(pupil.expected for pupil in self._pupils))
