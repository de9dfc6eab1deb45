"""What the user sees while a stage runs: progress bars, tables, and the time each stage took."""

import os
import sys
import time
from collections.abc import Callable, Generator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass

Tick = Callable[[int, int], None]
"""Called with (done, total)."""


@dataclass(frozen=True, kw_only=True, slots=True)
class StageTime:
    """How long one stage of a run took."""

    name: str
    cpu_s: float
    """User and system time of this process and of its ended children [s]."""
    wall_s: float
    """Time on the clock [s]."""


def cpu_seconds() -> float:
    """Return the CPU time of this process and of its ended children [s]."""
    t = os.times()
    return t.user + t.system + t.children_user + t.children_system


class Console:
    """Progress on stderr, results on stdout, and a record of what each stage cost."""

    def __init__(self, *, quiet: bool = False) -> None:
        """Open the console; a quiet one draws no progress."""
        from rich.console import Console as RichConsole

        self.quiet = quiet
        self.times: list[StageTime] = []
        # Output that is piped has no width of its own: 120 columns keep a table's rows whole.
        width = None if sys.stdout.isatty() else 120
        self._out = RichConsole(highlight=False, width=width)
        self._err = RichConsole(stderr=True, highlight=False)

    @contextmanager
    def stage(self, name: str, note: str = "") -> Generator[Tick]:
        """Show a progress bar for one stage and record its cost when it ends.

        Yields:
            A function to call with (done, total).
        """
        from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn
        from rich.progress import TimeElapsedColumn as Elapsed

        cpu, wall = cpu_seconds(), time.perf_counter()
        columns = (
            TextColumn("{task.description:<34}"),
            BarColumn(bar_width=30),
            MofNCompleteColumn(),
            Elapsed(),
        )
        label = f"{name}: {note}" if note else name
        with Progress(*columns, console=self._err, disable=self.quiet) as bar:
            task = bar.add_task(label, total=None)

            def tick(done: int, total: int) -> None:
                bar.update(task, completed=done, total=total)

            yield tick
            bar.update(task, total=bar.tasks[0].total or 1, completed=bar.tasks[0].total or 1)
        self.times.append(
            StageTime(name=name, cpu_s=cpu_seconds() - cpu, wall_s=time.perf_counter() - wall)
        )

    def say(self, text: str) -> None:
        """Print one line of result."""
        self._out.print(text, soft_wrap=True, markup=False)

    def warn(self, text: str) -> None:
        """Print one line that the user must not miss."""
        self._err.print(f"[yellow]note:[/yellow] {text}", soft_wrap=True)

    def table(self, title: str, header: Sequence[str], rows: Sequence[Sequence[object]]) -> None:
        """Print a table; the first column is text, the others are right-aligned."""
        from rich.table import Table
        from rich.text import Text

        table = Table(title=title, title_justify="left", title_style="bold")
        for k, name in enumerate(header):
            table.add_column(Text(name), justify="left" if k == 0 else "right", overflow="fold")
        for row in rows:
            table.add_row(*[Text(str(cell)) for cell in row])
        self._out.print(table)
