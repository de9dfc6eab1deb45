"""What options take: lists and numbers of views, points, names that the shell completes, ports."""

import errno
import re
import socket
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import click
from click.shell_completion import CompletionItem

LARGEST_RANGE = 100_000
"""Numbers of one range: more are a typing error, not views."""
FOLDER = click.Path(path_type=Path)
"""A file or folder as a pathlib.Path; whoever opens it says what is wrong with it."""


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
        from realsim.robots.robot_files import names_of

        found = [CompletionItem(n) for n in names_of("arm") if n.startswith(incomplete.lower())]
        return found or [CompletionItem(incomplete, type="dir")]


class PlanName(Name):
    """A plan file, or one that comes with realsim: `shipped:NAME`."""

    name = "plan"

    def shell_complete(
        self, ctx: click.Context, param: click.Parameter, incomplete: str
    ) -> list[Any]:
        """Return shipped plans and JSON files that begin so, or let the shell find files."""
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


class Numbers(click.ParamType[Sequence[int]]):
    """A comma-separated list of numbers and ranges, such as 1-3,7."""

    name = "numbers"

    def convert(
        self, value: Any, param: click.Parameter | None, ctx: click.Context | None
    ) -> Sequence[int]:
        """Return the numbers."""
        return numbers_of(value) if isinstance(value, str) else value


class Amount(click.IntRange):
    """A number, or one of other words, which are passed on as they are; A-B stands for any text."""

    def __init__(self, least: int, most: int, *words: str) -> None:
        """Take the range and the words that are accepted, too."""
        super().__init__(least, most)
        self.words = words

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Any:
        """Return the word or the number."""
        is_word = not str(value).isdecimal() and {value, "A-B"} & {*self.words}
        return value if is_word else super().convert(value, param, ctx)

    def get_metavar(self, param: click.Parameter, ctx: click.Context) -> str:
        """Return what is accepted."""
        return "|".join(("N", *self.words))


class DepthUnit(click.FloatRange):
    """Metres per count of depth images."""

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Any:
        """Return the number."""
        low, high, unit = self.min or 0.0, self.max or 0.0, click.FLOAT.convert(value, param, ctx)
        if not low <= unit <= high:
            self.fail(
                f"{unit:g} m a count is refused; {low:g} to {high:g} is accepted "
                "(0.001 where the counts are millimetres).", param, ctx,
            )  # fmt: skip
        return unit


def numbers_of(text: str) -> tuple[int, ...]:
    """Return the numbers of a comma-separated list such as 1-3,7; a range includes its ends.

    Raises:
        click.BadParameter: it is no such list.
    """
    numbers: list[int] = []
    for part in text.split(",") if text else ():
        found = re.fullmatch(r"\s*(\d{1,9})(?:\s*-\s*(\d{1,9}))?\s*", part)
        if found is None:
            raise click.BadParameter(
                f"'{text}' is not a comma-separated list of numbers and ranges, such as 1-3,7"
            )
        first = int(found[1])
        last = int(found[2] or first)
        if not 0 <= last - first < LARGEST_RANGE:
            raise click.BadParameter(f"'{part.strip()}' is no range from a number to a larger one")
        numbers += range(first, last + 1)
    return tuple(numbers)


def ranges_of(numbers: Sequence[int]) -> str:
    """Return numbers as '1-3, 7'."""
    ranges: list[list[int]] = []
    for k in sorted(numbers):
        if ranges and ranges[-1][1] == k - 1:
            ranges[-1][1] = k
        else:
            ranges.append([k, k])
    return ", ".join(f"{a}" if a == b else f"{a}-{b}" for a, b in ranges)


def port_in_use(host: str, port: int) -> bool:
    """Return whether another program listens at the port."""
    try:
        place = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)[0]
        with socket.socket(place[0], place[1]) as probe:
            probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            probe.bind(place[4])
    except OSError as error:  # whatever else is wrong is named by who listens
        return error.errno == errno.EADDRINUSE
    return False


def point_of(text: str) -> tuple[float, float] | None:
    """Return x,y [m] of a text, None for an empty one.

    Raises:
        InputError: it is no point on a table.
    """
    from realsim.errors import InputError

    if not text:
        return None
    number = r"\s*([-+]?(?:\d+\.?\d*|\.\d+))\s*"
    found = re.fullmatch(f"{number},{number}", text)
    if found is None:
        raise InputError(f"--at '{text}' is no point; x,y in metres, such as 0.40,-0.05, is one.")
    x, y = float(found[1]), float(found[2])
    # An arm that grasps reaches no further than this: beyond, millimetres were typed.
    if max(abs(x), abs(y)) > 3.0:
        raise InputError(
            f"--at {text} lies {max(abs(x), abs(y)):g} m from the robot; at most 3 m is accepted. "
            "Were millimetres typed? Metres are expected."
        )
    return x, y
