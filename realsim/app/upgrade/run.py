"""Upgrade a data set: find the table, refine the poses, try grasps, write labels and pictures.

The data set itself is only read. Every scene becomes a session (which is a BOP scene) under
OUT/SPLIT/SCENE, so that all later commands (`realsim review`, `realsim report`) work on it; what
the data set said of it goes along in OUT/SPLIT/SCENE/imported.

Scenes upgraded by processes or machines: one that breaks or is killed harms no other.
"""

import contextlib
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from realsim.app.console import Console
from realsim.app.outputs import require_outside, require_writable
from realsim.app.register.from_review import REVIEW_FILE
from realsim.app.upgrade import files
from realsim.app.upgrade.analytic import agreement_of, all_sets
from realsim.app.upgrade.dataset import SceneJob, SceneRef, UpgradeConfig, scenes_of
from realsim.app.upgrade.scene import Record, read_source, upgrade_scene
from realsim.app.upgrade.tables import show_upgrade, write_tables
from realsim.errors import InputError
from realsim.many import Outcome, Sent, Task, Worked, Workers, at_most, open_pool, run_many
from realsim.review.journal import JOURNAL_FILE
from realsim.store.atomic import only_run_in


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


__all__ = ["UpgradeConfig", "UpgradeResult", "run_upgrade", "show_upgrade"]


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class UpgradeResult:
    """All scenes of an upgrade."""

    out: Path
    scenes: list[Record]
    """What came of each scene that was asked for, in their order."""
    failed: dict[str, str]
    """Place of a scene -> why it was left out."""
    skipped: int
    """Scenes that an earlier run had finished with the same inputs."""
    analytic: Record | None
    """How the School's scores and the analytic labels of all scenes go together."""


def run_upgrade(config: UpgradeConfig, dataset: Path, out: Path, console: Console) -> UpgradeResult:
    """Upgrade the scenes of a BOP or GraspNet data set into `out`.

    Raises:
        InputError: no data set, no such scene, unwritable or foreign output, another run working
            there, or broken content of the only scene (of many, a broken one is left out).
    """
    refs = scenes_of(dataset, config)
    require_outside(out, sorted({r.root.resolve() for r in refs}))
    _refuse_what_cannot_be_written(out)
    files.require_one_data_set(out, refs)
    done: dict[str, Record] = {}
    todo: list[SceneRef] = []
    for ref in refs:
        record = files.finished_record(out / ref.place, files.key_of(ref, config))
        if record is None:
            if (out / ref.place / REVIEW_FILE).is_file():
                raise InputError(
                    f"{out / ref.place} was registered from its review, which an upgrade with "
                    "other options would undo. Give the options of before, or another --out."
                )
            todo.append(ref)
        else:
            done[ref.place] = record
    skipped = len(done)
    if skipped:
        console.say(f"{skipped} of {len(refs)} scenes are upgraded already, with the same inputs")
    if again := sum((out / ref.place / files.NOTE).is_file() for ref in todo):
        console.warn(f"options or inputs have changed: {again} of {len(refs)} scenes are done anew")
    if reviewed := [ref.place for ref in todo if (out / ref.place / JOURNAL_FILE).is_file()]:
        shown = ", ".join(reviewed[:4]) + (" ..." if len(reviewed) > 4 else "")
        console.warn(f"{shown} was reviewed: a decision counts on only where its object comes out "
                     "at the same place. Look at it again with `realsim review`.")  # fmt: skip
    failed: dict[str, str] = {}
    with contextlib.ExitStack() as lock:
        if len(refs) == 1 and todo:
            job = _job(todo[0], config, out, config.where)
            done[job.ref.place] = _alone(job, lock, console)
        else:
            out.mkdir(parents=True, exist_ok=True)
            lock.enter_context(only_run_in(out))
            if todo:
                jobs = [_job(ref, config, out, 1) for ref in todo]
                failed = upgrade_scenes(jobs, config.where, console, done)
        if not done:
            _remove_empty(out)
            reasons = "; ".join(f"{place}: {why}" for place, why in list(failed.items())[:3])
            raise InputError(f"none of the {len(refs)} scenes can be used: {reasons}")
        analytic = _write_together(out, failed, console)
    scenes = [done[r.place] for r in refs if r.place in done]
    return UpgradeResult(out=out, scenes=scenes, failed=failed, skipped=skipped, analytic=analytic)


def _job(ref: SceneRef, config: UpgradeConfig, out: Path, workers: Workers) -> SceneJob:
    return SceneJob(
        ref=ref, config=config, out=out, workers=workers, key=files.key_of(ref, config),
        labels=files.labels_of(ref),
    )  # fmt: skip


def _alone(job: SceneJob, lock: contextlib.ExitStack, console: Console) -> Record:
    """Upgrade the only scene in this process; nothing is written before it has been read whole."""
    from threadpoolctl import threadpool_limits

    console.say(f"scene {job.ref.number} ({job.ref.place})")
    with threadpool_limits(limits=1):
        source = read_source(job)
        job.out.mkdir(parents=True, exist_ok=True)
        lock.enter_context(only_run_in(job.out))
        return upgrade_scene(job, source, console)


def _write_together(out: Path, failed: dict[str, str], console: Console) -> Record | None:
    """Write what speaks of all scenes: models, root files, tables and the page.

    Returns:
        How the School's scores and the analytic labels go together.
    """
    from realsim.app.upgrade.tables import write_page

    records = list(files.all_records(out))
    places = [str(r["place"]) for r in records]
    with console.stage("together", f"{len(records)} scenes"):
        if differing := files.gather_models(out, places):
            console.warn(
                f"{', '.join(differing[:4])}{' ...' if len(differing) > 4 else ''}: another model "
                f"than in an earlier scene, which stays in {out}/models. Upgrade all scenes again."
            )
        files.write_root_files(out, places)
        analytic = agreement_of(all_sets(out, places))
        write_tables(out, records, failed, analytic)
        write_page(out, records, failed, analytic)
    return analytic


def _refuse_what_cannot_be_written(out: Path) -> None:
    """Raise if the output folder cannot be made or filled; nothing is left behind."""
    if out.exists() and not out.is_dir():
        raise InputError(f"--out '{out}' is a file; give a folder that may be made or filled.")
    # What a kill left before it wrote anything is folders, and files under temporary names.
    is_empty = not any(p.is_file() and not p.name.startswith(".") for p in out.rglob("*"))
    if not is_empty and not any(out.glob("*/*/session.json")):
        raise InputError(
            f"--out '{out}' is not empty and holds no upgrade. Choose another folder: nothing of "
            "yours is overwritten."
        )
    require_writable(out, "--out")


def _remove_empty(out: Path) -> None:
    """Remove the folders that scenes without a result left empty."""
    for path in sorted(out.rglob("*"), reverse=True):
        if path.is_dir():
            with contextlib.suppress(OSError):
                path.rmdir()
    with contextlib.suppress(OSError):
        out.rmdir()
