"""The review's door: frames that are no messages of the page, and reviewers who come and go."""

import argparse
import contextlib
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
from figures import Found
from reliability_log import Log
from review_client import CAMERA, Browser
from review_opening import Server, serving
from websockets.exceptions import ConnectionClosed

FRAMES, QUICK_FRAMES, BATCH = 5_000, 100, 20
"""Frames in all, and those between two looks at whether the server still answers."""
ANSWER_S = 30.0
"""A server that answers no ping for so long hangs."""
SOAK_S, QUICK_SOAK_S = 3600.0, 5.0
LEAST_VISITS, LOOPS = 12, 3
"""Reviewers, and whole loops after the one that warms up."""
HOSTILE = (
    None, True, -1, 2**63, 1e308, float("nan"), float("inf"), "", "\x00", "x" * 4000, "../../etc",
    b"\xff" * 40, [], [1] * 4, [[[]]] * 9, {}, {"a": {"b": None}}, [None] * 3, ["x", 1.0, {}],
)  # fmt: skip
"""Values of every wrong kind."""


@contextlib.contextmanager
def served() -> Iterator[tuple[Server, Path]]:
    """Yield a review of a small scene in a process of its own, and its log."""
    sys.path.append(str(Path(__file__).parents[1] / "tests/support"))
    from reviewed_boxes import boxes_session

    with tempfile.TemporaryDirectory() as folder:
        session, log = Path(folder) / "boxes", Path(folder) / "log"
        boxes_session(session).close()
        with log.open("wb") as file, serving(session, ("0.005", "4000", "2000"), file) as server:
            yield server, log


def frame(rng: np.random.Generator, controls: list[str]) -> bytes | str:
    """Return a frame that no browser sends: no message at all, or one with foreign values."""
    from viser import _messages as viser_messages

    types = viser_messages.Message._subclass_from_type_string()
    heard = [
        n for n in types if n.startswith(("Gui", "Scene", "Viewer", "File", "Command", "Share"))
    ]

    def foreign() -> Any:
        return HOSTILE[int(rng.integers(len(HOSTILE)))]

    kind, name = int(rng.integers(10)), heard[int(rng.integers(len(heard)))]
    message: Any = {"type": "GuiUpdateMessage", "updates": {"value": foreign()}, "uuid": ""}
    if kind < 3:
        message = {"type": name, **{f: foreign() for f in types[name].__dataclass_fields__}}
    elif kind == 3:
        message = CAMERA | {list(CAMERA)[int(rng.integers(1, len(CAMERA)))]: foreign()}
    elif kind < 6:
        message = {"type": name} if kind == 4 else foreign()
    if isinstance(message, dict) and "uuid" in message and controls:
        message["uuid"] = controls[int(rng.integers(len(controls)))]
    data = msgspec.msgpack.encode(message)
    if kind == 6:
        return data[: int(rng.integers(len(data)))]
    if kind == 7:
        return rng.bytes(int(rng.integers(1, 200)))
    return "text" if kind == 8 else data


def frames(given: argparse.Namespace, log: Log) -> None:
    """Send frames that are no messages; the server's log has a line for each, no traceback."""
    count = (QUICK_FRAMES if given.quick else FRAMES) // BATCH
    if not (todo := [*log.todo("frames", given.seed, count)]):
        return
    browser, controls, before = None, list[str](), 0
    with served() as (server, file):
        for k in todo:
            rng, sent, hangs = np.random.default_rng((given.seed, k)), 0, 0
            while sent < BATCH:
                if browser is None or browser.socket.close_code is not None:
                    browser = Browser.open(server.url)
                    browser.until_scene(0.3, 60.0)
                    controls = [str(m["uuid"]) for m in browser.messages if "uuid" in m]
                with contextlib.suppress(ConnectionClosed):
                    while sent < BATCH:
                        browser.socket.send(frame(rng, controls))
                        sent += 1
                    answer, end = browser.socket.ping(), time.monotonic() + ANSWER_S
                    while not answer.wait(0.1) and browser.socket.close_code is None and not hangs:
                        hangs = int(time.monotonic() > end)
            said = file.read_text(errors="replace")
            wrong = said.count("Traceback (most recent call last)") - before
            before += wrong
            found = {"inputs": sent, "traceback": wrong, "hang": hangs}
            found |= {"peak_mb": server.cost().peak_mb, "said": said[-3000:] if wrong else ""}
            log.add("frames", given.seed, k, **found)


def soak(given: argparse.Namespace) -> Found:
    """Let reviewers come, judge and go, and run whole loops; the greatest memory must not grow."""
    seconds, begin = QUICK_SOAK_S if given.quick else SOAK_S, time.monotonic()
    held: list[float] = []
    with served() as (server, _):
        while len(held) < LEAST_VISITS or time.monotonic() - begin < seconds:
            browser = Browser.open(server.url)
            browser.until_scene(0.3, 60.0)
            for label in ("Accept", "Next", "Undo"):
                if (button := browser.control(label)) is not None:
                    browser.set(button, True)
                    browser.until_quiet(0.2, 10.0)
            browser.close()
            held.append(server.cost().peak_mb)
    over = f"{len(held)} reviewers in {time.monotonic() - begin:.0f} s"
    growth, found = held[-1] / held[len(held) // 3] - 1, Found(cases={"review_mb": held})
    if not given.quick:
        found.cases["loop_mb"] = loops = [whole_loop() for _ in range(LOOPS + 1)][1:]
        growth = max(growth, loops[-1] / loops[0] - 1)
    found.add("soak_growth", growth, over)
    return found


def whole_loop() -> float:
    """Run a small demo in this process; return the most memory that it has held [MB]."""
    from realsim.app.console import Console
    from realsim.app.demo.run import DemoConfig, run_demo

    with tempfile.TemporaryDirectory() as folder:
        config = DemoConfig(views=6, objects=2, grasps_per_object=8, workers=1)
        Path("/proc/self/clear_refs").write_text("5")  # the peak of this loop alone
        run_demo(config, Path(folder) / "demo", Console(quiet=True))
    status = Path("/proc/self/status").read_text("ascii", "replace")
    return int(status.split("VmHWM:")[1].split()[0]) / 1024
