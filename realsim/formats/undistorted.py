"""A labelled scene as an ideal pinhole camera would have seen it, for formats without distortion.

The new camera has the same K and image size. Colour is interpolated; depth and masks, which must
not be mixed over edges, are taken from the nearest pixel. Pixels that the lens did not see are 0.
"""

from collections.abc import Mapping
from dataclasses import replace
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np

from realsim import images
from realsim.arrays import Array, Array32, Mask, UInt16
from realsim.formats.folders.depth_evidence import read_counts
from realsim.formats.grasps.scene_grasps import SceneGrasps
from realsim.formats.labelled_scene import LabelledFrame, LabelledScene
from realsim.records import CameraIntrinsics, ObjectModel


class UndistortedScene:
    """A `LabelledScene` made of another one; its images lie in a folder for the time being."""

    def __init__(self, scene: LabelledScene, folder: Path) -> None:
        """Take a scene.

        Args:
            scene: with any lens.
            folder: for images while they are written elsewhere; one of each kind at a time.
        """
        self._scene, self._folder = scene, folder

    @property
    def name(self) -> str:
        """The scene's name."""
        return self._scene.name

    @property
    def number(self) -> int:
        """The scene's number."""
        return self._scene.number

    @property
    def split(self) -> str:
        """The scene's split."""
        return self._scene.split

    @property
    def camera(self) -> str:
        """The scene's camera."""
        return self._scene.camera

    @property
    def indices(self) -> tuple[int, ...]:
        """Numbers of the images."""
        return self._scene.indices

    @property
    def T_world_table(self) -> Array | None:
        """(4, 4) supporting plane in world [m]; None = not known."""
        return self._scene.T_world_table

    @property
    def notes(self) -> tuple[str, ...]:
        """The scene's, and that it was undistorted."""
        return (
            *self._scene.notes,
            "images, depth and masks were undistorted: colour interpolated, depth and masks from "
            "the nearest pixel.",
        )

    def frame(self, index: int) -> LabelledFrame:
        """Return one frame; counts of pixels, which have changed, are left out."""
        frame = self._scene.frame(index)
        if not frame.intrinsics.is_distorted:
            return frame
        objects = tuple(replace(o, gt_info=None, visible_fraction=None) for o in frame.objects)
        ideal = replace(frame.intrinsics, distortion=np.zeros(8))
        return replace(frame, intrinsics=ideal, objects=objects, entry=None)

    def colour_file(self, index: int) -> Path:
        """Return the undistorted colour image; it is there until the next one is asked for."""
        path, camera = self._scene.colour_file(index), self._scene.frame(index).intrinsics
        if not camera.is_distorted:
            return path
        import cv2

        u, v = _looked_up(camera_key(camera))
        rgb = cv2.remap(images.read_rgb(path), u, v, cv2.INTER_LINEAR)
        return self._kept("colour.png", images.png_bytes(np.asarray(rgb)))

    def depth_file(self, index: int) -> Path | None:
        """Return the undistorted depth; it is there until the next one is asked for."""
        path, camera = self._scene.depth_file(index), self._scene.frame(index).intrinsics
        if path is None or not camera.is_distorted:
            return path
        return self._kept("depth.png", images.png_bytes(nearest(read_counts(path), camera)))

    def mask(self, index: int, k: int, *, visible: bool) -> Mask | None:
        """Return an undistorted mask (H, W); None = the source has none."""
        mask = self._scene.mask(index, k, visible=visible)
        camera = self._scene.frame(index).intrinsics
        if mask is None or not camera.is_distorted:
            return mask
        return nearest(mask.astype(np.uint16), camera) > 0

    def models(self) -> Mapping[int, ObjectModel]:
        """Return the scene's models."""
        return self._scene.models()

    def grasps(self) -> SceneGrasps | None:
        """Return the scene's grasps."""
        return self._scene.grasps()

    def _kept(self, name: str, data: bytes) -> Path:
        self._folder.mkdir(parents=True, exist_ok=True)
        path = self._folder / name
        path.write_bytes(data)
        return path


Key = tuple[int, int, float, float, float, float, tuple[float, ...]]


def camera_key(camera: CameraIntrinsics) -> Key:
    """Return a camera's numbers, which tell it from others."""
    i = camera
    terms: list[float] = i.distortion.tolist()
    return (i.width, i.height, i.fx, i.fy, i.cx, i.cy, tuple(terms))


@lru_cache(maxsize=2)
def _looked_up(key: Key) -> tuple[Array32, Array32]:
    """Return where each pixel of the ideal camera lies in the raw image, x and y (H, W) [px]."""
    import cv2

    width, height, fx, fy, cx, cy, terms = key
    K = np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])
    maps: Any = cv2.initUndistortRectifyMap(
        K, np.array(terms), np.eye(3), K, (width, height), cv2.CV_32FC1
    )
    return maps[0], maps[1]


def nearest(image: UInt16, camera: CameraIntrinsics) -> UInt16:
    """Return a single-channel image (H, W) undistorted, each pixel from the nearest raw one."""
    import cv2

    u, v = _looked_up(camera_key(camera))
    return np.asarray(cv2.remap(image, u, v, cv2.INTER_NEAREST), dtype=np.uint16)
