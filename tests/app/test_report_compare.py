"""Reports compared: a session with itself, both ways round, and with another content."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from realsim.app.register.files import write_result
from realsim.app.report import compare
from realsim.app.report.compare_page import as_json, comparison_of, comparison_page
from realsim.app.report.figures import Figure, count
from realsim.app.report.sources import Source, sources_of
from realsim.errors import InputError
from realsim.geometry import se3
from realsim.geometry.parts import part
from registered_sessions import models_of, registered_by_hand, table_session
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
        with pytest.raises(InputError, match=named):
            sources_of([path, path])


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
