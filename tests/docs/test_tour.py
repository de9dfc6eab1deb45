"""The tour is true: its commands run in order on one data set and print what the text says."""

import json
import os
import re
import shutil
import signal
import subprocess
import sys
import time
import urllib.request
from pathlib import Path

import pytest
from documents import ROOT, Block, blocks, prose
from printed import agrees, missing_lines

TOUR = (ROOT / "docs/tour/README.md", *sorted((ROOT / "docs/tour").glob("[0-9]*.md")))
API = sorted((ROOT / "docs/api").glob("*.md"))
GUIDE = ROOT / "docs/how-to/calibrate-a-new-lab.md"
"""A lab of its own, board views first: plan, capture, calibrate, and the figures of all three."""
GRIPPER = ROOT / "docs/how-to/your-own-gripper.md"
SERVER = "# Ctrl-C ends it"
START_S = 60.0
ENVIRONMENT = {
    **os.environ, "COLUMNS": "120", "NO_COLOR": "1", "OPENBLAS_NUM_THREADS": "1",
    "OMP_NUM_THREADS": "1", "PATH": f"{Path(sys.executable).parent}:{os.environ['PATH']}",
}  # fmt: skip
ENVIRONMENT.pop("REALSIM_CONFIG", None)


def read(path: Path) -> str:
    return path.read_text(encoding="utf-8")


def run(words: list[str], folder: Path) -> str:
    """Run to the end and return what was printed; it must end with 0."""
    done = subprocess.run(
        words, cwd=folder, env=ENVIRONMENT, capture_output=True, text=True, timeout=3600
    )
    assert done.returncode == 0, f"{words} ended with {done.returncode}:\n{done.stderr[-3000:]}"
    return done.stdout


def serve(line: str, folder: Path) -> str:
    """Run a server until its page can be had, end it as Ctrl-C does, return what it printed."""
    log = folder / "server.txt"
    with log.open("w") as out:
        server = subprocess.Popen(
            ["bash", "-c", f"exec {line} --port 0"], cwd=folder, env=ENVIRONMENT,
            stdout=out, stderr=subprocess.STDOUT,
        )  # fmt: skip
        try:
            until, found = time.monotonic() + START_S, None
            while found is None and time.monotonic() < until and server.poll() is None:
                time.sleep(0.2)
                found = re.search(r"http://\S+", read(log))
            assert found is not None, read(log)
            with urllib.request.urlopen(found[0], timeout=START_S) as page:
                assert page.status == 200 and b"<html" in page.read().lower()
            server.send_signal(signal.SIGINT)
            assert server.wait(START_S) in (0, 130), read(log)
        finally:
            server.kill()
    return read(log)


def printed_by(block: Block, folder: Path) -> str:
    """Run a block of the tour and return what it printed."""
    if block.kind == "python":
        return run([sys.executable, "-c", block.text], folder)
    out: list[str] = []
    for line in block.text.splitlines():
        if SERVER in line:
            out.append(serve(line.partition("#")[0].strip(), folder))
        elif line.strip():
            out.append(run(["bash", "-c", line], folder))
    return "\n".join(out)


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


def play(page: Path, folder: Path) -> list[str]:
    """Run the blocks of a page in order and return what was not printed."""
    wrong, printed = list[str](), ""
    for block in blocks(read(page)):
        if block.kind in ("sh", "python"):
            printed = printed_by(block, folder)
        elif block.kind == "toml":
            file = folder / block.text.splitlines()[0].removeprefix("# ")
            file.parent.mkdir()
            file.write_text(block.text, encoding="utf-8")
        elif block.kind == "text":
            wrong += [
                f"{page.name}: not printed: {line}\n{printed[-2500:]}"
                for line in missing_lines(block.text, printed)
            ]
    return wrong


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


@pytest.mark.slow
def test_the_guide_to_a_new_lab_prints_what_it_says(tmp_path: Path) -> None:
    wrong = play(GUIDE, tmp_path)
    assert not wrong, "\n\n".join(wrong)


@pytest.mark.slow
def test_a_gripper_that_is_not_in_the_package_is_described_proven_and_simulated(
    tmp_path: Path,
) -> None:
    wrong = play(GRIPPER, tmp_path)
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
