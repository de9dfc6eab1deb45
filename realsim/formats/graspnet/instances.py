"""Which of two equal objects is which: instances numbered by their place in object_id_list.txt."""

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from realsim.arrays import Array
from realsim.errors import InputError
from realsim.formats.graspnet.annotations import LARGEST_NUMBER
from realsim.untrusted.files import checked_text

OBJECT_LIST = "object_id_list.txt"
MOST_OBJECTS = 10_000
LARGEST_LIST = 100_000
"""[bytes]"""


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Instances:
    """The instances of a scene."""

    places: Mapping[int, tuple[int, ...]]
    """Object number -> its places in the list; more than one where equal objects lie there."""
    points: Mapping[int, Array]
    """Number of an object that is there several times -> (n, 3) where they stand [m]."""

    def of(self, numbers: Sequence[int], points: Array | None) -> list[int | None]:
        """Return the instances of an image's objects; None where nothing tells.

        Args:
            numbers: (N,) object numbers.
            points: (N, 3) where they stand, in the frame of `self.points` [m]; None = not known.
        """
        from scipy.optimize import linear_sum_assignment

        found: list[int | None] = [None] * len(numbers)
        for number in set(numbers):
            rows = [k for k, n in enumerate(numbers) if n == number]
            places = self.places.get(number, ())
            if len(places) == 1 and len(rows) == 1:
                found[rows[0]] = places[0]
            elif points is not None and number in self.points:
                apart = np.linalg.norm(points[rows][:, None] - self.points[number][None], axis=2)
                for r, p in zip(*linear_sum_assignment(apart), strict=True):
                    found[rows[int(r)]] = places[int(p)]
        return found


def read_object_list(path: Path) -> tuple[int, ...] | None:
    """Return the object numbers of a scene, None where there is no list.

    Raises:
        InputError: something else than a whole number in each line.
    """
    if not path.is_file():
        return None
    words = checked_text(path, LARGEST_LIST).split()
    ok = len(words) <= MOST_OBJECTS and all(w.isascii() and w.isdigit() for w in words)
    if not ok or any(len(w) > 6 or int(w) > LARGEST_NUMBER for w in words):
        raise InputError(
            f"{path} holds {' '.join(words[:5])[:60]!r}; one object number from 0 to "
            f"{LARGEST_NUMBER} in each line is expected."
        )
    return tuple(int(w) for w in words)


def number_instances(
    listed: Sequence[int] | None, images: Sequence[tuple[Sequence[int], Array | None]]
) -> tuple[Instances, list[str]]:
    """Return the instances of a scene, and what must be said about them.

    Args:
        listed: object_id_list.txt; None = there is none.
        images: of some images, the object numbers (N,) and where they stand (N, 3) [m] in one
            frame for all images; None = not known.
    """
    notes: list[str] = []
    order = list(listed or ())
    for numbers, _ in images:
        counts, there = Counter(numbers), Counter(order)
        for number in numbers:
            if there[number] < counts[number]:
                order.append(number)
                there[number] += 1
    added = order[len(listed or ()) :]
    if listed is None:
        notes.append(f"there is no {OBJECT_LIST}: instances are numbered as annotations name them.")
    elif added:
        notes.append(
            f"{OBJECT_LIST} does not name object(s) {', '.join(map(str, added))}, which the "
            "annotations have; they are counted on after its end."
        )
    places = {n: tuple(k for k, m in enumerate(order) if m == n) for n in order}
    points: dict[int, Array] = {}
    for number in [n for n, p in places.items() if len(p) > 1]:
        for numbers, where in images:
            rows = [k for k, n in enumerate(numbers) if n == number]
            if where is not None and len(rows) == len(places[number]):
                points[number] = where[rows]
                break
        known = "told apart by where they stand" if number in points else "not told apart"
        notes.append(
            f"object {number} is there {len(places[number])} times; GraspNet's label images have "
            f"one value for all of them, so they have no masks. They are {known}."
        )
    return Instances(places=places, points=points), notes
