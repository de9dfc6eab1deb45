"""Where objects come from: PyBullet's procedural ones, folders of meshes, a model library.

A pool is a list of names in a fixed order; a mesh is read when it is drawn. What cannot be used is
skipped and named, so that one broken file of ten thousand does not end a run.
"""

import hashlib
import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np

from realsim.errors import InputError

Kind = Literal["pybullet", "meshes", "library"]
PYBULLET = "pybullet"
"""Name of the pool that comes with PyBullet."""
OBJECTS = "random_urdfs"
"""Its folder in pybullet_data: 1000 procedural objects, each of convex parts."""


@dataclass(frozen=True, kw_only=True, slots=True)
class PoolSource:
    """One place that objects come from."""

    label: str
    """As the user named it."""
    kind: Kind
    folder: Path
    keys: tuple[str, ...]
    """Files below the folder, or object ids of a library, in a fixed order."""
    weight: float = 1.0
    """How often objects are drawn from here, against the other sources' weights."""

    @property
    def digest(self) -> str:
        """What tells another content of the pool: its kind, names and sizes of its files."""
        content = hashlib.sha256(f"{self.kind} {self.weight:g}".encode())
        for key in self.keys:
            path = self.folder / key
            size = path.stat().st_size if path.is_file() else 0
            content.update(f"{key} {size}\n".encode())
        return content.hexdigest()[:16]


@dataclass(frozen=True, kw_only=True, slots=True)
class ObjectPool:
    """Sources that objects are drawn from."""

    sources: tuple[PoolSource, ...]

    def __len__(self) -> int:
        """Return how many objects there are."""
        return sum(len(s.keys) for s in self.sources)

    def draw(self, rng: np.random.Generator) -> tuple[int, str]:
        """Return the number of a source, by the weights, and one of its keys, all alike."""
        weights = np.array([s.weight for s in self.sources])
        source = int(rng.choice(len(weights), p=weights / weights.sum()))
        keys = self.sources[source].keys
        return source, keys[int(rng.integers(len(keys)))]

    @property
    def digest(self) -> str:
        """What tells another pool."""
        return hashlib.sha256(" ".join(s.digest for s in self.sources).encode()).hexdigest()[:16]


def open_pool(texts: Sequence[str]) -> ObjectPool:
    """Return the pool of what the user named.

    Args:
        texts: 'pybullet', a folder of meshes (nested ones, too), or a model library, each with
            '=WEIGHT' after it where they are not to be drawn alike.

    Raises:
        InputError: none is named, or one holds no object; what was found is said.
    """
    if not texts:
        raise InputError("no pool of objects is named; 'pybullet' or a folder of meshes is needed.")
    return ObjectPool(sources=tuple(_source(text) for text in texts))


def _source(text: str) -> PoolSource:
    name, weight = _weighed(text)
    if name == PYBULLET:
        folder = _pybullet_folder()
        keys = tuple(f"{p.name}/{p.name}.obj" for p in sorted(folder.iterdir()) if p.is_dir())
        return PoolSource(label=name, kind="pybullet", folder=folder, keys=keys, weight=weight)
    folder = Path(name)
    if not folder.is_dir():
        raise InputError(
            f"--pool '{name}' is {'a file' if folder.exists() else 'no folder'}; 'pybullet', a "
            "folder of meshes (ABC's, too) or a model library is accepted, with =WEIGHT after it "
            "if several are not to be drawn alike."
        )
    kind, keys = _content(folder)
    return PoolSource(label=name, kind=kind, folder=folder, keys=keys, weight=weight)


def _weighed(text: str) -> tuple[str, float]:
    """Return the name and the weight of 'NAME=WEIGHT'; a name may hold '=' itself."""
    name, mark, number = text.rpartition("=")
    if not mark or Path(text).exists():
        return text, 1.0
    try:
        weight = float(number)
    except ValueError:
        return text, 1.0
    if not (math.isfinite(weight) and weight > 0):
        raise InputError(f"--pool '{text}': the weight {number} is not positive; 1 is usual.")
    return name, weight


def _pybullet_folder() -> Path:
    from realsim import interop

    with interop.quiet_output():
        import pybullet_data

    folder = Path(pybullet_data.getDataPath()) / OBJECTS
    if not folder.is_dir():
        raise InputError(
            f"PyBullet's own objects are not installed: {folder} is missing. Install pybullet "
            "again, or name a folder of meshes with --pool."
        )
    return folder


def _content(folder: Path) -> tuple[Kind, tuple[str, ...]]:
    """Return what a folder holds.

    Raises:
        InputError: no object; what is there is named.
    """
    from realsim.formats.bop.models import INFO_FILE
    from realsim.models.library_files import read_info
    from realsim.models.reading import SCAN_FORMATS

    if (folder / INFO_FILE).is_file():
        keys = tuple(str(obj_id) for obj_id in sorted(read_info(folder)))
        if not keys:
            raise InputError(
                f"the model library '{folder}' is empty; `realsim scan import MESH --library "
                f"{folder}` adds a model."
            )
        return "library", keys
    files = sorted(
        p.relative_to(folder).as_posix()
        for p in folder.rglob("*")
        if p.suffix.lower() in SCAN_FORMATS and not p.name.startswith(".") and p.is_file()
    )
    if not files:
        found = ", ".join(sorted(p.name for p in folder.iterdir())[:6]) or "nothing"
        raise InputError(
            f"the pool '{folder}' holds no mesh (it holds {found}); files of the kinds "
            f"{', '.join(SCAN_FORMATS)} are read, in folders below it, too."
        )
    return "meshes", tuple(files)
