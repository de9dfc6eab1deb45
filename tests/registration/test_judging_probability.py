"""The probability that a pose is right: monotone, careful with gaps; verdicts in words."""

from itertools import product

import numpy as np

from realsim.registration.judging.verdict import (
    CONTRAST_DECIDED,
    HELD_OUT,
    SURFACE,
    probability_right,
    verdict_of,
)

GOOD = {
    "agree": 0.995,
    "gain": 0.94,
    "cover": 0.995,
    "free_space_violation": 0.003,
    "hidden": 0.01,
    "n_pixels": 40_000.0,
    "residual_median_mm": 0.33,
    "penetration_mm": 0.2,
    "sunk_mm": 0.1,
    "floating_mm": 0.0,
    "wrong_surface": 0.001,
    "patch_rms": 0.1,
    "wrong_patch_mm2": 5.0,
    "looked_through": 0.002,
    "residual_bound_mm": 1.0,
    "held_out_shift_mm": 0.4,
    "held_out_agree": 0.99,
}
BAD = {
    "agree": 0.5,
    "gain": 0.1,
    "cover": 0.5,
    "free_space_violation": 0.4,
    "hidden": 0.4,
    "n_pixels": 500.0,
    "residual_median_mm": 2.5,
    "penetration_mm": 15.0,
    "sunk_mm": 10.0,
    "floating_mm": 15.0,
    "wrong_surface": 0.5,
    "patch_rms": 2.5,
    "wrong_patch_mm2": 1500.0,
    "looked_through": 0.4,
    "held_out_shift_mm": 8.0,
    "held_out_agree": 0.7,
}


def without(names):
    return {k: v for k, v in GOOD.items() if k not in names}


def test_good_checks_are_believed_and_bad_ones_are_not():
    assert probability_right(GOOD) > 0.97
    assert probability_right(without(HELD_OUT)) > 0.95
    assert probability_right(without((*HELD_OUT, *SURFACE))) > 0.8
    for kept in (GOOD, without(HELD_OUT), without((*HELD_OUT, *SURFACE))):
        assert probability_right({k: BAD.get(k, v) for k, v in kept.items()}) < 0.01


def test_more_evidence_never_lowers_it():
    every = (GOOD, without(HELD_OUT), without((*HELD_OUT, *SURFACE)))
    for name, kept in product(sorted(BAD), every):
        steps = np.linspace(0, 1, 15)
        told = [
            probability_right({**kept, name: (1 - t) * BAD[name] + t * GOOD[name]})
            for t in steps
            if name in kept
        ]
        assert np.all(np.diff(told) >= 0)


def test_what_was_not_seen_is_not_right_and_no_table_is_no_reproach():
    assert probability_right({**GOOD, "n_pixels": 0.0}) == 0.0
    assert probability_right({**GOOD, "agree": float("nan")}) == 0.0
    assert probability_right({}) == 0.0
    assert probability_right(without(("sunk_mm", "floating_mm"))) > 0.95


def test_an_undecided_rival_makes_it_doubtful():
    decided = probability_right({**GOOD, "contrast": 2 * CONTRAST_DECIDED})
    assert decided == probability_right({**GOOD, "contrast": None}) == probability_right(GOOD)
    assert probability_right({**GOOD, "contrast": 0.0}) < decided
    verdict, reasons = verdict_of(0.99, {**GOOD, "contrast": 0.02})
    assert verdict == "doubtful"
    assert any("0.02" in r and "symmetric" in r for r in reasons)


def test_verdicts_have_reasons_with_numbers_in_words():
    assert verdict_of(0.99, GOOD) == ("accepted", ())
    features = {**GOOD, "wrong_surface": 0.12}
    verdict, reasons = verdict_of(0.5, features)
    assert verdict == "doubtful"
    assert "0.12 of its seen surface is more than 1.0 mm off" in reasons
    verdict, reasons = verdict_of(0.001, {**GOOD, **BAD})
    assert verdict == "rejected"
    assert len(reasons) > 8
    assert all(any(ch.isdigit() for ch in r) for r in reasons)


def test_what_is_deep_inside_another_object_is_never_accepted():
    verdict, reasons = verdict_of(0.99, {**GOOD, "penetration_mm": 29.5})
    assert verdict == "doubtful"
    assert "29.50 mm inside another object" in reasons
    assert verdict_of(0.99, {**GOOD, "penetration_mm": 3.0})[0] == "accepted"
