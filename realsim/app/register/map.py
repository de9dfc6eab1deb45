"""The table from above: footprints of the objects, their numbers, and how sure their places are."""

from collections.abc import Mapping
from typing import Any

import numpy as np

from realsim.app.register.results import Registered
from realsim.arrays import Array
from realsim.geometry import se3
from realsim.pages.plots import png
from realsim.records import ObjectModel, ObjectPose
from realsim.scanning.scale.pictures import INK, VERDICT_COLORS

DPI = 110
MAGNIFIED = (1, 2, 5, 10, 20, 50, 100)
"""By which the ellipses are enlarged: a tenth of a millimetre is nothing on a map of a table."""
WANTED_SHARE = 0.12
"""The largest ellipse should be about so much of the objects' median size."""
SIGMAS = 3.0


def map_png(result: Registered, models: Mapping[int, ObjectModel]) -> bytes:
    """Return the map as PNG; the same registration gives the same bytes.

    Args:
        result: what was found; at least one object.
        models: obj_id -> model.
    """
    from matplotlib.figure import Figure

    plane = result.scene.plane
    T_map_world = np.eye(4) if plane is None else se3.invert(plane.T_world_table)
    figure = Figure(figsize=(9.0, 7.0), dpi=DPI, layout="constrained")
    ax: Any = figure.subplots()
    magnified = _magnification(result, models)
    for o in result.scene.objects:
        _draw_object(ax, o, models[o.obj_id], T_map_world, magnified)
    ax.set_aspect("equal")
    ax.margins(0.08)
    ax.grid(True, color="#e6eaee", lw=0.7)
    ax.set_axisbelow(True)
    ax.tick_params(labelsize=8, colors=INK)
    frame = "world" if plane is None else "table"
    ax.set_xlabel(f"x of the {frame} [mm]", fontsize=9, color=INK)
    ax.set_ylabel(f"y of the {frame} [mm]", fontsize=9, color=INK)
    ax.spines[["top", "right"]].set_visible(False)
    times = f", drawn {magnified} times as large" if magnified > 1 else ""
    ax.set_title(
        f"Objects from above; ellipses: {SIGMAS:g} sigma of their place{times}", fontsize=10,
        color=INK, loc="left",
    )  # fmt: skip
    _legend(figure, result)
    return png(figure)


def footprint_mm(model: ObjectModel, T_map_obj: Array) -> Array:
    """Return the convex outline (N, 2) of an object seen from above [mm]."""
    from scipy.spatial import ConvexHull

    points = 1e3 * se3.transform(T_map_obj, model.mesh.vertices)[:, :2]
    return points[ConvexHull(points).vertices]


def place_covariance_mm2(pose: ObjectPose, model: ObjectModel, T_map_world: Array) -> Array | None:
    """Return the covariance (2, 2) of an object's middle in the map's plane [mm^2].

    A right twist (w, v) moves the middle c, in the object's frame, by w x c + v.
    """
    C = pose.covariance
    if C is None or not np.all(np.isfinite(C)):
        return None
    J = np.concatenate([-se3.hat(model.mesh.bounds.mean(0)), np.eye(3)], axis=1)
    R = (T_map_world @ pose.T_world_obj)[:3, :3]
    return 1e6 * (R @ J @ C @ J.T @ R.T)[:2, :2]


def _magnification(result: Registered, models: Mapping[int, ObjectModel]) -> int:
    """Return by how much ellipses are enlarged, so that the largest can be seen."""
    largest, sizes = 0.0, [0.0]
    for o in result.scene.objects:
        C = place_covariance_mm2(o, models[o.obj_id], np.eye(4))
        sizes.append(1e3 * float(np.median(models[o.obj_id].mesh.extent)))
        if C is not None:
            largest = max(largest, SIGMAS * float(np.sqrt(np.linalg.eigvalsh(C)[-1])))
    if largest <= 0.0:
        return 1
    wanted = WANTED_SHARE * float(np.median(sizes[1:])) / largest
    return max(m for m in MAGNIFIED if m <= max(wanted, 1.0))


def _draw_object(
    ax: Any, pose: ObjectPose, model: ObjectModel, T_map_world: Array, magnified: int
) -> None:
    """Draw footprint, number, name and ellipse of one object."""
    from matplotlib.patches import Ellipse, Polygon

    T = T_map_world @ pose.T_world_obj
    color = VERDICT_COLORS[pose.verdict]
    outline = footprint_mm(model, T)
    ax.add_patch(Polygon(outline, closed=True, facecolor=color, alpha=0.18, lw=0))
    ax.add_patch(Polygon(outline, closed=True, fill=False, edgecolor=color, lw=1.4))
    ax.update_datalim(outline)
    x, y = 1e3 * se3.transform(T, model.mesh.bounds.mean(0)[None])[0, :2]
    C = place_covariance_mm2(pose, model, T_map_world)
    if C is not None:
        lengths, axes = np.linalg.eigh(C)
        wide, high = 2 * SIGMAS * magnified * np.sqrt(np.maximum(lengths[::-1], 0.0))
        angle = float(np.degrees(np.arctan2(axes[1, 1], axes[0, 1])))
        ax.add_patch(Ellipse((x, y), wide, high, angle=angle, fill=False, edgecolor=INK, lw=1.1))
        ax.plot([x], [y], ".", color=INK, ms=3)
    low = outline[:, 1].min()
    ax.annotate(
        f"{pose.instance} {model.name}", (outline[:, 0].mean(), low), xytext=(0, -3),
        textcoords="offset points", ha="center", va="top", fontsize=8, color=color,
    )  # fmt: skip


def _legend(figure: Any, result: Registered) -> None:
    """Name the colours."""
    from matplotlib.patches import Patch

    present = [v for v in VERDICT_COLORS if any(o.verdict == v for o in result.scene.objects)]
    handles: list[Any] = [Patch(color=VERDICT_COLORS[v], label=v) for v in present]
    figure.legend(handles=handles, loc="outside lower left", ncols=5, fontsize=8, frameon=False)
