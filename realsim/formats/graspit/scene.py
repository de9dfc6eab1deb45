"""The scenes of GraspIT (KochPJ/GraspIt): scene.yaml, meshes beside it, grasps.hdf5.

    object1: {file_path: assets/cup.usd, name: cup, orientation: [4], position: [3], scale: [3]}
    table: {...}                      grasp_path: scenes/scene_0/grasps.hdf5

Metres, world z up. The file does not say in which order its quaternions are written, so the content
has to prove it: read in the right order, the objects stand at one height and the grasps' contacts
lie on the objects. USD files are read from the STL of the same name.

Grasps are in `grasps`, writing in `writing`.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from os.path import isfile  # a name that no file can have is not there, and no error
from pathlib import Path
from typing import Any, Literal, cast, get_args

import numpy as np

from realsim.arrays import Array
from realsim.errors import InputError
from realsim.formats.graspit.grasps import GRASP_FILE, SAMPLED_GRASPS, midway_error, read_grasp_file
from realsim.geometry import se3
from realsim.geometry.mesh import load_mesh
from realsim.records import Mesh, ObjectModel, ObjectPose, Scene, SupportPlane
from realsim.untrusted.yaml_text import read_yaml

QuaternionOrder = Literal["wxyz", "xyzw"]
ORDERS: tuple[QuaternionOrder, ...] = get_args(QuaternionOrder)
SCENE_FILE, TABLE = "scene.yaml", "table"
LARGEST_YAML = 4_000_000
"""[bytes]: ten thousand objects; a scene has ten."""
MOST_OBJECTS = 1000
TABLE_TOLERANCE_M = 0.003
"""Objects whose lowest points differ by less stand on the same plane: physics left them there, with
the engine's own tolerance."""
CLEARER = 3.0
"""The right order's evidence is at least so many times better than the wrong one's."""
EVIDENCE_FLOOR_M = 0.001
"""Distance that is added to both before: the grasps were snapped to samples a millimetre apart."""


@dataclass(frozen=True, kw_only=True, slots=True)
class _Evidence:
    """What speaks for one order of the quaternions; less is better, NaN = there is none."""

    spread_m: float
    """Median distance of the objects' lowest points from their common height [m]."""
    midway_m: float
    """Median distance of a grasp's origin from the middle of its contacts [m]."""


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class GraspitScene:
    """A scene.yaml as it was read."""

    scene: Scene
    models: dict[int, ObjectModel]
    order: QuaternionOrder
    grasp_file: Path | None
    """None: there is none beside the scene."""
    names: dict[int, str]
    """Names of the objects in the file, by instance; grasps are kept under them."""
    notes: tuple[str, ...]


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class _Entry:
    """One object of the file."""

    name: str
    mesh_file: Path
    numbers: Array
    """(4,) the quaternion, in the file's order."""
    position: Array
    scale: tuple[float, float, float]


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class _Placed:
    """An object with its mesh, which the quaternions are judged by."""

    entry: _Entry
    mesh: Mesh
    Ts_world_grasp: Array
    """(N, 4, 4) some of its grasps."""

    def T_world_obj(self, order: QuaternionOrder) -> Array:
        q = self.entry.numbers if order == "wxyz" else np.roll(self.entry.numbers, 1)
        return se3.from_rt(se3.from_quaternion_wxyz(q), self.entry.position)


def is_graspit_scene(path: Path) -> bool:
    """Return whether this file, or the scene.yaml in this folder, looks like a scene of GraspIT."""
    path = path / SCENE_FILE if path.is_dir() else path
    if path.suffix not in (".yaml", ".yml") or not path.is_file():
        return False
    with path.open("rb") as file:
        head = file.read(20_000)
    return b"file_path" in head and b"orientation" in head and b"position" in head


def read_graspit_scene(
    path: Path | str, *, order: QuaternionOrder | None = None, meshes: Path | None = None
) -> GraspitScene:
    """Read a scene and prove the order of its quaternions.

    Objects with the same file and scale are instances of one model; ids count models from 1 in the
    order of the file, instances count objects from 0.

    Args:
        path: scene.yaml, or the folder that holds it.
        order: of the quaternions, where it is known; None = to be proven.
        meshes: folder of the meshes, where they are not beside the scene or in assets/.

    Raises:
        InputError: something is missing or damaged, or the content proves neither order.
    """
    path = Path(path)
    path = path / SCENE_FILE if path.is_dir() else path
    data = _read_yaml(path)
    entries = _entries(data, path, meshes)
    grasp_file = _beside(path.parent, str(data.get("grasp_path", GRASP_FILE)))
    notes = [] if grasp_file else ["there is no grasps.hdf5 beside the scene."]
    placed = _placed(entries, grasp_file, notes)
    if order is None:
        order, said = _proven(placed, path)
        notes.append(said)
    Ts = [p.T_world_obj(order) for p in placed]
    plane, said = _table(placed, Ts, path)
    notes += [said, *_leaning(placed, Ts, plane)]
    keys = list(dict.fromkeys((e.mesh_file, e.scale) for e in entries))
    models: dict[int, ObjectModel] = {}
    objects: list[ObjectPose] = []
    for k, (p, T) in enumerate(zip(placed, Ts, strict=True)):
        obj_id = 1 + keys.index((p.entry.mesh_file, p.entry.scale))
        if obj_id not in models:
            models[obj_id] = ObjectModel(obj_id=obj_id, name=p.entry.name, mesh=p.mesh)
        objects.append(ObjectPose(obj_id=obj_id, instance=k, T_world_obj=T))
    name = path.stem if path.name != SCENE_FILE else path.resolve().parent.name
    return GraspitScene(
        scene=Scene(name=name, objects=tuple(objects), plane=plane),
        models=models,
        order=order,
        grasp_file=grasp_file,
        names={k: e.name for k, e in enumerate(entries)},
        notes=tuple(notes),
    )


# --- the file -----------------------------------------------------------------------------------


def _read_yaml(path: Path) -> dict[str, Any]:
    """Return the file's mapping of plain values."""
    if not path.is_file():
        raise InputError(f"{path} does not exist; the {SCENE_FILE} of a GraspIT scene is expected.")
    data = read_yaml(path, most_bytes=LARGEST_YAML)
    if not isinstance(data, dict):
        raise InputError(f"{path} holds no named objects; object1: {{file_path: ...}} is expected.")
    mapping = cast("dict[Any, Any]", data)
    return {str(key): value for key, value in mapping.items()}


def _entries(data: dict[str, Any], path: Path, meshes: Path | None) -> list[_Entry]:
    """Return the objects of the file; the table is none."""
    found: list[_Entry] = []
    for key, value in data.items():
        if not isinstance(value, Mapping):
            continue
        fields = cast("Mapping[str, Any]", value)
        where = f"'{key}' of {path}"
        lacking = [k for k in ("file_path", "name", "orientation", "position") if k not in fields]
        if lacking:
            raise InputError(f"{where} has no {', '.join(lacking)}.")
        if key == TABLE or fields["name"] == TABLE:
            continue
        sx, sy, sz = _numbers(fields.get("scale", (1.0, 1.0, 1.0)), 3, f"the scale of {where}")
        if min(sx, sy, sz) <= 0:
            raise InputError(f"the scale of {where} is {[sx, sy, sz]}; positive ones are needed.")
        q = _numbers(fields["orientation"], 4, f"the orientation of {where}")
        if abs(float(np.linalg.norm(q)) - 1.0) > 0.01:
            raise InputError(
                f"the orientation of {where} has the length {float(np.linalg.norm(q)):.3g}; a "
                "quaternion of length 1 is needed."
            )
        found.append(
            _Entry(
                name=str(fields["name"]),
                mesh_file=_mesh_file(str(fields["file_path"]), path.parent, meshes, where),
                numbers=np.array(q),
                position=np.array(_numbers(fields["position"], 3, f"the position of {where}")),
                scale=(sx, sy, sz),
            )
        )
    if not 0 < len(found) <= MOST_OBJECTS:
        raise InputError(f"{path} holds {len(found)} objects; 1 to {MOST_OBJECTS} are expected.")
    return found


def _numbers(value: Any, count: int, name: str) -> list[float]:
    try:
        numbers = [float(v) for v in value]
    except (TypeError, ValueError):
        numbers = []
    if len(numbers) != count or not np.all(np.isfinite(numbers)):
        raise InputError(f"{name} is {str(value)[:60]!r}; {count} finite numbers are needed.")
    return numbers


def _beside(folder: Path, name: str) -> Path | None:
    """Return the file of this name in the scene's folder: paths in the file are of its authors."""
    path = folder / Path(name).name
    return path if isfile(path) else None


def _mesh_file(name: str, folder: Path, meshes: Path | None, where: str) -> Path:
    if not Path(name).stem:
        raise InputError(f"the mesh of {where} is {name!r}, which names no file.")
    stl = f"{Path(name).stem}.stl"
    places = [p for p in (meshes, folder, folder / "assets") if p is not None]
    for place in places:
        if isfile(place / stl):
            return place / stl
    raise InputError(
        f"the mesh of {where} is {name}; neither it nor {stl} can be read from "
        f"{', '.join(map(str, places))}. Put {stl} (in metres) there, or name its "
        "folder (`--models FOLDER`)."
    )


def _placed(entries: list[_Entry], grasp_file: Path | None, notes: list[str]) -> list[_Placed]:
    grasps = read_grasp_file(grasp_file) if grasp_file is not None else {}
    known: dict[tuple[Path, tuple[float, float, float]], Mesh] = {}
    placed: list[_Placed] = []
    for e in entries:
        key = (e.mesh_file, e.scale)
        if key not in known:
            known[key] = _mesh(e, notes)
        Ts = grasps.get(e.name, np.zeros((0, 2, 4, 4)))[:, 0]
        some = Ts[:: max(1, len(Ts) // SAMPLED_GRASPS)]
        placed.append(_Placed(entry=e, mesh=known[key], Ts_world_grasp=some))
    return placed


LARGEST_MM_SCALE = 0.01
"""Scales up to this are taken as the conversion of a file in millimetres."""


def _mesh(e: _Entry, notes: list[str]) -> Mesh:
    """Return an object's mesh [m], its scale applied; what is missing is added to the notes.

    Raises:
        InputError: it cannot be read, or is not in metres; object and file are named.
    """
    scale = np.array(e.scale)
    # A scale of thousandths is what makes metres of a file in millimetres.
    unit, metres = ("mm", 1e-3) if scale.max() <= LARGEST_MM_SCALE else ("m", 1.0)
    try:
        mesh = load_mesh(e.mesh_file, unit, notes)
    except (InputError, ValueError, IndexError, TypeError) as error:
        raise InputError(
            f"the object '{e.name}' of the scene cannot be read from {e.mesh_file}: {error} In a "
            "scene.yaml meshes are in metres; one in millimetres needs `scale: [0.001, 0.001, "
            "0.001]` there."
        ) from error
    return Mesh(vertices=mesh.vertices * (scale / metres), faces=mesh.faces)


# --- what the content proves --------------------------------------------------------------------


def _lowest(placed: list[_Placed], Ts: list[Array]) -> Array:
    heights = [
        float(se3.transform(T, p.mesh.vertices)[:, 2].min())
        for p, T in zip(placed, Ts, strict=True)
    ]
    return np.array(heights)


def _evidence(placed: list[_Placed], order: QuaternionOrder) -> _Evidence:
    Ts = [p.T_world_obj(order) for p in placed]
    low = _lowest(placed, Ts)
    spread = float(np.median(np.abs(low - np.median(low)))) if len(low) > 1 else float("nan")
    errors = [
        midway_error(p.mesh, se3.invert(T) @ p.Ts_world_grasp, "y")
        for p, T in zip(placed, Ts, strict=True)
        if len(p.Ts_world_grasp)
    ]
    midway = float(np.median(np.concatenate(errors))) if errors else float("nan")
    return _Evidence(spread_m=spread, midway_m=midway)


def _proven(placed: list[_Placed], path: Path) -> tuple[QuaternionOrder, str]:
    """Return the order that the content proves, and the sentence that says how.

    Raises:
        InputError: nothing speaks for either, or one thing for each.
    """
    evidence: dict[QuaternionOrder, _Evidence] = {o: _evidence(placed, o) for o in ORDERS}
    a, b = (evidence[o] for o in ORDERS)
    given = (_vote(a.spread_m, b.spread_m), _vote(a.midway_m, b.midway_m))
    votes: set[QuaternionOrder] = {v for v in given if v is not None}
    words = "; ".join(f"{o}: {_in_words(e)}" for o, e in evidence.items())
    if len(votes) == 1:
        order = votes.pop()
        return (
            order,
            f"quaternions are in the order {order[0]} {order[1]} {order[2]} {order[3]} "
            + (f"({words})."),
        )
    Ts = [np.stack([p.T_world_obj(o) for p in placed]) for o in ORDERS]
    if np.abs(Ts[0] - Ts[1]).max() < 1e-9:
        return "wxyz", "both orders of the quaternions give the same poses."
    raise InputError(
        f"{path}: the order of the quaternions cannot be told from the content ({words}). Say "
        "which one it is: `--quaternions wxyz` or `--quaternions xyzw` (order='wxyz' or 'xyzw')."
    )


def _in_words(e: _Evidence) -> str:
    """Return what an order would mean for the content."""
    spread = f"lowest points within {1e3 * e.spread_m:.1f} mm"
    if np.isnan(e.spread_m):
        spread = "one object, nothing to stand level with"
    if np.isnan(e.midway_m):
        return f"{spread}, no grasps to compare"
    return f"{spread}, grasps {1e3 * e.midway_m:.1f} mm off the middle of their contacts"


def _vote(wxyz: float, xyzw: float) -> QuaternionOrder | None:
    """Return the order for which one kind of evidence speaks clearly, None if for neither."""
    if np.isnan(wxyz) or np.isnan(xyzw):
        return None
    a, b = wxyz + EVIDENCE_FLOOR_M, xyzw + EVIDENCE_FLOOR_M
    if CLEARER * a < b:
        return "wxyz"
    return "xyzw" if CLEARER * b < a else None


def _table(placed: list[_Placed], Ts: list[Array], path: Path) -> tuple[SupportPlane, str]:
    """Return the plane at the height that most objects' lowest points agree on, the lower first."""
    low = np.sort(_lowest(placed, Ts))
    near = np.abs(low[:, None] - low) < TABLE_TOLERANCE_M
    on = low[near[int(np.argmax(near.sum(1)))]]
    height = float(np.median(on))
    rms = float(np.sqrt(np.mean(np.square(on - height))))
    missing = not any((path.parent / f"{TABLE}{s}").is_file() for s in (".stl", ".obj", ".usd"))
    why = "the table's mesh is not there" if missing else "the table's own mesh is not needed"
    plane = SupportPlane(
        T_world_table=se3.from_translation([0.0, 0.0, height]), rms_m=rms, inliers=len(on)
    )
    return plane, (
        f"{why}: its height, {height:.4f} m, is that of the lowest points of {len(on)} of "
        f"{len(low)} objects."
    )


def _leaning(placed: list[_Placed], Ts: list[Array], plane: SupportPlane) -> list[str]:
    """Name the objects that do not touch the table as they are given."""
    gaps = _lowest(placed, Ts) - plane.T_world_table[2, 3]
    off = [
        f"{p.entry.name} {1e3 * g:+.1f} mm"
        for p, g in zip(placed, gaps.tolist(), strict=True)
        if abs(g) > TABLE_TOLERANCE_M / 2
    ]
    return [f"not at the table's height: {', '.join(off)}."] if off else []
