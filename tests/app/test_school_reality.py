"""`realsim school reality`: trials judged, a calibration fitted, and what is refused."""

import json
from pathlib import Path

import numpy as np
import pytest

from graspa_folders import box_grasps, write_graspa
from realsim.app.school.inputs import SchoolRequest
from realsim.app.school.run import config_of
from realsim.errors import InputError
from realsim.untrusted.own_json import read_own
from realsim_sim_bridge.hold.calibration import Calibration
from school_sessions import refused, run, scene

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
    found = run("reality", trials, *words, "--out", out, "--fit", fit, "--json")
    assert found.exit_code == 0, found.output
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
    again = run("reality", trials, *words, "--p-hold-calibration", fit, "--json")
    assert again.exit_code == 0 and '"in_sample": true' in again.output
    config = config_of(SchoolRequest(calibration=fit), scene())
    assert config.calibration == told
    with pytest.raises(InputError, match=r"reality\.json"):
        config_of(SchoolRequest(calibration=out / "reality.json"), scene())
    assert "one of them" in refused("reality", trials, "--fit", fit, "--p-hold-calibration", fit)


def test_trials_of_a_known_object_that_all_ended_alike_are_told(tmp_path: Path) -> None:
    Ts, _ = box_grasps()
    write_graspa(tmp_path, "chips_can", Ts[3:5], [True, True])
    found = run("reality", tmp_path, "--draws", 2)
    assert found.exit_code == 0, found.output
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
