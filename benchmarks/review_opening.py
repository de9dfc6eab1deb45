"""Opening a scene, and clicking in it: what the server's process costs, seen from another one."""

import json
import os
import shutil
import subprocess
import sys
import tempfile
import time
from argparse import Namespace
from collections.abc import Callable, Generator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import IO, Any

import numpy as np
from figures import Found
from review_client import Browser
from review_session import GRASPS, make_session

VIEWS, QUICK_VIEWS = 256, 96
SERVER = Path(__file__).with_name("review_server.py")
USUAL = ("0.002", "400000", "100000")
"""Voxel [m], points kept and points shown of the settings as they are delivered."""
BIG = ("0.0003", "2000000", "2000000")
"""The same with 2 million points, all of them sent."""
QUIET_S = 2.0
"""Nothing is sent for so long: the scene is there."""
WINDOWS, SHORT_S = 60, 0.5
"""Windows that are opened one after the other, and for how long nothing is sent to each at last."""
CLICK_QUIET_S = 0.3
"""Nothing is sent for so long after a click: it is answered."""
IMPORTS = (
    "import trimesh, scipy.spatial, cv2, isal.isal_zlib, viser, realsim.review, "
    "realsim.review.window.window, realsim.review.content.content, "
    "realsim.review.drawing.scene_nodes, realsim.models.simplify, realsim.registration, "
    "numba, sys, pathlib; "
    "from realsim.review.content import quick_png; "
    "quick_png.read_rgb(pathlib.Path(sys.argv[1]) / 'rgb/000000.png'); "
    "quick_png.read_depth(pathlib.Path(sys.argv[1]) / 'depth/000000.png', 1e-4)"
)
"""What is compiled before anything is measured: an installed program is, after its first run."""


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Cost:
    """What the server's process has cost so far."""

    cpu_s: float
    peak_mb: float
    now_mb: float


class Server:
    """A running server process."""

    def __init__(self, process: "subprocess.Popen[str]") -> None:
        """Wait for its address."""
        self._in: IO[str] = _pipe(process.stdin)
        self._out: IO[str] = _pipe(process.stdout)
        self.url = str(self._next("url")["url"])

    def cost(self) -> Cost:
        """Return what it has cost so far."""
        self._in.write("\n")
        self._in.flush()
        return Cost(**self._next("cpu_s"))

    def _next(self, key: str) -> dict[str, Any]:
        for line in self._out:
            if line.startswith("{") and key in line:
                return json.loads(line)
        raise RuntimeError("the server ended; its messages stand above.")


def _pipe(end: IO[str] | None) -> IO[str]:
    assert end is not None
    return end


@lru_cache(maxsize=1)
def _scratch() -> Path:
    """Return a folder for the session and the byte code; `clean_up` takes it away."""
    return Path(tempfile.mkdtemp(prefix="review_bench_"))


def clean_up() -> None:
    """Delete what was made."""
    if _scratch.cache_info().currsize:
        shutil.rmtree(_scratch(), ignore_errors=True)


def scene_of(arguments: Namespace) -> Path:
    """Return the session that all parts look at."""
    given = os.environ.get("REVIEW_SESSION")
    if given:
        return Path(given)
    folder = _scratch() / "session"
    if not folder.exists():
        make_session(folder, QUICK_VIEWS if arguments.quick else VIEWS, arguments.seed)
    return folder


def _environment() -> dict[str, str]:
    # As installed: byte code is kept. Where the caller forbids it every start would compile.
    kept = {k: v for k, v in os.environ.items() if k != "PYTHONDONTWRITEBYTECODE"}
    return kept | {"PYTHONPYCACHEPREFIX": str(_scratch() / "bytecode")}


@lru_cache(maxsize=1)
def _compile(folder: Path) -> None:
    command = [sys.executable, "-c", IMPORTS, str(folder)]
    subprocess.run(command, env=_environment(), check=True)


@contextmanager
def serving(
    folder: Path, settings: tuple[str, str, str], log: IO[bytes] | None = None
) -> Generator[Server]:
    """Run the server on a session in a process of its own; None = it complains on the terminal."""
    _compile(folder)
    command = [sys.executable, str(SERVER), str(folder), *settings]
    with subprocess.Popen(
        command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=log, text=True,
        env=_environment(),
    ) as process:  # fmt: skip
        try:
            yield Server(process)
        finally:
            if process.stdin is not None:
                process.stdin.close()
            try:
                process.wait(20)
            except subprocess.TimeoutExpired:
                process.kill()


def _forget(folder: Path) -> None:
    """Take away what earlier openings have kept."""
    shutil.rmtree(folder / "review", ignore_errors=True)


def _decoding_s(folder: Path) -> float:
    """Return what decoding every photograph once with OpenCV costs [CPU s], from every eighth."""
    import cv2

    files = sorted((folder / "rgb").glob("*.png"))
    data = [np.frombuffer(f.read_bytes(), np.uint8) for f in files[::8]]
    start = time.process_time()
    for d in data:
        cv2.imdecode(d, cv2.IMREAD_COLOR)
    return (time.process_time() - start) / len(data) * len(files)


def _opened(
    folder: Path, settings: tuple[str, str, str], after: Callable[[Browser], None] | None = None
) -> tuple[Cost, Browser]:
    """Open the scene in a browser; return what it cost until everything was sent."""
    with serving(folder, settings) as server:
        browser = Browser.open(server.url)
        browser.until_scene(QUIET_S)
        if after is not None:
            after(browser)
            browser.until_quiet(QUIET_S)
        cost = server.cost()
        browser.close()
    return cost, browser


def opening(arguments: Namespace) -> Found:
    """Open the scene of 256 views as delivered, cold and warm."""
    found = Found()
    folder = scene_of(arguments)
    limit = _decoding_s(folder)
    _forget(folder)
    cold, browser = _opened(folder, USUAL)
    frustums = len(browser.of_type("CameraFrustumMessage"))
    found.add("open_cpu_s", cold.cpu_s, f"{frustums} frustums with photographs, nothing kept")
    found.add("open_over_decoding", cold.cpu_s / limit,
              f"all photographs decoded once by OpenCV: {limit:.1f} CPU s")  # fmt: skip
    found.add("open_mb", cold.peak_mb, "greatest resident size of the server's process")
    found.add("open_sent_mb", browser.received_bytes / 1e6)
    warm, _ = _opened(folder, USUAL)
    found.add("open_warm_cpu_s", warm.cpu_s, "photographs kept by an earlier opening")
    return found


def windows(arguments: Namespace) -> Found:
    """Open and close one window after the other; compare the memory with that after the first."""
    found, held = Found(), list[float]()
    with serving(scene_of(arguments), USUAL) as server:
        for _ in range(1 + WINDOWS):
            browser = Browser.open(server.url)
            browser.until_scene(SHORT_S)
            browser.close()
            time.sleep(SHORT_S)
            held.append(server.cost().now_mb)
    over = ", ".join(f"{mb:.0f}" for mb in held[::10])
    found.add("windows_growth", held[-1] / held[0], f"{WINDOWS} windows; every tenth: {over} MB")
    return found


def big_scene(arguments: Namespace) -> Found:
    """Open 2 million points, 256 frustums and 5,000 grasps, photographs kept or not as they are."""
    found = Found()
    folder = scene_of(arguments)

    def all_grasps(browser: Browser) -> None:
        of = browser.control("Of", "GuiDropdownMessage")
        least = browser.control("Least score", "GuiSliderMessage")
        show = browser.control("Show grasps", "GuiCheckboxMessage")
        for uuid, value in ((of, "all objects"), (least, 0.0), (show, True)):
            if uuid is not None:
                browser.set(uuid, value)

    _forget(folder)
    cost, browser = _opened(folder, BIG, all_grasps)
    points = sum(browser.count(m, "points") for m in browser.of_type("PointCloudMessage"))
    grasps = max(
        (browser.count(m, "batched_positions") for m in browser.of_type("BatchedMeshesMessage")),
        default=0,
    )
    over = f"{points} points, {len(browser.of_type('CameraFrustumMessage'))} frustums, "
    found.add("big_open_cpu_s", cost.cpu_s, over + f"{grasps} of {GRASPS} grasps; nothing kept")
    found.add("big_open_mb", cost.peak_mb)
    found.add("big_sent_mb", browser.received_bytes / 1e6)
    return found
