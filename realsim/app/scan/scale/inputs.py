"""What `realsim scan scale` starts from: a mesh, the views of a session, what was typed."""

import hashlib
import re
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from realsim import __version__
from realsim.app.option_values import ranges_of
from realsim.app.stages import arm_sigma_mm, content_key
from realsim.arrays import evenly
from realsim.errors import InputError
from realsim.formats.bop.models import INFO_FILE
from realsim.records import Mesh, View
from realsim.scanning.scale.measured import Measurement
from realsim.scanning.scale.result import Similarity
from realsim.store import SessionStore

if TYPE_CHECKING:
    from realsim.models.model_records import ScanSource, UpAxis
    from realsim.scanning.scale.config import ScaleConfig

LEAST_VIEWS = 3
"""Fewer views see too little of an object's sides: scale and distance cannot be told apart."""
MOST_VIEWS = 48
"""At most so many enter the fit, spread evenly, unless --only-views names them: more cost memory
and time, while a constant hand-eye error limits the result."""
LIBRARY = Path("models")
"""Where names are looked up when no library is named."""


@dataclass(frozen=True, kw_only=True, slots=True)
class ScaleRequest:
    """What the command line asks for."""

    mesh: str
    """A file, or the name of a model in the library."""
    session: Path | None = None
    """None: the scale by measured lengths alone."""
    library: Path | None = None
    """Where the scaled model goes; None = nowhere."""
    name: str = ""
    """Name of the result; empty = the mesh's."""
    up: "UpAxis | None" = None
    """Axis of the file that points up; None = as its format says."""
    start: Similarity | None = None
    size_m: float | None = None
    """Rough longest side [m]."""
    at: tuple[float, float] | None = None
    """Where the object stands, x and y in world [m]."""
    measured: tuple[Measurement, ...] = ()
    views: tuple[int, ...] = ()
    """Empty: all."""
    out: Path | None = None
    overwrite: bool = False
    accept_doubtful: bool = False
    """Whether a scale that is not accepted may go into the library."""
    obj_id: int | None = None
    """BOP id in the library; None = the next free one."""
    density: float | None = None
    """Density of the model in the library [kg/m^3]; None = the usual one."""
    mass: float | None = None
    """As weighed [kg], instead of a density."""
    json: Path | None = None
    """Where to write scale.json once more."""


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class NamedMesh:
    """The mesh that is to be scaled."""

    mesh: Mesh
    name: str
    origin: Literal["file", "unscaled", "model"]
    """A file, a model of the library without scale, or one with (which is checked: 1 is right)."""
    where: str
    """For a person: the file, or the library and the name in it."""
    sha256: str
    """SHA-256 of vertices and faces."""
    entry: str = ""
    """Its own name in the library; empty for a file."""
    library: Path | None = None
    """The library that it was read from; None for a file."""
    scaled_id: int | None = None
    """Id of the model of this name that the library has at metric scale."""
    source: "ScanSource | None" = None
    """What the library keeps of the file."""
    notes: tuple[str, ...] = ()


def name_of(request: ScaleRequest, mesh_name: str) -> str:
    """Return the name of the result: as said, or that of the mesh.

    Raises:
        InputError: nothing can be called so.
    """
    from realsim.models.library_files import require_name

    if request.name:
        return require_name(request.name)
    return require_name(re.sub(r"[^A-Za-z0-9_.+-]+", "_", mesh_name).strip("._-+"))


def mesh_hash(mesh: Mesh) -> str:
    """Return the hash of the shape."""
    digest = hashlib.sha256(mesh.vertices.tobytes())
    digest.update(mesh.faces.tobytes())
    return digest.hexdigest()


def read_mesh(request: ScaleRequest) -> NamedMesh:
    """Return the mesh that is asked for: a file, or a model of the library.

    Raises:
        InputError: it is neither; the library's models are named.
    """
    path = Path(request.mesh)
    place = _unscaled_place(path)
    if place is not None:
        folder, entry = place
        return _unscaled(folder, entry, request)
    if path.is_dir():
        raise InputError(
            f"'{path}' is a folder; a mesh file, a model's name or LIBRARY/unscaled/NAME is "
            "expected."
        )
    if path.is_file():
        return _from_file(path, request)
    return _from_library(request.mesh, request)


def _unscaled_place(path: Path) -> tuple[Path, str] | None:
    """Return library and name where a path is LIBRARY/unscaled/NAME or the mesh in it."""
    from realsim.models import library_files as files

    folder = path.parent if path.name == files.UNSCALED_MESH and path.is_file() else path
    library = folder.parent.parent
    is_entry = folder.parent.name == files.UNSCALED and (folder / files.UNSCALED_REPORT).is_file()
    return (library, folder.name) if is_entry and (library / INFO_FILE).is_file() else None


def _from_file(path: Path, request: ScaleRequest) -> NamedMesh:
    """Read a mesh file whose unit does not matter."""
    from realsim.models.library_prepare import source_of
    from realsim.models.reading import read_scan

    scan = read_scan(path, "none", request.up)
    return NamedMesh(
        mesh=scan.mesh, name=name_of(request, path.stem), origin="file",
        where=str(path), sha256=mesh_hash(scan.mesh), source=source_of(scan, path.name),
        notes=scan.notes,
    )  # fmt: skip


def _from_library(wanted: str, request: ScaleRequest) -> NamedMesh:
    """Read a model of the library: one without scale, or one whose scale is to be checked."""
    from realsim.models.library import ModelLibrary

    folder = request.library or LIBRARY
    if not (folder / INFO_FILE).is_file():
        raise InputError(
            f"'{wanted}' is no mesh file, and '{folder}' is no model library in which it could be "
            "the name of a model. Give a .glb, .obj, .ply, .stl or .usd file, or name the library "
            "with --library."
        )
    library = ModelLibrary.open(folder)
    entries = library.entries()
    plain = wanted.removeprefix("unscaled/")
    scaled_ids = {e.name: e.obj_id for e in entries if e.obj_id is not None}
    if any(e.obj_id is None and e.name == plain for e in entries):
        named = _unscaled(folder, plain, request)
        if wanted not in scaled_ids:
            return named
        note = (
            f"{folder} has '{wanted}' without scale and at metric scale; the one without is "
            f"scaled. `realsim scan scale {scaled_ids[wanted]} SESSION` checks the other."
        )
        return replace(named, notes=(*named.notes, note), scaled_id=scaled_ids[wanted])
    for name, obj_id in scaled_ids.items():
        if wanted in (name, str(obj_id)):
            mesh = library.load(wanted).model.mesh
            return NamedMesh(
                mesh=mesh, name=name_of(request, name), origin="model",
                where=f"{name} in {folder}", sha256=mesh_hash(mesh), entry=name, library=folder,
            )  # fmt: skip
    unscaled = [f"unscaled/{e.name}" for e in entries if e.obj_id is None]
    raise InputError(
        f"'{wanted}' is neither a file nor a model of the library '{folder}', which has: "
        f"{', '.join([*unscaled, *scaled_ids]) or 'nothing yet'}."
    )


def _unscaled(folder: Path, entry: str, request: ScaleRequest) -> NamedMesh:
    """Read a mesh that waits in a library for its scale."""
    from realsim.models.library import ModelLibrary

    raw = ModelLibrary.open(folder).load_unscaled(entry)
    return NamedMesh(
        mesh=raw.mesh, name=name_of(request, entry), origin="unscaled",
        where=f"unscaled/{entry} in {folder}", sha256=mesh_hash(raw.mesh), entry=entry,
        library=folder, source=raw.properties.source,
    )  # fmt: skip


def usable_views(store: SessionStore, wanted: Sequence[int]) -> list[View]:
    """Return the views with depth and camera pose that a fit uses.

    Raises:
        InputError: views that are not there, none calibrated, no depth, or fewer than three.
    """
    where = f"session '{store.folder}'"
    views = list(store.session.views)
    unknown = sorted(set(wanted) - {v.index for v in views})
    if unknown:
        raise InputError(
            f"{where} has no view {', '.join(map(str, unknown[:8]))}; its views are "
            f"{ranges_of([v.index for v in views]) or 'none'}."
        )
    asked = [v for v in views if not wanted or v.index in set(wanted)]
    with_depth = [v for v in asked if store.has_depth(v.index)]
    if not with_depth:
        raise InputError(
            f"{where} has {len(asked)} views and none with depth; a metric scale comes from depth "
            "images. Capture with depth, or give a measured length: --measured longest=120.4mm."
        )
    posed = [v for v in with_depth if v.T_world_cam is not None]
    if not posed:
        raise InputError(
            f"{where} is not calibrated: none of its {len(with_depth)} views with depth has a "
            f"camera pose. Run `realsim calibrate {store.folder}` first."
        )
    if len(posed) < LEAST_VIEWS:
        raise InputError(
            f"{where} has {len(posed)} of {len(asked)} views with depth and a camera pose "
            f"({ranges_of([v.index for v in posed])}); at least {LEAST_VIEWS} from different sides "
            "are needed. Capture more, calibrate the others, or widen --only-views."
        )
    return posed if wanted else evenly(posed, MOST_VIEWS)


def fit_config(store: SessionStore) -> "ScaleConfig":
    """Return the defaults, with what the session's own calibration knows of its errors."""
    from realsim.scanning.scale.config import ScaleConfig
    from realsim.store import load_hand_eye

    config = ScaleConfig()
    if not store.has("calibration/hand_eye.json"):
        return config
    hand_eye = load_hand_eye(store)
    return replace(
        config, hand_eye_sigma_mm=hand_eye.sigma_mm, hand_eye_sigma_deg=hand_eye.sigma_deg,
        arm_sigma_mm=arm_sigma_mm(hand_eye),
    )  # fmt: skip


def inputs_of(
    request: ScaleRequest,
    named: NamedMesh,
    store: SessionStore,
    views: Sequence[View],
    config: "ScaleConfig",
) -> dict[str, Any]:
    """Return what a result is made from, with `key`, the hash of all of it."""
    from realsim.store.session_store import depth_path

    start = request.start
    typed: dict[str, Any] = {
        "start": None if start is None else [start.scale, start.T_world_obj.tolist()],
        "size_m": request.size_m,
        "at": None if request.at is None else list(request.at),
        "measured": [m.text for m in request.measured],
        "views": [v.index for v in views],
    }
    depths = [store.path(depth_path(v.index)) for v in views]
    key = content_key(
        named.sha256, typed, asdict(config), __version__, [asdict(m) for m in request.measured],
        store.path("scene_camera.json"), store.path("robot.jsonl"), *depths,
    )  # fmt: skip
    mesh = {"name": named.name, "where": named.where, "sha256": named.sha256}
    session = {"name": store.session.name, "folder": store.folder.resolve().name}
    return {"key": key, "mesh": mesh, "session": session, **typed}
