"""One picture of a fitted depth sensor: what was measured, and what the fitted one makes of it."""

from typing import Any

import numpy as np

from realsim.pages.plots import png
from realsim.rendering.depth_sensors.autocovariance import LAGS, detrended_correlation
from realsim.rendering.depth_sensors.fit import FittedDepthModel
from realsim.rendering.stereo.fit import FittedStereo

REAL, FITTED, QUIET = "#2b6cb0", "#c05621", "#8a94a0"


def fit_picture(fit: FittedDepthModel) -> bytes:
    """Return a PNG: residuals, autocorrelation, noise over distance, holes over obliquity."""
    figure, axes = _figure()
    _residual(figure, axes[0, 0], fit)
    _correlation(axes[0, 1], fit)
    _distance(axes[1, 0], fit)
    _holes(axes[1, 1], fit)
    e = fit.estimates["disparity_noise_px"]
    figure.suptitle(
        f"{fit.profile}: noise {e.value:.3f} ± {e.uncertainty:.3f} px of disparity, "
        f"{len(fit.frames)} frames"
    )
    return png(figure)


def _figure() -> tuple[Any, Any]:
    """Return a figure and its four axes (2, 2)."""
    from matplotlib.figure import Figure

    figure: Any = Figure(figsize=(13, 9), dpi=90, layout="constrained")
    return figure, figure.subplots(2, 2)


def _residual(figure: Any, axis: Any, fit: FittedDepthModel) -> None:
    plane = fit.planes[0]
    reach = 3 * max(float(np.nanstd(plane.residual)), 1e-3)
    image = axis.imshow(plane.residual, cmap="coolwarm", vmin=-reach, vmax=reach)
    figure.colorbar(image, ax=axis, label="measured - plane [px of disparity]")
    axis.set_title(f"{fit.frames[0].name}: residual on the plane")
    axis.set_xticks([])
    axis.set_yticks([])


def _correlation(axis: Any, fit: FittedDepthModel) -> None:
    lags = np.arange(LAGS + 1)
    total = float(fit.covariance_px2[:, 0].mean())
    m = fit.model
    parts = [(m.disparity_noise_px, m.correlation_px), (m.slow_noise_px, m.slow_correlation_px)]
    curve = np.zeros((2, LAGS + 1))
    for sigma, radius in parts:
        if sigma > 0 and radius > 0:
            across = radius * m.correlation_aspect
            curve += sigma**2 * detrended_correlation(radius, across, fit.trend_px)
        elif sigma > 0:
            curve[:, 0] += sigma**2
    for k, (name, color) in enumerate((("along rows", REAL), ("along columns", FITTED))):
        axis.plot(lags, fit.covariance_px2[k] / total, "o", color=color, label=f"{name}, measured")
        axis.plot(lags, curve[k] / total, "-", color=color, label="model")
    axis.axhline(0, color=QUIET, lw=0.8)
    axis.set_xlabel("distance of the pixels [px]")
    axis.set_ylabel("autocorrelation")
    axis.set_title(f"how noise is alike (errors slower than {fit.trend_px:.0f} px taken out)")
    axis.legend(frameon=False)


def _distance(axis: Any, fit: FittedDepthModel) -> None:
    z = np.array([f.distance_m for f in fit.frames])
    sigma_mm = 1e3 * np.array([f.sigma_m for f in fit.frames])
    axis.plot(z, sigma_mm, "o", color=REAL, label="frames")
    reach = np.linspace(0.8 * z.min(), 1.2 * z.max(), 60)
    scale = float(np.median(sigma_mm / z**2))
    axis.plot(reach, scale * reach**2, "-", color=FITTED, label="z² law")
    law = fit.estimates["distance_exponent"]
    said = f"exponent {law.value:.2f} ± {law.uncertainty:.2f}" if law.determined else "not checked"
    axis.set_title(f"noise over distance: {said}")
    axis.set_xlabel("depth of the plane [m]")
    axis.set_ylabel("noise of depth [mm]")
    axis.set_ylim(bottom=0)
    axis.legend(frameon=False)


def _holes(axis: Any, fit: FittedDepthModel) -> None:
    h = fit.holes
    seen = h.pixels > 0
    axis.plot(h.angle_deg[seen], 100 * h.share[seen], "o-", color=REAL, label="frames")
    m = fit.model
    angle = np.linspace(0, 90, 181)
    span = max(m.grazing_to_deg - m.grazing_from_deg, 1e-6)
    ramp = 100 * np.clip((angle - m.grazing_from_deg) / span, 0, 1)
    known = fit.estimates["grazing_from_deg"].determined
    style, name = ("-", "fitted ramp") if known else ("--", "ramp of the profile (not fitted)")
    axis.plot(angle, ramp, style, color=FITTED, label=name)
    axis.set_xlabel("angle between ray and surface normal [deg]")
    axis.set_ylabel("pixels without depth [%]")
    axis.set_title("holes over obliquity")
    axis.set_ylim(bottom=0)
    axis.legend(frameon=False)


def stereo_fit_picture(fit: FittedStereo) -> bytes:
    """Return a PNG: residuals of the middle frame and its twin, noise and holes over distance."""
    figure, axes = _figure()
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
    return png(figure)


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
    for side, mark, color in (("measured", "o", REAL), ("simulated", "x", FITTED)):
        values = [scale * getattr(getattr(f, side), name) for f in fit.frames]
        axis.plot(z, values, mark, color=color, ms=9, mew=2, label=side)
        top = max(top, 1.2 * float(np.nanmax([0.0, *values])))
    axis.set_xlabel("distance of the plane [m]")
    axis.set_ylabel(said)
    axis.set_ylim(0, top)
    axis.legend(frameon=False)
