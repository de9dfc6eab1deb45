"""Pages of pictures: whole in one file, within the budget, usable by keyboard in a real browser."""

import base64
import json
import re
import shutil
import subprocess
import time
import urllib.request
from collections.abc import Iterator
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from websockets.sync.client import connect

from realsim.app.picture_pages import (
    LayeredView,
    Layers,
    Pair,
    Sheet,
    Sliders,
    Table,
    picture_page,
    slider_page,
    spread,
)
from realsim.errors import InputError


def flat(r: int, g: int, b: int, width: int = 320, height: int = 180) -> np.ndarray:
    return np.full((height, width, 3), (r, g, b), np.uint8)


def noisy(seed: int, width: int = 640) -> np.ndarray:
    rough = np.random.default_rng(seed).integers(0, 256, (90, width // 4, 3)).astype(np.uint8)
    return np.asarray(cv2.resize(rough, (width, 360), interpolation=cv2.INTER_CUBIC))


def pair(k: int = 0) -> Pair:
    return Pair(before=flat(200, 30, 30), after=flat(30, 30, 200), caption=f"view {k}",
                before_label="CAD start", after_label="registered")  # fmt: skip


class Tags(HTMLParser):
    """Counts the tags and checks that they close."""

    def __init__(self) -> None:
        super().__init__()
        self.open: list[str] = []
        self.seen: list[tuple[str, dict[str, str | None]]] = []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.seen.append((tag, dict(attrs)))
        if tag not in ("img", "meta", "input", "br"):
            self.open.append(tag)

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag


def tags(path: Path) -> Tags:
    parser = Tags()
    parser.feed(path.read_text("utf-8"))
    assert parser.open == []
    return parser


def pictures(path: Path) -> list[np.ndarray]:
    codes = re.findall(r'src="data:image/jpeg;base64,([^"]+)"', path.read_text("utf-8"))
    decoded = [cv2.imdecode(np.frombuffer(base64.b64decode(c), np.uint8), 1) for c in codes]
    return [np.asarray(d)[..., ::-1] for d in decoded]


def test_the_page_holds_its_pictures_and_asks_for_nothing_else(tmp_path: Path) -> None:
    path = tmp_path / "page.html"
    summary = slider_page(path, "A & B", [pair(0), pair(1)], about="<b>two</b> views")
    text = path.read_text("utf-8")
    assert "http" not in text
    assert "A &amp; B" in text and "&lt;b&gt;two" in text
    for _, attributes in tags(path).seen:
        for name in ("src", "href"):
            assert (attributes.get(name) or "data:").startswith("data:")
    shown = pictures(path)
    assert len(shown) == 4
    np.testing.assert_allclose(shown[0], flat(200, 30, 30), atol=4)
    np.testing.assert_allclose(shown[1], flat(30, 30, 200), atol=4)
    assert summary.size_bytes == path.stat().st_size
    assert summary.shown == {"Before and after": (2, 2)}


def test_the_same_pictures_make_the_same_bytes(tmp_path: Path) -> None:
    for name in ("a", "b"):
        slider_page(tmp_path / name, "x", [pair(k) for k in range(3)])
    assert (tmp_path / "a").read_bytes() == (tmp_path / "b").read_bytes()


@pytest.mark.parametrize("budget", [1_000_000, 2_000_000])
def test_the_budget_is_kept_and_the_page_says_what_is_left_out(tmp_path: Path, budget: int) -> None:
    path = tmp_path / "page.html"
    made: list[int] = []

    def picture(k: int) -> np.ndarray:
        made.append(k)
        return noisy(k)

    sheet = Sheet(
        title="Views", pictures=[(f"view {k}", lambda k=k: picture(k)) for k in range(64)]
    )
    sliders = Sliders(title="Pairs", pairs=[
        Pair(before=noisy(k), after=noisy(k + 1), caption=f"pair {k}") for k in range(3)
    ])  # fmt: skip
    summary = picture_page(path, "much", [sliders, sheet], budget_bytes=budget)
    assert path.stat().st_size <= budget
    shown, total = summary.shown["Views"]
    assert total == 64 and 0 < shown < 64
    assert f"{shown} of 64 pictures are shown." in path.read_text("utf-8")
    assert len(made) <= shown + 5  # views that are not shown are not made
    captions = [int(c) for c in re.findall(r'aria-label="view (\d+), open', path.read_text())]
    assert captions == sorted(captions) and len(captions) == shown
    if shown > 2:
        assert np.diff([*captions, 64]).max() <= 2 * 64 / shown + 1


def test_a_first_part_of_the_spread_covers_the_range() -> None:
    for total in (1, 2, 7, 64, 100):
        order = list(spread(total))
        assert sorted(order) == list(range(total))
        for n in range(1, total + 1):
            gaps = np.diff([*sorted(order[:n]), total])
            assert gaps.max() <= 4 * total / n + 1


def test_large_pictures_are_reduced_and_keep_their_shape(tmp_path: Path) -> None:
    large, grey = flat(9, 9, 9, 3840, 2160), flat(9, 9, 9)[..., 0]
    picture_page(tmp_path / "p", "x", [Sheet(title="s", pictures=[("a", large), ("b", grey)])])
    first, second = pictures(tmp_path / "p")
    assert first.shape == (720, 1280, 3)
    assert second.shape == (180, 320, 3)


def test_tables_have_a_chip_of_every_objects_colour(tmp_path: Path) -> None:
    table = Table(title="Objects", header=["object", "error [mm]"],
                  rows=[["<mug>", 0.4], ["bowl", 1.2]], colors=[(1, 2, 3), (4, 5, 6)])  # fmt: skip
    picture_page(tmp_path / "p", "x", [table])
    text = (tmp_path / "p").read_text("utf-8")
    tags(tmp_path / "p")
    assert "rgb(1,2,3)" in text and "&lt;mug&gt;" in text and ">1.2<" in text


def test_bad_pages_are_named_and_nothing_is_written(tmp_path: Path) -> None:
    path = tmp_path / "p.html"
    odd = Pair(before=flat(1, 1, 1), after=flat(1, 1, 1, 100), caption="view 7")
    empty = Table(title="t", header=["a"], rows=[["b", "c"]])
    chips = Table(title="t", header=["a"], rows=[["b"]], colors=[])
    cases: list[tuple[Any, str]] = [
        ([], "no sections"),
        ([Sliders(title="Pairs", pairs=[])], "'Pairs' has no pictures"),
        ([Sliders(title="s", pairs=[odd])], "'view 7'.*320x180.*100x180"),
        ([Sheet(title="s", pictures=[("a", np.zeros((4, 4), np.float32))])], "float32 cannot be"),
        ([Layers(title="s", views=[LayeredView(layers={}, caption="v")])], "'v' has no layers"),
        ([empty], "row 0 has 2 cells and the header 1"),
        ([chips], "1 rows and 0 colours"),
    ]
    for sections, message in cases:
        with pytest.raises(InputError, match=message):
            picture_page(path, "x", sections)
    with pytest.raises(InputError, match="larger budget"):
        picture_page(path, "x", [Sheet(title="s", pictures=[("a", noisy(0))])],
                     budget_bytes=260_000)  # fmt: skip
    assert not path.exists()


# --- in a real browser ------------------------------------------------------------------------

CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser")
BROWSER_ARGS = (
    "--headless", "--no-sandbox", "--disable-gpu", "--disable-background-networking",
    "--disable-dev-shm-usage", "--window-size=1100,900", "--remote-debugging-port=0",
)  # fmt: skip


class Browser:
    """A page of a headless browser, steered over the DevTools protocol."""

    def __init__(self, folder: Path, url: str) -> None:
        command = [str(CHROMIUM), *BROWSER_ARGS, f"--user-data-dir={folder}", "about:blank"]
        self.process = subprocess.Popen(command, stderr=subprocess.PIPE, text=True)
        assert self.process.stderr is not None
        port = next(m[1] for line in self.process.stderr
                    if (m := re.search(r"ws://127\.0\.0\.1:(\d+)/", line)))  # fmt: skip
        with urllib.request.urlopen(f"http://127.0.0.1:{port}/json", timeout=20) as answer:
            page = next(p for p in json.load(answer) if p["type"] == "page")
        self.socket = connect(page["webSocketDebuggerUrl"], max_size=None)
        self.calls = 0
        self.call("Page.navigate", url=url)
        end = time.monotonic() + 30
        while self.run("document.readyState") != "complete" and time.monotonic() < end:
            time.sleep(0.1)

    def call(self, method: str, **params: Any) -> Any:
        self.calls += 1
        self.socket.send(json.dumps({"id": self.calls, "method": method, "params": params}))
        while True:
            answer = json.loads(self.socket.recv(timeout=60))
            if answer.get("id") == self.calls:
                return answer["result"]

    def run(self, script: str) -> Any:
        answer = self.call("Runtime.evaluate", expression=script, returnByValue=True)
        assert "exceptionDetails" not in answer, answer
        return answer["result"].get("value")

    def press(self, key: str, times: int = 1) -> None:
        for _ in range(times):
            for kind in ("keyDown", "keyUp"):
                self.call("Input.dispatchKeyEvent", type=kind, key=key, code=key,
                          windowsVirtualKeyCode={"ArrowLeft": 37, "ArrowRight": 39,
                                                 "Escape": 27}[key])  # fmt: skip

    def screenshot(self) -> np.ndarray:
        data = base64.b64decode(self.call("Page.captureScreenshot", format="png")["data"])
        return np.asarray(cv2.imdecode(np.frombuffer(data, np.uint8), 1))[..., ::-1]

    def box(self, css: str) -> tuple[int, int, int, int]:
        box = f"document.querySelector({json.dumps(css)}).getBoundingClientRect()"
        r = self.run(f"(r => [r.left, r.top, r.right, r.bottom])({box})")
        return tuple(round(v) for v in r)  # type: ignore[return-value]

    def close(self) -> None:
        self.socket.close()
        self.process.kill()
        self.process.wait()


@pytest.fixture
def browser(tmp_path: Path) -> Iterator[Browser]:
    layers = [
        LayeredView(
            caption=f"view {k}", layers={"RGB": flat(10, 150, 60), "depth": flat(220, 120, 0)}
        )
        for k in range(2)
    ]
    sheet = [(f"picture {k}", flat(40 * k, 90, 90)) for k in range(3)]
    path = tmp_path / "page.html"
    slider_page(
        path, "Registration", [pair(0), pair(1)],
        [Layers(title="Maps", views=layers), Sheet(title="All", pictures=sheet)],
    )  # fmt: skip
    page = Browser(tmp_path / "profile", path.as_uri())
    yield page
    page.close()


def shares(page: Browser) -> tuple[float, float]:
    """Return which shares of the slider's width are red (before) and blue (after)."""
    page.run("document.querySelector('.view.on .pair').scrollIntoView({block: 'end'})")
    left, _, right, bottom = page.box(".view.on .pair")
    row = page.screenshot()[bottom - 12, left:right].astype(int)
    red, blue = row[:, 0] > row[:, 2] + 80, row[:, 2] > row[:, 0] + 80
    return float(red.mean()), float(blue.mean())


@pytest.mark.slow
@pytest.mark.skipif(CHROMIUM is None, reason="chromium is not installed")
def test_in_chromium_the_slider_moves_by_keyboard_and_by_mouse(browser: Browser) -> None:
    red, blue = shares(browser)
    assert red == pytest.approx(0.5, abs=0.02) and blue == pytest.approx(0.5, abs=0.02)
    browser.run("document.querySelector('.pair input').focus()")
    browser.press("ArrowRight", 30)
    red, _ = shares(browser)
    assert red == pytest.approx(0.8, abs=0.02)
    left, top, right, bottom = browser.box(".view.on .pair")
    at = {"x": left + 0.25 * (right - left), "y": (top + bottom) / 2, "button": "left"}
    browser.call("Input.dispatchMouseEvent", type="mousePressed", clickCount=1, **at)
    browser.call("Input.dispatchMouseEvent", type="mouseReleased", clickCount=1, **at)
    red, _ = shares(browser)
    assert red == pytest.approx(0.25, abs=0.03)


@pytest.mark.slow
@pytest.mark.skipif(CHROMIUM is None, reason="chromium is not installed")
def test_in_chromium_views_layers_and_the_lightbox_are_chosen(browser: Browser) -> None:
    assert browser.run("document.querySelectorAll('.views')[0].querySelectorAll('.on').length") == 1
    browser.run("document.querySelector('[aria-label=\"next view\"]').click()")
    name = "document.querySelector('.views .view.on').dataset.name"
    assert browser.run(name) == "view 1"

    def layer() -> str:
        return browser.run("document.querySelectorAll('.views')[1]"
                           ".querySelector('.view.on figure.on').dataset.layer")  # fmt: skip

    assert layer() == "RGB"
    browser.run("[...document.querySelectorAll('.choice button')].find(b => "
                "b.textContent == 'depth').click()")  # fmt: skip
    assert layer() == "depth"
    # The layer stays when the view changes.
    browser.run("document.querySelectorAll('[aria-label=\"next view\"]')[1].click()")
    assert layer() == "depth"

    browser.run("document.querySelector('.sheet button').click()")
    assert browser.run("document.querySelector('dialog').open")
    browser.press("ArrowRight")
    assert browser.run("document.querySelector('dialog span').textContent") == "picture 1"
    browser.press("Escape")
    assert not browser.run("document.querySelector('dialog').open")
