"""The tour and the guides are true: their commands run in order and print what the text says."""

import json
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
from played import ENVIRONMENT, play, read, run
from printed import agrees

from documents import ROOT, blocks, prose

TOUR = (ROOT / "docs/tour/README.md", *sorted((ROOT / "docs/tour").glob("[0-9]*.md")))
API = sorted((ROOT / "docs/api").glob("*.md"))

# --- the comparison ----------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("said", "printed", "same"),
    [
        ("│ tube │ 60 │ 0.50 │", "| tube".replace("|", "│") + "  │  60 │ 0.49 │", True),
        ("camera 0.308 mm", "camera 0.31 mm", True),
        ("camera 0.308 mm", "camera 0.41 mm", False),
        ("views 24", "views 20", False),
        ("1 sigma 0.03 mm", "1 sigma 0.05 mm", True),
        ("1 sigma 0.03 mm", "1 sigma 0.06 mm", False),
        ("verdict accepted", "verdict doubtful", False),
    ],
)
def test_lines_are_compared_as_the_first_page_says(said: str, printed: str, same: bool) -> None:
    assert agrees(said, printed) is same


# --- the text ----------------------------------------------------------------------------------


@pytest.mark.parametrize("chapter", TOUR, ids=lambda p: p.stem)
def test_figures_of_the_text_stand_beside_the_command_that_makes_them(chapter: Path) -> None:
    shown = "\n".join(b.text for page in (TOUR[0], chapter) for b in blocks(read(page)))
    text = re.sub(r"\]\([^)]*\)", "]", prose(read(chapter)))
    told = set(re.findall(r"(?<![\w.])\d+\.\d{2,}", text))
    assert not [figure for figure in told if figure not in shown]


@pytest.mark.parametrize("chapter", TOUR, ids=lambda p: p.stem)
def test_output_stands_below_what_prints_it(chapter: Path) -> None:
    kinds = [b.kind for b in blocks(read(chapter)) if b.kind]
    for before, kind in zip(["", *kinds], kinds, strict=False):
        assert kind in ("sh", "python", "text", "json")
        assert kind != "text" or before in ("sh", "python")


# --- all of it, run ----------------------------------------------------------------------------


@pytest.mark.slow
def test_the_tour_prints_what_it_says(tmp_path: Path) -> None:
    wrong = [line for chapter in TOUR for line in play(chapter, tmp_path)]
    snippets_of_the_reference_run(tmp_path)
    assert not wrong, "\n\n".join(wrong)


def snippets_of_the_reference_run(folder: Path) -> None:
    """Run them on the tour's data, each in an empty space of names, in one process."""
    snippets = [b.text for page in API for b in blocks(read(page)) if b.kind == "python"]
    (folder / "snippets.json").write_text(json.dumps(snippets))
    code = (
        "import json\n"
        "for text in json.load(open('snippets.json')):\n"
        "    print('--- next'); exec(compile(text, text, 'exec'), {'__name__': 'snippet'})"
    )
    printed = run([sys.executable, "-c", code], folder).split("--- next\n")[1:]
    assert len(printed) == len(snippets) > 8 and all(text.strip() for text in printed)


# --- The guides, likewise

PLAYED = ("calibrate-a-new-lab", "your-own-gripper")
"""A lab of its own, board views first: plan, capture, calibrate, and the figures of all three; a
gripper that is not in the package: described, proven and simulated."""


@pytest.mark.slow
@pytest.mark.parametrize("guide", PLAYED)
def test_a_guide_prints_what_it_says(guide: str, tmp_path: Path) -> None:
    wrong = play(ROOT / f"docs/how-to/{guide}.md", tmp_path)
    assert not wrong, "\n\n".join(wrong)


@pytest.mark.slow
def test_an_arm_that_is_not_in_the_package_is_proven_planned_for_and_captured_with(
    tmp_path: Path,
) -> None:
    robots = Path("examples/robots")
    shutil.copytree(ROOT / robots, tmp_path / robots)
    wrong = play(ROOT / "docs/how-to/your-own-arm.md", tmp_path)
    assert not wrong, "\n\n".join(wrong)
    header = json.loads((tmp_path / "own/session.json").read_text())
    assert header["extra"]["arm"] == "SixJoint"
    plan = json.loads((tmp_path / "own.json").read_text())["content"]
    assert plan["robot"] == "SixJoint" and plan["metrics"]["colliding_legs"] == 0


# --- Sphinx builds the pages without a warning, from what is here alone

NO_NETWORK = """
import socket, sys
def refuse(*args, **kwargs):
    raise OSError("the documentation is built without a network")
socket.socket.connect = socket.create_connection = refuse
from sphinx.cmd.build import main
sys.exit(main(sys.argv[1:]))
"""


@pytest.mark.slow
def test_the_pages_are_built_with_warnings_as_errors(tmp_path: Path) -> None:
    done = subprocess.run(
        [
            sys.executable, "-c", NO_NETWORK, "-q", "-W", "--keep-going", "-b", "html",
            "-d", str(tmp_path / "read"), str(ROOT / "docs"), str(tmp_path / "site"),
        ],
        capture_output=True, text=True, timeout=1200,
        env=ENVIRONMENT,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr[-6000:]
    site = tmp_path / "site"
    for page in ("index", "tour/05-school", "api/store", "how-to/import-bop"):
        assert (site / f"{page}.html").is_file()
    assert "SessionStore.open" in read(site / "api/store.html")
    assert not (ROOT / "docs/_build").exists()
