"""What goes wrong on a real table, done on purpose to simulated views.

Each fault is a pure function: it returns spoilt frames and leaves those it was given alone.
"""

from dataclasses import replace
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from realsim.errors import InputError
from realsim.geometry import se3
from realsim.geometry.camera import ray_table
from realsim.registration.evidence import DepthFrame
from realsim.registration.simulated import TableScene, seen_instances
from realsim.rendering.rays import rotated

Surface = Literal["black", "transparent"]
MARGIN_PX = 1
"""Pixels around an object whose match also fails: a matching window is wider than one pixel."""


def without_depth_on(
    scene: TableScene, instance: int, surface: Surface = "black"
) -> tuple[DepthFrame, ...]:
    """Return the frames as if an object sent back no light of its own.

    Args:
        scene: the table.
        instance: the object.
        surface: 'black' = its pixels have no depth; 'transparent' = they have the table's behind
            it, exact, where the table is.

    Raises:
        InputError: the scene has no such instance.
    """
    import cv2

    scene.true_pose(instance)
    kernel = np.ones((2 * MARGIN_PX + 1, 2 * MARGIN_PX + 1), np.uint8)
    rays = ray_table(scene.intrinsics)
    frames: list[DepthFrame] = []
    for k, frame in enumerate(scene.frames):
        shown = seen_instances(scene, [k])[0] == instance
        on = np.asarray(cv2.dilate(shown.astype(np.uint8), kernel)) > 0
        behind = np.zeros(frame.depth_m.shape, np.float32)
        if surface == "transparent":
            T = scene.Ts_world_cam[k]
            down = rotated(rays, T[:3, :3])[..., 2]
            # The ray o + z d meets the plane z = 0 at the depth -o_z / d_z.
            behind = np.where(down < 0, -T[2, 3] / np.where(down < 0, down, -1), 0)
            in_range = behind <= scene.sensor.max_z_m
            behind = np.where(in_range, behind, 0).astype(np.float32)
        frames.append(_with_depth(frame, np.where(on, behind, frame.depth_m)))
    return tuple(frames)


def without_any_depth(frame: DepthFrame) -> DepthFrame:
    """Return the view with an empty depth image: a covered lens, a lost file."""
    return _with_depth(frame, np.zeros_like(frame.depth_m))


def shifted_view(frame: DepthFrame, xi: ArrayLike) -> DepthFrame:
    """Return the view with its claimed camera moved by exp(xi), xi (6,) [rad, m]: a slipped mount.

    The image is unchanged: it is what is said of the camera that is wrong.
    """
    return replace(frame, T_world_cam=frame.T_world_cam @ se3.exp(np.asarray(xi, np.float64)))


def foreign(frame: DepthFrame, other: DepthFrame) -> DepthFrame:
    """Return the view with the image of a view of another scene: a file of another session.

    Raises:
        InputError: the images have different sizes.
    """
    if frame.depth_m.shape != other.depth_m.shape:
        raise InputError(
            f"the foreign image is {other.depth_m.shape}, this view's {frame.depth_m.shape}; "
            "simulate both with the same lab."
        )
    return replace(frame, depth_m=other.depth_m)


def _with_depth(frame: DepthFrame, depth_m: NDArray[np.float32]) -> DepthFrame:
    """Return the view with another image, not to be written."""
    image = np.asarray(depth_m, dtype=np.float32)
    image.setflags(write=False)
    return replace(frame, depth_m=image)
