"""A labelled scene as a COLMAP project: a sparse model and the images it places.

    FOLDER/images/000000.png ...                               colour images
    FOLDER/sparse/0/{cameras,images,points3D,rigs,frames}.bin

This is what trainers of Gaussian splatting, MVS programs and COLMAP's own window open. Poses and
points are in metres. The model has no tracks: its cameras were measured, not matched.

Files are after COLMAP's own description of its output: little endian, no padding. Each camera is a
rig of its own and each image a frame of its own, as COLMAP writes models of single cameras since
3.12.
"""

import struct
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from realsim.arrays import Array, UInt8
from realsim.errors import InputError
from realsim.formats.coloured_points import ColouredPoints, require_points, write_points
from realsim.formats.export_folder import ExportFolder
from realsim.formats.folders.listing import shown
from realsim.formats.labelled_scene import LabelledFrame, LabelledScene, WrittenScene
from realsim.geometry import se3
from realsim.interop import colmap_from_opencv_px, quaternion_xyzw_from_R
from realsim.records import CameraIntrinsics

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


def model_files(
    cameras: Sequence[CameraRow], images: Sequence[ImageRow], points: Array,
    colours: UInt8,
) -> dict[str, bytes]:  # fmt: skip
    """Return the five files of a model, by name.

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


def _point_bytes(points: Array, colours: UInt8) -> bytes:
    rows = np.zeros(len(points), dtype=POINT)
    rows["id"] = np.arange(1, len(points) + 1)
    rows["xyz"], rows["rgb"], rows["error"] = points, colours, NO_ERROR
    return struct.pack("<Q", len(points)) + rows.tobytes()


MODEL_FOLDER = "sparse/0"


def write_colmap(
    scene: LabelledScene,
    folder: ExportFolder,
    points: int = 100_000,
    *,
    progress: Callable[[], None] | None = None,
) -> WrittenScene:
    """Write a scene as a COLMAP project.

    Args:
        scene: its images with camera poses are written, the others are named in the notes.
        folder: to fill; gone on with where it was interrupted.
        points: the most in points3D, averaged out of the depth images; 0 = none. A hundred thousand
            is what Gaussian splatting usually begins with.
        progress: called once per frame.

    Raises:
        InputError: no image has a camera pose, or an image cannot be read.
    """
    require_points(points)
    cameras: dict[tuple[float, ...], CameraRow] = {}
    images: list[ImageRow] = []
    without: list[str] = []
    objects = written = 0
    for index in scene.indices:
        frame = scene.frame(index)
        if progress is not None:
            progress()
        if frame.T_world_cam is None:
            without.append(str(index))
            continue
        source = scene.colour_file(index)
        name = f"{index:06d}{source.suffix.lower()}"
        camera = _camera_of(frame, cameras)
        T_cam_world = se3.invert(frame.T_world_cam)
        images.append(image_row(index + 1, camera.camera_id, T_cam_world, name))
        objects += len(frame.objects)
        piece = f"frame {index}"
        if not folder.has(piece):
            folder.write_piece(piece, {f"images/{name}": source})
            written += 1
    if not images:
        raise InputError(
            f"{scene.name}: none of the {len(scene.indices)} images has a camera pose, and a "
            "COLMAP model is made of them. Calibrate or register the session first."
        )

    def model_of(cloud: ColouredPoints) -> dict[str, bytes]:
        files = model_files(list(cameras.values()), images, cloud.points, cloud.colours)
        return {f"{MODEL_FOLDER}/{name}": data for name, data in files.items()}

    count = write_points(scene, folder, points, "model", model_of)
    return WrittenScene(
        name=scene.name, folder=folder.place, frames=len(images),
        frames_written=written, objects=objects,
        notes=_notes(without, list(cameras.values()), objects),
        counts={"cameras": len(cameras), "points": count},
    )  # fmt: skip


def _camera_of(frame: LabelledFrame, cameras: dict[tuple[float, ...], CameraRow]) -> CameraRow:
    """Return the row of a frame's camera; equal cameras are one."""
    row = camera_row(len(cameras) + 1, frame.intrinsics)
    return cameras.setdefault((row.width, row.height, *row.params), row)


def _notes(without: list[str], cameras: list[CameraRow], objects: int) -> tuple[str, ...]:
    notes: list[str] = []
    if without:
        notes.append(
            f"{len(without)} images have no camera pose and were left out: {shown(without)}."
        )
    if any(c.model != "PINHOLE" for c in cameras):
        notes.append(
            "the images are distorted and the cameras say so; trainers that take PINHOLE only need "
            "COLMAP's image_undistorter first."
        )
    if objects:
        notes.append("COLMAP has no place for objects and their poses: they were left out.")
    return tuple(notes)
