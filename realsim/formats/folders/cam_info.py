"""The cam.info.txt of multi-view scans (apc-vision-toolbox): camera matrix and camera poses.

A text file of titled matrices; a line that begins with # is the title of the numbers below it.
"""

import math
import re
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from realsim.arrays import Array
from realsim.errors import InputError, UnitError
from realsim.formats.folders.listing import FrameState
from realsim.geometry import se3
from realsim.untrusted.files import checked_bytes

FILE = "cam.info.txt"
COLOUR_TITLE = "color camera intrinsic matrix"
POSE_TITLE = re.compile(r"camera-to-world extrinsic matrix.* for (\S+)\s*$", re.IGNORECASE)
MOST_BYTES = 20e6
"""Most bytes of a file: 50,000 poses have so many."""
FARTHEST_M = 50.0
"""A camera farther from the world's origin was written in millimetres."""


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class CamInfo:
    """What a cam.info.txt says."""

    path: Path
    K: Array
    """(3, 3) matrix of the colour camera [px]."""
    states: tuple[FrameState, ...]
    """T_world_cam of every frame, under the frame's name."""


def find_cam_info(folder: Path) -> Path | None:
    """Return the cam.info.txt of a folder, None where there is none."""
    path = folder / FILE
    return path if path.is_file() else None


def read_cam_info(path: Path) -> CamInfo:
    """Return the camera matrix and the poses of a cam.info.txt.

    Raises:
        InputError: there is no such file, a matrix is incomplete, or the camera's is missing.
        UnitError: the poses are not in metres.
    """
    blocks: list[tuple[str, list[float]]] = []
    text = checked_bytes(path, MOST_BYTES).decode(errors="replace")  # titles may be of any encoding
    for number, line in enumerate(text.splitlines(), start=1):
        words = line.strip()
        if words.startswith("#"):
            blocks.append((words.lstrip("# "), []))
            continue
        try:
            values = [float(word) for word in words.split()]
        except ValueError as error:
            raise InputError(f"{path}, line {number}: numbers are expected ({error}).") from error
        if not all(map(math.isfinite, values)):
            raise InputError(f"{path}, line {number}: '{words:.80}' has a number that is none.")
        if values and not blocks:
            raise InputError(f"{path}, line {number}: numbers without a title above them.")
        if values:
            blocks[-1][1].extend(values)
    K: Array | None = None
    states: list[FrameState] = []
    for title, values in blocks:
        pose = POSE_TITLE.match(title)
        if title.lower().startswith(COLOUR_TITLE):
            K = _matrix(values, 3, f"{path}, '{title}'")
        elif pose:
            name = f"{path.name}, '{title}'"
            T = se3.check_rigid(_matrix(values, 4, name), name)
            states.append(FrameState(name=pose[1], where=name, T_world_cam=T))
    if K is None:
        raise InputError(f"{path} has no '{COLOUR_TITLE}'; give the camera with --intrinsics.")
    far = [s for s in states if s.T_world_cam is not None and _distance(s) > FARTHEST_M]
    if far:
        raise UnitError(
            f"{far[0].where}: the camera stands {_distance(far[0]):.4g} m from the world's "
            f"origin, at most {FARTHEST_M:g} m is accepted. Are the poses in millimetres? Divide "
            "the translations by 1000."
        )
    return CamInfo(path=path, K=K, states=tuple(states))


def _distance(state: FrameState) -> float:
    T = state.T_world_cam
    return 0.0 if T is None else float(np.linalg.norm(T[:3, 3]))


def _matrix(values: list[float], n: int, name: str) -> Array:
    if len(values) != n * n:
        raise InputError(f"{name}: {len(values)} numbers, {n * n} are expected ({n}x{n}).")
    return np.array(values).reshape(n, n)
