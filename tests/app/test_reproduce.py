"""Records of what results were made of, and results made again from them.

The verbs of `import realsim as rs` do what the commands do, to the last bit.
"""

import json
import shutil
import subprocess
import sys
from pathlib import Path

import click
import numpy as np
import pytest
from threadpoolctl import threadpool_limits

import realsim as rs
from bop_scenes import edit
from file_trees import bytes_of
from realsim.app.cli import commands
from realsim.app.command import walk
from realsim.app.reproduce.compare import compare_folders
from realsim.app.verbs import run
from realsim.store import atomic, provenance
from school_sessions import QUICK, registered
from shared_sessions import copy_of
from typed_commands import finished, invoked, realsim, refused, started


@pytest.fixture(scope="module")
def made(few_views: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A session registered and annotated with one thread of BLAS and OpenMP."""
    folder = copy_of(few_views, tmp_path_factory.mktemp("made") / "s")
    with threadpool_limits(1):
        for words in (("register", folder, "--object", "wedge"), ("annotate", folder)):
            finished(*words, "--workers", 1, "--quiet")
    return folder


@pytest.fixture
def copy(made: Path, tmp_path: Path) -> Path:
    """A copy to be changed."""
    shutil.copytree(made, tmp_path / "s")
    return tmp_path / "s"


def test_a_record_names_versions_settings_inputs_and_command(made: Path) -> None:
    record, run = provenance.read(made, "register")
    assert record.request["objects"] == ["wedge"]
    assert record.config["refine"] and record.versions["open3d-cpu"][0].isdigit()
    assert {"python", "platform", "realsim"} <= set(record.versions)
    for name in ("rgb/000002.png", "depth/000000.png", "robot.jsonl"):
        assert record.inputs[name] == provenance.sha256_of(made / name)
    assert record.inputs["calibration/hand_eye.json"] == provenance.ABSENT
    assert run.command[:1] == ("register",) and run.ended and run.machine
    assert {t["name"] for t in run.times} >= {"register", "search"}
    assert str(made) not in (made / provenance.file_of("register")).read_text()


@pytest.mark.parametrize("stage", ["register", "annotate"])
def test_a_session_is_made_again_with_other_threads_and_left_alone(made: Path, stage: str) -> None:
    before = {p: p.stat().st_mtime_ns for p in made.rglob("*")}
    with threadpool_limits(2):
        result = finished("reproduce", made, stage, "--workers", 2, "--json")
    told = json.loads(result.stdout)
    assert told["equal"] and told["files"] > 20 and told["differing"] == []
    assert before == {p: p.stat().st_mtime_ns for p in made.rglob("*")}
    assert made / "registration/single_view.json" in before
    assert "cpu_s" not in (made / "registration/report.json").read_text()


def test_what_differs_is_named_with_its_size(copy: Path) -> None:
    path = copy / "annotations/000001.json"
    edit(path, lambda value: value.update(digest=value.get("digest"), spoiled=3))
    mask = next((copy / "mask").glob("*.png"))
    mask.unlink()
    result = invoked("reproduce", copy, "annotate", "--workers", 1, "--json")
    assert result.exit_code == 1, (result.output, result.exception)
    rows = {r["path"]: r["words"] for r in json.loads(result.stdout)["differing"]}
    assert set(rows) == {"annotations/000001.json", f"mask/{mask.name}"}
    assert rows[f"mask/{mask.name}"] == ["it is missing"]
    assert any("spoiled: 3 -> (nothing)" in w for w in rows["annotations/000001.json"])


def test_changed_inputs_are_named(copy: Path) -> None:
    model = next((copy / "models").glob("*.ply"))
    model.write_bytes(model.read_bytes() + b"\n")
    (copy / "review").mkdir(exist_ok=True)
    (copy / "review/journal.jsonl").write_text("")
    said = refused("reproduce", copy, "register")
    assert "2 inputs" in said and f"models/{model.name}: " in said
    assert "review/journal.jsonl: (nothing)" in said


def test_other_versions_are_told_and_it_goes_on(copy: Path) -> None:
    path = copy / provenance.file_of("annotate")
    edit(path, lambda record: record["versions"].update(numpy="1.0"))
    result = invoked("reproduce", copy, "annotate", "--workers", 1, "--json")
    told = json.loads(result.stdout)
    assert told["other_versions"][0].startswith("numpy 1.0 -> ")
    assert result.exit_code == 0 and told["equal"] and not told["differing"]


def test_what_cannot_be_made_again_is_said(copy: Path, tmp_path: Path) -> None:
    for words, told in (
        ((copy,), "say which stage"),
        ((copy, "school"), "holds no stages/school.json"),
        ((tmp_path / "none",), "is no folder"),
        ((tmp_path, "school"), "is no session"),
        ((tmp_path,), "neither session.json nor provenance.json"),
    ):
        assert told in refused("reproduce", *words)
    path = copy / provenance.file_of("annotate")
    whole = path.read_text()
    asked = json.loads(whole)["request"] | {"mapz": "all"}
    for change, told in (({"stage": "register"}, "of 'register'"), ({"request": asked}, "know")):
        path.write_text(json.dumps(json.loads(whole) | change))
        assert told in refused("reproduce", copy, "annotate")
    path = copy / provenance.file_of("register")
    edit(path, lambda record: record["request"].update(from_review=True))
    said = refused("reproduce", copy, "register")
    assert "from-review" in said and "realsim register" in said


def test_the_card_of_an_export_names_what_has_no_label(copy: Path, tmp_path: Path) -> None:
    file = copy / "registration/report.json"
    hidden = [{"obj_id": 9, "instance": 4, "reason": "hidden in all views"}]
    edit(file, lambda report: report.update(not_placed=hidden))
    finished("export", copy, "--to", "bop", "--out", tmp_path / "out", "--quiet")
    card = " ".join((tmp_path / "out/README.md").read_text().split())
    assert "object 9 (instance 4) is not placed and has no label" in card
    assert "hidden in all views" in card


@pytest.mark.slow
def test_a_school_and_an_export_are_made_again(tmp_path: Path) -> None:
    session, out = registered(tmp_path / "s"), tmp_path / "out"
    finished("school", session, *QUICK)
    finished("export", session, "--to", "hdf5", "--out", out, "--quiet")
    shutil.copytree(out, tmp_path / "renamed")
    for words in ((session, "school"), (out,), (tmp_path / "renamed",)):
        result = finished("reproduce", *words, "--workers", 1, "--json")
        assert json.loads(result.stdout)["equal"]
    listed = (out / "SHA256SUMS").read_text()
    assert " provenance.json\n" in listed and "run.json" not in listed
    assert str(tmp_path) not in (out / "provenance.json").read_text()


def test_arrays_and_pictures_are_compared_value_by_value(tmp_path: Path) -> None:
    from realsim import images

    for name, off in (("a", 0.0), ("b", 0.25)):
        values = np.array([1.0, np.nan, 3.0])
        values[2] += off
        atomic.write_npz(tmp_path / name / "x.npz", same=np.arange(3), moved=values)
        picture = np.full((4, 5), 7, np.uint8)
        picture[1, 2] += int(8 * off)
        (tmp_path / name / "p.png").write_bytes(images.png_bytes(picture))
        (tmp_path / name / "t.html").write_bytes(b"abc" if off else b"abd!")
    count, found = compare_folders(tmp_path / "a", tmp_path / "b")
    by = {f.path: f for f in found}
    assert count == 3 and set(by) == {"x.npz", "p.png", "t.html"}
    assert by["x.npz"].greatest == 0.25 and by["x.npz"].words == ("moved[2]: 3.0 -> 3.25",)
    assert by["p.png"].greatest == 2 and by["p.png"].words == ("pixels[7]: 7 -> 9",)
    assert by["t.html"].words == ("2 of 4 bytes differ",)


IMPORT = """
import sys, time
before = time.process_time()
import realsim
print(time.process_time() - before, "numpy" in sys.modules, "click" in sys.modules)
"""
VERBS = ("annotate", "calibrate", "export", "open", "plan", "register", "render", "review", "scan",
         "school")  # fmt: skip


def files(folder: Path) -> dict[str, bytes]:
    """Return the bytes of every file but the record of a run, which has its time and its folder."""
    kept = {k: v for k, v in bytes_of(folder).items() if not k.startswith("stages/")}
    sums = [s for s in kept.pop("manifest.jsonl", b"").splitlines() if b'"path": "stages/' not in s]
    return kept | {"manifest.jsonl": b"\n".join(sums)}


def test_import_is_cheap_and_loads_nothing() -> None:
    said = subprocess.run(
        [sys.executable, "-c", IMPORT], capture_output=True, text=True, check=True
    )
    cpu_s, *loaded = said.stdout.split()
    assert float(cpu_s) <= 0.05 and loaded == ["False", "False"]


def test_every_promised_name_is_there() -> None:
    assert set(VERBS) <= set(dir(rs)) == {*rs.__all__, "__version__"}
    assert all(callable(getattr(rs, name)) for name in rs.__all__)
    import realsim.review.server  # with all that the page imports

    assert callable(rs.review)  # the package of that name, which is the verb as well
    assert all(callable(getattr(realsim.review, name)) for name in realsim.review.__all__)
    with pytest.raises(AttributeError, match="no attribute 'nothing'"):
        rs.nothing  # noqa: B018  # pyright: ignore[reportAttributeAccessIssue]


def test_named_arguments_are_options_of_the_commands() -> None:
    import inspect

    found = walk(commands)
    several = {"open": ("import",), "scan": ("scan", "import"), "school": ("school", "run")}
    for verb in VERBS:
        params = found[several.get(verb, (verb,))].params
        options = [o for p in params if isinstance(p, click.Option) for o in p.opts]
        known = {p.name for p in params} | {o.lstrip("-").replace("-", "_") for o in options}
        given = inspect.signature(getattr(rs, verb)).parameters.values()
        named = {p.name for p in given if p.kind is p.KEYWORD_ONLY} - {"progress"}
        assert named - known <= ({"session"} if verb == "scan" else set()), verb


def test_a_plan_is_the_commands(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    by_command, by_verb = tmp_path / "command", tmp_path / "verb"
    for folder in (by_command, by_verb):
        folder.mkdir()
    monkeypatch.chdir(by_verb)
    steps: list[tuple[str, int, int]] = []
    monkeypatch.setenv("HOME", str(by_verb))
    given = {"center": np.array([0.4, 0, 0]), "overwrite": np.False_}
    made = rs.plan("~/plan.json", views=4, progress=lambda *step: steps.append(step), **given)
    words = ("--views", "4", "--center", "0.4,0,0", "--out", "plan.json", "--no-pictures", "--json")
    monkeypatch.chdir(by_command)
    done = realsim("plan", *words)
    assert done.returncode == 0 and made.passed
    assert (by_command / "plan.json").read_bytes() == (by_verb / "plan.json").read_bytes()
    assert len(made.value) == 4 and steps[-1][1] == steps[-1][2]
    assert json.loads(done.stdout)["metrics"] == made.document["metrics"]
    _, header, rows = made.tables[0]
    assert rows[0][0] == "views of the plan" and len(header) == len(rows[0])
    assert made.notes and all(f"note: {note}" in done.stderr for note in made.notes)
    assert [p.suffix for p in made.pictures] == [".png"] * len(made.pictures) and made.pictures


def test_labels_are_the_commands(tmp_path: Path, registered_few: Path) -> None:
    by_command, by_verb = (copy_of(registered_few, tmp_path / n) for n in ("a", "b"))
    session = rs.open(by_verb)
    assert session.value.views and "views with a camera pose" in session._repr_html_()
    made = rs.annotate(session, maps="none", quiet=True)
    done = realsim("annotate", by_command, "--maps", "none", "--quiet")
    assert done.returncode == 0 and made.passed and Path(made) == by_verb
    labels = files(by_verb)
    assert labels == files(by_command) and "reports/annotated.png" in labels
    figure = made.plot()
    assert [len(ax.images) for ax in figure.axes] == [1]
    run_of = json.loads((by_verb / "stages/annotate.run.json").read_text())
    assert run_of["command"] == ["annotate", "--quiet", "--maps", "none", str(by_verb)]


def test_errors_say_what_the_command_prints(tmp_path: Path) -> None:
    def told(verb: str, *places: object, **options: object) -> str:
        with pytest.raises(rs.InputError) as refused:
            getattr(rs, verb)(*places, **options)
        return str(refused.value)

    nowhere = str(tmp_path / "nowhere")
    process = started("register", nowhere, cwd=tmp_path, stderr=subprocess.PIPE)
    printed = process.communicate()[1]
    assert printed == f"error: {told('register', nowhere)}\n"
    with pytest.raises(click.ClickException) as refused:
        commands.main(["plan", "--views", "0"], standalone_mode=False)
    assert refused.value.format_message() == told("plan", views=0)
    mine = tmp_path / "mine.html"
    mine.write_text("mine")
    assert "is no page that this command wrote" in told("review", nowhere, static=mine)
    assert "register has no option 'object_'; it has " in told("register", nowhere, object_="mug")
    assert "kind are for an import" in told("open", nowhere, kind="bop")
    for verb, *places in (("open", 5), ("open", b"s"), ("open", None, "s"), ("plan", None)):
        assert "the path is " in told(verb, *places)
    assert "plan: overwrite is 'no'; True or False" in told("plan", overwrite="no")


def test_a_failed_check_is_a_result(tmp_path: Path) -> None:
    (tmp_path / "models").mkdir()
    (tmp_path / "models/models_info.json").write_text("{}")
    (tmp_path / "models/obj_000007.ply").write_text("left over")
    told = run("scan check", (tmp_path / "models",), {})
    assert not told.passed and not told.document["sound"]


def test_what_a_result_shows_is_escaped() -> None:
    from realsim.app.verbs import Result

    made = Result(
        verb="scan", folder=Path("<b>"), value=[], pictures=[], notes=["a < b"],
        tables=[("models & more", ["<name>"], [["<script>"]])],
    )  # fmt: skip
    shown = made._repr_html_()
    assert "&lt;script&gt;" in shown and "a &lt; b" in shown and "<script>" not in shown
    assert repr(made) == "<scan <b>: done>"
    with pytest.raises(rs.InputError, match="has no pictures"):
        made.plot()
