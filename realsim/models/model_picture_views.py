"""The shaded views of a model's sheet, and lines in space drawn over them."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from realsim.geometry import camera, se3
from realsim.records import CameraIntrinsics, Mesh
from realsim.rendering.photo import Lighting, PhotoRenderer
from realsim.rendering.rays import PlacedMesh

Array = NDArray[np.float64]
Image = NDArray[np.uint8]
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


def painted_all(vertices: Array, color: tuple[int, int, int]) -> NDArray[np.uint8]:
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


def rendered(meshes: Sequence[Mesh], view: View) -> tuple[Image, NDArray[np.float32]]:
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
    from scipy.spatial import ConvexHull

    hull: Any = ConvexHull(vertices)
    triangles: Array = vertices[hull.simplices]
    normals = np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0])
    inward = np.einsum("ij,ij->i", normals, hull.equations[:, :3]) < 0
    triangles[inward] = triangles[inward][:, ::-1]
    # Slightly smaller, so that neighbours are told apart by a seam.
    middle = vertices.mean(axis=0)
    corners = middle + SEAM * (triangles.reshape(-1, 3) - middle)
    faces = np.arange(len(corners), dtype=np.int32).reshape(-1, 3)
    return Mesh(vertices=corners, faces=faces, colors=painted_all(corners, color))


SEAM = 0.985


def draw_layer(ax: Any, layer: Layer, view: View, depth: NDArray[np.float32]) -> None:
    """Draw a layer over a rendered view: full in front of the surface, faint behind it."""
    from matplotlib.collections import LineCollection

    T_cam_obj = se3.invert(view.T_obj_cam)
    if layer.marker == "mass":
        _mass_mark(ax, camera.project(view.intrinsics, se3.transform(T_cam_obj, layer.lines[0])))
        return
    pieces: list[Array] = []
    opacity: list[Array] = []
    for line in layer.lines:
        points = _subdivided(line)
        seen = se3.transform(T_cam_obj, points)
        uv = camera.project(view.intrinsics, seen)
        behind = _is_behind(uv, seen[:, 2], depth)
        pieces.append(np.stack([uv[:-1], uv[1:]], axis=1))
        opacity.append(np.where(behind[:-1] | behind[1:], layer.hidden, 1.0))
    if pieces:
        runs = LineCollection(
            list(np.concatenate(pieces)), colors=layer.color, linewidths=layer.width,
            alpha=np.concatenate(opacity), capstyle="butt",
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


def _is_behind(uv: Array, z: Array, depth: NDArray[np.float32]) -> NDArray[np.bool_]:
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
