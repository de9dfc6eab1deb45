"""Where commands may write: on a new name, or on what the same option wrote before.

    @click.option("--out", type=OutputFile({".html": (DOCUMENT_SCRIPT,)}, "page"))

The check is part of the option's type, so that it comes before any work, and a command that has
such an option cannot forget it. A test holds every output option to these types.
"""

import os
import tempfile
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import click

from realsim.errors import InputError

Marks = Mapping[str, Sequence[str]]
"""Suffix -> texts that every file of the option's own has; none = the suffix is enough."""
SESSION_FILES = ("session.json", "session.begun.json", "robot.jsonl", "manifest.jsonl")
SESSION_PLAN = "plan.json"
"""What a session was captured by; elsewhere the usual name of a plan."""
SESSION_FOLDERS = (
    "annotations", "calibration", "depth", "grasps", "imported", "labels", "mask", "mask_visib",
    "models", "registration", "review", "rgb", "stages",
)  # fmt: skip
"""Folders of a session that hold data; into `reports`, `scans` and others anything may go."""
SESSION_NAMES = (*SESSION_FILES, SESSION_PLAN, *SESSION_FOLDERS)
BOARD_FOLDER = "calibration"
"""The one of them in which a session of its own lies, which is captured or imported."""
INPUTS = frozenset((
    "arm_calibration base_pose board_poses calibration campaign compare config_file dataset "
    "depth_model hdri hdris images intrinsics library limits masks meshes models mount obstacles "
    "poses result session sessions source sources start supports textures token_file trials truth"
).split())  # fmt: skip
"""Parameters that name what is read, or a session or library that is worked on: no outputs."""


class OutputFile(click.Path):
    """A file that a command writes: a new one, or one that it wrote before."""

    def __init__(self, own: Marks, what: str, *, beside: Sequence[str] = ()) -> None:
        """Take what the command writes.

        Args:
            own: how its earlier files are told from other ones; its suffixes are those accepted.
            what: the file in a word or two, such as "page".
            beside: suffixes of files of the same name that are written with it.
        """
        super().__init__(path_type=Path)
        self.own, self.what, self.beside = own, what, beside

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Path:
        """Return the path, if it may be written."""
        path = Path(value)
        if ctx is None or not ctx.resilient_parsing:
            require_free_file(path, _spelled(param), self.own, self.what, self.beside)
        return path


class OutputFolder(click.Path):
    """A folder that a command fills."""

    def __init__(
        self, files: Sequence[str] = (), own: tuple[str, Sequence[str]] = ("", ()), *,
        goes_on: bool = False,
    ) -> None:  # fmt: skip
        """Take what the command writes there.

        Args:
            files: names that are the same in every run.
            own: pattern of one of them, and the texts in each, which tell an earlier run's files
                from others'.
            goes_on: the command looks itself at what is there, to go on with it.
        """
        super().__init__(path_type=Path)
        self.files, self.own, self.goes_on = files, own, goes_on

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Path:
        """Return the path, if it may be filled."""
        path = Path(value)
        if ctx is not None and ctx.resilient_parsing:
            return path
        if self.goes_on:
            require_no_data(path, _spelled(param), besides=(BOARD_FOLDER,))
        else:
            require_free_folder(path, _spelled(param), self.files, self.own)
        return path


GOES_ON = OutputFolder(goes_on=True)
"""A place of a command that says itself, and better, what it does with what is there."""


def unguarded(name: str, parameter: click.Parameter) -> bool:
    """Return whether a parameter may name an output and is of none of the types here.

    Args:
        name: of the parameter.
        parameter: of any command.
    """
    is_path = isinstance(parameter.type, click.Path | click.File)
    return is_path and not (isinstance(parameter.type, OutputFile | OutputFolder) or name in INPUTS)


def require_no_data(path: Path, name: str, besides: Sequence[str] = ()) -> None:
    """Raise where a path lies in a folder of a session's data, or is reached by a link from there.

    Args:
        path: of a file or folder, there or not.
        name: of the option, for messages.
        besides: folders of data in which it may lie.

    Raises:
        InputError: it does, is one of a session's own files, or holds links that lead out of it.
    """
    for real in {path.resolve(), Path(os.path.abspath(path))}:
        for session in real.parents:
            first, *further = real.relative_to(session).parts
            own = SESSION_FOLDERS if further else SESSION_NAMES
            if first in own and first not in besides and _is_session(session):
                raise _is_data(path, name, session)
    require_no_links(path, name)


def require_outside(out: Path, sources: Iterable[Path]) -> None:
    """Raise where an output would be written into what is only read.

    Raises:
        InputError: it is one of the sources, or lies in one.
    """
    place = out.resolve()
    for source in sources:
        if source.resolve() in (place, *place.parents):
            raise InputError(
                f"--out '{out}' lies inside the source '{source}', which is only read; choose a "
                "folder outside it."
            )


def require_no_links(path: Path, name: str) -> None:
    """Raise where a folder is a link or has links that lead out of it: results would go there.

    Args:
        path: the folder, there or not.
        name: of the option, for messages.

    Raises:
        InputError: there is such a link.
    """
    if path.is_symlink():
        raise InputError(
            f"{name} '{path}' is a link to {path.resolve()}; nothing is written through links. "
            "Give that name, or another one."
        )
    if not path.is_dir():
        return
    real = path.resolve()
    for entry in path.iterdir():
        if entry.is_symlink() and not entry.resolve().is_relative_to(real):
            raise InputError(
                f"{name} '{path}': {entry} is a link to {entry.resolve()}, out of the folder; "
                "nothing is written through it. Take the link away, or give another folder."
            )


def _is_session(folder: Path) -> bool:
    return any((folder / file).is_file() for file in SESSION_FILES)


def _is_data(path: Path, name: str, session: Path) -> InputError:
    return InputError(
        f"{name} '{path}' is part of the session '{session}', whose own files are not replaced; "
        "give another place."
    )


def require_free_file(
    path: Path, name: str, own: Marks, what: str, beside: Sequence[str] = ()
) -> None:
    """Raise unless a file can be written without loss of anything but its earlier self.

    Args:
        path: the file.
        name: of the option, for messages.
        own: see `OutputFile`.
        what: the file in a word or two.
        beside: suffixes of files that are written with it.

    Raises:
        InputError: a folder, a device, another suffix, a file that the option did not write, or in
            a folder that is missing or cannot be written.
    """
    shown, suffixes = f"{name} '{path}'", " or ".join(own)
    if path.is_dir():
        raise InputError(f"{shown} is a folder; the name of a file ({suffixes}) is expected.")
    if os.path.lexists(path) and not path.is_file():
        raise InputError(
            f"{shown} is a device, or a link to nothing; give a name for the {what}, such as "
            f"result{next(iter(own))}. `--json` prints the figures."
        )
    if path.suffix.lower() not in own:
        raise InputError(
            f"{shown} is written as a {what}; a name that ends in {suffixes} is expected."
        )
    folder = path.absolute().parent
    if not folder.is_dir():
        raise InputError(
            f"the folder '{path.parent}' ({folder}) for {name} is not there; make it first."
        )
    if not os.access(folder, os.W_OK):
        raise InputError(f"the folder '{path.parent}' for {name} may not be written by you.")
    if path.is_symlink():
        raise InputError(
            f"{shown} is a link to {path.resolve()}; nothing is written through links. Give that "
            "name, or another one."
        )
    if path.name in SESSION_FILES or (path.name == SESSION_PLAN and _is_session(folder)):
        raise InputError(f"{shown} is a name of a session's own files; give another name.")
    is_own = path.is_file() and has_texts(path, own[path.suffix.lower()])
    others = [p for p in (path.with_suffix(suffix) for suffix in beside) if os.path.lexists(p)]
    if path.is_file() and not is_own:
        others = [path]
    if others and not is_own:
        raise InputError(
            f"{name} '{others[0]}' is there and is no {what} that this command wrote; it is not "
            "replaced. Give another name, or delete it first."
        )


def require_free_folder(
    path: Path, name: str, files: Sequence[str] | None, own: tuple[str, Sequence[str]]
) -> None:
    """Raise unless a folder can be filled without loss of anything but what was written there.

    Raises:
        InputError: a file, a link, a session, a folder of a session's data, one that cannot be
            written, or it holds files of the same names (None = any) that another program or user
            made.
    """
    if os.path.lexists(path) and not path.is_dir():
        raise InputError(f"{name} '{path}' is a file; give a folder.")
    if _is_session(path):
        raise _is_data(path, name, path)
    require_no_data(path, name)
    names = sorted(path.glob("[!.]*")) if files is None else [path / file for file in files]
    there = [p for p in names if os.path.lexists(p)]
    marked = [file for file in path.glob(own[0]) if file.is_file()] if own[0] else []
    if there and not (marked and all(has_texts(file, own[1]) for file in marked)):
        raise InputError(
            f"{name} '{path}': {there[0]} is there, made by something else or of something else; "
            "it is not replaced. Give "
            + ("another folder, or delete it first." if files else "a new or an empty folder.")
        )
    require_writable(path, name)


def require_writable(path: Path, name: str) -> None:
    """Raise unless a folder, or the nearest one above it that is there, can be written.

    Raises:
        InputError: it cannot; the message says why.
    """
    parent = next(p for p in (path.absolute(), *path.absolute().parents) if p.exists())
    try:
        tempfile.TemporaryDirectory(dir=parent).cleanup()
    except OSError as error:
        raise InputError(
            f"{name} '{path}': {parent} cannot be written ({error.strerror}). Give another folder."
        ) from error


def has_texts(path: Path, texts: Iterable[str]) -> bool:
    """Return whether a file holds all texts."""
    data = path.read_bytes()
    return all(text.encode() in data for text in texts)


def _spelled(param: click.Parameter | None) -> str:
    """Return an option as it is typed, an argument as the help names it."""
    if param is None:
        return "the output"
    return param.opts[0] if isinstance(param, click.Option) else param.human_readable_name
