"""A campaign's file: where its scenes come from, and which commands run on them.

    [campaign]
    out = "tables"                  # beside this file
    stages = ["register", "school", "annotate", "export", "stats"]

    [generate]                      # or: sources = [...] to import, sessions = [...] that are there
    scenes = 20

    [school.run]
    grasps = 60

    [export]
    to = "bop"

A table holds the options of a command, spelled as in realsim.toml; they are checked as there.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from difflib import get_close_matches
from pathlib import Path
from typing import Any, cast

import click

from realsim.app.command import Group, settable, spelling, typed, walk
from realsim.app.config.settings import ConfigFile, read_config, settings_of
from realsim.errors import InputError

OF_A_SCENE = {
    "calibrate": ("calibrate",),
    "register": ("register",),
    "school": ("school", "run"),
    "annotate": ("annotate",),
    "render": ("render",),
    "report": ("report",),
}
"""Stages that each scene goes through, in this order, and their commands."""
OF_ALL = {"export": ("export",), "stats": ("stats",)}
"""Stages over all finished scenes."""
FROM = ("generate", "sources", "sessions")
"""Where scenes come from."""
KEYS = ("out", "stages", "sources", "sessions")
OURS = ("json", "quiet", "out", "json-file", "workers", "address")
"""Options that a campaign sets itself."""


@dataclass(frozen=True, kw_only=True, slots=True)
class Step:
    """A command of a campaign without its folders."""

    stage: str
    command: tuple[str, ...]
    options: tuple[str, ...] = ()
    """As they are typed."""
    has_workers: bool = False
    """Whether the command takes --workers."""
    has_restart: bool = False
    """Whether it takes --restart, and refuses to go on with other options without."""


@dataclass(frozen=True, kw_only=True, slots=True)
class Campaign:
    """What a campaign's file asks for."""

    file: Path
    out: Path
    source: str
    """generate, sources or sessions."""
    places: tuple[Path, ...]
    """Recordings to import, or sessions; none where scenes are generated."""
    first: Step | None
    """Generates or imports; None = the sessions are there."""
    of_a_scene: tuple[Step, ...]
    of_all: tuple[Step, ...]
    scenes: int | None = None
    """Number of generated scenes to take; None = all."""


def read_campaign(path: Path, root: Group) -> Campaign:
    """Read and check a campaign's file.

    Args:
        path: the file.
        root: all commands.

    Raises:
        InputError: it is not there or not TOML, a table or key that there is not (with its line),
            scenes from nowhere or from two places, a stage in the wrong place.
    """
    if not path.is_file():
        raise InputError(
            f"'{path}' is {'no file' if path.exists() else 'not there'}; a campaign's file is TOML "
            "with a table [campaign]: see `realsim pipeline --help`."
        )
    file = read_config(path, "CAMPAIGN", is_named=True)
    tables = {k: v for k, v in file.tables.items() if k != "campaign"}
    head = _head(file)
    stages = _stages(file, head)
    source = _source(file, head)
    exports = tables.pop("export", {})
    several = cast("list[Any]", exports) if isinstance(exports, list) else [exports]
    commands = walk(root)
    steps = {
        name: _step(file, root, commands, tables, name)
        for name in ("generate", "import", *OF_A_SCENE, "stats")
    }
    _require_used(file, tables | ({"export": exports} if exports else {}), stages, source)
    exported = "export" in stages
    writing = [
        _step(file, root, commands, {"export": each}, "export") for each in several if exported
    ]
    if exported and not all(isinstance(e, dict) and "to" in e for e in several):
        raise InputError(
            f"{file.place(('export',))}: an [export] needs `to`, the format to write, such as "
            'to = "bop"; `realsim export --help` lists them.'
        )
    if len(several) > 1:
        writing = [replace(s, stage=f"export_{k}") for k, s in enumerate(writing, 1)]
    over_all = {"export": writing, "stats": [steps["stats"]]}
    first = {"generate": steps["generate"], "sources": steps["import"]}.get(source)
    return Campaign(
        file=path,
        out=path.parent / head["out"],
        source=source,
        places=tuple(_places(file, head.get(source, []), source)),
        first=first,
        of_a_scene=tuple(steps[name] for name in stages if name in OF_A_SCENE),
        of_all=tuple(step for name in stages for step in over_all.get(name, ())),
        scenes=_count(steps["generate"]) if source == "generate" else None,
    )


def _head(file: ConfigFile) -> dict[str, Any]:
    head = file.tables.get("campaign")
    if not isinstance(head, dict):
        raise InputError(
            f"{file.path} has no table [campaign]; it needs one with out (a folder) and stages "
            '(such as ["register", "school", "annotate"]).'
        )
    head = cast("dict[str, Any]", head)
    for key, value in head.items():
        if key not in KEYS:
            close = get_close_matches(key, KEYS, n=1)
            raise InputError(
                f"{file.place(('campaign',), key)}: [campaign] has no key '{key}'"
                f"{f' (did you mean {close[0]}?)' if close else ''}. Its keys are: "
                f"{', '.join(KEYS)}."
            )
        is_right = (
            isinstance(value, str) and value
            if key == "out"
            else isinstance(value, list) and all(isinstance(v, str) for v in value)  # pyright: ignore[reportUnknownVariableType]
        )
        if not is_right:
            kind = "a folder in quotes" if key == "out" else "a list of texts in quotes"
            raise InputError(
                f"{file.place(('campaign',), key)}: {key} = {value!r} cannot be used; {kind} is "
                "accepted."
            )
    for key in ("out", "stages"):
        if key not in head:
            raise InputError(f"{file.place(('campaign',))}: [campaign] needs '{key}'.")
    return head


def _stages(file: ConfigFile, head: Mapping[str, Any]) -> list[str]:
    """Return the stages; those over all scenes stand last."""
    stages = cast("list[str]", head["stages"])
    where = file.place(("campaign",), "stages")
    known = [*OF_A_SCENE, *OF_ALL]
    for k, name in enumerate(stages):
        if name not in known:
            raise InputError(f"{where}: there is no stage '{name}'. Stages: {', '.join(known)}.")
        if name in stages[:k]:
            raise InputError(f"{where}: '{name}' stands twice.")
        before = next((s for s in stages[:k] if known.index(s) > known.index(name)), None)
        if before and not {name, before} <= set(OF_ALL):
            raise InputError(
                f"{where}: '{name}' stands behind '{before}', which works on its result. The order "
                f"is: {', '.join(known)}."
            )
    return stages


def _source(file: ConfigFile, head: Mapping[str, Any]) -> str:
    given = [name for name in FROM if name in (file.tables if name == "generate" else head)]
    both = " and ".join(given)
    if len(given) != 1:
        raise InputError(
            f"{file.path} says {'nowhere' if not given else 'twice'} where its scenes come from"
            f"{f' ({both})' if given else ''}. Give one of: a table [generate]; "
            'sources = ["recordings/*.bag"], which are imported; sessions = ["captures/*"], which '
            "are there."
        )
    return given[0]


def _places(file: ConfigFile, patterns: Sequence[str], source: str) -> list[Path]:
    """Return what patterns name, sorted; each names something."""
    found: list[Path] = []
    for pattern in patterns:
        absolute = file.path.parent / pattern
        here = sorted(Path(absolute.anchor or ".").glob(str(absolute.relative_to(absolute.anchor))))
        if source == "sessions":
            here = [p for p in here if (p / "session.json").is_file()]
        if not here:
            wanted = "session" if source == "sessions" else "file or folder"
            raise InputError(
                f"{file.place(('campaign',), source)}: '{pattern}' names no {wanted} that is "
                f"there; it is looked for from {file.path.parent.resolve()}."
            )
        found += [p for p in here if p not in found]
    if source != "generate" and not found:
        raise InputError(f"{file.place(('campaign',), source)}: {source} is empty; name some.")
    return found


def _step(
    file: ConfigFile,
    root: Group,
    commands: Mapping[tuple[str, ...], click.Command],
    tables: Mapping[str, Any],
    name: str,
) -> Step:
    """Return the step of a stage with its options as they are typed."""
    path = {**OF_A_SCENE, **OF_ALL}.get(name, (name,))
    command = commands[path]
    settings: Any = settings_of(
        root, replace(file, tables={name: tables[name]} if name in tables else {})
    )
    for part in path:
        settings = settings.get(part, {})
    options = {o.name: o for o in settable(command)}
    words: list[str] = []
    for key, value in settings.items():
        option = options[key]
        word = spelling(option)
        if word in OURS:
            raise InputError(
                f"{file.place(path, word)}: a campaign sets --{word} itself; leave it out."
                + (" Give --workers to the pipeline." if word == "workers" else "")
            )
        words += map(str, typed(option, value))
    names = {spelling(o) for o in options.values()}
    return Step(
        stage=name, command=path, options=tuple(words), has_workers="workers" in names,
        has_restart="restart" in names,
    )  # fmt: skip


def _count(generate: Step) -> int | None:
    """Return the number of scenes that are asked for, None where it is the command's default."""
    at = generate.options.index("--scenes") if "--scenes" in generate.options else -1
    return int(generate.options[at + 1]) if at >= 0 else None


def _require_used(
    file: ConfigFile, tables: Mapping[str, Any], stages: Sequence[str], source: str
) -> None:
    """Raise where a table would have no effect."""
    used = {*stages, *({"generate": ["generate"], "sources": ["import"]}.get(source, []))}
    for name in tables:
        if name not in used:
            raise InputError(
                f"{file.place((name,))}: [{name}] has no effect: '{name}' is not among the stages "
                f"({', '.join(stages) or 'there are none'}). Name it there, or leave the table out."
            )
