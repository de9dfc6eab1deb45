"""`realsim school reality`: trials judged, a calibration fitted, and what is refused.

The school's tables and page, from sets alone.
"""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import refusals
from graspa_folders import box_grasps, write_graspa
from realsim.app.school import tables
from realsim.app.school.inputs import SchoolRequest
from realsim.app.school.run import config_of
from realsim.geometry.parts import part
from realsim.untrusted.own_json import read_own
from realsim_sim_bridge.hold.calibration import Calibration
from school_sessions import finished, refused, scene
from tried_grasps import tried_set

KINDS = ("chips_can", "gelatin_box", "wooden_box")


@pytest.fixture
def trials(tmp_path: Path) -> Path:
    """Return trials of three boxes; one good grasp of each slipped, one bad one held."""
    Ts, held = box_grasps()
    for name in KINDS:
        write_graspa(tmp_path / "trials", name, Ts, [not held[0], *held[1:-1], not held[-1]])
    return tmp_path / "trials"


def test_trials_are_judged_and_a_calibration_is_fitted_on_them(trials: Path) -> None:
    out, fit = trials.parent / "out", trials.parent / "fit.json"
    masses = ("--weighed", "wooden_box=0.1", "--weighed", "chips_can=0.1")
    words = ("--draws", 2, *masses, "--cache", trials.parent / "cache")
    finished("reality", trials, *words, "--out", out, "--fit", fit, "--json")
    report = json.loads((out / "reality.json").read_text())
    assert report["in_sample"] is True and len(report["p_hold"]) == 24
    assert report["predictors"]["p_hold"]["auc"] > 0.7
    assert report["predictors"]["always holds"]["auc"] == 0.5
    assert (out / "reliability.png").read_bytes()[:4] == b"\x89PNG"
    told = read_own(fit, Calibration)
    assert (told.trials, told.objects, told.held_share) == (24, KINDS, 0.5)
    # Bad grasps held in 1 of 4 and good ones in 3 of 4: what the curve must say of 0 and 1.
    np.testing.assert_allclose(told.p_hold(np.array([0.0, 1.0])), [0.25, 0.75], atol=0.02)
    # It serves the next run and the school, which refuse what is no calibration.
    again = finished("reality", trials, *words, "--p-hold-calibration", fit, "--json")
    assert '"in_sample": true' in again.output
    config = config_of(SchoolRequest(calibration=fit), scene())
    assert config.calibration == told
    none = SchoolRequest(calibration=out / "reality.json")
    refusals.refused(r"reality\.json", config_of, none, scene())
    assert "one of them" in refused("reality", trials, "--fit", fit, "--p-hold-calibration", fit)


def test_trials_of_a_known_object_that_all_ended_alike_are_told(tmp_path: Path) -> None:
    Ts, _ = box_grasps()
    write_graspa(tmp_path, "chips_can", Ts[3:5], [True, True])
    found = finished("reality", tmp_path, "--draws", 2)
    assert "fitted on trials of chips_can too" in " ".join(found.output.split())
    assert "all trials ended alike" in found.output and "nan" not in found.output


@pytest.mark.parametrize(
    ("words", "told"),
    [
        (("--weighed", "wooden=0.1"), "'wooden', which no trial is of; there are chips_can"),
        (("--weighed", "wooden_box=-1"), "no weighed object"),
        (("--draws", "1"), "2 draws or more"),
        (("--cell-error", "8", "3", "-10", "3"), "--cell-error has -10 for yaw"),
        (("--cell-error", "1e9", "3", "10", "3"), "0 to 180 is accepted"),
    ],
)
def test_what_cannot_be_is_refused(trials: Path, words: tuple[str, ...], told: str) -> None:
    assert told in refused("reality", trials, *words)


def test_a_folder_of_another_layout_is_refused(tmp_path: Path) -> None:
    said = refused("reality", tmp_path)
    assert "no folder 'layouts'" in said and "GRASPA" in said


def test_rows_add_up_and_levels_only_rise() -> None:
    rng = np.random.default_rng(5)
    sets = [tried_set(rng, 40, obj_id=2, instance=k) for k in range(3)]
    models = {2: part("cube")}
    header, rows = tables.school_table(sets, models)
    assert header == tables.SCHOOL_HEADER
    plain = [replace(s, measures={}) for s in sets]
    assert tables.school_table(plain, models)[0] == tables.SCHOOL_HEADER[:9]
    assert not tables.p_hold_line(plain)
    assert tables.p_hold_line(sets).startswith("p_hold of ")
    assert "estimate" not in tables.p_hold_line(sets)  # they are of Franka's hand
    own = [replace(s, parameters={"config": {"hand": {"name": "wide"}}}) for s in sets]
    assert "for wide it is an estimate" in tables.p_hold_line(own)
    for column in range(1, 8):
        assert int(rows[-1][column]) == sum(int(r[column]) for r in rows[:-1])
    assert [r[0] for r in rows] == ["0 cube", "1 cube", "2 cube", "all"]
    levels, share = tables.survivors(sets[0], "least_friction", "frictions")
    assert np.all(np.diff(levels) < 0) and np.all(np.diff(share) <= 0)
    assert [t[0] for t in tables.level_tables(sets, models)] == ["friction", "force [N]"]
    assert sum(tables.reasons(sets).values()) == sum(bool(f) for s in sets for f in s.failures)


def test_shapes_that_make_labels_doubtful_are_named() -> None:
    rng = np.random.default_rng(7)
    sound = {"convex": {"volume_ratio": 1.02}, "watertight": True}
    fat = {"convex": {"volume_ratio": 1.41}, "watertight": True}
    open_mesh = {"convex": {"volume_ratio": 0.8}, "watertight": False}
    sets = [
        replace(tried_set(rng, 3, instance=k), parameters=p)
        for k, p in enumerate((sound, fat, open_mesh, {}))
    ]
    words = list(tables.doubts(sets, {}))
    assert [w[0] for w in words] == ["1", "2", "2"]
    assert "1.41 times" in words[0] and "0.80 of" in words[1] and "not closed" in words[2]


def test_reasons_lose_their_figures_and_keep_their_words() -> None:
    one = tried_set(np.random.default_rng(5), 3)
    told = (
        "lift: the object's weight is 3.4 times what the grasp bears; not simulated",
        "lift: the object's weight is 7.0 times what the grasp bears; not simulated",
        "lift: the object slipped 21.3 mm and turned 4.0 deg",
    )
    assert tables.reasons([replace(one, failures=told)]) == {
        "lift: the object's weight is more than the grasp bears": 2,
        "lift: the object slipped or turned too far": 1,
    }
