"""Robot School: every object of a registered scene, every grasp, through reach and slip test."""

from collections.abc import Callable, Mapping
from contextlib import ExitStack
from pathlib import Path
from typing import ParamSpec

import numpy as np

from realsim.errors import InputError
from realsim.geometry import se3
from realsim.many import ClusterLostError, Workers, open_pool
from realsim.models.model_records import KnownSolid
from realsim.records import GraspSet, Mesh, ObjectModel, Scene, names_of
from realsim_sim_bridge.grasping.surroundings import standing_object, together
from realsim_sim_bridge.school.cache_folder import (
    Restart,
    SchoolResult,
    folder_of_run,
    mark_finished,
    run_record,
)
from realsim_sim_bridge.school.config import SchoolConfig
from realsim_sim_bridge.school.day import Day, Progress, Pupil, so_far
from realsim_sim_bridge.school.object_task import ObjectTask
from realsim_sim_bridge.school.shards import default_shard_grasps

P = ParamSpec("P")


def run_school_results(  # noqa: PLR0913 - keywords, each with a meaning of its own
    scene: Scene,
    models: Mapping[int, ObjectModel],
    config: SchoolConfig | None = None,
    *,
    workers: Workers = None,
    cache: Path | None = None,
    progress: Progress | None = None,
    solids: Mapping[int, KnownSolid] | None = None,
    restart: Restart = False,
    shard_grasps: int | None = None,
    label_files: Mapping[int, Path] | None = None,
) -> list[SchoolResult]:
    """Return grasps and trajectories of every object whose pose was not rejected.

    A rejected object is not grasped, but stays an obstacle: something stands there. Every finished
    piece of work is kept in `cache`; running the same again after a crash goes on from there. The
    same seed gives the same bytes for any number of workers, on one machine or a cluster of alike
    ones.

    Args:
        scene: the registered scene; its plane is the table, its normal is up.
        models: the objects by id.
        config: everything the scores depend on.
        workers: processes; None = one a core, 1 = this one; or a Ray cluster. More than one need
            the caller's script to guard its start with `if __name__ == "__main__"`.
        cache: folder for this run's results, or None to keep nothing.
        progress: called with (grasps judged, grasps expected).
        solids: convex parts and matter by object id, as a model library knows them; of other
            objects they are computed from the mesh.
        restart: whether to discard the results in `cache` if they are of another run, instead of
            refusing; "finished" = only where that run was finished.
        shard_grasps: most grasps that are tested in one go; None = some seconds' worth. A dead
            worker loses one shard at most.
        label_files: GraspNet's labels by object id, where the config asks for analytic grasps;
            those of other objects are computed.

    Raises:
        InputError: the scene has no plane, or an object without a model; the cache holds a run with
            another config, other versions or other objects, or is in use.
        ClusterLostError: the cluster's head is gone; it says how to go on, likewise
        KeyboardInterrupt: Ctrl-C.
    """
    config = config or SchoolConfig()
    tasks = object_tasks(scene, models, config, cache, solids, label_files)
    size = default_shard_grasps(config) if shard_grasps is None else shard_grasps
    if size < 1:
        raise InputError(f"shard_grasps is {size}; 1 or more grasps in one go are accepted.")
    with ExitStack() as stack:
        if cache is not None:
            record = run_record(tasks, config, size)
            stack.enter_context(folder_of_run(cache, record, restart=restart))
        pupils = [Pupil(task=task, folder=cache, shard_grasps=size) for task in tasks]
        try:
            if any(pupil.result is None for pupil in pupils):
                with open_pool(workers) as pool:
                    Day(pool, pupils, progress).run()
            elif progress is not None:
                progress(*so_far(pupils))
        except KeyboardInterrupt as stop:
            raise type(stop)(f"interrupted {_how_to_go_on(pupils, cache)}") from None
        except ClusterLostError as error:
            lost = str(error).partition(". ")[0]
            raise ClusterLostError(f"{lost} {_how_to_go_on(pupils, cache)}") from None
        results = [_result(pupil) for pupil in pupils]
        if cache is not None and not any(result.unfinished for result in results):
            mark_finished(cache)
    return results


def _grasp_sets(run: Callable[P, list[SchoolResult]]) -> Callable[P, list[GraspSet]]:
    """Return a function of the same arguments that returns the results' grasp sets alone."""

    def run_school(*args: P.args, **kwargs: P.kwargs) -> list[GraspSet]:
        """Return the scored grasps of every object whose pose was not rejected.

        Arguments and errors are those of `run_school_results`.
        """
        return [result.grasp_set for result in run(*args, **kwargs)]

    return run_school


run_school = _grasp_sets(run_school_results)


def _how_to_go_on(pupils: list[Pupil], cache: Path | None) -> str:
    """Return what is left after an interruption."""
    judged, expected = so_far(pupils)
    done = f"after {judged} of {expected} grasps"
    if cache is None:
        return f"{done}; nothing of it is kept, as no cache folder was given."
    return f"{done}; they are kept in {cache}. Run the same again, and it goes on from there."


def _result(pupil: Pupil) -> SchoolResult:
    """Return what became of a pupil."""
    assert pupil.result is not None, "the day ends when all results are there"
    return pupil.result


def object_tasks(
    scene: Scene,
    models: Mapping[int, ObjectModel],
    config: SchoolConfig,
    cache: Path | None,
    solids: Mapping[int, KnownSolid] | None = None,
    label_files: Mapping[int, Path] | None = None,
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
        o.instance: standing_object(models[o.obj_id].mesh, Ts[o.instance], o.instance, count)
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
                neighbours=together([s for i, s in surfaces.items() if i != obj.instance]),
                names=tuple((o.instance, models[o.obj_id].name) for o in scene.objects),
                middle_xy=(float(middle[0]), float(middle[1])),
                config=config,
                cache=cache,
                solid=(solids or {}).get(obj.obj_id),
                covariance=obj.covariance,
                labels_file=(label_files or {}).get(obj.obj_id),
            )
        )
    return tasks
