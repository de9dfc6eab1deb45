"""Pictures of a scene whose bodies move, in the soft even room of `photo.Lighting`.

Everything that does not change is prepared once: meshes, textures and, for a camera that stands
still, the picture of what stands still. Of such a camera only the pixels are rendered again in
which moving bodies or their shadows are. What pixels see comes from the labels' rasteriser, also
between their centres: the parts of a pixel are the pixels of a finer camera.

Beside `photo.PhotoRenderer`, which casts rays, the pictures are the same but for rounding.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import accumulate, pairwise, product

import numpy as np
from numpy.typing import ArrayLike

from realsim.arrays import Array, Array32, Int32, Int64, Mask, UInt8
from realsim.geometry import camera, se3
from realsim.records import CameraIntrinsics
from realsim.rendering.casting.pixel_caster import (
    NOT_WANTED,
    Buffers,
    PixelCaster,
    empty_buffers,
    enter,
    lens_array,
    may_be_seen,
    projected,
)
from realsim.rendering.embedded import room_light, sun_shadows
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
    in_the_sun: sun_shadows.SunBodies
    """The meshes in the sun's frame."""


@dataclass(frozen=True, eq=False, slots=True)
class Seen:
    """What a camera sees of some of the meshes at one moment, and how that came about."""

    camera: tuple[CameraIntrinsics, CameraIntrinsics, Array]
    """The camera, the one whose pixels are the parts of its pixels, T_world_cam (4, 4) [m]."""
    numbers: tuple[int, ...]
    """The meshes."""
    hits: tuple[Buffers, Buffers]
    """What the centres of the pixels see, and what their parts see."""
    points: sun_shadows.SortedPoints
    """Where the sun could shine on what the centres see."""
    lit: Mask
    """(P,) where it does."""
    ambient: Array32
    """(P, 3) light of the centres without the sun."""
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
        self._surfaces = room_light.room_surfaces(placed, light.gamma)
        self._R_sun_world = light.R_sun_world()
        self._light = light.rows()
        bodies, Ts = self._caster.bodies, [p.T_world_obj for p in placed]
        self._boxes = np.array([list(product(*b.bounds.T)) for b in bodies])
        self._kept: dict[tuple[int, ...], tuple[Buffers, Mask]] = {}
        firsts = [0, *accumulate(len(b.vertices) for b in bodies)]
        self._rows = [slice(*ends) for ends in pairwise(firsts)]
        in_the_sun = sun_shadows.SunBodies(
            np.concatenate([self._in_the_sun(k, T) for k, T in enumerate(Ts)]),
            np.concatenate([b.faces + np.int32(k) for b, k in zip(bodies, firsts, strict=False)]),
            self._surfaces.first_face,
            np.array([b.is_solid for b in bodies]),
        )
        self._first = Moment(np.array(Ts), in_the_sun)

    def moment(self, Ts_world_obj: Mapping[int, Array]) -> Moment:
        """Return a time at which some meshes, by number, are at poses (4, 4) [m].

        The others are where they were at first.
        """
        Ts, first = self._first.Ts_world_obj.copy(), self._first.in_the_sun
        vertices = first.vertices.copy()
        for k, T in Ts_world_obj.items():
            Ts[k], vertices[self._rows[k]] = T, self._in_the_sun(k, T)
        return Moment(Ts, first._replace(vertices=vertices))

    def still(
        self, intrinsics: CameraIntrinsics, T_world_cam: ArrayLike, numbers: Sequence[int]
    ) -> Seen:
        """Return what a camera that stands still sees of meshes that do, for `renewed`.

        Args:
            intrinsics: the raw (distorted) camera.
            T_world_cam: (4, 4) camera in world [m].
            numbers: of the meshes that stay where they were at first.
        """
        T = se3.check_rigid(T_world_cam, "T_world_cam")
        finer = self._finer(intrinsics)
        seen = self._seen(self._first, (intrinsics, finer, T), tuple(numbers))
        parts = empty_buffers(camera.ray_table(finer))
        self._enter(numbers, self._first, (finer, T), parts)
        return replace(seen, hits=(seen.hits[0], parts))

    def picture(
        self, moment: Moment, intrinsics: CameraIntrinsics, T_world_cam: ArrayLike
    ) -> MovingPicture:
        """Return what a camera sees, all of it rendered; arguments as of `still`."""
        T = se3.check_rigid(T_world_cam, "T_world_cam")
        seen = self._seen(moment, (intrinsics, self._finer(intrinsics), T), self._every)
        return self._finished(seen.hits[0], seen.whole)

    def renewed(self, moment: Moment, still: Seen) -> MovingPicture:
        """Return what `picture` does for a camera that stands still.

        Only the pixels in which moving bodies or their shadows are, and those beside them, are
        rendered.
        """
        import cv2

        intrinsics, _, T = still.camera
        depth, geometry, face = still.hits[0]
        centres = depth.copy(), geometry.copy(), face.copy()
        moving = [k for k in self._every if k not in still.numbers]
        self._enter(moving, moment, (intrinsics, T), centres)
        lit = still.lit.copy()
        self._cast_shadows(moving, moment, still.points, lit)
        moved, darker = (centres[1] != geometry).ravel(), lit != still.lit
        color, tone, whole = still.color.copy(), still.tone.copy(), still.whole.copy()
        color[darker] = still.ambient[darker]
        view, rows = self._view(moment, T), np.flatnonzero(moved)
        samples, _, sunlit = self._sampled(moment, view, intrinsics, centres, rows, self._every)
        color[rows] = room_light.lit_colors(samples, sunlit)
        changed = moved | darker
        room_light.tones(color, self.lighting.gamma, np.flatnonzero(changed), tone)
        near = changed.reshape(geometry.shape).astype(np.uint8)
        rows = np.flatnonzero(cv2.dilate(near, np.ones((3, 3), np.uint8)))
        whole[rows] = color[rows]
        pixels = (centres[1], tone, rows, whole)
        self._refine(moment, view, still.camera, pixels, still.hits[1], moving)
        return self._finished(centres, whole)

    # --- how ----------------------------------------------------------------------------------

    def _in_the_sun(self, number: int, T_world_obj: Array) -> Array:
        """Return the vertices (V, 3) of a mesh in the sun's frame [m]."""
        T = se3.from_rt(self._R_sun_world, np.zeros(3)) @ T_world_obj
        return se3.transform(T, self._caster.bodies[number].vertices)

    def _finer(self, intrinsics: CameraIntrinsics) -> CameraIntrinsics:
        """Return the camera whose pixels are the parts of a camera's pixels."""
        i, n = intrinsics, self.lighting.samples
        return replace(
            i, width=n * i.width, height=n * i.height, fx=n * i.fx, fy=n * i.fy,
            cx=n * i.cx + (n - 1) / 2.0, cy=n * i.cy + (n - 1) / 2.0,
        )  # fmt: skip

    def _seen(
        self, moment: Moment, seen_by: tuple[CameraIntrinsics, CameraIntrinsics, Array],
        numbers: tuple[int, ...],
    ) -> Seen:  # fmt: skip
        """Return what a camera, as of `Seen`, sees of the meshes `numbers`; not for all parts."""
        i, _, T = seen_by
        centres = empty_buffers(camera.ray_table(i))
        self._enter(numbers, moment, (i, T), centres)
        view, rows = self._view(moment, T), np.arange(i.height * i.width)
        samples, points, lit = self._sampled(moment, view, i, centres, rows, numbers)
        color, tone = room_light.lit_colors(samples, lit), np.empty(len(rows), np.float32)
        room_light.tones(color, self.lighting.gamma, rows, tone)
        whole = color.copy()
        self._refine(moment, view, seen_by, (centres[1], tone, rows, whole), None, numbers)
        hits = centres, centres
        return Seen(seen_by, numbers, hits, points, lit, samples.ambient, color, tone, whole)

    def _view(self, moment: Moment, T_world_cam: Array) -> room_light.RoomView:
        """Return a camera as the kernels take it."""
        return room_light.room_view(
            self._light, self._R_sun_world, moment.Ts_world_obj, T_world_cam
        )

    def _enter(
        self, numbers: Sequence[int], moment: Moment, seen_by: tuple[CameraIntrinsics, Array],
        buffers: Buffers, among: Mask = NOT_WANTED,
    ) -> None:  # fmt: skip
        """Enter meshes into what a camera sees, at the pixels `among` (H, W)."""
        intrinsics, T_world_cam = seen_by
        rays, Ts = camera.ray_table(intrinsics), moment.Ts_world_obj
        lens, T_cam_world = lens_array(intrinsics), se3.invert(T_world_cam)
        may = may_be_seen(intrinsics, self._boxes, T_cam_world @ Ts)
        for k in numbers:
            if may[k]:
                mesh = projected(self._caster.bodies[k], lens, T_cam_world @ Ts[k])
                enter(mesh, k, rays, buffers, NOT_WANTED, among)

    def _cast_shadows(
        self, numbers: Sequence[int], moment: Moment, points: sun_shadows.SortedPoints, lit: Mask
    ) -> None:
        """Clear `lit` where one of these meshes keeps the sun off."""
        sun_shadows.cast_shadows(points, moment.in_the_sun, np.array(numbers, np.int64), lit)

    def _sampled(
        self, moment: Moment, view: room_light.RoomView, intrinsics: CameraIntrinsics,
        hits: Buffers, rows: Int64, numbers: Sequence[int],
    ) -> tuple[room_light.RoomSamples, sun_shadows.SortedPoints, Mask]:  # fmt: skip
        """Return what rays of a camera see, where the sun could shine there, and where it does."""
        out: room_light.RoomSamples = room_light.empty_samples(len(rows))
        rays = camera.ray_table(intrinsics).reshape(-1, 3)
        pixel_rad = 1.0 / float(np.sqrt(intrinsics.fx * intrinsics.fy))
        seen = hits[1].reshape(-1), hits[2].reshape(-1)
        room_light.sample_room(self._surfaces, view, rays, seen, rows, pixel_rad, out)
        points, lit = sun_shadows.sort_points(out.toward_sun), np.ones(len(rows), np.bool_)
        self._cast_shadows(numbers, moment, points, lit)
        return out, points, lit

    def _refine(
        self, moment: Moment, view: room_light.RoomView,
        seen_by: tuple[CameraIntrinsics, CameraIntrinsics, Array],
        pixels: tuple[Int32, Array32, Int64, Array32], below: Buffers | None,
        numbers: Sequence[int],
    ) -> None:  # fmt: skip
        """Put the means over their parts into those pixels that have contrast.

        Args:
            moment: the time.
            view: the camera as the kernels take it.
            seen_by: the camera, as of `Seen`.
            pixels: the mesh (H, W) that they see, their tone (P,), which of them may be changed
                (N,), and their light (P, 3), which is.
            below: what parts see of the meshes that are not among `numbers`; None = there are none.
            numbers: the other meshes.
        """
        geometry, tone, rows, whole = pixels
        n, (intrinsics, finer, T) = self.lighting.samples, seen_by
        if n == 1:
            return
        rows = rows[room_light.busy_among(tone, geometry, self.lighting.contrast).ravel()[rows]]
        first = (rows // intrinsics.width) * n * finer.width + (rows % intrinsics.width) * n
        of_pixel = (np.arange(n)[:, None] * finer.width + np.arange(n)).ravel()
        parts = (first[:, None] + of_pixel).ravel()
        # Only these parts are cast, into buffers that are kept from picture to picture.
        rays = camera.ray_table(finer)
        if rays.shape not in self._kept:
            self._kept[rays.shape] = empty_buffers(rays), np.zeros(rays.shape[:2], np.bool_)
        hits, among = self._kept[rays.shape]
        for k, nothing in enumerate((np.inf, -1, -1)):
            hits[k].reshape(-1)[parts] = nothing if below is None else below[k].reshape(-1)[parts]
        among.reshape(-1)[parts] = True
        self._enter(numbers, moment, (finer, T), hits, among)
        among.reshape(-1)[parts] = False
        every = numbers if below is None else self._every
        samples, _, lit = self._sampled(moment, view, finer, hits, parts, every)
        room_light.mean_colors(samples, lit, n * n, rows, whole)

    def _finished(self, centres: Buffers, whole: Array32) -> MovingPicture:
        """Return the picture behind the lens, and its depth."""
        import cv2

        depth, geometry, _ = centres
        color = whole.reshape(*depth.shape, 3)
        if self.lighting.psf_px > 0:
            color = np.asarray(cv2.GaussianBlur(color, (0, 0), self.lighting.psf_px), np.float32)
        rgb = room_light.encoded(color.reshape(-1, 3), self.lighting.gamma).reshape(color.shape)
        return MovingPicture(rgb, np.where(geometry < 0, np.float32(0.0), depth))
