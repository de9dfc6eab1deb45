"""All scenes of a data set: several at a time, each by one process, gone on with after a kill."""

from collections.abc import Callable
from concurrent.futures import FIRST_COMPLETED, Future, wait
from dataclasses import dataclass, field
from pathlib import Path

from realsim.app.console import Console
from realsim.app.generate.request import GenerateRequest, claim, made_folder, require_usable
from realsim.app.generate.scene import SceneCosts, is_finished, make_scene
from realsim.errors import RealsimError
from realsim.store.atomic import StorageError
from realsim.store.lock import only_run_in
from realsim_sim_bridge.school.workers import WorkerDiedError, local_workers
from realsim_sim_bridge.synthetic.frame import require_renderer
from realsim_sim_bridge.table_scenes.scene import scene_name

POLL_S = 1.0
"""The files written so far are counted this often [s]."""


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
    out: Path, scenes: int, request: GenerateRequest, workers: int, console: Console
) -> GenerateOutcome:
    """Make the scenes 0 to `scenes` - 1 of a request.

    A scene's bytes depend on the request and its number only, not on `workers`.

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
        at_once = max(1, min(workers, len(due)))
        plural = "" if scenes == 1 else "s"
        what = f"{scenes} scene{plural} of {request.views.count} views"
        with console.stage("generate", what) as tick:
            made, failed = _made(out, due, request, (at_once, workers // at_once), _ticker(
                out, scenes, request.views.count, tick))  # fmt: skip
    return GenerateOutcome(
        kept=tuple(kept), made=tuple(sorted(made, key=lambda c: c.number)),
        failed=dict(sorted(failed.items())),
    )  # fmt: skip


def _made(
    out: Path,
    due: list[int],
    request: GenerateRequest,
    share: tuple[int, int],
    tick: Callable[[], None],
) -> tuple[list[SceneCosts], dict[int, str]]:
    """Make the scenes that are due, so many at a time, each with so many processes for its views.

    A scene that cannot be made is named, and the others are made all the same.
    """
    made: list[SceneCosts] = []
    failed: dict[int, str] = {}
    waiting = list(due)
    tick()
    under_way: dict[Future[SceneCosts], int] = {}
    with local_workers(share[0]) as pool:
        while waiting or under_way:
            while waiting and len(under_way) < pool.capacity():
                k = waiting.pop(0)
                under_way[pool.submit(make_scene, out, k, request, max(1, share[1]))] = k
            done, _ = wait(under_way, timeout=POLL_S, return_when=FIRST_COMPLETED)
            for future in done:
                k = under_way.pop(future)
                try:
                    made.append(future.result())
                except StorageError:
                    raise  # the next scenes would fall as this one, and then find no room either
                except WorkerDiedError as error:
                    failed[k] = f"{error}. Run the same command again: it goes on from here."
                except RealsimError as error:
                    failed[k] = str(error)
            tick()
    return made, failed


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
