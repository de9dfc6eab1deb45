"""All scenes of a data set: several at a time, each by one process, gone on with after a kill.

One generated scene: laid out once, rendered and labelled, and kept when it is finished.
"""

import tempfile
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

from realsim import many
from realsim.app.console import Console, cpu_seconds
from realsim.app.generate.request import LAYOUTS, Files, GenerateRequest, claim, require_usable
from realsim.errors import InputError
from realsim.pages import counted
from realsim.store import SessionStore, atomic
from realsim.store.atomic import only_run_in
from realsim.untrusted.own_json import noted, read_object
from realsim_sim_bridge.synthetic.write import require_renderer, write_session
from realsim_sim_bridge.table_scenes import sample
from realsim_sim_bridge.table_scenes.cameras import intrinsics_of, views
from realsim_sim_bridge.table_scenes.scene import build_scene, scene_name, write_models

CACHE = "cache"
"""Where convex parts of meshes are kept."""


@dataclass(frozen=True, kw_only=True, slots=True)
class SceneCosts:
    """CPU time of a scene by this run [s]; zeros where it was there already."""

    number: int
    physics_s: float = 0.0
    """Meshes read, convex parts, falling and settling."""
    rendering_s: float = 0.0
    """Photographs, depth and labels of all views, and their files."""
    rendered: int = 0
    """Views rendered by this run."""
    parts: dict[str, float] = field(default_factory=dict[str, float])
    """CPU time per frame by part [s]: rgb, depth, write, labels."""
    notes: tuple[str, ...] = ()
    """What the renderer wants a person to know: that it is slower than it could be, say."""


def layout_path(out: Path, number: int) -> Path:
    """Return the file of a scene's layout."""
    return out / LAYOUTS / f"{scene_name(number)}.json"


def finished_path(out: Path, number: int) -> Path:
    """Return the file that says that a scene is finished."""
    return out / LAYOUTS / f"{scene_name(number)}.finished.json"


def load_layout(out: Path, number: int) -> sample.Layout:
    """Return the layout of a scene.

    Raises:
        InputError: it is missing or damaged.
    """
    path = layout_path(out, number)
    return sample.layout_from_json(read_object(path), str(path))


def is_finished(out: Path, number: int, request: GenerateRequest) -> bool:
    """Return whether a scene of this request is complete: its note and all of its files."""
    path, folder = finished_path(out, number), out / scene_name(number)
    if noted(path).get("key") != request.key or not (folder / "session.json").is_file():
        return False
    views = range(request.views.count)
    labelled = all((folder / f"annotations/{k:06d}.json").is_file() for k in views)
    return labelled and SessionStore.open(folder).completed >= set(views)


def make_scene(
    out: Path, number: int, request: GenerateRequest, files: Files | None = None, workers: int = 1
) -> SceneCosts:
    """Make a scene, or what is missing of it.

    Args:
        out: folder of the data set.
        number: of the scene.
        request: what is wanted.
        files: the request's, where they lie elsewhere than it says.
        workers: processes that render its views.

    Raises:
        InputError: the pool or the cameras cannot be used.
        StorageError: the disk is full, or refuses.
    """
    began = cpu_seconds()
    cache = out / CACHE
    if files is not None:
        request = request.with_files(*files)
    if layout_path(out, number).is_file():
        layout = load_layout(out, number)
    else:
        layout = sample.sample_layout(request.seed, number, request.pool, request.scene, cache)
        with atomic.storing(out, f"the layout of {scene_name(number)}"):
            atomic.write_json(layout_path(out, number), sample.layout_to_json(layout))
    built = build_scene(
        layout, request.pool, request.scene, own=request.looks,
        farthest_m=request.views.radius_m[1], cache=cache,
    )  # fmt: skip
    between = cpu_seconds()
    Ts_table_cam = views(
        built.hulls(),
        request.views,
        sample.generator(request.seed, number, "cameras"),
        built.table.rims,
    )
    noise = int(sample.generator(request.seed, number, "noise").integers(2**31))
    with tempfile.TemporaryDirectory(prefix="realsim_models_") as models:
        with atomic.storing(Path(models), "the scene's models"):
            write_models(Path(models), built)
        summary = write_session(
            out / scene_name(number), built.synthetic,
            intrinsics_of(request.rendering.profile, request.views.size), Ts_table_cam,
            request.rendering, noise, workers=workers, models_from=Path(models),
        )  # fmt: skip
    costs = SceneCosts(
        number=number, physics_s=between - began, rendering_s=cpu_seconds() - between,
        rendered=summary.rendered, parts=summary.cpu_s,
        notes=summary.notes,
    )  # fmt: skip
    with atomic.storing(out, f"the note that {scene_name(number)} is finished"):
        atomic.write_json(finished_path(out, number), {"key": request.key, "costs": asdict(costs)})
    return costs


def stored_costs(out: Path, number: int) -> dict[str, Any]:
    """Return what the run that finished a scene spent on it; empty where that is not known."""
    path = finished_path(out, number)
    value: Any = read_object(path).get("costs", {}) if path.is_file() else {}
    return dict(value)


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
    if out.exists() and not out.is_dir():
        raise InputError(f"'{out}' is a file; give a folder that may be made or filled.")
    out.mkdir(parents=True, exist_ok=True)
    with only_run_in(out):
        claim(out, request)
        kept = [k for k in range(scenes) if is_finished(out, k, request)]
        due = [k for k in range(scenes) if k not in kept]
        pool = many.at_most(where, len(due))
        # Scenes fewer than workers: the rest help with the views.
        each = 1 if where.address else max(1, where.processes // pool.processes)
        what = f"{counted(scenes, 'scene')} of {request.views.count} views"
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
        yield many.Task(name=name, fn=make_scene, args=(own, k, request, request.files(), workers))


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
