"""The whole loop in the simulated lab: a kill costs nothing."""

import json
import re
import subprocess
from collections.abc import Callable
from pathlib import Path

import pytest

from file_trees import bytes_of
from realsim.app.console import Console, StageTime
from realsim.app.demo.run import DemoResult, show_demo
from realsim.app.demo.site import PAGES, write_site
from realsim.app.truth import LoopErrors, loop_errors
from realsim.store import SessionStore
from typed_commands import realsim, started, wait_until

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
