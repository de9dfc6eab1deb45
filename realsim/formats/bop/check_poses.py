"""A pose held against masks and depth by the projected vertices of its model."""

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from realsim.arrays import Array, Array32, Int32, Mask
from realsim.formats.bop.labels import bbox_of
from realsim.geometry import se3
from realsim.geometry.camera import project, turning_radius
from realsim.geometry.mesh import hull_vertices
from realsim.records import CameraIntrinsics, Mesh

if TYPE_CHECKING:
    from realsim.formats.bop.check import Sheet

GROWN_PX = 2
"""By which the projected hull is grown [px] before a mask is asked to lie in it: pixels belong to a
mask by their centres, and the edge of a lens-bent hull is bent between its corners."""
COVERED = 0.98
"""Share of a mask's pixels that must lie in the projected hull."""
FILLED = 0.8
"""Overlap (intersection over union) of the box of a whole mask and of the projected vertices, cut
at the image, from which the pose and the mask are of one thing."""
IN_FRONT_SHARE = 0.01
"""Share of the visible pixels that may measure nearer than the model's nearest point by more than
delta: BOP's visibility excludes them, counted images round depth."""
BEHIND_SHARE = 0.5
"""Share of the visible pixels with depth that may lie behind the model's farthest point: BOP calls
such pixels visible, but where most are, the object is not where it is said to be."""
SMALLEST_PX = 30
"""Masks of fewer pixels say little of a pose."""


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Silhouette:
    """Where a model is in an image, by its vertices."""

    box: Array | None
    """x0 y0 x1 y1 of all vertices, also beyond the image [px]; None = some are not in front."""
    is_inside: bool
    """Whether all vertices are inside the image."""
    hull: Mask | None
    """(H, W) the hull of the projected vertices, grown; None = some are not in front."""
    nearest_m: float
    """Least depth of a vertex [m]."""
    farthest_m: float
    intrinsics: CameraIntrinsics
    corners: Array
    """(V, 3) vertices in the camera [m]."""
    faces: Int32

    @property
    def drawn_box(self) -> Array | None:
        """The box where BOP's own tools cut it: they draw on a canvas of three by three images."""
        if self.box is None:
            return None
        low = -np.array([self.intrinsics.width, self.intrinsics.height])
        return np.clip(self.box, np.tile(low, 2), np.tile(-2 * low - 1, 2))


def silhouette(intrinsics: CameraIntrinsics, T_cam_obj: Array, mesh: Mesh) -> Silhouette:
    """Return where a mesh is in an image."""
    import cv2

    corners = se3.transform(T_cam_obj, hull_vertices(mesh.vertices))
    z = corners[:, 2]
    nearest, farthest = float(z.min()), float(z.max())

    nowhere = Silhouette(
        box=None, is_inside=False, hull=None, nearest_m=nearest, farthest_m=farthest,
        intrinsics=intrinsics, corners=se3.transform(T_cam_obj, mesh.vertices), faces=mesh.faces,
    )  # fmt: skip
    if nearest <= 0:
        return nowhere
    radius = np.linalg.norm(corners[:, :2] / z[:, None], axis=1)
    if float(radius.max()) >= turning_radius(intrinsics):
        return nowhere
    # Of the hull's corners only: a point inside a hull is projected inside the corners' hull.
    uv = project(intrinsics, corners)
    box = np.concatenate([uv.min(axis=0), uv.max(axis=0)])
    size = np.array([intrinsics.width, intrinsics.height])
    canvas = np.zeros((intrinsics.height, intrinsics.width), np.uint8)
    limit = 4.0 * float(size.max())
    outline = cv2.convexHull(np.clip(uv, -limit, limit).astype(np.float32))
    filled: Any = cv2.fillConvexPoly(canvas, np.rint(outline).astype(np.int32), 1)
    kernel = np.ones((2 * GROWN_PX + 1, 2 * GROWN_PX + 1), np.uint8)
    grown: Any = cv2.dilate(filled, kernel)
    inside = bool(np.all(box[:2] >= 0) and np.all(box[2:] <= size - 1))
    return replace(nowhere, box=box, is_inside=inside, hull=np.asarray(grown) > 0)


def pose_findings(
    shape: Silhouette,
    whole: Mask | None,
    visible: Mask | None,
    depth_m: Array32 | None,
    delta_m: float,
    sheet: "Sheet",
) -> None:
    """Compare a pose with masks and depth.

    Args:
        shape: the projected model.
        whole: (H, W) its silhouette.
        visible: (H, W) the visible part.
        depth_m: (H, W) measured depth [m].
        delta_m: BOP's tolerance of visibility [m].
        sheet: takes the comparisons.
    """
    mask = visible if whole is None else whole
    pixels = 0 if mask is None else int(np.count_nonzero(mask))
    if mask is not None and shape.hull is not None and pixels >= SMALLEST_PX:
        covered = float(np.count_nonzero(mask & shape.hull)) / pixels
        sheet.compare(
            "scene_gt",
            "pose and mask",
            f"at least {COVERED:.0%} of the mask within the projected model",
            f"{covered:.1%}",
            agree=covered >= COVERED,
        )
    if whole is not None and shape.box is not None and pixels >= SMALLEST_PX:
        overlap, off = _overlap(_visible_box(shape), whole)
        if overlap < FILLED and not shape.is_inside:  # what is cut off may be a hollow of the hull
            overlap, off = max((overlap, off), _overlap(_shown_box(shape), whole))
        sheet.compare(
            "scene_gt",
            "pose and box",
            f"an overlap of at least {FILLED:g} of the mask's and the projected model's box",
            f"{overlap:.2f}",
            agree=overlap >= FILLED or off <= GROWN_PX,  # thin ends may hit no pixel's centre
        )
    if visible is not None and depth_m is not None:
        _compare_depth(shape, depth_m[visible].astype(np.float64), delta_m, sheet)


def _compare_depth(shape: Silhouette, depth_m: Array, delta_m: float, sheet: "Sheet") -> None:
    count = len(depth_m)
    if count < SMALLEST_PX:
        return
    measured = depth_m[depth_m > 0]
    front = int(np.count_nonzero(measured < shape.nearest_m - delta_m))
    sheet.compare(
        "scene_gt",
        "depth in front",
        f"at most {IN_FRONT_SHARE:.0%} of the visible pixels nearer than the model by "
        f"{1e3 * delta_m:g} mm",
        f"{front / count:.1%}",
        agree=front <= IN_FRONT_SHARE * count,
    )
    if len(measured) >= SMALLEST_PX:
        behind = float(np.mean(measured > shape.farthest_m + delta_m))
        sheet.compare(
            "scene_gt",
            "depth behind",
            f"at most {BEHIND_SHARE:.0%} of the visible pixels beyond the model",
            f"{behind:.1%}",
            agree=behind <= BEHIND_SHARE,
        )


def _visible_box(shape: Silhouette) -> Array:
    """Return the box [px] of what the image shows of a model: its border may cut a corner off."""
    assert shape.box is not None
    if shape.is_inside or shape.hull is None or not shape.hull.any():
        return shape.box
    x, y, w, h = bbox_of(shape.hull)
    border = np.array(shape.hull.shape[::-1]) - 1
    low, high = np.array([x, y]), np.array([x + w, y + h])
    return np.concatenate([
        np.where(low > 0, low + GROWN_PX, low), np.where(high < border, high - GROWN_PX, high)
    ]).astype(np.float64)  # fmt: skip


def _shown_box(shape: Silhouette) -> Array:
    """Return the box [px] of a model's pixels, drawn face by face."""
    import cv2

    width, height = shape.intrinsics.width, shape.intrinsics.height
    drawn, limit = np.zeros((height, width), np.uint8), 4.0 * max(width, height)
    uv = np.clip(project(shape.intrinsics, shape.corners), -limit, limit)
    for triangle in np.rint(uv).astype(np.int32)[shape.faces]:
        cv2.fillConvexPoly(drawn, triangle, 1)
    if not drawn.any():
        return np.full(4, -1.0)
    x, y, w, h = bbox_of(drawn > 0)
    return np.array([x, y, x + w, y + h], dtype=np.float64)


def _overlap(box: Array, mask: Mask) -> tuple[float, float]:
    """Return how a box and that of a mask overlap, and the greatest distance of two sides [px]."""
    height, width = mask.shape
    x, y, w, h = bbox_of(mask)
    a = np.array([x, y, x + w, y + h], dtype=np.float64)
    limits = np.array([width - 1, height - 1], dtype=np.float64)
    b = np.concatenate([np.clip(box[:2], 0, limits), np.clip(box[2:], 0, limits)])
    size = np.maximum(np.minimum(a[2:], b[2:]) - np.maximum(a[:2], b[:2]), 0) + 1
    area = float(np.prod(a[2:] - a[:2] + 1) + np.prod(b[2:] - b[:2] + 1))
    inside = float(np.prod(size))
    return inside / (area - inside), float(np.abs(a - b).max())
