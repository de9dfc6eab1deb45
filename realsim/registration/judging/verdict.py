"""Accepted, doubtful or rejected, and why, in words with numbers."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Literal

import numpy as np

from realsim.records import Verdict

Kind = Literal["views", "no_held_out", "single_view"]
LEAST_ODDS = 0.003
"""Added to both sides of a share before its odds are taken: 3 of 1000 pixels are always off."""
HIDDEN_FREE = 0.3
"""To be hidden up to this share by what is no model speaks against no pose."""
MARGIN, MARGIN_STEP = 0.3, 0.15
"""By how much more likely an object's pixels are than without it, from which on it is needed there,
and by how much less takes `CONTRAST_WEIGHT` from the log-odds: a card on top of a box agrees with
the box. Second lab: right ones 0.4 (a plate of 2 mm) and more, those on another place up to -0.15.
"""
EXPLAINED, EXPLAINED_STEP = 0.99, 0.008
"""Share of the heights around a flat object from which on its pose explains them, and by how much
less takes `CONTRAST_WEIGHT` from the log-odds (second lab: right ones 1.0, those 3 mm off and more
up to 0.966)."""
LOWEST, HIGHEST = 0.0005, 0.9995
"""No check can be surer than what it was calibrated on: some thousand poses."""
CONTRAST_DECIDED = 0.1
"""From this contrast to its rival on, a near-symmetric pose is decided (facts of simulated tables:
right ones have 0.14 to 0.4)."""
CONTRAST_WEIGHT = 3.0
"""What a contrast of 0 takes from the log-odds. Set, not fitted: at a contrast of 0 two poses are
as good as each other, whatever else is right; 20 : 1 becomes 1 : 1."""


def _odds(name: str) -> Callable[[Mapping[str, float]], float]:
    """Return the transform of a share of which more is better."""

    def term(f: Mapping[str, float]) -> float:
        p = float(np.clip(f[name], 0.0, 1.0))
        return float(np.log((p + LEAST_ODDS) / (1.0 - p + LEAST_ODDS)))

    return term


def _root(name: str) -> Callable[[Mapping[str, float]], float]:
    """Return the transform of a share of which less is better: the root spreads small ones."""
    return lambda f: -float(np.sqrt(np.clip(f[name], 0.0, 1.0)))


def _length(name: str, unit: float, most: float) -> Callable[[Mapping[str, float]], float]:
    """Return the transform of a length of which less is better, in `unit`, cut at `most` of it."""
    return lambda f: -float(np.log1p(np.clip(f[name] / unit, 0.0, most)))


def _relative(name: str, unit: float, most: float) -> Callable[[Mapping[str, float]], float]:
    """Return the same of a length that errors common to the session lengthen too.

    Its unit grows with `residual_bound_mm` [mm], which is 1 on the tables of the calibration and up
    to 5 with a camera at 1 m and hand-made meshes.
    """

    def term(f: Mapping[str, float]) -> float:
        bound = f.get("residual_bound_mm", 1.0)
        scale = max(1.0, bound) if np.isfinite(bound) else 1.0
        return -float(np.log1p(np.clip(f[name] / (unit * scale), 0.0, most)))

    return term


TERMS: dict[str, Callable[[Mapping[str, float]], float]] = {
    "agree": _odds("agree"),
    "gain": lambda f: float(np.clip(f["gain"], -1.0, 1.0)),
    "cover": _odds("cover"),
    "free_space_violation": _root("free_space_violation"),
    "hidden": lambda f: -float(np.clip(f["hidden"] - HIDDEN_FREE, 0.0, 1.0)),
    "n_pixels": lambda f: float(np.clip(np.log(max(f["n_pixels"], 1.0) / 1e4), -4.0, 0.0)),
    "residual_median_mm": _relative("residual_median_mm", 0.5, 20.0),
    "penetration_mm": _relative("penetration_mm", 2.0, 20.0),
    "sunk_mm": _relative("sunk_mm", 1.0, 50.0),
    "floating_mm": _relative("floating_mm", 2.0, 50.0),
    "wrong_surface": _root("wrong_surface"),
    "patch_rms": lambda f: -float(np.clip(f["patch_rms"], 0.0, 4.0)),
    "wrong_patch_mm2": _length("wrong_patch_mm2", 30.0, 200.0),
    "looked_through": _root("looked_through"),
    "held_out_shift_mm": _length("held_out_shift_mm", 0.5, 100.0),
    "held_out_agree": _odds("held_out_agree"),
}
"""From checks by name to terms; all grow with the evidence for the pose."""
IMAGES = (
    "agree", "gain", "cover", "free_space_violation", "hidden", "n_pixels", "residual_median_mm",
    "penetration_mm", "sunk_mm", "floating_mm",
)  # fmt: skip
SURFACE = ("wrong_surface", "patch_rms", "wrong_patch_mm2", "looked_through")
HELD_OUT = ("held_out_shift_mm", "held_out_agree")
NAMES: dict[Kind, tuple[str, ...]] = {
    "views": (*IMAGES, *SURFACE, *HELD_OUT),
    "no_held_out": (*IMAGES, *SURFACE),
    "single_view": IMAGES,
}
"""The checks that each set of coefficients needs."""
NEEDED = ("agree", "gain", "cover", "free_space_violation")
"""Without these nothing can be said; others that are missing are taken as unremarkable."""


@dataclass(frozen=True, kw_only=True, slots=True)
class Coefficients:
    """Weights of one set."""

    bias: float
    """b."""
    weights: Mapping[str, float]
    """c_i >= 0 by name; a name that is missing has 0."""
    usual: Mapping[str, float]
    """Term of a check that is missing (no table: neither sunk nor floating): the median of right
    poses; a name that is missing has 0."""


# COEFFICIENTS-BEGIN
COEFFICIENTS: dict[Kind, Coefficients] = {
    "views": Coefficients(
        bias=0.152,
        weights={
            "agree": 0.476,
            "gain": 0.691,
            "cover": 0.432,
            "free_space_violation": 2.511,
            "hidden": 11.473,
            "residual_median_mm": 0.006,
            "penetration_mm": 0.249,
            "sunk_mm": 0.559,
            "floating_mm": 2.227,
            "wrong_surface": 3.027,
            "patch_rms": 0.442,
            "wrong_patch_mm2": 0.519,
            "looked_through": 2.252,
            "held_out_shift_mm": 0.892,
            "held_out_agree": 0.143,
        },
        usual={
            "residual_median_mm": -0.533,
            "sunk_mm": -0.062,
            "held_out_shift_mm": -0.707,
            "held_out_agree": 5.789,
        },
    ),
    "no_held_out": Coefficients(
        bias=-0.738,
        weights={
            "agree": 0.533,
            "gain": 0.753,
            "cover": 0.513,
            "free_space_violation": 2.751,
            "hidden": 10.118,
            "residual_median_mm": 0.123,
            "penetration_mm": 0.156,
            "sunk_mm": 0.644,
            "floating_mm": 2.118,
            "wrong_surface": 3.370,
            "patch_rms": 0.488,
            "wrong_patch_mm2": 0.536,
            "looked_through": 2.033,
        },
        usual={"residual_median_mm": -0.533, "sunk_mm": -0.062},
    ),
    "single_view": Coefficients(
        bias=-2.156,
        weights={
            "agree": 0.994,
            "gain": 1.172,
            "cover": 0.381,
            "free_space_violation": 6.870,
            "hidden": 5.828,
            "residual_median_mm": 1.160,
            "penetration_mm": 0.564,
            "sunk_mm": 0.931,
            "floating_mm": 4.897,
        },
        usual={"residual_median_mm": -0.563, "sunk_mm": -0.077},
    ),
}
# COEFFICIENTS-END


def kind_of(features: Mapping[str, float]) -> Kind:
    """Return which set of coefficients the checks at hand allow."""

    def has(names: tuple[str, ...]) -> bool:
        return all(np.isfinite(features.get(n, np.nan)) for n in names)

    if not has(SURFACE):
        return "single_view"
    return "views" if has(HELD_OUT) else "no_held_out"


def terms_of(features: Mapping[str, float], kind: Kind) -> dict[str, float]:
    """Return the terms of one set; those whose check is missing or not finite are left out."""
    return {n: TERMS[n](features) for n in NAMES[kind] if np.isfinite(features.get(n, np.nan))}


def probability_right(features: Mapping[str, float | None]) -> float:
    """Return the probability that a pose is right within 3 mm.

    Args:
        features: checks by name, as `verify_objects`, `residual_checks`, `HeldOut.checks` and
            `support_checks` return them; also `contrast` to a near-symmetric rival (None = it has
            none). 0 where agree, gain, cover or free_space_violation are missing or not finite:
            what was not seen is not right.
    """
    known = {k: float(v) for k, v in features.items() if v is not None}
    if not all(np.isfinite(known.get(n, np.nan)) for n in NEEDED) or known.get("n_pixels") == 0:
        return 0.0
    kind = kind_of(known)
    c, terms = COEFFICIENTS[kind], terms_of(known, kind)
    score = c.bias
    for name, weight in c.weights.items():
        score += weight * terms.get(name, c.usual.get(name, 0.0))
    contrast = known.get("contrast", CONTRAST_DECIDED)
    score -= CONTRAST_WEIGHT * float(np.clip(1.0 - contrast / CONTRAST_DECIDED, 0.0, 2.0))
    explained = known.get("explained", 1.0)
    score -= CONTRAST_WEIGHT * float(np.clip((EXPLAINED - explained) / EXPLAINED_STEP, 0.0, 4.0))
    margin = known.get("margin", MARGIN)
    score -= CONTRAST_WEIGHT * float(np.clip((MARGIN - margin) / MARGIN_STEP, 0.0, 4.0))
    p = 1.0 / (1.0 + np.exp(-np.clip(score, -40.0, 40.0)))
    return float(np.clip(p, LOWEST, HIGHEST))


ACCEPT = 0.9
"""Least probability of an accepted pose: one in ten of the least sure ones may be wrong."""
ACCEPT_FEW = 0.92
"""The same for one to three views, in which wrong poses are as sure as right ones that are half
hidden; set on the second lab's seeds 6000 to 6007."""
REJECT = 0.1
"""Below this the pose is not to be used."""
INSIDE_MM = 12.0
"""An object further inside another is not accepted, however well it explains the images: a
small one hidden in a large one does. The large one is doubtful too until that is settled."""
AGREE = 0.95
"""Less than this share of agreeing pixels is mentioned."""
GAIN = 0.65
"""A lower mean likelihood is mentioned."""
COVER = 0.90
"""Less cover is mentioned."""
VIOLATION = 0.03
"""A greater share of pixels that the camera saw through is mentioned."""
WRONG_SURFACE = 0.03
"""A greater share of wrong surface is mentioned."""
LOOKED_THROUGH = 0.05
"""A greater share of surface that views saw through is mentioned."""
LENGTH_MM = 2.0
"""Greater lengths (sunk, floating, inside another, moved by the held-out fit) are mentioned."""
PIXELS = 1500.0
"""Fewer visible pixels over all frames are mentioned."""
HIDDEN = 0.7
"""A greater hidden share is mentioned."""


def reasons_of(features: Mapping[str, float | None]) -> tuple[str, ...]:
    """Return what speaks against a pose, each in words with its number."""

    def value(name: str) -> float:
        v = features.get(name)
        return float("nan") if v is None else float(v)

    bound = value("residual_bound_mm")
    contrast = value("contrast")
    low = (
        ("agree", AGREE, "of its visible pixels agree with the depth"),
        ("gain", GAIN, "is the mean likelihood of its visible pixels (1 is the most)"),
        ("cover", COVER, "of its visible surface has a measured point"),
        ("held_out_agree", AGREE, "of the points of views that were not used agree"),
        (
            "margin",
            MARGIN,
            "is by how much likelier its pixels are with it than without (2 at most)",
        ),
        ("explained", EXPLAINED, "of the heights over the table around it are its own"),
    )
    high = (
        ("free_space_violation", VIOLATION, "of its visible pixels were looked through"),
        ("wrong_surface", WRONG_SURFACE, f"of its seen surface is more than {bound:.1f} mm off"),
        ("looked_through", LOOKED_THROUGH, "of its surface was looked through by the views"),
        ("sunk_mm", LENGTH_MM, "mm sunk into the table"),
        ("floating_mm", LENGTH_MM, "mm over the table and everything else"),
        ("penetration_mm", LENGTH_MM, "mm inside another object"),
        ("held_out_shift_mm", LENGTH_MM, "mm between what two halves of the views find"),
        ("hidden", HIDDEN, "of it is hidden by something that is no model"),
    )
    reasons = [f"{value(n):.2f} {words}" for n, limit, words in low if value(n) < limit]
    reasons += [f"{value(n):.2f} {words}" for n, limit, words in high if value(n) > limit]
    if value("n_pixels") < PIXELS:
        reasons.append(f"only {value('n_pixels'):.0f} pixels of it are seen")
    if contrast < CONTRAST_DECIDED:
        reasons.append(
            f"a nearly symmetric pose explains the images as well (contrast {contrast:.2f}, "
            f"{CONTRAST_DECIDED:g} decides): declare the symmetry if both are the same to you, "
            "else look at the photograph"
        )
    return tuple(reasons)


def verdict_of(
    probability: float, features: Mapping[str, float | None]
) -> tuple[Verdict, tuple[str, ...]]:
    """Return the verdict, and the reasons for it unless it is accepted.

    Args:
        probability: that the pose is right, of `probability_right`.
        features: the checks it was told from.
    """
    reasons = reasons_of(features)
    known = {k: float(v) for k, v in features.items() if v is not None}
    undecided = known.get("contrast", np.inf) < CONTRAST_DECIDED
    undecided |= known.get("penetration_mm", 0.0) > INSIDE_MM
    least = ACCEPT_FEW if kind_of(known) == "single_view" else ACCEPT
    if np.isfinite(probability) and probability >= least and not undecided:
        return "accepted", ()
    said = (f"the probability that it is right within 3 mm is {probability:.3f}", *reasons)
    return ("rejected" if probability < REJECT else "doubtful"), said
