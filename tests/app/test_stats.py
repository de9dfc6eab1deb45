"""Laws of the statistics: parts add up, order does not matter, figures are counted by hand."""

import csv
import json
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from realsim.app.annotate.current import annotate_session
from realsim.app.console import Console
from realsim.app.stats.collect import session_facts
from realsim.app.stats.statistics import all_rows, same_content, statistics_of
from realsim.store import load_scene, save_grasps, save_scene
from synthetic_scenes import captured_session
from tried_grasps import plain_grasps
from typed_commands import finished, refused

QUIET = Console(quiet=True)
#        (score, base score, reachable, closes at)
GRASPS = {
    0: [
        (1.0, 1.0, True, 0.2), (0.75, 0.75, True, 0.4), (0.25, 0.5, True, 0.6),
        (0.0, 0.0, False, np.nan),
    ],
    3: [(0.5, 0.5, True, np.inf), (0.2, 0.25, True, 0.2), (0.0, 0.0, True, 0.4)],
}  # fmt: skip


def grasp_set(instance, obj_id):
    score, base, reachable, friction = (np.array(x) for x in zip(*GRASPS[instance], strict=True))
    stage = np.arange(4) / 4
    slip = np.where(stage < base[:, None], 1e-3, np.where(stage == base[:, None], np.inf, np.nan))
    slip[~reachable.astype(bool)] = np.nan
    return plain_grasps(
        len(score), obj_id=obj_id, instance=instance, widths_m=np.full(len(score), 0.04),
        scores=score, base_scores=base, slip_m=slip, slip_rad=slip,
        reachable=reachable.astype(bool), measures={"closure_friction": friction},
    )  # fmt: skip


@pytest.fixture(scope="module")
def session(tmp_path_factory):
    store = captured_session(tmp_path_factory.mktemp("stats") / "scene_000004", count=3)
    scene = load_scene(store)
    C = np.diag([4e-3, 2e-3, 1e-3, 3e-4, 2e-4, 1e-4]) ** 2
    verdicts = ("accepted", "doubtful")
    judged = zip(scene.objects, verdicts, strict=True)
    objects = tuple(replace(o, covariance=C, verdict=v) for o, v in judged)
    save_scene(store, replace(scene, objects=objects))
    annotate_session(store, QUIET)
    for o in scene.objects:
        save_grasps(store, grasp_set(o.instance, o.obj_id))
    return store.folder


def rows_of(*folders):
    return {name: here for name, here, _ in all_rows(statistics_of(map(session_facts, folders)))}


def test_the_figures_are_those_counted_by_hand(session):
    rows = rows_of(session)
    assert rows["scenes"] == "1 simulated, 0 real"
    assert rows["annotated frames in all"] == "3"
    assert rows["objects per scene"] == "2.0 ± 0.0 (range 2 to 2)"
    assert rows["candidates"] == "7"
    assert rows["with trajectory"] == "6 (85.71 %)"
    assert rows["good (s >= 0.5)"] == "4 (57.14 %)"
    assert rows["nominal score: good"] == "3 (42.86 %)"
    assert rows["nominal score: penalized"] == "1 (14.29 %)"
    assert rows["penalized large slip (s < 0.5)"] == "0 (0.00 %)"
    assert rows["fail lift (s <= 0.25)"] == "1 (14.29 %)"
    assert rows["fail close (s = 0)"] == "1 (14.29 %)"
    assert rows["fail horizontal (s = 0.50)"] == "2 (28.57 %)"
    assert rows["full success (s = 1)"] == "1 (14.29 %)"
    mean = np.mean([g[0] for part in GRASPS.values() for g in part])
    assert rows["nominal score: mean"].startswith(f"{mean:.2f} ")
    mean = np.mean([g[1] for part in GRASPS.values() for g in part])
    assert rows["mean score"].startswith(f"{mean:.2f} ")
    assert rows["without a score"] == "0"
    # Of the six that were tried, one closes at no level.
    assert rows["closure_friction: closed at some level up to 0.6: good, bad"] == "2, 3"
    assert rows["poses accepted"] == rows["poses doubtful"] == "1 (50.0 %)"
    assert rows["pose uncertainty [mm], median, p90, most"].startswith(
        "0.300, 0.300, 0.300 (n = 2)"
    )
    sigma_deg = np.degrees(4e-3)
    assert rows["pose uncertainty [deg], median, p90, most"].startswith(f"{sigma_deg:.3f}")


def test_copies_are_told(session, tmp_path):
    folders = [Path(shutil.copytree(session, tmp_path / n)) for n in ("first", "again", "third")]
    assert same_content(statistics_of([session_facts(session)])) == []
    photograph = folders[2] / "rgb/000000.png"
    photograph.write_bytes(photograph.read_bytes() + b"\0")  # another capture
    statistics = statistics_of(map(session_facts, folders))
    (note,) = same_content(statistics)
    assert "first" in note and "again" in note and "third" not in note
    assert note.endswith("counts twice.")


def test_tables_and_page_say_the_same(session, tmp_path):
    out = tmp_path / "out"
    finished("stats", session, "--out", out, "--quiet")
    document = json.loads((out / "statistics.json").read_text())
    with (out / "statistics.csv").open(newline="") as file:
        table = {row["property"]: row["here"] for row in csv.DictReader(file)}
    assert table == document["statistics"] == rows_of(session)
    with (out / "objects.csv").open(newline="") as file:
        objects = list(csv.DictReader(file))
    assert [int(o["candidates"]) for o in objects] == [4, 3]
    assert sum(o["good"] for o in document["objects"]) == document["sessions"][0]["good"] == 3
    page = (out / "statistics.html").read_text()
    assert page.count('src="data:') == 6
    assert all(here in page for here in (table["mean score"], table["objects per scene"]))


def test_a_damaged_session_of_many_is_named_and_left_out(session, tmp_path):
    for name in ("a", "b"):
        shutil.copytree(session, tmp_path / name)
    (tmp_path / "b/session.json").write_text("{")
    (tmp_path / "b/session.begun.json").unlink()
    result = finished("stats", tmp_path, "--quiet")
    assert "b is left out" in result.output.replace("\n", " ")
    assert "│ 7 " in result.output or " 7 │" in result.output


def test_what_is_no_session_is_refused(session, tmp_path):
    assert "holds no session" in refused("stats", tmp_path)
    assert "given twice" in refused("stats", session, session)
    (tmp_path / "file").write_text("")
    assert "is a file" in refused("stats", session, "--out", tmp_path / "file")
