"""A scene of a BOP dataset as a frame source, its conventions as in `realsim.formats.bop.scene`."""

import hashlib
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from realsim import images
from realsim.arrays import UInt16
from realsim.errors import InputError
from realsim.formats.bop.scene import BopScene, BopSceneRef, find_scenes, read_scene
from realsim.formats.folders.listing import image_header, shown
from realsim.formats.folders.source import file_digest, require_one_size
from realsim.formats.frame_source import SourceFrame
from realsim.store.opening import CAMERA_FILE

TYPICAL_DEPTHS = 3
"""Depth images whose median distance is shown: enough to notice a wrong depth_scale."""


class BopSource:
    """One scene of a BOP dataset; made by `open_bop`."""

    def __init__(self, scene: BopScene, indices: Sequence[int], notes: Sequence[str]) -> None:
        """Take over a scene that was checked; see `open_bop`."""
        self._scene = scene
        self.name = scene.ref.name
        """Split and scene, such as test-000050."""
        self.indices = tuple(indices)
        """Numbers of the images, in the order of the frames."""
        self.intrinsics = scene.session.intrinsics
        """The camera of all images of the scene."""
        with_depth = any(scene.has_depth(i) for i in indices)
        self.depth_unit_m = scene.session.depth_unit_m if with_depth else None
        """depth_scale / 1000; None where the scene has no depth."""
        self.notes = tuple(notes)
        """What was left out and what the scene lacks."""

    @property
    def extra(self) -> dict[str, Any]:
        """Where it came from: scene, image numbers, content key."""
        return {
            "kind": "bop",
            "path": str(self._scene.ref.folder),
            "scene": self._scene.ref.scene_id,
            "frames": [self._scene.color_files[i].name for i in self.indices],
            "content_key": self._content_key(),
        }

    def _content_key(self) -> str:
        scene = self._scene
        digest = hashlib.sha256(scene.ref.layout.document("scene_camera").read_bytes())
        for i in self.indices:
            for path in (scene.color_files[i], scene.depth_files.get(i)):
                if path is not None:
                    digest.update(file_digest(path, path.name))
        return digest.hexdigest()

    def __len__(self) -> int:
        """Return the number of images."""
        return len(self.indices)

    def frames(self, start: int = 0) -> Iterator[SourceFrame]:
        """Yield the images from place `start` on, in the order of their numbers.

        Raises:
            InputError: an image cannot be read; the message names it.
        """
        scene = self._scene
        for i in self.indices[start:]:
            counts = images.read_counts(scene.depth_path(i)) if scene.has_depth(i) else None
            yield SourceFrame(
                name=f"image {i} of {scene.ref.folder}",
                time_s=float(i),
                rgb=images.read_rgb(scene.rgb_path(i)),
                depth_counts=counts,
                T_world_cam=scene.session.view(i).T_world_cam,
            )


def choose_scene(root: Path | str, number: int | None, *, camera: str = "") -> BopSceneRef:
    """Return the scene of a dataset that was asked for, or its only one.

    Args:
        root: dataset, split or scene.
        number: of the scene; None = the only one.
        camera: type of its camera, where it has several; "" = the only one.

    Raises:
        InputError: none, several of which none was chosen, or not that one; lists them.
    """
    scenes = find_scenes(root)
    places = ["/".join([s.split, s.folder.name, *([s.camera] if s.camera else [])]) for s in scenes]
    listed = shown([f"{s.scene_id} ({p})" for s, p in zip(scenes, places, strict=True)], 12)
    chosen = [s for s in scenes if number in (None, s.scene_id) and camera in ("", s.camera)]
    if not chosen:
        asked = [f"scene {'of any number' if number is None else number}"]
        asked += [f"camera '{camera}'"] if camera else []
        raise InputError(f"{root} has no {', '.join(asked)}; it has {listed}.")
    if len(chosen) > 1:
        what = "scenes" if number is None else f"scenes of number {number}"
        if len({s.folder for s in chosen}) == 1:
            raise InputError(
                f"{chosen[0].folder} was seen by {len(chosen)} cameras: "
                f"{', '.join(s.camera or '(none)' for s in chosen)}. Choose one of them by its "
                "name (--camera-name)."
            )
        raise InputError(
            f"{root} has {len(chosen)} {what}: {listed}, and a session holds one. Choose with "
            "--scene N, or give the folder of one scene."
        )
    return chosen[0]


def open_bop(
    root: Path | str, *, scene: int | None = None, use_depth: bool = True, camera: str = ""
) -> BopSource:
    """Return a scene of a BOP dataset as a frame source.

    Args:
        root: dataset, split or scene.
        scene: number of the scene, where there are several.
        use_depth: whether depth is imported.
        camera: type of the camera, where the scene has several.

    Raises:
        InputError: no scene, several, cameras that change, sizes that differ, no depth_scale.
    """
    found = read_scene(choose_scene(root, scene, camera=camera))
    if not use_depth:
        found.depth_files.clear()
    indices = sorted(found.color_files)
    notes: list[str] = []
    if found.missing_images:
        listed = shown([str(i) for i in found.missing_images], 12)
        notes.append(f"{CAMERA_FILE} lists images that are not there: {listed}.")
    without = [i for i in indices if not found.has_depth(i)]
    if 0 < len(without) < len(indices):
        listed = shown([str(i) for i in without], 12)
        notes.append(
            f"{len(without)} of {len(indices)} images have no depth and were left out, their "
            f"frames are not complete: {listed}."
        )
        indices = [i for i in indices if found.has_depth(i)]
    _require_sizes(found, indices)
    used = set(indices)
    posed = sum(v.index in used and v.T_world_cam is not None for v in found.session.views)
    if posed < len(indices):
        notes.append(
            f"{len(indices) - posed} of {len(indices)} images have no camera pose (cam_R_w2c, "
            "cam_t_w2c): these views cannot be registered together."
        )
    median = _median_depth_m(found, indices)
    if median is not None:
        unit_m = found.session.depth_unit_m
        notes.append(f"depth: median {median:.3g} m with {unit_m:g} m per count (depth_scale).")
    return BopSource(found, indices, notes)


def _require_sizes(scene: BopScene, indices: Sequence[int]) -> None:
    """Raise if the images are not all of the camera's size."""
    require_one_size(
        [image_header(scene.color_files[i]) for i in indices], f"images of {scene.ref.folder}"
    )
    deep = [image_header(scene.depth_files[i]) for i in indices if scene.has_depth(i)]
    if not deep:
        return
    size = require_one_size(deep, f"depth images of {scene.ref.folder}")
    camera = scene.session.intrinsics
    if size != (camera.width, camera.height):
        raise InputError(
            f"{scene.ref.folder}: depth is {size[0]}x{size[1]} px, colour "
            f"{camera.width}x{camera.height} px: depth is not on the colour's pixels. Import the "
            "colour alone with --no-depth."
        )


def _median_depth_m(scene: BopScene, indices: Sequence[int]) -> float | None:
    deep = [i for i in indices if scene.has_depth(i)][:TYPICAL_DEPTHS]
    counts: list[UInt16] = [images.read_counts(scene.depth_path(i)) for i in deep]
    values = [c[c > 0] for c in counts if np.any(c)]
    if not values:
        return None
    return float(np.median(np.concatenate(values))) * scene.session.depth_unit_m
