"""What goes wrong on a real table, done on purpose to simulated views.

Each fault is a pure function: it returns spoilt frames and leaves those it was given alone.
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from realsim.arrays import Array32, Int32
from realsim.geometry.camera import ray_table
from realsim.registration.evidence import DepthFrame
from realsim.registration.simulated import TableScene
from realsim.rendering.rays import BACKGROUND, RayScene, rotated
from table_scenes import things_of

MARGIN_PX = 1
"""Pixels around an object whose match also fails: a matching window is wider than one pixel."""


def seen_instances(scene: TableScene, views: Sequence[int]) -> Int32:
    """Return which instance each pixel really shows (V, H, W); -1 = the table or nothing."""
    things = things_of(scene)
    world = RayScene(things)
    # The last entry answers -1, nothing.
    instances = np.array([*(p.instance for p in things), BACKGROUND], np.int32)
    rays = ray_table(scene.intrinsics)
    images: list[Int32] = []
    for k in views:
        T_world_cam = scene.Ts_world_cam[k]
        directions = rotated(rays, T_world_cam[:3, :3]).reshape(-1, 3)
        _, which = world.first_hits(T_world_cam[:3, 3], directions)
        images.append(instances[which].reshape(rays.shape[:2]))
    return np.stack(images)


def without_depth_on(scene: TableScene, instance: int) -> tuple[DepthFrame, ...]:
    """Return the frames as if an object sent back no light: black, its pixels have no depth."""
    import cv2

    assert instance in {p.instance for p in scene.truth}
    kernel = np.ones((2 * MARGIN_PX + 1, 2 * MARGIN_PX + 1), np.uint8)
    frames: list[DepthFrame] = []
    for k, frame in enumerate(scene.frames):
        shown = seen_instances(scene, [k])[0] == instance
        on = np.asarray(cv2.dilate(shown.astype(np.uint8), kernel)) > 0
        frames.append(_with_depth(frame, np.where(on, np.float32(0), frame.depth_m)))
    return tuple(frames)


def without_any_depth(frame: DepthFrame) -> DepthFrame:
    """Return the view with an empty depth image: a covered lens, a lost file."""
    return _with_depth(frame, np.zeros_like(frame.depth_m))


def foreign(frame: DepthFrame, other: DepthFrame) -> DepthFrame:
    """Return the view with the image of a view of another scene: a file of another session."""
    assert frame.depth_m.shape == other.depth_m.shape
    return replace(frame, depth_m=other.depth_m)


def _with_depth(frame: DepthFrame, depth_m: Array32) -> DepthFrame:
    """Return the view with another image, not to be written."""
    image = np.asarray(depth_m, dtype=np.float32)
    image.setflags(write=False)
    return replace(frame, depth_m=image)
