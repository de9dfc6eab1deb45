"""Scenes upgraded by processes or machines: one that breaks or is killed harms no other."""

from collections.abc import Callable, Generator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Protocol

from realsim.app.console import Console
from realsim.app.upgrade.scene import Record, SceneJob, read_source, upgrade_scene
from realsim.many import Outcome, Sent, Task, Worked, Workers, at_most, open_pool, run_many


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class SceneEnd:
    """How a scene ended."""

    job: SceneJob
    record: Record | None
    """None = it was left out."""
    error: str = ""
    """Why."""


class Told(Protocol):
    """Called when a scene has ended, with those that are under way."""

    def __call__(self, ended: SceneEnd | None, under_way: Sequence[str]) -> None:
        """Show it."""
        ...


def upgrade_scenes(
    jobs: Sequence[SceneJob], where: Workers, tell: Told, take: Callable[[SceneEnd], None]
) -> None:
    """Upgrade scenes, as many at a time as there are workers, and hand on how each ended.

    A scene with broken input ends with its reason. A scene whose process was killed is gone on
    with, from the stage where it was; what its stages had finished is not done again.

    Raises:
        StorageError: the disk is full.
        ClusterLostError: the cluster's head is gone.
    """
    by = {job.ref.place: job for job in jobs}
    under_way: Sequence[str] = ()

    def tick(names: Sequence[str]) -> None:
        nonlocal under_way
        under_way = names
        tell(None, names)

    def done(outcome: Outcome) -> None:
        why = outcome.why + (". Run the same again with fewer --workers." if outcome.deaths else "")
        end = SceneEnd(job=by[outcome.task.name], record=outcome.value, error=why)
        tell(end, [name for name in under_way if name != outcome.task.name])
        take(end)

    with open_pool(at_most(where, len(jobs))) as pool:
        run_many(map(_task, jobs), pool, done, tick=tick)


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


@contextmanager
def scene_progress(total: int, console: Console) -> Generator[Told]:
    """Show how many scenes have ended, with the remaining time and those under way.

    Args:
        total: scenes to upgrade; those of an earlier run took no time of this one.
        console: where it is shown.
    """
    done = 0
    with console.stage("upgrade", "scenes") as tick:

        def tell(ended: SceneEnd | None, under_way: Sequence[str]) -> None:
            nonlocal done
            done += ended is not None
            console.doing(", ".join(under_way))
            tick(done, total)

        yield tell
