"""What the user sees while a stage runs: progress, tables, and the time each stage took.

Progress and notes go to stderr, results to stdout. Where a result is asked for as JSON, stdout
holds that document and nothing else.
"""

import os
import sys
import time
from collections.abc import Callable, Generator, Iterable, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import click

if TYPE_CHECKING:
    from pathlib import Path

    from rich.console import Console as RichConsole

Tick = Callable[[int, int], None]
"""Called with (done, total)."""
Progress = Callable[[str, int, int], None]
"""Called with (what is done, done, total)."""
SECONDS_BETWEEN_LINES = 10.0
"""Least time between two lines of progress in a log [s]: one can see that it goes on, no more."""
SECONDS_BETWEEN_SAME = 120.0
"""The same where nothing has changed since [s]."""
PIPED_WIDTH = 120
"""Columns of output that is piped: it has no width of its own, and 120 keep most rows whole."""


@dataclass(frozen=True, kw_only=True, slots=True)
class StageTime:
    """How long one stage of a run took."""

    name: str
    cpu_s: float
    """User and system time of this process and of its ended children [s]."""
    wall_s: float
    """Time on the clock [s]."""


@dataclass(eq=False, kw_only=True)
class Told:
    """What a command tells a caller in Python: the object (`obj`) of click's context."""

    tables: list[tuple[str, Sequence[str], list[list[str]]]] = field(default_factory=list[Any])
    """Title, header and rows of every table."""
    notes: list[str] = field(default_factory=list[str])
    """What the user must not miss."""
    document: Any = None
    """The whole result, as `--json` has it."""
    passed: bool = True
    """Whether no check failed: the command's exit code is 0."""
    progress: Progress | None = None
    """Called as a stage goes on; None = as on the command line."""


def cpu_seconds() -> float:
    """Return the CPU time of this process and of its ended children [s]."""
    t = os.times()
    return t.user + t.system + t.children_user + t.children_system


class Console:
    """Progress on stderr, results on stdout, and a record of what each stage cost."""

    def __init__(self, *, quiet: bool = False, as_json: bool = False) -> None:
        """Open the console.

        Args:
            quiet: show no progress.
            as_json: stdout is for the document of `result` alone: lines go to stderr, tables
                (whose figures are in the document) nowhere.
        """
        self.quiet = quiet
        self.as_json = as_json
        self.times: list[StageTime] = []
        self._out = _rich(stderr=as_json)
        self._err = _rich(stderr=True)
        self._last_line = time.monotonic()
        self._doing = ""
        context = click.get_current_context(silent=True)
        self._told = None if context is None else context.find_object(Told)

    @contextmanager
    def stage(self, name: str, note: str = "") -> Generator[Tick]:
        """Show the progress of one stage and record its cost when it ends.

        A terminal gets a bar with the remaining time; a log gets a line now and then.

        Yields:
            A function to call with (done, total).
        """
        cpu, wall = cpu_seconds(), time.perf_counter()
        label = f"{name}: {note}" if note else name
        self._doing = ""
        progress = None if self._told is None else self._told.progress
        if progress is not None:
            yield lambda done, total: progress(label, done, total)
        elif self.quiet:
            yield _no_tick
        elif sys.stderr.isatty() and not self._err.is_dumb_terminal:
            with self._bar(label) as tick:
                yield tick
        else:
            yield self._lines(label)
        self.times.append(
            StageTime(name=name, cpu_s=cpu_seconds() - cpu, wall_s=time.perf_counter() - wall)
        )

    @contextmanager
    def steps(self, name: str) -> Generator[Progress]:
        """Show one step of a stage after another: a step's bar ends when the next begins.

        Yields:
            A function to call with (step, done, total).
        """
        with ExitStack() as stack:
            bars: dict[str, Tick] = {}

            def tell(step: str, done: int, total: int) -> None:
                if step not in bars:
                    stack.close()
                    bars.clear()
                    bars[step] = stack.enter_context(self.stage(name, step))
                bars[step](done, total)

            yield tell

    @contextmanager
    def _bar(self, label: str) -> Generator[Tick]:
        """Draw a progress bar on the terminal."""
        from rich import progress as parts
        from rich.table import Column

        columns = (
            parts.TextColumn(
                "{task.description}",
                markup=False,
                # The label gives way where the terminal is narrow, the figures never.
                table_column=Column(ratio=1, no_wrap=True, overflow="ellipsis"),
            ),
            parts.BarColumn(bar_width=20),
            parts.MofNCompleteColumn(),
            parts.TimeElapsedColumn(),
            parts.TextColumn("left"),
            parts.TimeRemainingColumn(),
        )
        with parts.Progress(*columns, console=self._err, expand=self._err.width < 100) as bar:
            task = bar.add_task(label, total=None)

            def tick(done: int, total: int) -> None:
                words = f"{label}: {self._doing}" if self._doing else label
                bar.update(task, completed=done, total=total, description=words)

            yield tick
            total = bar.tasks[0].total or 1
            bar.update(task, total=total, completed=total)

    def _lines(self, label: str) -> Tick:
        """Return what writes a line of progress into a log, at most every ten seconds."""
        begun, told = time.monotonic(), (-1, -1, "")

        def tick(done: int, total: int) -> None:
            nonlocal told
            at, now = time.monotonic(), (done, total, self._doing)
            least = SECONDS_BETWEEN_SAME if now == told else SECONDS_BETWEEN_LINES
            if total <= 0 or at - self._last_line < least:
                return
            self._last_line, told = at, now
            left = f", {duration((at - begun) * (total - done) / done)} left" if done > 0 else ""
            share = f"{100 * done // total} %"
            self._err.print(
                f"{label}: {share} ({done} of {total}){left}"
                f"{f': {self._doing}' if self._doing else ''}",
                soft_wrap=True, markup=False,
            )  # fmt: skip

        return tick

    def doing(self, words: str) -> None:
        """Say what the stage does now: shown with its next step."""
        self._doing = words

    def say(self, *texts: str) -> None:
        """Print lines of the result."""
        if not (self.quiet and (self.as_json or self._told is not None)):
            for text in texts:
                self._out.print(text, soft_wrap=True, markup=False)

    def warn(self, *texts: str) -> None:
        """Print lines that the user must not miss."""
        from rich.markup import escape

        if self._told is not None:
            self._told.notes += texts
        for text in texts:
            self._err.print(f"[yellow]note:[/yellow] {escape(text)}", soft_wrap=True)

    def result(self, document: object, file: "Path | None" = None) -> None:
        """Print the command's whole result as JSON, if it was asked for; once in a command.

        Args:
            document: a mapping or a record (see `json_values`).
            file: that takes it, too: plain JSON values then.
        """
        if file is not None:
            from realsim.store.atomic import write_json

            write_json(file, document)
        if self._told is not None:
            self._told.document = document
        if self.as_json:
            from realsim.json_values import json_document

            # Not through rich: no colour, no wrapping, nothing but the document.
            sys.stdout.write(json_document(document) + "\n")
            sys.stdout.flush()

    def table(self, title: str, header: Sequence[str], rows: Iterable[Sequence[object]]) -> None:
        """Print a table: text is left-aligned (the first column, and sentences), figures right.

        Where it is too wide for its words, each row becomes a block of lines instead: no number is
        cut in two.
        """
        from rich.text import Text

        if self.as_json:
            return
        cells = [[str(cell) for cell in row] for row in rows]
        if self._told is not None:
            self._told.tables.append((title, header, cells))
            return
        self._out.print(Text(title, style="bold"))
        if _least_width(header, cells) > self._out.width:
            self._blocks(header, cells)
        else:
            self._grid(header, cells)

    def _grid(self, header: Sequence[str], cells: list[list[str]]) -> None:
        from rich.table import Table
        from rich.text import Text

        table = Table(show_header=any(header))
        for k, name in enumerate(header):
            table.add_column(
                Text(name),
                justify="left" if k == 0 or _is_text(k, cells) else "right",
                overflow="fold",
                min_width=min(_column_width(k, header, cells), self._out.width),
            )
        for row in cells:
            table.add_row(*[Text(cell) for cell in row])
        self._out.print(table)

    def _blocks(self, header: Sequence[str], cells: list[list[str]]) -> None:
        """Print each row as lines of `name  value`."""
        from rich.text import Text

        for row in cells:
            self._out.print(Text(row[0] if row else ""))
            for name, cell in zip(header[1:], row[1:], strict=False):
                if cell:
                    self._out.print(Text(f"  {name}: {cell}" if name else f"  {cell}"))


def shortened(lines: Sequence[str], most: int, rest: str) -> list[str]:
    """Return at most so many lines, and one that says how many more there are: {} in `rest`."""
    return [*lines[:most], *[rest.format(len(lines) - most)] * (len(lines) > most)]


def duration(seconds: float) -> str:
    """Return a time as people say it: 40 s, 12 min, 3 h 20 min."""
    if seconds < 90:
        return f"{seconds:.0f} s"
    minutes = round(seconds / 60)
    return f"{minutes} min" if minutes < 90 else f"{minutes // 60} h {minutes % 60} min"


def open_missing_streams() -> None:
    """Lead streams that whoever started this process has closed (`>&-`) to the null device.

    Python has None for them, which every library that writes a line would stumble over. Their
    numbers are taken, too: the next file that is opened would get number 1 or 2, and what a library
    in C prints, or a process that is started, would be written into it.
    """
    streams = (("stdin", "r"), ("stdout", "w"), ("stderr", "w"))
    missing = [(k, *stream) for k, stream in enumerate(streams) if getattr(sys, stream[0]) is None]
    # All numbers first: a stream that is opened before would take the next one's.
    for number, _, _ in missing:
        try:
            os.fstat(number)
        except OSError:
            null = os.open(os.devnull, os.O_RDWR)
            if null != number:
                os.dup2(null, number)
                os.close(null)
            os.set_inheritable(number, True)  # a process that is started has it, too
    for _, name, mode in missing:
        setattr(sys, name, open(os.devnull, mode, encoding="utf-8"))


def _no_tick(done: int, total: int) -> None:
    """Take notice of nothing."""


def _rich(*, stderr: bool) -> "RichConsole":
    """Return rich's console of one stream: colours for terminals that want them.

    NO_COLOR (not empty) wins over FORCE_COLOR, and a file gets no control characters unless
    FORCE_COLOR asks for them.
    """
    from rich.console import Console as RichConsole

    class Piped(RichConsole):
        def on_broken_pipe(self) -> None:
            # Rich would end with exit code 1, which says that a check failed.
            raise BrokenPipeError

    stream = sys.stderr if stderr else sys.stdout
    plain = bool(os.environ.get("NO_COLOR"))
    forced = False if plain and not stream.isatty() else None
    width = None if sys.stdout.isatty() or stderr else PIPED_WIDTH
    return Piped(stderr=stderr, highlight=False, width=width, force_terminal=forced)


def _is_text(k: int, cells: list[list[str]]) -> bool:
    """Return whether a column holds sentences, which wrapped lines would tear at the right."""
    return any(len(row[k]) > LONGEST_WORD for row in cells if k < len(row))


def _column_width(k: int, header: Sequence[str], cells: list[list[str]]) -> int:
    """Return the characters of the longest word in a column; a path may be folded."""
    words = " ".join([header[k], *(row[k] for row in cells if k < len(row))]).split()
    return max((min(len(w), LONGEST_WORD) for w in words), default=0)


LONGEST_WORD = 24
"""Longer words are paths and hashes, which may be folded; numbers are not that long."""


def _least_width(header: Sequence[str], cells: list[list[str]]) -> int:
    """Return the columns that a table takes with a word in a line: content, padding, lines."""
    return 1 + sum(_column_width(k, header, cells) + 3 for k in range(len(header)))
