"""A labelled scene as a nerfstudio data set: transforms.json, images, depth, masks, points.

    FOLDER/transforms.json
    FOLDER/images/000000.png ...
    FOLDER/depth/000000.png ...     16 bit, millimetres unless asked otherwise
    FOLDER/sparse_pc.ply            what Gaussian splatting begins with

Poses and points are in metres in the scene's own world: `applied_transform` is the identity.
"""

import json
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np

from realsim import images
from realsim.errors import InputError
from realsim.formats.coloured_points import require_points, write_points
from realsim.formats.export_folder import Content, ExportFolder
from realsim.formats.folders.listing import shown
from realsim.formats.labelled_scene import LabelledFrame, LabelledScene, WrittenScene
from realsim.formats.nerfstudio.transforms import (
    DEFAULT_DEPTH_UNIT_M,
    FILE,
    UNIT,
    camera_entry,
    transform_matrix,
)
from realsim.geometry.clouds import cloud_ply
from realsim.records import CameraIntrinsics

POINTS_FILE = "sparse_pc.ply"
ROWS = "frames.json"
"""Where the export notes the frames that are done."""


@dataclass(frozen=True, kw_only=True, slots=True)
class NerfstudioWriteConfig:
    """How a scene is written for nerfstudio."""

    depth_unit_m: float | None = DEFAULT_DEPTH_UNIT_M
    """Metres per count of the depth images. nerfstudio takes millimetres unless it is told another
    on its command line, so finer depth is rounded to them; None = the scene's own unit, exactly."""
    points: int = 100_000
    """Most points in sparse_pc.ply, averaged out of the depth images; 0 = none."""

    def __post_init__(self) -> None:
        """Check the values."""
        if self.depth_unit_m is not None and not 1e-6 <= self.depth_unit_m <= 0.1:
            raise InputError(
                f"{self.depth_unit_m} m per count of depth; 1e-6 to 0.1 can be written."
            )
        require_points(self.points)


def write_nerfstudio(
    scene: LabelledScene,
    folder: ExportFolder,
    config: NerfstudioWriteConfig,
    *,
    progress: Callable[[], None] | None = None,
) -> WrittenScene:
    """Write a scene as a nerfstudio data set.

    Args:
        scene: its images with camera poses are written, the others are named in the notes.
        folder: to fill; gone on with where it was interrupted.
        config: what to write.
        progress: called once per frame.

    Raises:
        InputError: no image has a camera pose, a lens that nerfstudio has no place for, several
            depth units where the scene's own was asked for, or an image cannot be read.
    """
    posed, without = _posed(scene)
    shared = _shared_camera(scene, posed)
    unit_m = _depth_unit(scene, posed, config)
    written = objects = 0
    for index in scene.indices:
        if progress is not None:
            progress()
        if index not in posed:
            continue
        frame = scene.frame(index)
        objects += len(frame.objects)
        piece = f"frame {index}"
        if folder.has(piece):
            continue
        entry, files = _frame(scene, frame, unit_m)
        if shared is None:
            entry |= camera_entry(frame.intrinsics, f"image {index} of {scene.name}")
        folder.write_piece(piece, files, {ROWS: (str(index), entry)})
        written += 1
    points = write_points(
        scene, folder, config.points, "points",
        lambda c: {POINTS_FILE: cloud_ply(c.points, c.colours)} if len(c.points) else {},
    )  # fmt: skip
    top = _top(scene, shared, unit_m, points)
    folder.write_document(FILE, _document(top, folder))
    return WrittenScene(
        name=scene.name, folder=folder.place, frames=len(posed), frames_written=written,
        objects=objects, notes=_notes(scene, posed, without, unit_m, objects),
        counts={"points": points},
    )  # fmt: skip


def _posed(scene: LabelledScene) -> tuple[frozenset[int], list[str]]:
    """Return the numbers of images with a camera pose, and those without."""
    posed = frozenset(i for i in scene.indices if scene.frame(i).T_world_cam is not None)
    if not posed:
        raise InputError(
            f"{scene.name}: none of the {len(scene.indices)} images has a camera pose, and "
            f"{FILE} is made of them. Calibrate or register the session first."
        )
    return posed, [str(i) for i in scene.indices if i not in posed]


def _shared_camera(scene: LabelledScene, posed: frozenset[int]) -> CameraIntrinsics | None:
    """Return the camera if all images have the same one."""
    cameras = {
        (c.width, c.height, c.fx, c.fy, c.cx, c.cy, *c.distortion.tolist()): c
        for c in (scene.frame(i).intrinsics for i in posed)
    }
    return next(iter(cameras.values())) if len(cameras) == 1 else None


def _depth_unit(
    scene: LabelledScene, posed: frozenset[int], config: NerfstudioWriteConfig
) -> float | None:
    """Return metres per count of the depth to be written, None where there is no depth."""
    units = {scene.frame(i).depth_unit_m for i in posed if scene.depth_file(i) is not None}
    known = sorted(u for u in units if u is not None)
    if not known:
        return None
    if config.depth_unit_m is not None:
        return config.depth_unit_m
    if len(known) > 1:
        raise InputError(
            f"{scene.name} has depth in units of {known[0]:g} and {known[-1]:g} m, and nerfstudio "
            "has one. Say one, such as depth_unit_m=0.001."
        )
    return known[0]


def _frame(
    scene: LabelledScene, frame: LabelledFrame, unit_m: float | None
) -> tuple[dict[str, Any], dict[str, Content]]:
    """Return the entry of a frame without its camera, and its files."""
    colour = scene.colour_file(frame.index)
    name = f"images/{frame.index:06d}{colour.suffix.lower()}"
    entry: dict[str, Any] = {"file_path": name}
    files: dict[str, Content] = {name: colour}
    depth = scene.depth_file(frame.index)
    if depth is not None and unit_m is not None and frame.depth_unit_m is not None:
        name = f"depth/{frame.index:06d}.png"
        entry["depth_file_path"] = name
        files[name] = depth
        if frame.depth_unit_m != unit_m:
            depth_m = images.read_counts(depth) * np.float64(frame.depth_unit_m)
            files[name] = images.png_bytes(images.depth_counts(depth_m, unit_m))
    assert frame.T_world_cam is not None  # only posed frames come here
    entry["transform_matrix"] = transform_matrix(frame.T_world_cam)
    return entry, files


def _top(
    scene: LabelledScene, shared: CameraIntrinsics | None, unit_m: float | None, points: int
) -> dict[str, Any]:
    """Return the keys of the whole file."""
    top: dict[str, Any] = {"camera_model": "OPENCV"}
    if shared is not None:
        top |= camera_entry(shared, scene.name)
    if unit_m is not None:
        top[UNIT] = unit_m
    top["applied_transform"] = np.eye(4)[:3].tolist()
    if points:
        top["ply_file_path"] = POINTS_FILE
    return top


def _document(top: dict[str, Any], folder: ExportFolder) -> Iterator[str]:
    yield "{\n"
    for key, value in top.items():
        yield f" {json.dumps(key)}: {json.dumps(value, allow_nan=False)},\n"
    yield ' "frames": [\n'
    for k, (_, entry) in enumerate(folder.rows(ROWS)):
        yield ("  " if k == 0 else ",\n  ") + json.dumps(entry, allow_nan=False)
    yield "\n ]\n}\n"


def _notes(
    scene: LabelledScene, posed: frozenset[int], without: list[str], unit_m: float | None,
    objects: int,
) -> tuple[str, ...]:  # fmt: skip
    notes: list[str] = []
    if without:
        notes.append(
            f"{len(without)} images have no camera pose and were left out: {shown(without)}."
        )
    units = {scene.frame(i).depth_unit_m for i in posed}
    finer = sorted(u for u in units if u is not None and unit_m is not None and u < unit_m)
    if finer:
        notes.append(
            f"depth was rounded from {finer[0]:g} to {unit_m:g} m per count, what nerfstudio takes."
        )
    if unit_m is not None and unit_m != DEFAULT_DEPTH_UNIT_M:
        notes.append(
            f"nerfstudio does not read {UNIT} from the file: give it --depth-unit-scale-factor "
            f"{unit_m:g}."
        )
    if objects:
        notes.append("nerfstudio has no place for objects and their poses: they were left out.")
    return tuple(notes)
