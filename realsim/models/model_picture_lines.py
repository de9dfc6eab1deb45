"""What is drawn over the views of a model's sheet: box, scale bar, symmetry axes, open rims."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from realsim.geometry import se3
from realsim.geometry.mesh_shape import welded
from realsim.models.model_picture_views import INK, MUTED, Layer, View
from realsim.models.model_records import Symmetries
from realsim.records import Mesh

Array = NDArray[np.float64]
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


def mass_layer(center: Array) -> Layer:
    """Return the mark of the centre of mass (3,), in the drawn size."""
    return Layer(lines=(center[None],), marker="mass")


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
