"""One picture of a fitted stereo simulator: a frame and its twin, noise and holes."""

import io
from typing import Any

import numpy as np

from realsim.rendering.stereo.fit import FittedStereo

REAL, SIMULATED = "#2b6cb0", "#c05621"


def stereo_fit_picture(fit: FittedStereo) -> bytes:
    """Return a PNG: residuals of the middle frame and its twin, noise and holes over distance."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure: Any = Figure(figsize=(13, 9), layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.subplots(2, 2)
    k = len(fit.twins) // 2
    reach = 3 * max(float(np.nanstd(fit.twins[k].residual)), 1e-3)
    for axis, what, residual in (
        (axes[0, 0], "measured", fit.twins[k].residual),
        (axes[0, 1], "simulated", fit.residuals[k]),
    ):
        axis.set_facecolor("black")
        image = axis.imshow(residual, cmap="coolwarm", vmin=-reach, vmax=reach)
        axis.set_title(f"{fit.twins[k].name}, {what} (black: no depth)")
        axis.set_xticks([])
        axis.set_yticks([])
        figure.colorbar(image, ax=axis, label=f"{what} - plane [px of disparity]")
    z = [f.distance_m for f in fit.frames]
    _pair(axes[1, 0], z, fit, ("sigma_px", 1.0, 0.05), "noise of disparity [px]")
    _pair(axes[1, 1], z, fit, ("hole_share", 100.0, 1.0), "pixels without depth [%]")
    figure.suptitle(f"stereo simulator of a {fit.profile}; planes compared: {len(fit.frames)}")
    out = io.BytesIO()
    figure.savefig(out, format="png", dpi=90, metadata={"Software": None})
    return out.getvalue()


def _pair(
    axis: Any, z: list[float], fit: FittedStereo, what: tuple[str, float, float], said: str
) -> None:
    """Draw a figure of the frames and of their twins over distance.

    Args:
        axis: drawn on.
        z: distances [m].
        fit: the fit.
        what: name of the figure, its factor, and the least height of the axis.
        said: its label.
    """
    name, scale, least = what
    top = least
    for side, mark, color in (("measured", "o", REAL), ("simulated", "x", SIMULATED)):
        values = [scale * getattr(getattr(f, side), name) for f in fit.frames]
        axis.plot(z, values, mark, color=color, ms=9, mew=2, label=side)
        top = max(top, 1.2 * float(np.nanmax([0.0, *values])))
    axis.set_xlabel("distance of the plane [m]")
    axis.set_ylabel(said)
    axis.set_ylim(0, top)
    axis.legend(frameon=False)
