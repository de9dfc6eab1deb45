"""Whether a scale may be trusted, judged without ground truth."""

from collections.abc import Iterator, Sequence
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
    # A rival that ended at the same scale is none.
    scale = state.s * shape.unit
    others = [(s, gain) for s, gain in rivals if abs(np.log(s / scale)) > v.rival_change]
    checks = {
        "far": _share_far(look, evidence, config), "gain": seen.gain, "agree": seen.agree,
        "cover": seen.cover, "iou": seen.iou,
        "contrast": min((seen.gain - gain for _, gain in others), default=1.0),
        "shape_mm": 1e3 * look.shape.sigma_m, "shape_share": _shape_share(look, evidence),
        "sigma_percent": 100 * sigma, "rim_px": state.rim, "bias_per_m": state.bias,
    }  # fmt: skip
    wrong = _refusals(checks, config)
    doubts = [*_doubts_of_object(checks, evidence, config), *_doubts_of_scale(checks, config)]
    doubts += [
        f"a pose with a scale {100 * (other / scale - 1):+.1f} % off explains the images as well "
        f"({gain:.2f} against {seen.gain:.2f}); give a start or a measured length."
        for other, gain in others
        if gain > seen.gain - v.rival_gain
    ]
    verdict: Verdict = "rejected" if wrong else "doubtful" if doubts else "accepted"
    return Judged(verdict=verdict, reasons=(*wrong, *doubts), checks=checks)


def _share_far(look: Outlook, evidence: ScanEvidence, config: ScaleConfig) -> float:
    """Return the share of the object's points that are too far from the mesh to be of it."""
    known = np.abs(look.residuals[np.isfinite(look.residuals)])
    return float(np.mean(known > config.verdict.far_share * evidence.size_m)) if len(known) else 1.0


def _shape_share(look: Outlook, evidence: ScanEvidence) -> float:
    """Return the RMS offset of the surface where it was measured, as a share of the size."""
    offsets = look.offsets[look.offset_sigmas < 2.0 * np.median(look.offset_sigmas)]
    return float(np.sqrt(np.mean(np.square(offsets))) / evidence.size_m)


def _refusals(checks: dict[str, float], config: ScaleConfig) -> list[str]:
    """Return why the result is rejected."""
    v, gain = config.verdict, checks["gain"]
    if gain >= v.reject_gain:
        return []
    return [
        f"the mesh explains {100 * gain:.0f} % of what was measured of the object (what it "
        f"contradicts deducted); {100 * v.least_gain:.0f} % and more are trusted. It is not this "
        "object, or mirrored, or was not found."
    ]


def _doubts_of_object(
    checks: dict[str, float], evidence: ScanEvidence, config: ScaleConfig
) -> Iterator[str]:
    """Yield why the mesh may not be of what stands there."""
    v = config.verdict
    if v.reject_gain <= checks["gain"] < v.least_gain:
        yield (
            f"the mesh explains {100 * checks['gain']:.0f} % of what was measured of the object; "
            f"{100 * v.least_gain:.0f} % and more are trusted."
        )
    if checks["iou"] < v.least_iou:
        yield (
            f"its outline overlaps the measured one by {100 * checks['iou']:.0f} %; "
            f"{100 * v.least_iou:.0f} % and more are trusted."
        )
    if checks["agree"] > v.part_agree and checks["cover"] < v.part_cover:
        yield (
            f"the mesh agrees where it is seen ({100 * checks['agree']:.0f} %) but covers "
            f"{100 * checks['cover']:.0f} % of what stands there: another object touches it, or "
            "the mesh is of a part only. Capture the object alone."
        )
    if checks["far"] > v.most_far:
        yield (
            f"{100 * checks['far']:.1f} % of the measured points lie more than "
            f"{1e3 * v.far_share * evidence.size_m:.0f} mm from the mesh; of the same object at "
            f"most {100 * v.most_far:.0f} % do. A part of it is elsewhere: another object of its "
            "kind?"
        )


def _doubts_of_scale(checks: dict[str, float], config: ScaleConfig) -> Iterator[str]:
    """Yield why the scale may not be known well enough."""
    v = config.verdict
    if checks["shape_share"] > v.worst_shape:
        yield (
            f"the surfaces differ by {100 * checks['shape_share']:.1f} % of the size; meshes of "
            f"the same object differ by less than {100 * v.worst_shape:.0f} %."
        )
    if checks["sigma_percent"] > 100 * v.doubtful_sigma:
        yield (
            f"the scale is known to {checks['sigma_percent']:.1f} % only; "
            f"{100 * v.doubtful_sigma:.1f} % and less are trusted. More views from other sides "
            "help."
        )
