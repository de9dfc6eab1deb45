"""Hand-written TOML: the mount file and the work cell file.

A mount file says where the camera sits and what holds it:

name = "printed bracket, left"
camera = "D405"
translation_m = [0.0, -0.065, 0.035]          # the camera's frame in the flange, z out of it
rotation_vector_rad = [0.0, 0.0, 0.0]         # or quaternion_xyzw, or matrix (3 rows of 3)
cover_m = 0.005                               # round camera and bracket: cable, screws

[[bracket]]                                   # without any, a plain bracket is assumed
kind = "box"                                  # box, capsule, cylinder, sphere
size_m = [0.04, 0.09, 0.006]
position_m = [0.0, -0.03, 0.003]              # the piece's centre in the flange
rotation_vector_rad = [0.0, 0.0, 0.0]

[[bracket]]
kind = "convex"                               # the convex hull of a mesh
file = "bracket.stl"
unit = "mm"

A work cell file says what the arm keeps away from:

[[obstacles]]
name = "back wall"
lower_m = [-2.0, 0.70, -1.0]      # in the controller's base; inf and -inf are accepted
upper_m = [2.0, 0.75, 2.0]
"""

import math
from difflib import get_close_matches
from pathlib import Path
from typing import Any, cast

import numpy as np

from realsim.arrays import Array
from realsim.errors import InputError, UnitError
from realsim.geometry import se3
from realsim.interop import unbroken
from realsim.robots.shapes import SIZES, Box, Kind, Mount, Shape
from realsim.untrusted.toml_text import read_toml
from realsim_capture_plans.collision.mount import FLANGE, camera_body, plain_bracket


class Fields:
    """One table of a TOML file; remembers which file and where, for messages."""

    def __init__(self, values: dict[str, Any], where: str, known: tuple[str, ...]) -> None:
        """Check the keys.

        Raises:
            InputError: a key that is not known; it is named with the nearest known one.
        """
        self.values, self.where = values, where
        if unknown := [key for key in values if key not in known]:
            key = unknown[0]
            near = get_close_matches(key, known, n=1, cutoff=0.5)
            meant = f" Was '{near[0]}' meant?" if near else ""
            raise InputError(f"{where}: '{key}' is not known.{meant} There are {', '.join(known)}.")

    def text(self, key: str) -> str:
        """Return a text that must be there."""
        value = self.values.get(key)
        if not isinstance(value, str) or not value.strip():
            raise InputError(f"{self.where}: {key} is {_shown(value)}; a text is needed.")
        return value

    def number(self, key: str, default: float) -> float:
        """Return a finite number, or the default."""
        value = self.values.get(key, default)
        if not _is_number(value):
            raise InputError(f"{self.where}: {key} is {_shown(value)}; a number is needed.")
        return float(value)

    def row(self, key: str, count: int, default: tuple[float, ...] | None = None) -> list[float]:
        """Return a list of `count` numbers, finite or not."""
        value = self.values.get(key, default)
        if (
            not isinstance(value, list | tuple)
            or len(value) != count
            or not all(isinstance(v, int | float) and not isinstance(v, bool) for v in value)
        ):
            raise InputError(
                f"{self.where}: {key} is {_shown(value)}; a list of {count} numbers is needed."
            )
        return [float(v) for v in value]

    def finite_row(
        self, key: str, count: int, default: tuple[float, ...] | None = None
    ) -> list[float]:
        """Return a list of `count` finite numbers."""
        row = self.row(key, count, default)
        if not all(math.isfinite(v) for v in row):
            raise InputError(f"{self.where}: {key} is {row}; finite numbers are needed.")
        return row

    def tables(self, key: str) -> list[dict[str, Any]]:
        """Return the [[key]] tables, none if there are none."""
        value = self.values.get(key, [])
        if not isinstance(value, list) or not all(isinstance(v, dict) for v in value):
            raise InputError(f"{self.where}: {key} must be written as [[{key}]] tables.")
        return value


def _is_number(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value)


def _shown(value: Any) -> str:
    return "missing" if value is None else repr(value)


ROTATIONS = ("rotation_vector_rad", "quaternion_xyzw", "matrix")
MOUNT_KEYS = ("name", "camera", "translation_m", *ROTATIONS, "cover_m", "bracket")
PIECE_KEYS = ("kind", "size_m", "position_m", "rotation_vector_rad", "file", "unit")
UNITS = {"mm": 1e-3, "m": 1.0}
REACH_M = 0.5
"""Nothing on a flange is farther out; larger numbers are millimetres."""
COVER_LIMIT_M = 0.1
"""A cover of more is a millimetre number."""
QUATERNION_TOLERANCE = 1e-3
"""How far from 1 a quaternion's length may be: four decimals written by hand."""


def read_mount(path: Path | str) -> Mount:
    """Return the mount of a file (see the module's text for the format).

    Without [[bracket]] tables a plain bracket from the flange to the camera is assumed; write
    `bracket = []` for none.

    Raises:
        InputError: no such file, unknown keys or camera, not exactly one rotation, a mesh that
            cannot be read.
        UnitError: lengths that can only be millimetres.
    """
    path = Path(path)
    fields = Fields(read_toml(path)[1], str(path), MOUNT_KEYS)
    camera = fields.text("camera")
    try:
        camera_body(camera)
    except InputError as error:
        raise InputError(f"{path}: {error}") from None
    T = se3.from_rt(_rotation(fields), _length_row(fields, "translation_m", 3))
    cover = fields.number("cover_m", 0.0)
    if not 0 <= cover <= COVER_LIMIT_M:
        raise UnitError(
            f"{path}: cover_m is {cover}; a thickness from 0 to {COVER_LIMIT_M} m is accepted. "
            "Lengths are in metres."
        )
    pieces = tuple(
        _piece(table, f"{path}, bracket {k}", path.parent)
        for k, table in enumerate(fields.tables("bracket"), 1)
    )
    if "bracket" not in fields.values:
        pieces = plain_bracket(T, camera)
    return Mount(name=fields.text("name"), camera=camera, T_ee_cam=T, bracket=pieces, cover_m=cover)


def _rotation(fields: Fields) -> Array:
    """Return R_ee_cam (3, 3) from whichever of the three is there."""
    given = [key for key in ROTATIONS if key in fields.values]
    if len(given) != 1:
        raise InputError(
            f"{fields.where}: {' and '.join(given) or 'no rotation'} given; exactly one of "
            f"{', '.join(ROTATIONS)} is needed."
        )
    if given[0] == "rotation_vector_rad":
        return _turn(fields, fields.finite_row("rotation_vector_rad", 3))
    if given[0] == "quaternion_xyzw":
        x, y, z, w = fields.finite_row("quaternion_xyzw", 4)
        length = float(np.linalg.norm([x, y, z, w]))
        if abs(length - 1) > QUATERNION_TOLERANCE:
            raise InputError(
                f"{fields.where}: quaternion_xyzw has the length {length:.4f}; 1 is needed. Write "
                "all digits, in the order x y z w."
            )
        return se3.from_quaternion_wxyz(np.array([w, x, y, z]) / length)
    rows = fields.values["matrix"]
    table = {f"row {k}": row for k, row in enumerate(rows, 1)} if isinstance(rows, list) else {}
    named = Fields(table, f"{fields.where}, matrix", ("row 1", "row 2", "row 3"))
    R = np.array([named.finite_row(f"row {k}", 3) for k in (1, 2, 3)])
    return se3.check_rigid(se3.from_rt(R, np.zeros(3)), f"{fields.where}: matrix")[:3, :3]


def _turn(fields: Fields, vector: list[float]) -> Array:
    """Return the rotation of a vector [rad].

    Raises:
        UnitError: more than a whole turn: degrees.
    """
    angle = float(np.linalg.norm(vector))
    if angle > 2 * np.pi:
        raise UnitError(
            f"{fields.where}: rotation_vector_rad turns by {angle:.1f} rad, more than a whole turn."
            " Were degrees given? Multiply by pi / 180."
        )
    return se3.exp_so3(vector)


def _length_row(
    fields: Fields, key: str, count: int, default: tuple[float, ...] | None = None
) -> list[float]:
    """Return lengths on a flange [m].

    Raises:
        UnitError: longer than anything on a flange: millimetres.
    """
    row = fields.finite_row(key, count, default)
    size = float(np.linalg.norm(row))
    if size > REACH_M:
        raise UnitError(
            f"{fields.where}: {key} is {row}, {size:.4g} m long; nothing on a flange is beyond "
            f"{REACH_M} m. Were millimetres given? {size:.4g} mm are {size / 1e3:.4g} m."
        )
    return row


def _piece(table: dict[str, Any], where: str, folder: Path) -> Shape:
    """Return one piece of the bracket."""
    fields = Fields(table, where, PIECE_KEYS)
    kind = fields.text("kind")
    if kind not in SIZES:
        raise InputError(f"{where}: kind is '{kind}'; there are {', '.join(SIZES)}.")
    needless = ("size_m",) if kind == "convex" else ("file", "unit")
    if wrong := [key for key in needless if key in table]:
        raise InputError(f"{where}: {' and '.join(wrong)} do not belong to a {kind} piece.")
    T = se3.from_rt(
        _turn(fields, fields.finite_row("rotation_vector_rad", 3, (0.0, 0.0, 0.0))),
        _length_row(fields, "position_m", 3, (0.0, 0.0, 0.0)),
    )
    is_mesh = kind == "convex"
    size = () if is_mesh else tuple(_length_row(fields, "size_m", SIZES[kind]))
    points = _corners(fields, folder) if is_mesh else None
    kind = cast(Kind, kind)
    try:
        return Shape(
            part="bracket", frame=FLANGE, kind=kind, size_m=size, T_frame_shape=T, points=points
        )
    except InputError as error:
        raise InputError(f"{where}: {error}") from None


def _corners(fields: Fields, folder: Path) -> Array:
    """Return the corners (P, 3) [m] of the convex hull of a mesh file."""
    import trimesh
    from scipy.spatial import ConvexHull, QhullError

    path = folder / fields.text("file")
    unit = fields.values.get("unit")
    if unit not in UNITS:
        raise UnitError(
            f"{fields.where}: unit is {unit!r}; a mesh file has no unit of its own, so that "
            'unit = "mm" or unit = "m" is needed.'
        )
    if not path.is_file():
        raise InputError(f"{fields.where}: the mesh {path} does not exist.")
    try:
        with unbroken():
            mesh = trimesh.load_mesh(path, process=False)
        points = np.asarray(mesh.vertices, dtype=np.float64) * UNITS[unit]
        hull = points[ConvexHull(points).vertices]
    except (QhullError, ValueError, OSError, KeyError, IndexError, AttributeError) as error:
        reason = str(error).splitlines()[0] if str(error) else type(error).__name__
        raise InputError(
            f"{fields.where}: {path} holds no solid that a hull could be put round ({reason}). "
            "STL and OBJ files are read."
        ) from None
    size = float(np.abs(hull).max())
    if size > REACH_M:
        raise UnitError(
            f"{fields.where}: {path} reaches {size:.4g} m from its origin in the unit '{unit}'; "
            f"nothing on a flange is beyond {REACH_M} m. Is the unit another?"
        )
    return hull


FAR_M = 20.0
"""No work cell is larger; larger finite numbers are millimetres."""


def read_work_cell_obstacles(path: Path | str) -> tuple[tuple[str, Box], ...]:
    """Return the named boxes in base of a file (see the module's text for the format) [m].

    Raises:
        InputError: no such file, unknown keys, a name twice, a box without volume.
        UnitError: coordinates that can only be millimetres.
    """
    path = Path(path)
    top = Fields(read_toml(path)[1], str(path), ("obstacles",))
    tables = top.tables("obstacles")
    if not tables:
        raise InputError(f"{path} holds no [[obstacles]] tables (name, lower_m, upper_m).")
    found: dict[str, Box] = {}
    for k, table in enumerate(tables, 1):
        fields = Fields(table, f"{path}, obstacle {k}", ("name", "lower_m", "upper_m"))
        name = fields.text("name")
        if name in found:
            raise InputError(f"{path}: two obstacles are called '{name}'; give each its own name.")
        found[name] = _box(fields, name)
    return tuple(found.items())


def _box(fields: Fields, name: str) -> Box:
    lower, upper = fields.row("lower_m", 3), fields.row("upper_m", 3)
    for value in (*lower, *upper):
        if math.isnan(value):
            raise InputError(f"{fields.where} ('{name}'): a coordinate is NaN.")
        if math.isfinite(value) and abs(value) > FAR_M:
            raise UnitError(
                f"{fields.where} ('{name}'): a coordinate of {value} m is beyond {FAR_M:.0f} m. "
                "Were millimetres given? Boxes are in metres in the controller's base."
            )
    try:
        return Box(lower=(lower[0], lower[1], lower[2]), upper=(upper[0], upper[1], upper[2]))
    except InputError as error:
        raise InputError(
            f"{fields.where} ('{name}'): {error} Every number of lower_m must be below upper_m's."
        ) from None
