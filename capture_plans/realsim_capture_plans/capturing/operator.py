"""What the capture tells a person and asks of one: plain lines, or a view in the terminal.

Keys are read one by one (cbreak) by a thread; the terminal is given back as it was when the view
closes, however the capture ends.
"""

import os
import queue
import select
import signal
import sys
import termios
import threading
import time
import tty
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Literal, Self, TextIO

from realsim_capture_plans.capturing.checks import Check

if TYPE_CHECKING:
    from rich.console import RenderableType

Command = Literal["pause", "redo", "skip", "stop", "go"]
"""What a person may want: p, r, s, q, space."""


@dataclass(frozen=True, kw_only=True, slots=True)
class CaptureStatus:
    """Where the capture stands."""

    stored: int
    """Views on the disk."""
    total: int
    """Views of the plan (those asked for)."""
    view: int | None
    """The view that is being taken."""
    doing: str
    """'moving', 'settling', 'looking', 'stored'."""
    checks: tuple[Check, ...] = ()
    """What was found in the last frame."""
    retaken: int = 0
    """Frames thrown away and taken again by this run."""
    noted: int = 0
    """Views stored with a note by this run."""
    skipped: int = 0
    """Views left out by the operator in this run."""
    remaining_s: float | None = None
    """Estimated time to the end [s]."""
    dry_run: bool = False
    """Whether nothing is stored."""


class Operator:
    """Who is asked and told: as it stands nobody, who hears nothing and cannot be asked."""

    def show(self, status: CaptureStatus) -> None:
        """Show where the capture stands; called several times a view, must be quick."""

    def tell(self, text: str, *, trouble: bool = False) -> None:
        """Report an event; trouble also beeps."""

    def commands(self) -> list[Command]:
        """Return what the person asked for since the last call, oldest first."""
        return []

    def ask(self, text: str, choices: Sequence[Command]) -> Command | None:
        """Wait for one of the choices; None where nobody can answer."""
        return None


class LineOperator(Operator):
    """Lines of text for a log file or a pipe; cannot be asked."""

    def __init__(self, write: Callable[[str], None], every: int = 16) -> None:
        """Write lines with `write`: all events, and the progress every so many views."""
        self._write = write
        self._every = every
        self._told = -1

    def show(self, status: CaptureStatus) -> None:
        """Write a line after every few views."""
        due = status.stored % self._every == 0 or status.stored == status.total
        if status.doing == "stored" and due and status.stored != self._told:
            self._told = status.stored
            self._write(
                f"{status.stored} of {status.total} views{remaining(status)}"
                + (f", {status.noted} with a note" if status.noted else "")
            )

    def tell(self, text: str, *, trouble: bool = False) -> None:
        """Write a line."""
        self._write(f"trouble: {text}" if trouble else text)


def remaining(status: CaptureStatus) -> str:
    """Return ', about 3 min 20 s left', or nothing where it is not known."""
    if status.remaining_s is None or status.stored >= status.total:
        return ""
    minutes, seconds = divmod(round(status.remaining_s), 60)
    return f", about {minutes} min {seconds:02d} s left" if minutes else f", about {seconds} s left"


KEYS: dict[str, Command] = {"p": "pause", "r": "redo", "s": "skip", "q": "stop", " ": "go"}
KEY_LINE = "p pause   r redo the last view   s skip this view   q stop (all is kept)   space go on"
SAYS: dict[Command, str] = {
    "pause": "p pause",
    "redo": "r redo",
    "skip": "s skip",
    "stop": "q stop",
    "go": "space go on",
}
MARKS = {"good": ("●", "green"), "doubt": ("▲", "yellow"), "fault": ("✖", "red")}
"""Shape and colour: told apart without colours, too."""
BELL = "\a"
POLL_S = 0.05
"""How often the key thread looks whether it is to end [s]."""
DRAW_EVERY_S = 0.15
"""Least time between two drawings [s]: each costs 2-4 ms of CPU."""
BAR_WIDTH = 64
"""Characters: fits the narrowest terminal in use, 80 columns."""
EVENTS = 6
"""Events kept in view."""


def is_terminal(keys: TextIO = sys.stdin, screen: TextIO = sys.stderr) -> bool:
    """Return whether a person can see and type."""
    return keys.isatty() and screen.isatty()


class KeyReader:
    """Reads single keys from a terminal while it is open."""

    def __init__(self, handle: int) -> None:
        """Read from a file descriptor of a terminal."""
        self._handle = handle
        self._keys: queue.SimpleQueue[Command] = queue.SimpleQueue()
        self._end = threading.Event()
        self._thread: threading.Thread | None = None
        self._before: list[Any] | None = None

    def open(self) -> None:
        """Switch the terminal to single keys and begin to read."""
        self._before = termios.tcgetattr(self._handle)
        tty.setcbreak(self._handle)
        self._thread = threading.Thread(target=self._read, name="capture keys", daemon=True)
        self._thread.start()

    def close(self) -> None:
        """Stop reading and give the terminal back as it was."""
        self._end.set()
        try:
            if self._thread is not None:
                self._thread.join()
        finally:
            if self._before is not None:
                termios.tcsetattr(self._handle, termios.TCSADRAIN, self._before)
                self._before = None

    @property
    def alive(self) -> bool:
        """Whether keys can still come."""
        return self._thread is not None and self._thread.is_alive()

    def pressed(self) -> list[Command]:
        """Return the commands typed since the last call."""
        found: list[Command] = []
        while True:
            try:
                found.append(self._keys.get_nowait())
            except queue.Empty:
                return found

    def _read(self) -> None:
        while not self._end.is_set():
            ready, _, _ = select.select([self._handle], [], [], POLL_S)
            if not ready:
                continue
            try:
                data = os.read(self._handle, 64)
            except OSError:
                return
            if not data:
                return  # the terminal was closed
            for key in data.decode("utf-8", errors="replace").lower():
                if key in KEYS:
                    self._keys.put(KEYS[key])


class TerminalOperator(Operator):
    """A person at a terminal; to be used in a `with` block."""

    def __init__(self, title: str, keys: TextIO = sys.stdin, screen: TextIO = sys.stderr) -> None:
        """Prepare the view.

        Args:
            title: the head line, such as the session's folder and the devices.
            keys: the terminal that keys come from.
            screen: the terminal that the view is drawn on.
        """
        from rich.console import Console

        self._title = title
        self._keys = KeyReader(keys.fileno())
        self._console: Console = Console(file=screen, force_terminal=True, highlight=False)
        self._events: deque[tuple[str, bool]] = deque(maxlen=EVENTS)
        self._status: CaptureStatus | None = None
        self._question = ""
        self._drawn_s = -1.0
        self._live: Any = None

    def __enter__(self) -> Self:
        """Open the view and switch to single keys."""
        from rich.live import Live

        if signal.getsignal(signal.SIGINT) == signal.SIG_IGN:
            # A shell that started us in the background left Ctrl-C deaf; a person must be heard.
            signal.signal(signal.SIGINT, signal.default_int_handler)
        self._keys.open()
        try:
            self._live = Live(
                self._picture(), console=self._console, auto_refresh=False, transient=False
            )
            self._live.start()
        except BaseException:
            self._keys.close()
            raise
        return self

    def __exit__(self, *error: object) -> None:
        """Close the view and give the terminal back."""
        try:
            self._question = ""
            self._draw()
            self._live.stop()
        finally:
            self._keys.close()

    def show(self, status: CaptureStatus) -> None:
        """Show where the capture stands; not more often than the eye follows."""
        self._status = status
        if time.monotonic() - self._drawn_s >= DRAW_EVERY_S or status.stored >= status.total:
            self._draw()

    def tell(self, text: str, *, trouble: bool = False) -> None:
        """Add an event; trouble beeps."""
        self._events.append((text, trouble))
        if trouble:
            self._beep()
        self._draw()

    def commands(self) -> list[Command]:
        """Return the commands typed since the last call."""
        return self._keys.pressed()

    def ask(self, text: str, choices: Sequence[Command]) -> Command | None:
        """Beep, show the question and wait for a key of the choices."""
        self._question = f"{text}   [{' / '.join(SAYS[c] for c in choices)}]"
        self._keys.pressed()  # what was typed before the question was not meant for it
        self._beep()
        self._draw()
        try:
            while True:
                for command in self._keys.pressed():
                    if command in choices:
                        return command
                if not self._keys.alive:
                    return None  # the terminal was closed: nobody is there any more
                time.sleep(POLL_S)
        finally:
            self._question = ""
            self._draw()

    def _beep(self) -> None:
        self._console.file.write(BELL)
        self._console.file.flush()

    def _draw(self) -> None:
        self._drawn_s = time.monotonic()
        if self._live is not None:
            self._live.update(self._picture(), refresh=True)

    def _picture(self) -> "RenderableType":
        from rich.console import Group
        from rich.panel import Panel
        from rich.text import Text

        lines: list[RenderableType] = []
        s = self._status
        if s is not None:
            full = BAR_WIDTH * s.stored // max(s.total, 1)
            bar = Text("━" * full, style="green")
            bar.append("─" * (BAR_WIDTH - full), style="dim")
            lines += [bar, Text(_progress_text(s)), _check_line(s)]
        lines += [
            Text(("! " if trouble else "  ") + text, style="yellow" if trouble else "dim")
            for text, trouble in self._events
        ]
        if self._question:
            lines.append(Text(self._question, style="bold reverse"))
        title = f"{self._title}   DRY RUN" if s is not None and s.dry_run else self._title
        return Panel(Group(*lines), title=title, subtitle=KEY_LINE, title_align="left")


def _progress_text(s: CaptureStatus) -> str:
    """Return the line under the bar."""
    counts = [
        f"{n} {what}"
        for n, what in ((s.retaken, "retaken"), (s.noted, "noted"), (s.skipped, "skipped"))
        if n
    ]
    where = f"   view {s.view}: {s.doing}" if s.view is not None else ""
    said = "   " + ", ".join(counts) if counts else ""
    return f"{s.stored} of {s.total} views{remaining(s)}{where}{said}"


def _check_line(s: CaptureStatus) -> Any:
    """Return the checks as coloured marks."""
    from rich.text import Text

    line = Text()
    for check in s.checks:
        shape, colour = MARKS[check.mark]
        line.append(f"{shape} ", style=colour)
        line.append(f"{check.name} {check.value}   ")
    return line
