"""What is known of where an object is, and the region of space that this leaves for it.

A region is a ball that holds the middle of the object's bounding box. It is meant to be too large
rather than too small: the search looks at the whole of it.
"""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from realsim.arrays import Array, Mask
from realsim.errors import InputError
from realsim.geometry import se3
from realsim.geometry.camera import ray_table
from realsim.records import CameraIntrinsics, ObjectModel, SupportPlane
from realsim.registration.evidence import DepthFrame
from realsim.registration.search.records import Region


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Click:
    """A pixel on the object."""

    view: int
    pixel: tuple[float, float]
    """Column and row."""


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Box:
    """A rectangle around what is seen of the object, roughly."""

    view: int
    xywh: tuple[float, float, float, float]
    """Left, top, width, height [px]."""


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Marked:
    """Pixels of the object, roughly: a network's mask."""

    view: int
    inside: Mask
    """(H, W)."""


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class RoughPose:
    """A pose that somebody claims, and how far off it may be."""

    T_world_obj: Array
    """(4, 4)."""
    radius_m: float | None = None
    """How far the object's middle may be from there [m]; None = usual."""
    turn_deg: float | None = None
    """How far it may be turned from there [deg]; None = usual."""


Where = Click | Box | Marked | RoughPose | None


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Hint:
    """One object instance that is wanted, and what is known of where it is."""

    obj_id: int
    instance: int
    """Unique in the scene."""
    where: Where = None
    """None = anywhere."""


START_RADIUS_M = 0.045
"""How far an object may be from a pose given without accuracy [m]: 1.5 times 30 mm."""
START_TURN_DEG = 38.0
"""How far it may be turned from there [deg]: nearly twice 20 deg."""
CLICK_REACH_PX = 2
"""Depth at a click is the median of the valid pixels up to so far from it (5 x 5)."""
SLACK_M = 0.010
"""Regions are larger by this [m]: cameras are off by millimetres, people by a few pixels."""
ABOVE_M = 0.005
"""In boxes and masks points higher over the table than this are the object's [m]."""
LEAST_POINTS = 20
"""With fewer such points all measured ones are taken: flat things do not rise above it."""
LEAST_SLOPE = 0.3
"""Sine of the flattest ray to the table that tells a place; flatter ones miss it by far."""


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class HintScene:
    """What hints are held against."""

    intrinsics: CameraIntrinsics
    frames: Mapping[int, DepthFrame]
    """By the number of the view."""
    plane: SupportPlane | None = None


def region_of(hint: Hint, model: ObjectModel, scene: HintScene) -> Region | None:
    """Return where the middle of the object may be; None = anywhere.

    Raises:
        InputError: the view is unknown, the pixel, box or mask is not of its image, or nothing is
            measured there and there is no table either.
    """
    where = hint.where
    if where is None:
        return None
    if isinstance(where, RoughPose):
        return region_about(where, model)
    name = f"object {hint.obj_id} (instance {hint.instance})"
    if where.view not in scene.frames:
        known = sorted(scene.frames)
        raise InputError(
            f"the hint of {name} names view {where.view}; there are {len(known)} views with depth "
            f"and a camera pose: {_shortened(known)}."
        )
    inside, middle = _pixels(where, scene.intrinsics, name)
    depth = scene.frames[where.view].depth_m
    measured = inside & (depth > 0) & np.isfinite(depth)
    if np.any(measured):
        return _from_depth(where, measured, model, scene)
    if scene.plane is None:
        raise InputError(
            f"the hint of {name} is of no use: no depth is measured there in view {where.view}, "
            "and no table was found to guess it from. Give another view, or a rough pose."
        )
    return _from_table(where.view, middle, model, scene, name)


def region_about(start: RoughPose, model: ObjectModel) -> Region:
    """Return where the middle of an object may be whose pose is known roughly."""
    T = start.T_world_obj
    return Region(
        center_world=T[:3, :3] @ model.mesh.bounds.mean(0) + T[:3, 3],
        radius_m=START_RADIUS_M if start.radius_m is None else start.radius_m,
        R_world_obj=T[:3, :3].copy(),
        turn_deg=START_TURN_DEG if start.turn_deg is None else start.turn_deg,
    )


def _pixels(
    where: Click | Box | Marked, camera: CameraIntrinsics, name: str
) -> tuple[Mask, tuple[float, float]]:
    """Return the pixels (H, W) that a hint speaks of, and their middle (column, row).

    Raises:
        InputError: they are not in the image.
    """
    size = f"view {where.view} has {camera.width}x{camera.height} pixels"
    inside = np.zeros((camera.height, camera.width), dtype=bool)
    if isinstance(where, Marked):
        if where.inside.shape != inside.shape:
            raise InputError(
                f"the mask of {name} has {where.inside.shape[1]}x{where.inside.shape[0]} pixels; "
                f"{size}. Masks must be as large as the image."
            )
        if not where.inside.any():
            raise InputError(f"the mask of {name} in view {where.view} is empty.")
        rows, columns = np.nonzero(where.inside)
        return where.inside.astype(bool), (float(np.median(columns)), float(np.median(rows)))
    if isinstance(where, Click):
        u, v = where.pixel
        if not (-0.5 <= u <= camera.width - 0.5 and -0.5 <= v <= camera.height - 0.5):
            raise InputError(f"the click of {name} is at pixel ({u:g}, {v:g}); {size}.")
        j, i = (int(np.clip(np.rint(x), 0, n - 1)) for x, n in
                ((u, camera.width), (v, camera.height)))  # fmt: skip
        r = CLICK_REACH_PX
        inside[max(0, i - r) : i + r + 1, max(0, j - r) : j + r + 1] = True
        return inside, (u, v)
    x, y, w, h = where.xywh
    if w <= 0 or h <= 0:
        raise InputError(f"the box of {name} is {w:g} by {h:g} pixels; both must be positive.")
    left, top = max(0, int(np.floor(x))), max(0, int(np.floor(y)))
    right, bottom = min(camera.width, int(np.ceil(x + w))), min(camera.height, int(np.ceil(y + h)))
    if right <= left or bottom <= top:
        raise InputError(f"the box of {name} at ({x:g}, {y:g}), {w:g}x{h:g}, is outside; {size}.")
    inside[top:bottom, left:right] = True
    return inside, (0.5 * (left + right - 1), 0.5 * (top + bottom - 1))


def _from_depth(
    where: Click | Box | Marked, measured: Mask, model: ObjectModel, scene: HintScene
) -> Region:
    """Return the region behind the surface that is measured at the pixels.

    From a point on its surface the middle of an object is at most half its diagonal R away, and
    not before it: in a half ball. The ball around the point half the smallest extent h behind the
    surface, of radius sqrt(R^2 + h^2), holds that half ball.
    """
    frame = scene.frames[where.view]
    rows, columns = np.nonzero(measured)
    rays = ray_table(scene.intrinsics)[rows, columns].astype(np.float64)
    z = frame.depth_m[rows, columns].astype(np.float64)
    known = np.isfinite(rays[:, 0])
    p, z = (rays * z[:, None])[known], z[known]
    half, radius = _half_size(model)
    spread = 0.0
    if isinstance(where, Click):
        surface = p[np.argsort(z, kind="stable")[len(p) // 2]]
    else:
        T_cam_table = None
        if scene.plane is not None:
            T_cam_table = se3.invert(frame.T_world_cam) @ scene.plane.T_world_table
        surface, near, far = _middle_of(p, radius, T_cam_table)
        # A box holds what stands before and behind the object as well.
        spread = 0.5 * (far - near) if isinstance(where, Box) else 0.0
    behind = surface / np.linalg.norm(surface)
    center = se3.transform(frame.T_world_cam, surface + half * behind)[0]
    return Region(
        center_world=_raised(center, half, scene.plane),
        radius_m=float(np.hypot(radius, half)) + spread + SLACK_M,
    )


def _middle_of(
    points: Array, radius: float, T_cam_table: Array | None
) -> tuple[Array, float, float]:
    """Return the middle (3,) of those points (N, 3) that may be the object's, and their depths.

    Boxes and rough masks hold table, and other things before and behind: the table is left out,
    and of the rest only what lies within reach of its median counts. The depths are those that a
    tenth of the points is nearer and farther than [m]. All in camera axes.
    """
    if T_cam_table is not None:
        height = se3.transform(se3.invert(T_cam_table), points)[:, 2]
        above = points[height > ABOVE_M]
        points = above if len(above) >= LEAST_POINTS else points
    middle = np.median(points, axis=0)
    near = points[np.linalg.norm(points - middle, axis=1) < 2.0 * radius]
    near = near if len(near) else points
    first, last = np.quantile(near[:, 2], [0.1, 0.9])
    return np.median(near, axis=0), float(first), float(last)


def _from_table(
    view: int, pixel: tuple[float, float], model: ObjectModel, scene: HintScene, name: str
) -> Region:
    """Return the region where a pixel's ray passes over the table, for things without depth.

    The ray meets the object somewhere between the table and its greatest height.

    Raises:
        InputError: the ray does not come down to the table.
    """
    plane = scene.plane
    assert plane is not None
    camera = scene.intrinsics
    i = int(np.clip(np.rint(pixel[1]), 0, camera.height - 1))
    j = int(np.clip(np.rint(pixel[0]), 0, camera.width - 1))
    T = scene.frames[view].T_world_cam
    ray = T[:3, :3] @ ray_table(camera)[i, j].astype(np.float64)
    ray /= np.linalg.norm(ray)
    up = plane.T_world_table[:3, 2]
    slope = float(-ray @ up)
    if not slope > LEAST_SLOPE / 3:
        raise InputError(
            f"the hint of {name} is of no use: no depth is measured there in view {view}, and its "
            "ray does not come down to the table. Give a view from further above."
        )
    half, radius = _half_size(model)
    eye_height = float((T[:3, 3] - plane.T_world_table[:3, 3]) @ up)
    middle = T[:3, 3] + ray * ((eye_height - radius) / slope)
    along = radius / max(slope, LEAST_SLOPE)
    return Region(
        center_world=_raised(middle, half, plane), radius_m=float(np.hypot(along, radius)) + SLACK_M
    )


def _half_size(model: ObjectModel) -> tuple[float, float]:
    """Return half the smallest extent of the object's box, and half its diagonal [m]."""
    extent = model.mesh.extent
    return float(0.5 * np.min(extent)), float(0.5 * np.linalg.norm(extent))


def _raised(point: Array, half: float, plane: SupportPlane | None) -> Array:
    """Return the point, not nearer to the table than half the smallest extent [m]."""
    if plane is None:
        return point
    up = plane.T_world_table[:3, 2]
    height = float((point - plane.T_world_table[:3, 3]) @ up)
    return point + up * max(0.0, half - height)


def _shortened(numbers: list[int]) -> str:
    """Return numbers for a message, the first and the last of many."""
    few = 8
    if len(numbers) <= few:
        return ", ".join(map(str, numbers)) or "none"
    return f"{', '.join(map(str, numbers[: few - 2]))} ... {numbers[-1]}"
