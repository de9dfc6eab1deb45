"""Image files of one camera with their poses and, where there is any, depth: a frame source.

COLMAP's models and nerfstudio's transforms.json name such images; what they say of poses is judged
by the depth.
"""

import hashlib
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from realsim import images
from realsim.arrays import Array, Array32
from realsim.errors import InputError
from realsim.formats.evidence import poses_checked_by_depth
from realsim.formats.folders.depth_evidence import depth_evidence, require_unit
from realsim.formats.folders.listing import image_header
from realsim.formats.folders.source import file_digest, require_one_size
from realsim.formats.frame_source import SourceFrame
from realsim.records import CameraIntrinsics

SAME_CAMERA = 1e-9
"""Cameras whose parameters differ by less are one camera, written once for every image."""


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class PosedImage:
    """One image and where its camera stood."""

    name: str
    """As the file that places it has it."""
    colour: Path
    depth: Path | None
    intrinsics: CameraIntrinsics
    T_world_cam: Array
    """(4, 4) OpenCV camera in the file's world, in its unit."""

    def T_metric(self, metres_per_unit: float | None) -> Array:
        """Return the pose (4, 4) with its translation in metres, as far as they are known."""
        T = self.T_world_cam.copy()
        T[:3, 3] *= 1.0 if metres_per_unit is None else metres_per_unit
        return T


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class PosedImages:
    """Images of one camera, opened and checked."""

    kind: str
    """Kind of the file that places them."""
    path: Path
    """That file, or its folder."""
    name: str
    """What the session is to be called."""
    intrinsics: CameraIntrinsics
    """The camera of all images."""
    images: tuple[PosedImage, ...]
    """In natural order of their names."""
    depth_unit_m: float | None
    """Metres per count; None where depth is not imported."""
    metres_per_unit: float | None
    """Metres per unit of the file's world; None = not known."""
    notes: tuple[str, ...]
    """What was left out, undone and checked."""

    @property
    def extra(self) -> dict[str, Any]:
        """Where it came from: kind, file, images, scale, content key."""
        digest = hashlib.sha256()
        for image in self.images:
            digest.update(file_digest(image.colour, image.name))
            if image.depth is not None and self.depth_unit_m is not None:
                digest.update(file_digest(image.depth, image.name))
            digest.update(image.T_world_cam.tobytes())
        return {
            "kind": self.kind,
            "path": str(self.path.resolve()),
            "metres_per_unit": self.metres_per_unit,
            "frames": [image.name for image in self.images],
            "content_key": digest.hexdigest(),
        }

    def __len__(self) -> int:
        """Return the number of images."""
        return len(self.images)

    def frames(self, start: int = 0) -> Iterator[SourceFrame]:
        """Yield the images from place `start` on.

        Raises:
            InputError: an image cannot be read; the message names it.
        """
        for k, image in enumerate(self.images[start:], start):
            deep = image.depth if self.depth_unit_m is not None else None
            yield SourceFrame(
                name=image.name,
                time_s=float(k),
                rgb=images.read_rgb(image.colour),
                depth_counts=None if deep is None else images.read_counts(deep),
                T_world_cam=image.T_metric(self.metres_per_unit),
            )


def same_camera(a: CameraIntrinsics, b: CameraIntrinsics) -> bool:
    """Return whether two cameras are one, said twice."""
    rows = [np.array([c.width, c.height, c.fx, c.fy, c.cx, c.cy, *c.distortion]) for c in (a, b)]
    return bool(np.allclose(rows[0], rows[1], rtol=0, atol=SAME_CAMERA))


def require_scale(metres_per_unit: float | None) -> None:
    """Raise unless a scale is positive, or not known.

    Raises:
        InputError: says what was given.
    """
    if metres_per_unit is not None and not (np.isfinite(metres_per_unit) and metres_per_unit > 0):
        raise InputError(f"the scale {metres_per_unit} is not a positive number of metres.")


def checked_by_depth(
    deep: Sequence[PosedImage],
    camera: CameraIntrinsics,
    unit_m: float | None,
    where: str,
    metres_per_unit: float | None,
    remedy: str,
) -> tuple[float, float, list[str]]:
    """Return the depth unit and the median depth [m], and what depth says of the poses.

    Args:
        deep: images with depth.
        camera: of all images.
        unit_m: metres per count as told.
        where: for messages.
        metres_per_unit: as told, None = not told.
        remedy: what to do where depth contradicts the poses.

    Raises:
        InputError: no unit, another size than the colour's, or poses that the depth contradicts in
            their direction, their axes or their unit.
    """
    paths = [image.depth for image in deep if image.depth is not None]
    size = require_one_size([image_header(p) for p in paths], f"depth images of {where}")
    if size != (camera.width, camera.height):
        raise InputError(
            f"{where}: the depth images are {size[0]}x{size[1]} px, the colour images "
            f"{camera.width}x{camera.height} px: depth is not on the colour's pixels. Align it, or "
            "leave it out with --no-depth."
        )
    evidence = depth_evidence(paths)
    unit = require_unit(unit_m, evidence, "plain", where)

    def depth_of(k: int) -> tuple[Array32, CameraIntrinsics]:
        return images.read_depth(paths[k], unit), camera

    Ts = np.stack([image.T_metric(metres_per_unit) for image in deep])
    said = poses_checked_by_depth(Ts, depth_of, where, metres_per_unit, remedy)
    return unit, evidence.median("plain") * unit, said
