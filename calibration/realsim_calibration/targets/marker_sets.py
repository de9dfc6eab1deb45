"""The marker dictionaries of OpenCV: their names, their sizes, and the modules of a marker."""

from functools import lru_cache
from typing import Any

import numpy as np

from realsim.arrays import Mask
from realsim.errors import InputError
from realsim.records import TAG_CELLS, CharucoBoard, TagBoard, Target

MOST_ROWS = 500
"""Largest number of rows or columns of a target: beyond it a count was mistyped."""


@lru_cache(maxsize=1)
def dictionary_names() -> tuple[str, ...]:
    """Return the names of OpenCV's predefined dictionaries, each once."""
    from cv2 import aruco

    names = sorted(name for name in dir(aruco) if name.startswith("DICT_"))
    # OpenCV spells the AprilTag families twice, 36H11 and 36h11; the later one sorts last.
    once = {int(getattr(aruco, name)): name for name in names}
    return tuple(sorted(once.values()))


def dictionary_name(text: str) -> str:
    """Return OpenCV's name of a dictionary; case and the leading DICT_ do not matter.

    Raises:
        InputError: there is no such dictionary; the message lists those that there are.
    """
    wanted = text.strip().upper().removeprefix("DICT_")
    if wanted.startswith("TAG"):
        wanted = "APRILTAG_" + wanted[len("TAG") :]
    for name in dictionary_names():
        if name.upper() == f"DICT_{wanted}":
            return name
    prefix = "DICT_" * text.upper().startswith("DICT_")
    known = ", ".join(prefix + name.removeprefix("DICT_") for name in dictionary_names())
    raise InputError(f"the marker dictionary '{text}' is not known; accepted: {known}.")


def tag_dictionary(family: str) -> str:
    """Return OpenCV's name of the dictionary that holds an AprilTag family."""
    return "DICT_APRILTAG_" + family.removeprefix("tag")


@lru_cache(maxsize=32)
def load_dictionary(name: str) -> Any:
    """Return OpenCV's dictionary of a name."""
    from cv2 import aruco

    return aruco.getPredefinedDictionary(getattr(aruco, dictionary_name(name)))


def dictionary_size(name: str) -> int:
    """Return how many markers a dictionary has."""
    return len(load_dictionary(name).bytesList)


def marker_modules(name: str, marker_id: int) -> Mask:
    """Return (cells, cells) modules of a marker, True = black, first row at the top."""
    from cv2 import aruco

    dictionary = load_dictionary(name)
    cells = int(dictionary.markerSize) + 2  # its black border of one module included
    gray = aruco.generateImageMarker(dictionary, marker_id, cells)
    return np.asarray(gray, dtype=np.uint8) == 0


def check_markers(target: Target) -> None:
    """Raise unless the target's markers exist and its counts are plausible.

    Raises:
        InputError: a dictionary is not known or has too few markers, or a count is absurd.
    """
    if max(target.rows, target.columns) > MOST_ROWS:
        raise InputError(
            f"a target of {target.columns} x {target.rows} (columns x rows) is too large; at "
            f"most {MOST_ROWS} of each are accepted."
        )
    if isinstance(target, TagBoard):
        size = dictionary_size(tag_dictionary(target.family))
        last = target.first_id + target.rows * target.columns - 1
        if target.first_id < 0 or last >= size:
            raise InputError(
                f"the board has the tags {target.first_id} to {last}, but the family "
                f"{target.family} has the ids 0 to {size - 1}. Use fewer tags, a smaller first id, "
                f"or another family ({', '.join(TAG_CELLS)})."
            )
    elif isinstance(target, CharucoBoard):
        size = dictionary_size(target.dictionary)
        # The corner square is black; only OpenCV's legacy pattern of even rows starts with white.
        need = target.rows * target.columns // 2
        if need > size:
            raise InputError(
                f"a ChArUco board of {target.columns} x {target.rows} squares needs {need} "
                f"markers, but {target.dictionary} has {size}. Use fewer squares or a larger "
                "dictionary."
            )
