"""One session's report: what it says, of whole sessions and of broken ones.

Figures of a report, and limits on them.
"""

import json
import math
import re
from pathlib import Path
from typing import Literal

import numpy as np
import pytest

from begun_sessions import begun
from page_tags import Tags
from realsim.app.annotate.run import run_annotate
from realsim.app.console import Console
from realsim.app.register.results import held, sigmas
from realsim.app.report.compare_page import comparison_of, comparison_page
from realsim.app.report.figures import (
    Figure,
    count,
    figures_from_json,
    figures_to_json,
    share,
    shown,
)
from realsim.app.report.run import broken, limit_of, read_limits
from realsim.app.report.section import Section, built
from realsim.app.report.session import page_of, report_of, write_report
from realsim.app.report.sources import sources_of
from realsim.app.report.summary import Report, write_summary
from realsim.geometry.parts import part
from realsim.pages import Cell, Page
from realsim.review import journal
from realsim.store import SessionStore, load_scene, save_grasps
from refusals import refused
from registered_sessions import CAMERA
from review_browser import needs_chromium, review_browser
from shared_sessions import copy_of
from tried_grasps import tried_set
from typed_commands import invoked

HOSTILE = '<script>alert("x")</script>'
STAGES = (
    "calibration", "plan", "capture", "registration", "review", "school", "labels", "files",
    "settings",
)  # fmt: skip


@pytest.fixture(scope="module")
def registered(registered_few: Path, tmp_path_factory: pytest.TempPathFactory) -> SessionStore:
    """A registered session; one object is doubtful, one is not placed. Not to be changed."""
    store = SessionStore.open(copy_of(registered_few, tmp_path_factory.mktemp("report") / "s"))
    save_grasps(store, tried_set(np.random.default_rng(0), 30, obj_id=10, instance=0))
    return SessionStore.open(store.folder)


@pytest.fixture
def store(registered_few: Path, tmp_path: Path) -> SessionStore:
    """The same kind of session, to be changed."""
    return SessionStore.open(copy_of(registered_few, tmp_path / "s"))


@pytest.fixture(scope="module")
def page(registered: SessionStore) -> Path:
    """Its report."""
    return write_report(registered, report_of(registered, pictures="kept"))


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
    store = SessionStore.open(registered.folder)
    again = write_report(store, report_of(store, pictures="kept"))
    assert again == page and again.read_bytes() == first
    assert (again.parent / "report.json").read_bytes() == document


def test_a_report_does_not_count_the_record_of_the_one_before_and_exit_codes_tell(
    store: SessionStore,
) -> None:
    rules = ("--fail-on", "registration.accepted<2", "--fail-on", "registration.accepted<1")
    read = []
    for more in ((), ("--json", "--quiet", *rules)):
        done = invoked("report", store.folder, *more)
        read.append((store.folder / "reports" / "report.json").read_bytes())
    assert (store.folder / "stages" / "report.json").is_file() and read[0] == read[1]
    assert done.exit_code == 1 and "registration.accepted" in done.stderr
    assert len(json.loads(done.stdout)["failed"]) == 1  # the other is exactly met


def test_the_page_is_whole_needs_no_network_and_names_no_folder(
    registered: SessionStore, page: Path
) -> None:
    text = page.read_text("utf-8")
    assert text.startswith("<!DOCTYPE html>") and len(text) < 15_000_000
    attributes = [pair for _, given in Tags(text).seen for pair in given.items()]
    addresses = [v or "" for k, v in attributes if k in ("src", "href", "action")]
    assert all(a.startswith(("data:image/", "#")) for a in addresses if a != "data:,")
    assert "http://" not in text and "https://" not in text
    pictures = [a for a in addresses if a.startswith("data:image/")]
    assert len(pictures) == len(set(pictures)) > 3
    for place in (str(registered.folder), str(Path.home()), str(Path(__file__).parents[2])):
        assert place not in text
    anchors = {a[1:] for a in addresses if a.startswith("#")}
    assert anchors <= set(re.findall(r' id="([\w-]+)"', text)) and set(STAGES) <= anchors


def test_the_page_and_the_file_hold_the_same_figures(page: Path) -> None:
    document = json.loads((page.parent / "report.json").read_text())
    assert embedded(page.read_text("utf-8")) == document
    assert document["schema_version"] == 1
    assert document["figures"]["registration.objects"] == {
        "value": 2.0, "unit": "", "sigma": 0.0, "better": "none", "meaning": "objects placed",
    }  # fmt: skip
    # Covariance diag(3, 2, 1 mrad; 0.3, 0.2, 0.1 mm): the worst axes. The mug is no body of
    # revolution, so nothing is set aside.
    expected = {
        "registration.accepted": 1, "registration.not_placed": 1, "registration.views_used": 4,
        "registration.probability_min": pytest.approx(0.57), "school.candidates": 30,
        "registration.sigma_mm_max": pytest.approx(0.3, rel=1e-6),
        "registration.sigma_deg_max": pytest.approx(np.degrees(3e-3)),
    }  # fmt: skip
    assert {name: document["figures"][name]["value"] for name in expected} == expected


def test_the_worst_comes_first_and_missing_stages_name_their_command(
    registered: SessionStore, page: Path
) -> None:
    report = report_of(registered)
    severities = [f.severity for f in report.findings]
    assert severities == sorted(severities, key=("bad", "warn", "note").index)
    assert report.verdict == "look" and states(report)["labels"] == "missing"
    command = {s.key: s.command for s in report.missing}["labels"]
    assert command == "realsim annotate SESSION"
    first = page.read_text("utf-8").partition("<h2")[0]
    for words in ("Look first", "half of it is hidden", command):
        assert words in first


def test_a_page_never_says_that_all_passed_while_a_stage_is_not_done() -> None:
    def first_screen(**states: Literal["done", "missing"]) -> str:
        sections = tuple(
            Section(key=key, title=key, page=Page(), command=key, state=state)
            for key, state in states.items()
        )
        page = Page(title="s", about="")
        write_summary(page, Report(name="s", about="", sections=sections))
        return page.encode().decode()

    assert "All checks passed" in first_screen(labels="done", review="done")
    unreviewed = first_screen(labels="done", review="missing")
    assert "All checks passed" not in unreviewed and "Not done: review" in unreviewed
    assert "What was run passed" not in first_screen(labels="missing", review="done")


def test_what_reviewers_decided_is_told(store: SessionStore) -> None:
    doubtful = load_scene(store).objects[1]
    path = store.path(journal.JOURNAL_FILE)
    journal.append(path, journal.new_entry("accept", doubtful, HOSTILE, comment="looked at it"))
    journal.append(path, journal.new_entry("exclude", None, "Ada", view=1, comment="blurred"))
    report = report_of(store)
    figures = report.figures
    assert (figures["review.decided"].value, figures["review.open"].value) == (1, 0)
    assert figures["review.excluded_views"].value == 1
    assert figures["registration.accepted"].value == 2
    text = page_of(store, report).encode().decode()
    assert "<script>alert" not in text and "looked at it" in text and "blurred" in text


def test_a_hostile_name_is_only_text(tmp_path: Path) -> None:
    store = begun(tmp_path / "s", CAMERA, {"camera": HOSTILE, "x": "</script><b>"}, name=HOSTILE)
    report = report_of(store, pictures="kept", notes=[HOSTILE])
    text = write_report(store, report).read_text("utf-8")
    Tags(text)
    assert "<script>alert" not in text and "<b>" not in text.partition("</div>")[2]
    assert embedded(text)["session"] == HOSTILE


# --- missing and damaged ----------------------------------------------------------------------


@pytest.mark.parametrize(
    ("file", "stage"),
    [
        ("registration/scene.json", "registration"),
        ("registration/views.json", "registration"),
        ("models/models_info.json", "registration"),
        ("grasps/000000_obj000010.npz", "school"),
        ("review/journal.jsonl", "review"),
        ("plan.json", "plan"),
        ("calibration/hand_eye.json", "calibration"),
        ("annotations/000000.json", "labels"),
    ],
)
def test_a_damaged_file_is_named_and_the_other_sections_stand(
    registered: SessionStore, tmp_path: Path, file: str, stage: str
) -> None:
    path = copy_of(registered.folder, tmp_path / "s") / file
    path.parent.mkdir(exist_ok=True)
    whole = path.read_bytes() if path.is_file() else b'{"content": {"joints": [[1, 2]]'
    path.unlink(missing_ok=True)  # it may be linked to that of the other tests
    path.write_bytes(whole[: len(whole) // 2])
    report = report_of(SessionStore.open(tmp_path / "s"))
    told = {f.section for f in report.findings}
    section = next(s for s in report.sections if s.key == stage)
    assert stage in told or section.state == "damaged" or "files" in told
    assert states(report)["settings"] == "done" and report.figures["report.bad"].value >= 0


# --- Pages of a session fit the screen: tables scroll by themselves, never the page.


@pytest.fixture(scope="module")
def pages(registered_few: Path, tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """The report and the annotation's page of a registered session."""
    folder = tmp_path_factory.mktemp("pages")
    store = SessionStore.open(copy_of(registered_few, folder / "s"))
    run_annotate(store.folder, Console(quiet=True), maps="all", workers=1, check_depth=True)
    comparison = folder / "comparison.html"
    sources = sources_of([store.folder, store.folder])
    comparison.write_bytes(comparison_page(comparison_of(sources)).encode())
    return {
        "report": write_report(store, report_of(store, pictures="kept")),
        "comparison": comparison,
        "annotation": store.path("reports/annotated.html"),
    }


def test_tables_scroll_inside_the_page_and_every_check_is_in_one(pages: dict[str, Path]) -> None:
    for page in pages.values():
        text = page.read_text("utf-8")
        scrolled = re.findall(r'<div class="scroll[^>]*><table>', text)
        assert text.count("<table>") == len(scrolled) > 0
    rows = re.findall(r"<tr><td[^>]*>(?:<span>)?(.*?)</", pages["report"].read_text("utf-8"))
    assert {"agree", "probability"} <= set(rows)


def test_the_first_screen_has_a_picture_three_figures_and_what_to_do_next(
    pages: dict[str, Path],
) -> None:
    text = pages["report"].read_text("utf-8")
    first, *stages = re.split(r"<details class=\"stage\">", text)
    assert "<img" in first and first.index("<img") < first.index("<table>")
    assert first.count('class="card"') == 3 and "Next: realsim" in first
    heads = re.findall(r'<h2 id="(\w+)"', "".join(stages))
    assert {"registration", "capture", "labels"} <= set(heads)
    assert text.count("<details") == text.count("</details>")


def test_what_a_table_marks_is_also_found() -> None:
    def build(section: Section) -> None:
        section.page.table(["check", "state"], [["drift", Cell("warn", kind="warn")]])

    told = built(Section(key="capture", title="Capture", page=Page()), build)
    report = Report(name="", about="", sections=(told,))
    assert [f.severity for f in report.findings] == ["warn"] and "drift" in report.findings[0].text
    assert report.verdict == "look"


@pytest.mark.slow
@needs_chromium
def test_in_chromium_no_page_scrolls_sideways(pages: dict[str, Path]) -> None:
    width = 390
    with review_browser() as opened:
        shown = opened.browser.new_page(viewport={"width": width, "height": 900})
        for name, page in pages.items():
            shown.goto(page.as_uri())
            wide, seen = (
                shown.evaluate(f"document.documentElement.{what}Width")
                for what in ("scroll", "client")
            )
            assert wide <= seen and seen > width - 40, name


NAME = "calibration.held_out_px"


def test_figures_survive_the_round_trip_through_json() -> None:
    figures = {
        f.name: f
        for f in (
            Figure(name=NAME, value=0.1 + 0.2, sigma=1e-3),
            Figure(name="plan.tour_s", value=33.0),
            count("capture.views", 24),
        )
    }
    assert figures_from_json(figures_to_json(figures)) == figures


def test_a_figure_that_nobody_knows_or_that_is_no_number_is_refused() -> None:
    refused("no figure", Figure, name="calibration.nonsense", value=1.0)
    refused("a number is needed", Figure, name=NAME, value=math.nan)
    for given, why in (
        ({NAME: {"value": "much", "sigma": None}}, rf"figures.{NAME}'.value is 'much'"),
        ({NAME: {"value": 1, "sigma": None, "unit": "mm"}}, "unit 'mm'; 'px' is expected"),
        ({"a": {"b": 1}}, r"'figures\.a'\.value"),
    ):
        refused(why, figures_from_json, given)
    # A name of a newer version is no reason to refuse the rest.
    assert figures_from_json({"future.figure": {"value": 1, "sigma": None}}) == {}


@pytest.mark.parametrize(
    ("value", "sigma", "text"),
    [
        (646.835, 0.0111, "646.835 ± 0.011"), (24.0, 0.0, "24"), (0.12345678, None, "0.1235"),
        (1234.5, 23.0, "1234 ± 23"), (-0.000268, 8.7e-6, "-0.0002680 ± 0.0000087"),
    ],
)  # fmt: skip
def test_a_value_is_shown_to_the_digits_its_sigma_allows(
    value: float, sigma: float | None, text: str
) -> None:
    assert shown(value, sigma) == text


def test_the_sigma_of_a_share_is_the_spread_of_such_shares() -> None:
    rng = np.random.default_rng(3)
    n, p = 200, 0.3
    seen = rng.binomial(n, p, 4000)
    mean = np.mean([share("school.good_share", int(k), n).sigma or 0.0 for k in seen])
    assert mean == pytest.approx(np.std(seen / n), rel=0.04)
    # Where all did, the next one may not: the sigma is not 0.
    assert (share("school.good_share", 5, 5).sigma or 0.0) > 0.1


# --- limits -----------------------------------------------------------------------------------


def test_a_limit_that_is_exactly_met_is_kept_and_the_next_number_breaks_it() -> None:
    at = {NAME: Figure(name=NAME, value=0.25)}
    for rule, beyond in ((f"{NAME}>0.25", np.nextafter(0.25, 1)), (f"{NAME}<0.25", 0.2499)):
        assert not list(broken([limit_of(rule)], at))
        told = list(broken([limit_of(rule)], {NAME: Figure(name=NAME, value=float(beyond))}))
        assert len(told) == 1 and NAME in told[0]


def test_a_limit_on_what_is_not_there_is_broken() -> None:
    assert "not there" in next(broken([limit_of("registration.accepted<1")], {}))


@pytest.mark.parametrize(
    ("text", "named"),
    [
        ("nonsense = {max = 1}", "calibration.held_out_px"),  # the known ones are listed
        ("calibration.held_out_px = 3", "no limit"),
        ('calibration.held_out_px = {max = "much"}', "no number"),
        ("calibration.held_out_px = {min = 2, max = 1}", "min above max"),
        ("calibration.held_out_px = {most = 2}", "no figure"),
        ("", "names no figure"), ("= 3", "not TOML"),
    ],
)  # fmt: skip
def test_a_file_of_limits_that_says_something_else_is_refused(
    tmp_path: Path, text: str, named: str
) -> None:
    path = tmp_path / "limits.toml"
    path.write_text(text)
    refused(named, read_limits, path)


@pytest.mark.parametrize("rule", ["held_out", "plan.views<=3", "nothing<3", "plan.views<inf"])
def test_a_rule_that_cannot_be_read_is_refused(rule: str) -> None:
    refused(".", limit_of, rule)


# --- uncertainty ------------------------------------------------------------------------------


def test_holding_is_conditioning_and_never_adds_uncertainty() -> None:
    rng = np.random.default_rng(1)
    A = rng.normal(size=(6, 6))
    C, u = A @ A.T, np.array([1.0, 2.0, 2.0]) / 3
    tight = held(C, [u])
    assert np.linalg.eigvalsh(C - tight)[0] > -1e-9
    np.testing.assert_allclose(np.concatenate([u, np.zeros(3)]) @ tight, 0, atol=1e-9)
    np.testing.assert_allclose(held(C, [u, 2 * u]), tight, atol=1e-9)  # the same axis twice
    np.testing.assert_allclose(held(C, []), C)
    # Of a ball nothing is left of the rotation; the place, given the rotation, remains.
    ball = held(C, [[1, 0, 0], [0, 1, 0]])
    np.testing.assert_allclose(ball[:3], 0, atol=1e-9)
    given = C[3:, 3:] - C[3:, :3] @ np.linalg.inv(C[:3, :3]) @ C[:3, 3:]
    np.testing.assert_allclose(ball[3:, 3:], given, atol=1e-9)


def covariance(rng: np.random.Generator, axis: np.ndarray, free_rad: float) -> np.ndarray:
    """A well-known pose (0.1 mm, 0.05 deg) but for a turn about an axis."""
    small = np.concatenate([np.full(3, np.radians(0.05)), np.full(3, 1e-4)])
    Q, _ = np.linalg.qr(rng.normal(size=(6, 6)))
    C = np.diag(small) @ Q @ np.diag(rng.uniform(0.5, 1.0, 6)) @ Q.T @ np.diag(small)
    free = np.concatenate([axis, np.zeros(3)])
    return C + free_rad**2 * np.outer(free, free)


def test_a_free_turn_is_set_aside_even_where_the_declared_axis_is_two_degrees_off() -> None:
    rng = np.random.default_rng(0)
    declared = np.array([0.0, 0.0, 1.0])
    for _ in range(20):
        tilt = np.radians(2.0)
        a = rng.uniform(0, 2 * np.pi)
        axis = np.array([np.sin(tilt) * np.cos(a), np.sin(tilt) * np.sin(a), np.cos(tilt)])
        C = covariance(rng, axis, free_rad=0.5)
        tight = held(C, [declared])
        worst = np.degrees(np.sqrt(np.linalg.eigvalsh(tight[:3, :3])[-1]))
        assert worst < 0.06, worst
        # The projection of the marginal leaves sin(2 deg) of the free turn's 29 deg.
        P = np.eye(3) - np.outer(declared, declared)
        assert np.degrees(np.sqrt(np.linalg.eigvalsh(P @ C[:3, :3] @ P)[-1])) > 0.5


def test_a_free_turn_is_no_uncertainty_and_what_is_unknown_is_nan() -> None:
    C = np.diag([1e-3, 2e-3, 0.5, 1e-4, 2e-4, 3e-4]) ** 2
    tube = part("tube")  # turns about its z axis
    assert sigmas(C, tube) == pytest.approx((0.3, np.degrees(2e-3)))
    assert sigmas(C, None)[1] == pytest.approx(np.degrees(0.5))
    assert np.isnan([*sigmas(None, tube), *sigmas(np.full((6, 6), np.nan), None)]).all()
