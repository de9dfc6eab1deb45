"""The photograph as evidence: do the outlines of placed models lie on edges of the image?

Where a model ends in the picture and something that lies behind it begins, the photograph mostly
changes. Along the normal of every outline point the edge that stands out most nearby is sought; its
signed distance d [px] is positive where it lies outside of the model. Outlines in front of which
something was measured are no evidence.

`shifted` moves objects in the picture only, in directions that depth knows badly: with n the normal
and p the place from the object's middle, R its reach,
    d = n.(c + s) + roll (n x p) / R + rim
c is common to all objects (depth does not lie exactly on colour), s and the roll are the object's
own, with priors; the rim (mesh too large, depth too short: depth decides which) moves nothing.
Weights come from the residuals, so that an outline which fits no edge moves nothing either.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field

import cv2
import numpy as np

from realsim.arrays import Array, Array32, Int64, Mask, UInt8
from realsim.geometry import camera, se3
from realsim.records import CameraIntrinsics, Mesh
from realsim.rendering.casting.pixel_caster import PixelCaster
from realsim.rendering.rays import PlacedMesh

WINDOW_PX = 16
"""Around a model in a picture so much is looked at [px]: more than all filters reach."""


OUTLINE_PX = 1.5
"""Smoothing of the model's mask, whose half is the outline, to fractions of a pixel."""
REACH_PX = 7.0
"""Edges are sought so far on both sides."""
STEP_PX = 0.5
"""Steps of the search; a parabola through the crest finds the rest."""
GRAY_NOISE = 1.2
"""Least change at an edge, in units of the photograph's median change."""
LEAST_CHANGE = 0.7
"""Least change at an edge in absolute terms [of 255, per px]."""
FRONT_M = 0.015
"""What was measured by more than this in front of a model hides its outline [m]."""
BEHIND_M = 0.004
"""What is seen beyond an outline lies behind by at least this [m]; else it is none."""
SQUARE_PX = 16
"""Blocks of a checkerboard: a correction is fitted on every other one."""
TOGETHER = 8.0
"""Neighbouring outline points that count as one, because they see the same edge."""
COMMON_PX = 3.0
"""1-sigma of the common shift [px]: published depth lies up to 5 px off its photograph."""
OWN_PX = 1.0
"""1-sigma of an object's own shift and of its roll at its reach [px]."""
OUTLINE_RIM_PX = 2.0
"""1-sigma of the rim [px]."""
LEAST_PX = 0.4
"""Residuals are taken for at least so large [px]."""
EDGE_POINTS = 25
"""Fewer outline points with an edge move nothing."""
EDGE_ROUNDS = 3
"""Times the outlines are drawn again."""


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Picture:
    """A photograph with its depth, seen from a known place, its changes taken once."""

    intrinsics: CameraIntrinsics
    depth_m: Array32
    """(H, W) [m]; 0 = none."""
    T_world_cam: Array
    """(4, 4)."""
    rgb: UInt8
    """(H, W, 3)."""
    changes: tuple[Array32, Array32] = field(init=False)
    """(H, W, 3) change of red, green, blue along u, and along v [of 255 per px]."""
    noise: float = field(init=False)
    """What it changes by in the median [of 255 per px]."""

    def __post_init__(self) -> None:
        """Take the changes of the photograph, smoothed by a pixel."""
        smooth = cv2.GaussianBlur(self.rgb.astype(np.float32), (0, 0), 1.0)
        both = [cv2.Sobel(smooth, cv2.CV_32F, *d, ksize=3, scale=1 / 8) for d in ((1, 0), (0, 1))]
        object.__setattr__(self, "changes", tuple(both))
        some = np.concatenate([c[::4, ::4] for c in both], axis=2)
        noise = np.median(np.linalg.norm(some, axis=2) / np.sqrt(2.0))
        object.__setattr__(self, "noise", float(noise))

    def depth_of(self, mesh: Mesh, T_world_obj: Array) -> Array32:
        """Return the depth (H, W) of a mesh alone [m]; inf beside it."""
        hits = PixelCaster([PlacedMesh(0, mesh, T_world_obj)]).cast(
            self.intrinsics, self.T_world_cam
        )
        return np.where(hits.geometry == 0, hits.depth_m, np.float32(np.inf))


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Outline:
    """Where a model ends in a picture before something behind it, and the edge found there."""

    pixels: Array
    """(N, 2) u, v."""
    normals: Array
    """(N, 2) unit, outwards."""
    offsets: Array
    """(N,) signed distance of the photograph's edge along the normal [px]; NaN = none."""

    @property
    def median_px(self) -> float:
        """Median distance of the edges that were found [px]; NaN without any."""
        seen = np.isfinite(self.offsets)
        return float(np.median(np.abs(self.offsets[seen]))) if seen.any() else float("nan")

    def part(self, which: Mask) -> "Outline":
        """Return some of the points."""
        return Outline(
            pixels=self.pixels[which], normals=self.normals[which], offsets=self.offsets[which]
        )

    def squares(self, block: int, odd: bool) -> Mask:
        """Return (N,) which points lie in the one or the other half of a checkerboard."""
        cells = np.floor(self.pixels / block).astype(np.int64).sum(1)
        return (cells % 2 == 1) == odd

    def sectors(self, middle: Array, count: int) -> Int64:
        """Return (N,) the direction of every point from a middle (2,), 0 to count - 1."""
        x, y = (self.pixels - middle).T
        return np.floor((np.arctan2(y, x) / (2 * np.pi) % 1.0) * count).astype(np.int64) % count


def hidden_by_measured(measured: Array32, own: Array32) -> Mask:
    """Return (H, W) where something was measured in front of a mesh or of its next pixel.

    Args:
        measured: (H, W) depth; 0 = none [m].
        own: (H, W) the mesh's depth, inf beside it [m].
    """
    # Beside the mesh the nearest depth of its rim.
    rim = np.where(np.isfinite(own), own, cv2.erode(np.minimum(own, 99.0), np.ones((5, 5))))
    front = (measured > 0) & (rim < 99) & (measured < rim - FRONT_M)
    return cv2.dilate(front.astype(np.uint8), np.ones((5, 5))) > 0


def outline_of(picture: Picture, own: Array32, others: Array32) -> Outline:
    """Return the outline of a mesh and the photograph's edges beside it.

    Args:
        picture: the photograph.
        own: (H, W) the mesh's depth, inf beside it [m].
        others: (H, W) that of all other things.
    """
    size = own.shape[::-1]
    inside = np.isfinite(own) & (own <= others)
    nothing = np.zeros((0, 2))
    if not inside.any():
        return Outline(pixels=nothing, normals=nothing, offsets=np.zeros(0))
    spans = [np.flatnonzero(inside.any(axis=a)) for a in (1, 0)]
    first = [max(0, int(s[0]) - WINDOW_PX) for s in spans]
    window = tuple(slice(f, int(s[-1]) + WINDOW_PX) for f, s in zip(first, spans, strict=True))
    own, others, inside = own[window], others[window], inside[window]
    measured = picture.depth_m[window]
    smooth = cv2.GaussianBlur(inside.astype(np.float32), (0, 0), OUTLINE_PX)
    du, dv = (cv2.Sobel(smooth, cv2.CV_32F, *d, ksize=3, scale=1 / 8) for d in ((1, 0), (0, 1)))
    slope = np.hypot(du, dv)
    border = inside & (cv2.erode(inside.astype(np.uint8), np.ones((3, 3))) == 0)
    # Beyond the border something must lie behind: where it lies in front, its own outline is seen.
    nearest = cv2.erode(np.where(inside, 99.0, np.minimum(others, 99.0)), np.ones((3, 3)))
    seen = border & (nearest > own + BEHIND_M) & (slope > 0.02)
    i, j = np.nonzero(seen & ~hidden_by_measured(measured, own))
    normals = -np.stack([du[i, j], dv[i, j]], axis=1) / slope[i, j][:, None]
    # Across a straight outline the smoothed mask falls by `slope` per pixel where it is a half.
    away = np.clip((smooth[i, j] - 0.5) / slope[i, j], -1.0, 1.5)
    pixels = np.stack([j + first[1], i + first[0]], axis=1) + away[:, None] * normals
    within = np.all((pixels > 2) & (pixels < np.array(size) - 3), axis=1)
    pixels, normals = pixels[within], normals[within].astype(np.float64)
    return Outline(pixels=pixels, normals=normals, offsets=_edges(picture, pixels, normals))


def _edges(picture: Picture, pixels: Array, normals: Array) -> Array:
    """Return the signed distance (N,) to the edge that stands out most near every point [px]."""
    if len(pixels) == 0:
        return np.zeros(0)
    n = round(REACH_PX / STEP_PX) + 1
    s = np.arange(-n, n + 1) * STEP_PX
    at = (pixels[:, None] + s[None, :, None] * normals[:, None]).astype(np.float32)
    along_u, along_v = (
        cv2.remap(c, at[..., 0], at[..., 1], cv2.INTER_LINEAR) for c in picture.changes
    )
    across = along_u * normals[:, :1, None] + along_v * normals[:, 1:, None]
    change = np.linalg.norm(across, axis=2)
    inner, least = change[:, 1:-1], max(LEAST_CHANGE, GRAY_NOISE * picture.noise)
    crest = (inner >= change[:, :-2]) & (inner > change[:, 2:]) & (inner > least)
    # A nearer edge is preferred to a stronger one, which is likely another's.
    worth = np.where(crest, inner * np.exp(-2.0 * np.square(s[1:-1] / REACH_PX)), 0.0)
    best = np.argmax(worth, axis=1) + 1
    row = np.arange(len(pixels))
    a, b, c = change[row, best - 1], change[row, best], change[row, best + 1]
    d = s[best] + STEP_PX * np.clip(0.5 * (a - c) / np.minimum(a - 2 * b + c, -1e-6), -1, 1)
    return np.where(worth.max(axis=1) > 0, d, np.nan)


def shifted(picture: Picture, meshes: Sequence[Mesh], poses: Sequence[Array]) -> list[Array]:
    """Return poses T_world_obj moved in the picture onto its edges.

    The even squares of a checkerboard are used; the odd ones are left to judge by.

    Args:
        picture: the photograph.
        meshes: of the objects.
        poses: (4, 4) each, as depth has them.
    """
    now = list(poses)
    for _ in range(EDGE_ROUNDS):
        depths = [picture.depth_of(m, T) for m, T in zip(meshes, now, strict=True)]
        outlines: list[Outline] = []
        for k, own in enumerate(depths):
            others = np.min([*depths[:k], *depths[k + 1 :], np.full_like(own, np.inf)], axis=0)
            found = outline_of(picture, own, others)
            use = found.squares(SQUARE_PX, odd=False) & np.isfinite(found.offsets)
            outlines.append(found.part(use))
        Ts_cam_obj = [se3.invert(picture.T_world_cam) @ T for T in now]
        middles = [se3.transform(T, m.bounds.mean(0)[None])[0] for T, m in zip(Ts_cam_obj, meshes,
                                                                     strict=True)]  # fmt: skip
        centers = camera.project(picture.intrinsics, np.stack(middles))
        reaches = [max(float(np.abs(o.pixels - c).max(initial=1.0)), 1.0)
                   for o, c in zip(outlines, centers, strict=True)]  # fmt: skip
        x = _solved(outlines, centers, reaches)
        for k, (T, middle) in enumerate(zip(Ts_cam_obj, middles, strict=True)):
            own_part = x[2 + 4 * k : 6 + 4 * k]
            f = np.array([picture.intrinsics.fx, picture.intrinsics.fy])
            step = np.append((x[:2] + own_part[:2]) * middle[2] / f, 0.0)
            axis = middle / np.linalg.norm(middle) * own_part[2] / reaches[k]
            turn = se3.exp(np.concatenate([axis, np.zeros(3)]))
            about = se3.from_translation(middle + step) @ turn @ se3.from_translation(-middle)
            now[k] = picture.T_world_cam @ about @ T
    return now


def _solved(outlines: Sequence[Outline], centers: Array, reaches: Sequence[float]) -> Array:
    """Return the common shift (2) and of every object its shift (2), roll and rim [px]."""
    size = 2 + 4 * len(outlines)
    own = [OWN_PX, OWN_PX, OWN_PX, OUTLINE_RIM_PX]
    prior = 1.0 / np.square([COMMON_PX] * 2 + own * len(outlines))
    rows: list[tuple[Array, Array]] = []
    for k, o in enumerate(outlines):
        if len(o.offsets) < EDGE_POINTS:
            continue
        J, n, p = np.zeros((len(o.offsets), size)), o.normals, o.pixels - centers[k]
        J[:, :2] = J[:, 2 + 4 * k : 4 + 4 * k] = n
        J[:, 4 + 4 * k] = (n[:, 1] * p[:, 0] - n[:, 0] * p[:, 1]) / reaches[k]
        J[:, 5 + 4 * k] = 1.0
        rows.append((J, o.offsets))
    x = np.zeros(size)
    for _ in range(8):
        A, b = np.diag(prior), np.zeros(size)
        for J, d in rows:
            r = d - J @ x
            sigma = max(1.48 * float(np.median(np.abs(r))), LEAST_PX)
            w = 1.0 / np.square(1.0 + np.square(r / (1.5 * sigma)))
            w /= sigma**2 * TOGETHER
            A += J.T @ (w[:, None] * J)
            b += J.T @ (w * d)
        x = np.asarray(np.linalg.solve(A, b), dtype=np.float64)
    return x


# --- the print --------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Paint:
    """Points of a surface with the colours that its mesh has there."""

    points: Array
    """(N, 3) in the object's frame [m]."""
    colors: Array
    """(N, 3) [of 255]."""


def paint_of(mesh: Mesh, count: int = 6000) -> Paint | None:
    """Return painted points of a mesh, evenly spread; None = it has neither colours nor texture."""
    if mesh.colors is None and (mesh.texture is None or mesh.uv is None):
        return None
    rng = np.random.default_rng(0)
    corners = mesh.vertices[mesh.faces]
    first, second = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    areas = np.linalg.norm(np.cross(first, second), axis=1)
    faces = mesh.faces[rng.choice(len(areas), count, p=areas / areas.sum())]
    weights = rng.dirichlet(np.ones(3), count)[..., None]
    points = np.sum(weights * mesh.vertices[faces], axis=1)
    if mesh.texture is not None and mesh.uv is not None:
        u, v = np.sum(weights * mesh.uv[faces], axis=1).T
        height, width = mesh.texture.shape[:2]
        rows = np.clip(((1.0 - v % 1.0) * height).astype(int), 0, height - 1)
        columns = np.clip((u % 1.0 * width).astype(int), 0, width - 1)
        colors = mesh.texture[rows, columns].astype(np.float64)
    else:
        assert mesh.colors is not None
        colors = np.sum(weights * mesh.colors[faces], axis=1)
    return Paint(points=points, colors=colors)


def print_errors(
    picture: Picture, paint: Paint, T_world_obj: Array, own: Array32, others: Array32,
    ) -> tuple[float, Array]:  # fmt: skip
    """Return how well a surface's print is found in the photograph.

    The photograph is fitted by gain times print plus an offset, colour by colour: light is unknown.

    Args:
        picture: the photograph.
        paint: the surface.
        T_world_obj: (4, 4).
        own: (H, W) the object's depth, inf beside it [m].
        others: (H, W) that of all other things.

    Returns:
        The correlation of all colours (0 where they go against each other); and the mean square
        rest (H / block, W / block), NaN where nothing of the object is in sight.
    """
    blocks = tuple(-(-n // SQUARE_PX) for n in own.shape)
    nothing = float("nan"), np.full(blocks, np.nan)
    points = se3.transform(se3.invert(picture.T_world_cam) @ T_world_obj, paint.points)
    seen = points[:, 2] > 0.02
    pixels = np.full((len(points), 2), -1.0)
    pixels[seen] = camera.project(picture.intrinsics, points[seen])
    at = np.round(np.nan_to_num(pixels, nan=-1.0)).astype(np.int64)
    height, width = own.shape
    seen &= (at >= 0).all(1) & (at[:, 0] < width) & (at[:, 1] < height)
    j, i = at[seen].T
    free = (np.abs(own[i, j] - points[seen, 2]) < BEHIND_M) & (own[i, j] <= others[i, j])
    free &= ~hidden_by_measured(picture.depth_m, own)[i, j]
    i, j, C = i[free], j[free], paint.colors[seen][free]
    if len(i) < 10 * EDGE_POINTS:
        return nothing
    P = cv2.GaussianBlur(picture.rgb, (0, 0), OUTLINE_PX)[i, j].astype(np.float64)
    p, c = P - P.mean(0), C - C.mean(0)
    gain = np.maximum(np.sum(p * c, axis=0) / np.maximum(np.sum(c * c, axis=0), 1.0), 0.0)
    rest = np.sum(np.square(p - gain * c), axis=1)
    explained = 1.0 - float(rest.sum()) / max(float(np.sum(p * p)), 1.0)
    cells = (i // SQUARE_PX) * blocks[1] + j // SQUARE_PX
    count = np.bincount(cells, minlength=blocks[0] * blocks[1])
    total = np.bincount(cells, weights=rest, minlength=len(count))
    means = np.where(count > 0, total / np.maximum(count, 1), np.nan)
    return float(np.sqrt(max(explained, 0.0))), means.reshape(blocks)
