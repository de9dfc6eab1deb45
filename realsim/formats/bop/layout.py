"""Where the files of a BOP scene are, for one of its cameras.

    SPLIT/000001/scene_camera.json, rgb/ or gray/, depth/, mask/, mask_visib/        one camera
    SPLIT/000001/scene_camera_cam1.json, rgb_cam1/, depth_cam1/, mask_cam1/ ...      several
    SPLIT/000001/scene_camera_gray1.json, gray1/, mask_gray1/ ...                    HOT3D
    onboarding_static/obj_000001_up/, onboarding_dynamic/obj_000001/                 scenes, too

(bop_toolkit, docs/bop_datasets_format.md and bop_toolkit_lib/dataset_params.py.)
"""

import os
import re
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

Document = Literal["scene_camera", "scene_gt", "scene_gt_info", "scene_gt_coco"]
ImageKind = Literal["rgb", "gray", "depth", "mask", "mask_visib"]
CAMERA_DOCUMENT = re.compile(r"scene_camera(?:_([A-Za-z0-9][A-Za-z0-9_-]*))?\.json")
ONBOARDING = re.compile(r"obj_(\d+)(?:_(\w+))?")
COLOUR_ENDINGS = (".png", ".jpg", ".jpeg", ".tif", ".tiff")
DEPTH_ENDINGS = (".png", ".tif", ".tiff")
DIGITS = 6
"""Digits of an image's number in its name, at least."""


@dataclass(frozen=True, kw_only=True, slots=True)
class SceneLayout:
    """Names of the files of one camera of a scene."""

    folder: Path
    """The scene."""
    camera: str = ""
    """Type of the camera ('cam1', 'photoneo', 'gray1'); '' where the scene has one."""

    @property
    def suffix(self) -> str:
        """What is added to the names of documents and folders."""
        return f"_{self.camera}" if self.camera else ""

    def document(self, name: Document) -> Path:
        """Return the path of a document, whether it is there or not."""
        return self.folder / f"{name}{self.suffix}.json"

    def images(self, kind: ImageKind) -> Path:
        """Return the folder of a kind of images, whether it is there or not."""
        return self.folder / f"{kind}{self.suffix}"

    def colour_files(self) -> dict[int, Path]:
        """Return the colour images by number; grey ones where there are none."""
        folders = [self.images("rgb"), self.images("gray")]
        if self.camera.startswith(("rgb", "gray")):
            folders.append(self.folder / self.camera)
        found: dict[int, Path] = {}
        for folder in folders:
            found = numbered_files(folder, COLOUR_ENDINGS) | found
        return found

    def depth_files(self) -> dict[int, Path]:
        """Return the depth images by number."""
        return numbered_files(self.images("depth"), DEPTH_ENDINGS)

    def mask_numbers(self, *, visible: bool) -> dict[int, set[int]]:
        """Return which objects (their places in scene_gt) have a mask file, by image."""
        found: dict[int, set[int]] = {}
        for name in _names(self.images("mask_visib" if visible else "mask")):
            image, _, place = name.removesuffix(".png").partition("_")
            if name.endswith(".png") and _is_number(image) and _is_number(place):
                found.setdefault(int(image), set()).add(int(place))
        return found

    def mask_file(self, index: int, k: int, *, visible: bool) -> Path:
        """Return the path of a mask, whether it is there or not."""
        return self.images("mask_visib" if visible else "mask") / f"{index:06d}_{k:06d}.png"


def numbered_files(folder: Path, endings: tuple[str, ...]) -> dict[int, Path]:
    """Return the files of a folder named by a number (000012.png); earlier endings win."""
    found: dict[int, tuple[int, Path]] = {}
    for name in _names(folder):
        stem, ending = os.path.splitext(name)
        if ending.lower() in endings and _is_number(stem):
            rank = endings.index(ending.lower())
            if int(stem) not in found or rank < found[int(stem)][0]:
                found[int(stem)] = (rank, folder / name)
    return {i: found[i][1] for i in sorted(found)}


def cameras_of(folder: Path) -> list[str]:
    """Return the types of the cameras of a scene folder; [''] where it has one, [] = no scene."""
    found = (CAMERA_DOCUMENT.fullmatch(name) for name in _names(folder))
    return sorted({match[1] or "" for match in found if match})


def scene_number(folder_name: str) -> int:
    """Return the number of a scene by its folder's name: 000050, or obj_000001_up; else 0."""
    if folder_name.isascii() and folder_name.isdecimal():
        return int(folder_name)
    match = ONBOARDING.fullmatch(folder_name)
    return int(match[1]) if match else 0


def _is_number(text: str) -> bool:
    return text.isascii() and text.isdecimal() and DIGITS <= len(text) <= 2 * DIGITS


def _names(folder: Path) -> list[str]:
    return sorted(os.listdir(folder)) if folder.is_dir() else []
