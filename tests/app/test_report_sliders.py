"""Sliders in the report: the outlines before and after, where there is a before.

Stored reports are files of others: what is not as `realsim report` writes it is named.
"""

import copy
import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from realsim import Scene
from realsim.app.register.files import write_result
from realsim.app.report.session import report_of, write_report
from realsim.app.report.sliders import registration_pairs
from realsim.app.report.sources import read_stored
from realsim.app.stages import save_starts
from realsim.geometry import se3
from realsim.store import SessionStore, save_scene
from registered_sessions import models_of, registered_by_hand, table_session, true_poses
from typed_commands import refused


@pytest.fixture
def store(tmp_path: Path) -> SessionStore:
    store = table_session(tmp_path / "s", views=4, sigma=(0.0, 0.0))
    save_scene(store, Scene(name="two", objects=tuple(true_poses()), plane=None))
    return store


def coloured(picture: object) -> np.ndarray:
    assert isinstance(picture, np.ndarray)
    return np.ptp(picture.astype(int), axis=-1) > 40


def test_the_outline_moves_from_the_start_onto_the_object(store: SessionStore) -> None:
    aside = se3.from_translation([0.02, 0.0, 0.0])
    starts = [replace(o, T_world_obj=aside @ o.T_world_obj) for o in true_poses()]
    save_starts(store, starts, "a rough guess")
    pairs, before = registration_pairs(store)
    assert "2 of 2 objects at the rough pose" in before and "cameras" not in before
    assert [p.caption for p in pairs] == ["view 0", "view 2", "view 3"]
    for p in pairs:
        on_object = store.rgb(int(p.caption.split()[1]))[..., 0] == 200
        # After, the outline lies within the object; before, it does not.
        assert np.mean(on_object[coloured(p.pictures["registered"])]) > 0.99
        assert np.mean(on_object[coloured(p.pictures["before"])]) < 0.9


def test_without_a_before_there_are_no_sliders(store: SessionStore) -> None:
    assert registration_pairs(store) == ([], "")
    clicked = {"starts": [{"instance": 0, "click": [3, 80, 60]}]}
    store.write_json("registration/starts.json", clicked)
    assert registration_pairs(store) == ([], "")


Document = dict[str, Any]


@pytest.fixture(scope="module")
def document(tmp_path_factory: pytest.TempPathFactory) -> Document:
    store = table_session(tmp_path_factory.mktemp("stored") / "s", views=2)
    write_result(store, registered_by_hand(store), models_of(), {})
    page = write_report(store, report_of(store, pictures="kept"))
    return json.loads((page.parent / "report.json").read_text("utf-8"))


def test_what_a_report_says_is_read_as_it_was_written(document: Document, tmp_path: Path) -> None:
    path = tmp_path / "r.json"
    path.write_text(json.dumps(document))
    read = read_stored(path, "A r")
    assert read.verdict == document["verdict"] and set(read.figures) == set(document["figures"])
    for a, b in zip(read.objects, document["objects"], strict=True):
        assert a["T_world_obj"] == b["T_world_obj"]
    assert set(read.series) == set(document["series"])


FIGURE = "registration.accepted"
SERIES = {"calibration.view_rms_px": {"view": [0], "value": []}}
DAMAGES: list[tuple[Callable[[Document], Any], str]] = [
    (lambda d: d.update(session=[]), "session"),
    (lambda d: d.update(missing={"school": 3}), "missing.school"),
    (lambda d: d.update(stages={"plan": "perhaps"}), "stages.plan"),
    (lambda d: d.update(findings=[{"severity": "bad"}]), "section"),
    (lambda d: d.update(figures={}), "report.bad"),
    (lambda d: d["figures"][FIGURE].update(value="7"), FIGURE),
    (lambda d: d.update(verdict=["sound"]), "verdict"),
    (lambda d: d["series"].update(SERIES), "view_rms_px"),
    (lambda d: d["objects"][0].update(verdict="good"), "objects[0]"),
    (lambda d: d["objects"][0].update(T_world_obj=[[1, 0], [0, 1]]), "T_world_obj"),
    (lambda d: d["objects"].append(d["objects"][0]), "2 times"),
]


@pytest.mark.parametrize("k", range(len(DAMAGES)))
def test_a_damaged_field_is_named_with_its_file(document: Document, tmp_path: Path, k: int) -> None:
    change, named = DAMAGES[k]
    damaged = copy.deepcopy(document)
    change(damaged)
    good, bad = tmp_path / "good.json", tmp_path / "bad.json"
    good.write_text(json.dumps(document))
    bad.write_text(json.dumps(damaged))
    said = refused("report", good, bad, "--quiet")
    assert "bad.json" in said and named in said


def test_a_stored_report_that_is_missing_is_told_as_a_file(tmp_path: Path) -> None:
    missing = tmp_path / "x.json"
    for given in ((missing,), (missing, missing)):
        assert "x.json' is not there" in refused("report", *given)
