"""Where objects come from: PyBullet's procedural ones, folders of meshes, a model library.

A pool is a list of names in a fixed order; a mesh is read when it is drawn. What cannot be used is
skipped and named, so that one broken file of ten thousand does not end a run.
"""

import hashlib
import math
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal, cast

import numpy as np

from realsim.arrays import Array, Int64
from realsim.errors import InputError
from realsim.geometry.mesh_shape import hull_triangles
from realsim.models.convex import ConvexConfig, convex_parts
from realsim.models.convex_hulls import hull_volume
from realsim.models.model_records import ConvexParts, ScanUnit
from realsim.records import Mesh
from realsim_sim_bridge.table_scenes.config import PoolConfig

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
    shared: frozenset[str] = frozenset()
    """Names that several objects of the pool would have: each gets one of its own."""

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
    sources = [_source(text) for text in texts]
    times = Counter(name for source in sources for name in _names(source))
    shared = frozenset(name for name, n in times.items() if n > 1)
    return ObjectPool(sources=tuple(replace(source, shared=shared) for source in sources))


def _source(text: str) -> PoolSource:
    name, weight = _weighed(text)
    if name == PYBULLET:
        folder = pybullet_folder()
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


def pybullet_folder() -> Path:
    """Return where the objects that come with PyBullet are on this machine."""
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


# --- An object of a pool as it is read: mesh, convex parts, and why it cannot be used ------------


CUT_SIZE_M = 0.1
"""Largest extent at which a mesh is cut into convex parts [m]: one result for all its sizes."""
BYTES_PER_MB = 1e6
LEAST_PART = 1e-6
"""Convex parts of a smaller share of all of them's volume are flat: nothing collides with them."""


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class PoolObject:
    """An object of a pool in the numbers of its file."""

    name: str
    """Letters, digits, '_', '-' and '.' only."""
    mesh: Mesh
    parts: ConvexParts
    symmetries: Array
    """(S, 4, 4) known symmetries, the identity first; translations in the mesh's numbers."""
    symmetry_axes: tuple[tuple[tuple[float, float, float], tuple[float, float, float]], ...] = ()
    has_look: bool = False
    """Whether it has a texture or colours of its own, which are kept."""
    density: float | None = None
    """[kg/m^3] where it is known; None = the scenes' own."""

    @property
    def middle(self) -> Array:
        """(3,) the middle of its box."""
        return self.mesh.bounds.mean(axis=0)


def read_object(
    source: PoolSource, key: str, config: PoolConfig, cache: Path | None = None
) -> PoolObject:
    """Read an object.

    Args:
        source: where it comes from.
        key: which one.
        config: what is refused.
        cache: folder for convex parts; None = none are kept.

    Raises:
        InputError: it cannot be used; the message begins with its file.
    """
    path = source.folder / key
    if source.kind == "library":
        return _from_library(source, int(key), config)
    if path.is_file() and path.stat().st_size > config.most_mb * BYTES_PER_MB:
        size = path.stat().st_size / BYTES_PER_MB
        raise InputError(f"{path} has {size:.0f} MB; up to {config.most_mb:g} MB are read.")
    mesh, parts = _pybullet_mesh(path) if source.kind == "pybullet" else (None, None)
    if mesh is None:
        mesh = _folder_mesh(path, config)
    _check(mesh, str(path), config)
    if parts is None:
        parts = _parts(mesh, config, cache)
    return PoolObject(
        name=_told_apart(_name_of(source, key), source, key),
        mesh=mesh,
        parts=parts,
        symmetries=np.eye(4)[None],
        has_look=mesh.colors is not None or mesh.texture is not None,
    )


def _pybullet_mesh(path: Path) -> tuple[Mesh, ConvexParts]:
    """Return mesh and parts of a procedural object: every `o` of its OBJ is a convex part."""
    rows: list[list[list[float]]] = []
    try:
        for line in path.read_text(encoding="ascii").splitlines():
            words = line.split()
            if words[:1] == ["o"]:
                rows.append([])
            elif words[:1] == ["v"] and rows:
                rows[-1].append([float(w) for w in words[1:4]])
    except (OSError, ValueError) as error:
        raise InputError(f"{path} is no procedural object of PyBullet ({error}).") from error
    scale = 0.015  # of every URDF beside them
    # Some of the files have parts whose coordinates are 'nan'; PyBullet drops them, too.
    arrays = [scale * np.array(r) for r in rows if len(r) >= 4]
    solid = [part for part in arrays if np.all(np.isfinite(part))]
    volumes = np.array([hull_volume(part) for part in solid])
    if not volumes.sum() > 0:
        raise InputError(f"{path} has no convex part with a volume.")
    kept = [p for p, v in zip(solid, volumes, strict=True) if v > LEAST_PART * volumes.sum()]
    corners: list[Array] = []
    faces: list[Int64] = []
    for part in kept:
        at, triangles = hull_triangles(part)
        faces.append(triangles + sum(len(c) for c in corners))
        corners.append(at)
    mesh = Mesh(vertices=np.concatenate(corners), faces=np.concatenate(faces).astype(np.int32))
    # The mesh is the hulls of its parts, so they are exactly as large.
    return mesh, ConvexParts(parts=tuple(corners), volume_ratio=1.0, method="pybullet_data")


def _folder_mesh(path: Path, config: PoolConfig) -> Mesh:
    from realsim.models.reading import read_scan

    unit = cast(ScanUnit, config.unit if config.keep_size else "none")
    return read_scan(path, unit).mesh


def _from_library(source: PoolSource, obj_id: int, config: PoolConfig) -> PoolObject:
    from realsim.models.library_reading import LibraryReader

    found = LibraryReader(source.folder).load(obj_id)
    mesh = found.model.mesh
    _check(mesh, f"object {obj_id} of {source.folder}", config)
    parts = found.parts if found.parts is not None else _parts(mesh, config, None)
    return PoolObject(
        name=_told_apart(found.model.name, source, str(obj_id)),
        mesh=mesh,
        parts=parts,
        symmetries=found.model.symmetries,
        symmetry_axes=found.model.symmetry_axes,
        has_look=mesh.colors is not None or mesh.texture is not None,
        density=found.model.density,
    )


def _check(mesh: Mesh, name: str, config: PoolConfig) -> None:
    """Raise if a mesh is too large, or too flat to be an object on a table."""
    if len(mesh.faces) > config.most_faces:
        raise InputError(
            f"{name} has {len(mesh.faces)} triangles; up to {config.most_faces} are used. Thin it "
            "out (`realsim scan import`)."
        )
    used = np.unique(mesh.vertices[np.unique(mesh.faces)], axis=0)
    about = used - used.mean(axis=0)
    _, _, axes = np.linalg.svd(about[:: max(1, len(about) // 5000)], full_matrices=False)
    widths = np.ptp(about @ axes.T, axis=0) if len(axes) == 3 else np.zeros(3)
    largest = float(np.max(mesh.extent))
    if not float(widths.min()) > config.least_flatness * largest:
        raise InputError(
            f"{name} is flat: {100 * float(widths.min()) / max(largest, 1e-300):.2g} % of its "
            f"largest extent at its thinnest; {100 * config.least_flatness:g} % are needed."
        )


def _parts(mesh: Mesh, config: PoolConfig, cache: Path | None) -> ConvexParts:
    """Return the convex parts of a mesh in its numbers."""
    size = float(np.max(mesh.extent)) / CUT_SIZE_M
    middle = mesh.bounds.mean(axis=0)
    at_size = Mesh(vertices=(mesh.vertices - middle) / size, faces=mesh.faces)
    if config.hull_only:
        hull = hull_triangles(at_size.vertices)[0]
        parts = ConvexParts(parts=(hull,), volume_ratio=1.0, method="hull")
    else:
        parts = convex_parts(at_size, ConvexConfig(), cache)
    return ConvexParts(
        parts=tuple(size * part + middle for part in parts.parts),
        volume_ratio=parts.volume_ratio,
        method=parts.method,
        seconds=parts.seconds,
        notes=parts.notes,
    )


def _names(source: PoolSource) -> list[str]:
    """Return the names of a source's objects, by themselves."""
    from realsim.models.library_files import model_file, read_info

    if source.kind != "library":
        return [_name_of(source, key) for key in source.keys]
    infos = read_info(source.folder).items()
    return [str(info.get("name", Path(model_file(i)).stem)) for i, info in infos]


def _told_apart(name: str, source: PoolSource, key: str) -> str:
    """Return the name, with a mark of the file where others of the pool would have it, too."""
    if name not in source.shared:
        return name
    mark = hashlib.sha256(f"{source.label}/{key}".encode()).hexdigest()[:6]
    return f"{name[-57:].lstrip('-.+')}-{mark}"


def _name_of(source: PoolSource, key: str) -> str:
    """Return a name of the characters that a model library accepts."""
    stem = Path(key).with_suffix("").as_posix()
    if source.kind == "pybullet":
        return f"pybullet-{Path(key).stem}"
    plain = "".join(c if c.isascii() and (c.isalnum() or c in "_-.") else "-" for c in stem)
    plain = plain.strip("-.") or "mesh"
    return f"mesh-{plain[-60:].lstrip('-.')}" if plain.isdigit() else plain[-64:].lstrip("-.+")
