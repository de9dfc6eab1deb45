"""One sheet per model that shows what is known of it: surface, size, symmetries, parts, faults.

Four shaded views, the convex parts, and the figures in words. The mesh is drawn at a size of its
own, so that a mesh in unknown units comes out as one in metres does.
"""

import textwrap
from dataclasses import replace
from io import BytesIO
from typing import Any

import numpy as np

from realsim.arrays import Image
from realsim.models.model_picture_views import (
    INK,
    MUTED,
    PAPER,
    PART_COLORS,
    Layer,
    box_layer,
    draw_layer,
    drawn_size,
    parts_mesh,
    rendered,
    rim_layer,
    scale_bar,
    symmetry_layers,
    view_of,
)
from realsim.models.model_records import ConvexParts, ModelProperties
from realsim.records import Mesh

VIEWS: tuple[tuple[str, tuple[float, float, float]], ...] = (
    ("front", (0.9, -1.5, 0.8)),
    ("back, with its symmetries", (-1.1, 1.4, 0.7)),
    ("from above", (0.25, -0.35, 1.6)),
    ("from below", (-0.6, -0.9, -1.2)),
)
"""Names and directions from the object to the camera."""
PANEL = (640, 480)
"""Width and height of one picture [px]."""
DPI = 100
TITLE_IN = 0.46
"""Height of the sheet's title [inch]."""
VERDICT_COLORS = {"accepted": "#1f8a5b", "doubtful": "#c77700", "rejected": "#c0392b"}
LINE_CHARS = 62
"""Characters of one line of the figures."""
MOST_LINES = 25
"""Lines of the figures; a longer text ends with '...'."""


def model_sheet(mesh: Mesh, properties: ModelProperties, parts: ConvexParts | None = None) -> Image:
    """Return the sheet of a model (H, W, 3).

    Args:
        mesh: the model's mesh; metres, or its own units where `properties.matter` is None.
        properties: what is known of it.
        parts: its convex parts in the same unit.
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    width, height = 3 * PANEL[0] / DPI, 2 * PANEL[1] / DPI + TITLE_IN
    figure = Figure(figsize=(width, height), dpi=DPI, facecolor=PAPER)
    FigureCanvasAgg(figure)
    _title(figure, properties)
    drawn, factor = drawn_size(mesh)
    layers = _layers(mesh, properties, factor)
    for k, (title, direction) in enumerate(VIEWS):
        shown = [layer for layer in layers if layer.views == () or k in layer.views]
        lines = [line for layer in shown for line in layer.lines]
        view = view_of(np.concatenate([drawn.vertices, *lines]), direction, PANEL)
        ax = _panel(figure, k % 2, k // 2, title)
        picture, depth = rendered([drawn], view)
        ax.imshow(picture)
        for layer in shown:
            draw_layer(ax, layer, view, depth)
        scale_bar(ax, view, factor, PANEL, metric=properties.matter is not None)
    _parts_panel(_panel(figure, 2, 0, _parts_title(properties)), drawn, factor, parts)
    _figures_panel(_panel(figure, 2, 1, ""), mesh, properties)
    buffer = BytesIO()
    figure.savefig(buffer, format="rgba")
    pixels = np.frombuffer(buffer.getvalue(), np.uint8)
    return pixels.reshape(round(height * DPI), round(width * DPI), 4)[..., :3].copy()


def _layers(mesh: Mesh, properties: ModelProperties, factor: float) -> list[Layer]:
    """Return what is drawn over the views, in the drawn size."""
    metric = properties.matter is not None
    layers = [box_layer(mesh, factor, metric=metric)]
    layers += [rim_layer(mesh, factor)]
    if properties.symmetries is not None:
        layers += symmetry_layers(mesh, properties.symmetries, factor)
    if properties.matter is not None:
        center = properties.matter.center_of_mass * factor
        layers.append(Layer(lines=(center[None],), marker="mass"))
    return layers


def _panel(figure: Any, column: int, row: int, title: str) -> Any:
    """Return the axes of one panel, without a frame."""
    width, height = figure.get_size_inches()
    w, h = PANEL[0] / DPI / width, PANEL[1] / DPI / height
    ax = figure.add_axes((column * w, (1 - row) * h, w, h))
    ax.set_axis_off()
    ax.set_xlim(-0.5, PANEL[0] - 0.5)
    ax.set_ylim(PANEL[1] - 0.5, -0.5)
    ax.text(16, 24, title, fontsize=10, color=MUTED, va="center")
    return ax


def _title(figure: Any, properties: ModelProperties) -> None:
    height = float(figure.get_size_inches()[1])
    at = 1 - 0.5 * TITLE_IN / height
    obj_id = properties.obj_id
    label = properties.name if obj_id is None else f"{properties.name}  ({obj_id})"
    figure.text(0.009, at, label, fontsize=16, weight="bold", color=INK, va="center")
    is_plain = properties.matter is None and properties.verdict == "accepted"
    color = MUTED if is_plain else VERDICT_COLORS.get(properties.verdict, MUTED)
    figure.text(
        0.991, at, verdict_text(properties), fontsize=12, weight="bold", color=color, va="center",
        ha="right",
    )  # fmt: skip


def _parts_title(properties: ModelProperties) -> str:
    c = properties.convex
    if c is None:
        return "convex parts: none"
    plural = "" if c.parts == 1 else "s"
    return f"{c.parts} convex part{plural} ({c.method}), volume {c.volume_ratio:.2f} of the mesh"


def _parts_panel(ax: Any, drawn: Mesh, factor: float, parts: ConvexParts | None) -> None:
    """Draw the convex parts in colours, from the front."""
    if parts is None:
        return
    view = view_of(drawn.vertices, VIEWS[0][1], PANEL)
    meshes = [
        parts_mesh(part * factor, PART_COLORS[k % len(PART_COLORS)])
        for k, part in enumerate(parts.parts)
    ]
    ax.imshow(rendered(meshes, view)[0])


def _figures_panel(ax: Any, mesh: Mesh, properties: ModelProperties) -> None:
    """Write the figures."""
    lines = figure_lines(mesh, properties)
    y, step = 44.0, 17.0
    if len(lines) > MOST_LINES:
        lines = [*lines[: MOST_LINES - 1], ("", "... (all of it is in the properties file)")]
    for label, text in lines:
        ax.text(16, y, label, fontsize=9, color=MUTED, va="center")
        is_problem = label == "look" or (label == "" and text.startswith("! "))
        color = VERDICT_COLORS["doubtful"] if is_problem else INK
        ax.text(130, y, text.removeprefix("! "), fontsize=9, color=color, va="center")
        y += step


def figure_lines(mesh: Mesh, properties: ModelProperties) -> list[tuple[str, str]]:
    """Return the figures of a model as (name, text) lines; a name is empty where a text goes on."""
    rows = size_lines(mesh, properties)
    s = properties.symmetries
    if s is not None:
        rows.append(("symmetries", symmetry_text(properties)))
        rows += [("", f"nearly: {n}") for n in s.near[:2]]
    if properties.scale is not None:
        rows.append(("scale", scale_text(properties)))
    rows += [("repair", a) for a in properties.actions]
    rows += [("look", r) for r in properties.reasons]
    out: list[tuple[str, str]] = []
    for label, text in rows:
        mark = "! " if label == "look" else ""
        for k, piece in enumerate(textwrap.wrap(text, LINE_CHARS) or [""]):
            out.append((label if k == 0 else "", piece if k == 0 else mark + piece))
    return out


def size_lines(mesh: Mesh, properties: ModelProperties) -> list[tuple[str, str]]:
    """Return what is known of size and matter."""
    surface = f"{len(mesh.vertices)} vertices, {len(mesh.faces)} faces"
    paint = "texture" if mesh.texture is not None else "colours" if mesh.colors is not None else ""
    rows = [("surface", surface + (f", {paint}" if paint else ""))]
    m = properties.matter
    if m is None:
        size = " x ".join(f"{x:.4g}" for x in mesh.extent)
        return [("size", f"{size} units: no metric scale yet"), *rows]
    size = " x ".join(f"{1e3 * x:.1f}" for x in m.extent_m)
    center = ", ".join(f"{round(1e3 * x, 1) + 0.0:.1f}" for x in m.center_of_mass)
    moments = np.linalg.eigvalsh(m.inertia)
    return [
        ("size", f"{size} mm, diameter {1e3 * m.diameter_m:.1f} mm"),
        ("volume", f"{1e6 * m.volume_m3:.4g} cm³ of the {m.volume_of}, "
                   f"{100 * m.hull_volume_fraction:.0f} % of its hull"),
        ("mass", f"{1e3 * m.mass_kg:.4g} g ({_mass_from(properties)})"),
        ("centre of mass", f"({center}) mm"),
        ("inertia", ", ".join(f"{1e7 * x:.4g}" for x in moments) + " g cm² (principal)"),
        *rows,
    ]  # fmt: skip


def _mass_from(properties: ModelProperties) -> str:
    m = properties.matter
    assert m is not None, "asked for only where there is matter"
    if m.mass_from == "weighed":
        return f"weighed: {m.density:.4g} kg/m³"
    return f"at {m.density:.4g} kg/m³, not weighed"


def verdict_text(properties: ModelProperties) -> str:
    """Return the verdict in words: a mesh of no size is not accepted, however sound it is."""
    if properties.matter is not None:
        return properties.verdict
    mesh = "" if properties.verdict == "accepted" else f", {properties.verdict} mesh"
    return f"no scale yet{mesh}"


def symmetry_text(properties: ModelProperties) -> str:
    """Return the symmetries in words."""
    s = properties.symmetries
    if s is None:
        return "not looked for"
    said: list[str] = []
    if s.axes:
        said.append("any turn about an axis" if len(s.axes) == 1 else "any turn at all")
    if len(s.discrete) > 1:
        said.append(f"{len(s.discrete)} discrete")
    text = ", ".join(said) or "none"
    if said:
        text += f" (off by up to {1e3 * s.worst_m:.2f} mm)"
    if said and s.texture_breaks:
        text += "; the colours break them"
    return text


def scale_text(properties: ModelProperties) -> str:
    """Return the scale in words."""
    s = properties.scale
    if s is None:
        return "by the file's unit" if properties.matter is not None else "none"
    sigma = "" if s.sigma_percent is None else f" ± {s.sigma_percent:.2g} %"
    where = f" in {s.session}" if s.session else ""
    return f"{s.scale:.6g} m per unit{sigma}, {s.verdict} ({s.how or 'not said how'}{where})"


def sheet_png(
    mesh: Mesh, properties: ModelProperties, parts: ConvexParts | None, name: str
) -> bytes:
    """Return the sheet as the content of a PNG file."""
    from realsim.images import png_bytes

    return png_bytes(model_sheet(mesh, replace(properties, name=name), parts))
