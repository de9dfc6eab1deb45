"""One object of the School's picture sheet: its surface, its grasps in their labels' colours."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from realsim.arrays import Array, Int64
from realsim.formats.grasps.scene_grasps import executed, labelled
from realsim.geometry import se3
from realsim.models.model_picture_views import (
    INK,
    MUTED,
    PAPER,
    Layer,
    View,
    draw_layer,
    drawn_size,
    rendered,
    view_of,
)
from realsim.records import STAGES, GraspSet, Mesh
from realsim.rendering.overlay import dashed, evenly_ranked, score_hex
from realsim_sim_bridge.school.measure_statistics import mean_label

Box = tuple[float, float, float, float]
"""Left, top, width and height of a part of the sheet [px]."""
DIRECTION = (0.9, -1.5, 1.0)
"""From the object to the camera; z is up."""
MOST_HANDS = 40
"""Hands drawn on an object: more hide it."""
FINGER_M = 0.035
STEM_M = 0.02
"""Lengths of a drawn hand [m]: shorter than the Panda's, so that the object is seen."""
FINGER_SHARE = 0.22
"""Longest finger as a share of the object's diagonal: small objects get small hands."""
DASH_SHARE = 0.14
"""Dash of a hand whose p_hold is not sure, as a share of the finger."""
HAND_WIDTH = 1.5
"""Width of a drawn hand's lines [pt]."""
STOPS: tuple[tuple[str, str], ...] = (
    ("not tried", "#d3d8de"),
    ("no trajectory", "#8793a1"),
    *((f"failed: {stage}", score_hex(k / len(STAGES))) for k, stage in enumerate(STAGES)),
    ("passed all", score_hex(1.0)),
)
"""Where a grasp stopped, and its colour: that of the base score it has there."""
ZOOM = 1.24
"""The views leave a quarter of the picture free, for labels; here is none."""
TEXT_PX = 64
"""Height of the text below a picture [px]."""
BAR_PX = 16
"""Height of the bar of where the grasps stopped [px]."""
NARROWEST = 0.075
"""Share of the bar from which a part carries its number."""


def stops_of(s: GraspSet) -> Int64:
    """Return (N,) where each grasp stopped: its number in STOPS."""
    judged = ~np.isnan(s.scores)
    passed = np.rint(np.nan_to_num(s.base_scores) * len(STAGES)).astype(np.int64)
    nowhere = ~s.reachable & ~executed(s)
    return np.where(judged, np.where(nowhere, 1, 2 + passed), 0)


def shown_rows(s: GraspSet) -> Int64:
    """Return the rows drawn: evenly through the labelled grasps; where none has a label: of all."""
    rows = np.flatnonzero(labelled(s))
    return evenly_ranked(s, MOST_HANDS, rows if len(rows) else None)


def draw_object(figure: Any, box: Box, s: GraspSet, mesh: Mesh, name: str, T_up_obj: Array) -> None:
    """Draw one object into its part of the sheet.

    Args:
        figure: the sheet.
        box: its part.
        s: the grasps.
        mesh: the object [m].
        name: of the object.
        T_up_obj: (4, 4) object in a frame whose z axis is up [m].
    """
    left, top, width, height = box
    size = (round(width), round(height - TEXT_PX - BAR_PX))
    ax = axes_at(figure, (left, top, *size))
    ax.set_axis_off()
    ax.set_xlim(-0.5, size[0] - 0.5)
    ax.set_ylim(size[1] - 0.5, -0.5)
    _picture(ax, s, mesh, T_up_obj, size)
    below = top + size[1]
    text_at(
        figure, left + 4, below + 16, f"{s.instance}  {shortened(name, width)}", 12, INK, bold=True
    )
    text_at(figure, left + 4, below + 40, _figures(s), 10, MUTED)
    _bar(axes_at(figure, (left + 4, below + TEXT_PX - 6, width - 8, BAR_PX)), stops_of(s))


def _picture(ax: Any, s: GraspSet, mesh: Mesh, T_up_obj: Array, size: tuple[int, int]) -> None:
    """Draw the shaded surface and the hands, nearest last."""
    bare = Mesh(vertices=se3.transform(T_up_obj, mesh.vertices), faces=mesh.faces)
    drawn, factor = drawn_size(bare)
    finger = min(FINGER_M, FINGER_SHARE * float(np.linalg.norm(mesh.extent)))
    rows = shown_rows(s)
    hands = [
        [factor * se3.transform(T_up_obj @ s.Ts_obj_pads[row], line)
         for line in _hand_lines(float(np.nan_to_num(s.widths_m[row])), finger)]
        for row in rows
    ]  # fmt: skip
    lines = [line for hand in hands for line in hand]
    view = _near_view(np.concatenate([drawn.vertices, *lines]), size)
    picture, depth = rendered([drawn], view)
    ax.imshow(picture)
    labels = np.where(labelled(s), s.labels, np.nan)
    for k in np.argsort(-_depths(view, hands)):
        row = int(rows[k])
        lines = dashed(hands[k], factor * DASH_SHARE * finger) if s.unsure[row] else hands[k]
        hand = Layer(lines=tuple(lines), color=score_hex(float(labels[row])), width=HAND_WIDTH)
        draw_layer(ax, hand, view, depth)


def _near_view(points: Array, size: tuple[int, int]) -> View:
    """Return the camera that sees all of the points (N, 3), with less paper about them."""
    wide = (round(ZOOM * size[0]), round(ZOOM * size[1]))
    view = view_of(points, DIRECTION, wide)
    seen = view.intrinsics
    cut = replace(
        seen, width=size[0], height=size[1],
        cx=seen.cx - 0.5 * (wide[0] - size[0]), cy=seen.cy - 0.5 * (wide[1] - size[1]),
    )  # fmt: skip
    return replace(view, intrinsics=cut)


def _hand_lines(width_m: float, finger_m: float) -> list[Array]:
    """Return a hand as lines in its grasp frame [m]: two fingers with a palm, and a stem."""
    y, stem = width_m / 2, -finger_m * (1 + STEM_M / FINGER_M)
    u = [[0, -y, 0], [0, -y, -finger_m], [0, y, -finger_m], [0, y, 0]]
    return [np.array(u), np.array([[0, 0, -finger_m], [0, 0, stem]])]


def _depths(view: View, hands: Sequence[Sequence[Array]]) -> Array:
    """Return how far each hand is from the camera [m, drawn size]."""
    middles = np.array([hand[0].mean(axis=0) for hand in hands]).reshape(-1, 3)
    return se3.transform(se3.invert(view.T_obj_cam), middles)[:, 2]


def _figures(s: GraspSet) -> str:
    """Return the figures of an object in one line."""
    scores = s.scores[~np.isnan(s.scores)]
    if len(s) == 0:
        return "no candidate"
    if len(scores) == 0:
        return f"n = {len(s)}, not tried"
    arrived = int(np.sum(stops_of(s) > 1))
    return (
        f"n = {len(s)} · reachable {100 * arrived / len(scores):.0f} % · "
        f"good {100 * np.mean(scores >= 0.5):.0f} % · {mean_label([s])}"
    )


def _bar(ax: Any, stops: Int64) -> None:
    """Draw how many grasps stopped where."""
    ax.set_axis_off()
    ax.set_xlim(0, 1)
    ax.set_ylim(0, 1)
    counts = np.bincount(stops, minlength=len(STOPS))
    start = 0.0
    for (_, color), count in zip(STOPS, counts, strict=True):
        share = count / max(1, len(stops))
        ax.barh(0.5, share, left=start, height=1.0, color=color, edgecolor=PAPER, linewidth=0.8)
        if share >= NARROWEST:
            ax.text(start + share / 2, 0.46, str(count), fontsize=8.5, color=ink_on(color),
                    ha="center", va="center")  # fmt: skip
        start += share


# --- parts of a sheet that is laid out in pixels ------------------------------------------------


def axes_at(figure: Any, box: Box) -> Any:
    """Return axes in a part of the sheet [px, from the upper left corner]."""
    wide, high = figure.get_size_inches() * figure.dpi
    left, top, width, height = box
    return figure.add_axes((left / wide, 1 - (top + height) / high, width / wide, height / high))


def text_at(
    figure: Any, left: float, middle: float, text: str, size: float, color: str, *,
    bold: bool = False, align: str = "left",
) -> None:  # fmt: skip
    """Write a line of text on the sheet; `left` and `middle` are in pixels."""
    wide, high = figure.get_size_inches() * figure.dpi
    figure.text(
        left / wide, 1 - middle / high, text, fontsize=size, color=color, ha=align, va="center",
        weight="bold" if bold else "normal", parse_math=False,
    )  # fmt: skip


def shortened(name: str, width_px: float) -> str:
    """Return a name that fits into a width; a bold letter of 12 pt takes 11 px."""
    most = max(8, int(width_px / 11) - 5)
    return name if len(name) <= most else name[: most - 1] + "…"


def ink_on(color: str) -> str:
    """Return dark or light ink, whichever reads better on a colour '#rrggbb'."""
    r, g, b = (int(color[k : k + 2], 16) for k in (1, 3, 5))
    return INK if 0.299 * r + 0.587 * g + 0.114 * b > 140 else "white"


def names_of_sets(sets: Sequence[GraspSet], names: Mapping[int, str]) -> list[str]:
    """Return the object's name of each set."""
    return [names.get(s.obj_id) or f"object {s.obj_id}" for s in sets]
