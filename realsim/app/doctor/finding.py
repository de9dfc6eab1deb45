"""What was found out about this machine, one line each."""

from dataclasses import dataclass
from typing import Literal

Kind = Literal["ok", "note", "problem"]


@dataclass(frozen=True, kw_only=True, slots=True)
class Finding:
    """One line of the doctor's tables."""

    group: str
    """Title of its table."""
    name: str
    kind: Kind
    """`problem`: something that every user needs does not work; `note`: some will miss it."""
    found: str
    todo: str = ""
    """What to do about it; empty where nothing is to be done."""
