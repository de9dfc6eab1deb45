"""The work cell file: walls, lamps and other boxes that the arm keeps away from, in TOML.

[[obstacles]]
name = "back wall"
lower_m = [-2.0, 0.70, -1.0]      # in the controller's base; inf and -inf are accepted
upper_m = [2.0, 0.75, 2.0]
"""

import math
from pathlib import Path

from realsim.errors import InputError, UnitError
from realsim_capture_plans.collision.shapes import Box
from realsim_capture_plans.collision.toml_fields import Fields, read_toml

FAR_M = 20.0
"""No work cell is larger; larger finite numbers are millimetres."""


def read_work_cell_obstacles(path: Path | str) -> tuple[tuple[str, Box], ...]:
    """Return the named boxes in base of a file (see the module's text for the format) [m].

    Raises:
        InputError: no such file, unknown keys, a name twice, a box without volume.
        UnitError: coordinates that can only be millimetres.
    """
    path = Path(path)
    top = Fields(read_toml(path), str(path), ("obstacles",))
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
