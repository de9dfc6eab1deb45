"""Pictures of a school: every object as it stands, with its grasps in the colour of their score."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from io import BytesIO

import numpy as np
from numpy.typing import NDArray

from realsim.app.school_tables import Names, named
from realsim.geometry import se3
from realsim.records import STAGES, GraspSet, Scene

Array = NDArray[np.float64]
Rgb = NDArray[np.uint8]

SHEET, MARGINS = "school_sheet.png", "school_margins.png"
PANEL = (640, 480)
"""Width and height of one object's picture [px]."""
COLUMNS = 3
MOST_GRASPS = 40
"""Grippers in one picture: the best and the worst; more hide the object."""
DIRECTION = (0.9, -1.5, 1.1)
"""From the object to the camera, table frame."""


def sheet_png(sets: Sequence[GraspSet], models: Names, scene: Scene) -> bytes:
    """Return all objects with their grasps, red to green by score, as one PNG; b'' without any.

    Args:
        sets: the grasps.
        models: the objects by id.
        scene: where they stand; upright by its table where it has one.
    """
    import cv2

    from realsim.rendering.overlay import contact_sheet

    poses = {o.instance: o.T_world_obj for o in scene.objects}
    up = np.eye(4) if scene.plane is None else se3.invert(scene.plane.T_world_table)
    shown = [s for s in sets if s.instance in poses and s.obj_id in models]
    if not shown:
        return b""
    panels = [_panel(s, models, up @ poses[s.instance]) for s in shown]
    sheet = contact_sheet(panels, COLUMNS, [_caption(s, models) for s in shown])
    return bytes(cv2.imencode(".png", sheet[..., ::-1])[1].tobytes())


def _caption(s: GraspSet, models: Names) -> str:
    """Return name and counts of an object."""
    held = int(np.sum(s.base_scores >= 1.0))
    return f"{named(s, models)}: {held} of {len(s)} hold, {int(s.good.sum())} good"


def shown_grasps(s: GraspSet) -> NDArray[np.int64]:
    """Return rows of the best and the worst tried grasps, half each; without any, of the others."""
    tried = np.nonzero(~np.isnan(s.slip_m[:, 0]))[0]
    if len(tried) == 0:
        return np.arange(min(len(s), MOST_GRASPS), dtype=np.int64)
    order = tried[np.argsort(-s.scores[tried], kind="stable")]
    half = MOST_GRASPS // 2
    if len(order) > MOST_GRASPS:
        order = np.concatenate([order[:half], order[-half:]])
    return order.astype(np.int64)


def _panel(s: GraspSet, models: Names, T_table_obj: Array) -> Rgb:
    """Return one object and its grasps."""
    from realsim.models.model_picture_views import drawn_size, rendered, view_of
    from realsim.rendering.overlay import draw_grasps, draw_legend, gripper_lines, score_color

    mesh = models[s.obj_id].mesh
    placed = replace(mesh, vertices=se3.transform(T_table_obj, mesh.vertices))
    drawn, factor = drawn_size(placed)
    rows = shown_grasps(s)
    hands = [
        se3.transform(T_table_obj @ s.Ts_obj_grasp[i], line)
        for i in rows
        for line in gripper_lines(float(s.widths_m[i]))
    ]
    view = view_of(np.concatenate([drawn.vertices, *(factor * h for h in hands)]), DIRECTION, PANEL)
    rgb = rendered([drawn], view)[0]
    # The renderer's camera stands in a world of its own size; the grasps are in metres.
    T_table_cam = view.T_obj_cam.copy()
    T_table_cam[:3, 3] /= factor
    T_cam_obj = se3.invert(T_table_cam) @ T_table_obj
    rgb = draw_grasps(rgb, view.intrinsics, T_cam_obj, s, rows)
    legend = [
        ("holds", score_color(1.0)),
        ("half way", score_color(0.5)),
        ("lost", score_color(0.0)),
    ]
    return draw_legend(rgb, legend)


def margins_png(sets: Sequence[GraspSet], models: Names) -> bytes:
    """Return the share of each object's tested grasps that survive a friction and a force.

    The score alone is the right end of the curves; b'' where nothing was swept.
    """
    columns: Mapping[str, str] = {
        "least_friction": "friction", "least_force_n": "force of a finger [N]"
    }  # fmt: skip
    swept = [
        s for s in sets if all(np.isfinite(s.measures.get(c, np.zeros(0))).any() for c in columns)
    ]
    if not swept:
        return b""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(9.0, 3.6), dpi=110, layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.subplots(1, len(columns))
    for ax, (measure, label) in zip(axes, columns.items(), strict=True):
        for s in swept:
            least = np.sort(s.measures[measure][~np.isnan(s.measures[measure])])
            levels = np.unique(least[np.isfinite(least)])
            share = [100.0 * np.mean(least <= v) for v in levels]
            ax.step(levels, share, where="post", label=named(s, models), linewidth=1.2)
        ax.set_xscale("log")
        ax.set_ylim(0, 100)
        ax.set_xlabel(label, fontsize=8)
        ax.set_title(f"Grasps [%] that pass all {len(STAGES)} stages", fontsize=9, loc="left")
        ax.tick_params(labelsize=8)
    axes[0].legend(fontsize=7, frameon=False)
    buffer = BytesIO()
    figure.savefig(buffer, format="png")
    return buffer.getvalue()
