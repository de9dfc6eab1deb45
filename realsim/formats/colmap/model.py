"""A COLMAP model: whether its files are whole, and what they hold.

COLMAP's reader takes what it gets: a file that was cut off gives cameras with made-up numbers, or a
loop without end. So each file is walked through first; its records must end where the file does.
"""

import math
import mmap
import re
import struct
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from realsim.arrays import Array
from realsim.errors import InputError
from realsim.formats.frame_source import require_plausible
from realsim.geometry import se3
from realsim.interop import T_from_rigid3d, opencv_from_colmap_px
from realsim.records import CameraIntrinsics
from realsim.untrusted import values

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


PLACES = ("", "sparse/0", "sparse", "model", "colmap", "dense/sparse", "colmap/sparse/0")
"""Where in a project's folder the model may be."""
FILES = ("cameras", "images")
"""Files that every model has, as .bin or .txt."""
PARAMETERS: dict[str, str] = {
    "SIMPLE_PINHOLE": "f cx cy",
    "PINHOLE": "fx fy cx cy",
    "SIMPLE_RADIAL": "f cx cy k1",
    "RADIAL": "f cx cy k1 k2",
    "OPENCV": "fx fy cx cy k1 k2 p1 p2",
    "FULL_OPENCV": "fx fy cx cy k1 k2 p1 p2 k3 k4 k5 k6",
}
"""Camera models that the record holds exactly, and the order of their parameters."""
OPENCV_ORDER = ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class ColmapImage:
    """One registered image of a model."""

    name: str
    """Its file, relative to the images' folder."""
    camera_id: int
    T_world_cam: Array
    """(4, 4) camera in the model's world; its translation is in the model's own unit."""


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class ColmapModel:
    """Cameras and registered images of a model."""

    folder: Path
    cameras: Mapping[int, CameraIntrinsics]
    images: tuple[ColmapImage, ...]
    """In the order of their numbers in the model."""
    unregistered: tuple[str, ...]
    """Names of images that the model lists without a pose."""


def find_model(root: Path | str) -> Path | None:
    """Return the folder of the COLMAP model in a project, None where there is none.

    Raises:
        InputError: several are there (sparse/0, sparse/1).
    """
    root = Path(root)
    found = [root / place for place in PLACES if _is_model(root / place)]
    if not found:
        return None
    parent = found[0].parent
    siblings = sorted(p for p in parent.iterdir() if p.name.isdecimal() and _is_model(p))
    if found[0] != root and len(siblings) > 1:
        raise InputError(
            f"{parent} holds {len(siblings)} models ({', '.join(p.name for p in siblings)}): parts "
            f"that COLMAP could not connect, each with a world of its own. Give one: {siblings[0]}."
        )
    return found[0]


def _is_model(folder: Path) -> bool:
    return any(all((folder / f"{n}{e}").is_file() for n in FILES) for e in (".bin", ".txt"))


def read_model(folder: Path | str) -> ColmapModel:
    """Return the cameras and poses of a COLMAP model.

    Raises:
        InputError: no model, damaged, or a camera model that the record has no place for.
    """
    import pycolmap

    folder = Path(folder)
    if not _is_model(folder):
        raise InputError(
            f"{folder} holds no COLMAP model: cameras and images (.bin or .txt) are expected there."
        )
    require_whole(folder)
    try:
        model: Any = pycolmap.Reconstruction(str(folder))
    except Exception as error:  # pycolmap raises RuntimeError, ValueError, IndexError on damage
        raise InputError(
            f"the COLMAP model {folder} cannot be read ({str(error).strip().splitlines()[-1]}). "
            "cameras, images and points3D of one export belong together; export it again."
        ) from error
    found: list[ColmapImage] = []
    unregistered: list[str] = []
    for number, image in sorted(dict(model.images).items()):
        try:
            name = str(image.name)
        except UnicodeDecodeError as error:
            raise InputError(
                f"the name of image {number} in {folder} is no text (UTF-8); the file is damaged, "
                "or written with another encoding. Export it again."
            ) from error
        values.relative_path(name, f"the name of image {number} in {folder}")
        if not image.has_pose:
            unregistered.append(name)
            continue
        T = se3.invert(T_from_rigid3d(image.cam_from_world()))
        if not np.isfinite(T).all():
            raise InputError(
                f"the pose of {name} in {folder} has NaN or infinite numbers; the file is "
                "damaged. Export it again."
            )
        found.append(ColmapImage(name=name, camera_id=int(image.camera_id), T_world_cam=T))
    used = {i.camera_id for i in found}
    cameras = {k: _intrinsics(c, folder) for k, c in dict(model.cameras).items() if k in used}
    return ColmapModel(
        folder=folder, cameras=cameras, images=tuple(found), unregistered=tuple(unregistered)
    )


def _intrinsics(camera: Any, folder: Path) -> CameraIntrinsics:
    """Return our record of a pycolmap camera."""
    model = str(camera.model_name)
    if model not in PARAMETERS:
        raise InputError(
            f"camera {camera.camera_id} of {folder} has the model {model}, which the record has no "
            f"place for; {', '.join(PARAMETERS)} have. Undistort the images with COLMAP's "
            "image_undistorter, or run it with one of these models."
        )
    names = PARAMETERS[model].split()
    p = dict(zip(names, (float(x) for x in camera.params), strict=True))
    cx, cy = (float(x) for x in opencv_from_colmap_px([p["cx"], p["cy"]]))
    intrinsics = CameraIntrinsics(
        width=int(camera.width),
        height=int(camera.height),
        fx=p.get("fx", p.get("f", 0.0)),
        fy=p.get("fy", p.get("f", 0.0)),
        cx=cx,
        cy=cy,
        distortion=np.array([p.get(k, 0.0) for k in OPENCV_ORDER]),
    )
    require_plausible(intrinsics, f"camera {camera.camera_id} of {folder}")
    return intrinsics
