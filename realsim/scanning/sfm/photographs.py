"""The photographs that go in: found, of one size, readable, each one named that is not."""

import hashlib
import os
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from realsim.errors import InputError
from realsim.images import image_size, read_grey

ENDINGS = (".png", ".jpg", ".jpeg", ".tif", ".tiff", ".bmp")
"""Files that are taken for photographs."""
LEAST_VIEWS = 3
"""Two views have no scale check, and their reconstruction no redundancy."""


@dataclass(frozen=True, kw_only=True, slots=True)
class Photographs:
    """Images of one camera."""

    root: Path
    """Folder that the names are relative to."""
    names: tuple[str, ...]
    size: tuple[int, int]
    """(width, height) [px]."""

    @property
    def paths(self) -> tuple[Path, ...]:
        """The files."""
        return tuple(self.root / name for name in self.names)


def photographs_in(folder: Path) -> list[Path]:
    """Return the images of a folder by name, from its rgb/ or images/ where those exist.

    Raises:
        InputError: the folder is missing or holds none.
    """
    if not folder.is_dir():
        raise InputError(
            f"'{folder}' is not a folder; a session or a folder of photographs is expected."
        )
    for place in (folder, folder / "rgb", folder / "images", folder / "color"):
        if place.is_dir():
            found = sorted(p for p in place.iterdir() if p.suffix.lower() in ENDINGS)
            if found:
                return found
    raise InputError(
        f"'{folder}' holds no images ({', '.join(e[1:] for e in ENDINGS)}), nor do rgb/, images/ "
        "or color/ in it. Give the folder that the photographs lie in, or a session."
    )


def checked_photographs(paths: Sequence[Path]) -> Photographs:
    """Return the photographs after reading each one whole.

    Raises:
        InputError: fewer than 3, one that cannot be read, or several sizes.
    """
    if len(paths) < LEAST_VIEWS:
        raise InputError(
            f"{len(paths)} photograph(s) were given; structure from motion needs {LEAST_VIEWS} at "
            "least, and 15 or more around the object for a scale that can be checked."
        )
    sizes: dict[tuple[int, int], list[str]] = {}
    for path in paths:
        read_grey(path)  # a header alone does not tell a file that was cut off
        sizes.setdefault(image_size(path), []).append(path.name)
    if len(sizes) > 1:
        told = "; ".join(
            f"{len(v)} of {w}x{h} ({', '.join(v[:3])}{', ...' if len(v) > 3 else ''})"
            for (w, h), v in sorted(sizes.items(), key=lambda item: -len(item[1]))
        )
        raise InputError(
            f"the photographs have different sizes: {told}. One camera at one resolution is "
            "expected: take the others out, or run them by themselves."
        )
    root = Path(os.path.commonpath([p.resolve().parent for p in paths]))
    names = tuple(p.resolve().relative_to(root).as_posix() for p in paths)
    return Photographs(root=root, names=names, size=next(iter(sizes)))


def images_digest(paths: Sequence[Path]) -> str:
    """Return the SHA-256 of files by name and content."""
    digest = hashlib.sha256()
    for path in paths:
        digest.update(path.name.encode() + b"\0" + hashlib.sha256(path.read_bytes()).digest())
    return digest.hexdigest()
