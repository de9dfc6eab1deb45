"""What a person gets to see: the pages of review and report in Chromium without a graphics card."""

import tempfile
import time
from argparse import Namespace
from collections.abc import Generator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from figures import Found
from review_opening import USUAL, serving
from review_session import make_session

VIEWS = 24
WIDTH, HEIGHT = 1280, 800
ARGS = (
    "--no-sandbox", "--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader",
    "--ignore-gpu-blocklist", "--disable-dev-shm-usage",
)  # fmt: skip
HARMLESS = ("GPU stall due to ReadPixels", "GL Driver Message")
"""Messages of the software renderer, not of the page."""
LONGEST_S = 60.0
DRAWN_SIGMA = 12.0
"""Spread of the grey values in the middle of the window from which on a scene is drawn."""
PANELS = f"""(() => {{ let free = 0, all = 0;
  for (let x = 4; x < {WIDTH}; x += 8) for (let y = 4; y < {HEIGHT}; y += 8) {{
    all += 1; const top = document.elementFromPoint(x, y);
    if (top && (top.tagName === "CANVAS" || top.querySelector("canvas"))) free += 1; }}
  return free / all; }})()"""
"""Share of the window where the scene is what the pointer meets."""
FIRST_PHOTO = """Math.min(...[...document.images].filter(i => i.src && i.offsetParent)
    .map(i => i.getBoundingClientRect().top + scrollY))"""


def page(_: Namespace) -> Found:
    """Open the review of 24 views and the report of the same session at 1280x800."""
    from realsim.app.report.session import page_of, report_of
    from realsim.store import SessionStore

    found = Found()
    with tempfile.TemporaryDirectory(prefix="review_page_") as scratch:
        folder, report = Path(scratch) / "session", Path(scratch) / "report.html"
        make_session(folder, VIEWS, 0)
        store = SessionStore.open(folder)
        report.write_bytes(page_of(store, report_of(store, None, "shown")).encode(np.inf))
        with serving(folder, USUAL) as server, chromium_page() as (window, errors):
            start = time.perf_counter()
            window.goto(server.url)
            while _spread(window) < DRAWN_SIGMA and time.perf_counter() - start < LONGEST_S:
                window.wait_for_timeout(50)
            found.add(
                "first_frame_s", time.perf_counter() - start, "points or objects in the middle"
            )
            for close in window.query_selector_all(".mantine-Notification-closeButton"):
                close.click()  # it tells of the missing graphics card
            window.wait_for_timeout(1000)
            found.add("scene_share", float(window.evaluate(PANELS)), f"of {WIDTH}x{HEIGHT}")
            window.goto(report.as_uri())
            window.wait_for_timeout(500)
            found.add("report_first_photo_px", float(window.evaluate(FIRST_PHOTO)))
    found.add("console_errors", len(errors), "; ".join(errors)[:300])
    return found


@contextmanager
def chromium_page(url: str = "about:blank") -> Generator[tuple[Any, list[str]]]:
    """Open a page in Chromium; give it, and what the browser calls an error, as it comes."""
    from playwright.sync_api import sync_playwright

    errors: list[str] = []
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path="/usr/bin/chromium", args=list(ARGS))
        window = browser.new_page(viewport={"width": WIDTH, "height": HEIGHT})
        window.on("console", lambda m: errors.append(m.text) if _is_error(m) else None)
        window.on("pageerror", lambda e: errors.append(str(e)))
        window.goto(url)
        yield window, errors
        browser.close()


def _is_error(message: Any) -> bool:
    return message.type == "error" and not any(h in message.text for h in HARMLESS)


def _spread(window: Any) -> float:
    """Return the standard deviation of the grey values in the window's middle [of 255]."""
    import cv2

    clip = {"x": 420, "y": 250, "width": 400, "height": 300}
    data = np.frombuffer(window.screenshot(clip=clip, timeout=120_000), np.uint8)
    return float(np.std(np.asarray(cv2.imdecode(data, cv2.IMREAD_GRAYSCALE), np.float64)))
