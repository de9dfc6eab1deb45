"""Which pose belongs to which image: by name, by number, by order, or not at all.

A pose that is paired with the wrong image spoils a calibration more than any noise, and a list that
lost one entry pairs every later one wrongly. So names come first, a bare order counts only if
nothing speaks against it, and everything else is refused with both sides listed.

Where images and poses lie: beside each other, in images/ and poses/, one folder a pose.

| layout | what is read |
|---|---|
| beside each other | FOLDER/*.png with FOLDER/poses.csv or FOLDER/*.json |
| below | FOLDER/images/*.png with FOLDER/poses.csv, FOLDER/poses/*.yaml or poses in images/ |
| one folder a pose | FOLDER/pose_00/image.png with FOLDER/pose_00/data.json |
"""

import re
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path, PurePosixPath

from realsim.errors import InputError
from realsim.formats.folders.listing import natural_key
from realsim_calibration.inputs.image_files import (
    IMAGE_ENDINGS,
    ImageListing,
    image_files,
    list_images,
    require_readable,
)
from realsim_calibration.inputs.pose_file import pose_files_in, read_pose_file, read_single_files
from realsim_calibration.inputs.raw_poses import RawPoses

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


IMAGE_FOLDERS = frozenset("images image imgs img rgb color colour photos pictures".split())
"""Names of a folder that holds the images of the set that it lies in."""
POSE_FOLDERS = frozenset("poses pose robot_poses robot tcp tcp_poses ee_poses arm_poses".split())
"""Names of a folder that holds the poses."""
MADE_OF = "calibrated_of.json"
"""File that says of which images the results beside it are: they are replaced, and never read."""
MIN_FOLDERS = 3
"""Folders with one image each that are one folder a pose."""


@dataclass(frozen=True, kw_only=True, slots=True)
class PoseFolders:
    """A set with one folder a pose, in natural order."""

    listing: ImageListing
    raw: RawPoses
    names: tuple[str, ...]
    """What each image is called: "pose_00/image.png"."""


def image_folder(folder: Path) -> Path:
    """Return the folder that holds the images: the given one, or its images/ where it has none."""
    if not folder.is_dir() or _has_images(folder):
        return folder
    below = [d for d in folder.iterdir() if d.is_dir() and d.name.lower() in IMAGE_FOLDERS]
    below = [d for d in below if _has_images(d)]
    return below[0] if len(below) == 1 else folder


def poses_of(folder: Path, images: Path) -> Path:
    """Return where the poses lie of a set whose images lie in `images` below it."""
    if folder == images or not folder.is_dir() or pose_files_in(folder):
        return folder
    below = [d for d in folder.iterdir() if d.is_dir() and d.name.lower() in POSE_FOLDERS]
    below = [d for d in below if pose_files_in(d)]
    return below[0] if len(below) == 1 else images


def pose_folders(folder: Path, key: str | None) -> PoseFolders | None:
    """Return a set with one folder a pose, None where the folder is no such set.

    Raises:
        InputError: a folder lacks its image or its pose, or it is not clear which file is which.
    """
    if not folder.is_dir() or _has_images(folder) or pose_files_in(folder):
        return None
    below = sorted((d for d in folder.iterdir() if d.is_dir()), key=lambda d: natural_key(d.name))
    below = [d for d in below if not d.name.startswith(".") and any(d.iterdir())]
    below = [d for d in below if not (d / MADE_OF).is_file()]
    with_both = [d for d in below if _has_images(d) and pose_files_in(d)]
    if len(with_both) < MIN_FOLDERS:
        return None
    missing = [d.name for d in below if d not in with_both]
    try:
        listings = [list_images(d) for d in with_both]
    except InputError:
        require_readable([p for d in with_both for p in image_files(d)])
        raise
    for d, listing in zip(with_both, listings, strict=True):
        if len(listing.images) > 1:
            names = ", ".join(p.name for p in listing.images[:4])
            raise InputError(
                f"{d} holds {len(listing.images)} images ({names}); with one folder a pose each "
                "holds one image and one pose file. Take the others out."
            )
    files = [_one_pose_file(d) for d in with_both]
    images = tuple(listing.images[0] for listing in listings)
    names = tuple(f"{p.parent.name}/{p.name}" for p in images)
    raw = read_single_files(folder, files, [f"{p.parent.name}/{p.name}" for p in files], key)
    reason = "this folder holds no image with a pose file"
    return PoseFolders(
        listing=ImageListing(
            images=images,
            depths=tuple(listing.depths[0] for listing in listings),
            ignored=tuple((name, reason) for name in missing),
        ),
        raw=raw,
        names=names,
    )


def _one_pose_file(folder: Path) -> Path:
    """Return the one pose file of a folder: of several, the only one that holds a pose."""
    files = pose_files_in(folder)
    if len(files) > 1:
        readable: list[Path] = []
        for file in files:
            try:
                read_pose_file(file)
            except InputError:
                continue
            readable.append(file)
        files = readable or files
    if len(files) != 1:
        names = ", ".join(p.name for p in files[:4])
        raise InputError(
            f"{folder} holds {len(files)} pose files ({names}); with one folder a pose each holds "
            "one image and one pose file. Take the others out."
        )
    return files[0]


def _has_images(folder: Path) -> bool:
    return any(p.suffix.lower() in IMAGE_ENDINGS and p.is_file() for p in folder.iterdir())
