"""The files of a COLMAP model as bytes: cameras, images, points3D, rigs and frames.

Both kinds after COLMAP's own description of its output (binary: little endian, no padding; text:
17 digits, which is every bit of a double). Each camera is a rig of its own and each image a frame
of its own, as COLMAP writes models of single cameras since 3.12. Rows are given in the order in
which they are to stand in the files.
"""

import struct
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from realsim.interop import colmap_from_opencv_px, quaternion_xyzw_from_R
from realsim.records import CameraIntrinsics

Array = NDArray[np.float64]
MODELS: dict[str, tuple[int, int]] = {"PINHOLE": (1, 4), "OPENCV": (4, 8), "FULL_OPENCV": (6, 12)}
"""Number and parameter count of the camera models that are written."""
NO_ERROR = -1.0
"""COLMAP's reprojection error of a point that no image was matched for."""
POINT = np.dtype(
    [("id", "<u8"), ("xyz", "<f8", 3), ("rgb", "u1", 3), ("error", "<f8"), ("track", "<u8")]
)  # fmt: skip
"""A point without track in points3D.bin."""


@dataclass(frozen=True, kw_only=True, slots=True)
class CameraRow:
    """A camera as COLMAP has it."""

    camera_id: int
    model: str
    width: int
    height: int
    params: tuple[float, ...]
    """In COLMAP's order; pixel centres at +0.5."""


@dataclass(frozen=True, kw_only=True, slots=True)
class ImageRow:
    """A registered image as COLMAP has it."""

    image_id: int
    camera_id: int
    pose: tuple[float, ...]
    """qw qx qy qz tx ty tz of cam_from_world."""
    name: str


def camera_row(camera_id: int, camera: CameraIntrinsics) -> CameraRow:
    """Return a camera in the simplest model that holds its lens exactly."""
    d = tuple(float(v) for v in camera.distortion)
    model, count = "PINHOLE", 0
    if any(d[4:]):
        model, count = "FULL_OPENCV", 8
    elif any(d):
        model, count = "OPENCV", 4
    cx, cy = (float(v) for v in colmap_from_opencv_px([camera.cx, camera.cy]))
    return CameraRow(
        camera_id=camera_id, model=model, width=camera.width, height=camera.height,
        params=(float(camera.fx), float(camera.fy), cx, cy, *d[:count]),
    )  # fmt: skip


def image_row(image_id: int, camera_id: int, T_cam_world: Array, name: str) -> ImageRow:
    """Return an image of a pose (4, 4)."""
    x, y, z, w = (float(v) for v in quaternion_xyzw_from_R(T_cam_world[:3, :3]))
    t = (float(v) for v in T_cam_world[:3, 3])
    return ImageRow(image_id=image_id, camera_id=camera_id, pose=(w, x, y, z, *t), name=name)


# --- binary -----------------------------------------------------------------------------------


def binary_files(
    cameras: Sequence[CameraRow], images: Sequence[ImageRow], points: Array,
    colours: NDArray[np.uint8],
) -> dict[str, bytes]:  # fmt: skip
    """Return the five binary files of a model, by name.

    Args:
        cameras: at least one.
        images: at least one.
        points: (N, 3) in world [m].
        colours: (N, 3) RGB.
    """
    return {
        "cameras.bin": _counted([_camera_bytes(c) for c in cameras]),
        "images.bin": _counted([_image_bytes(i) for i in images]),
        "points3D.bin": _point_bytes(points, colours),
        "rigs.bin": _counted([_rig_bytes(c) for c in cameras]),
        "frames.bin": _counted([_frame_bytes(i) for i in images]),
    }  # fmt: skip


def _counted(records: Sequence[bytes]) -> bytes:
    return struct.pack("<Q", len(records)) + b"".join(records)


def _camera_bytes(c: CameraRow) -> bytes:
    number, count = MODELS[c.model]
    head = struct.pack("<IiQQ", c.camera_id, number, c.width, c.height)
    return head + struct.pack(f"<{count}d", *c.params)


def _rig_bytes(c: CameraRow) -> bytes:
    # One sensor: a camera (0) and its number, which is the reference and has no pose.
    return struct.pack("<IIiI", c.camera_id, 1, 0, c.camera_id)


def _image_bytes(i: ImageRow) -> bytes:
    head = struct.pack("<I7dI", i.image_id, *i.pose, i.camera_id)
    return head + i.name.encode("utf-8") + b"\0" + struct.pack("<Q", 0)


def _frame_bytes(i: ImageRow) -> bytes:
    # One datum, seen by sensor (camera = 0, its number): the image.
    return struct.pack("<II7dIiIQ", i.image_id, i.camera_id, *i.pose, 1, 0, i.camera_id, i.image_id)


def _point_bytes(points: Array, colours: NDArray[np.uint8]) -> bytes:
    rows = np.zeros(len(points), dtype=POINT)
    rows["id"] = np.arange(1, len(points) + 1)
    rows["xyz"], rows["rgb"], rows["error"] = points, colours, NO_ERROR
    return struct.pack("<Q", len(points)) + rows.tobytes()


# --- text -------------------------------------------------------------------------------------


def text_files(
    cameras: Sequence[CameraRow], images: Sequence[ImageRow], points: Array,
    colours: NDArray[np.uint8],
) -> dict[str, bytes]:  # fmt: skip
    """Return the five text files of a model, by name; arguments as `binary_files`."""
    rigs = [f"{c.camera_id} 1 CAMERA {c.camera_id}" for c in cameras]
    frames = [
        f"{i.image_id} {i.camera_id} {_digits(i.pose)} 1 CAMERA {i.camera_id} {i.image_id}"
        for i in images
    ]
    return {
        "cameras.txt": _text(
            "cameras",
            "CAMERA_ID, MODEL, WIDTH, HEIGHT, PARAMS[]",
            [f"{c.camera_id} {c.model} {c.width} {c.height} {_digits(c.params)}" for c in cameras],
        ),
        "images.txt": _text(
            "images",
            "IMAGE_ID, QW, QX, QY, QZ, TX, TY, TZ, CAMERA_ID, NAME; then a line of POINTS2D[]",
            [f"{i.image_id} {_digits(i.pose)} {i.camera_id} {i.name}\n" for i in images],
        ),
        "points3D.txt": _text(
            "points",
            "POINT3D_ID, X, Y, Z, R, G, B, ERROR, TRACK[]",
            [
                f"{k} {_digits(p)} {r} {g} {b} {NO_ERROR:g}"
                for k, (p, (r, g, b)) in enumerate(
                    zip(points.tolist(), colours.tolist(), strict=True), start=1
                )
            ],
        ),
        "rigs.txt": _text("rigs", "RIG_ID, NUM_SENSORS, REF_SENSOR_TYPE, REF_SENSOR_ID", rigs),
        "frames.txt": _text(
            "frames",
            "FRAME_ID, RIG_ID, RIG_FROM_WORLD[QW QX QY QZ TX TY TZ], NUM_DATA_IDS, "
            "DATA_IDS[] as SENSOR_TYPE, SENSOR_ID, DATA_ID",
            frames,
        ),
    }


def _digits(values: Sequence[float]) -> str:
    return " ".join(f"{v:.17g}" for v in values)


def _text(what: str, columns: str, lines: Sequence[str]) -> bytes:
    head = [f"# {columns}", f"# Number of {what}: {len(lines)}"]
    return "\n".join([*head, *lines, ""]).encode("utf-8")
