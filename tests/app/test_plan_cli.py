"""`realsim plan`, `plan-show`, `plan-convert`: what they write, and what they refuse."""

import json
from pathlib import Path

import numpy as np
import pytest

from given_plans import plan_through
from realsim.formats.graspnet.cameras import read_camera_poses
from realsim.geometry import se3
from realsim.robots.arm import UR5E
from realsim.store.atomic import only_run_in
from realsim_capture_plans.plan_files.foreign_plans import table_frame
from realsim_capture_plans.plan_files.plan_json import load_plan, save_plan
from realsim_capture_plans.planning.record import CapturePlan
from typed_commands import complained, finished, realsim

HOME = np.array([0.0, -1.9, 1.9, -1.57, -1.57, 0.0])
CENTER = np.array([0.40, 0.1, 0.05])


@pytest.fixture(autouse=True)
def _in_an_empty_folder(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.chdir(tmp_path)


def a_plan(n: int = 3) -> CapturePlan:
    """A few views high above the table, free of everything."""
    rng = np.random.default_rng(0)
    plan = plan_through(HOME + rng.normal(0, 0.05, (n, 6)), HOME, CENTER)
    assert np.all(plan.collision_model().free(plan.joints))
    return plan


def csv_of(rows: np.ndarray) -> str:
    """Return a table of joints whose header says that they are in radians."""
    header = ",".join(f"q{j}_rad" for j in range(1, 7))
    return "\n".join([header, *(",".join(map(repr, q)) for q in rows.tolist())])


def test_a_plan_is_made_and_written() -> None:
    words = ("plan", "--views", 4, "--quiet", "--out", "a.json")
    done = finished(*words, "--arm", "ur5e", "--no-pictures")
    plan = load_plan("a.json")
    assert len(plan) == 4 and plan.robot == "UR5e" and plan.kind == "hemisphere"
    assert plan.center_world == pytest.approx([0.40, 0.0, 0.05])
    assert plan.metrics["colliding_legs"] == 0
    assert plan.content_hash[:12] in done.stdout and "good" in done.stdout
    before = Path("a.json").read_bytes()
    assert "--overwrite" in complained(*words)
    Path("b_pictures").mkdir()
    with only_run_in(Path("b_pictures")):  # a second run at the same time
        assert "another run" in complained("plan", "--views", 1, "--quiet", "--out", "b.json")
    assert Path("a.json").read_bytes() == before


@pytest.mark.slow
def test_a_plan_comes_after_its_pictures_so_that_what_was_interrupted_is_run_again() -> None:
    in_the_way = Path("a_pictures/views.png")
    in_the_way.mkdir(parents=True)
    words = ("plan", "--views", 1, "--quiet", "--out", "a.json")
    assert "views.png" in complained(*words) and not Path("a.json").exists()
    in_the_way.rmdir()
    finished(*words)
    assert len(load_plan("a.json")) == 1 and in_the_way.is_file()


@pytest.mark.parametrize(
    ("args", "says"),
    [
        ("--center 350,0,50", "'0.35,0,0.05'"),
        ("--center nan,0,0", "3 numbers"),
        ("--keep-out 300,300,120", "--keep-out"),
        ("--keep-out 0.3,0.3,-0.12", "sizes of 0 or more"),
        ("--radius 0.4,0.3", "in this order"),
        ("--elevation 20,95", "90"),
        ("--board-views --elevation 20,80", "--elevation"),
        ("--mount nowhere.toml", "nowhere.toml"),
        ("--center 1.3,0.5,0.05 --views 24", "24 views were asked for"),
    ],
)
def test_what_cannot_be_planned_is_one_paragraph(args: str, says: str, tmp_path: Path) -> None:
    assert says in complained("plan", "--quiet", *args.split())
    assert list(tmp_path.iterdir()) == []


def test_a_plan_is_shown() -> None:
    save_plan(a_plan(), "p.json")
    done = finished("plan-show", "p.json", "--no-pictures")
    assert a_plan().content_hash[:12] in done.stdout and "0, always" in done.stdout
    complained("plan-show", "shipped:nowhere")
    assert "no plan at q.json" in complained("plan-show", "q.json")


def test_a_plan_that_collides_ends_with_1_and_is_named() -> None:
    plan = a_plan()
    Path("p.csv").write_text(csv_of(plan.home + np.outer([0, 1, 0], np.eye(6)[1])))
    where = ("--arm", "UR5", "--center", "0.4,0.1,0.05")
    done = realsim("plan-convert", "p.csv", "p.json", *where)
    assert done.returncode == 1 and "view 0 -> view 1" in done.stderr and "table" in done.stderr
    assert load_plan("p.json").metrics["colliding_legs"] == 2
    done = realsim("plan-convert", "p.json", "p.script")
    assert done.returncode == 1 and "NOT FREE: view 0 -> view 1" in Path("p.script").read_text()
    assert 'popup("2 moves' in Path("p.script").read_text()
    assert realsim("plan-show", "p.json", "--no-pictures").returncode == 1


def test_a_plan_goes_out_and_comes_back() -> None:
    plan = a_plan()
    save_plan(plan, "p.json")
    for dest in ("p.csv", "p.script", "folder", "copy.json"):
        assert dest in finished("plan-convert", "p.json", dest).stdout
        assert "--overwrite" in complained("plan-convert", "p.json", dest)
        finished("plan-convert", "p.json", dest, "--overwrite")
    assert load_plan("copy.json").content_hash == plan.content_hash
    assert "def realsim_plan():" in Path("p.script").read_text()
    Ts = table_frame(plan) @ read_camera_poses("folder")
    assert np.abs(Ts - plan.Ts_base_cam).max() < 1e-12
    words = ("plan-convert", "p.csv", "back.json", "--center", "0.4,0.1,0", "--arm")
    assert "of this robot" in complained(*words, "UR5e") and not Path("back.json").exists()
    finished(*words, "UR5")
    assert np.array_equal(load_plan("back.json").joints, plan.joints)


@pytest.mark.parametrize(
    ("args", "says"),
    [
        (["p.json", "p.xyz"], ".script"),
        (["p.json", "q.csv", "--arm", "UR5e"], "the plan is for a UR5"),
        (["bare.csv", "q.json", "--arm", "UR5"], "--joints-unit"),
        (["bare.csv", "q.json", "--arm", "UR5", "--joints-unit", "deg"], "look like radians"),
        (["degrees.csv", "q.json", "--arm", "UR5"], "look like degrees"),
        (["bare.csv", "q.json", "--joints-unit", "rad"], "choose --arm"),
        (["other.json", "q.json", "--arm", "UR5"], "path of another robot"),
    ],
)
def test_what_cannot_be_converted_is_one_paragraph(args: list[str], says: str) -> None:
    save_plan(a_plan(), "p.json")
    row = ",".join(map(repr, HOME.tolist()))
    Path("bare.csv").write_text(f"q1,q2,q3,q4,q5,q6\n{row}\n{row}\n")
    Path("degrees.csv").write_text(csv_of(np.degrees([HOME])))
    q = HOME + np.random.default_rng(0).normal(0, 0.4, (9, 6))
    T = UR5E.forward(q)
    numbers = np.concatenate([T[:, :3, 3], se3.log_so3(T[:, :3, :3])], axis=1).tolist()
    poses = [dict(zip("xyzabc", row, strict=True)) for row in numbers]
    Path("other.json").write_text(json.dumps({"joints": q.tolist(), "cart_pose": poses}))
    before = sorted(p.name for p in Path().iterdir())
    assert says in complained("plan-convert", *args)
    assert sorted(p.name for p in Path().iterdir()) == before
