"""Standing in a camera: its photograph with the models' outlines, as a browser's camera sees it.

A browser's camera is a pinhole with its axis in the middle of the canvas. So the photograph is bent
straight (undistorted) onto such a camera, as large as it takes to show all of it, and padded to the
canvas. Every model is cast by itself and kept, so that of a dragged object only it is cast again.
"""

import threading
from collections import OrderedDict
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, TypeVar

import numpy as np
from numpy.typing import ArrayLike

from realsim.arrays import Array, Array32, Int32, Mask, Rgb
from realsim.errors import InputError
from realsim.geometry import camera, se3
from realsim.records import CameraIntrinsics, ObjectModel, ObjectPose
from realsim.rendering.casting.pixel_caster import PixelCaster, empty_buffers, enter
from realsim.rendering.overlay import INK, VERDICT_RGB
from realsim.rendering.rays import PlacedMesh
from realsim.store import SessionStore

WIDEST_TAN = 3.0
"""Tangent of the widest half angle that is shown: a pinhole cannot show 90 degrees."""
BORDER_SAMPLES = 33
"""Pixels per side of the photograph by which its straightened outline is found."""
PAD_RGB = (38, 40, 46)
"""Around the photograph."""
KEPT_PHOTOS = 6
"""Straightened photographs that are kept; 1.6 MB each at 960 px."""
KEPT_CASTS = 128
"""Outlines that are kept: of 15 objects in 8 views."""
THIN_PX, BOLD_PX = 2, 3
"""Width of an outline and of the highlighted one [px]."""
DASH_PX, GAP_PX = 6, 6
"""Dash and gap of the hidden part of an outline [px]."""
DIM = 0.85
"""By so much the hidden part is darker."""
SEEN_M = 1e-4
"""A surface this much behind the nearest one is seen [m]: rounding of single precision."""
K = TypeVar("K")
V = TypeVar("V")
LEAST_PX, MOST_PX = 16, 4096
"""Width of a picture [px]."""


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class CameraPicture:
    """A photograph as a pinhole camera's, with outlines."""

    rgb: Rgb
    """(H, W, 3)."""
    T_world_cam: Array
    """(4, 4) where the camera stands, OpenCV axes [m]."""
    fov_rad: float
    """Vertical field of view [rad]."""
    aspect: float
    """Width over height."""


@dataclass(frozen=True, eq=False, slots=True)
class _Cast:
    """One object alone in one view."""

    window: tuple[slice, slice]
    depth_m: Array32
    """(h, w) within the window; inf = not there."""
    contours: tuple[Int32, ...]
    """(N, 2) column and row of each contour's pixels, in the picture, closed."""


class CameraViews:
    """Pictures of the cameras of one session; photographs and outlines are kept."""

    def __init__(self, store: SessionStore, models: Mapping[int, ObjectModel]) -> None:
        """Take a session; nothing is read.

        Args:
            store: the session.
            models: by obj_id; objects without one are not drawn.
        """
        self._store, self._models = store, dict(models)
        self._casters: dict[int, PixelCaster] = {}
        self._photos: OrderedDict[tuple[float, ...], Rgb] = OrderedDict()
        self._casts: OrderedDict[tuple[Any, ...], _Cast] = OrderedDict()
        self._lock = threading.Lock()

    def picture(
        self,
        view_index: int,
        placed: Sequence[ObjectPose],
        *,
        aspect: float,
        width_px: int = 960,
        T_world_cam: ArrayLike | None = None,
        highlight: int | None = None,
    ) -> CameraPicture:
        """Return what a view's camera saw, with the outlines of the objects where they stand.

        Outlines are in the colour of the verdict; the highlighted one is bold, and what other
        objects hide is dashed.

        Args:
            view_index: number of the view.
            placed: the objects.
            aspect: width over height of the browser's canvas.
            width_px: of the picture.
            T_world_cam: (4, 4) where the camera stands; None = as the session says.
            highlight: instance that is drawn bold.

        Raises:
            InputError: there is no such view, its camera is not known, or the size is none.
        """
        T = self._camera_of(view_index, T_world_cam)
        pinhole = pinhole_of(self._store.session.intrinsics, aspect, width_px)
        with self._lock:
            rgb = self._photo(view_index, pinhole).copy()
            casts = [
                (o, self._cast(o, pinhole, T)) for o in placed if o.obj_id in self._models
            ]  # fmt: skip
        nearest = np.full(rgb.shape[:2], np.inf, np.float32)
        for _, cast in casts:
            part = nearest[cast.window]
            np.minimum(part, cast.depth_m, out=part)
        # The highlighted one last, over all others.
        for o, cast in sorted(casts, key=lambda pair: pair[0].instance == highlight):
            bold = o.instance == highlight
            seen = _seen(cast, nearest)
            _draw(rgb, cast.contours, seen, VERDICT_RGB[o.verdict], BOLD_PX if bold else THIN_PX)
        return CameraPicture(
            rgb=rgb, T_world_cam=T, fov_rad=2 * float(np.arctan(0.5 * pinhole.height / pinhole.fy)),
            aspect=pinhole.width / pinhole.height,
        )  # fmt: skip

    def _camera_of(self, view_index: int, T_world_cam: ArrayLike | None) -> Array:
        """Return where the camera of a view stands (4, 4)."""
        if T_world_cam is not None:
            return se3.check_rigid(T_world_cam, f"the camera of view {view_index}")
        T = self._store.session.view(view_index).T_world_cam
        if T is None:
            raise InputError(
                f"the camera of view {view_index} is not known; calibrate first, or choose a view "
                "that has a frustum."
            )
        return T

    def _photo(self, view_index: int, pinhole: CameraIntrinsics) -> Rgb:
        """Return the straightened photograph, from memory if it was there before."""
        key = (view_index, *_key(pinhole))
        if key not in self._photos:
            rgb = self._store.rgb(view_index)
            self._photos[key] = straightened(rgb, self._store.session.intrinsics, pinhole)
        return _remembered(self._photos, key, KEPT_PHOTOS)

    def _cast(self, placed: ObjectPose, pinhole: CameraIntrinsics, T_world_cam: Array) -> _Cast:
        """Return one object alone in a view, from memory if it did not move."""
        T_obj_cam = se3.invert(placed.T_world_obj) @ T_world_cam
        key = (placed.obj_id, *_key(pinhole), T_obj_cam.tobytes())
        if key not in self._casts:
            self._casts[key] = _cast_alone(self._caster(placed.obj_id), pinhole, T_obj_cam)
        return _remembered(self._casts, key, KEPT_CASTS)

    def _caster(self, obj_id: int) -> PixelCaster:
        """Return what casts a model in its own frame; made once."""
        if obj_id not in self._casters:
            alone = PlacedMesh(0, self._models[obj_id].mesh, np.eye(4))
            self._casters[obj_id] = PixelCaster([alone])
        return self._casters[obj_id]


def pinhole_of(intrinsics: CameraIntrinsics, aspect: float, width_px: int) -> CameraIntrinsics:
    """Return the browser's camera that shows all of a photograph on a canvas.

    Its pixels are square, its axis is the middle of the canvas (pixel centres are integers, so the
    principal point is at (W - 1) / 2), and its focal length is the greatest for which the
    straightened border of the photograph lies on the canvas.

    Args:
        intrinsics: the camera, with its lens.
        aspect: width over height of the canvas.
        width_px: of the picture.

    Raises:
        InputError: the aspect or the width is out of range.
    """
    if not 0.1 <= aspect <= 10:
        raise InputError(f"a canvas {aspect} times as wide as high; 0.1 to 10 is accepted.")
    if not LEAST_PX <= width_px <= MOST_PX:
        raise InputError(
            f"a picture {width_px} px wide; {LEAST_PX} to {MOST_PX} px are accepted."
        )  # fmt: skip
    height = max(1, round(width_px / aspect))
    w, h = intrinsics.width - 0.5, intrinsics.height - 0.5
    u, v = np.linspace(-0.5, w, BORDER_SAMPLES), np.linspace(-0.5, h, BORDER_SAMPLES)
    sides = [(u, -0.5), (u, h), (-0.5, v), (w, v)]
    border = np.concatenate([np.stack(np.broadcast_arrays(a, b), -1) for a, b in sides])
    xy, known = camera.undistort(intrinsics, border)
    if known.any():
        half_x, half_y = np.minimum(np.abs(xy[known]).max(0), WIDEST_TAN)
    else:
        half_x = half_y = WIDEST_TAN
    f = min(0.5 * width_px / half_x, 0.5 * height / half_y)
    return CameraIntrinsics(
        width=width_px, height=height, fx=f, fy=f, cx=0.5 * (width_px - 1), cy=0.5 * (height - 1)
    )


def straightened(rgb: Rgb, intrinsics: CameraIntrinsics, pinhole: CameraIntrinsics) -> Rgb:
    """Return a photograph (H, W, 3) as a pinhole camera at the same place would have seen it.

    Args:
        rgb: of the camera with its lens.
        intrinsics: this camera.
        pinhole: the other; what it sees beyond the photograph is padded.
    """
    import cv2

    u, v = _lookup(intrinsics, pinhole)
    scale = intrinsics.fx / pinhole.fx
    if scale > 1.5:  # else fine texture would flicker
        rgb = np.asarray(cv2.GaussianBlur(rgb, (0, 0), 0.35 * scale), dtype=np.uint8)
    out = cv2.remap(
        rgb, u, v, cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT, borderValue=PAD_RGB
    )
    return np.asarray(out, dtype=np.uint8)


def _lookup(intrinsics: CameraIntrinsics, pinhole: CameraIntrinsics) -> tuple[Array32, Array32]:
    """Return where each pinhole pixel lies in the photograph, x and y (H, W) [px]."""
    xy = (camera.pixel_grid(pinhole.width, pinhole.height) - [pinhole.cx, pinhole.cy]) / pinhole.fx
    uv = xy if not intrinsics.is_distorted else camera.distort(intrinsics.distortion, xy)
    uv = uv * [intrinsics.fx, intrinsics.fy] + [intrinsics.cx, intrinsics.cy]
    # Beyond the turning radius the lens model folds the picture back.
    radius = camera.turning_radius(intrinsics)
    if np.isfinite(radius):
        uv[np.sum(np.square(xy), axis=-1) >= radius**2] = -1e4
    uv = np.clip(uv, -1e4, 1e4).astype(np.float32)
    return np.ascontiguousarray(uv[..., 0]), np.ascontiguousarray(uv[..., 1])


def _cast_alone(caster: PixelCaster, pinhole: CameraIntrinsics, T_obj_cam: Array) -> _Cast:
    """Return what a camera sees of one object."""
    import cv2

    rays = camera.ray_table(pinhole)
    buffers = empty_buffers(rays)
    covered = np.zeros(rays.shape[:2], np.bool_)
    window = enter(caster.project(0, pinhole, T_obj_cam), 0, rays, buffers, covered).window
    mask = covered[window]
    if mask.size == 0:
        return _Cast(window, np.zeros(mask.shape, np.float32), ())
    found: Any = cv2.findContours(
        np.ascontiguousarray(mask, dtype=np.uint8), cv2.RETR_CCOMP, cv2.CHAIN_APPROX_NONE
    )
    corner = np.array([window[1].start, window[0].start], dtype=np.int32)
    contours = tuple(np.asarray(c, dtype=np.int32).reshape(-1, 2) + corner for c in found[0])
    return _Cast(window, buffers[0][window].copy(), contours)


def _seen(cast: _Cast, nearest: Array32) -> list[Mask]:
    """Return per contour which of its pixels (N,) no other object hides."""
    if not cast.contours:
        return []
    front = cast.depth_m <= nearest[cast.window] + SEEN_M
    top, left = cast.window[0].start, cast.window[1].start
    # An inner contour runs on pixels around the hole, which are the object's, too.
    return [front[c[:, 1] - top, c[:, 0] - left] for c in cast.contours]


def _draw(
    rgb: Rgb,
    contours: Sequence[Int32],
    seen: Sequence[Mask],
    color: tuple[int, int, int],
    width_px: int,
) -> None:
    """Draw outlines on a picture: seen parts whole, hidden ones dashed, all on a dark rim."""
    import cv2

    dim = (round(DIM * color[0]), round(DIM * color[1]), round(DIM * color[2]))
    height, width = rgb.shape[:2]
    solid: list[Int32] = []
    dashes: list[Int32] = []
    for contour, visible in zip(contours, seen, strict=True):
        # Where the object is cut by the border there is no outline.
        x, y = contour[:, 0], contour[:, 1]
        inside = (x > 0) & (y > 0) & (x < width - 1) & (y < height - 1)
        dash = np.arange(len(contour)) % (DASH_PX + GAP_PX) < DASH_PX
        solid += _runs(contour, visible & inside)
        dashes += _runs(contour, ~visible & inside & dash)
    canvas: Any = rgb
    for lines, ink, thick in (
        (dashes, INK, width_px + 1), (dashes, dim, width_px),
        (solid, INK, width_px + 1), (solid, color, width_px),
    ):  # fmt: skip
        cv2.polylines(canvas, lines, False, ink, thick, cv2.LINE_AA)


def _runs(contour: Int32, on: Mask) -> list[Int32]:
    """Return the unbroken runs of a closed contour's pixels (N, 2) that are `on`."""
    if on.all():
        return [np.concatenate([contour, contour[:1]])]
    if not on.any():
        return []
    # Begun where it is broken, no run goes over the end.
    first = int(np.argmin(on))
    contour, on = np.roll(contour, -first, axis=0), np.roll(on, -first)
    steps = np.flatnonzero(np.diff(on)) + 1
    parts: Iterator[tuple[Int32, Mask]] = zip(
        np.split(contour, steps), np.split(on, steps), strict=True
    )
    return [np.ascontiguousarray(p) for p, o in parts if o[0]]


def _key(pinhole: CameraIntrinsics) -> tuple[float, ...]:
    """Return the numbers that tell one pinhole from another."""
    return (pinhole.width, pinhole.height, pinhole.fx)


def _remembered(kept: "OrderedDict[K, V]", key: K, most: int) -> V:
    """Return a kept value, the last used; those not used for longest are dropped."""
    kept.move_to_end(key)
    while len(kept) > most:
        kept.popitem(last=False)
    return kept[key]
