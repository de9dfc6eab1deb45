"""Pictures of a scene whose bodies move, in the soft even room of `photo.Lighting`.

Everything that does not change is prepared once: meshes, textures and, for a camera that stands
still, the picture of what stands still. Of such a camera only the pixels are rendered again in
which moving bodies or their shadows are. What pixels see comes from the labels' rasteriser, also
between their centres: the parts of a pixel are the pixels of a finer camera.

Beside `photo.PhotoRenderer`, which casts rays, the pictures are the same but for rounding.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike

from realsim.arrays import Array, Array32, Int64, Mask, UInt8
from realsim.geometry import camera, se3
from realsim.records import CameraIntrinsics
from realsim.rendering.casting.pixel_caster import (
    NOT_WANTED,
    Buffers,
    PixelCaster,
    empty_buffers,
    enter,
)
from realsim.rendering.embedded.room_light import (
    RoomSamples,
    RoomView,
    busy_among,
    empty_samples,
    encoded,
    lit_colors,
    room_surfaces,
    room_view,
    sample_room,
    tones,
)
from realsim.rendering.embedded.sun_shadows import SortedPoints, cast_shadows, sort_points
from realsim.rendering.photo import Lighting
from realsim.rendering.rays import PlacedMesh


@dataclass(frozen=True, eq=False, slots=True)
class MovingPicture:
    """What a camera sees at one moment."""

    rgb: UInt8
    """(H, W, 3) encoded colours."""
    depth_m: Array32
    """(H, W) exact depth along z at the pixel centres [m]; 0 = nothing."""


@dataclass(frozen=True, eq=False, slots=True)
class Moment:
    """Where everything is at one time, and how the sun sees it; shared by all cameras."""

    Ts_world_obj: Array
    """(G, 4, 4) [m]."""
    in_the_sun: tuple[Array, ...]
    """Vertices (V, 3) of each mesh in the sun's frame [m]."""


@dataclass(frozen=True, eq=False, slots=True)
class Seen:
    """What a camera sees of some of the meshes at one moment, and how that came about."""

    camera: tuple[CameraIntrinsics, CameraIntrinsics, Array]
    """The camera, the one whose pixels are the parts of its pixels, T_world_cam (4, 4) [m]."""
    numbers: tuple[int, ...]
    """The meshes."""
    hits: tuple[Buffers, Buffers]
    """What the centres of the pixels see, and what their parts see."""
    points: SortedPoints
    """Where the sun could shine on what the centres see."""
    lit: Mask
    """(P,) where it does."""
    color: Array32
    """(P, 3) light of the centres."""
    tone: Array32
    """(P,) their encoded brightness."""
    whole: Array32
    """(P, 3) light of the pixels, before the lens."""


class MovingScene:
    """Renders pictures of placed meshes that may move."""

    def __init__(self, placed: Sequence[PlacedMesh], lighting: Lighting | None = None) -> None:
        """Prepare everything that does not depend on where things are.

        Args:
            placed: the meshes, where they stand at first.
            lighting: light, lens and sensor; no noise is added.
        """
        self.lighting = light = lighting or Lighting()
        self._every = tuple(range(len(placed)))
        self._caster = PixelCaster(placed)
        self._surfaces = room_surfaces(placed, light.gamma)
        self._R_sun_world = light.R_sun_world()
        self._light = light.rows()
        poses = [p.T_world_obj for p in placed]
        self._first = Moment(np.array(poses), tuple(map(self._in_the_sun, self._every, poses)))

    def moment(self, Ts_world_obj: Mapping[int, Array]) -> Moment:
        """Return a time at which some meshes, by number, are at poses (4, 4) [m].

        The others are where they were at first.
        """
        Ts, seen = self._first.Ts_world_obj.copy(), list(self._first.in_the_sun)
        for k, T in Ts_world_obj.items():
            Ts[k], seen[k] = T, self._in_the_sun(k, T)
        return Moment(Ts, tuple(seen))

    def still(
        self, intrinsics: CameraIntrinsics, T_world_cam: ArrayLike, numbers: Sequence[int]
    ) -> Seen:
        """Return what a camera that stands still sees of meshes that do, for `renewed`.

        Args:
            intrinsics: the raw (distorted) camera.
            T_world_cam: (4, 4) camera in world [m].
            numbers: of the meshes that stay where they were at first.
        """
        return self._seen(self._first, intrinsics, T_world_cam, tuple(numbers))

    def picture(
        self, moment: Moment, intrinsics: CameraIntrinsics, T_world_cam: ArrayLike
    ) -> MovingPicture:
        """Return what a camera sees, all of it rendered; arguments as of `still`."""
        return self._finished(self._seen(moment, intrinsics, T_world_cam, self._every))

    def renewed(self, moment: Moment, still: Seen) -> MovingPicture:
        """Return what `picture` does for a camera that stands still.

        Only the pixels in which moving bodies or their shadows are, and those beside them, are
        rendered.
        """
        import cv2

        intrinsics, finer, T = still.camera
        centres, parts = (
            (depth.copy(), geometry.copy(), face.copy()) for depth, geometry, face in still.hits
        )
        moving = [k for k in self._every if k not in still.numbers]
        self._enter(moving, moment, (intrinsics, T), centres)
        self._enter(moving, moment, (finer, T), parts)
        lit = still.lit.copy()
        self._cast_shadows(moving, moment, still.points, lit)
        changed = (centres[1] != still.hits[0][1]).ravel() | (lit != still.lit)
        rows = np.flatnonzero(changed)
        color, tone, whole = still.color.copy(), still.tone.copy(), still.whole.copy()
        view = self._view(moment, T)
        color[rows] = self._lit_colors(moment, view, intrinsics, centres, rows, self._every)[2]
        tones(color, self.lighting.gamma, rows, tone)
        near = changed.reshape(centres[1].shape).astype(np.uint8)
        rows = np.flatnonzero(cv2.dilate(near, np.ones((3, 3), np.uint8)))
        whole[rows] = color[rows]
        seen = Seen(
            still.camera, self._every, (centres, parts), still.points, lit, color, tone, whole
        )
        self._refine(moment, view, seen, rows)
        return self._finished(seen)

    # --- how ----------------------------------------------------------------------------------

    def _in_the_sun(self, number: int, T_world_obj: Array) -> Array:
        """Return the vertices (V, 3) of a mesh in the sun's frame [m]."""
        T = se3.from_rt(self._R_sun_world, np.zeros(3)) @ T_world_obj
        return se3.transform(T, self._caster.bodies[number].vertices)

    def _seen(
        self, moment: Moment, intrinsics: CameraIntrinsics, T_world_cam: ArrayLike,
        numbers: tuple[int, ...],
    ) -> Seen:  # fmt: skip
        """Return what a camera sees of the meshes `numbers`."""
        T, n, i = se3.check_rigid(T_world_cam, "T_world_cam"), self.lighting.samples, intrinsics
        finer = replace(
            i, width=n * i.width, height=n * i.height, fx=n * i.fx, fy=n * i.fy,
            cx=n * i.cx + (n - 1) / 2.0, cy=n * i.cy + (n - 1) / 2.0,
        )  # fmt: skip
        centres, parts = (empty_buffers(camera.ray_table(c)) for c in (i, finer))
        self._enter(numbers, moment, (i, T), centres)
        self._enter(numbers, moment, (finer, T), parts)
        view, rows = self._view(moment, T), np.arange(i.height * i.width)
        points, lit, color = self._lit_colors(moment, view, i, centres, rows, numbers)
        tone = np.empty(len(rows), np.float32)
        tones(color, self.lighting.gamma, rows, tone)
        seen = Seen(
            (i, finer, T), numbers, (centres, parts), points, lit, color, tone, color.copy()
        )
        self._refine(moment, view, seen, rows)
        return seen

    def _view(self, moment: Moment, T_world_cam: Array) -> RoomView:
        """Return a camera as the kernels take it."""
        return room_view(self._light, self._R_sun_world, moment.Ts_world_obj, T_world_cam)

    def _enter(
        self, numbers: Sequence[int], moment: Moment, seen_by: tuple[CameraIntrinsics, Array],
        buffers: Buffers,
    ) -> None:  # fmt: skip
        """Enter meshes into what a camera sees."""
        intrinsics, T_world_cam = seen_by
        rays = camera.ray_table(intrinsics)
        for k in numbers:
            mesh = self._caster.project(k, intrinsics, T_world_cam, moment.Ts_world_obj[k])
            enter(mesh, k, rays, buffers, NOT_WANTED)

    def _cast_shadows(
        self, numbers: Sequence[int], moment: Moment, points: SortedPoints, lit: Mask
    ) -> None:
        """Clear `lit` where one of these meshes keeps the sun off."""
        for k in numbers:
            body = self._caster.bodies[k]
            cast_shadows(points, (moment.in_the_sun[k], body.faces), body.is_solid, lit)

    def _lit_colors(
        self, moment: Moment, view: RoomView, intrinsics: CameraIntrinsics, hits: Buffers,
        rows: Int64, numbers: Sequence[int],
    ) -> tuple[SortedPoints, Mask, Array32]:  # fmt: skip
        """Return for rays of a camera where the sun could shine, where it does, and the light."""
        out: RoomSamples = empty_samples(len(rows))
        rays = camera.ray_table(intrinsics).reshape(-1, 3)
        pixel_rad = 1.0 / float(np.sqrt(intrinsics.fx * intrinsics.fy))
        seen = hits[1].reshape(-1), hits[2].reshape(-1)
        sample_room(self._surfaces, view, rays, seen, rows, pixel_rad, out)
        points, lit = sort_points(out.toward_sun), np.ones(len(rows), np.bool_)
        self._cast_shadows(numbers, moment, points, lit)
        return points, lit, lit_colors(out, lit)

    def _refine(self, moment: Moment, view: RoomView, seen: Seen, rows: Int64) -> None:
        """Put the means over their parts into those of the pixels `rows` that have contrast."""
        n, (intrinsics, finer, _), geometry = self.lighting.samples, seen.camera, seen.hits[0][1]
        if n == 1:
            return
        busy = busy_among(seen.tone, geometry.ravel(), rows, geometry.shape, self.lighting.contrast)
        rows = rows[busy]
        first = (rows // intrinsics.width) * n * finer.width + (rows % intrinsics.width) * n
        of_pixel = (np.arange(n)[:, None] * finer.width + np.arange(n)).ravel()
        parts = (first[:, None] + of_pixel).ravel()
        color = self._lit_colors(moment, view, finer, seen.hits[1], parts, seen.numbers)[2]
        seen.whole[rows] = color.reshape(len(rows), n * n, 3).mean(1)

    def _finished(self, seen: Seen) -> MovingPicture:
        """Return the picture behind the lens, and its depth."""
        import cv2

        depth, geometry, _ = seen.hits[0]
        color = seen.whole.reshape(*depth.shape, 3)
        if self.lighting.psf_px > 0:
            color = np.asarray(cv2.GaussianBlur(color, (0, 0), self.lighting.psf_px), np.float32)
        rgb = encoded(color.reshape(-1, 3), self.lighting.gamma).reshape(color.shape)
        return MovingPicture(rgb, np.where(geometry < 0, np.float32(0.0), depth))
