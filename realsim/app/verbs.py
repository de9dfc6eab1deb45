"""The commands for Python: `import realsim as rs`, then `session = rs.open("demo/session")`.

A verb runs the command of its name in this process: the same defaults and settings, the same files
to the last bit, and the same record for `realsim reproduce`. Every option of the command is an
argument, by its name with `_` for `-`; None leaves it to the command.
"""

import os
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from html import escape
from pathlib import Path
from typing import TYPE_CHECKING, Any, Generic, TypeVar

import click
import numpy as np

from realsim.app.cli import commands, refusal
from realsim.app.command import Group, context_of, spelling, typed
from realsim.app.console import Progress, Told
from realsim.app.stages import judged_scene, open_session
from realsim.errors import InputError
from realsim.records import CaptureSession, GraspSet, HandEye, ObjectModel, Scene
from realsim.store import load_grasps
from realsim.store.results import HAND_EYE_FILE
from realsim.untrusted.own_json import read_own

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from realsim_capture_plans import CapturePlan

Place = str | os.PathLike[str]
"""A path, or the result of a verb, which stands for its folder."""
T = TypeVar("T")


@dataclass(eq=False, kw_only=True, repr=False)
class Result(Told, os.PathLike[str], Generic[T]):
    """What a verb made: its record, its folder, and what its command told; draws itself."""

    verb: str
    folder: Path
    """The session or folder that was filled; a result may be given wherever a path may."""
    value: T
    """The record: a `Scene`, a `HandEye`, grasp sets and so on."""
    pictures: Sequence[Path]
    """Pictures that the command drew."""

    def __fspath__(self) -> str:
        """Return the folder, so that a result stands for it."""
        return str(self.folder)

    def __repr__(self) -> str:
        """Return the verb, the folder and the outcome in a line."""
        return f"<{self.verb} {self.folder}: {'done' if self.passed else 'a check failed'}>"

    def _repr_html_(self) -> str:
        """Return the tables and notes for a notebook."""
        parts = [f"<b>{escape(repr(self)[1:-1])}</b>"]
        for title, header, rows in self.tables:
            lines = [
                f"<tr>{_cells('th', header)}</tr>",
                *(f"<tr>{_cells('td', r)}</tr>" for r in rows),
            ]
            parts.append(f"<table><caption>{escape(title)}</caption>{''.join(lines)}</table>")
        return "".join([*parts, *(f"<p>{escape(note)}</p>" for note in self.notes)])

    def plot(self) -> "Figure":
        """Return the command's pictures as a figure, one under the other.

        Raises:
            InputError: the command drew none.
        """
        from matplotlib import pyplot

        if not self.pictures:
            raise InputError(f"{self!r} has no pictures; its tables are in .tables.")
        images = [pyplot.imread(path) for path in self.pictures]
        shares = [image.shape[0] / image.shape[1] for image in images]
        figure, axes = pyplot.subplots(
            len(images), squeeze=False, figsize=(10.0, 10.0 * sum(shares)), height_ratios=shares,
            layout="constrained",
        )  # fmt: skip
        for ax, image in zip(axes[:, 0], images, strict=True):
            ax.imshow(image)
            ax.set_axis_off()
        return figure


def _cells(tag: str, texts: Sequence[str]) -> str:
    return "".join(f"<{tag}>{escape(text)}</{tag}>" for text in texts)


def open(
    source: Place, out: Place | None = None, *, progress: Progress | None = None, **options: Any,
) -> Result[CaptureSession]:  # fmt: skip
    """Open a session; with `out`, import a recording, images or a data set into it first.

    Raises:
        InputError: it is no session, or it cannot be imported.
    """
    told = Told()
    if out is not None:
        told = run("import", (source, out), options, progress)
    elif options:
        raise InputError(f"open: {', '.join(options)} are for an import; give `out`, its session.")
    store = open_session(_path(source if out is None else out))
    views, camera = store.session.views, store.session.intrinsics
    done = sorted(path.stem for path in store.path("stages").glob("*.json"))
    rows = [["views", f"{len(views)}, {camera.width} x {camera.height} px"],
            ["views with a robot pose", str(sum(v.T_base_ee is not None for v in views))],
            ["views with a camera pose", str(len(store.session.Ts_world_cam))],
            ["stages done", ", ".join(done) or "none"]]  # fmt: skip
    told.tables.append((store.session.name, ["session", "value"], rows))
    return _made("open", store.folder, store.session, told, "reports/views.png")


def demo(
    out: Place = "demo", *, quick: bool = False, progress: Progress | None = None, **options: Any,
) -> Result[CaptureSession]:  # fmt: skip
    """Make a session in a simulated lab and run the whole loop on it; no robot is needed."""
    told = run("demo", (), options | {"out": out, "quick": quick}, progress)
    session = open(told.document["session"])
    return _made("demo", session.folder, session.value, told, *session.pictures)


def plan(
    out: Place = "plan.json", *, views: int | None = None, arm: str | None = None,
    board_views: bool = False, progress: Progress | None = None, **options: Any,
) -> "Result[CapturePlan]":  # fmt: skip
    """Plan the views of a scene, or of a board; write the plan and its pictures beside it."""
    from realsim_capture_plans import load_plan

    out = _path(out)  # None, too, is refused before the work
    options |= {"out": out, "views": views, "arm": arm, "board_views": board_views}
    told = run("plan", (), options, progress)
    return _made("plan", out, load_plan(out), told, *told.document["pictures"])


def calibrate(
    source: Place, *, board: str | None = None, poses: Place | None = None,
    out: Place | None = None, progress: Progress | None = None, **options: Any,
) -> Result[HandEye | None]:  # fmt: skip
    """Calibrate lens and hand-eye of a session, or of a folder of images with robot poses.

    The record is a session's; that of a plain folder is in `.document`: T_ee_cam, sigma_mm, ...
    """
    options |= {"board": board, "poses": poses, "out": out}
    told = run("calibrate", (source,), options, progress)
    if (file := _path(source) / HAND_EYE_FILE).is_file():
        value = read_own(file, HandEye)
        return _made("calibrate", _path(source), value, told, "calibration/report/*.png")
    files = [Path(path) for path in told.document["files"]]
    pictures = [path for path in files if path.suffix == ".png"]
    return _made("calibrate", files[0].parent, None, told, *pictures)


def register(
    session: Place, *, object: str | Sequence[str] = (), find_all: bool = False,
    from_review: bool = False, library: Place | None = None, views: int | None = None,
    progress: Progress | None = None, **options: Any,
) -> Result[Scene]:  # fmt: skip
    """Find the pose of every object, with its uncertainty and a verdict."""
    options |= {"object": object, "find_all": find_all, "from_review": from_review,
                "library": library, "views": views}  # fmt: skip
    told = run("register", (session,), options, progress)
    scene = judged_scene(open_session(_path(session)))
    return _made("register", _path(session), scene, told, "registration/pictures/*")


def scan(
    *meshes: Place, library: Place | None = None, unit: str | None = None,
    session: Place | None = None, progress: Progress | None = None, **options: Any,
) -> Result[list[ObjectModel]]:  # fmt: skip
    """Add meshes to a library (`models`); with `session`, find one's size in its depth images.

    The records are the models at metric scale that are in the library now.
    """
    from realsim.models.library_reading import LibraryReader

    options |= {"library": library}
    if session is None:
        options["unit"] = unit
        told = run("scan import", meshes, options, progress)
        names = [row.get("name") for row in told.document["meshes"]]
    else:
        told = run("scan scale", (*meshes, session), options, progress)
        names = [options.get("name") or Path(mesh).stem for mesh in meshes]
    folder, models = _path(library or "models"), list[ObjectModel]()
    if folder.is_dir():
        reader = LibraryReader.open(folder)
        there = [e.obj_id for e in reader.entries() if e.name in names and e.obj_id is not None]
        models = [reader.load(obj_id).model for obj_id in there]
    return _made("scan", folder, models, told, *(f"pictures/{n}.png" for n in names))


def school(
    session: Place, *, grasps: int | None = None, hand: str | None = None, arm: str | None = None,
    workers: int | None = None, restart: bool = False,
    progress: Progress | None = None, **options: Any,
) -> Result[list[GraspSet]]:  # fmt: skip
    """Try grasps on every object by physics."""
    options |= {"grasps": grasps, "hand": hand, "arm": arm, "workers": workers,
                "restart": restart}  # fmt: skip
    told = run("school run", (session,), options, progress)
    folder = Path(told.document["folder"])
    return _made("school", folder, load_grasps(folder), told, "reports/school_*.png")


def annotate(
    session: Place, *, maps: str | None = None, workers: int | None = None,
    progress: Progress | None = None, **options: Any,
) -> Result[Any]:  # fmt: skip
    """Write masks, maps, poses and grasps for every frame; the record is the summary."""
    options |= {"maps": maps, "workers": workers}
    told = run("annotate", (session,), options, progress)
    return _made("annotate", _path(session), told.document, told, "reports/annotated.png")


def render(
    session: Place, *, views: int | str | None = None, out: Place | None = None,
    renderer: str | None = None, workers: int | None = None,
    progress: Progress | None = None, **options: Any,
) -> Result[CaptureSession]:  # fmt: skip
    """Render the twin of every frame, or new views: a session of its own, with labels."""
    options |= {"views": views, "out": out, "renderer": renderer, "workers": workers}
    told = run("render", (session,), options, progress)
    store = open_session(told.document["session"])
    return _made("render", store.folder, store.session, told, "reports/synthetic.png")


def export(
    *sources: Place, to: str, out: Place, progress: Progress | None = None, **options: Any,
) -> Result[Path]:  # fmt: skip
    """Write sessions or data sets in another format; the record is the path of the card."""
    options |= {"to": to, "out": out}
    told = run("export", sources, options, progress)
    return _made("export", _path(out), told.document.card, told)


def review(
    *sessions: Place, static: Place | None = None, port: int | None = None,
    reviewer: str | None = None, progress: Progress | None = None, **options: Any,
) -> Result[Scene]:  # fmt: skip
    """Serve the review page until it is interrupted; with `static`, write the scene as one file.

    The record is the scene of the first session as its reviewers left it.
    """
    options |= {"static": static, "port": port, "reviewer": reviewer}
    told = run("review", sessions, options, progress)
    store = open_session(_path(told.document["sessions"][0] if static is None else sessions[0]))
    return _made("review", store.folder, judged_scene(store), told)


def _made(verb: str, folder: Path, value: T, told: Told, *pictures: Place) -> Result[T]:
    """Return the result of a verb; pictures are paths or patterns in its folder."""
    root = folder if folder.is_dir() else folder.parent
    given: list[Path] = []
    for place in pictures:
        given += [Path(place)] if Path(place).is_file() else sorted(root.glob(str(place)))
    return Result(verb=verb, folder=folder, value=value, pictures=given, **vars(told))


def run(
    name: str, places: Sequence[Place], options: Mapping[str, Any],
    progress: Progress | None = None,
) -> Told:  # fmt: skip
    """Run any command and return what it told.

    Raises:
        InputError: an option that it has not, or a value that it refuses.
        RealsimError: the disk is full, a library is missing, or the data do not tell the answer.
    """
    path = name.split()
    told = Told(progress=progress)
    words = [*path, *_words(name, path, options), *map(_typed_path, places)]
    try:
        commands.main(words, prog_name="realsim", standalone_mode=False, obj=told)
    except SystemExit as end:
        told.passed = not end.code
    except click.ClickException as error:
        raise InputError(error.format_message()) from None
    except click.Abort as stop:
        raise KeyboardInterrupt(*getattr(stop.__cause__, "args", ())) from None
    except (ImportError, OSError) as error:
        if (text := refusal(error)) is None:
            raise
        raise InputError(text) from error
    return told


def _words(name: str, path: Sequence[str], options: Mapping[str, Any]) -> Iterator[str]:
    """Return options as they are typed.

    Raises:
        InputError: the command has no such option, or it is given no path or no bool.
    """
    command: click.Command = commands
    for k, part in enumerate(path):
        assert isinstance(command, Group)
        found = command.get_command(context_of(commands, path[:k]), part)
        assert found is not None
        command = found
    known = {
        spelling(p).replace("-", "_"): p for p in command.params if isinstance(p, click.Option)
    }
    for key, value in options.items():
        if value is None:
            continue
        if key not in known:
            raise InputError(f"{name} has no option '{key}'; it has {', '.join(sorted(known))}.")
        option, what = known[key], f"{name}: {key}"
        if option.is_flag and not isinstance(value, bool | np.bool_):
            raise InputError(f"{what} is {value!r}; True or False is accepted.")
        given: Any = value.tolist() if isinstance(value, np.ndarray) else value
        single = isinstance(given, str) or not isinstance(given, Iterable)
        several: Any = given if option.multiple and not single else [given]
        if isinstance(option.type, click.Path):
            several = [_typed_path(place, what) for place in several]
        yield from [str(w) for w in typed(option, several if option.multiple else several[0])]


def _path(place: Any) -> Path:
    """Return a path with `~` expanded.

    Raises:
        InputError: it is none.
    """
    return Path(_typed_path(place))


def _typed_path(place: Any, what: str = "the path") -> str:
    """Return a path as the command takes it; `~`, which shells expand, is the home.

    Raises:
        InputError: it is none.
    """
    text = os.fspath(place) if isinstance(place, str | os.PathLike) else None
    if not isinstance(text, str):
        raise InputError(
            f"{what} is {place!r}; a text, a pathlib.Path or the result of a verb is accepted."
        )
    return os.path.expanduser(text)
