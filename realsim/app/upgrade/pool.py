"""Scenes upgraded by processes or machines: one that breaks or is killed harms no other."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from realsim.app.console import Console
from realsim.app.upgrade.dataset import SceneJob
from realsim.app.upgrade.scene import Record, read_source, upgrade_scene
from realsim.many import Outcome, Sent, Task, Worked, Workers, at_most, open_pool, run_many


def upgrade_scenes(
    jobs: Sequence[SceneJob], where: Workers, console: Console, done: dict[str, Record]
) -> dict[str, str]:
    """Upgrade scenes, as many at a time as there are workers.

    A scene with broken input ends with its reason. A scene whose process was killed is gone on
    with, from the stage where it was; what its stages had finished is not done again.

    Args:
        jobs: the scenes; those of an earlier run took no time of this one.
        where: who upgrades them.
        console: shows how many have ended, with the remaining time and those under way.
        done: place of a scene -> what came of it; those that end well are added.

    Returns:
        Place of a scene -> why it was left out.

    Raises:
        StorageError: the disk is full.
        ClusterLostError: the cluster's head is gone.
    """
    failed: dict[str, str] = {}
    ended = 0
    under_way: Sequence[str] = ()

    def show(names: Sequence[str]) -> None:
        nonlocal under_way
        under_way = names
        console.doing(", ".join(names))
        tick(ended, len(jobs))

    def take(outcome: Outcome) -> None:
        nonlocal ended
        ended += 1
        place = outcome.task.name
        show([name for name in under_way if name != place])
        if outcome.value is not None:
            done[place] = outcome.value
            return
        again = ". Run the same again with fewer --workers." if outcome.deaths else ""
        failed[place] = outcome.why + again
        console.say(f"scene {place} is left out: {failed[place]}")

    with console.stage("upgrade", "scenes") as tick, open_pool(at_most(where, len(jobs))) as pool:
        run_many(map(_task, jobs), pool, take, tick=show)
    return failed


def _task(job: SceneJob) -> Task:
    """Return the task of a scene: what it reads of the data set, and the folder that it fills."""
    ref = job.ref
    scene = ref.folder.relative_to(ref.root)
    # Of the scene's folder and those above it; models and labels are the data set's.
    only = [f"{scene}/*" if scene.parts else "*", f"keyframe_poses/{job.config.start}/*"]
    only += [
        p.relative_to(ref.root).as_posix()
        for above in ref.folder.parents
        if above == ref.root or ref.root in above.parents
        for p in above.iterdir()
        if p.is_file()
    ]
    only += job.labels if job.config.analytic else ()
    root = Sent(ref.root, only=tuple(only))
    models = Sent(ref.models) if ref.models.is_dir() else None
    out = Worked(job.out, only=(f"{ref.place}/*", "grasp_label/*"))
    return Task(name=ref.place, fn=upgraded, args=(out, job, root, models))


def upgraded(out: Path, job: SceneJob, root: Path, models: Path | None) -> Record:
    """Upgrade a scene quietly.

    Args:
        out: folder of the whole upgrade.
        job: the scene.
        root: folder of the data set.
        models: folder of the models, if there is one.
    """
    ref = job.ref
    folder = root / ref.folder.relative_to(ref.root)
    at = replace(ref, root=root, folder=folder, models=models or ref.models)
    job = replace(job, out=out, at=at)
    return upgrade_scene(job, read_source(job), None)
