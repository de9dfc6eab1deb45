"""A fit against lengths measured by hand: whether they agree, and both together where they do."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from realsim.arrays import Array
from realsim.errors import DegenerateError
from realsim.geometry import se3
from realsim.records import Mesh
from realsim.scanning.scale import measured
from realsim.scanning.scale.result import ScaleFit

LOG_SCALE = 6
"""Row of the logarithm of the scale in a fit's covariance."""
TO_SIGMA = 1.4826
"""Sigma of a normal distribution / its median absolute deviation."""


@dataclass(frozen=True, kw_only=True, slots=True)
class MeasuredCheck:
    """One measured length against a fit."""

    measurement: measured.Measurement
    length: float
    """The same length on the mesh [units of the mesh]."""
    scale: float
    """What the measurement alone says [metres per unit]."""
    sigma: float
    """1-sigma of it, the mesh's shape error included [metres per unit]."""
    fitted_mm: float
    """The same length at the fit's scale [mm]."""
    difference_percent: float
    """(measured - fitted) / fitted [%]."""
    z: float
    """The difference in joint sigmas of fit and measurement."""
    agrees: bool
    text: str
    """One sentence for a person, with numbers."""


def as_it_stands(fit: ScaleFit) -> Array:
    """Return R (3, 3) that turns the mesh as it stands on the table, z out of the table."""
    return (se3.invert(fit.plane.T_world_table) @ fit.T_world_obj)[:3, :3]


def shape_error_m(fit: ScaleFit) -> float:
    """Return the 1-sigma distance between the model's and the measured surface [m]; 0 if unknown.

    It is the spread about the median (1.4826 times the median deviation, the sigma of a normal
    distribution): a scale that is off shifts all residuals alike, and must not excuse itself.
    """
    seen = fit.residual_mm[np.isfinite(fit.residual_mm)]
    if len(seen) == 0:
        return 0.0
    return 1e-3 * TO_SIGMA * float(np.median(np.abs(seen - np.median(seen))))


def compare(fit: ScaleFit, mesh: Mesh, measurement: measured.Measurement) -> MeasuredCheck:
    """Return whether a measured length agrees with a fit.

    Args:
        fit: the scale from the depth images.
        mesh: the mesh it is of, in its own unit.
        measurement: what was measured. A 'height' is out of the table, as the object stands.
    """
    alone = measured.scale_of(mesh, measurement, as_it_stands(fit), shape_error_m(fit))
    ratio = alone.scale / fit.scale
    z = (alone.scale - fit.scale) / float(np.hypot(alone.sigma, fit.sigma))
    fitted_mm, percent = 1e3 * alone.length * fit.scale, 100 * (ratio - 1)
    agrees = abs(z) <= measured.AGREE_Z
    said = f"measured {1e3 * measurement.value_m:.4g} mm, fitted {fitted_mm:.4g} mm"
    how = f"{percent:+.2f} %, {abs(z):.1f} sigma" if abs(percent) < 100 else f"{ratio:.3g} times"
    text = f"{measurement.kind}: {said} ({how})"
    if agrees:
        text += ": they agree."
    else:
        hint = measured.typo(ratio) or _other_kind(fit, mesh, measurement)
        text += f": they do not agree.{' ' + hint[0].upper() + hint[1:] if hint else ''}"
    return MeasuredCheck(
        measurement=measurement, length=alone.length, scale=alone.scale, sigma=alone.sigma,
        fitted_mm=fitted_mm, difference_percent=percent, z=z, agrees=agrees, text=text,
    )  # fmt: skip


def _other_kind(fit: ScaleFit, mesh: Mesh, measurement: measured.Measurement) -> str:
    """Return which other length of the mesh the measured one would fit, '' for none."""
    fitting: list[str] = []
    for kind in measured.KINDS:
        if kind in ("between", measurement.kind):
            continue
        other = replace(measurement, kind=kind, points=None)
        try:
            alone = measured.scale_of(mesh, other, as_it_stands(fit), shape_error_m(fit))
        except DegenerateError:  # flat along that axis: it was not measured there
            continue
        z = (alone.scale - fit.scale) / float(np.hypot(alone.sigma, fit.sigma))
        if abs(z) <= measured.AGREE_Z:
            fitting.append(f"'{kind}' ({measured.MEANING[kind]})")
    return f"it would agree as {' or '.join(fitting)}." if fitting else ""


def with_measurements(
    fit: ScaleFit, mesh: Mesh, measurements: Sequence[measured.Measurement]
) -> tuple[ScaleFit, tuple[MeasuredCheck, ...]]:
    """Return the fit with measured lengths taken in, and how each compares with the fit alone.

    Where all agree, scale and pose become the mean by inverse variance. Where one does not, the
    scale stays as it was fitted, an accepted fit becomes doubtful, and both figures are named.
    """
    if not measurements:
        return fit, ()
    checks = tuple(compare(fit, mesh, m) for m in measurements)
    R_up, shape_m = as_it_stands(fit), shape_error_m(fit)
    each = [measured.scale_of(mesh, m, R_up) for m in measurements]
    between = measured.contradiction(
        [measured.scale_of(mesh, m, R_up, shape_m) for m in measurements]
    )
    faults = [*(c.text for c in checks if not c.agrees), *([between] if between else [])]
    if faults:
        verdict = "doubtful" if fit.verdict == "accepted" else fit.verdict
        return replace(fit, verdict=verdict, reasons=(*fit.reasons, *faults)), checks
    # The mesh's shape error is the same in every length; it is not averaged away by more of them.
    scale, sigma = measured.weighted([e.scale for e in each], [e.sigma for e in each])
    shape = shape_m * np.sqrt(2) / max(e.length for e in each)
    joined = conditioned(fit, mesh, scale, float(np.hypot(sigma, shape)))
    note = (
        f"{len(each)} measured length{'s' if len(each) > 1 else ''} moved the scale by "
        f"{100 * (joined.scale / fit.scale - 1):+.3f} % and its sigma from "
        f"{fit.sigma_percent:.3f} % to {joined.sigma_percent:.3f} %."
    )
    return replace(joined, notes=(*joined.notes, note)), checks


def conditioned(fit: ScaleFit, mesh: Mesh, scale: float, sigma: float) -> ScaleFit:
    """Return the fit after an independent figure of the scale: one Kalman step in its logarithm.

    With x = [rotation, translation, log scale] of covariance C and a figure y = x[6] of variance r,
    K = C[:, 6] / (C[6, 6] + r), x += K (y - x[6]), C -= K C[6, :]; the mean of the scale is the
    one by inverse variance, and the pose follows by as much as it is correlated with it.

    Args:
        fit: the fit.
        mesh: the mesh it is of.
        scale: the other figure [metres per unit].
        sigma: 1-sigma of it [metres per unit].
    """
    C = np.asarray(fit.covariance, dtype=np.float64)
    variance = float((fit.sigma / fit.scale) ** 2)
    gain = np.zeros(7)
    gain[LOG_SCALE] = 1.0
    if C[LOG_SCALE, LOG_SCALE] > 0:
        gain = C[:, LOG_SCALE] / C[LOG_SCALE, LOG_SCALE]
    share = variance / (variance + (sigma / scale) ** 2)
    step = gain * share * np.log(scale / fit.scale)
    # The right perturbation is about the centre of the mesh's box, which is where T has to be.
    centre = mesh.bounds.mean(0)
    T_world_centre = fit.T_world_obj @ se3.from_translation(fit.scale * centre)
    joined = fit.scale * float(np.exp(step[LOG_SCALE]))
    moved = T_world_centre @ se3.exp(step[:LOG_SCALE])
    return replace(
        fit,
        scale=joined,
        sigma=joined * float(np.sqrt(variance * (1 - share))),
        T_world_obj=moved @ se3.from_translation(-joined * centre),
        covariance=C - share * np.outer(gain, C[LOG_SCALE]),
        extent_mm=fit.extent_mm * (joined / fit.scale),
    )
