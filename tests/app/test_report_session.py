"""One session's report: what it says, of whole sessions and of broken ones."""

import json
import re
from collections.abc import Callable
from html.parser import HTMLParser
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner

from realsim import CaptureSession
from realsim.app.register.files import write_result
from realsim.app.report.cli import report_command
from realsim.app.report.session import page_of, report_of, write_report
from realsim.app.report.summary import Report
from realsim.errors import RealsimError
from realsim.review import journal
from realsim.store import SessionStore, load_scene, save_grasps
from registered_sessions import CAMERA, models_of, registered_by_hand, table_session
from tried_grasps import tried_set

HOSTILE = '<script>alert("x")</script>'
STAGES = (
    "calibration", "plan", "capture", "registration", "review", "school", "labels", "files",
    "settings",
)  # fmt: skip
VOID = {"img", "meta", "input", "br", "hr", "link"}


@pytest.fixture(scope="module")
def registered(tmp_path_factory: pytest.TempPathFactory) -> SessionStore:
    """A registered session; one object is doubtful, one is not placed. Not to be changed."""
    store = table_session(tmp_path_factory.mktemp("report") / "s", views=3)
    write_result(store, registered_by_hand(store), models_of(), {})
    save_grasps(store, tried_set(np.random.default_rng(0), 30, obj_id=10, instance=0))
    return SessionStore.open(store.folder)


@pytest.fixture
def store(tmp_path: Path) -> SessionStore:
    """The same kind of session, to be changed."""
    store = table_session(tmp_path / "s", views=2)
    write_result(store, registered_by_hand(store), models_of(), {})
    return SessionStore.open(store.folder)


@pytest.fixture(scope="module")
def page(registered: SessionStore) -> Path:
    """Its report."""
    return write_report(registered, None)


class Balance(HTMLParser):
    """Notes which elements are open, and every address."""

    def __init__(self) -> None:
        super().__init__()
        self.open: list[str] = []
        self.addresses: list[str] = []
        self.faults: list[str] = []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        if tag not in VOID:
            self.open.append(tag)
        self.addresses += [v or "" for k, v in attrs if k in ("src", "href", "action")]

    def handle_endtag(self, tag: str) -> None:
        if not self.open or self.open.pop() != tag:
            self.faults.append(tag)


def checked(text: str) -> Balance:
    found = Balance()
    found.feed(text)
    assert found.faults == [] and found.open == []
    return found


def embedded(text: str) -> dict[str, object]:
    found = re.search(r'<script type="application/json" id="report">(.*?)</script>', text)
    assert found
    return json.loads(found[1])


def states(report: Report) -> dict[str, str]:
    return {s.key: s.state for s in report.sections}


# --- a whole session --------------------------------------------------------------------------


def test_the_report_of_the_same_session_is_the_same_bytes(
    registered: SessionStore, page: Path
) -> None:
    first, document = page.read_bytes(), (page.parent / "report.json").read_bytes()
    again = write_report(SessionStore.open(registered.folder), None)
    assert again == page and again.read_bytes() == first
    assert (again.parent / "report.json").read_bytes() == document


def test_the_page_is_whole_needs_no_network_and_names_no_folder(
    registered: SessionStore, page: Path
) -> None:
    text = page.read_text("utf-8")
    assert text.startswith("<!DOCTYPE html>") and len(text) < 15_000_000
    found = checked(text)
    assert all(a.startswith(("data:image/", "#")) for a in found.addresses)
    assert "http://" not in text and "https://" not in text
    pictures = [a for a in found.addresses if a.startswith("data:")]
    assert len(pictures) == len(set(pictures)) > 3
    for place in (str(registered.folder), str(Path.home()), str(Path(__file__).parents[2])):
        assert place not in text
    anchors = {a[1:] for a in found.addresses if a.startswith("#")}
    assert anchors <= set(re.findall(r' id="([\w-]+)"', text)) and set(STAGES) <= anchors


def test_the_page_and_the_file_hold_the_same_figures(page: Path) -> None:
    document = json.loads((page.parent / "report.json").read_text())
    assert embedded(page.read_text("utf-8")) == document
    assert document["schema_version"] == 1
    figures = document["figures"]
    assert figures["registration.objects"] == {
        "value": 2.0, "unit": "", "sigma": 0.0, "better": "none", "meaning": "objects placed",
    }  # fmt: skip
    assert figures["registration.accepted"]["value"] == 1
    assert figures["registration.not_placed"]["value"] == 1
    assert figures["registration.probability_min"]["value"] == pytest.approx(0.57)
    assert figures["registration.views_used"]["value"] == 3
    # Covariance diag(3, 2, 1 mrad; 0.3, 0.2, 0.1 mm): the worst axes. The mug is no body of
    # revolution, so nothing is set aside.
    assert figures["registration.sigma_mm_max"]["value"] == pytest.approx(0.3, rel=1e-6)
    assert figures["registration.sigma_deg_max"]["value"] == pytest.approx(np.degrees(3e-3))
    assert figures["school.candidates"]["value"] == 30


def test_the_worst_comes_first_and_missing_stages_name_their_command(
    registered: SessionStore, page: Path
) -> None:
    report = report_of(registered)
    severities = [f.severity for f in report.findings]
    assert severities == sorted(severities, key=("bad", "warn", "note").index)
    assert report.verdict == "look"
    assert states(report)["labels"] == "missing"
    assert {s.key: s.command for s in report.missing}["labels"] == "realsim annotate SESSION"
    text = page.read_text("utf-8")
    first = text[: text.index("<h2")]
    assert "Look first" in first and "half of it is hidden" in first
    assert "realsim annotate SESSION" in first


def test_agree_is_explained_where_it_stands(page: Path) -> None:
    text = page.read_text("utf-8")
    assert re.search(r"<abbr title=[^>]*share whose depth fits its pose", text)


def test_accepted_beside_a_low_probability_is_explained(store: SessionStore) -> None:
    scene = store.read_json("registration/scene.json")
    scene["objects"][0]["checks"] |= {"probability": 0.31, "views": 1.0}
    store.write_json("registration/scene.json", scene)
    report = report_of(store)
    assert any("probability below 0.9" in f.text for f in report.findings)
    text = page_of(store, report).encode().decode()
    assert "31.0<sup>1</sup>" in text and "registered in a single photograph" in text


def test_what_reviewers_decided_is_told(store: SessionStore) -> None:
    doubtful = load_scene(store).objects[1]
    path = store.path(journal.JOURNAL_FILE)
    journal.append(path, journal.new_entry("accept", doubtful, HOSTILE, comment="looked at it"))
    left = journal.new_entry("exclude", None, "Ada", view=1, comment="blurred")
    journal.append(path, left)
    report = report_of(store)
    figures = report.figures
    assert (figures["review.decided"].value, figures["review.open"].value) == (1, 0)
    assert figures["review.excluded_views"].value == 1
    assert figures["registration.accepted"].value == 2
    text = page_of(store, report).encode().decode()
    assert "<script>alert" not in text and "looked at it" in text and "blurred" in text


def test_a_hostile_name_is_only_text(tmp_path: Path) -> None:
    session = CaptureSession(name=HOSTILE, intrinsics=CAMERA, views=(), depth_unit_m=1e-4)
    store = SessionStore.create(tmp_path / "s", session, {"camera": HOSTILE, "x": "</script><b>"})
    text = write_report(store, None, notes=[HOSTILE]).read_text("utf-8")
    checked(text)
    assert "<script>alert" not in text and "<b>" not in text.partition("</div>")[2]
    assert embedded(text)["session"] == HOSTILE


# --- missing and damaged ----------------------------------------------------------------------


def test_a_session_that_was_only_begun_says_what_comes_next(tmp_path: Path) -> None:
    session = CaptureSession(name="begun", intrinsics=CAMERA, views=(), depth_unit_m=1e-4)
    store = SessionStore.create(tmp_path / "s", session)
    report = report_of(store)
    assert report.verdict == "unfinished"
    found = states(report)
    assert all(found[k] == "missing" for k in ("calibration", "capture", "registration", "labels"))
    checked(write_report(store, None).read_text("utf-8"))


def emptied(data: bytes) -> bytes:
    return b""


def halved(data: bytes) -> bytes:
    return data[: len(data) // 2]


def another(data: bytes) -> bytes:
    return b'{"a": [1, null]}'


@pytest.mark.parametrize("spoil", [emptied, halved, another])
@pytest.mark.parametrize(
    ("file", "stage"),
    [
        ("registration/scene.json", "registration"),
        ("registration/report.json", "registration"),
        ("registration/views.json", "registration"),
        ("registration/cameras.json", "registration"),
        ("models/models_info.json", "registration"),
        ("grasps/000000_obj000010.npz", "school"),
        ("grasps/000000_obj000010.json", "school"),
        ("review/journal.jsonl", "review"),
        ("plan.json", "plan"),
        ("calibration/hand_eye.json", "calibration"),
        ("annotations/000000.json", "labels"),
    ],
)
def test_a_damaged_file_is_named_and_the_other_sections_stand(
    registered: SessionStore, file: str, stage: str, spoil: Callable[[bytes], bytes]
) -> None:
    path = registered.folder / file
    before = path.read_bytes() if path.is_file() else None
    path.parent.mkdir(exist_ok=True)
    path.write_bytes(spoil(before if before is not None else b'{"content": {"joints": [[1, 2]]'))
    try:
        try:
            report = report_of(SessionStore.open(registered.folder))
        except RealsimError:
            pytest.fail("the report must be made of what is left")
    finally:
        if before is None:
            path.unlink()
        else:
            path.write_bytes(before)
    told = {f.section for f in report.findings}
    section = next(s for s in report.sections if s.key == stage)
    # An empty log or journal says nothing, as a missing one.
    silent = spoil is emptied and path.suffix == ".jsonl"
    assert silent or stage in told or section.state == "damaged" or "files" in told
    assert states(report)["settings"] == "done" and report.figures["report.bad"].value >= 0


def test_a_photograph_that_was_changed_is_bad(store: SessionStore) -> None:
    path = store.folder / "rgb/000001.png"
    path.write_bytes(path.read_bytes()[:-10])
    report = report_of(SessionStore.open(store.folder))
    assert report.verdict == "bad" and report.figures["files.damaged"].value == 1
    done = CliRunner().invoke(report_command, [str(store.folder), "--quiet"])
    assert done.exit_code == 1 and "missing or changed" in done.stderr


# --- for scripts ------------------------------------------------------------------------------


def test_json_is_all_there_is_on_stdout_and_exit_codes_tell(registered: SessionStore) -> None:
    runner, folder = CliRunner(), str(registered.folder)
    out = str(registered.folder.parent / "p.html")
    done = runner.invoke(report_command, [folder, "--json", "--out", out])
    document = json.loads(done.stdout)
    assert done.exit_code == 0 and document["failed"] == []
    rule = "registration.accepted<2"
    done = runner.invoke(
        report_command, [folder, "--json", "--quiet", "--out", out, "--fail-on", rule]
    )
    assert done.exit_code == 1 and "registration.accepted" in done.stderr
    assert len(json.loads(done.stdout)["failed"]) == 1
    rule = "registration.accepted<1"  # exactly met
    arguments = [folder, "--quiet", "--out", out, "--fail-on", rule]
    done = runner.invoke(report_command, arguments)
    assert (done.exit_code, done.stdout, done.stderr) == (0, "", "")


def test_out_writes_there_and_leaves_the_session_alone(store: SessionStore, tmp_path: Path) -> None:
    before = {p: p.read_bytes() for p in store.folder.rglob("*") if p.is_file()}
    out = tmp_path / "page.html"
    done = CliRunner().invoke(report_command, [str(store.folder), "--out", str(out), "--quiet"])
    assert done.exit_code == 0
    checked(out.read_text("utf-8"))
    assert {p: p.read_bytes() for p in store.folder.rglob("*") if p.is_file()} == before
