"""COLMAP models, text or binary: cameras and camera poses in our conventions.

The files are read by pycolmap. COLMAP's pixel centres lie at +0.5 and its poses are
`cam_from_world`; both are converted by `realsim.interop`. Its scale is arbitrary unless it was
fixed on purpose, and the model does not say whether it was.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from realsim.errors import InputError
from realsim.formats.colmap.files import require_whole
from realsim.formats.plausible_camera import require_plausible
from realsim.geometry import se3
from realsim.interop import T_from_rigid3d, opencv_from_colmap_px
from realsim.records import CameraIntrinsics

Array = NDArray[np.float64]
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
    for _, image in sorted(dict(model.images).items()):
        if not image.has_pose:
            unregistered.append(str(image.name))
            continue
        T_cam_world = T_from_rigid3d(image.cam_from_world())
        found.append(
            ColmapImage(
                name=str(image.name),
                camera_id=int(image.camera_id),
                T_world_cam=se3.invert(T_cam_world),
            )
        )
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
