"""The verdict without ground truth: every threshold has two sides."""

from dataclasses import replace
from functools import lru_cache

import numpy as np
import pytest

from realsim.geometry import se3
from realsim.scanning.scale.config import ScaleConfig
from realsim.scanning.scale.joint import Outlook, joint_fit
from realsim.scanning.scale.state import ScaleState
from realsim.scanning.scale.verdict import Explained, Judged, explain, judge
from scanned_objects import evidence_of, scanned, shape_of, true_state

CONFIG = ScaleConfig()
V = CONFIG.verdict


@lru_cache(maxsize=1)
def right() -> tuple[ScaleState, Outlook, Explained]:
    shape, evidence, state = truth("bunny")
    state, look = joint_fit(shape, evidence, state, CONFIG)
    return state, look, explain(shape, evidence, state)


def judged(
    sigma: float = 0.002, rivals: tuple[tuple[float, float], ...] = (),
    offsets: float | None = None, **seen: float,
) -> Judged:  # fmt: skip
    """Return the verdict on a right fit in which some figures are other ones."""
    state, look, explained = right()
    if offsets is not None:
        size = evidence_of("bunny", "exact").size_m
        look = replace(look, offsets=np.full_like(look.offsets, offsets * size))
    fit = (state, look, replace(explained, **seen))
    return judge(shape_of("bunny"), evidence_of("bunny", "exact"), fit, rivals, (sigma, CONFIG))


def test_a_right_fit_is_accepted_without_reasons():
    j = judged()
    assert j.verdict == "accepted" and j.reasons == ()
    names = {"gain", "agree", "cover", "iou", "contrast", "shape_mm", "sigma_percent"}
    assert names <= set(j.checks)
    assert all(np.isfinite(v) for v in j.checks.values())
    assert j.checks["sigma_percent"] == pytest.approx(0.2)


@pytest.mark.parametrize(
    ("good", "bad", "verdict", "said"),
    [
        ({"gain": V.least_gain + 0.01}, {"gain": V.least_gain - 0.01}, "doubtful", "explains 49 %"),
        ({"gain": V.least_gain + 0.01}, {"gain": V.reject_gain - 0.01}, "rejected", "mirrored"),
        ({"gain": V.least_gain + 0.01}, {"gain": -0.5}, "rejected", "not this object"),
        ({"iou": V.least_iou + 0.01}, {"iou": V.least_iou - 0.01}, "doubtful", "outline overlaps"),
        ({"sigma": V.doubtful_sigma - 1e-4}, {"sigma": V.doubtful_sigma + 1e-4}, "doubtful",
         "More views from other sides"),
        ({"offsets": V.worst_shape - 1e-3}, {"offsets": V.worst_shape + 1e-3}, "doubtful",
         "surfaces differ by 4.1 %"),
        ({"offsets": -V.worst_shape + 1e-3}, {"offsets": -V.worst_shape - 1e-3}, "doubtful",
         "surfaces differ"),
    ],
)  # fmt: skip
def test_every_threshold_has_two_sides(good, bad, verdict: str, said: str):
    assert judged(**good).verdict == "accepted"
    j = judged(**bad)
    assert j.verdict == verdict
    assert any(said in r for r in j.reasons), j.reasons


def test_a_rival_of_another_scale_that_explains_as_much_raises_doubt():
    gain = right()[2].gain
    for scale, theirs, doubt in (
        (1.2, gain - 0.01, True), (0.8, gain + 0.01, True), (1.2, gain - 0.1, False),
    ):  # fmt: skip
        j = judged(rivals=((right()[0].s * shape_of("bunny").unit * scale, theirs),))
        assert (j.verdict == "doubtful") == doubt
        assert j.checks["contrast"] == pytest.approx(gain - theirs)
        if doubt:
            assert f"{100 * (scale - 1):+.1f} %" in j.reasons[0]
            assert "measured length" in j.reasons[0]
    assert judged().checks["contrast"] == 1.0


def test_patches_that_were_hardly_seen_do_not_speak_for_another_object():
    state, look, explained = right()
    unseen = look.offset_sigmas > 1.5 * np.median(look.offset_sigmas)
    sigmas = np.where(unseen, 10 * np.median(look.offset_sigmas), look.offset_sigmas)
    sigmas[0] = 10 * np.median(look.offset_sigmas)
    offsets = look.offsets.copy()
    offsets[sigmas > 5 * np.median(look.offset_sigmas)] = 0.2
    spoiled = replace(look, offsets=offsets, offset_sigmas=sigmas)
    fit = (state, spoiled, explained)
    j = judge(shape_of("bunny"), evidence_of("bunny", "exact"), fit, (), (0.002, CONFIG))
    assert j.verdict == "accepted"


# --- Rendered against measured: the truth explains everything, too large and too small do not.


def truth(name: str, lab: str = "exact"):
    shape, evidence = shape_of(name), evidence_of(name, lab)
    return shape, evidence, true_state(scanned(name, lab), shape, evidence)


def scaled_about_foot(state: ScaleState, factor: float) -> ScaleState:
    """Return the object at another scale, standing where it stood."""
    foot = np.array([state.t[0], state.t[1], 0.0])
    return shifted(replace(state, s=state.s * factor), (factor - 1) * (state.t - foot))


def shifted(state: ScaleState, step: np.ndarray) -> ScaleState:
    return replace(state, poses=se3.from_translation(step) @ state.poses)


def test_the_truth_explains_everything_without_noise():
    seen = explain(*truth("mug"))
    # A little above one: the foot is told from an empty table, but not counted as the object.
    assert 0.985 < seen.gain < 1.05
    assert seen.agree > 0.985
    assert seen.cover > 0.995
    assert np.all(seen.view_agree > 0.95)


@pytest.mark.parametrize("factor", [0.9, 1.1])
def test_too_small_and_too_large_explain_less(factor: float):
    shape, evidence, state = truth("mug")
    right = explain(shape, evidence, state).gain
    assert explain(shape, evidence, scaled_about_foot(state, factor)).gain < right - 0.15
    # About the middle, the mesh floats or is sunk: worse yet.
    assert explain(shape, evidence, replace(state, s=factor * state.s)).gain < right - 0.3


def test_a_mesh_elsewhere_explains_less_than_nothing():
    """Next to the object, in the views' sight: the cameras looked through there."""
    shape, evidence, state = truth("mug")
    step = 1.1 * (np.ptp(evidence.footprint.box, axis=0)[:2].max())
    for angle in (0.5, 2.6, 4.7):
        away = shifted(state, step * np.array([np.cos(angle), np.sin(angle), 0]))
        seen = explain(shape, evidence, away)
        assert seen.gain < 0.0
        assert seen.cover < 0.25


def test_the_outline_of_an_open_vessel_overlaps_seen_from_above():
    """Its floor lies nearer to the table than what is told from it, and must not count as missed.

    Where such a view falls under `view_share` of the usual overlap, a right view is left out.
    """
    shape, evidence, state = truth("bowl", "lab")
    seen = explain(shape, evidence, state, every=2)
    assert evidence.views[0].index == 0
    assert seen.view_agree[0] > 0.95
    assert seen.view_iou[0] > 0.7 * np.median(seen.view_iou)
