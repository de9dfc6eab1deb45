"""Which pose belongs to which image: by name, by number, by order, or not at all.

A pose that is paired with the wrong image spoils a calibration more than any noise, and a list that
lost one entry pairs every later one wrongly. So names come first, a bare order counts only if
nothing speaks against it, and everything else is refused with both sides listed.
"""

import re
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import PurePosixPath

from realsim.errors import InputError
from realsim.formats.folders.listing import natural_key

SHOWN = 6
"""Names of one kind that a message lists."""


@dataclass(frozen=True, kw_only=True, slots=True)
class Pairing:
    """Pairs of images and poses, and what is left over."""

    pairs: tuple[tuple[int, int], ...]
    """(image, pose row), in the order of the images."""
    sentence: str
    """How they were paired."""
    unpaired_images: tuple[tuple[int, str], ...] = ()
    """(image, reason)."""
    unpaired_poses: tuple[tuple[int, str], ...] = ()
    """(pose row, reason)."""
    warnings: tuple[str, ...] = ()


def pair(
    images: Sequence[str], labels: Sequence[str | None], stems: Sequence[str], where: Sequence[str]
) -> Pairing:
    """Return which pose belongs to which image.

    Args:
        images: names of the image files, in natural order.
        labels: the image's name that the poses' file gives with each pose, or None.
        stems: name or number of the pose itself, or "".
        where: where each pose stands, for messages.

    Raises:
        InputError: nothing but the order could pair them and the counts differ, names fit no
            image or several, or names are shifted by one.
    """
    if any(label is not None for label in labels):
        return _by_label(images, labels, where)
    image_stems = [PurePosixPath(i).stem for i in images]
    if all(stems) and len(set(stems)) == len(stems):
        found = _by_stem(images, image_stems, stems, where)
        if found is not None:
            return found
    return _by_row(images, image_stems, stems, where)


def _by_label(images: Sequence[str], labels: Sequence[str | None], where: Sequence[str]) -> Pairing:
    """Return the pairing by the images' names that the poses carry."""
    twice = [name for name, n in Counter(x for x in labels if x is not None).items() if n > 1]
    if twice:
        at = ", ".join(w for w, x in zip(where, labels, strict=True) if x == twice[0])
        raise InputError(
            f"the poses name the image '{twice[0]}' {labels.count(twice[0])} times ({at}): which "
            "of them is its pose? Delete the others."
        )
    index = [
        {name: k for k, name in enumerate(images)},
        {name.lower(): k for k, name in enumerate(images)},
        {PurePosixPath(name).stem: k for k, name in enumerate(images)},
    ]
    pairs: list[tuple[int, int]] = []
    no_image: list[tuple[int, str]] = []
    other_ending = 0
    for row, label in enumerate(labels):
        if label is None:
            no_image.append((row, f"{where[row]} names no image, the others do"))
            continue
        name = PurePosixPath(label.replace("\\", "/")).name
        tries = (name, name.lower(), PurePosixPath(name).stem)
        hit = next((m[t] for m, t in zip(index, tries, strict=True) if t in m), None)
        if hit is None:
            no_image.append((row, f"there is no image '{label}'"))
            continue
        other_ending += images[hit].lower() != name.lower()
        pairs.append((hit, row))
    taken = Counter(i for i, _ in pairs)
    double = [images[i] for i, n in taken.items() if n > 1]
    if double:
        raise InputError(f"several names of the poses mean the image '{double[0]}'. Keep one.")
    if not pairs:
        raise InputError(
            f"none of the {len(labels)} names that the poses give is an image: the poses name "
            f"{_shown([x for x in labels if x is not None])}; the images are {_shown(images)}."
        )
    how = f"by the image names beside the poses (images: {len(pairs)} of {len(images)})"
    how += f", {other_ending} of them up to the file's ending" if other_ending else ""
    return _finished(images, pairs, no_image, f"Paired {how}.", "no pose names it")


def _by_stem(
    images: Sequence[str], image_stems: Sequence[str], stems: Sequence[str], where: Sequence[str]
) -> Pairing | None:
    """Return the pairing by equal names or by equal numbers in them, None where there is none."""
    rows = {s: k for k, s in enumerate(stems)}
    pairs = [(i, rows[s]) for i, s in enumerate(image_stems) if s in rows]
    how = "by equal names"
    numbers, pose_numbers = running_numbers(image_stems), running_numbers(stems)
    if not pairs and numbers is not None and pose_numbers is not None:
        at = {n: k for k, n in enumerate(pose_numbers)}
        pairs = [(i, at[n]) for i, n in enumerate(numbers) if n in at]
        how = "by the numbers in the names"
    if not pairs:
        return None
    shift = _shift(numbers, pose_numbers)
    if shift:
        raise InputError(
            f"there are as many images as poses ({len(images)}), but the images' numbers are those "
            f"of the poses {shift:+d}: {_shown(images)} and {_shown(stems)}. Either the two count "
            "from different starts, or the first one of one side and the last one of the other are "
            "missing. Rename one side, or write the image's name beside each pose."
        )
    paired = {r for _, r in pairs}
    left = [(k, f"no image is called '{s}'") for k, s in enumerate(stems) if k not in paired]
    sentence = f"Paired {how} ({images[pairs[0][0]]} with {where[pairs[0][1]]})."
    return _finished(images, pairs, left, sentence, "no pose has its name")


def _shift(numbers: list[int] | None, pose_numbers: list[int] | None) -> int:
    """Return by how much the images' numbers exceed the poses', 0 unless all do alike."""
    if numbers is None or pose_numbers is None or len(numbers) != len(pose_numbers):
        return 0
    differences = {a - b for a, b in zip(sorted(numbers), sorted(pose_numbers), strict=True)}
    return differences.pop() if len(differences) == 1 else 0


def _by_row(
    images: Sequence[str], image_stems: Sequence[str], stems: Sequence[str], where: Sequence[str]
) -> Pairing:
    """Return the pairing by the rows' numbers or order; both need equal counts."""
    n = len(where)
    numbers = running_numbers(image_stems)
    gaps = _gaps(numbers)
    if len(images) != n:
        raise InputError(
            f"there are {len(images)} images and {n} poses, and no names say which belong "
            f"together. Images: {_shown(images)}{_gap_text(gaps)}; poses: {_shown(where)}. A list "
            "that lost one entry pairs every later one wrongly. Write the image's name beside "
            "each pose, or delete what has no partner."
        )
    order = sorted(range(n), key=lambda k: natural_key(stems[k])) if all(stems) else list(range(n))
    by_order = list(enumerate(order))
    if numbers is not None and not any(stems):
        for start in (0, 1):
            if sorted(numbers) == list(range(start, start + n)):
                pairs = [(i, number - start) for i, number in enumerate(numbers)]
                first = next(i for i, r in pairs if r == 0)
                sentence = (
                    f"Paired by number: {images[first]} with {where[0]}, and so on; all {n} "
                    "numbers are there."
                )
                return _finished(images, pairs, [], sentence, "")
    sentence = (
        f"Paired by order, as the counts agree ({n}): {images[0]} with {where[order[0]]}, "
        f"{images[-1]} with {where[order[-1]]}. No names confirm it."
    )
    warnings: list[str] = []
    if gaps:
        warnings.append(
            f"The image numbers have gaps{_gap_text(gaps)}, but there are as many poses as images: "
            "check that the poses of the missing images were left out, too."
        )
    return _finished(images, by_order, [], sentence, "", warnings)


def _gaps(numbers: list[int] | None) -> list[int]:
    """Return the numbers that are missing between the smallest and the largest."""
    if not numbers or max(numbers) - min(numbers) > 10 * len(numbers):
        return []
    return sorted(set(range(min(numbers), max(numbers) + 1)) - set(numbers))


def _gap_text(gaps: Sequence[int]) -> str:
    """Return the missing numbers for a message; empty where none are missing."""
    return f" (number {_shown([str(g) for g in gaps])} missing)" if gaps else ""


def _finished(
    images: Sequence[str],
    pairs: Sequence[tuple[int, int]],
    no_image: Sequence[tuple[int, str]],
    sentence: str,
    no_pose: str,
    warnings: Sequence[str] = (),
) -> Pairing:
    """Return the pairs in the order of the images, and the images without a pose."""
    taken = {i for i, _ in pairs}
    return Pairing(
        pairs=tuple(sorted(pairs)),
        sentence=sentence,
        unpaired_images=tuple((k, no_pose) for k in range(len(images)) if k not in taken),
        unpaired_poses=tuple(no_image),
        warnings=tuple(warnings),
    )


def _shown(names: Sequence[str]) -> str:
    """Return the first and the last names for a message."""
    if len(names) <= SHOWN:
        return ", ".join(names)
    return f"{', '.join(names[: SHOWN - 2])}, ..., {names[-1]}"


# --- names in the order people count: 9 before 10 ---------------------------------------------


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
