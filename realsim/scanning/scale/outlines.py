"""The model's outlines against the measured ones: which points, and what they say.

A point m of the model's outline, or of its surface in free space, lies D(u) pixels outside of the
measured outline in the image:  r = (D(u) - rim) z / f. With g its gradient in the body's axes
    block (see `registration.refinement.equations`):  dr/dxi = -[m x g, g],  dr/dlambda = g.m,
    dr/drim = -z / f.
Where the real surface lies outside by delta, so does the outline: r + delta.
"""

from dataclasses import dataclass

import numpy as np

from realsim.arrays import Array, Array32, Int64
from realsim.compiled import njit
from realsim.geometry import se3
from realsim.geometry.normal_equations import add_row, symmetric
from realsim.geometry.point_loops import move_back, pixel, turn
from realsim.geometry.robust import tukey
from realsim.registration.refinement.equations import Blocks, Offsets
from realsim.scanning.scale.config import ScaleConfig
from realsim.scanning.scale.evidence import Rim, ScanEvidence
from realsim.scanning.scale.shape import INNER_EXTENT, ScanShape
from realsim.scanning.scale.state import OBJECT, PATCHES, RIM, SIZE, ScaleState, metre_per_px

COLUMNS = 8
"""Columns of a block of outlines: twist, size, the outlines' offset."""
WIDEST_GAP_PX = 5.0
"""An outline whose place is unknown over more than this says nothing."""
RIM_PX = 0.35
"""1-sigma of an outline point without gap [px]: it lies somewhere in a pixel."""
LEAST_HEIGHT_M = 0.005
"""Outline points nearer to the table than this are not used [m]: the foot is not measured."""
LEAST_JUMP_M = 0.010
"""Outline points with a smaller jump of the depth behind them are not used [m]."""


@dataclass(frozen=True, eq=False, slots=True)
class Rims:
    """The model's outlines of a round, per view."""

    points: list[Array]
    """(N, 3) in the inner mesh's axes."""
    ids: list[Int64]
    """(N,) patch."""
    factors: list[Array]
    """(N,) by which they count less, since all outlines of a patch may be off by the same."""


def outlines_of(
    shape: ScanShape, evidence: ScanEvidence, state: ScaleState, cameras: Array, config: ScaleConfig
) -> Rims:
    """Return the points of the model's outline in every view that its depth can show."""
    T_table_world = se3.invert(state.table)
    points: list[Array] = []
    ids: list[Int64] = []
    offered = np.zeros(len(shape.patches.areas))
    for T in cameras:
        found = outline(shape, state, T, evidence.intrinsics.fx, config.samples.rim_points)
        world = state.s * found.points @ state.R.T + state.t
        height = se3.transform(T_table_world, world)[:, 2]
        # Behind the outline there must be table far enough away for the depth to jump.
        eye = float(se3.transform(T_table_world, T[:3, 3])[0, 2])
        distance = np.linalg.norm(world - T[:3, 3], axis=1)
        jump = distance * height / np.maximum(eye - height, 1e-6)
        keep = (height > LEAST_HEIGHT_M) & (jump > LEAST_JUMP_M)
        points.append(found.points[keep])
        ids.append(shape.patches.of(found.points[keep], found.normals[keep]))
        metre = metre_per_px(evidence, T)
        offered += np.bincount(ids[-1], minlength=len(offered)) / (RIM_PX * metre) ** 2
    # Together the outlines of a patch say no more than what all of them may be off by.
    factor = 1.0 / (1.0 + offered * config.shape.rim_sigma_m**2)
    return Rims(points, ids, [factor[k] for k in ids])


def outline_blocks(
    evidence: ScanEvidence, state: ScaleState, cameras: Array, rims: Rims, offsets: Array,
    limits: tuple[float, float],
) -> Blocks:  # fmt: skip
    """Return what the model's outlines say in every view.

    Args:
        evidence: what was measured.
        state: where everything stands.
        cameras: (V, 4, 4).
        rims: the points.
        offsets: (K,) where the real surface is believed to lie outside of the mesh [m].
        limits: Tukey's cut-off [sigma], and the shape's 1-sigma [m].
    """
    n, k = len(cameras), len(offsets)
    H, b = np.zeros((n, COLUMNS, COLUMNS)), np.zeros((n, COLUMNS))
    coupling, information, right = np.zeros((n, COLUMNS, k)), np.zeros(k), np.zeros(k)
    Ms = se3.invert(state.poses[0]) @ cameras
    rule = (WIDEST_GAP_PX, limits[0], limits[1] ** 2, False)
    for v, view in enumerate(evidence.views):
        add_outline(
            state.s * rims.points[v], Ms[v], evidence.camera_numbers, _image(view.rim),
            (rims.factors[v], state.rim, RIM_PX**2), rule, (rims.ids[v], offsets),
            (H[v], b[v], coupling[v], information, right),
        )  # fmt: skip
    return Blocks(
        H=symmetric(H), b=b, Ms=Ms, own=OBJECT, further=np.array([SIZE, RIM]),
        offsets=Offsets(
            coupling=coupling, information=information, right=right, at=PATCHES + np.arange(k)
        ),
    )  # fmt: skip


def add_outside(
    evidence: ScanEvidence, state: ScaleState, camera: Array, v: int, points: Array,
    rule: tuple[float, float, float], system: tuple[Array, Array],
) -> None:  # fmt: skip
    """Add the model's points that lie outside of the measured outline: the camera looked there.

    Args:
        evidence: what was measured.
        state: where everything stands.
        camera: (4, 4) of the view.
        v: the view's place in the list.
        points: (N, 3) in the inner mesh's axes.
        rule: weight of a point, distance from which on it counts [px], cut-off [m].
        system: H (8, 8) and b (8,), added to.
    """
    weight, least_px, cut = rule
    M = se3.invert(state.poses[0]) @ camera
    n, metre = len(points), metre_per_px(evidence, camera)
    add_outline(
        state.s * points, M, evidence.camera_numbers, _image(evidence.views[v].rim),
        # Unit variance in metres, as that of the measured points.
        (np.full(n, weight), least_px, 1.0 / metre**2), (0.0, cut, 0.0, True),
        (np.zeros(n, dtype=np.int64), np.zeros(1)),
        (*system, np.zeros((COLUMNS, 1)), np.zeros(1), np.zeros(1)),
    )  # fmt: skip


def _image(rim: Rim) -> tuple[Array32, Array32, float, float]:
    return rim.distance_px, rim.gap_px, float(rim.left), float(rim.top)


@njit
def _between_pixels(
    image: Array32, row: int, column: int, du: float, dv: float
) -> tuple[float, float, float]:
    """Return an image's value beside a pixel, and its slopes along u and v, by four pixels."""
    d00, d01 = image[row, column], image[row, column + 1]
    d10, d11 = image[row + 1, column], image[row + 1, column + 1]
    top, low = d00 + du * (d01 - d00), d10 + du * (d11 - d10)
    return top + dv * (low - top), (d01 - d00) * (1 - dv) + (d11 - d10) * dv, low - top


@njit
def add_outline(
    points: Array,
    M: Array,
    camera: Array,
    rim: tuple[Array32, Array32, float, float],
    data: tuple[Array, float, float],
    limits: tuple[float, float, float, bool],
    patches: tuple[Int64, Array],
    system: tuple[Array, Array, Array, Array, Array],
) -> None:
    """Add points of the model in one view: those of its outline, or those outside of the measured.

    Args:
        points: (N, 3) in the body's frame [m].
        M: (4, 4) T_body_cam.
        camera: (12,) fx fy cx cy and the eight distortion terms.
        rim: distance and gap images [px], left and top of the crop.
        data: factor (N,), the outline's offset [px], variance of a point without gap [px^2].
        limits: widest gap that says anything [px], Tukey's cut-off [sigma], variance of the shape
            [m^2], and whether only points outside count: the camera looked through there.
        patches: patch (N,) of every point, and where the real surface is believed to lie outside
            of the mesh there (K,) [m]: it is in the residual.
        system: H (8, 8) upper triangle and b (8,) of this view; coupling (8, K), information (K,)
            and right side (K,) of the patches. All are added to.
    """
    distance, gaps, left, top = rim
    factor, offset, base = data
    widest, cut, shape, one_sided = limits
    patch, outer = patches
    H, b, coupling, information, right = system
    fx, fy = camera[0], camera[1]
    f = 0.5 * (fx + fy)
    height, width = distance.shape
    J = np.zeros(COLUMNS)
    for i in range(len(points)):
        m = points[i]
        a0, a1, a2 = move_back(M, m[0], m[1], m[2])
        if a2 <= 0.02:
            continue
        x, y = a0 / a2, a1 / a2
        u, v = pixel(camera, x, y)
        u, v = u - left, v - top
        j, i0 = int(np.floor(u)), int(np.floor(v))
        if j < 1 or i0 < 1 or j >= width - 2 or i0 >= height - 2:
            continue
        gap = gaps[i0, j]
        if gap > widest and not one_sided:
            continue
        gap = 1.0 if one_sided else gap
        du, dv = u - j, v - i0
        D, along_u, along_v = _between_pixels(distance, i0, j, du, dv)
        if one_sided and D <= offset:
            continue
        metre = a2 / f
        n = patch[i]
        r = (D - offset) * metre + outer[n]
        # Uniform over the gap: gap^2 / 12; a gap of one pixel is none.
        variance = (base + (gap - 1.0) ** 2 / 12.0) * metre * metre
        w = tukey(r * r / (cut * cut * (variance + shape))) * factor[i] / variance
        if w == 0.0:
            continue
        # Gradient of r in camera axes, the lens taken for straight here.
        h0, h1 = along_u * fx / f, along_v * fy / f
        h2 = -(h0 * x + h1 * y)
        g0, g1, g2 = turn(M, h0, h1, h2)
        J[0], J[1], J[2] = m[2] * g1 - m[1] * g2, m[0] * g2 - m[2] * g0, m[1] * g0 - m[0] * g1
        J[3], J[4], J[5] = -g0, -g1, -g2
        J[6], J[7] = g0 * m[0] + g1 * m[1] + g2 * m[2], -metre
        add_row(H, b, J, w, r)
        information[n] += w
        right[n] -= w * r
        for c in range(COLUMNS):
            coupling[c, n] += w * J[c]


@dataclass(frozen=True, eq=False, slots=True)
class Outline:
    """Points on the model's outline as one camera would see it."""

    points: Array
    """(N, 3) in the inner mesh's axes."""
    normals: Array
    """(N, 3) of the surface there, outward, unit."""


def outline(
    shape: ScanShape, state: ScaleState, T_world_cam: Array, focal_px: float, wanted: int
) -> Outline:
    """Return points of the model's outline against the background in one view.

    Edges between a face that looks at the camera and one that does not, evenly by their length;
    of these the ones that a ray just inside meets, and a ray just outside misses.

    Args:
        shape: the mesh.
        state: scale and pose of the inner mesh.
        T_world_cam: (4, 4).
        focal_px: [px], for the width of "just".
        wanted: points before the test; about half of them stay.
    """
    s, R, t = state.s, state.R, state.t
    eye = (T_world_cam[:3, 3] - t) @ R / s
    a = shape.vertices[shape.edges[:, 0]]
    to_eye = eye - a
    facing = np.einsum("ekc,ec->ek", shape.edge_normals, to_eye) > 0
    border = np.flatnonzero(facing[:, 0] != facing[:, 1])
    if len(border) == 0:
        return Outline(np.zeros((0, 3)), np.zeros((0, 3)))
    a = a[border]
    b = shape.vertices[shape.edges[border, 1]]
    length = np.linalg.norm(b - a, axis=1)
    total = np.cumsum(length)
    at = (np.arange(wanted) + 0.5) / wanted * total[-1]
    e = np.searchsorted(total, at)
    part = ((total[e] - at) / np.maximum(length[e], 1e-12))[:, None]
    points = part * a[e] + (1 - part) * b[e]
    normal = shape.edge_normals[border[e]].sum(1)
    R_cam = T_world_cam[:3, :3]
    points_cam = (points * s @ R.T + t - T_world_cam[:3, 3]) @ R_cam
    out_cam = normal @ R.T @ R_cam
    z = points_cam[:, 2]
    # The direction out of the outline in the image is that of the normal, less its share along
    # the viewing ray.
    ray = points_cam / z[:, None]
    flat = out_cam[:, :2] - ray[:, :2] * out_cam[:, 2:]
    size = np.linalg.norm(flat, axis=1)
    ok = (size > 1e-9) & (z > 0.02)
    points, normal, ray = points[ok], normal[ok], ray[ok]
    flat = flat[ok] / size[ok, None]
    step = 1.5 / focal_px
    z = z[ok]
    outer, inner = ray.copy(), ray.copy()
    outer[:, :2] += step * flat
    inner[:, :2] -= step * flat
    both = np.concatenate([outer, inner]).astype(np.float32) @ R_cam.T.astype(np.float32)
    hit = shape.cast(T_world_cam[:3, 3], both, s, R, t)
    n = len(points)
    # What the inner ray meets may lie a little behind the edge on a round body, not far behind.
    seen = np.isfinite(hit[n:]) & (np.abs(hit[n:] - z) < 0.25 * s * INNER_EXTENT)
    keep = ~np.isfinite(hit[:n]) & seen
    normal = normal[keep] / np.linalg.norm(normal[keep], axis=1, keepdims=True)
    return Outline(points[keep], normal)
