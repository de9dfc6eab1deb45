"""Poses as rows of numbers, in every reading of them, and folders for files of them."""

import tempfile
from collections.abc import Generator, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from itertools import product
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from realsim.arrays import Array
from realsim.geometry import se3
from realsim_calibration.inputs.readings import ROTATIONS, PoseReading


@contextmanager
def folder() -> Generator[Path, None, None]:
    """Give a folder for as long as the block lasts: an example of hypothesis has its own."""
    with tempfile.TemporaryDirectory() as path:
        yield Path(path)


def all_readings() -> Iterator[PoseReading]:
    """Give every reading that there is."""
    for rotation, length, inverted, first in product(
        ROTATIONS, ("m", "mm"), (False, True), (True, False)
    ):
        plain = PoseReading(
            rotation=rotation, length_unit=length, inverted=inverted, position_first=first
        )
        yield plain
        if plain.has_angles:
            yield replace(plain, angle_unit="deg")


def random_poses(seed: int, n: int) -> Array:
    """Return poses (n, 4, 4) [m]."""
    return se3.random_transform(np.random.default_rng(seed), n, spread=0.5)


def write_lines(
    path: Path, rows: Array, separator: str = " ", names: Sequence[str] | None = None,
    head: str = "", decimal: str = ".",
) -> Path:  # fmt: skip
    """Write rows of numbers as text, each after its name; return the path."""
    lines = [head] if head else []
    for k, row in enumerate(rows.tolist()):
        fields = [repr(x).replace(".", decimal) for x in row]
        lines.append(separator.join([names[k], *fields] if names else fields))
    path.write_text("\n".join(lines) + "\n")
    return path


def rows_of(reading: PoseReading, Ts: Array, width: int = 16) -> Array:
    """Return the rows (n, k) that a reading turns into poses (n, 4, 4) [m]; `width` of matrices."""
    T = se3.invert(Ts) if reading.inverted else Ts.copy()
    T[:, :3, 3] *= 1000.0 if reading.length_unit == "mm" else 1.0
    R, t, kind = T[:, :3, :3], T[:, :3, 3], reading.rotation
    if kind.startswith("matrix"):
        columns = kind == "matrix_column_major"
        if width == 16:
            return (np.swapaxes(T, 1, 2) if columns else T).reshape(-1, 16)
        rotation = (np.swapaxes(R, 1, 2) if columns else R).reshape(-1, 9)
    elif kind.startswith("quaternion"):
        q = se3.quaternion_wxyz(R)
        rotation = q if kind.endswith("wxyz") else np.roll(q, -1, axis=-1)
    else:
        turn, order = Rotation.from_matrix(R), kind.removeprefix("euler_")
        rotation = turn.as_rotvec() if kind == "rotation_vector" else turn.as_euler(order)
        rotation = np.degrees(rotation) if reading.angle_unit == "deg" else rotation
    return np.concatenate([t, rotation] if reading.position_first else [rotation, t], -1)
