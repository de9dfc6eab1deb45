"""Rendered against measured: the truth explains everything, too large and too small do not."""

from dataclasses import replace

import numpy as np
import pytest

from realsim.geometry import se3
from realsim.scanning.scale.state import ScaleState
from realsim.scanning.scale.verdict import explain
from scanned_objects import evidence_of, scanned, shape_of, true_state


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
