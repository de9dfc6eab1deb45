"""Poses as rows of numbers, in every reading of them, and folders for files of them."""

import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from itertools import product
from pathlib import Path

import numpy as np

from realsim.arrays import Array
from realsim.geometry import se3
from realsim_calibration.inputs.readings import ROTATIONS, PoseReading


@contextmanager
def folder() -> Iterator[Path]:
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
