"""Scenes upgraded in processes beside this one: one that breaks or is killed harms no other."""

import sys
import time
from collections.abc import Callable, Generator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Protocol

from realsim.app.console import Console
from realsim.app.upgrade.scene import Record, SceneJob, read_source, upgrade_scene
from realsim.errors import RealsimError
from realsim.many import Outcome, Task, open_pool, run_many


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


def upgrade_in_processes(
    jobs: Sequence[SceneJob], processes: int, tell: Told, take: Callable[[SceneEnd], None]
) -> None:
    """Upgrade scenes, so many at a time, and hand on how each ended.

    A scene with broken input ends with its reason. A scene whose process was killed is gone on
    with, from the stage where it was; what its stages had finished is not done again.
    """
    by = {job.ref.place: job for job in jobs}
    under_way: Sequence[str] = ()

    def tick(names: Sequence[str]) -> None:
        nonlocal under_way
        under_way = names
        tell(None, names)

    def done(outcome: Outcome) -> None:
        end = outcome.value
        if outcome.error is not None:
            job, why = by[outcome.task.name], outcome.why
            if outcome.deaths:
                why += ". Run the same again with fewer --workers."
            end = SceneEnd(job=job, record=None, error=why)
        tell(end, [name for name in under_way if name != outcome.task.name])
        take(end)

    tasks = [Task(name=place, fn=upgraded, args=(job,)) for place, job in by.items()]
    with open_pool(processes) as pool:
        run_many(tasks, pool, done, tick=tick)


def upgraded(job: SceneJob) -> SceneEnd:
    """Upgrade a scene quietly; whatever breaks it is told, not raised."""
    try:
        return SceneEnd(job=job, record=upgrade_scene(job, read_source(job), None))
    except (RealsimError, OSError) as error:
        return SceneEnd(job=job, record=None, error=str(error))
    except Exception as error:  # a fault of the program in one scene of many
        return SceneEnd(
            job=job, record=None, error=f"the program failed: {type(error).__name__}: {error}"
        )


@contextmanager
def scene_progress(total: int, finished: int, *, quiet: bool) -> Generator[Told]:
    """Show a bar over scenes with the remaining time and those under way.

    Args:
        total: scenes in all.
        finished: of them, upgraded by an earlier run.
        quiet: whether nothing is shown.
    """
    if not quiet and not sys.stderr.isatty():
        with Console().stage("upgrade", "scenes") as tick:
            ended_now = 0

            def note(ended: SceneEnd | None, under_way: Sequence[str]) -> None:
                nonlocal ended_now
                ended_now += ended is not None
                # Those of an earlier run took no time of this one.
                tick(ended_now, total - finished)

            yield note
        return
    from rich.console import Console as RichConsole
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn

    columns = (
        TextColumn("scenes"), BarColumn(bar_width=30), MofNCompleteColumn(), TimeElapsedColumn(),
        TextColumn("{task.description}"),
    )  # fmt: skip
    start, done = time.monotonic(), 0
    with Progress(*columns, console=RichConsole(stderr=True), disable=quiet) as bar:
        task = bar.add_task("", total=total, completed=finished)

        def tell(ended: SceneEnd | None, under_way: Sequence[str]) -> None:
            nonlocal done
            done += ended is not None
            left = remaining_s(time.monotonic() - start, done, total - finished)
            words = f"{_words(left)} left" if left is not None else ""
            names = ", ".join(under_way)
            bar.update(task, completed=finished + done, description=f"{words}  {names}".strip())

        yield tell


def remaining_s(elapsed_s: float, done: int, of: int) -> float | None:
    """Return how long the rest takes at the rate of what is done [s]; None = nothing is done."""
    return None if done == 0 else elapsed_s / done * (of - done)


def _words(seconds: float) -> str:
    """Return a time as a person says it."""
    if seconds < 90:
        return f"{seconds:.0f} s"
    return f"{seconds / 60:.0f} min" if seconds < 5400 else f"{seconds / 3600:.1f} h"
