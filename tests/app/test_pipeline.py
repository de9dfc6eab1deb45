"""`realsim pipeline`: a campaign's file is checked before anything runs; scenes fail alone.

The whole loop in the simulated lab: a kill costs nothing.
"""

import contextlib
import gc
import json
import os
import re
import shutil
import signal
import subprocess
from collections.abc import Callable
from pathlib import Path
from unittest import mock

import pytest

from file_trees import bytes_of
from realsim.app.cli import commands
from realsim.app.console import Console, StageTime
from realsim.app.demo.run import PAGES, DemoResult, show_demo, write_site
from realsim.app.pipeline import chain
from realsim.app.pipeline import run as pipeline_run
from realsim.app.pipeline.campaign import read_campaign
from realsim.app.pipeline.chain import SCENE, Ended
from realsim.app.pipeline.page import page_of, verdicts_of
from realsim.app.truth import LoopErrors, loop_errors
from realsim.pages import Page
from realsim.store import SessionStore
from typed_commands import invoked, realsim, refused, started, wait_until

HEAD = '[campaign]\nout = "out"\nstages = ["annotate", "export", "stats"]\n'
SCENES = '[generate]\nscenes = 2\nviews = 2\nobjects = "2"\nsize = "160x120"\nrange = "d405"\n'
EXPORT = '[export]\nto = "bop"\n'


def run(path, *more):
    return invoked("pipeline", path, "--quiet", "--workers", "1", *more)


WHOLE = HEAD + SCENES + EXPORT


def written(folder, text=WHOLE):
    path = folder / "campaign.toml"
    path.write_text(text)
    return path


@pytest.mark.parametrize(
    ("text", "told"),
    [
        ("[generate]\nscenes = 1\n", "has no table [campaign]"),
        (HEAD.replace("stages", "stage") + SCENES, "did you mean stages"),
        (HEAD.replace('"annotate"', '"anotate"') + SCENES, "there is no stage 'anotate'"),
        (HEAD.replace('"annotate", "export"', '"export", "annotate"') + SCENES, "behind 'export'"),
        (HEAD.replace('"annotate"', '"school", "register"') + SCENES, "works on its result"),
        (HEAD + SCENES + EXPORT.replace("to", "two"), "line 11: [export] has no option 'two'"),
        (HEAD + SCENES + EXPORT + 'out = "x"\n', "a campaign sets --out itself"),
        (HEAD + SCENES + EXPORT + "[register]\n", "[register] has no effect"),
        (HEAD + SCENES, "[export] needs `to`"),
        (HEAD.replace(', "export"', "") + SCENES + EXPORT, "[export] has no effect"),
        (HEAD + EXPORT, "says nowhere where its scenes come from"),
        (HEAD + 'sessions = ["a*"]\n' + SCENES + EXPORT, "says twice"),
        (HEAD + 'sessions = ["a*"]\n' + EXPORT, "'a*' names no session"),
        (HEAD.replace('"out"', "3") + SCENES, "a folder in quotes"),
    ],
)
def test_a_file_that_cannot_be_used_names_line_and_key_and_runs_nothing(tmp_path, text, told):
    assert told in refused("pipeline", written(tmp_path, text), "--quiet", "--workers", "1")
    assert not (tmp_path / "out").exists()


OTHERS = '{"campaign": "../other.toml", "scenes": 2}'


@pytest.mark.parametrize(
    ("name", "text", "told"),
    [
        ("mine.txt", "mine", "holds something else"),
        ("campaign.json", OTHERS, "is of another campaign, ../other.toml"),
    ],
)
def test_a_folder_of_something_else_is_not_filled(tmp_path, name, text, told):
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / name).write_text(text)
    assert told in str(run(written(tmp_path)).exception)
    assert bytes_of(tmp_path / "out") == {name: text.encode()}


def test_what_a_person_has_to_look_at_is_on_the_page(tmp_path):
    campaign = read_campaign(written(tmp_path), commands)
    scene = tmp_path / "out/scenes/scene_000000"
    (scene / "registration").mkdir(parents=True)
    objects = [{"verdict": "accepted"}, {"verdict": "accepted"}]
    (scene / "registration/scene.json").write_text(json.dumps({"objects": objects}))
    end = Ended(stage="annotate", words=(), code=0, wall_s=1, cpu_s=1, peak_mb=1, told="")
    state = pipeline_run.SceneState(name="scene_000000", folder=scene, ends=(end,))
    result = pipeline_run.PipelineResult(scenes=[state], stages=("annotate",))
    for missing, told in (([], "Done"), ([{"instance": 3}], "objects of 1 need a look")):
        report = {"not_placed": missing}
        (scene / "registration/report.json").write_text(json.dumps(report))
        page = page_of(campaign, result).encode().decode()
        assert told in page and ("1 not placed" in page) == bool(missing)
    assert verdicts_of(result, state) == {"accepted": 2, "not placed": 1}
    (scene / "registration/report.json").unlink()
    assert verdicts_of(result, state) == {"accepted": 2}
    result.stages = ("register", "annotate")
    assert not verdicts_of(result, state), "poses of before the registration are not its verdicts"


def test_a_page_is_given_back_when_it_is_written(tmp_path):
    campaign = read_campaign(written(tmp_path), commands)
    campaign.out.mkdir()
    gc.collect()
    before = {id(o) for o in gc.get_objects() if isinstance(o, Page)}
    pipeline_run._write(campaign, pipeline_run.PipelineResult(scenes=[]))
    assert all(id(o) in before for o in gc.get_objects() if isinstance(o, Page))


def document(out):
    return json.loads((out / "campaign.json").read_text())


def in_this_process(command, scene, folder, log):
    """Run a command as a campaign does, without a new interpreter."""
    words = [str(scene) if word == SCENE else word for word in command.words]
    with contextlib.chdir(folder):
        done = realsim(*words)
    return Ended(
        stage=command.stage, words=command.words, code=done.returncode, wall_s=1.0, cpu_s=1.0,
        peak_mb=1.0, told=done.stderr if done.returncode > 1 else "",
    )  # fmt: skip


@contextlib.contextmanager
def no_interpreters(*modules):
    """Let modules run commands in this process; one that is to fail or be killed has its own."""
    with contextlib.ExitStack() as stack:
        for module in modules or (pipeline_run, chain):
            stack.enter_context(mock.patch.object(module, "run_command", in_this_process))
        yield


def exported(out):
    return {p.name: p.read_bytes() for p in (out / "export").glob("*/*/scene_gt.json")}


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    """A campaign's file and folder, and what it exported when it was done."""
    path = written(tmp_path_factory.mktemp("whole"))
    with no_interpreters():
        assert run(path).exit_code == 0
    out = path.parent / "out"
    told = document(out)
    assert told["done"] == 2 and not told["failed"]
    assert len(list((out / "export").glob("*/*/scene_gt.json"))) == 2
    return path, out, exported(out)


@pytest.mark.slow
def test_results_that_are_gone_or_of_others_are_seen_and_nobodys_files_are_removed(whole, tmp_path):
    path, out = written(tmp_path), tmp_path / "out"
    shutil.copytree(whole[1], out)
    # Of one scene the labels' record is lost, the other was labelled again with other maps.
    (out / "scenes/scene_000000/stages/annotate.json").unlink()
    assert realsim("annotate", out / "scenes/scene_000001", "--maps", "none").returncode == 0
    (out / "export/NOTES.md").write_text("mine")
    card = out / "export/README.md"
    card.write_text(card.read_text() + "and mine")
    lost = "scene_000000: files that annotate left are gone or others"
    mask = out / "scenes/scene_000000/mask_visib/000000_000000.png"

    def gone_on_with() -> str:
        with no_interpreters():
            result = run(path)
        assert result.exit_code == 0, result.output
        return " ".join(result.output.split())

    told = gone_on_with()
    assert lost in told and "scene_000001: annotate was run outside this campaign" in told
    mask.unlink()
    assert lost in gone_on_with() and mask.is_file()
    assert (out / "scenes/scene_000000/stages/annotate.json").is_file()
    assert sorted(p.name for p in (out / "export.kept").iterdir()) == ["NOTES.md", "README.md"]
    assert (out / "export.kept/README.md").read_text().endswith("and mine")
    assert exported(out).keys() == whole[2].keys() and not (out / "export.before").exists()


@pytest.mark.slow
def test_a_scene_that_fails_is_listed_the_others_go_on_and_only_it_is_done_again(whole):
    path, out, _ = whole
    # One scene's poses are damaged, and it has to be done again.
    (out / "records/scene_000001.json").unlink()
    views = out / "scenes/scene_000001/registration/scene.json"
    kept = views.read_bytes()
    views.write_bytes(b"{")
    with no_interpreters(pipeline_run):
        assert run(path).exit_code == 1
    told = document(out)
    assert list(told["failed"]) == ["scene_000001"] and told["done"] == 1 and told["kept"] == 1
    assert told["waiting"] == ["export", "stats"] and not told["of_all"][1:]
    assert "scene.json" in told["failed"]["scene_000001"]
    with no_interpreters():
        assert run(path, "--without-failed").exit_code == 1
        assert len(list((out / "export_1_of_2").glob("*/*/scene_gt.json"))) == 1
        page = (out / "campaign.html").read_text()
        assert "scene_000001" in page and "1 failed" in page
        views.write_bytes(kept)
        assert run(path).exit_code == 0
        assert document(out)["done"] == 2
        # Other options of an export: it is made anew. A photograph is damaged: the others are kept.
        written(path.parent, WHOLE + 'licence = "CC0-1.0"\n')
        assert run(path).exit_code == 0
        assert "CC0-1.0" in (out / "export/README.md").read_text()
        assert not (out / "export.before").exists()
        photograph = out / "scenes/scene_000000/rgb/000000.png"
        photograph.write_bytes(photograph.read_bytes()[:100])
        assert run(path).exit_code == 1
    told = document(out)
    assert told["done"] == 2 and list(told["failed"]) == ["export"]
    assert "scenes/scene_000000/rgb/000000.png" in (out / "campaign.html").read_text()


@pytest.mark.slow
def test_a_campaign_that_was_interrupted_goes_on_and_comes_to_the_same(whole, tmp_path):
    path, out = written(tmp_path), tmp_path / "out"
    words = ("pipeline", path, "--workers", "1")
    process = started(*words, start_new_session=True, stderr=subprocess.PIPE)
    wait_until((out / "scenes/scene_000000/session.json").is_file, process)
    os.killpg(process.pid, signal.SIGINT)
    _, told = process.communicate(timeout=60)
    assert process.returncode == 130
    assert "the same command goes on from here" in told
    with no_interpreters():
        assert run(path).exit_code == 0
    assert exported(out) == whole[2]


SMALL = ["--quick", "--views", "6", "--objects", "2", "--grasps", "8", "--workers", "1",
         "--quiet"]  # fmt: skip
"""The demo of `demo_session`; `--quick` makes its pictures small."""


def kill_when(out: Path, reached: Callable[[Path], bool]) -> None:
    """Start a demo and SIGKILL it as soon as `reached`, which has to catch it alive."""
    pipe = subprocess.PIPE
    with started("demo", "--out", out, *SMALL, stdout=pipe, stderr=pipe) as process:
        try:
            wait_until(lambda: reached(out / "session"), process)
        finally:
            process.kill()
            process.communicate()


@pytest.mark.slow
def test_a_demo_killed_in_two_stages_ends_like_one_left_alone(
    tmp_path: Path, demo_session: Path
) -> None:
    def lines(path: Path) -> int:
        return path.read_text().count("\n") if path.is_file() else 0

    killed = tmp_path / "killed"
    kill_when(killed, lambda s: lines(s / "robot.jsonl") == 3)
    kill_when(killed, lambda s: any((s / "grasps/cache").glob("*")))
    finished = realsim("demo", "--out", killed, *SMALL)
    assert finished.returncode == 0, finished.stderr
    for pattern in ("rgb/*.png", "depth/*.png", "mask_visib/*.png"):
        assert bytes_of(killed / "session", pattern) == bytes_of(demo_session, pattern) != {}
    for name in ("scene_gt.json", "registration/scene.json"):
        left = json.loads((killed / "session" / name).read_text())
        assert left == json.loads((demo_session / name).read_text()), name


def test_the_last_screen_says_what_to_do_in_80_columns(
    table_views: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    errors = LoopErrors(
        handeye_mm=12.3456, handeye_deg=123.45678, mount_mm=1.0, camera_mm=1.0, camera_deg=1.0,
        object_mssd_mm={1: 123.456}, single_view_mssd_mm={1: 1234.567}, mask_iou={1: 0.5},
        iou_views=1024,
    )  # fmt: skip
    result = DemoResult(
        store=SessionStore.open(table_views), grasps=[], errors=errors, report=Path("report.html"),
        times=[StageTime(name="school", cpu_s=12345.6, wall_s=1.0)],
    )  # fmt: skip
    show_demo(result, Console())
    said = capsys.readouterr().out.replace(str(table_views), "demo/session")
    assert max(map(len, said.splitlines())) <= 80
    steps = [line.strip() for line in said.splitlines()][-3:]
    assert steps[0] == "1. Open report.html in a browser."
    assert [step[:2] for step in steps] == ["1.", "2.", "3."]


@pytest.mark.slow
def test_a_site_needs_nothing_but_its_folder(tmp_path: Path, demo_session: Path) -> None:
    store, site = SessionStore.open(demo_session), tmp_path / "site"
    index = write_site(store, loop_errors(store, demo_session.parent / "truth"), site, Console())
    names = {page for page, _, _ in PAGES}
    assert index.name == "index.html" and names <= {p.name for p in site.iterdir()}
    for page in site.glob("*.html"):
        text = page.read_text()
        links = r'<(?:a|link|img|script|iframe|video)\b[^>]*?(?:href|src)="([^"#]*)'
        named = re.findall(links, text)
        kept = {name for name in named if name and not name.startswith("data:")}
        assert all((site / name).is_file() for name in kept), (page.name, kept)
        assert str(demo_session) not in text and str(tmp_path) not in text
    assert {f"./{name}" for name in names} <= set(re.findall(r'href="([^"]*)"', index.read_text()))
