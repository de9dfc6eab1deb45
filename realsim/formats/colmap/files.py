"""Whether the binary files of a COLMAP model are whole.

COLMAP's reader takes what it gets: a file that was cut off gives cameras with made-up numbers, or a
loop without end. So each file is walked through first; its records must end where the file does.
"""

import math
import mmap
import re
import struct
from collections.abc import Callable, Sequence
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
QUATERNION = struct.Struct("<4d")
"""The first numbers of a pose."""
UNIT_TOLERANCE = 1e-3
"""How far the length of a quaternion may be from 1: files with four digits pass."""
FRAME_BYTES, DATA_BYTES = 4 + 4 + POSE_BYTES, 16
"""Frame, rig, pose; then what was seen."""


def require_whole(folder: Path) -> None:
    """Raise if a file of the model was cut off, has a wrong tail, or poses that are none.

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
    if not (folder / "cameras.bin").is_file():
        require_whole_text(folder)


def require_unit(quaternion: Sequence[float], where: str) -> None:
    """Raise if a quaternion is not of unit length: its numbers are damaged, or something else.

    Raises:
        InputError: says how long it is.
    """
    length = math.sqrt(sum(min(abs(q), 1e9) ** 2 for q in quaternion))
    if not abs(length - 1) <= UNIT_TOLERANCE:  # also NaN
        raise InputError(
            f"{where}: the quaternion {' '.join(f'{q:.6g}' for q in quaternion)} has the length "
            f"{length:.6g}, and a rotation has 1. The file is damaged, or its columns are others; "
            "COLMAP's order is qw qx qy qz tx ty tz."
        )


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
    (number,) = struct.unpack_from("<I", data, at)
    require_unit(QUATERNION.unpack_from(data, at + 4), f"image {number} of images.bin")
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
    (number,) = struct.unpack_from("<I", data, at)
    require_unit(QUATERNION.unpack_from(data, at + 8), f"frame {number} of frames.bin")
    (seen,) = struct.unpack_from("<I", data, at + FRAME_BYTES)
    return at + FRAME_BYTES + 4 + seen * DATA_BYTES


# --- text -------------------------------------------------------------------------------------

ANNOUNCED = re.compile(r"#\s*Number of (\w+):\s*(\d+)")
"""COLMAP's comment at the beginning of every text file."""
MOST_LINE = 100_000_000
"""Characters of a line: an image with a million points has 60 million."""


def require_whole_text(folder: Path) -> None:
    """Raise if a text file of the model has fewer records than it announces, or broken ones.

    Raises:
        InputError: names the file and the line.
    """
    checks: dict[str, Callable[[list[str], str], None]] = {
        "cameras": _camera_line, "images": _image_line, "points3D": _point_line,
        "frames": _frame_line,
    }  # fmt: skip
    for name, check in checks.items():
        path = folder / f"{name}.txt"
        if path.is_file():
            _walk_lines(path, check, pairs=name == "images")


def _walk_lines(path: Path, check: Callable[[list[str], str], None], *, pairs: bool) -> None:
    """Check the records of a text file; of `pairs` the second line has the image's points."""
    announced: int | None = None
    records, is_second = 0, False
    try:
        with path.open(encoding="utf-8") as file:
            for number, line in enumerate(iter(lambda: file.readline(MOST_LINE), ""), start=1):
                words = line.split()
                if is_second:
                    is_second = False
                    if len(words) % 3:
                        raise _broken(path, number, f"{len(words)} numbers for points of three")
                elif line.startswith("#"):
                    match = ANNOUNCED.match(line)
                    announced = announced if match is None else int(match[2])
                elif words:
                    check(words, f"{path}, line {number}")
                    records, is_second = records + 1, pairs
    except UnicodeDecodeError as error:
        raise InputError(f"{path} is no text ({error.reason} at byte {error.start}).") from error
    if announced is not None and announced != records:
        raise InputError(
            f"{path} is damaged: it announces {announced} records and has {records}. Was it copied "
            "completely? Copy or export the model again."
        )


def _broken(path: Path, number: int, what: str) -> InputError:
    return InputError(f"{path}, line {number}: {what}; the file is damaged. Export it again.")


def _numbers(words: list[str], where: str, kind: str) -> list[float]:
    try:
        found = [float(w) for w in words]
    except ValueError as error:
        raise InputError(f"{where}: {kind} has something that is no number ({error}).") from error
    if not all(math.isfinite(v) for v in found):
        raise InputError(f"{where}: {kind} has NaN or infinite numbers.")
    return found


def _camera_line(words: list[str], where: str) -> None:
    import pycolmap

    models: dict[str, Any] = dict(pycolmap.CameraModelId.__members__)
    if len(words) < 4 or words[1] not in models or words[1] == "INVALID":
        raise InputError(f"{where} is no camera: CAMERA_ID MODEL WIDTH HEIGHT PARAMS is expected.")
    expected = len(pycolmap.Camera.create_from_model_id(0, models[words[1]], 1.0, 1, 1).params)
    _numbers([words[0], *words[2:]], where, "a camera")
    if len(words) != 4 + expected:
        raise InputError(
            f"{where}: the model {words[1]} has {expected} parameters, the line {len(words) - 4}."
        )


def _image_line(words: list[str], where: str) -> None:
    if len(words) != 10:  # COLMAP itself cuts a name at its first space, without a word
        raise InputError(
            f"{where} has {len(words)} columns; an image has ten, IMAGE_ID QW QX QY QZ TX TY TZ "
            "CAMERA_ID NAME, the name without a space, and a line for its points follows, empty "
            "where it has none. Rename the image, or export the model as binary."
        )
    require_unit(_numbers(words[:9], where, "an image")[1:5], where)


def _point_line(words: list[str], where: str) -> None:
    if len(words) < 8 or len(words) % 2:
        raise InputError(f"{where} has {len(words)} columns; a point has eight and two a track.")
    _numbers(words[:8], where, "a point")


def _frame_line(words: list[str], where: str) -> None:
    seen = int(words[9]) if len(words) > 9 and words[9].isdecimal() else -1
    if seen < 0 or len(words) != 10 + 3 * seen:
        raise InputError(f"{where} has {len(words)} columns, which are no frame of COLMAP's.")
    require_unit(_numbers(words[:9], where, "a frame")[2:6], where)
