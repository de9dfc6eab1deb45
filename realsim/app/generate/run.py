"""All scenes of a data set: several at a time, each by one process, gone on with after a kill."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from realsim import many
from realsim.app.console import Console
from realsim.app.generate.request import (
    LAYOUTS,
    GenerateRequest,
    claim,
    made_folder,
    require_usable,
)
from realsim.app.generate.scene import CACHE, SceneCosts, is_finished, make_scene_of
from realsim.store.lock import only_run_in
from realsim_sim_bridge.synthetic.frame import require_renderer
from realsim_sim_bridge.table_scenes.scene import scene_name


@dataclass(frozen=True, kw_only=True, slots=True)
class GenerateOutcome:
    """What became of the scenes."""

    kept: tuple[int, ...] = ()
    """Scenes that were finished before."""
    made: tuple[SceneCosts, ...] = ()
    """Scenes that this run finished, by number."""
    failed: dict[int, str] = field(default_factory=dict[int, str])
    """Scene -> why it could not be made."""


def generate(
    out: Path, scenes: int, request: GenerateRequest, where: many.PoolConfig, console: Console
) -> GenerateOutcome:
    """Make the scenes 0 to `scenes` - 1 of a request.

    A scene's bytes depend on the request and its number only, not on where it is made.

    Raises:
        InputError: the folder holds something else, another run works in it, the pool or the
            panoramas are certain to fail, or the renderer is not installed.
        StorageError: the disk is full, or refuses; the same request goes on from there.
    """
    require_renderer(request.rendering)
    require_usable(request)
    made_folder(out)
    with only_run_in(out):
        claim(out, request)
        kept = [k for k in range(scenes) if is_finished(out, k, request)]
        due = [k for k in range(scenes) if k not in kept]
        pool = many.at_most(where, len(due))
        # Scenes fewer than workers: the rest help with the views.
        each = 1 if where.address else max(1, where.processes // pool.processes)
        plural = "" if scenes == 1 else "s"
        what = f"{scenes} scene{plural} of {request.views.count} views"
        with console.stage("generate", what) as tick:
            count = _ticker(out, scenes, request.views.count, tick)
            made, failed = _made(out, due, request, pool, each, count)
    return GenerateOutcome(
        kept=tuple(kept), made=tuple(sorted(made, key=lambda c: c.number)),
        failed=dict(sorted(failed.items())),
    )  # fmt: skip


def _made(
    out: Path,
    due: list[int],
    request: GenerateRequest,
    where: many.PoolConfig,
    workers: int,
    tick: Callable[[], None],
) -> tuple[list[SceneCosts], dict[int, str]]:
    """Make the scenes that are due, each with so many processes for its views.

    A scene that cannot be made is named, and the others are made all the same.
    """
    made: list[SceneCosts] = []
    failed: dict[int, str] = {}
    tick()
    if not due:
        return made, failed
    numbers = {scene_name(k): k for k in due}

    def done(outcome: many.Outcome) -> None:
        if outcome.error is None:
            made.append(outcome.value)
        elif isinstance(outcome.error, many.WorkerDiedError):
            failed[numbers[outcome.task.name]] = (
                f"{outcome.why}. Run the same command again: it goes on from here."
            )
        else:
            failed[numbers[outcome.task.name]] = outcome.why

    with many.open_pool(where) as pool:
        many.run_many(scene_tasks(out, due, request, workers), pool, done, tick=lambda _: tick())
    return made, failed


def scene_tasks(
    out: Path, due: Sequence[int], request: GenerateRequest, workers: int
) -> Iterator[many.Task]:
    """Yield the tasks that make scenes; each changes its own files in the folder.

    Args:
        out: folder of the data set, which the caller holds.
        due: numbers of the scenes.
        request: what is wanted.
        workers: processes of each for its views.
    """
    for k in due:
        name = scene_name(k)
        own = many.Worked(out, only=(f"{name}/*", f"{LAYOUTS}/{name}.*", f"{CACHE}/*"))
        yield many.Task(name=name, fn=make_scene_of, args=(own, k, *request.carried(), workers))


def _ticker(
    out: Path, scenes: int, views: int, tick: Callable[[int, int], None]
) -> Callable[[], None]:
    """Return what tells the progress by the files that are there: pictures and labels."""

    def count() -> None:
        done = sum(
            sum(1 for _ in (out / scene_name(k) / kind).glob(f"[0-9]*.{ending}"))
            for k in range(scenes)
            for kind, ending in (("rgb", "png"), ("annotations", "json"))
        )
        tick(min(done, 2 * scenes * views), 2 * scenes * views)

    return count
