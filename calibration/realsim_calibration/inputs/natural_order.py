"""File names in the order people count: 9 before 10."""

import re
from collections.abc import Sequence


def natural_key(name: str) -> list[tuple[int, int, str]]:
    """Return a sort key by which the numbers in names count as numbers."""
    parts = re.split(r"(\d+)", name)
    return [(0, int(p), p) if p.isdecimal() else (1, 0, p.lower()) for p in parts if p]


def running_numbers(stems: Sequence[str]) -> list[int] | None:
    """Return the one number that runs through names alike but for it, None where there is none.

    "0-1", "0-2", "0-10" run in their second number; "12-30-05" and "12-31-07" in none.
    """
    if not stems:
        return None
    parts = [re.split(r"(\d+)", s) for s in stems]
    if any(p[::2] != parts[0][::2] for p in parts):
        return None
    columns = list(zip(*(tuple(map(int, p[1::2])) for p in parts), strict=True))
    if len(stems) == 1:
        return [columns[0][0]] if len(columns) == 1 else None
    running = [c for c in columns if len(set(c)) > 1]
    if len(running) != 1 or len(set(running[0])) != len(stems):
        return None
    return list(running[0])
