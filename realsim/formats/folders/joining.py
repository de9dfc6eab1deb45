"""Which files belong to one frame: those of the same name, or of the same number in it.

Never by order: a list that lost one entry would pair every later one wrongly.
"""

import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import PurePosixPath
from typing import Any

import numpy as np
from numpy.typing import NDArray

from realsim.errors import InputError
from realsim.formats.folders.listing import shown

Array = NDArray[np.float64]
KIND_WORDS = frozenset(
    "aligned color colour rgb image img depth d pose poses joint joints robot tcp cam".split()
)
"""Words that say what a file is and not which frame it belongs to."""


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class FrameState:
    """What is known of a frame besides its images; joined to it by the name."""

    name: str
    """The image's name, or a name or number of its own; "" = nothing but the row's number."""
    where: str
    """Where it stands, for messages: "line 12", "poses/3.yaml"."""
    T_base_ee: Array | None = None
    """(4, 4) flange in the robot's base [m]."""
    T_world_cam: Array | None = None
    """(4, 4) camera in world [m]."""
    joints: Array | None = None
    """(6,) [rad]."""


@dataclass(frozen=True, kw_only=True, slots=True)
class Join:
    """Pairs of two lists of names."""

    pairs: dict[int, int]
    """Left -> right."""
    sentence: str
    """By what they were joined, with an example."""


def natural_key(name: str) -> list[tuple[int, int, str]]:
    """Return a sort key by which the numbers in names count as numbers: 9 before 10."""
    parts = re.split(r"(\d+)", name)
    return [(0, int(p), p) if p.isdecimal() else (1, 0, p.lower()) for p in parts if p]


def frame_key(name: str) -> str:
    """Return what a file's name says of the frame: without kind words, numbers without zeros.

    "frame-000007.color", "frame-000007.depth" and "frame_7" are one frame; "rgb_7" and "7" too.
    """
    parts = [w for w in re.split(r"[^a-z0-9]+", name.lower()) if w]
    words: list[str] = []
    for part in parts:
        letters = re.fullmatch(r"([a-z]+)(\d+)", part)  # "depth0007" has a kind word, too
        pieces = [letters[1], letters[2]] if letters and letters[1] in KIND_WORDS else [part]
        words += [p for p in pieces if p not in KIND_WORDS]
    return "_".join(re.sub(r"\d+", lambda m: str(int(m[0])), w) for w in words)


def require_unique(names: Sequence[str], stems: Sequence[str], what: str) -> list[str]:
    """Return the frame keys of names, all different.

    Raises:
        InputError: two names mean the same frame.
    """
    seen: dict[str, str] = {}
    keys = [frame_key(s) for s in stems]
    for name, key in zip(names, keys, strict=True):
        if key in seen:
            raise InputError(
                f"{seen[key]} and {name} are two {what} of one frame: which one counts is not "
                "known. Keep one of them, or move the other elsewhere."
            )
        seen[key] = name
    return keys


def running_numbers(keys: Sequence[str]) -> list[int] | None:
    """Return the number that runs through names alike but for it, None where there is none."""
    parts = [re.split(r"(\d+)", k) for k in keys]
    if not parts or any(p[::2] != parts[0][::2] for p in parts):
        return None
    columns = list(zip(*(tuple(map(int, p[1::2])) for p in parts), strict=True))
    running = [c for c in columns if len(set(c)) > 1] if len(keys) > 1 else columns
    if len(running) != 1 or len(set(running[0])) != len(keys):
        return None
    return list(running[0])


def join_names(left: Sequence[str], right: Sequence[str], left_is: str, right_is: str) -> Join:
    """Return which left belongs to which right, by equal names or by equal numbers in them.

    Args:
        left: frame keys, all different.
        right: frame keys, all different.
        left_is: what the left ones are, for messages: "colour images".
        right_is: what the right ones are.

    Raises:
        InputError: neither names nor numbers agree, or the numbers are shifted as a whole.
    """
    at = {key: k for k, key in enumerate(right)}
    pairs = {k: at[key] for k, key in enumerate(left) if key in at}
    if pairs:
        k, j = next(iter(pairs.items()))
        return Join(pairs=pairs, sentence=f"by name ('{left[k]}' with '{right[j]}')")
    numbers, others = running_numbers(left), running_numbers(right)
    names = f"{left_is}: {shown(left)}; {right_is}: {shown(right)}"
    if numbers is None or others is None:
        raise InputError(
            f"the names do not say which {right_is} belong to which {left_is}: no name is on both "
            f"sides, and no single number runs through them ({names}). Rename one side so that "
            "what belongs together has the same number, such as rgb_0001.png and depth_0001.png."
        )
    at_number = {n: k for k, n in enumerate(others)}
    pairs = {k: at_number[n] for k, n in enumerate(numbers) if n in at_number}
    differences = {a - b for a, b in zip(sorted(numbers), sorted(others), strict=False)}
    shift = differences.pop() if len(differences) == 1 and len(left) == len(right) else 0
    if not pairs or shift:
        why = f"all numbers differ by {shift:+d}" if shift else "no number is on both sides"
        raise InputError(
            f"the {left_is} and the {right_is} cannot be joined by number: {why} ({names}). Do the "
            "two count from different starts, or is the first of one side and the last of the "
            "other missing? Rename one side."
        )
    k, j = next(iter(pairs.items()))
    return Join(pairs=pairs, sentence=f"by the number in the name ('{left[k]}' with '{right[j]}')")


def join_states(keys: Sequence[str], states: Sequence[FrameState]) -> Join:
    """Return which state belongs to which frame: by its name, else by the row's number.

    A row without a name belongs to the image of its number, if the images are numbered 0 to n - 1
    or 1 to n without a gap; anything else is refused.

    Raises:
        InputError: no names, and the numbers do not fit; or two states of one frame.
    """
    named = [bool(s.name) for s in states]
    if all(named):
        stems = [PurePosixPath(s.name.replace("\\", "/")).name for s in states]
        stems = [_without_ending(s) for s in stems]
        return join_names(
            keys, require_unique([s.where for s in states], stems, "poses"), "images", "poses"
        )
    if any(named):
        first = states[named.index(False)]
        raise InputError(
            f"the pose of {first.where} names no image, the others do. Add its name, or delete it."
        )
    numbers, n = running_numbers(keys), len(states)
    if numbers is not None and sorted(numbers) in (list(range(n)), list(range(1, n + 1))):
        start = min(numbers)
        return Join(
            pairs={k: number - start for k, number in enumerate(numbers)},
            sentence=f"by row number ('{keys[numbers.index(start)]}' with {states[0].where})",
        )
    raise InputError(
        f"there are {len(keys)} images ({shown(keys)}) and {n} poses without names, and the "
        f"images are not numbered 0 to {n - 1} or 1 to {n}: which belong together is not known, "
        "and the order does not tell after a gap. Write the image's name beside each pose."
    )


def _without_ending(name: str) -> str:
    """Return a name without an image's ending: "a.color.png" becomes "a.color"."""
    return re.sub(r"\.(png|jpe?g|bmp|tiff?|webp|p[gp]m|json|ya?ml|txt)$", "", name, flags=re.I)


def plain_values(states: Sequence[FrameState]) -> list[Any]:
    """Return states as plain values, for a digest of the content."""
    return [
        [s.name, *(None if a is None else np.asarray(a).tolist()
                   for a in (s.T_base_ee, s.T_world_cam, s.joints))]
        for s in states
    ]  # fmt: skip
