"""The fused mesh from four sides, shaded and coloured by how sure it is, as one PNG."""

import io
from typing import Any

import numpy as np

from realsim.arrays import Array
from realsim.geometry import se3
from realsim.records import Mesh
from realsim.scanning.fusion.result import FusedObject
from realsim.scanning.shading import ShadingConfig, color_paint, shaded_views

SIDES = ("front, from 25° above", "right, from 25° above", "back, from 25° above", "from above")
LOOK = ShadingConfig(
    sides_deg=((-90.0, 25.0), (0.0, 25.0), (90.0, 25.0), (-90.0, 89.0)), margin=0.02, ambient=0.45
)
"""How the eight pictures are taken."""
PLAIN = np.array([0.70, 0.72, 0.75])
"""Colour of a mesh without colours."""
INVENTED = np.array([0.93, 0.55, 0.20])
"""Colour of what no camera measured."""
WORST_SHARE = 98.0
"""The colour scale ends at this percentile of the sigmas."""


def fusion_picture(fused: FusedObject) -> bytes:
    """Return a PNG of the fused mesh from four sides.

    The upper row shows the mesh in its own colours (grey without), the lower the 1-sigma of every
    vertex; what is invented is orange in both.
    """
    from matplotlib.cm import ScalarMappable
    from matplotlib.colors import Normalize
    from matplotlib.figure import Figure

    values = 1e3 * fused.sigma_m
    known = values[fused.measured & np.isfinite(values)]
    top = float(np.percentile(known, WORST_SHARE)) if len(known) else 1.0
    shades = ScalarMappable(Normalize(0.0, top), "viridis")
    rows = _vertex_paints(fused, shades.to_rgba(np.nan_to_num(values))[:, :3])
    standing = se3.transform(se3.invert(fused.plane.T_world_table), fused.mesh.vertices)
    mesh = Mesh(vertices=standing, faces=fused.mesh.faces)

    figure = Figure(figsize=(14.5, 8.0), dpi=100, layout="constrained")
    axes: Any = figure.subplots(2, len(SIDES))
    for row, colors in enumerate(rows):
        pictures = shaded_views(mesh, color_paint(255.0 * colors), LOOK)
        for ax, picture, name in zip(axes[row], pictures, SIDES, strict=True):
            ax.imshow(picture, interpolation="nearest")
            ax.set_axis_off()
            if row == 0:
                ax.set_title(name, fontsize=11)
    what = "1-sigma of the surface [mm]"
    figure.colorbar(shades, ax=axes[1, :], label=what, fraction=0.02, pad=0.01)
    size = 1e3 * np.ptp(standing, axis=0)
    c = fused.coverage
    figure.suptitle(
        f"{size[0]:.0f} x {size[1]:.0f} x {size[2]:.0f} mm,  {fused.verdict};  measured: "
        f"{100 * c.measured_above_cut:.0f} % of what is above the table;  orange: invented",
        fontsize=12,
    )
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png")
    return buffer.getvalue()


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
