"""What the capture tells a person and asks of one, and the plain-line way of doing so."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Literal, Protocol

from realsim_capture_plans.capturing.checks import Check

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


class Operator(Protocol):
    """A person at the capture, or nobody."""

    def show(self, status: CaptureStatus) -> None:
        """Show where the capture stands; called several times a view, must be quick."""
        ...

    def tell(self, text: str, *, trouble: bool = False) -> None:
        """Report an event; trouble also beeps."""
        ...

    def commands(self) -> list[Command]:
        """Return what the person asked for since the last call, oldest first."""
        ...

    def ask(self, text: str, choices: Sequence[Command]) -> Command | None:
        """Wait for one of the choices; None where nobody can answer."""
        ...


class NoOperator:
    """Nobody: says nothing, cannot be asked."""

    def show(self, status: CaptureStatus) -> None:
        """Show nothing."""

    def tell(self, text: str, *, trouble: bool = False) -> None:
        """Tell nobody."""

    def commands(self) -> list[Command]:
        """Return nothing."""
        return []

    def ask(self, text: str, choices: Sequence[Command]) -> Command | None:
        """Return None: nobody is there."""
        return None


class LineOperator(NoOperator):
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
