"""The camera on the hand, seen from two sides, and the whole scene."""

from dataclasses import dataclass
from typing import Any

import numpy as np

from realsim.arrays import Array
from realsim.geometry import se3
from realsim.records import CameraIntrinsics
from realsim_calibration.report import style
from realsim_calibration.report.summary import carrier, corrected, looks_along
from realsim_calibration.results import HandEyeReport, ViewReport

FLANGE_RADIUS_M = 0.0315
"""Half the outer diameter of the flange ISO 9409-1-50-4-M6, for scale [m]."""
TRIAD_SHARE = 0.28
"""Length of drawn axes, as a share of the drawing."""
FRUSTUM_SHARE = 0.45
"""Depth of the drawn field of view, as a share of the camera's distance from the carrier."""
FRUSTUM_RANGE_M = (0.07, 0.20)
"""Least and largest depth of it [m]."""
SIDE_WIDTH_IN = 2.9
"""Width of a side view [inch]."""
END_ON = 0.35
"""Apparent length of a unit axis below which it is seen end on and left out."""
SCENE_FRUSTUM_SHARE = 0.12
"""Depth of a frustum in the scene, as a share of the distance to the target."""


def frustum(intrinsics: CameraIntrinsics, depth_m: float) -> Array:
    """Return the camera's centre and the image's corners (5, 3) at a depth, camera frame [m].

    Corners run top left, top right, bottom right, bottom left, without the lens's distortion.
    """
    i = intrinsics
    u = np.array([-0.5, i.width - 0.5, i.width - 0.5, -0.5])
    v = np.array([-0.5, -0.5, i.height - 0.5, i.height - 0.5])
    rays = np.stack([(u - i.cx) / i.fx, (v - i.cy) / i.fy, np.ones(4)], -1)
    return np.concatenate([np.zeros((1, 3)), rays * depth_m])


def frustum_lines(corners: Array) -> Array:
    """Return the 8 edges and the mark of the image's top (10, 2, 3) of a frustum (5, 3)."""
    a, b, c, d, e = corners
    peak = (b + c) / 2 + 0.35 * (b - e)
    lines = [(a, b), (a, c), (a, d), (a, e), (b, c), (c, d), (d, e), (e, b), (b, peak), (peak, c)]
    return np.array(lines)


def disc(radius: float, n: int = 61) -> Array:
    """Return a circle (n, 3) in the xy plane."""
    t = np.linspace(0, 2 * np.pi, n)
    return np.stack([radius * np.cos(t), radius * np.sin(t), np.zeros(n)], -1)


def plot_camera_in_hand(report: HandEyeReport) -> Any:
    """Draw carrier and camera: a view in space and two sides with dimensions [mm]."""
    side = _side(report)
    tall = (side.high[2] - side.low[2] + 0.42 * side.span) / (1.56 * side.span)
    room = (0.05, 0.35, 0.45, 0.52, 0.85, 0)
    figure = style.new_figure(1.2 + SIDE_WIDTH_IN * tall, grid=(1, 3), room=room)
    grid = figure.add_gridspec(1, 3, width_ratios=(1.3, 1, 1))
    _space_view(figure.add_subplot(grid[0], projection="3d"), report)
    for across in (0, 1):
        _side_view(figure.add_subplot(grid[across + 1]), side, across)
    figure.suptitle(f"The camera looks along {looks_along(report)}", x=0.01, ha="left",
                    fontsize=10.5, fontweight="bold", color=style.INK)  # fmt: skip
    return figure


def _frustum_depth(report: HandEyeReport) -> float:
    """Return how deep the field of view is drawn [m]."""
    away = float(np.linalg.norm(report.X[:3, 3]))
    return float(np.clip(FRUSTUM_SHARE * away, *FRUSTUM_RANGE_M))


def _parts_mm(report: HandEyeReport) -> tuple[Array, Array]:
    """Return the frustum (5, 3) and the disc (n, 3) in the carrier's frame [mm]."""
    corners = se3.transform(report.X, frustum(report.intrinsics, _frustum_depth(report)))
    return 1e3 * corners, 1e3 * disc(FLANGE_RADIUS_M)


def _space_view(ax: Any, report: HandEyeReport) -> None:
    """Draw disc, axes and frustum in space; a hand hangs with its z axis down."""
    from mpl_toolkits.mplot3d.art3d import Line3DCollection, Poly3DCollection

    # Half a turn about x puts a hand's z axis down without mirroring anything.
    turn = np.diag([1.0, -1.0, -1.0]) if report.mode == "eye_in_hand" else np.eye(3)
    corners, flange = _parts_mm(report)
    corners, flange = corners @ turn, flange @ turn
    X = report.X
    size = max(float(np.abs(corners).max()), 1e3 * FLANGE_RADIUS_M)
    length = TRIAD_SHARE * size
    ax.add_collection3d(Poly3DCollection([flange], facecolor=style.FAINT, edgecolor=style.MUTED,
                                         alpha=0.85))  # fmt: skip
    image = corners[1:]
    ax.add_collection3d(Poly3DCollection([image], facecolor=style.WARN, alpha=0.22))
    ax.add_collection3d(Line3DCollection(list(frustum_lines(corners)), colors=style.INK, lw=1.1))
    origin = np.zeros(3)
    up = np.array([0.0, 0.0, length])
    apart = length * corners[0] / max(float(np.linalg.norm(corners[0])), 1e-9)
    above = 0.6 * up * (1.0 if report.mode == "eye_in_hand" else -1.0) - 0.5 * apart
    _triad(ax, origin, turn, length, carrier(report), above)
    camera = turn @ X[:3, :3]
    aside = corners[0] + 0.45 * up + apart
    _triad(ax, corners[0], camera, 0.7 * length, "camera", aside)
    ax.plot(*np.stack([origin, corners[0]], -1), color=style.MUTED, lw=1, ls=(0, (4, 3)))
    tips = [_triad_tips(origin, turn, length), _triad_tips(corners[0], camera, 0.7 * length)]
    _equal_box(ax, np.concatenate([corners, flange, *tips, [aside]]), 1.12)
    ax.view_init(elev=18, azim=-58)
    ax.set_axis_off()
    ax.set_title("In space: the roof is the image's top", pad=0)


def _triad(ax: Any, at: Array, R: Array, length: float, name: str, name_at: Array) -> None:
    """Draw three axes, x red, y green, z blue, with letters at their ends, and a name."""
    for k, letter in enumerate("xyz"):
        tip = at + length * R[:, k]
        ax.plot(*np.stack([at, tip], -1), color=style.AXIS_COLORS[k], lw=2)
        ax.text(*(at + 1.18 * length * R[:, k]), letter, color=style.AXIS_COLORS[k], fontsize=8,
                ha="center", va="center")  # fmt: skip
    ax.text(*name_at, name, fontsize=8.5, color=style.INK, ha="center", va="center",
            fontweight="bold")  # fmt: skip


def _triad_tips(at: Array, R: Array, length: float) -> Array:
    """Return where the letters of a triad stand (3, 3)."""
    return at + 1.18 * length * R.T


def _equal_box(ax: Any, points: Array, zoom: float) -> None:
    """Give axes in space the same scale along all three, just large enough for some points."""
    low, high = points.min(0), points.max(0)
    half = 0.52 * np.maximum(high - low, 0.25 * float((high - low).max()))
    middle = (low + high) / 2
    x, y, z = np.stack([middle - half, middle + half], -1)
    ax.set(xlim=x, ylim=y, zlim=z)
    ax.set_box_aspect(half, zoom=zoom)
    ax.set_proj_type("ortho")


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class _Side:
    """What a side view shows, in the carrier's frame [mm]."""

    report: HandEyeReport
    corners: Array
    """(5, 3) camera and image corners."""
    span: float
    """Largest extent of the drawing, the same for both sides, so that they have one scale."""
    low: Array
    """(3,)"""
    high: Array
    """(3,)"""


def _side(report: HandEyeReport) -> _Side:
    """Return the extents of both sides."""
    corners, flange = _parts_mm(report)
    points = np.concatenate([frustum_lines(corners).reshape(-1, 3), flange])
    low, high = points.min(0), points.max(0)
    return _Side(report=report, corners=corners, span=float((high - low).max()), low=low, high=high)


def _side_view(ax: Any, side: _Side, across: int) -> None:
    """Draw one side: axis `across` (0 = x, 1 = y) to the right, z down for a hand, else up."""
    pick, span, report = [across, 2], side.span, side.report
    down = report.mode == "eye_in_hand"
    flat, camera = side.corners[:, pick], side.corners[0, pick]
    low, high = side.low[pick], side.high[pick]
    ax.fill(*_convex(flat).T, color=style.WARN, alpha=0.16, lw=0)
    for a, b in frustum_lines(side.corners)[:, :, pick]:
        ax.plot(*np.stack([a, b], -1), color=style.INK, lw=0.9)
    radius = 1e3 * FLANGE_RADIUS_M
    ax.plot([-radius, radius], [0, 0], color=style.MUTED, lw=5, solid_capstyle="butt")
    _flat_axes(ax, np.zeros(2), np.eye(3)[:, pick], 0.22 * span)
    _flat_axes(ax, camera, report.X[:3, :3].T[:, pick], 0.18 * span)
    _dimensions(ax, camera, low, high, span, down)
    ax.plot(*camera, "o", ms=3.5, color=style.INK)
    middle = (low[0] + high[0]) / 2 + 0.14 * span
    z = (low[1] - 0.08 * span, high[1] + 0.34 * span)
    if down:
        z = (high[1] + 0.08 * span, low[1] - 0.34 * span)
    ax.set(xlim=(middle - 0.78 * span, middle + 0.78 * span), ylim=z, aspect="equal")
    name, what = "xy"[across], carrier(report)
    seen = {(0, True): "+y", (1, True): "-x", (0, False): "-y", (1, False): "+x"}[across, down]
    ax.locator_params(nbins=6)
    ax.set(title=f"Seen from {seen}", xlabel=f"{what} {name} [mm]", ylabel=f"{what} z [mm]")
    style.grid(ax)


def _convex(points: Array) -> Array:
    """Return the convex hull (m, 2) of points (n, 2), which are not all on a line."""
    from scipy.spatial import ConvexHull, QhullError

    try:
        return points[ConvexHull(points).vertices]
    except QhullError:
        return points


def _flat_axes(ax: Any, at: Array, directions: Array, length: float) -> None:
    """Draw the axes (3, 2) of a frame as they appear from a side; ones seen end on are left out."""
    for k, letter in enumerate("xyz"):
        arrow = length * directions[k]
        if np.linalg.norm(directions[k]) < END_ON:
            continue
        ax.annotate("", at + arrow, at, arrowprops={"arrowstyle": "-|>", "lw": 1.8, "shrinkA": 0,
                    "shrinkB": 0, "color": style.AXIS_COLORS[k]})  # fmt: skip
        tip = at + arrow + 0.16 * length * directions[k] / np.linalg.norm(directions[k])
        ax.text(*tip, letter, color=style.AXIS_COLORS[k], fontsize=8, ha="center", va="center")


def _dimensions(ax: Any, camera: Array, low: Array, high: Array, span: float, down: bool) -> None:
    """Draw the camera's distances from the carrier's origin outside of the drawing [mm]."""
    edge = low[1] - 0.17 * span if down else high[1] + 0.17 * span
    right = high[0] + 0.14 * span
    looks = {"color": style.MUTED, "lw": 0.6}
    for x in (0.0, camera[0]):
        ax.plot([x, x], [0.0 if x == 0.0 else camera[1], edge], **looks)
    for z in (0.0, camera[1]):
        ax.plot([0.0 if z == 0.0 else camera[0], right], [z, z], **looks)
    arrow = {"arrowstyle": "<|-|>", "lw": 0.9, "color": style.INK, "shrinkA": 0, "shrinkB": 0,
             "mutation_scale": 6}  # fmt: skip
    ax.annotate("", (0.0, edge), (camera[0], edge), arrowprops=arrow)
    ax.annotate("", (right, 0.0), (right, camera[1]), arrowprops=arrow)
    box = {"boxstyle": "round,pad=0.15", "fc": "white", "ec": "none"}
    ax.text(camera[0] / 2, edge + (-0.07 if down else 0.07) * span, f"{camera[0]:.1f} mm",
            ha="center", va="center", fontsize=8, color=style.INK, bbox=box)  # fmt: skip
    ax.text(right + 0.03 * span, camera[1] / 2, f"{camera[1]:.1f} mm", ha="left", va="center",
            fontsize=8, color=style.INK, bbox=box)  # fmt: skip


def plot_scene(report: HandEyeReport) -> Any:
    """Draw base, target and every camera (eye to hand: every target) from a corner and above."""
    from matplotlib.cm import ScalarMappable
    from matplotlib.collections import LineCollection
    from matplotlib.colors import Normalize
    from mpl_toolkits.mplot3d.art3d import Line3DCollection, Poly3DCollection

    figure = style.new_figure(4.4, grid=(1, 2), room=(0.1, 0.8, 0.5, 0.3, 0.8, 0))
    grid = figure.add_gridspec(1, 2, width_ratios=(1.3, 1))
    corner = figure.add_subplot(grid[0], projection="3d")
    above = figure.add_subplot(grid[1])
    errors = style.finite([v.unseen_px for v in report.used])
    colors = ScalarMappable(Normalize(0, float(errors.max(initial=1e-3))), style.ERROR_MAP)
    drawn = _scene_lines(report)
    for view, lines in drawn:
        color: Any = colors.to_rgba(np.array(view.unseen_px)) if view.used else style.BAD
        looks: dict[str, Any] = {"lw": 0.9} if view.used else {"lw": 0.8, "linestyles": ":"}
        corner.add_collection3d(Line3DCollection(list(lines), colors=[color], **looks))
        above.add_collection(LineCollection(list(lines[:, :, :2]), colors=[color], **looks))
    fixed = _fixed_lines(report)
    corner.add_collection3d(Line3DCollection(list(fixed), colors=style.INK, lw=1.3))
    above.add_collection(LineCollection(list(fixed[:, :, :2]), colors=style.INK, lw=1.3))
    if report.mode == "eye_in_hand":
        sheet = fixed[:, 0]
        corner.add_collection3d(Poly3DCollection([sheet], facecolor=style.PALE, alpha=0.7))
        above.fill(sheet[:, 0], sheet[:, 1], color=style.PALE, alpha=0.7, lw=0)
        corner.plot(*sheet[:1].T, "o", ms=3.5, color=style.INK)
        above.plot(*sheet[0, :2], "o", ms=3.5, color=style.INK)
    points = np.concatenate([fixed.reshape(-1, 3), *[lines.reshape(-1, 3) for _, lines in drawn]])
    length = 0.13 * float(np.ptp(np.concatenate([points, np.zeros((1, 3))]), axis=0).max())
    points = np.concatenate([points, np.zeros((1, 3)), np.eye(3) * length])
    _corner_looks(corner, points, length)
    _above_looks(above, points, length)
    what = "camera" if report.mode == "eye_in_hand" else "target"
    style.color_bar(figure, colors, above, f"unseen error of the {what}'s view [px]")
    return figure


def _scene_lines(report: HandEyeReport) -> list[tuple[ViewReport, Array]]:
    """Return what moves with every view as lines (m, 2, 3) in the base frame [m]."""
    hands = np.array([corrected(report, v) for v in report.views]).reshape(-1, 4, 4)
    if report.mode == "eye_to_hand":
        outline = _target_outline(report)
        loops = [se3.transform(A @ report.Z_points, outline) for A in hands]
        return [(v, np.stack([p[:-1], p[1:]], 1)) for v, p in zip(report.views, loops, strict=True)]
    away = np.linalg.norm((hands @ report.X)[:, :3, 3] - report.Z_points[:3, 3], axis=-1)
    depth = SCENE_FRUSTUM_SHARE * float(np.median(away)) if len(away) else 0.05
    shape = frustum(report.intrinsics, depth)
    return [
        (v, frustum_lines(se3.transform(A @ report.X, shape)))
        for v, A in zip(report.views, hands, strict=True)
    ]


def _fixed_lines(report: HandEyeReport) -> Array:
    """Return what stands still as lines (m, 2, 3) in the base frame [m]: target or camera."""
    if report.mode == "eye_in_hand":
        loop = se3.transform(report.Z_points, _target_outline(report))
        return np.stack([loop[:-1], loop[1:]], 1)
    targets = np.array([(corrected(report, v) @ report.Z_points)[:3, 3] for v in report.views])
    away = np.linalg.norm(targets.reshape(-1, 3) - report.X[:3, 3], axis=-1)
    depth = 2 * SCENE_FRUSTUM_SHARE * float(np.median(away)) if len(away) else FRUSTUM_RANGE_M[1]
    return frustum_lines(se3.transform(report.X, frustum(report.intrinsics, depth)))


def _target_outline(report: HandEyeReport) -> Array:
    """Return the closed outline (5, 3) of the target's points in its frame [m]."""
    points = report.target.points_board
    (x0, y0, _), (x1, y1, _) = points.min(0), points.max(0)
    return np.array([[x0, y0, 0], [x1, y0, 0], [x1, y1, 0], [x0, y1, 0], [x0, y0, 0]])


def _corner_looks(ax: Any, points: Array, length: float) -> None:
    """Finish the view in space."""
    _triad(ax, np.zeros(3), np.eye(3), length, "base", np.array([-0.4, -0.4, -0.2]) * length)
    _equal_box(ax, points, 0.98)
    ax.view_init(elev=24, azim=-60)
    ax.set_title("From a corner", y=1.05, pad=0)
    ax.set_xlabel("base x [m]", labelpad=-3)
    ax.set_ylabel("base y [m]", labelpad=-3)
    ax.set_zlabel("base z [m]", labelpad=-4)
    ax.tick_params(labelsize=7, pad=-2)
    ax.locator_params(nbins=5)


def _above_looks(ax: Any, points: Array, length: float) -> None:
    """Finish the view from above."""
    _flat_axes(ax, np.zeros(2), np.eye(3)[:, :2], length)
    low, high = points[:, :2].min(0), points[:, :2].max(0)
    margin = 0.06 * float((high - low).max())
    ax.text(-0.4 * margin, -0.7 * margin, "base", ha="right", va="top", fontsize=8,
            fontweight="bold", color=style.INK)  # fmt: skip
    x, y = (low[0] - 3 * margin, high[0] + margin), (low[1] - 2 * margin, high[1] + margin)
    ax.set(xlim=x, ylim=y, aspect="equal")
    ax.set(title="From above", xlabel="base x [m]", ylabel="base y [m]")
    style.grid(ax)
