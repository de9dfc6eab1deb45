"""A picture of what physics did to a scene: outlines before and after, from above and the side."""

from typing import Any

import numpy as np

from realsim.arrays import Array, Int32
from realsim.geometry import se3
from realsim.geometry.mesh import welded_mesh
from realsim.pages.plots import png
from realsim.records import Mesh
from realsim_sim_bridge.scenes.school_scene import SchoolScene
from realsim_sim_bridge.scenes.stable_state import ObjectStand, Standing, StandReport

COLORS: dict[Standing, str] = {
    "stands": "#5b7f95",
    "jumps": "#d1495b",
    "falls": "#e07a1f",
    "inside another": "#8e44ad",
    "floats": "#2a9d8f",
}
VIEWS = (("from above", 0, 1, 2), ("from the side", 0, 2, 1))
"""Title, the axes drawn to the right and upwards, and the axis looked along."""
MOST_FACES = 8_000
"""Most faces of a mesh that is drawn; a picture of 1600 pixels shows no more."""


def stand_picture(scene: SchoolScene, report: StandReport) -> bytes:
    """Return a PNG: dashed grey before, filled and coloured by verdict after, arrows for the way.

    Table's frame, millimetres.
    """
    from matplotlib.figure import Figure

    figure = Figure(figsize=(10, 12), dpi=110, layout="constrained")
    meshes = {i: _light(m.mesh) for i, m in scene.models.items()}
    axes: Any = figure.subplots(len(VIEWS), 1, sharex=True)
    for ax, (title, right, up, along) in zip(axes, VIEWS, strict=True):
        for o, stand in zip(scene.scene.objects, report.objects, strict=True):
            _draw(ax, scene, meshes[o.obj_id], stand, (right, up, along))
        ax.set_title(title)
        ax.set_xlabel(f"{'xyz'[right]} of the table [mm]")
        ax.set_ylabel(f"{'xyz'[up]} of the table [mm]")
        ax.set_aspect("equal")
        ax.autoscale_view()
        if up == 2:
            ax.axhline(0.0, color="#333333", linewidth=1.2)
        ax.grid(alpha=0.2)
    _legend(figure, report)
    # Without Matplotlib's version and a date the same scene gives the same bytes; by this name the
    # command knows a picture of its own, which it may replace.
    return png(figure, "realsim settle")


def _light(mesh: Mesh) -> Mesh:
    """Return the bare surface, thinned out where it is fine."""
    from realsim.models.simplify import simplified

    return simplified(welded_mesh(mesh), MOST_FACES)


def _draw(
    ax: Any, scene: SchoolScene, mesh: Mesh, stand: ObjectStand, axes: tuple[int, int, int]
) -> None:
    from matplotlib.collections import LineCollection, PolyCollection
    from matplotlib.patheffects import withStroke

    right, up, along = axes
    color, is_moved = COLORS[stand.verdict], stand.verdict != "stands"
    before, after = (
        1e3 * se3.transform(scene.T_table_world @ T, mesh.vertices)
        for T in (stand.T_world_before, stand.T_world_after)
    )
    flat: Any = after[mesh.faces][:, :, [right, up]]
    ax.add_collection(PolyCollection(flat, facecolors=color, edgecolors="none", alpha=0.25))
    lines = outline(after, mesh.faces, along)[:, :, [right, up]]
    ax.add_collection(LineCollection(list(lines), colors=color, linewidths=0.8))
    if is_moved:
        lines = outline(before, mesh.faces, along)[:, :, [right, up]]
        ax.add_collection(
            LineCollection(list(lines), colors="#777777", linewidths=0.6, linestyles="dashed")
        )
    start, end = before.mean(axis=0)[[right, up]], after.mean(axis=0)[[right, up]]
    if is_moved and np.linalg.norm(end - start) > 1.0:
        arrow = {"arrowstyle": "->", "color": color, "lw": 2.0}
        ax.annotate("", xy=end, xytext=start, arrowprops=arrow, zorder=4)
    words = ax.annotate(
        stand.name, xy=end, color=color, ha="center", va="bottom", fontsize=8, zorder=5
    )
    words.set_path_effects([withStroke(linewidth=2.5, foreground="white")])


def outline(vertices: Array, faces: Int32, along: int) -> Array:
    """Return the edges (E, 2, 3) between a face towards the viewer and one away, and open edges."""
    a, b, c = np.moveaxis(vertices[faces], 1, 0)
    towards = np.cross(b - a, c - a)[:, along] > 0
    edges = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]]).astype(np.int64)
    facing = np.tile(towards, 3).astype(np.int64)
    key = edges.min(axis=1) * len(vertices) + edges.max(axis=1)
    unique, index, counts = np.unique(key, return_inverse=True, return_counts=True)
    seen = np.bincount(index, weights=facing, minlength=len(unique))
    chosen = (counts == 1) | ((seen > 0) & (seen < counts))
    return vertices[np.stack([unique[chosen] // len(vertices), unique[chosen] % len(vertices)], 1)]


def _legend(figure: Any, report: StandReport) -> None:
    from matplotlib.lines import Line2D
    from matplotlib.patches import Patch

    handles: list[Any] = [
        Patch(color=color, label=f"{verdict} ({n})", alpha=0.6)
        for verdict, color in COLORS.items()
        if (n := sum(o.verdict == verdict for o in report.objects))
    ]
    handles.append(Line2D([], [], color="#777777", linestyle="dashed", label="before"))
    figure.legend(handles=handles, loc="outside lower center", ncols=len(handles), frameon=False)
    worst = [o for o in report.objects if o.verdict != "stands"]
    title = "every object stands" if not worst else f"{len(worst)} of {len(report.objects)} move"
    figure.suptitle(f"{title} when physics runs for {report.simulated_s:.1f} s")
