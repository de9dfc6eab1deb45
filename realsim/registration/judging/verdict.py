"""Accepted, doubtful or rejected, and why, in words with numbers."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from realsim.records import Verdict
from realsim.registration.judging.probability import CONTRAST_DECIDED


@dataclass(frozen=True, kw_only=True, slots=True)
class VerdictConfig:
    """From where on a pose is accepted, and which checks are worth a word."""

    accept: float = 0.9
    """Least probability of an accepted pose: one in ten of the least sure ones may be wrong."""
    reject: float = 0.1
    """Below this the pose is not to be used."""
    contrast: float = CONTRAST_DECIDED
    """Least contrast of an accepted pose that has a near-symmetric rival."""
    inside_mm: float = 12.0
    """An object further inside another is not accepted, however well it explains the images: a
    small one hidden in a large one does. The large one is doubtful too until that is settled."""
    agree: float = 0.95
    """Less than this share of agreeing pixels is mentioned."""
    gain: float = 0.65
    """A lower mean likelihood is mentioned."""
    cover: float = 0.90
    """Less cover is mentioned."""
    violation: float = 0.03
    """A greater share of pixels that the camera saw through is mentioned."""
    wrong_surface: float = 0.03
    """A greater share of wrong surface is mentioned."""
    looked_through: float = 0.05
    """A greater share of surface that views saw through is mentioned."""
    length_mm: float = 2.0
    """Greater lengths (sunk, floating, inside another, moved by the held-out fit) are mentioned."""
    pixels: float = 1500.0
    """Fewer visible pixels over all frames are mentioned."""
    hidden: float = 0.7
    """A greater hidden share is mentioned."""


def reasons_of(features: Mapping[str, float | None], config: VerdictConfig) -> tuple[str, ...]:
    """Return what speaks against a pose, each in words with its number."""

    def value(name: str) -> float:
        v = features.get(name)
        return float("nan") if v is None else float(v)

    bound = value("residual_bound_mm")
    contrast = value("contrast")
    c = config
    low = (
        ("agree", c.agree, "of its visible pixels agree with the depth"),
        ("gain", c.gain, "is the mean likelihood of its visible pixels (1 is the most)"),
        ("cover", c.cover, "of its visible surface has a measured point"),
        ("held_out_agree", c.agree, "of the points of views that were not used agree"),
    )
    high = (
        ("free_space_violation", c.violation, "of its visible pixels were looked through"),
        ("wrong_surface", c.wrong_surface, f"of its seen surface is more than {bound:.1f} mm off"),
        ("looked_through", c.looked_through, "of its surface was looked through by the views"),
        ("sunk_mm", c.length_mm, "mm sunk into the table"),
        ("floating_mm", c.length_mm, "mm over the table and everything else"),
        ("penetration_mm", c.length_mm, "mm inside another object"),
        ("held_out_shift_mm", c.length_mm, "mm between what two halves of the views find"),
        ("hidden", c.hidden, "of it is hidden by something that is no model"),
    )
    reasons = [f"{value(n):.2f} {words}" for n, limit, words in low if value(n) < limit]
    reasons += [f"{value(n):.2f} {words}" for n, limit, words in high if value(n) > limit]
    if value("n_pixels") < c.pixels:
        reasons.append(f"only {value('n_pixels'):.0f} pixels of it are seen")
    if contrast < c.contrast:
        reasons.append(
            f"a nearly symmetric pose explains the images as well (contrast {contrast:.2f}, "
            f"{c.contrast:g} decides)"
        )
    return tuple(reasons)


def verdict_of(
    probability: float, features: Mapping[str, float | None], config: VerdictConfig
) -> tuple[Verdict, tuple[str, ...]]:
    """Return the verdict, and the reasons for it unless it is accepted.

    Args:
        probability: that the pose is right, of `probability_right`.
        features: the checks it was told from.
        config: see there.
    """
    reasons = reasons_of(features, config)
    contrast = features.get("contrast")
    undecided = contrast is not None and contrast < config.contrast
    inside = features.get("penetration_mm")
    undecided |= inside is not None and inside > config.inside_mm
    if np.isfinite(probability) and probability >= config.accept and not undecided:
        return "accepted", ()
    said = (f"the probability that it is right within 3 mm is {probability:.3f}", *reasons)
    return ("rejected" if probability < config.reject else "doubtful"), said
