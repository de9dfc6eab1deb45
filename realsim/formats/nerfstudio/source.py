"""The images of a transforms.json as a frame source."""

import hashlib
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from realsim import images
from realsim.errors import InputError
from realsim.formats.camera_scale import poses_checked_by_depth
from realsim.formats.folders import depth_evidence as depth_units
from realsim.formats.folders.listing import image_header, shown
from realsim.formats.folders.source import file_digest, require_one_size
from realsim.formats.frame_source import SourceFrame
from realsim.formats.nerfstudio.transforms import (
    FILE,
    NGP_UNIT,
    Transforms,
    TransformsFrame,
    find_transforms,
    read_transforms,
)
from realsim.records import CameraIntrinsics

Array = NDArray[np.float64]
SAME_CAMERA = 1e-9
"""Cameras whose parameters differ by less are one camera, written once for every frame."""
REMEDY = (
    "transform_matrix is camera to world with y up and -z forward; write it so, or give the images "
    "as a folder with the poses in a file of their own (--kind folder --poses)."
)


class NerfstudioSource:
    """Images of one camera of a transforms.json; made by `open_nerfstudio`."""

    def __init__(
        self, transforms: Transforms, camera: CameraIntrinsics, frames: Sequence[TransformsFrame],
        notes: Sequence[str], *, scale: float | None, depth_unit_m: float | None,
    ) -> None:  # fmt: skip
        """Take over what was checked; see `open_nerfstudio`."""
        self._transforms, self._camera = transforms, camera
        self._frames, self._notes = tuple(frames), tuple(notes)
        self._scale, self._unit_m = scale, depth_unit_m

    @property
    def name(self) -> str:
        """The folder's name."""
        return self._transforms.path.resolve().parent.name

    @property
    def intrinsics(self) -> CameraIntrinsics:
        """The camera of all images."""
        return self._camera

    @property
    def depth_unit_m(self) -> float | None:
        """Metres per count; None without depth."""
        return self._unit_m

    @property
    def notes(self) -> tuple[str, ...]:
        """What was left out, undone and checked."""
        return self._notes

    @property
    def extra(self) -> dict[str, Any]:
        """Where it came from: file, images, scale, content key."""
        digest = hashlib.sha256()
        for f in self._frames:
            digest.update(file_digest(f.colour, f.name))
            if f.depth is not None and self._unit_m is not None:
                digest.update(file_digest(f.depth, f.name))
            digest.update(f.T_world_cam.tobytes())
        return {
            "kind": "nerfstudio",
            "path": str(self._transforms.path.resolve()),
            "metres_per_unit": self._scale,
            "frames": [f.name for f in self._frames],
            "content_key": digest.hexdigest(),
        }

    def __len__(self) -> int:
        """Return the number of frames."""
        return len(self._frames)

    def frames(self, start: int = 0) -> Iterator[SourceFrame]:
        """Yield the frames from place `start` on, in natural order of their names.

        Raises:
            InputError: an image cannot be read; the message names it.
        """
        for k in range(start, len(self._frames)):
            f = self._frames[k]
            counts = None
            if f.depth is not None and self._unit_m is not None:
                counts = depth_units.read_counts(f.depth)
            yield SourceFrame(
                name=f.name, time_s=float(k), rgb=images.read_rgb(f.colour), depth_counts=counts,
                T_world_cam=_scaled(f.T_world_cam, self._scale),
            )  # fmt: skip


def open_nerfstudio(
    root: Path | str,
    *,
    images_folder: Path | str | None = None,
    camera_id: int | None = None,
    metres_per_unit: float | None = None,
    depth_unit_m: float | None = None,
    use_depth: bool = True,
) -> NerfstudioSource:
    """Return a transforms.json with its images as a frame source.

    Where there is depth, it judges the poses: their direction and axes, and their unit.

    Args:
        root: the file, or the folder that holds it.
        images_folder: where the images are, if not where the file says.
        camera_id: which camera's images, 1, 2, ... in the order in which the file has them.
        metres_per_unit: metres per unit of the file's world; None = not known.
        depth_unit_m: metres per count of depth; None = what the file says, or nerfstudio's 0.001.
        use_depth: whether depth is imported.

    Raises:
        InputError: no such file, several cameras, images that are not there or of another size, or
            poses that the depth contradicts.
    """
    path = find_transforms(root)
    if path is None:
        raise InputError(f"{root} holds no {FILE}.")
    if metres_per_unit is not None and not (np.isfinite(metres_per_unit) and metres_per_unit > 0):
        raise InputError(f"the scale {metres_per_unit} is not a positive number of metres.")
    transforms = read_transforms(
        path, images_folder=None if images_folder is None else Path(images_folder)
    )
    frames, camera, notes = _of_one_camera(transforms, camera_id)
    notes = [*transforms.notes, *notes]
    unit_m: float | None = None
    deep = [f for f in frames if f.depth is not None]
    if use_depth and deep:
        if len(deep) < len(frames):
            without = [f.name for f in frames if f.depth is None]
            notes.append(
                f"{len(without)} frames have no depth and were left out: {shown(without)}."
            )
        frames = deep
        unit_m, said = _unit_of(transforms, deep, camera, depth_unit_m, metres_per_unit)
        notes += [said, *_checked_by_depth(transforms.path, deep, camera, unit_m, metres_per_unit)]
    elif metres_per_unit is None:
        notes.append(
            f"scale unknown: {FILE} says no unit, and programs that write it often scale the "
            "poses; they are taken as if in metres. Give --scale (metres per unit) once it is "
            "known, such as a measured distance over the same distance in the file's world."
        )
    return NerfstudioSource(
        transforms, camera, frames, notes, scale=metres_per_unit, depth_unit_m=unit_m
    )


def _scaled(T: Array, scale: float | None) -> Array:
    T = T.copy()
    T[:3, 3] *= 1.0 if scale is None else scale
    return T


def _of_one_camera(
    transforms: Transforms, camera_id: int | None
) -> tuple[list[TransformsFrame], CameraIntrinsics, list[str]]:
    """Return the frames of one camera, the camera, and what was left out.

    Raises:
        InputError: there are several cameras and none was chosen; names them.
    """
    groups: list[list[TransformsFrame]] = []
    for f in transforms.frames:
        mine = next((g for g in groups if _same(g[0].intrinsics, f.intrinsics)), None)
        if mine is None:
            groups.append([f])
        else:
            mine.append(f)
    listed = "; ".join(
        f"{n} ({len(g)} images, {g[0].intrinsics.width}x{g[0].intrinsics.height}, fx "
        f"{g[0].intrinsics.fx:.2f}, first {g[0].name})"
        for n, g in enumerate(groups[:8], start=1)
    )
    if camera_id is None and len(groups) > 1:
        raise InputError(
            f"{transforms.path} has {len(groups)} different cameras: {listed}. A session has one. "
            "Choose with --camera-id N."
        )
    chosen = 1 if camera_id is None else camera_id
    if not 1 <= chosen <= len(groups):
        raise InputError(f"{transforms.path} has no camera {chosen}; it has {listed}.")
    frames = groups[chosen - 1]
    require_one_size([image_header(f.colour) for f in frames[:1]], f"images of {transforms.path}")
    left = len(transforms.frames) - len(frames)
    return (
        frames,
        frames[0].intrinsics,
        [f"{left} images of other cameras were left out."] if left else [],
    )


def _same(a: CameraIntrinsics, b: CameraIntrinsics) -> bool:
    rows = [np.array([c.width, c.height, c.fx, c.fy, c.cx, c.cy, *c.distortion]) for c in (a, b)]
    return bool(np.allclose(rows[0], rows[1], rtol=0, atol=SAME_CAMERA))


# --- depth ------------------------------------------------------------------------------------


def _unit_of(
    transforms: Transforms, deep: Sequence[TransformsFrame], camera: CameraIntrinsics,
    given_m: float | None, metres_per_unit: float | None,
) -> tuple[float, str]:  # fmt: skip
    """Return the depth unit [m] and a note that says from where it is.

    Raises:
        InputError: no 16-bit images of the colour's size, or distances that no camera measures.
    """
    paths = [f.depth for f in deep if f.depth is not None]
    for path in paths:
        if path.suffix.lower() in (".npy", ".exr"):
            raise InputError(
                f"{path} is no 16-bit image; depth is read as PNG of counts. Convert it, or leave "
                "depth out with --no-depth."
            )
    size = require_one_size([image_header(p) for p in paths], f"depth images of {transforms.path}")
    if size != (camera.width, camera.height):
        raise InputError(
            f"{transforms.path}: the depth images are {size[0]}x{size[1]} px, the colour images "
            f"{camera.width}x{camera.height} px: depth is not on the colour's pixels. Align it, or "
            "leave it out with --no-depth."
        )
    evidence = depth_units.depth_evidence(paths)
    if given_m is not None:
        unit_m, said = given_m, "as asked"
    elif transforms.depth_unit_said == NGP_UNIT:
        unit_m = transforms.depth_unit * (1.0 if metres_per_unit is None else metres_per_unit)
        said = f"from {NGP_UNIT}, in the unit of the poses"
    else:
        unit_m = transforms.depth_unit
        said = (
            f"from {transforms.depth_unit_said}" if transforms.depth_unit_said else "nerfstudio's"
        )
    depth_units.require_unit(unit_m, evidence, "plain", str(transforms.path))
    return unit_m, (
        f"depth: {unit_m:g} m per count, {said}; median {evidence.median('plain') * unit_m:.3g} m."
    )


def _checked_by_depth(
    path: Path, deep: Sequence[TransformsFrame], camera: CameraIntrinsics, unit_m: float,
    metres_per_unit: float | None,
) -> list[str]:  # fmt: skip
    """Return notes on what depth says of the poses.

    Raises:
        InputError: it contradicts their direction, their axes or their unit.
    """
    Ts = np.stack([_scaled(f.T_world_cam, metres_per_unit) for f in deep])

    def depth_of(k: int) -> tuple[NDArray[np.float32], CameraIntrinsics]:
        return images.read_depth(deep[k].depth or path, unit_m), camera

    return poses_checked_by_depth(Ts, depth_of, str(path), metres_per_unit, REMEDY)
