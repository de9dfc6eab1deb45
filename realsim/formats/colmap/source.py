"""The registered images of a COLMAP model as a frame source."""

import hashlib
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from realsim import images
from realsim.errors import InputError
from realsim.formats.colmap.depth import checked_by_depth, find_depth
from realsim.formats.colmap.model import ColmapImage, ColmapModel, find_model, read_model
from realsim.formats.folders.depth_evidence import read_counts
from realsim.formats.folders.joining import natural_key
from realsim.formats.folders.listing import image_header, shown
from realsim.formats.folders.source import file_digest, require_one_size
from realsim.formats.frame_source import SourceFrame
from realsim.records import CameraIntrinsics

IMAGE_FOLDERS = ("images", "image", "rgb", "input", "")
"""Where in a project's folder its images may be."""
SAME_CAMERA = 1e-9
"""Cameras whose parameters differ by less are one camera, listed once for every image."""


class ColmapSource:
    """Images of one camera of a COLMAP model; made by `open_colmap`."""

    def __init__(
        self, name: str, model: ColmapModel, camera: CameraIntrinsics,
        files: Sequence[tuple[ColmapImage, Path]], notes: Sequence[str], scale: float | None,
        depth: Mapping[str, Path], unit_m: float | None,
    ) -> None:  # fmt: skip
        """Take over what was checked; see `open_colmap`."""
        self._depth, self._unit_m = dict(depth), unit_m
        self._name, self._model, self._camera = name, model, camera
        self._files, self._notes, self._scale = tuple(files), tuple(notes), scale

    @property
    def name(self) -> str:
        """The project's folder name."""
        return self._name

    @property
    def intrinsics(self) -> CameraIntrinsics:
        """The camera of all images."""
        return self._camera

    @property
    def depth_unit_m(self) -> float | None:
        """Metres per count; None without depth images, which COLMAP itself has not."""
        return self._unit_m

    @property
    def notes(self) -> tuple[str, ...]:
        """What was left out, and what is not known of the scale."""
        return self._notes

    @property
    def extra(self) -> dict[str, Any]:
        """Where it came from: model, images, scale, content key."""
        digest = hashlib.sha256()
        for image, path in self._files:
            digest.update(file_digest(path, image.name))
            if image.name in self._depth:
                digest.update(file_digest(self._depth[image.name], image.name))
            digest.update(image.T_world_cam.tobytes())
        return {
            "kind": "colmap",
            "path": str(self._model.folder.resolve()),
            "metres_per_unit": self._scale,
            "frames": [image.name for image, _ in self._files],
            "content_key": digest.hexdigest(),
        }

    def __len__(self) -> int:
        """Return the number of images."""
        return len(self._files)

    def frames(self, start: int = 0) -> Iterator[SourceFrame]:
        """Yield the images from place `start` on, in natural order of their names.

        Raises:
            InputError: an image cannot be read; the message names it.
        """
        for k in range(start, len(self._files)):
            image, path = self._files[k]
            deep = self._depth.get(image.name)
            yield SourceFrame(
                name=image.name, time_s=float(k), rgb=images.read_rgb(path),
                depth_counts=None if deep is None else read_counts(deep),
                T_world_cam=_metric(image, self._scale),
            )  # fmt: skip


def open_colmap(
    root: Path | str,
    *,
    images_folder: Path | str | None = None,
    camera_id: int | None = None,
    metres_per_unit: float | None = None,
    depth_folder: Path | str | None = None,
    depth_unit_m: float | None = None,
    use_depth: bool = True,
) -> ColmapSource:
    """Return a COLMAP model with its images as a frame source.

    Args:
        root: the model's folder, or a project that holds it (sparse/0 and images).
        images_folder: where the images are; None = looked for in the project.
        camera_id: which camera's images, where the model has several cameras.
        metres_per_unit: metres per unit of the model's world; None = not known.
        depth_folder: 16-bit PNG of the images' names; None = depth/ in the project, if a unit is
            given. Depth judges the direction of the poses and the scale.
        depth_unit_m: metres per count of depth.
        use_depth: whether depth is imported.

    Raises:
        InputError: no model, several cameras, images that are not there or of another size.
    """
    root = Path(root)
    folder = find_model(root)
    if folder is None:
        raise InputError(
            f"{root} holds no COLMAP model: cameras and images (.bin or .txt) were looked for "
            "there and in sparse/0, sparse, model, colmap and dense/sparse."
        )
    if metres_per_unit is not None and not (np.isfinite(metres_per_unit) and metres_per_unit > 0):
        raise InputError(f"the scale {metres_per_unit} is not a positive number of metres.")
    model = read_model(folder)
    chosen, camera, notes = _of_one_camera(model, camera_id)
    place = _images_place(root, folder, images_folder, chosen)
    there = [(i, place / i.name) for i in chosen if (place / i.name).is_file()]
    absent = [i.name for i in chosen if not (place / i.name).is_file()]
    if absent:
        notes.append(f"{len(absent)} images are not in {place} and were left out: {shown(absent)}.")
    if model.unregistered:
        notes.append(
            f"{len(model.unregistered)} images have no pose in the model and were left out: "
            f"{shown(model.unregistered)}."
        )
    size = require_one_size([image_header(p) for _, p in there], f"images of {place}")
    if size != (camera.width, camera.height):
        raise InputError(
            f"the images in {place} are {size[0]}x{size[1]} px, the model's camera is of "
            f"{camera.width}x{camera.height} px. Give the images that COLMAP was run on with "
            "--images."
        )
    there.sort(key=lambda pair: natural_key(pair[0].name))
    depth: dict[str, Path] = {}
    unit_m: float | None = None
    if use_depth and (depth_folder is not None or depth_unit_m is not None):
        depth = find_depth(root, depth_folder, [i.name for i, _ in there], notes)
    if depth:
        there = [pair for pair in there if pair[0].name in depth]
        Ts = np.stack([_metric(i, metres_per_unit) for i, _ in there])
        paths = [depth[i.name] for i, _ in there]
        unit_m, said = checked_by_depth(
            paths, Ts, camera, depth_unit_m, str(folder), metres_per_unit
        )
        notes += said
    elif metres_per_unit is None:
        notes.append(
            "scale unknown: a COLMAP model has an arbitrary scale and world; camera poses are "
            "taken as if its unit were the metre. Give --scale (metres per unit) once it is known, "
            "such as a measured distance over the same distance in the model."
        )
    name = root.resolve().name if folder != root else folder.resolve().parent.name
    return ColmapSource(name, model, camera, there, notes, metres_per_unit, depth, unit_m)


def _metric(image: ColmapImage, scale: float | None) -> NDArray[np.float64]:
    """Return T_world_cam of an image with its translation in metres, as far as they are known."""
    T = image.T_world_cam.copy()
    T[:3, 3] *= 1.0 if scale is None else scale
    return T


def _of_one_camera(
    model: ColmapModel, camera_id: int | None
) -> tuple[list[ColmapImage], CameraIntrinsics, list[str]]:
    """Return the images of one camera, the camera, and what was left out.

    Raises:
        InputError: there are several cameras and none was chosen; names them.
    """
    if not model.images:
        raise InputError(f"the COLMAP model {model.folder} has no registered image.")
    groups: dict[int, list[int]] = {}
    for k, camera in sorted(model.cameras.items()):
        first = next((g for g in groups if _same(camera, model.cameras[g])), k)
        groups.setdefault(first, []).append(k)
    counts = {g: sum(i.camera_id in members for i in model.images) for g, members in groups.items()}
    listed = "; ".join(
        f"{g} ({counts[g]} images, {model.cameras[g].width}x{model.cameras[g].height}, "
        f"fx {model.cameras[g].fx:.2f})"
        for g in groups
    )
    notes: list[str] = []
    if camera_id is None:
        if len(groups) > 1:
            raise InputError(
                f"the COLMAP model {model.folder} has {len(groups)} different cameras: {listed}. "
                "A session has one. Choose with --camera-id N."
            )
        group = next(iter(groups))
    else:
        group = next((g for g, members in groups.items() if camera_id in members), -1)
        if group < 0:
            raise InputError(
                f"the COLMAP model {model.folder} has no camera {camera_id}; it has {listed}."
            )
        left = len(model.images) - counts[group]
        notes += [f"{left} images of other cameras were left out."] if left else []
    chosen = [i for i in model.images if i.camera_id in groups[group]]
    return chosen, model.cameras[group], notes


def _same(a: CameraIntrinsics, b: CameraIntrinsics) -> bool:
    values = [np.array([c.width, c.height, c.fx, c.fy, c.cx, c.cy, *c.distortion]) for c in (a, b)]
    return bool(np.allclose(values[0], values[1], rtol=0, atol=SAME_CAMERA))


def _images_place(
    root: Path, folder: Path, given: Path | str | None, wanted: Sequence[ColmapImage]
) -> Path:
    """Return the folder in which the model's images are.

    Raises:
        InputError: none has any of them.
    """
    if given is not None:
        places = [Path(given), root / given]
    else:
        parents = [root, folder, folder.parent, folder.parent.parent]
        places = [p / name for p in parents for name in IMAGE_FOLDERS]
    found = next((p for p in places if any((p / i.name).is_file() for i in wanted)), None)
    if found is None:
        looked = shown([str(p) for p in dict.fromkeys(places)], 8)
        raise InputError(
            f"none of the {len(wanted)} images of the COLMAP model {folder} was found "
            f"({shown([i.name for i in wanted], 3)}); looked in {looked}. Give --images FOLDER."
        )
    return found
