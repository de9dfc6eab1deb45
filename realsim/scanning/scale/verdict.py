"""Whether a scale may be trusted, judged without ground truth."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from realsim.records import Verdict
from realsim.scanning.scale.agreement import Explained
from realsim.scanning.scale.config import ScaleConfig
from realsim.scanning.scale.evidence import ScanEvidence
from realsim.scanning.scale.joint import Outlook
from realsim.scanning.scale.shape import ScanShape
from realsim.scanning.scale.state import State

Array = NDArray[np.float64]


@dataclass(frozen=True, kw_only=True, slots=True)
class Judged:
    """A verdict with its reasons."""

    verdict: Verdict
    reasons: tuple[str, ...]
    checks: dict[str, float]
    notes: tuple[str, ...] = ()


def judge(
    shape: ScanShape,
    evidence: ScanEvidence,
    fit: tuple[State, Outlook, Explained],
    rivals: Sequence[tuple[float, float]],
    rules: tuple[float, ScaleConfig],
) -> Judged:
    """Return the verdict on a fit.

    Args:
        shape: the mesh.
        evidence: what was measured.
        fit: state, what the fit saw, and how well it explains the images.
        rivals: scale and gain of other solutions.
        rules: 1-sigma of the log scale, and the constants.
    """
    (state, look, seen), (sigma, config) = fit, rules
    v = config.verdict
    offsets = look.offsets[look.offset_sigmas < 2.0 * np.median(look.offset_sigmas)]
    shape_share = float(np.sqrt(np.mean(np.square(offsets))) / evidence.size_m)
    # A rival that ended at the same scale is none.
    others = [
        (scale, gain)
        for scale, gain in rivals
        if abs(np.log(scale / (state.s * shape.unit))) > v.rival_change
    ]
    contrast = min((seen.gain - gain for _, gain in others), default=1.0)
    known = np.abs(look.residuals[np.isfinite(look.residuals)])
    far = float(np.mean(known > v.far_share * evidence.size_m)) if len(known) else 1.0
    checks = {
        "far": far, "gain": seen.gain, "agree": seen.agree, "cover": seen.cover, "iou": seen.iou,
        "contrast": contrast, "shape_mm": 1e3 * look.shape.sigma_m, "shape_share": shape_share,
        "sigma_percent": 100 * sigma, "rim_px": state.rim, "bias_per_m": state.bias,
    }  # fmt: skip
    wrong: list[str] = []
    doubts: list[str] = []
    if seen.gain < v.reject_gain:
        wrong.append(
            f"the mesh explains {100 * seen.gain:.0f} % of what was measured of the object (what "
            f"it contradicts deducted); {100 * v.least_gain:.0f} % and more are trusted. It is "
            "not this object, or mirrored, or was not found."
        )
    elif seen.gain < v.least_gain:
        doubts.append(
            f"the mesh explains {100 * seen.gain:.0f} % of what was measured of the object; "
            f"{100 * v.least_gain:.0f} % and more are trusted."
        )
    if seen.iou < v.least_iou:
        doubts.append(
            f"its outline overlaps the measured one by {100 * seen.iou:.0f} %; "
            f"{100 * v.least_iou:.0f} % and more are trusted."
        )
    if seen.agree > v.part_agree and seen.cover < v.part_cover:
        doubts.append(
            f"the mesh agrees where it is seen ({100 * seen.agree:.0f} %) but covers "
            f"{100 * seen.cover:.0f} % of what stands there: another object touches it, or the "
            "mesh is of a part only. Capture the object alone."
        )
    if far > v.most_far:
        doubts.append(
            f"{100 * far:.1f} % of the measured points lie more than "
            f"{1e3 * v.far_share * evidence.size_m:.0f} mm from the mesh; of the same object at "
            f"most {100 * v.most_far:.0f} % do. A part of it is elsewhere: another object of its "
            "kind?"
        )
    if shape_share > v.worst_shape:
        doubts.append(
            f"the surfaces differ by {100 * shape_share:.1f} % of the size; meshes of the same "
            f"object differ by less than {100 * v.worst_shape:.0f} %."
        )
    if sigma > v.doubtful_sigma:
        doubts.append(
            f"the scale is known to {100 * sigma:.1f} % only; {100 * v.doubtful_sigma:.1f} % and "
            "less are trusted. More views from other sides help."
        )
    for scale, gain in others:
        if gain > seen.gain - v.rival_gain:
            change = 100 * (scale / (state.s * shape.unit) - 1)
            doubts.append(
                f"a pose with a scale {change:+.1f} % off explains the images as well ({gain:.2f} "
                f"against {seen.gain:.2f}); give a start or a measured length."
            )
    verdict: Verdict = "rejected" if wrong else "doubtful" if doubts else "accepted"
    return Judged(verdict=verdict, reasons=(*wrong, *doubts), checks=checks)
