"""A labelled scene as a COLMAP project: a sparse model and the images it places.

    FOLDER/images/000000.png ...                               colour images
    FOLDER/sparse/0/{cameras,images,points3D,rigs,frames}      .bin, .txt, or both
    FOLDER/depth/000000.png ...                                only if asked for

This is what trainers of Gaussian splatting, MVS programs and COLMAP's own window open. Poses and
points are in metres. The model has no tracks: its cameras were measured, not matched.
"""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from realsim.errors import InputError
from realsim.formats.colmap.encoding import (
    CameraRow,
    ImageRow,
    binary_files,
    camera_row,
    image_row,
    text_files,
)
from realsim.formats.coloured_points import coloured_points
from realsim.formats.export_folder import Content, ExportFolder
from realsim.formats.folders.listing import shown
from realsim.formats.labelled_scene import LabelledFrame, LabelledScene, WrittenScene
from realsim.geometry import se3

MODEL_FOLDER = "sparse/0"
MODEL_PIECE, POINTS_ROW = "model", "points.json"
"""The model as a piece of the export, and where the export notes its number of points."""
MOST_POINTS = 10_000_000
"""Points that a model may be asked to have: 500 MB as text."""


@dataclass(frozen=True, kw_only=True, slots=True)
class ColmapWriteConfig:
    """How a scene is written as a COLMAP project."""

    encoding: Literal["binary", "text", "both"] = "binary"
    """Of the model. Both hold every bit of a double; binary is a third of the size, and every
    reader takes it."""
    images: Literal["copied", "referenced"] = "copied"
    """Referenced: no image is written and the model names them as their files are called, relative
    to the folder that a note says (COLMAP's --image_path)."""
    points: int = 100_000
    """Most points in points3D, averaged out of the depth images; 0 = none. A hundred thousand is
    what Gaussian splatting usually begins with."""
    depth: bool = False
    """Whether the depth images are written, too; COLMAP has no place for them, `realsim import
    --kind colmap` finds them there."""

    def __post_init__(self) -> None:
        """Check the values."""
        if self.encoding not in ("binary", "text", "both"):
            raise InputError(f"the encoding '{self.encoding}' is none of binary, text, both.")
        if self.images not in ("copied", "referenced"):
            raise InputError(f"images can be copied or referenced, not '{self.images}'.")
        if not 0 <= self.points <= MOST_POINTS:
            raise InputError(f"{self.points} points; 0 to {MOST_POINTS} can be written.")


def write_colmap(
    scene: LabelledScene,
    folder: ExportFolder,
    config: ColmapWriteConfig,
    *,
    progress: Callable[[], None] | None = None,
) -> WrittenScene:
    """Write a scene as a COLMAP project.

    Args:
        scene: its images with camera poses are written, the others are named in the notes.
        folder: to fill; gone on with where it was interrupted.
        config: what to write.
        progress: called once per frame.

    Raises:
        InputError: no image has a camera pose, or an image cannot be read.
    """
    place = _common_place(scene) if config.images == "referenced" else None
    cameras: dict[tuple[float, ...], CameraRow] = {}
    images: list[ImageRow] = []
    without: list[str] = []
    units_m: set[float] = set()
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
        if place is not None:
            name = source.resolve().relative_to(place).as_posix()
            if config.encoding != "binary" and len(name.split()) > 1:
                raise InputError(
                    f"the image '{name}' has a space in its name, at which COLMAP's text reader "
                    "cuts it. Write the model as binary, or copy the images."
                )
        camera = _camera_of(frame, cameras)
        T_cam_world = se3.invert(frame.T_world_cam)
        images.append(image_row(index + 1, camera.camera_id, T_cam_world, name))
        objects += len(frame.objects)
        files, unit_m = _files_of(scene, frame, name, config)
        units_m |= {unit_m} if unit_m is not None else set()
        piece = f"frame {index}"
        if files and not folder.has(piece):
            folder.write_piece(piece, files)
            written += 1
    if not images:
        raise InputError(
            f"{scene.name}: none of the {len(scene.indices)} images has a camera pose, and a "
            "COLMAP model is made of them. Calibrate or register the session first."
        )
    count = _write_model(scene, folder, config, list(cameras.values()), images)
    return WrittenScene(
        name=scene.name, folder=folder.place, frames=len(images),
        frames_written=written if config.images == "copied" or config.depth else len(images),
        objects=objects,
        notes=_notes(without, place, list(cameras.values()), sorted(units_m), objects),
        counts={"cameras": len(cameras), "points": count},
    )  # fmt: skip


def _camera_of(frame: LabelledFrame, cameras: dict[tuple[float, ...], CameraRow]) -> CameraRow:
    """Return the row of a frame's camera; equal cameras are one."""
    row = camera_row(len(cameras) + 1, frame.intrinsics)
    return cameras.setdefault((row.width, row.height, *row.params), row)


def _files_of(
    scene: LabelledScene, frame: LabelledFrame, name: str, config: ColmapWriteConfig
) -> tuple[dict[str, Content], float | None]:
    """Return the image files of a frame, and the unit [m] of its depth where it is written."""
    files: dict[str, Content] = {}
    unit_m: float | None = None
    if config.images == "copied":
        files[f"images/{name}"] = scene.colour_file(frame.index)
    if config.depth:
        depth = scene.depth_file(frame.index)
        if depth is not None and frame.depth_unit_m is not None:
            files[f"depth/{frame.index:06d}.png"] = depth
            unit_m = frame.depth_unit_m
    return files, unit_m


def _write_model(
    scene: LabelledScene, folder: ExportFolder, config: ColmapWriteConfig,
    cameras: list[CameraRow], images: list[ImageRow],
) -> int:  # fmt: skip
    """Write the files of the model if they are not there yet; return its number of points."""
    if folder.has(MODEL_PIECE):
        return int(dict(folder.rows(POINTS_ROW)).get(scene.name, 0))
    cloud = coloured_points(scene, config.points)
    files: dict[str, bytes] = {}
    if config.encoding != "text":
        files |= binary_files(cameras, images, cloud.points, cloud.colours)
    if config.encoding != "binary":
        files |= text_files(cameras, images, cloud.points, cloud.colours)
    folder.write_piece(
        MODEL_PIECE,
        {f"{MODEL_FOLDER}/{name}": data for name, data in files.items()},
        {POINTS_ROW: (scene.name, len(cloud.points))},
    )
    return len(cloud.points)


def _common_place(scene: LabelledScene) -> Path:
    """Return the folder that all colour images lie in or below."""
    parents = {scene.colour_file(i).resolve().parent for i in scene.indices}
    if not parents:
        raise InputError(f"{scene.name} has no images.")
    place = sorted(parents)[0]
    while not all(p.is_relative_to(place) for p in parents):
        place = place.parent
    return place


def _notes(
    without: list[str], place: Path | None, cameras: list[CameraRow], units_m: list[float],
    objects: int,
) -> tuple[str, ...]:  # fmt: skip
    notes: list[str] = []
    if without:
        notes.append(
            f"{len(without)} images have no camera pose and were left out: {shown(without)}."
        )
    if place is not None:
        notes.append(f"the images stay where they are: give {place} as the image path.")
    if any(c.model != "PINHOLE" for c in cameras):
        notes.append(
            "the images are distorted and the cameras say so; trainers that take PINHOLE only need "
            "COLMAP's image_undistorter first."
        )
    if units_m:
        said = " and ".join(f"{u:g}" for u in units_m)
        notes.append(f"depth/ has {said} m per count; COLMAP has no field that says it.")
    if objects:
        notes.append("COLMAP has no place for objects and their poses: they were left out.")
    return tuple(notes)
