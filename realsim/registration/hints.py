"""What a person or a network says of the objects: read, written, and turned into what is wanted.

On the command line an object is named as

    5                       object 5, anywhere on the table
    mug                     the same by its name
    5x2                     two instances of it
    5@view3:640,360         a click: it is seen at column 640, row 360 of view 3
    5@view3:100,80,60x40    a box: left 100, top 80, width 60, height 40

and in the session's `registration/starts.json` as rows of "starts", beside a "source":

    {"obj_id": 5, "instance": 0}                                             anywhere
    {..., "T_world_obj": [[...]], "radius_mm": 30, "turn_deg": 20}           a rough pose [m]
    {..., "click": {"view": 3, "pixel": [640, 360]}}
    {..., "box": {"view": 3, "xywh": [100, 80, 60, 40]}}
    {..., "mask": {"view": 3, "file": "masks/5.png"}}     beside starts.json, not 0 = the object

`radius_mm` and `turn_deg` say how far off the pose may be; without them it is 45 mm and 38 deg.
"""

import re
from collections.abc import Mapping, Sequence
from difflib import get_close_matches
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from realsim.arrays import Array
from realsim.errors import InputError, UnitError
from realsim.geometry import se3
from realsim.images import read_image
from realsim.records import CameraIntrinsics, ObjectModel, SupportPlane
from realsim.registration.evidence import DepthFrame, EvidenceConfig, measure_noise
from realsim.registration.find_table import find_table
from realsim.registration.hint_regions import (
    Box,
    Click,
    Hint,
    HintScene,
    Marked,
    RoughPose,
    Where,
    region_of,
)
from realsim.registration.search.records import Wanted
from realsim.registration.views import SampleConfig, sample_views
from realsim.store import SessionStore
from realsim.untrusted.own_json import read_object

MOST_INSTANCES = 100
"""Instances of one object that can be asked for at once."""
KINDS = ("T_world_obj", "click", "box", "mask")
KEYS = ("obj_id", "instance", *KINDS, "radius_mm", "turn_deg")
FARTHEST_M = 10.0
"""An object that is further from the robot's base than this was given in millimetres [m]."""
TABLE_VIEWS = 12
"""Number of views in which the table is sought; hints need no more."""
TABLE_STRIDE = 8
"""Every so many pixels of them."""
NUMBER = r"-?\d+(?:\.\d+)?"
TYPED = re.compile(
    rf"(?P<object>[^@]+)(?:@view(?P<view>\d+):(?P<x>{NUMBER}),(?P<y>{NUMBER})"
    rf"(?:,(?P<w>{NUMBER})x(?P<h>{NUMBER}))?)?"
)
GRAMMAR = (
    "Accepted are 5 (or a name) = anywhere, 5x2 = two of them, 5@view3:640,360 = seen at that "
    "pixel, 5@view3:100,80,60x40 = seen in that box (left, top, width x height)"
)


def parse_object(text: str, models: Mapping[int, ObjectModel]) -> list[Hint]:
    """Return what one typed object says; several hints if it counts them. Instances are 0, 1 ...

    Raises:
        InputError: the text is not understood, or there is no such object.
    """
    match = TYPED.fullmatch(text.strip())
    if match is None:
        raise InputError(f"'{text}' does not name an object. {GRAMMAR}.")
    said = match["object"].strip()
    obj_id, count = _object_of(said, models), 1
    counted = re.fullmatch(r"(.+)x(\d+)", said)
    if obj_id is None and counted is not None:
        obj_id, count = _object_of(counted[1], models), int(counted[2])
    if obj_id is None:
        known = ", ".join(f"{k} ({m.name})" for k, m in sorted(models.items()))
        raise InputError(f"there is no object '{said}'; there are: {known or 'none'}. {GRAMMAR}.")
    where: Where = None
    if match["view"] is not None:
        x, y, view = float(match["x"]), float(match["y"]), int(match["view"])
        where = Click(view=view, pixel=(x, y))
        if match["w"] is not None:
            where = Box(view=view, xywh=(x, y, float(match["w"]), float(match["h"])))
    if not 1 <= count <= MOST_INSTANCES or (count > 1 and where is not None):
        room = f"; 1 to {MOST_INSTANCES} can be looked for."
        room = room if where is None else " at one place; name each with its own place."
        raise InputError(f"'{text}' asks for {count} instances{room}")
    return [Hint(obj_id=obj_id, instance=k, where=where) for k in range(count)]


def parse_objects(
    texts: Sequence[str], models: Mapping[int, ObjectModel], store: SessionStore
) -> list[Wanted]:
    """Return what is typed, instances numbered in the order given.

    Raises:
        InputError: see `parse_object` and `region_of`.
    """
    hints = [h for text in texts for h in parse_object(text, models)]
    numbered = [Hint(obj_id=h.obj_id, instance=k, where=h.where) for k, h in enumerate(hints)]
    return _wanted_in(store, numbered, models)


def read_starts(path: Path, models: Mapping[int, ObjectModel], store: SessionStore) -> list[Wanted]:
    """Return what a starts file says.

    Raises:
        InputError: see `read_hints` and `region_of`.
        UnitError: a pose is in millimetres.
    """
    return _wanted_in(store, read_hints(path, models), models)


def read_hints(path: Path, models: Mapping[int, ObjectModel]) -> list[Hint]:
    """Return the rows of a starts file; files of rough poses only are read as ever.

    Raises:
        InputError: a row has an unknown key or object, an instance twice, or a wrong value; the
            message names row and value.
        UnitError: a pose is in millimetres.
    """
    data = read_object(path)
    rows: Any = data.get("starts")
    if not isinstance(rows, list):
        raise InputError(
            f"{path} has no list 'starts'; it has: {', '.join(data) or 'nothing'}. A row for each "
            'object is expected, such as {"obj_id": 5, "instance": 0}.'
        )
    hints: list[Hint] = []
    listed: list[Any] = rows  # pyright: ignore[reportUnknownVariableType]
    for n, row in enumerate(listed):
        label = f"{path.name}, row {n}"
        if not isinstance(row, dict):
            raise InputError(f"{label} is {row!r}; an object with obj_id and instance is expected.")
        values: dict[str, Any] = {str(k): v for k, v in row.items()}  # pyright: ignore[reportUnknownVariableType, reportUnknownArgumentType]
        hint = _hint_of(values, n, label, path.parent, models)
        if any(h.instance == hint.instance for h in hints):
            raise InputError(
                f"{label}: instance {hint.instance} is there twice; every row needs its own."
            )
        hints.append(hint)
    return hints


def _hint_of(
    row: dict[str, Any], n: int, label: str, folder: Path, models: Mapping[int, ObjectModel]
) -> Hint:
    """Return what one row of a starts file says."""
    unknown = [k for k in row if k not in KEYS]
    if unknown:
        close = "".join(f" Did you mean {k}?" for k in get_close_matches(unknown[0], KEYS, n=1))
        raise InputError(
            f"{label} has the key '{unknown[0]}'.{close} There are: {', '.join(KEYS)}."
        )
    obj_id, instance = row.get("obj_id"), row.get("instance", n)
    if not isinstance(obj_id, int) or obj_id not in models:
        raise InputError(
            f"{label}: obj_id is {obj_id!r}; there are models of: "
            f"{', '.join(map(str, sorted(models))) or 'none'}."
        )
    if not isinstance(instance, int) or isinstance(instance, bool) or instance < 0:
        raise InputError(f"{label}: instance is {instance!r}; a whole number from 0 is expected.")
    said = [k for k in KINDS if row.get(k) is not None]
    if len(said) > 1:
        raise InputError(f"{label} says where the object is twice: {' and '.join(said)}. Keep one.")
    if said != ["T_world_obj"] and {"radius_mm", "turn_deg"} & set(row):
        raise InputError(
            f"{label}: radius_mm and turn_deg belong to T_world_obj, which it has not."
        )
    where = _where_of(said[0], row, label, folder) if said else None
    return Hint(obj_id=obj_id, instance=instance, where=where)


def _where_of(kind: str, row: dict[str, Any], label: str, folder: Path) -> Where:
    """Return the place that a row of a starts file names."""
    if kind == "T_world_obj":
        T = _rigid(row[kind], label)
        radius, turn = (
            None if row.get(k) is None else float(_numbers([row[k]], 1, f"{label}, {k}")[0])
            for k in ("radius_mm", "turn_deg")
        )
        for name, value in (("radius_mm", radius), ("turn_deg", turn)):
            if value is not None and value <= 0:
                raise InputError(f"{label}: {name} is {value:g}; more than 0 is expected.")
        return RoughPose(
            T_world_obj=T, radius_m=None if radius is None else radius / 1e3, turn_deg=turn
        )
    part, second = row[kind], {"click": "pixel", "box": "xywh", "mask": "file"}[kind]
    if not isinstance(part, dict) or set(part) != {"view", second}:  # pyright: ignore[reportUnknownArgumentType]
        raise InputError(f"{label}: {kind} is {part!r}; view and {second} are expected.")
    view: Any = part["view"]
    value: Any = part[second]
    if not isinstance(view, int) or isinstance(view, bool):
        raise InputError(f"{label}: the view is {view!r}; the number of a view is expected.")
    if kind == "click":
        u, v = _numbers(value, 2, f"{label}, pixel")
        return Click(view=view, pixel=(u, v))
    if kind == "box":
        x, y, w, h = _numbers(value, 4, f"{label}, xywh")
        return Box(view=view, xywh=(x, y, w, h))
    file = folder / str(value)
    if not file.is_file():
        raise InputError(f"{label}: there is no mask {file}; a file beside starts.json is meant.")
    mask = np.asarray(read_image(file))
    flat = mask.reshape(*mask.shape[:2], -1).any(axis=2)
    return Marked(view=view, inside=np.asarray(flat, dtype=np.bool_))


def _numbers(values: Any, count: int, label: str) -> list[float]:
    """Return so many finite numbers."""
    try:
        array = np.asarray(values, dtype=np.float64)
    except (TypeError, ValueError):
        array = np.zeros(0)
    if array.shape != (count,) or not np.isfinite(array).all():
        raise InputError(f"{label}: {values!r} was found; {count} finite numbers are expected.")
    return [float(x) for x in array]


def _rigid(values: ArrayLike, label: str) -> Array:
    """Return a rigid (4, 4) transform in metres."""
    try:
        T = se3.check_rigid(np.asarray(values, dtype=np.float64), f"{label}: T_world_obj")
    except (TypeError, ValueError) as error:
        raise InputError(f"{label}: T_world_obj is {values!r}; 4 rows of 4 numbers.") from error
    if T.shape != (4, 4):
        raise InputError(f"{label}: T_world_obj has shape {T.shape}; (4, 4) is expected.")
    far = float(np.linalg.norm(T[:3, 3]))
    if far > FARTHEST_M:
        raise UnitError(
            f"{label}: T_world_obj puts the object {far:.4g} m from the origin; at most "
            f"{FARTHEST_M:g} m is accepted. Metres are expected: were millimetres given?"
        )
    return T


def wanted_objects(
    hints: Sequence[Hint], models: Mapping[int, ObjectModel], scene: HintScene
) -> list[Wanted]:
    """Return what is wanted: each hint's object with its region and, of a rough pose, the pose.

    Raises:
        InputError: see `region_of`.
    """
    return [
        Wanted(
            obj_id=h.obj_id,
            instance=h.instance,
            region=region_of(h, models[h.obj_id], scene),
            T_start=h.where.T_world_obj if isinstance(h.where, RoughPose) else None,
        )
        for h in hints
    ]


def _object_of(said: str, models: Mapping[int, ObjectModel]) -> int | None:
    """Return the id of an object by its name or number, or None."""
    named = [k for k, m in models.items() if m.name == said]
    if len(named) > 1:
        raise InputError(f"'{said}' is the name of objects {named}; give the number of one.")
    if named:
        return named[0]
    return int(said) if said.isdecimal() and int(said) in models else None


def _wanted_in(
    store: SessionStore, hints: Sequence[Hint], models: Mapping[int, ObjectModel]
) -> list[Wanted]:
    """Return what is wanted in a session; its images are only read where a hint speaks of them."""
    camera = store.session.intrinsics
    poses = {v.index: v.T_world_cam for v in store.session.views if store.has_depth(v.index)}
    seen = {h.where.view for h in hints if isinstance(h.where, Click | Box | Marked)}
    placed = {k: T for k, T in poses.items() if T is not None}
    frames: dict[int, DepthFrame] = {}
    plane: SupportPlane | None = None
    if seen:
        some = sorted(placed)[:: max(1, -(-len(placed) // TABLE_VIEWS))]
        for k in sorted({*some, *(seen & set(placed))}):
            frames[k] = DepthFrame(index=k, depth_m=store.depth_m(k), T_world_cam=placed[k])
        up = store.extra.get("gravity_up_world")
        plane = _table(camera, [frames[k] for k in some], up)
        unknown = sorted(seen - set(placed))
        if unknown:
            raise InputError(
                f"a hint names view {unknown[0]}; it is not one of the {len(placed)} views with "
                "depth and a camera pose."
            )
    scene = HintScene(intrinsics=camera, frames=frames, plane=plane)
    return wanted_objects(hints, models, scene)


def _table(camera: CameraIntrinsics, frames: Sequence[DepthFrame], up: Any) -> SupportPlane | None:
    """Return the table in some views, if it is found."""
    try:
        noise = measure_noise(frames, EvidenceConfig())
    except InputError:
        return None  # hardly any depth: then there is no table either
    views = sample_views(camera, frames, noise, SampleConfig(stride=TABLE_STRIDE))
    return find_table(views, noise, gravity_up_world=up).plane
