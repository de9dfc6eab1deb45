"""Pages of a session fit the screen: tables scroll by themselves, never the page."""

import html
import re
import shutil
import subprocess
from pathlib import Path

import pytest

from realsim.app.annotate.run import run_annotate
from realsim.app.console import Console
from realsim.app.report.compare_page import comparison_of, comparison_page
from realsim.app.report.section import Section, built
from realsim.app.report.session import write_report
from realsim.app.report.sources import sources_of
from realsim.app.report.summary import Report
from realsim.pages import Cell, Page
from realsim.store import SessionStore
from shared_sessions import copy_of

CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser")


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
        "report": write_report(store, None),
        "comparison": comparison,
        "annotation": store.path("reports/annotated.html"),
    }


def test_tables_scroll_inside_the_page_and_every_check_is_in_one(pages: dict[str, Path]) -> None:
    for page in pages.values():
        text = page.read_text("utf-8")
        assert (
            text.count("<table>") == len(re.findall(r'<div class="scroll[^>]*><table>', text)) > 0
        )
    rows = re.findall(r"<tr><td[^>]*>(?:<span>)?(.*?)</", pages["report"].read_text("utf-8"))
    assert {"agree", "probability"} <= set(rows)


def test_the_first_screen_has_a_picture_three_figures_and_what_to_do_next(
    pages: dict[str, Path],
) -> None:
    text = pages["report"].read_text("utf-8")
    first, *stages = re.split(r"<details class=\"stage\">", text)
    assert "<img" in first and first.index("<img") < first.index("<table>")
    assert first.count('class="card"') == 3 and "Next: realsim" in first
    assert {"registration", "capture", "labels"} <= set(
        re.findall(r'<h2 id="(\w+)"', "".join(stages))
    )
    assert text.count("<details") == text.count("</details>")


def test_what_a_table_marks_is_also_found() -> None:
    def build(section: Section) -> None:
        section.page.table(["check", "state"], [["drift", Cell("warn", kind="warn")]])

    told = built(Section(key="capture", title="Capture", page=Page()), build)
    report = Report(name="", about="", sections=(told,))
    assert [f.severity for f in report.findings] == ["warn"] and "drift" in report.findings[0].text
    assert report.verdict == "look"


@pytest.mark.slow
@pytest.mark.skipif(CHROMIUM is None, reason="chromium is not installed")
def test_in_chromium_no_page_scrolls_sideways(pages: dict[str, Path], tmp_path: Path) -> None:
    width = 390
    for name, page in pages.items():
        frame = tmp_path / "frame.html"
        source = html.escape(page.read_text("utf-8"))
        frame.write_text(
            f'<iframe id="f" style="width:{width}px;height:900px;border:0" srcdoc="{source}">'
            "</iframe><script>onload = () => { const e = f.contentDocument.documentElement;"
            'document.title = e.scrollWidth + " of " + e.clientWidth; }</script>',
            "utf-8",
        )
        done = subprocess.run(
            [str(CHROMIUM), "--headless", "--no-sandbox", "--disable-gpu",
             "--disable-dev-shm-usage", f"--user-data-dir={tmp_path / 'profile'}",
             "--dump-dom", frame.as_uri()],
            capture_output=True, text=True, timeout=120, check=True,
        )  # fmt: skip
        found = re.search(r"<title>(\d+) of (\d+)</title>", done.stdout)
        assert found, name
        assert int(found[1]) <= int(found[2]) and int(found[2]) > width - 40, name
