"""One generated scene: laid out once, rendered and labelled, and kept when it is finished."""

import tempfile
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

from realsim.app.console import cpu_seconds
from realsim.app.generate.request import LAYOUTS, GenerateRequest
from realsim.store import SessionStore, atomic
from realsim.untrusted.own_json import noted, read_object
from realsim_sim_bridge.synthetic.write import write_session
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


def make_scene(out: Path, number: int, request: GenerateRequest, workers: int = 1) -> SceneCosts:
    """Make a scene, or what is missing of it.

    Args:
        out: folder of the data set.
        number: of the scene.
        request: what is wanted.
        workers: processes that render its views.

    Raises:
        InputError: the pool or the cameras cannot be used.
        StorageError: the disk is full, or refuses.
    """
    began = cpu_seconds()
    cache = out / CACHE
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


def make_scene_of(
    out: Path,
    number: int,
    request: GenerateRequest,
    folders: tuple[Path | None, ...],
    hdris: tuple[Path, ...],
    textures: tuple[Path, ...],
    workers: int,
) -> SceneCosts:
    """Make a scene, or what is missing of it, where files may lie elsewhere than the request says.

    Arguments as of `GenerateRequest.with_files` and `make_scene`.
    """
    return make_scene(out, number, request.with_files(folders, hdris, textures), workers)


def stored_costs(out: Path, number: int) -> dict[str, Any]:
    """Return what the run that finished a scene spent on it; empty where that is not known."""
    path = finished_path(out, number)
    value: Any = read_object(path).get("costs", {}) if path.is_file() else {}
    return dict(value)
