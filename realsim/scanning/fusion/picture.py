"""The fused mesh from four sides, shaded and coloured by how sure it is, as one PNG."""

import io
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from realsim.geometry import se3
from realsim.records import Mesh
from realsim.scanning.fusion.result import FusedObject

Array = NDArray[np.float64]
Image = NDArray[np.float64]
SIDE_PX = 420
"""Edge of one of the eight pictures [px]."""
SIDES: tuple[tuple[str, float, float], ...] = (
    ("front, from 25° above", 0.0, 25.0),
    ("right, from 25° above", 90.0, 25.0),
    ("back, from 25° above", 180.0, 25.0),
    ("from above", 0.0, 89.0),
)
"""Name, angle around the table's z and elevation [deg] of the views."""
PLAIN = np.array([0.70, 0.72, 0.75])
"""Colour of a mesh without colours."""
INVENTED = np.array([0.93, 0.55, 0.20])
"""Colour of what no camera measured."""
WORST_SHARE = 98.0
"""The colour scale ends at this percentile of the sigmas."""


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class _Look:
    """What an orthographic camera sees: faces, barycentric weights, light."""

    hit: NDArray[np.bool_]
    face: NDArray[np.int32]
    weights: Array
    light: Array


def fusion_picture(
    fused: FusedObject, path: Path | str | None = None, values_mm: Array | None = None
) -> bytes:
    """Return a PNG of the fused mesh from four sides; also save it if a path is given.

    The upper row shows the mesh in its own colours (grey without), the lower the 1-sigma of every
    vertex; what is invented is orange in both.

    Args:
        fused: the result of the fusion.
        path: where to save the picture.
        values_mm: (V,) drawn instead of sigma, signed (for instance errors against a known truth).
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.cm import ScalarMappable
    from matplotlib.colors import Normalize
    from matplotlib.figure import Figure

    values = 1e3 * fused.sigma_m if values_mm is None else np.asarray(values_mm, dtype=np.float64)
    known = values[fused.measured & np.isfinite(values)]
    top = float(np.percentile(np.abs(known), WORST_SHARE)) if len(known) else 1.0
    scale = Normalize(0.0 if values_mm is None else -top, top)
    shades = ScalarMappable(scale, "viridis" if values_mm is None else "RdBu_r")
    own, painted = _vertex_paints(fused, shades.to_rgba(np.nan_to_num(values))[:, :3])
    looks = _looks(fused)

    figure = Figure(figsize=(14.5, 8.0), dpi=100, layout="constrained")
    FigureCanvasAgg(figure)
    axes: Any = figure.subplots(2, len(SIDES))
    for column, (look, (name, _, _)) in enumerate(zip(looks, SIDES, strict=True)):
        for row, paint in enumerate((own, painted)):
            ax = axes[row, column]
            ax.imshow(_colored(look, fused.mesh, paint), interpolation="nearest")
            ax.set_axis_off()
        axes[0, column].set_title(name, fontsize=11)
    what = "1-sigma of the surface [mm]" if values_mm is None else "signed error [mm]"
    figure.colorbar(shades, ax=axes[1, :], label=what, fraction=0.02, pad=0.01)
    size = 1e3 * np.ptp(_in_table(fused), axis=0)
    c = fused.coverage
    figure.suptitle(
        f"{size[0]:.0f} x {size[1]:.0f} x {size[2]:.0f} mm,  {fused.verdict};  measured: "
        f"{100 * c.measured_above_cut:.0f} % of what is above the table;  orange: invented",
        fontsize=12,
    )
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png")
    data = buffer.getvalue()
    if path is not None:
        from realsim.store.atomic import write_bytes

        write_bytes(Path(path), data)
    return data


def _in_table(fused: FusedObject) -> Array:
    """Return the vertices (V, 3) in the table's frame [m]."""
    return se3.transform(se3.invert(fused.plane.T_world_table), fused.mesh.vertices)


def _vertex_paints(fused: FusedObject, scale: Array) -> tuple[Array, Array]:
    """Return RGB (V, 3) in [0, 1] of the upper and of the lower row."""
    own = np.tile(PLAIN, (len(fused.mesh.vertices), 1))
    if fused.mesh.colors is not None:
        own = fused.mesh.colors / 255.0
    invented = ~fused.measured[:, None]
    return (
        np.where(invented, 0.5 * own + 0.5 * INVENTED, own),
        np.where(invented, INVENTED, scale),
    )


def _looks(fused: FusedObject) -> Sequence[_Look]:
    """Return what parallel rays meet from every side."""
    from realsim.rendering.rays import PlacedMesh, RayScene

    vertices = _in_table(fused)
    scene = RayScene(
        [PlacedMesh(0, Mesh(vertices=vertices, faces=fused.mesh.faces), np.eye(4))],
        center=vertices.mean(0),
    )
    middle = (vertices.min(0) + vertices.max(0)) / 2
    radius = max(float(r) for r in _radii(vertices - middle))
    out: list[_Look] = []
    for _, around, above in SIDES:
        T = _camera(middle, around, above, 6 * radius)
        steps = radius * np.linspace(-1, 1, SIDE_PX)
        x, y = np.meshgrid(steps, steps)
        origins = T[:3, 3] + x.reshape(-1, 1) * T[:3, 0] + y.reshape(-1, 1) * T[:3, 1]
        hits = scene.cast(origins, np.tile(T[:3, 2], (len(origins), 1)).astype(np.float32))
        lamp = T[:3, :3] @ np.array([-0.35, -0.45, -0.8])
        lamp /= np.linalg.norm(lamp)
        light = 0.45 + 0.55 * np.clip(hits.normal.astype(np.float64) @ lamp, 0, 1)
        uv = hits.uv.astype(np.float64)
        out.append(
            _Look(
                hit=np.isfinite(hits.t), face=np.maximum(hits.face, 0),
                weights=np.stack([1 - uv.sum(1), uv[:, 0], uv[:, 1]], -1), light=light,
            )
        )  # fmt: skip
    return out


def _camera(middle: Array, around: float, above: float, distance: float) -> Array:
    """Return T_table_cam (4, 4) of a camera that looks at the middle from angles [deg]."""
    a, e = np.radians([around, above])
    towards = np.array([np.cos(e) * np.sin(a), -np.cos(e) * np.cos(a), np.sin(e)])
    return se3.look_at(middle + distance * towards, middle)


def _radii(vertices: Array) -> Sequence[float]:
    """Return per side how far the picture must reach from the middle [m], with a small border."""
    turned = (se3.invert(_camera(np.zeros(3), a, e, 1.0)) for _, a, e in SIDES)
    return [1.04 * float(np.abs(vertices @ T[:2, :3].T).max()) for T in turned]


def _colored(look: _Look, mesh: Mesh, paint: Array) -> Image:
    """Return the picture (SIDE_PX, SIDE_PX, 3) of one side with these vertex colours."""
    corners = paint[mesh.faces[look.face]]
    rgb = np.einsum("nk,nkc->nc", look.weights, corners) * look.light[:, None]
    rgb[~look.hit] = 1.0
    return np.clip(rgb, 0, 1).reshape(SIDE_PX, SIDE_PX, 3)
