"""The photographs as an instrument: what each says for and against the objects as they stand.

All of it is in the raw image, lens included: a pixel on the page is a pixel of the camera. Depth is
compared across the surface, not along the ray, so that a slope does not look like an error.
"""

import threading
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from realsim.arrays import Array, Array32, Int32, Mask, Rgb, evenly
from realsim.errors import InputError
from realsim.geometry import camera, mesh_shape, se3
from realsim.pages.pictures import jpeg_bytes
from realsim.records import CameraIntrinsics, ObjectPose
from realsim.rendering.casting.pixel_caster import PixelCaster, empty_buffers, enter, finished
from realsim.rendering.overlay import VERDICT_RGB
from realsim.rendering.rays import PlacedMesh
from realsim.review.content.content import SceneContent
from realsim.review.content.views import strided
from realsim.review.placing.depth_residuals import SIGMAS, legend, noise_of, residual_rgb
from realsim.review.placing.measured_views import depth_bias_of

KINDS = ("photo", "render", "difference", "depth")
"""What a view can be shown as."""
JPEG_QUALITY = 92
"""Quality of what is shown in full size [%]: no block is seen at eight times the size."""
STRIP_PX = 640
"""Width at which all views are compared [px]: 3 mm at an arm's length are two to three pixels of
it, and an edge of one pixel, where depth is a mixture, is left out."""
MOST_VIEWS = 48
"""Views that are compared: a spread of them."""
LEAST_SEEN_PX = 40
"""With fewer compared pixels a view says nothing of an object."""
OFF_M = 0.002
"""Least distance from the surface that speaks against a pose [m]; more where the depth is noisy."""
STANDS_M, LEAST_BLOB_PX = 0.008, 30
"""What stands higher above the table, where no model is, on so many pixels, is a missing object."""
SEEN_M = 1e-4
"""A surface this much behind the nearest one is seen [m]: rounding of single precision."""
CONTEXT = 0.45
"""Brightness of the photograph under the colours of the depth."""


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Compared:
    """One view's measured depth against the objects as they stand."""

    which: Int32
    """(H, W) number of the object seen; -1 = none."""
    off_m: Array32
    """(H, W) measured surface in front of the model, or above the table [m]; NaN = not known."""
    covered: list[Mask]
    """(H, W) of each object: where it would be seen alone."""


@dataclass(frozen=True, eq=False, slots=True)
class _Cast:
    """One object alone in one view."""

    window: tuple[slice, slice]
    depth_m: Array32
    """(h, w) within the window; inf = not there."""
    contours: tuple[Int32, ...]
    """(N, 2) column and row of each contour's pixels, in the picture, closed."""


class Photographs:
    """Pictures and comparisons of one session's views; what was compared is kept."""

    def __init__(self, content: SceneContent) -> None:
        """Take what is shown of a session; no image is read."""
        self._content = content
        self._casters: dict[int, PixelCaster] = {}
        self._bias = depth_bias_of(content.store)
        self._normals: dict[int, Array] = {}
        self._scores: dict[tuple[int, bytes], dict[str, Any]] = {}
        self._lock = threading.Lock()

    def picture(self, view: int, kind: str, objects: Sequence[ObjectPose]) -> bytes:
        """Return a view as a JPEG in full size: photograph, render, difference or depth.

        Args:
            view: its number.
            kind: one of `KINDS`.
            objects: as they stand.

        Raises:
            InputError: there is no such view, or its image is missing or damaged.
        """
        rgb = self._content.store.rgb(view)
        if kind == "depth":
            rgb = self._depth_rgb(rgb, self._compared(view, objects, 1))
        elif kind != "photo":
            rendered, seen = self._rendered(view, rgb, objects)
            rgb = rendered if kind == "render" else _difference(rgb, rendered, seen)
        return jpeg_bytes(rgb, JPEG_QUALITY)

    def outlines(self, view: int, objects: Sequence[ObjectPose]) -> list[dict[str, Any]]:
        """Return the outlines of the objects in a view, as lines of pixels (u, v).

        Args:
            view: its number.
            objects: as they stand.
        """
        T, K = self._content.pose_of(view), self._content.intrinsics
        casts = [_cast_alone(self._caster(o.obj_id), K, se3.invert(o.T_world_obj) @ T)
                 for o in objects]  # fmt: skip
        nearest = np.full((K.height, K.width), np.inf, np.float32)
        for cast in casts:
            np.minimum(nearest[cast.window], cast.depth_m, out=nearest[cast.window])
        out: list[dict[str, Any]] = []
        for o, cast in zip(objects, casts, strict=True):
            lines: dict[bool, list[list[int]]] = {True: [], False: []}
            for contour, seen in zip(cast.contours, _seen_parts(cast, nearest), strict=True):
                for is_seen in lines:
                    lines[is_seen] += [r.ravel().tolist() for r in _runs(contour, seen == is_seen)]
            out.append({
                "instance": o.instance, "rgb": VERDICT_RGB[o.verdict],
                "seen": lines[True], "hidden": lines[False],
            })  # fmt: skip
        return out

    def strip(
        self, instance: int | None, objects: Sequence[ObjectPose], soon_s: float = np.inf
    ) -> dict[str, Any]:
        """Return all views with what speaks against an object in each, the worst view first.

        Args:
            instance: the object; None = none is looked at.
            objects: as they stand.
            soon_s: after so long [s] and one view no other is compared; the next call goes on.
        """
        content = self._content
        number = next((k for k, o in enumerate(objects) if o.instance == instance), None)
        chosen = evenly([v for v in content.views if v.index not in content.damaged], MOST_VIEWS)
        found: dict[int, dict[str, Any]] = {}
        end, kept = time.monotonic() + soon_s, len(self._scores)
        for v in chosen:
            if len(self._scores) == kept or time.monotonic() < end:
                found[v.index] = self._scored(v.index, objects)
        rows: list[dict[str, Any]] = []
        for v in content.shown_views:
            scored = found.get(v.index, {})
            row: dict[str, Any] = {"view": v.index, "missing": scored.get("missing", [])}
            trouble = content.damaged.get(v.index) or scored.get("trouble", "")
            row |= {"against": None, "is_compared": v.index in found, "trouble": trouble}
            if number is not None:
                o = objects[number]
                low, high = content.models[o.obj_id].mesh.bounds
                row |= self._at(v.index, se3.transform(o.T_world_obj, (low + high)[None] / 2.0))
                row["radius"] = 0.5 * float(np.linalg.norm(high - low)) * row["px_per_m"]
                if "against" in scored:
                    row["against"] = scored["against"][number]
            rows.append(row)
        rows.sort(key=lambda r: -1.0 if r["against"] is None else r["against"], reverse=True)
        noises = [f["noise_m"] for f in found.values() if "noise_m" in f]
        noise_m = float(np.median(noises or [noise_of([])]))
        said = legend(noise_m=noise_m)
        K = content.intrinsics
        return {
            "views": rows, "width": K.width, "height": K.height, "words": said.words,
            "compared": len(found), "of": len(chosen),
            "legend": [[v, rgb] for v, rgb in zip(said.values_mm, said.rgb.tolist(), strict=True)],
        }  # fmt: skip

    def spot(
        self, view: int, pixel: tuple[float, float], objects: Sequence[ObjectPose]
    ) -> list[dict[str, Any]]:
        """Return where the surface behind a pixel lies in all views that could see it.

        Args:
            view: of the pixel.
            pixel: (u, v).
            objects: as they stand; their surface counts where nothing was measured.
        """
        content, store = self._content, self._content.store
        xy, known = camera.undistort(content.intrinsics, np.array([pixel]))
        u, v = np.rint(pixel).astype(int)
        if not known.all() or not (0 <= u < content.intrinsics.width):
            return []
        z = float(store.depth_m(view)[v, u]) if store.has_depth(view) else 0.0
        if z <= 0:
            z = float(self._hits(view, objects, 1)[0][v, u])
        if z <= 0:
            return []
        ray = np.append(xy[0], 1.0)
        point = se3.transform(content.pose_of(view), z * ray[None])
        found = [{"view": w.index} | self._at(w.index, point) for w in content.views]
        return [f for f in found if f["u"] is not None]

    # --- how --------------------------------------------------------------------------------------

    def _at(self, view: int, point: Array) -> dict[str, Any]:
        """Return the pixel of a point (1, 3) in a view, None beyond it, and pixels a metre."""
        K = self._content.intrinsics
        p = se3.transform(se3.invert(self._content.pose_of(view)), point)
        u, v = camera.project(K, p)[0].tolist()
        is_in = p[0, 2] > 0 and -0.5 <= u < K.width - 0.5 and -0.5 <= v < K.height - 0.5
        return {
            "u": u if is_in else None, "v": v if is_in else None,
            "px_per_m": K.fx / max(float(p[0, 2]), 1e-6),
        }  # fmt: skip

    def _hits(
        self, view: int, objects: Sequence[ObjectPose], stride: int
    ) -> tuple[Array32, Int32, Int32, list[Mask]]:
        """Return depth, number of the object, its face, and what each would cover alone."""
        K, T = strided(self._content.intrinsics, stride), self._content.pose_of(view)
        rays = camera.ray_table(K)
        buffers = empty_buffers(rays)
        covered = [np.zeros(rays.shape[:2], np.bool_) for _ in objects]
        for k, o in enumerate(objects):
            mesh = self._caster(o.obj_id).project(0, K, se3.invert(o.T_world_obj) @ T)
            enter(mesh, k, rays, buffers, covered[k])
        hits = finished(buffers)
        return hits.depth_m, hits.geometry, hits.face, covered

    def _compared(self, view: int, objects: Sequence[ObjectPose], stride: int) -> Compared:
        content = self._content
        T = content.pose_of(view)
        depth, which, face, covered = self._hits(view, objects, stride)
        off = np.full(depth.shape, np.nan, np.float32)
        if not content.store.has_depth(view):
            return Compared(which=which, off_m=off, covered=covered)
        rays = camera.ray_table(strided(content.intrinsics, stride))
        measured = self._bias.corrected(content.store.depth_m(view)[::stride, ::stride])
        is_known = measured > 0
        for k, o in enumerate(objects):
            on = (which == k) & is_known
            normals = self._normals_of(o.obj_id)[face[on]] @ o.T_world_obj[:3, :3].T @ T[:3, :3]
            across = np.abs(np.einsum("ij,ij->i", normals, rays[on]))
            off[on] = (depth[on] - measured[on]) * across
        if content.scene.plane is not None:
            on = (which < 0) & is_known
            points = se3.transform(T, rays[on].astype(np.float64) * measured[on, None])
            plane = content.scene.plane.T_world_table
            height = (points - plane[:3, 3]) @ plane[:3, 2]
            off[on] = np.where(content.region.holds(points), height, np.nan)
        return Compared(which=which, off_m=off, covered=covered)

    def _caster(self, obj_id: int) -> PixelCaster:
        """Return what casts a model in its own frame; made once."""
        if obj_id not in self._casters:
            alone = PlacedMesh(0, self._content.models[obj_id].mesh, np.eye(4))
            self._casters[obj_id] = PixelCaster([alone])
        return self._casters[obj_id]

    def _normals_of(self, obj_id: int) -> Array:
        if obj_id not in self._normals:
            self._normals[obj_id] = mesh_shape.face_normals(self._content.models[obj_id].mesh)
        return self._normals[obj_id]

    def _scored(self, view: int, objects: Sequence[ObjectPose]) -> dict[str, Any]:
        """Return what a view says against each object, and where it sees what no model explains."""
        poses = b"".join(o.T_world_obj.tobytes() + bytes([o.obj_id % 256]) for o in objects)
        with self._lock:
            if (view, poses) not in self._scores:
                stride = max(1, round(self._content.intrinsics.width / STRIP_PX))
                if len(self._scores) > 8 * MOST_VIEWS:
                    self._scores.clear()
                try:
                    compared = self._compared(view, objects, stride)
                    self._scores[view, poses] = _scores(compared, len(objects), stride)
                except InputError as error:
                    return {"trouble": str(error)}  # the file may come back
            return self._scores[view, poses]

    def _depth_rgb(self, rgb: Rgb, compared: Compared) -> Rgb:
        """Return a photograph, darkened, with the colours of what the depth says on it."""
        off, on_model = compared.off_m, compared.which >= 0
        noise_m = noise_of(off[on_model])
        colors = residual_rgb(off, noise_m=noise_m).reshape(*off.shape, 3)
        shown = np.isfinite(off) & (on_model | (np.abs(off) > SIGMAS * noise_m))
        grey = np.repeat(rgb.mean(-1, keepdims=True) * CONTEXT, 3, -1).astype(np.uint8)
        return np.where(shown[..., None], colors, grey)

    def _rendered(self, view: int, rgb: Rgb, objects: Sequence[ObjectPose]) -> tuple[Rgb, Mask]:
        """Return the photograph with rendered objects in it, and where they are."""
        from realsim.rendering.photo import Lighting, PhotoRenderer

        models = self._content.models
        placed = [PlacedMesh(o.instance, models[o.obj_id].mesh, o.T_world_obj) for o in objects]
        lighting = Lighting(gamma=2.2, samples=1, psf_px=0.0)
        K, T = self._content.intrinsics, self._content.pose_of(view)
        photo = PhotoRenderer(placed, lighting).render(K, T)
        seen = photo.geometry >= 0
        out = rgb.copy()
        for k in range(len(objects)):
            on = photo.geometry == k
            if on.any():
                a, b = photo.rgb[on].astype(np.float32), rgb[on].astype(np.float32)
                gain = b.std(0).mean() / max(float(a.std(0).mean()), 1.0)
                out[on] = np.clip((a - a.mean(0)) * min(float(gain), 2.0) + b.mean(0), 0, 255)
        return out, seen


def _difference(rgb: Rgb, rendered: Rgb, seen: Mask) -> Rgb:
    """Return how much photograph and render (H, W, 3) differ: black = not, yellow = much."""
    import cv2

    off = np.abs(rgb.astype(np.int16) - rendered).max(-1)
    heat: Any = cv2.applyColorMap(np.clip(2 * off, 0, 255).astype(np.uint8), cv2.COLORMAP_INFERNO)
    grey = np.repeat(rgb.mean(-1, keepdims=True) * CONTEXT, 3, -1).astype(np.uint8)
    return np.where(seen[..., None], heat[..., ::-1], grey)


def _scores(compared: Compared, count: int, stride: int) -> dict[str, Any]:
    """Return the shares against `count` objects, and what stands where no model is."""
    import cv2

    off, which = compared.off_m, compared.which
    noise_m = noise_of(off[which >= 0])
    limit = max(OFF_M, SIGMAS * noise_m)
    kernel = np.ones((5, 5), np.uint8)
    bare = (which < 0) & np.isfinite(off)
    high = bare & (off > limit)
    against: list[float | None] = []
    for k in range(count):
        mine = (which == k) & np.isfinite(off)
        seen = int(mine.sum())
        if seen < LEAST_SEEN_PX:
            against.append(None)
            continue
        near = cv2.dilate(compared.covered[k].astype(np.uint8), kernel) > 0
        wrong = ((mine & (np.abs(off) > limit)) | (near & high)).astype(np.uint8)
        wrong = cv2.morphologyEx(wrong, cv2.MORPH_OPEN, np.ones((2, 2), np.uint8))
        against.append(min(1.0, float(wrong.sum()) / seen))
    explained = cv2.dilate((which >= 0).astype(np.uint8), kernel) > 0
    stands = (bare & (off > STANDS_M) & ~explained).astype(np.uint8)
    found: Any = cv2.connectedComponentsWithStats(stands, connectivity=8)
    missing = [
        {"u": stride * float(c[0]), "v": stride * float(c[1]),
         "radius": stride * 0.5 * float(np.hypot(*s[2:4]))}
        for s, c in zip(found[2][1:], found[3][1:], strict=True)
        if s[cv2.CC_STAT_AREA] >= LEAST_BLOB_PX
    ]  # fmt: skip
    return {"against": against, "missing": missing, "noise_m": noise_m}


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


def _seen_parts(cast: _Cast, nearest: Array32) -> list[Mask]:
    """Return per contour which of its pixels (N,) no other object hides."""
    if not cast.contours:
        return []
    front = cast.depth_m <= nearest[cast.window] + SEEN_M
    top, left = cast.window[0].start, cast.window[1].start
    # An inner contour runs on pixels around the hole, which are the object's, too.
    return [front[c[:, 1] - top, c[:, 0] - left] for c in cast.contours]


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
