"""Reports compared: a session with itself, both ways round, and with another content."""

import copy
import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import refusals
from realsim import Scene
from realsim.app.register.files import write_result
from realsim.app.report import compare
from realsim.app.report.compare_page import as_json, comparison_of, comparison_page
from realsim.app.report.figures import Figure, count
from realsim.app.report.registering import registration_pairs
from realsim.app.report.session import report_of, write_report
from realsim.app.report.sources import Source, read_stored, sources_of
from realsim.app.stages import save_starts
from realsim.geometry import se3
from realsim.geometry.parts import part
from realsim.store import SessionStore, save_scene
from registered_sessions import models_of, registered_by_hand, table_session, true_poses
from typed_commands import finished, invoked, refused

SHIFT_M = 0.004


@pytest.fixture(scope="module")
def folders(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """Sessions: a; b with one object moved and one view less."""
    root = tmp_path_factory.mktemp("compare")
    for name, left_out, shift_m in (("a", None, 0.0), ("b", 1, SHIFT_M)):
        store = table_session(root / name, views=3)
        result = registered_by_hand(store, left_out=left_out)
        first, *others = result.scene.objects
        moved = se3.from_translation([shift_m, 0, 0]) @ first.T_world_obj
        objects = (replace(first, T_world_obj=moved), *others)
        result = replace(result, scene=replace(result.scene, objects=objects))
        write_result(store, result, models_of(), {})
    return {name: root / name for name in ("a", "b")}


@pytest.fixture(scope="module")
def both(folders: dict[str, Path]) -> list[Source]:
    return sources_of([folders["a"], folders["b"]])


def test_a_report_against_itself_has_no_difference(folders: dict[str, Path]) -> None:
    found = comparison_of(sources_of([folders["a"], folders["a"]]))
    assert all(d.value == 0 and d.outcome == "same" for d in found.figures[0])
    assert [(o.shift_mm, o.turn_deg, o.mssd_mm) for o in found.objects[0]] == [(0, 0, 0)] * 2
    assert found.worse == []


def test_a_against_b_is_the_opposite_of_b_against_a(both: list[Source]) -> None:
    a, b = both
    forward, back = compare.differences(a, b), compare.differences(b, a)
    assert [d.name for d in forward] == [d.name for d in back]
    mirrored = {"better": "worse", "worse": "better"}
    for d, e in zip(forward, back, strict=True):
        assert (d.value is None) == (e.value is None)
        assert d.value is None or e.value is None or d.value == -e.value
        assert d.sigma == e.sigma
        assert d.outcome is None or mirrored.get(d.outcome, d.outcome) == e.outcome
    there, here = (
        [(o.name, o.mssd_mm, o.shift_mm, o.turn_deg, o.sigma_mm) for o in found]
        for found in (compare.object_differences(a, b), compare.object_differences(b, a))
    )
    assert there == here


def test_what_moved_is_told_in_millimetres_and_against_its_noise(both: list[Source]) -> None:
    moved, still = compare.object_differences(*both)
    assert moved.shift_mm == pytest.approx(1e3 * SHIFT_M)
    assert moved.mssd_mm == pytest.approx(1e3 * SHIFT_M)
    assert moved.turn_deg == pytest.approx(0, abs=1e-4)
    assert moved.sigma_mm == pytest.approx(0.3 * np.sqrt(2))
    assert moved.is_moved and not still.is_moved
    by = {d.name: d for d in compare.differences(*both)}
    assert by["registration.views_used"].value == -1
    assert by["registration.views_used"].outcome == "worse"


@pytest.mark.parametrize("name", ["tube", "wedge"])
def test_pose_differences_know_symmetries_and_no_order(name: str) -> None:
    model = part(name)
    rng = np.random.default_rng(4)
    T_a = se3.random_transform(rng, 1, 0.3)[0]
    small = se3.exp(rng.normal(size=6) * np.repeat([0.01, 1e-3], 3))
    S = model.symmetries[rng.integers(len(model.symmetries))]
    for axis, point in model.symmetry_axes:
        p = np.asarray(point)
        turn = se3.exp(np.concatenate([np.asarray(axis) * 2.0, np.zeros(3)]))
        S = se3.from_translation(p) @ turn @ se3.from_translation(-p) @ S
    T_b = T_a @ small
    mine = compare.pose_difference(T_a, T_b, model)
    assert mine == compare.pose_difference(T_b, T_a, model)
    # Turned by a symmetry it is the same pose.
    np.testing.assert_allclose(compare.pose_difference(T_a, T_b @ S, model), mine, atol=2e-3)
    assert compare.pose_difference(T_a, T_a @ S, model)[0] == pytest.approx(0, abs=1e-4)
    # In another world the distances are the same.
    T = se3.random_transform(rng, 1, 1.0)[0]
    np.testing.assert_allclose(compare.pose_difference(T @ T_a, T @ T_b, model), mine, atol=1e-6)


def row(instance: int, obj_id: int) -> dict[str, object]:
    return {
        "instance": instance, "obj_id": obj_id, "name": f"m{obj_id}", "verdict": "accepted",
        "sigma_mm": None, "sigma_deg": None, "probability": None, "T_world_obj": np.eye(4).tolist(),
    }  # fmt: skip


def source(label: str, *objects: dict[str, object]) -> Source:
    return Source(
        label=label, verdict="sound", figures={}, objects=list(objects), series={}, models={}
    )


def test_objects_are_matched_by_number_and_model_then_by_their_only_model() -> None:
    a = source("A", row(0, 1), row(1, 2), row(2, 5), row(3, 5))
    b = source("B", row(0, 1), row(7, 2), row(8, 5), row(2, 9))
    found = {o.name: o for o in compare.object_differences(a, b)}

    def sides(o: compare.ObjectDifference) -> tuple[bool, bool]:
        return o.first is not None, o.second is not None

    assert sides(found["0 m1"]) == sides(found["1 m2"]) == (True, True)
    assert "7 here" in found["1 m2"].note
    # Two of model 5 against one: which is which nobody knows. Number 2 is another model there.
    assert sides(found["2 m5"]) == sides(found["3 m5"]) == (True, False)
    assert sides(found["8 m5"]) == sides(found["2 m9"]) == (False, True)
    assert found["0 m1"].mssd_mm is None and "no mesh" in found["0 m1"].note
    assert found["0 m1"].is_moved is None  # no sigma is known


def test_what_is_no_report_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "report.json"
    for text, named in (
        ("[]", "no stored report"), ('{"schema": "realsim report", "schema_version": 99}', "99"),
        ('{"schema": "realsim report", "schema_version": 1}', "damaged"), ("{", "JSON"),
    ):  # fmt: skip
        path.write_text(text)
        refusals.refused(named, sources_of, [path, path])


def test_exit_codes_and_json_of_a_comparison(folders: dict[str, Path], tmp_path: Path) -> None:
    a, b = folders["a"], folders["b"]
    assert finished("report", a, b, "--quiet").stdout == ""
    done = invoked("report", a, b, "--json", "--quiet", "--fail-if-worse")
    assert done.exit_code == 1 and "registration.views_used" in done.stderr
    document = json.loads(done.stdout)
    assert document["failed"] and len(document["sessions"]) == 2
    out = tmp_path / "c.html"
    done = finished("report", b, b, "--out", out, "--fail-if-worse")
    assert out.is_file() and "every figure is the same" in done.stdout
    refused("report", a, "--fail-if-worse")
    refused("report", a, b, "--truth", tmp_path)


def test_a_difference_within_two_sigmas_is_noise() -> None:
    def outcome(first: Figure, second: Figure) -> str | None:
        return compare.Difference(name=first.name, first=first, second=second).outcome

    def score(value: float, sigma: float | None) -> Figure:
        return Figure(name="school.mean_score", value=value, sigma=sigma)

    for value, told in ((0.59, "same"), (0.61, "better"), (0.39, "worse")):
        assert outcome(score(0.5, 0.03), score(value, 0.04)) == told
    assert outcome(score(0.5, 0.03), score(0.39, None)) == "unknown"
    lower = "registration.doubtful"
    assert outcome(count(lower, 1), count(lower, 2)) == "worse"


def test_the_page_of_three_holds_its_document_and_escapes_names(
    folders: dict[str, Path], both: list[Source]
) -> None:
    hostile = replace(both[1], label="C <script>alert(1)</script>")
    c = comparison_of([*both, hostile])
    text = comparison_page(c).encode().decode()
    assert "<script>alert" not in text
    data = text.partition('id="report">')[2].partition("</script>")[0]
    assert json.loads(data) == json.loads(json.dumps(as_json(c)))
    assert len(json.loads(data)["differences"]) == 2


# --- Sliders in a report, and reports that are files of others ---------------------------------


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
    (lambda d: d.update(missing={"school": 3}), "missing[...]"),
    (lambda d: d.update(stages={"plan": "perhaps"}), "`stages[...]`; accepted: damaged, done"),
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
