"""The figures of a report: every number with its unit, its sigma, and which way is better.

Names are stable: scripts, limits and comparisons are written against them.

What every figure of a report says: its unit, which way is better, and its meaning in words.

Names are stable: scripts, limits and comparisons are written against them.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np

from realsim.arrays import Array
from realsim.errors import InputError
from realsim.untrusted.values import mapping, number

Better = Literal["lower", "higher", "none"]


@dataclass(frozen=True, kw_only=True, slots=True)
class Meaning:
    """What a figure says, whatever its value."""

    unit: str
    """'' = a plain number."""
    better: Better
    text: str


def _is(unit: str, better: Better, text: str) -> Meaning:
    return Meaning(unit=unit, better=better, text=text)


CATALOGUE: dict[str, Meaning] = {
    "report.bad": _is("", "lower", "things that speak against using the session"),
    "report.warnings": _is("", "lower", "things to look at before it is used"),
    "calibration.sigma_mm": _is(
        "mm", "lower", "1 sigma of the camera's place in the hand, worst axis"
    ),
    "calibration.sigma_deg": _is("deg", "lower", "1 sigma of its rotation, worst axis"),
    "calibration.held_out_px": _is(
        "px", "lower", "RMS reprojection of board views the fit has not seen"
    ),
    "calibration.view_rms_px": _is(
        "px", "lower", "median over the board views of their RMS reprojection"
    ),
    "calibration.mismatch_deg": _is(
        "deg", "lower", "how far hand and camera turn differently: reading and pairing of the poses"
    ),
    "calibration.views_used": _is("", "higher", "board views used"),
    "calibration.views_rejected": _is("", "lower", "board views left out"),
    "calibration.checks_bad": _is("", "lower", "checks of the calibration that are bad"),
    "calibration.checks_warn": _is("", "lower", "checks of the calibration that warn"),
    "calibration.camera_x_mm": _is("mm", "none", "camera in the hand, x of the tool"),
    "calibration.camera_y_mm": _is("mm", "none", "camera in the hand, y of the tool"),
    "calibration.camera_z_mm": _is("mm", "none", "camera in the hand, z of the tool"),
    "calibration.fx_px": _is("px", "none", "focal length along the rows"),
    "calibration.fy_px": _is("px", "none", "focal length along the columns"),
    "calibration.depth_scale": _is("", "none", "true inverse depth over measured one"),
    "plan.views": _is("", "none", "views of the plan"),
    "plan.tour_s": _is("s", "lower", "time of the planned tour, settling included"),
    "plan.hole_deg": _is("deg", "lower", "radius of the largest gap between viewing directions"),
    "plan.clearance_mm": _is("mm", "higher", "least clearance of the planned moves"),
    "plan.in_view_min": _is(
        "", "higher", "least share of the scene's points that a planned view sees"
    ),
    "capture.views": _is("", "higher", "views captured"),
    "capture.views_missing": _is("", "lower", "views planned and not captured"),
    "capture.seconds": _is("s", "lower", "time from the first to the last view"),
    "capture.retakes": _is("", "lower", "photographs taken again because a check refused them"),
    "capture.settle_s": _is("s", "lower", "median time until the arm stood still"),
    "capture.sharpness": _is("", "higher", "median sharpness of the photographs"),
    "capture.saturated": _is("", "lower", "largest share of saturated pixels of a photograph"),
    "capture.depth_fill": _is("", "higher", "median share of pixels with depth, near the middle"),
    "registration.objects": _is("", "none", "objects placed"),
    "registration.accepted": _is("", "higher", "objects accepted, by checks or by a reviewer"),
    "registration.doubtful": _is("", "lower", "objects doubtful"),
    "registration.rejected": _is("", "lower", "objects rejected"),
    "registration.not_placed": _is("", "lower", "objects looked for and not placed"),
    "registration.probability_min": _is(
        "", "higher", "least probability that an object is right within 3 mm"
    ),
    "registration.agree_min": _is(
        "", "higher", "least share of an object's visible pixels whose depth fits its pose"
    ),
    "registration.sigma_mm_max": _is(
        "mm", "lower", "largest 1 sigma of an object's position, worst axis"
    ),
    "registration.sigma_deg_max": _is(
        "deg",
        "lower",
        "largest 1 sigma of an object's rotation, turns about its own axis of revolution set aside",
    ),
    "registration.views_used": _is("", "higher", "views the objects were registered in"),
    "registration.views_left_out": _is("", "lower", "views that took no part"),
    "registration.view_sigma_px": _is(
        "px", "lower", "median over the views of 1 sigma of their median object"
    ),
    "registration.camera_shift_mm": _is(
        "mm", "none", "median shift of the cameras by the refinement"
    ),
    "registration.camera_turn_deg": _is(
        "deg", "none", "median turn of the cameras by the refinement"
    ),
    "registration.hand_eye_shift_mm": _is("mm", "none", "shift of all cameras together (hand-eye)"),
    "registration.plane_rms_mm": _is(
        "mm", "lower", "RMS distance of the table's points from its plane"
    ),
    "review.decided": _is("", "higher", "objects a person has accepted or rejected as they stand"),
    "review.open": _is("", "lower", "objects not accepted that nobody has decided on"),
    "review.corrections": _is("", "none", "standing moves, swaps and marks of symmetry"),
    "review.excluded_views": _is("", "none", "views that reviewers left out"),
    "school.candidates": _is("", "none", "grasp candidates"),
    "school.good": _is("", "none", "grasps with a score of 0.5 or more"),
    "school.reachable_share": _is("", "higher", "share of the tried grasps that the arm gets to"),
    "school.close_share": _is("", "higher", "share of the tried grasps that close on the object"),
    "school.pendulum_share": _is(
        "", "higher", "share of the tried grasps that pass all four stages"
    ),
    "school.good_share": _is("", "higher", "share of the tried grasps with a score of 0.5 or more"),
    "school.mean_score": _is("", "higher", "mean score of the tried grasps"),
    "school.mean_p_hold": _is("", "higher", "mean p_hold of the grasps that the arm reaches"),
    "school.p_hold_entropy_bits": _is("bit", "none", "entropy of p_hold over ten equal bins"),
    "school.slip_mm": _is(
        "mm", "lower", "median of the largest slip of the grasps that kept their object"
    ),
    "school.objects_without_grasp": _is("", "lower", "objects without a good grasp"),
    "labels.frames": _is("", "higher", "frames with labels"),
    "labels.frames_flagged": _is(
        "", "lower", "frames where depth contradicts a pose or the scene's occlusion"
    ),
    "labels.visibility_mean": _is("", "none", "mean visible share of an object in a frame"),
    "labels.depth_agree": _is(
        "", "higher", "median share of a mask's measured pixels whose depth fits the label"
    ),
    "labels.hidden_by_unknown": _is(
        "", "lower", "share of object pixels hidden by what is not in the scene"
    ),
    "files.listed": _is("", "none", "files with a checksum"),
    "files.megabytes": _is("MB", "none", "their size"),
    "files.damaged": _is("", "lower", "files missing or changed since they were written"),
    "truth.handeye_mm": _is("mm", "lower", "hand-eye against the truth, translation"),
    "truth.handeye_deg": _is("deg", "lower", "hand-eye against the truth, rotation"),
    "truth.object_mssd_mm": _is("mm", "lower", "median MSSD of the objects against the truth"),
    "truth.object_mssd_max_mm": _is("mm", "lower", "worst MSSD of the objects against the truth"),
    "truth.mask_iou": _is("", "higher", "mean overlap of the visible masks with the true ones"),
}
"""In the order of the report."""


NOT_A_FIGURE = "has no figure of this name"


@dataclass(frozen=True, slots=True)
class Figure:
    """One figure of one session."""

    name: str
    value: float
    sigma: float | None = None
    """1 sigma in the same unit; 0 = exact (a count); None = not known."""

    def __post_init__(self) -> None:
        """Check that there is such a figure and that it has a value.

        Raises:
            InputError: an unknown name, or no finite number.
        """
        if self.name not in CATALOGUE:
            raise InputError(f"a report {NOT_A_FIGURE}: '{self.name}'.")
        if not math.isfinite(self.value):
            raise InputError(f"the figure {self.name} is {self.value}; a number is needed.")
        if self.sigma is not None and not math.isfinite(self.sigma):
            object.__setattr__(self, "sigma", None)

    @property
    def meaning(self) -> Meaning:
        """Return unit, direction and text."""
        return CATALOGUE[self.name]

    @property
    def shown(self) -> str:
        """Return the value with its sigma, without the unit."""
        return shown(self.value, self.sigma)


def count(name: str, value: int) -> Figure:
    """Return an exact figure."""
    return Figure(name=name, value=float(value), sigma=0.0)


def share(name: str, part: int, whole: int) -> Figure:
    """Return a share with the sigma of its binomial, by Agresti and Coull with z = 1.

    sigma = sqrt(p (1 - p) / n') with p = (k + 1/2) / n', n' = n + 1: not 0 where all or none did.
    (Agresti and Coull, The American Statistician 52, 1998.)
    """
    p = (part + 0.5) / (whole + 1)
    return Figure(name=name, value=part / whole, sigma=math.sqrt(p * (1 - p) / (whole + 1)))


def mean_error(values: Array) -> float:
    """Return the standard error of a mean; NaN of fewer than two."""
    return float(np.std(values, ddof=1) / np.sqrt(len(values))) if len(values) > 1 else math.nan


MEDIAN_SCATTER = 1.2533
"""The median of many normal values scatters so many times as much as their mean."""


def shown(value: float, sigma: float | None) -> str:
    """Return a value with its sigma, both to the digits that say something."""
    if sigma is not None and sigma > 0 and math.isfinite(sigma):
        digits = max(0, min(9, 1 - math.floor(math.log10(sigma))))
        return f"{value:.{digits}f} ± {sigma:.{digits}f}"
    if value == int(value) and abs(value) < 1e15 and sigma == 0:
        return f"{int(value)}"
    return f"{value:.4g}"


def require_known(name: str) -> None:
    """Raise if there is no such figure.

    Raises:
        InputError: unknown; lists those that there are.
    """
    if name not in CATALOGUE:
        raise InputError(
            f"a report {NOT_A_FIGURE}: '{name}'. There are: {', '.join(sorted(CATALOGUE))}."
        )


def figures_to_json(figures: Mapping[str, Figure]) -> dict[str, Any]:
    """Return name -> value, unit, sigma (null = not known), better, meaning."""
    return {
        name: {
            "value": f.value,
            "unit": f.meaning.unit,
            "sigma": f.sigma,
            "better": f.meaning.better,
            "meaning": f.meaning.text,
        }
        for name, f in figures.items()
    }


def figures_from_json(value: Any) -> dict[str, Figure]:
    """Return the figures of a stored report; names that this version does not know are left out.

    Raises:
        InputError: not the figures of a report, or in other units; names the field.
    """
    found: dict[str, Figure] = {}
    for name, told in mapping(value, "'figures'").items():
        where = f"'figures.{name:.60}'"
        row = {"value": None, "sigma": math.nan, "unit": None} | mapping(told, where)
        figure_value = number(row["value"], f"{where}.value")
        sigma = row["sigma"]
        sigma = None if sigma is None else number(sigma, f"{where}.sigma", 0.0)
        if name not in CATALOGUE:
            continue
        unit = CATALOGUE[name].unit
        if row["unit"] != unit:
            raise InputError(f"{where} has the unit {row['unit']!r:.60}; '{unit}' is expected.")
        found[name] = Figure(name=name, value=figure_value, sigma=sigma)
    return found
