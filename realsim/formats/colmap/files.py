"""Whether the binary files of a COLMAP model are whole.

COLMAP's reader takes what it gets: a file that was cut off gives cameras with made-up numbers, or a
loop without end. So each file is walked through first; its records must end where the file does.
"""

import mmap
import struct
from collections.abc import Callable
from pathlib import Path
from typing import Any

from realsim.errors import InputError

COUNT = struct.Struct("<Q")
"""Number of records at the beginning of every file."""
CAMERA = struct.Struct("<IiQQ")
"""Camera, model, width, height; the parameters follow as doubles."""
IMAGE_BYTES, POINT2D_BYTES = 4 + 7 * 8 + 4, 24
"""Image, quaternion and translation, camera; then the name, ended by zero, and its points."""
POINT3D_BYTES, TRACK_BYTES = 8 + 3 * 8 + 3 + 8, 8
"""Point, position, colour, error; then its track."""
RIG = struct.Struct("<II")
"""Rig, number of sensors; the first sensor has no pose, the others may have one."""
SENSOR_BYTES, POSE_BYTES = 8, 7 * 8
FRAME_BYTES, DATA_BYTES = 4 + 4 + POSE_BYTES, 16
"""Frame, rig, pose; then what was seen."""


def require_whole(folder: Path) -> None:
    """Raise if a binary file of the model was cut off or has a wrong tail.

    Raises:
        InputError: names the file.
    """
    walks: dict[str, Callable[[Any, int], int]] = {
        "cameras": _camera, "images": _image, "points3D": _point, "rigs": _rig, "frames": _frame,
    }  # fmt: skip
    for name, walk in walks.items():
        path = folder / f"{name}.bin"
        if path.is_file():
            _walk(path, walk)


def _walk(path: Path, step: Callable[[Any, int], int]) -> None:
    size = path.stat().st_size
    at = COUNT.size
    count = done = 0
    try:
        with path.open("rb") as file, mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as data:
            (count,) = COUNT.unpack_from(data, 0)
            while done < count and at <= size:
                at = step(data, at)
                done += 1
    except (struct.error, ValueError):  # ValueError: empty file, or a name without end
        at = size + 1
    if done < count or at != size:
        raise InputError(
            f"{path} is damaged: it announces {count} records, and its {size} bytes do not end "
            f"with the last of them. Was it copied completely? Copy or export the model again."
        )


def _camera(data: Any, at: int) -> int:
    import pycolmap

    _, model, width, height = CAMERA.unpack_from(data, at)
    known = {int(m): m for m in pycolmap.CameraModelId.__members__.values()}
    if model not in known:
        raise ValueError(f"no camera model has the number {model}")
    camera = pycolmap.Camera.create_from_model_id(0, known[model], 1.0, width, height)
    return at + CAMERA.size + 8 * len(camera.params)


def _image(data: Any, at: int) -> int:
    end: int = data.find(b"\x00", at + IMAGE_BYTES)
    if end < 0:
        raise ValueError("a name without end")
    (points,) = COUNT.unpack_from(data, end + 1)
    return end + 1 + COUNT.size + points * POINT2D_BYTES


def _point(data: Any, at: int) -> int:
    (track,) = COUNT.unpack_from(data, at + POINT3D_BYTES)
    return at + POINT3D_BYTES + COUNT.size + track * TRACK_BYTES


def _rig(data: Any, at: int) -> int:
    _, sensors = RIG.unpack_from(data, at)
    at += RIG.size
    for k in range(sensors):
        at += SENSOR_BYTES
        if k:
            (has_pose,) = struct.unpack_from("<B", data, at)
            at += 1 + (POSE_BYTES if has_pose else 0)
    return at


def _frame(data: Any, at: int) -> int:
    (seen,) = struct.unpack_from("<I", data, at + FRAME_BYTES)
    return at + FRAME_BYTES + 4 + seen * DATA_BYTES
