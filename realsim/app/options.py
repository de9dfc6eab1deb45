"""The options that many commands have, spelled and explained alike."""

from collections.abc import Callable
from functools import wraps
from pathlib import Path
from typing import Any

import click

from realsim.app.command import Decorator
from realsim.app.outputs import OutputFile

FOLDER = click.Path(path_type=Path)
"""A file or folder as a pathlib.Path; whoever opens it says what is wrong with it."""

QUIET = click.option("--quiet", is_flag=True, help="No progress; only the result and trouble.")
JSON = click.option("--json", "as_json", is_flag=True, help="The result as JSON on stdout.")


def json_file(what: str, key: str, *keys: str, top: bool = False) -> Decorator:
    """Return the option that writes the JSON into a file as well; `keys` tell its own files.

    Args:
        what: the help.
        key: of the document.
        keys: more of them.
        top: they count at the document's top alone, where another command's holds this one inside.
    """
    marks = [f'\n "{name}"' if top else f'"{name}"' for name in (key, *keys)]
    own = OutputFile({".json": marks}, "document")
    return click.option("--json-file", type=own, default=None, metavar="FILE", help=what)


def overwrite(what: str) -> Decorator:
    """Return the option that allows to replace what is there."""
    return click.option("--overwrite", is_flag=True, help=what)


def workers(default: int | None = 2, help: str = "Processes.") -> Decorator:
    """Return the option for how many processes work at a time."""
    return click.option(
        "--workers", default=default, show_default=True, type=click.IntRange(1, 256), help=help
    )


def many(default: int | None = 2, help: str = "Processes.") -> Decorator:
    """Return the two options for where work is done, which the command gets as one, `where`."""

    def decorated(command: Callable[..., Any]) -> Callable[..., Any]:
        @wraps(command)
        def with_pool(*args: Any, workers: int | None, address: str, **kwargs: Any) -> Any:
            from realsim.many import PoolConfig

            return command(*args, where=PoolConfig(workers=workers, address=address), **kwargs)

        address = click.option(
            "--address", default="", metavar="RAY", help="HOST:PORT of a Ray cluster, or local."
        )
        return workers(default, help)(address(with_pool))

    return decorated


def seed(what: str = "Of everything random: the same seed, the same result.") -> Decorator:
    """Return the option that chooses the random numbers."""
    return click.option("--seed", default=0, show_default=True, type=click.IntRange(0), help=what)


class Name(click.ParamType[str]):
    """What is found by name; whether there is such a thing is seen when it is looked for."""

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> str:
        """Return the text."""
        return str(value)


class ArmName(Name):
    """An arm that is found by name, or the folder of one: see `realsim.robots`."""

    name = "arm"

    def shell_complete(
        self, ctx: click.Context, param: click.Parameter, incomplete: str
    ) -> list[Any]:
        """Return the names that begin so, or let the shell find a folder."""
        from click.shell_completion import CompletionItem

        from realsim.robots.robot_files import names_of

        found = [CompletionItem(n) for n in names_of("arm") if n.startswith(incomplete.lower())]
        return found or [CompletionItem(incomplete, type="dir")]


def arm(what: str, default: str | None = None) -> Decorator:
    """Return the option that names the arm; its older name `--robot` still works."""

    def older(ctx: click.Context, param: click.Parameter, value: str | None) -> None:
        if value is not None:
            ctx.default_map = {**(ctx.default_map or {}), "arm": value}

    new = click.option(
        "--arm", type=ArmName(), default=default, show_default=True, metavar="NAME", help=what
    )
    old = click.option("--robot", hidden=True, is_eager=True, expose_value=False, callback=older)
    return lambda command: new(old(command))


class PlanName(Name):
    """A plan file, or one that comes with realsim: `shipped:NAME`."""

    name = "plan"

    def shell_complete(
        self, ctx: click.Context, param: click.Parameter, incomplete: str
    ) -> list[Any]:
        """Return shipped plans and JSON files that begin so, or let the shell find files."""
        from click.shell_completion import CompletionItem

        names = [f"shipped:{name}" for name in shipped_names()]
        if not any(name.startswith(incomplete) for name in names):
            return [CompletionItem(incomplete, type="file")]
        names += sorted(p.name for p in Path().glob("*.json"))
        return [CompletionItem(name) for name in names if name.startswith(incomplete)]


def shipped_names() -> list[str]:
    """Return the names of the plans that come with realsim, without loading their package."""
    from importlib.util import find_spec

    spec = find_spec("realsim_capture_plans")
    places = spec.submodule_search_locations if spec is not None else None
    return sorted(
        file.stem
        for place in places or ()
        for file in (Path(place) / "plan_files" / "shipped").glob("*.json")
    )
