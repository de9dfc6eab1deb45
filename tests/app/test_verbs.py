"""The verbs of `import realsim as rs` do what the commands do, to the last bit."""

import json
import subprocess
import sys
from pathlib import Path

import click
import pytest

import realsim as rs
from file_trees import bytes_of
from realsim.app.cli import commands
from realsim.app.command import walk
from realsim.app.verbs import run
from shared_sessions import copy_of
from typed_commands import realsim, started

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
    assert set(VERBS) <= set(rs.__all__)
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
    made = rs.plan("plan.json", views=4, progress=lambda *step: steps.append(step))
    words = ("--views", "4", "--out", "plan.json", "--no-pictures", "--json")
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
    def told(verb: str, *places: str, **options: object) -> str:
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
