"""The views of a model's sheet, and the lines on them: rims, axes, lengths."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Any

import numpy as np

from realsim.arrays import Array, Array32, Image, Mask, UInt8
from realsim.geometry import camera, se3
from realsim.geometry.mesh_shape import hull_triangles, welded
from realsim.models.model_records import Symmetries
from realsim.records import CameraIntrinsics, Mesh
from realsim.rendering.photo import Lighting, PhotoRenderer
from realsim.rendering.rays import PlacedMesh

PAPER, INK, MUTED = "#f7f7f5", "#22303c", "#6b7a88"
PAPER_RGB = (247, 247, 245)
PART_COLORS = (
    (0, 158, 230), (230, 159, 0), (0, 180, 130), (240, 210, 60), (213, 94, 0), (204, 121, 167),
    (86, 110, 255), (255, 140, 180), (0, 200, 200), (160, 210, 70), (180, 120, 60), (160, 90, 220),
)  # fmt: skip
"""Okabe and Ito's colour-blind-safe colours first."""
DRAWN_M = 0.1
"""Half the diagonal of the box of what is drawn [m]: the renderer knows lengths (where shadows
start), and a mesh may have any."""
FAR = 9.0
"""Distance of the camera in half diagonals: far, so that a scale bar holds all over the object."""
FILL = 0.74
"""Share of the picture that is filled, in the direction in which it is filled most."""
GAMMA = 2.2
BARE = (196, 200, 206)
"""Colour of a mesh that has none."""
DEPTH_SLACK = 0.006
"""By how much a line may lie behind the surface and still count as in front [half diagonals]."""
STEPS = 160
"""Pieces per line: each is drawn full in front of the surface and faint behind it."""


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class View:
    """A camera that looks at a model."""

    intrinsics: CameraIntrinsics
    T_obj_cam: Array
    """(4, 4) camera in the model's frame, drawn size [m]."""
    px_per_m: float
    """Pixels per metre of the drawn size at the middle of the box."""


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Layer:
    """Lines, labels and dots over a view; drawn size [m]."""

    lines: tuple[Array, ...] = ()
    """Polylines (N, 3)."""
    labels: tuple[tuple[Array, str], ...] = ()
    """(3,) places and texts."""
    color: str = INK
    width: float = 1.2
    hidden: float = 0.28
    """Opacity of what lies behind the surface."""
    views: tuple[int, ...] = ()
    """Numbers of the views it is drawn in; empty = all."""
    marker: str = ""
    """Drawn at the first point of every line instead of the line; 'mass' = a centre of mass."""


def drawn_size(mesh: Mesh) -> tuple[Mesh, float]:
    """Return the mesh at the size in which it is drawn, and the factor."""
    factor = DRAWN_M / (0.5 * float(np.linalg.norm(mesh.extent)))
    painted = mesh
    if mesh.colors is None and mesh.texture is None:
        painted = replace(mesh, colors=painted_all(mesh.vertices, BARE))
    return replace(painted, vertices=mesh.vertices * factor), factor


def painted_all(vertices: Array, color: tuple[int, int, int]) -> UInt8:
    """Return one colour for every vertex (V, 3)."""
    return np.tile(np.array(color, dtype=np.uint8), (len(vertices), 1))


def view_of(points: Array, direction: Sequence[float], size: tuple[int, int]) -> View:
    """Return the camera that sees all of the points (N, 3) [m, drawn size] from a direction."""
    width, height = size
    middle = 0.5 * (points.min(axis=0) + points.max(axis=0))
    away = np.asarray(direction, dtype=np.float64)
    distance = FAR * DRAWN_M
    T_obj_cam = se3.look_at(middle + distance * away / np.linalg.norm(away), middle)
    seen = se3.transform(se3.invert(T_obj_cam), points)
    slope = seen[:, :2] / seen[:, 2:]
    span = np.ptp(slope, axis=0)
    focal = FILL * float(min(width / span[0], height / span[1]))
    # The middle of what is seen lies in the middle of the picture.
    center = 0.5 * np.array([width, height]) - 0.5 - focal * (slope.min(axis=0) + 0.5 * span)
    intrinsics = CameraIntrinsics(
        width=width, height=height, fx=focal, fy=focal, cx=float(center[0]), cy=float(center[1])
    )
    return View(intrinsics=intrinsics, T_obj_cam=T_obj_cam, px_per_m=focal / distance)


def rendered(meshes: Sequence[Mesh], view: View) -> tuple[Image, Array32]:
    """Return the shaded picture on paper and its depth; the light comes over the left shoulder."""
    R = view.T_obj_cam[:3, :3]
    sun = R @ np.array([-0.45, -0.75, -0.75])
    r, g, b = (float((c / 255.0) ** GAMMA) for c in PAPER_RGB)
    paper = (r, g, b)
    light = Lighting(
        sun_direction=(float(sun[0]), float(sun[1]), float(sun[2])),
        sun=(0.62, 0.60, 0.57), sky=(0.40, 0.41, 0.43), ground=(0.27, 0.26, 0.26),
        horizon=paper, zenith=paper, floor=paper, specular=0.05, gamma=GAMMA, samples=3,
        psf_px=0.0,
    )  # fmt: skip
    placed = [PlacedMesh(k, mesh, np.eye(4)) for k, mesh in enumerate(meshes)]
    photo = PhotoRenderer(placed, light).render(view.intrinsics, view.T_obj_cam)
    return photo.rgb, photo.depth_m


def parts_mesh(vertices: Array, color: tuple[int, int, int]) -> Mesh:
    """Return the hull of a convex part, with flat faces in one colour."""
    points, triangles = hull_triangles(vertices)
    # Slightly smaller, so that neighbours are told apart by a seam.
    middle = vertices.mean(axis=0)
    corners = middle + SEAM * (points[triangles.ravel()] - middle)
    faces = np.arange(len(corners), dtype=np.int32).reshape(-1, 3)
    return Mesh(vertices=corners, faces=faces, colors=painted_all(corners, color))


SEAM = 0.985


def draw_layer(ax: Any, layer: Layer, view: View, depth: Array32) -> None:
    """Draw a layer over a rendered view: full in front of the surface, faint behind it."""
    from matplotlib.collections import LineCollection

    T_cam_obj = se3.invert(view.T_obj_cam)
    if layer.marker == "mass":
        _mass_mark(ax, camera.project(view.intrinsics, se3.transform(T_cam_obj, layer.lines[0])))
        return
    pieces: list[Array] = []
    opacity: list[float] = []
    for line in layer.lines:
        points = _subdivided(line)
        seen = se3.transform(T_cam_obj, points)
        uv = camera.project(view.intrinsics, seen)
        behind = _is_behind(uv, seen[:, 2], depth)
        faint = behind[:-1] | behind[1:]
        ends = [0, *(np.flatnonzero(np.diff(faint)) + 1), len(faint)]
        pieces += [uv[a : b + 1] for a, b in pairwise(ends)]
        opacity += [layer.hidden if faint[a] else 1.0 for a in ends[:-1]]
    if pieces:
        runs = LineCollection(
            pieces, colors=layer.color, linewidths=layer.width, alpha=np.array(opacity),
            capstyle="butt",
        )  # fmt: skip
        ax.add_collection(runs)
    for place, text in layer.labels:
        u, v = camera.project(view.intrinsics, se3.transform(T_cam_obj, place[None]))[0]
        box = {"boxstyle": "round,pad=0.16", "fc": PAPER, "ec": "none", "alpha": 0.85}
        ax.text(u, v, text, fontsize=8.5, color=layer.color, ha="center", va="center", bbox=box,
                clip_on=True)  # fmt: skip


def _subdivided(line: Array) -> Array:
    """Return a polyline (N, 3) with many short pieces."""
    each = max(1, STEPS // max(1, len(line) - 1))
    step = np.linspace(0, 1, each, endpoint=False)[:, None]
    parts = [a + step * (b - a) for a, b in pairwise(line)]
    return np.concatenate([*parts, line[-1:]])


def _is_behind(uv: Array, z: Array, depth: Array32) -> Mask:
    """Return which points lie behind the drawn surface."""
    height, width = depth.shape
    column = np.clip(np.rint(uv[:, 0]).astype(int), 0, width - 1)
    row = np.clip(np.rint(uv[:, 1]).astype(int), 0, height - 1)
    surface = depth[row, column]
    return (surface > 0) & (z > surface + DEPTH_SLACK * DRAWN_M)


def _mass_mark(ax: Any, uv: Array) -> None:
    """Draw the sign of a centre of mass: a circle with two black quarters."""
    from matplotlib.patches import Circle, Wedge

    u, v = float(uv[0, 0]), float(uv[0, 1])
    radius = 8.0
    ax.add_patch(Circle((u, v), radius, fc="white", ec=INK, lw=1.3, zorder=9))
    for first in (0, 180):
        ax.add_patch(Wedge((u, v), radius, first, first + 90, fc=INK, ec="none", zorder=10))


ROUND_LENGTHS = (1.0, 2.0, 5.0)
BAR_SHARE = 0.22
"""Greatest length of the scale bar [share of the picture's width]."""
BEYOND = 1.25
"""How far an axis is drawn beyond the box [of its reach inside]."""
MOST_AXES = 7
"""Discrete axes drawn; a cube has 13, and more than a few hide the object."""
AXIS_COLORS = {0: "#7b2cbf", 2: "#0077b6", 3: "#2a9d8f", 4: "#d1495b"}
"""By the order of the rotation; 0 = continuous."""
OTHER_AXIS = "#b5651d"
RIM = "#e01b24"
SAME_AXIS = 1e-3
"""Axes whose directions differ by less (sine) are one."""


def box_layer(mesh: Mesh, factor: float, *, metric: bool) -> Layer:
    """Return the box with its three sizes, in the drawn size."""
    low, high = mesh.bounds * factor
    corners = np.array([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)])
    at = low + corners * (high - low)
    edges = [(a, b) for a in range(8) for b in range(a + 1, 8) if _is_edge(corners[a], corners[b])]
    lines = tuple(at[[a, b]] for a, b in edges)
    unit, times = (" mm", 1e3) if metric else ("", 1.0)
    near = np.array([high[0], low[1], low[2]])
    middle = 0.5 * (low + high)
    labels: list[tuple[Array, str]] = []
    for axis, name in enumerate("xyz"):
        # The upright edge on the left: no face of the object lies behind its label.
        place = np.array([low[0], low[1], 0.0]) if name == "z" else near.copy()
        place[axis] = middle[axis]
        labels.append((place, f"{name} {_short(times * float(mesh.extent[axis]))}{unit}"))
    return Layer(lines=lines, labels=tuple(labels), color=MUTED, width=0.8, views=(0,))


def _is_edge(a: Array, b: Array) -> bool:
    return float(np.abs(a - b).sum()) == 1.0


def _short(value: float) -> str:
    return f"{value:.1f}" if 10 <= value < 1e4 else f"{value:.4g}"


def rim_layer(mesh: Mesh, factor: float) -> Layer:
    """Return the edges that only one face has, in red; empty where the mesh is closed."""
    vertices, faces = welded(mesh)
    edges = np.sort(np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]]), axis=1)
    unique, count = np.unique(edges, axis=0, return_counts=True)
    lines = tuple(vertices[e] * factor for e in unique[count == 1])
    return Layer(lines=lines, color=RIM, width=2.0, hidden=0.45)


def symmetry_layers(mesh: Mesh, symmetries: Symmetries, factor: float) -> list[Layer]:
    """Return the axes of the symmetries with their orders, drawn in the second view."""
    layers: list[Layer] = []
    middle = mesh.bounds.mean(axis=0)
    for direction, point in symmetries.axes[:1]:
        line = _axis_line(np.asarray(direction), np.asarray(point), middle, mesh)
        label = "any turn" if len(symmetries.axes) == 1 else "any turn, any axis"
        layers.append(_axis_layer(line * factor, AXIS_COLORS[0], label))
    if symmetries.axes:
        return layers
    for order, direction, point in rotation_axes(symmetries.discrete)[:MOST_AXES]:
        line = _axis_line(direction, point, middle, mesh)
        color = AXIS_COLORS.get(order, OTHER_AXIS)
        layers.append(_axis_layer(line * factor, color, f"{order}x"))
    return layers


def _axis_layer(line: Array, color: str, label: str) -> Layer:
    return Layer(
        lines=(line,), labels=((line[1], label),), color=color, width=1.8, hidden=0.4, views=(1,)
    )


def _axis_line(direction: Array, point: Array, middle: Array, mesh: Mesh) -> Array:
    """Return the two ends of an axis, a little beyond the object."""
    d = direction / np.linalg.norm(direction)
    foot = point + ((middle - point) @ d) * d
    # The upper end carries the label.
    d = d if d[2] >= 0 else -d
    half = BEYOND * float(np.abs((mesh.vertices - foot) @ d).max())
    return np.stack([foot - half * d, foot + half * d])


def rotation_axes(discrete: Array) -> list[tuple[int, Array, Array]]:
    """Return (order, direction, point) of every axis of discrete symmetries, greatest order first.

    Args:
        discrete: (S, 4, 4) rotations about axes.
    """
    found: list[tuple[list[float], Array, Array]] = []
    for S in discrete:
        twist = se3.log_so3(S[:3, :3])
        angle = float(np.linalg.norm(twist))
        if angle < SAME_AXIS:
            continue
        d = twist / angle
        # A point of the axis stays: (I - R) p = t; the least-squares solution is nearest to zero.
        point = np.linalg.lstsq(np.eye(3) - S[:3, :3], S[:3, 3], rcond=1e-6)[0]
        for angles, e, _ in found:
            if float(np.linalg.norm(np.cross(d, e))) < SAME_AXIS:
                angles.append(angle)
                break
        else:
            found.append(([angle], d, point))
    axes = [(round(2 * np.pi / min(angles)), d, p) for angles, d, p in found]
    return sorted(axes, key=lambda a: -a[0])


def scale_bar(ax: Any, view: View, factor: float, size: tuple[int, int], *, metric: bool) -> None:
    """Draw a bar of a round length at the lower right, true at the middle of the object."""
    width, height = size
    unit, times = ("mm", 1e3) if metric else ("units", 1.0)
    px_per_unit = view.px_per_m * factor / times
    longest = BAR_SHARE * width / px_per_unit
    power = 10.0 ** np.floor(np.log10(longest))
    length = max(r * power for r in ROUND_LENGTHS if r * power <= longest)
    right, y = width - 24, height - 26
    left = right - length * px_per_unit
    ax.plot([left, right], [y, y], color=INK, lw=3, solid_capstyle="butt")
    for x in (left, right):
        ax.plot([x, x], [y - 5, y + 5], color=INK, lw=1.2)
    ax.text(0.5 * (left + right), y - 13, f"{length:g} {unit}", fontsize=9, color=INK,
            ha="center", va="center")  # fmt: skip
