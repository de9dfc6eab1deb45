"""Reading a transforms.json: where its images and depth are, their cameras and poses."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import Any, cast

import numpy as np
from numpy.typing import NDArray

from realsim.errors import InputError
from realsim.formats.folders.joining import natural_key
from realsim.formats.folders.listing import ENDINGS, image_header, shown
from realsim.formats.nerfstudio.cameras import T_world_cam_of, intrinsics_of, undone
from realsim.records import CameraIntrinsics
from realsim.untrusted import json_text, values

Array = NDArray[np.float64]
FILE = "transforms.json"
MOST_FRAMES = 200_000
"""Frames in one file; more are a whole data set."""
DEFAULT_DEPTH_UNIT_M = 1e-3
"""nerfstudio's own --depth-unit-scale-factor where nobody says another."""


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class TransformsFrame:
    """One frame as the file has it."""

    name: str
    """`file_path`, as it stands there."""
    colour: Path
    depth: Path | None
    intrinsics: CameraIntrinsics
    T_world_cam: Array
    """(4, 4) OpenCV camera in the original world, in the file's unit before `applied_scale`."""


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Transforms:
    """What a transforms.json says."""

    path: Path
    frames: tuple[TransformsFrame, ...]
    """Those whose images are there, in natural order of their names."""
    depth_unit: float
    """Of the file's world per count of depth."""
    depth_unit_said: str
    """Who says so: a key of the file, or ''."""
    notes: tuple[str, ...]


def find_transforms(root: Path | str) -> Path | None:
    """Return the transforms.json of a folder, or the file itself; None where there is none."""
    root = Path(root)
    if root.is_file():
        return (
            root if root.suffix.lower() == ".json" and root.stem.startswith("transforms") else None
        )
    return root / FILE if (root / FILE).is_file() else None


def read_transforms(path: Path | str, *, images_folder: Path | None = None) -> Transforms:
    """Return the frames of a transforms.json.

    Args:
        path: the file.
        images_folder: where images of these names are, instead of where the file says.

    Raises:
        InputError: damaged, a camera or pose that cannot be, two frames of one image, or no image
            is there.
    """
    path = Path(path)
    top = values.mapping(json_text.read_json(path), str(path))
    entries = top.get("frames")
    if not isinstance(entries, list) or not entries:
        raise InputError(f"{path} has no list of 'frames'; is it a transforms.json?")
    rows = cast("list[Any]", entries)
    if len(rows) > MOST_FRAMES:
        raise InputError(f"{path} has {len(rows)} frames; at most {MOST_FRAMES} are one scene.")
    T_original_file, factor, notes = undone(top, str(path))
    frames: list[TransformsFrame] = []
    absent: list[str] = []
    seen: set[str] = set()
    for k, row in enumerate(rows):
        where = f"frame {k + 1} of {path}"
        entry = values.mapping(row, where)
        name = values.text(entry.get("file_path"), f"'file_path' of {where}")
        if name in seen:
            raise InputError(f"{path} has two frames of the image {name}: which pose is its own?")
        seen.add(name)
        T = T_world_cam_of(entry.get("transform_matrix"), f"'transform_matrix' of {where}")
        T[:3, 3] *= factor
        colour = _image_file(path.parent, name, images_folder, where)
        if colour is None:
            absent.append(name)
            continue
        frames.append(
            TransformsFrame(
                name=name, colour=colour, depth=_depth_file(path.parent, entry, where),
                intrinsics=intrinsics_of(top, entry, image_header(colour).size, where),
                T_world_cam=T_original_file @ T,
            )
        )  # fmt: skip
    if not frames:
        raise InputError(
            f"none of the {len(rows)} images of {path} was found ({shown(absent, 3)}). Give the "
            "folder that they are in with --images."
        )
    if absent:
        notes.append(f"{len(absent)} images are not there and were left out: {shown(absent)}.")
    notes += _other_notes(top, rows)
    frames.sort(key=lambda f: natural_key(f.name))
    unit, said = _depth_unit(top, path)
    return Transforms(
        path=path, frames=tuple(frames), depth_unit=unit * (1.0 if said != NGP_UNIT else factor),
        depth_unit_said=said, notes=tuple(notes),
    )  # fmt: skip


def _image_file(folder: Path, name: str, images_folder: Path | None, where: str) -> Path | None:
    """Return the image that a frame names; NeRF's own files leave the ending out."""
    if images_folder is not None:
        path = images_folder / PurePosixPath(name.replace("\\", "/")).name
    else:
        path = values.path_inside(folder, name, f"'file_path' of {where}")
    if path.is_file():
        return path
    if path.suffix.lower() in ENDINGS:
        return None
    beside = (path.with_name(path.name + ending) for ending in ENDINGS)
    return next((p for p in beside if p.is_file()), None)


def _depth_file(folder: Path, entry: Mapping[str, Any], where: str) -> Path | None:
    """Return the depth image that a frame names, None where it names none or it is not there."""
    for key in ("depth_file_path", "depth_path"):
        if entry.get(key) is not None:
            path = values.path_inside(folder, entry[key], f"'{key}' of {where}")
            return path if path.is_file() else None
    return None


UNIT, NGP_UNIT = "depth_unit_scale_factor", "integer_depth_scale"


def _depth_unit(top: Mapping[str, Any], path: Path) -> tuple[float, str]:
    """Return units per count of depth, and the key that says so ('' = nerfstudio's default)."""
    for key in (UNIT, NGP_UNIT):
        if key in top:
            return values.number(top[key], f"'{key}' of {path}", 1e-9, 1e3), key
    return DEFAULT_DEPTH_UNIT_M, ""


def _other_notes(top: Mapping[str, Any], rows: Sequence[Any]) -> list[str]:
    """Return notes on what the file has and is not used."""
    notes: list[str] = []
    boxed = [k for k in ("aabb_scale", "scale", "offset") if k in top]
    if boxed:
        notes.append(
            f"{', '.join(boxed)} of instant-ngp say how it places the scene in its box when it "
            "loads; the poses in the file are before that, and were taken as they stand."
        )
    masks = sum(isinstance(row, dict) and "mask_path" in row for row in rows)
    if masks:
        notes.append(f"{masks} masks of the training were left aside.")
    return notes
