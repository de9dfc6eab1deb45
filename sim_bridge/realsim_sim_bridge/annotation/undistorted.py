"""A labelled scene as an ideal pinhole camera would have seen it, for formats without distortion.

The new camera has the same K and image size. Colour is interpolated; depth, which must not be mixed
over edges, is taken from the nearest pixel. Pixels that the lens did not see are 0. Masks and their
counts are not resampled: they are cast from the poses, as the annotation casts them. Where the
source's visible mask lacks what the scene's bodies leave visible (a hand, a cable that nobody
modelled), the cast mask lacks it, too.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np

from realsim import images
from realsim.arrays import Array, Array32, Mask, UInt16, evenly
from realsim.formats.graspnet.write_plan import greatest_displacement_px
from realsim.formats.grasps.scene_grasps import SceneGrasps
from realsim.formats.labelled_scene import LabelledFrame, LabelledScene
from realsim.geometry.metrics import mask_iou
from realsim.records import CameraIntrinsics, ObjectModel
from realsim.rendering.labels import LabelRenderer, Labels
from realsim.rendering.rays import BACKGROUND, PlacedMesh
from realsim_sim_bridge.annotation.config import AnnotationConfig
from realsim_sim_bridge.annotation.frame_labels import object_info
from realsim_sim_bridge.annotation.inputs import table_slab
from realsim_sim_bridge.annotation.unmodelled import object_masks

STANDS_STILL = 1e-9
"""Poses in world [m, rotation entries] that differ by less are one scene to cast."""
COMPARED_FRAMES = 8
"""Number of frames, evenly spread, from which the cost of a lens is measured."""
GOOD_IOU = 0.99
THIN_PX = 3
"""What is hidden in a strip thinner than this is the rim of another program's rasteriser [px]."""


@dataclass(frozen=True, eq=False, slots=True)
class _Cast:
    """The labels of one frame by the ideal camera."""

    index: int
    labels: Labels
    visible: Sequence[Mask]
    """(H, W) of each of the frame's objects."""


class UndistortedScene:
    """A `LabelledScene` made of another one; its images lie in a folder for the time being."""

    def __init__(self, scene: LabelledScene, folder: Path, *, counted: bool = False) -> None:
        """Take a scene.

        Args:
            scene: with any lens.
            folder: for images while they are written elsewhere; one of each kind at a time.
            counted: whether frames bring the counts and boxes of their masks (`gt_info`), which
                takes a cast a frame.
        """
        self._scene, self._folder, self._counted = scene, folder, counted
        self.name, self.number, self.split = scene.name, scene.number, scene.split
        self.camera, self.indices = scene.camera, scene.indices
        self._standing: tuple[list[int], Array, LabelRenderer] | None = None
        self._last: _Cast | None = None

    @property
    def T_world_table(self) -> Array | None:
        """(4, 4) supporting plane in world [m]; None = not known."""
        return self._scene.T_world_table

    @property
    def notes(self) -> tuple[str, ...]:
        """The scene's, and that it was undistorted."""
        frames = [self._scene.frame(i) for i in self.indices]
        bent = [f for f in frames if f.intrinsics.is_distorted]
        if not bent:
            return self._scene.notes
        told = (
            "images were undistorted: colour interpolated, depth from the nearest pixel, masks "
            "cast from the poses."
        )
        lacking = sorted({o.obj_id for f in bent for o in f.objects} - set(self._scene.models()))
        resampled = (
            f"frames with the object(s) {lacking} have resampled masks, from the nearest pixel: "
            "without a mesh nothing can be cast.",
        )
        return (*self._scene.notes, told, *(resampled if lacking else ()))

    def frame(self, index: int) -> LabelledFrame:
        """Return one frame, its pixels counted anew where masks can be cast."""
        frame = self._scene.frame(index)
        if not frame.intrinsics.is_distorted:
            return frame
        infos = self._infos(index) if self._counted else None
        objects = tuple(
            replace(
                o,
                gt_info=None if infos is None else infos[k],
                visible_fraction=None if infos is None else infos[k]["visib_fract"],
            )
            for k, o in enumerate(frame.objects)
        )
        return replace(frame, intrinsics=pinhole(frame.intrinsics), objects=objects, entry=None)

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
        return self._kept("depth.png", images.png_bytes(nearest(images.read_counts(path), camera)))

    def mask(self, index: int, k: int, *, visible: bool) -> Mask | None:
        """Return a mask (H, W) as the ideal camera sees it; None = the source has none."""
        mask = self._scene.mask(index, k, visible=visible)
        camera = self._scene.frame(index).intrinsics
        if mask is None or not camera.is_distorted:
            return mask
        cast = self._cast(index)
        if cast is None:
            return nearest(mask.astype(np.uint16), camera) > 0
        return cast.visible[k] if visible else cast.labels.amodal[k]

    def _cast(self, index: int) -> _Cast | None:
        """Return what the ideal camera sees of a frame; None = an object has no mesh to cast."""
        if self._last is not None and self._last.index == index:
            return self._last
        frame = self._scene.frame(index)
        renderer, T_world_cam = self.renderer(frame)
        if renderer is None:
            return None
        camera = frame.intrinsics
        labels = renderer.render(pinhole(camera), T_world_cam)
        masks = [self._scene.mask(index, k, visible=True) for k in range(len(frame.objects))]
        visible = [labels.visible(k) for k in range(len(masks))]
        if any(m is not None for m in masks):
            raw = renderer.render(camera, T_world_cam)
            for k, mask in enumerate(masks):
                if mask is not None:
                    hidden = _thick(raw.visible(k) & ~mask)
                    visible[k] &= nearest(hidden.astype(np.uint16), camera) == 0
        self._last = _Cast(index, labels, visible)
        return self._last

    def renderer(self, frame: LabelledFrame) -> tuple[LabelRenderer | None, Array]:
        """Return the renderer of a frame's objects and the table, and the camera (4, 4) in it.

        Where nothing has moved it is the last one; None = an object has no mesh.
        """
        models = self._scene.models()
        ids = [o.obj_id for o in frame.objects]
        T_world_cam = np.eye(4) if frame.T_world_cam is None else frame.T_world_cam
        if any(i not in models for i in ids):
            return None, T_world_cam
        Ts = np.array([T_world_cam @ o.T_cam_obj for o in frame.objects]).reshape(-1, 4, 4)
        last = self._standing
        if last is not None and last[0] == ids and np.allclose(last[1], Ts, 0, STANDS_STILL):
            return last[2], T_world_cam
        placed = [PlacedMesh(k, models[i].mesh, Ts[k]) for k, i in enumerate(ids)]
        if self.T_world_table is not None and frame.T_world_cam is not None:
            slab = table_slab(AnnotationConfig())
            placed.append(PlacedMesh(BACKGROUND, slab, self.T_world_table))
        self._standing = (ids, Ts, LabelRenderer(placed))
        return self._standing[2], T_world_cam

    def _infos(self, index: int) -> list[dict[str, Any]] | None:
        """Return BOP's scene_gt_info row of each object of a frame; None = nothing can be cast."""
        cast = self._cast(index)
        if cast is None:
            return None
        frame, depth_file = self._scene.frame(index), self._scene.depth_file(index)
        camera, models = frame.intrinsics, self._scene.models()
        shape = cast.labels.ids.shape
        depth = (
            np.zeros(shape)
            if depth_file is None
            else nearest(images.read_counts(depth_file), camera)
        )
        infos: list[dict[str, Any]] = []
        for k, o in enumerate(frame.objects):
            masks = object_masks(cast.labels, k)
            masks = replace(masks, visible=cast.visible[k][masks.window])
            pose = (pinhole(camera), models[o.obj_id].mesh, o.T_cam_obj)
            infos.append(object_info(masks, cast.labels.px_count_all[k], depth, pose))
        return infos

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


def cost_of_the_lens(scene: LabelledScene) -> str:
    """Return what a reader that knows no lens gets wrong in a scene's raw images; '' = nothing.

    The masks of some frames, cast through the lens, are compared with those that such a reader
    renders from the same poses.
    """
    chosen = [scene.frame(k) for k in evenly(scene.indices, COMPARED_FRAMES)]
    bent = [f for f in chosen if f.intrinsics.is_distorted]
    if not bent:
        return ""
    off_px = max(greatest_displacement_px(f.intrinsics) for f in bent)
    text = f"the lens is kept: for a reader that knows none, pixels are up to {off_px:.1f} px off"
    ideal = UndistortedScene(scene, scene.colour_file(bent[0].index).parent)
    ious: list[float] = []
    for frame in bent:
        renderer, T = ideal.renderer(frame)
        if renderer is None:
            continue
        raw, plain = (renderer.render(c, T) for c in (frame.intrinsics, pinhole(frame.intrinsics)))
        pairs = [(raw.visible(k), plain.visible(k)) for k in range(len(frame.objects))]
        ious += [mask_iou(a, b) for a, b in pairs if a.any() or b.any()]
    if not ious:
        return f"{text}."
    below = np.mean(np.array(ious) < GOOD_IOU)
    return (
        f"{text}, and {100 * below:.0f} % of the {len(ious)} visible masks compared have an IoU "
        f"below {GOOD_IOU:g} with what it renders (median {np.median(ious):.4f})."
    )


def pinhole(camera: CameraIntrinsics) -> CameraIntrinsics:
    """Return the camera of the same K and size without distortion."""
    return replace(camera, distortion=np.zeros(8))


def _thick(mask: Mask) -> Mask:
    """Return what is left of a mask (H, W) without its thin strips."""
    import cv2

    square = np.ones((THIN_PX, THIN_PX), np.uint8)
    return np.asarray(cv2.morphologyEx(mask.astype(np.uint8), cv2.MORPH_OPEN, square)) > 0


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
