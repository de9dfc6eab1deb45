"""A headless Chromium that looks at the review page and presses its buttons."""

import shutil
import time
from collections.abc import Callable, Generator
from contextlib import contextmanager, suppress
from typing import Any

import numpy as np
import pytest
import viser
from numpy.typing import ArrayLike
from websockets.typing import Subprotocol

from realsim.arrays import Rgb
from realsim.geometry import se3
from realsim.review import ReviewServer
from realsim.review.content.config import SceneConfig
from realsim.store import SessionStore

CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser")
ARGS = [
    "--no-sandbox", "--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader",
    "--ignore-gpu-blocklist", "--disable-background-networking", "--no-first-run",
    "--disable-dev-shm-usage",
]  # fmt: skip
WAIT_S = 240.0
"""How long is waited for a page without a graphics card on a busy machine [s]."""
HARMLESS = ("GPU stall due to ReadPixels", "GL Driver Message")
"""Messages of the software renderer, not of the page."""
needs_chromium = pytest.mark.skipif(CHROMIUM is None, reason="chromium is not installed")
SMALL = SceneConfig(coarse_points=4_000, shown_points=4_000, most_points=20_000)
"""So little that a processor draws it fast enough."""
DRAWN = """async () => { for (let k = 0; k < 3 || __viserMutable.messageQueue.length; k++) {
    __viserMutable.requestRender(); await new Promise(requestAnimationFrame); } }"""
SOCKET = Subprotocol(f"{viser.__name__}-v{viser.__version__}")
"""What the page's websocket speaks."""
CAMERA = {
    "type": "ViewerCameraMessage", "wxyz": [1, 0, 0, 0], "position": [0, 0, 1], "fov": 1.0,
    "near": 0.01, "far": 100.0, "image_height": 480, "image_width": 640, "look_at": [0, 0, 0],
    "up_direction": [0, 1, 0],
}  # fmt: skip
"""What a page says first."""
VISIBLE = "e => e.offsetParent !== null"


class ReviewPage:
    """One reviewer's page."""

    def __init__(self, context: Any, url: str) -> None:
        """Open it."""
        self.context = context
        self.page: Any = context.new_page()
        self.errors: list[str] = []
        """What the browser's console called an error."""
        self.page.on("console", self._heard)
        self.page.on("pageerror", self._failed)
        self.page.goto(url)

    def _heard(self, message: Any) -> None:
        if message.type == "error" and not any(h in message.text for h in HARMLESS):
            self.errors.append(f"{message.text} ({message.location})")

    def _failed(self, error: Any) -> None:
        self.errors.append(str(error))

    # --- looking --------------------------------------------------------------------------------

    def text(self) -> str:
        """Return all text that is shown."""
        return self.page.evaluate("document.body ? document.body.innerText : ''")

    def wait_for(self, *texts: str, seconds: float = WAIT_S) -> str:
        """Wait until all texts are shown; return everything that is."""
        self.wait_until(lambda: all(t in self.text() for t in texts), f"{texts}", seconds)
        return self.text()

    def wait_gone(self, text: str, seconds: float = WAIT_S) -> None:
        """Wait until a text is no longer shown."""
        self.wait_until(lambda: text not in self.text(), f"'{text}' gone", seconds)

    def wait_until(self, holds: Callable[[], bool], what: str, seconds: float = WAIT_S) -> None:
        """Wait until something holds."""
        end = time.monotonic() + seconds
        while time.monotonic() < end:
            if holds():
                return
            self.page.wait_for_timeout(100)
        raise AssertionError(f"{what} was waited for; the page shows:\n{self.text()}")

    def message(self) -> str:
        """Return the line that answers the last thing done."""
        return self.page.evaluate(
            "(document.querySelector('.realsim-message') || {innerText: ''}).innerText"
        )

    def wait_message(self, text: str) -> str:
        """Wait until the answer holds a text."""
        self.wait_until(lambda: text in self.message(), f"the answer '{text}'")
        return self.message()

    def buttons(self) -> list[str]:
        """Return the labels of the buttons that are shown, in the order of the page."""
        return self.page.evaluate(
            f"[...document.querySelectorAll('button')].filter({VISIBLE}).map(b => b.innerText)"
        )

    def screenshot(self, path: Any = None) -> Rgb:
        """Return the page as an image (H, W, 3)."""
        import cv2

        data = self.page.screenshot(path=path, timeout=120_000)
        image = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR)
        assert image is not None
        return np.asarray(image, dtype=np.uint8)[..., ::-1].copy()

    # --- doing ----------------------------------------------------------------------------------

    def press(self, label: str) -> None:
        """Press the button whose label holds this text, as soon as it can be pressed."""
        script = (
            "label => { const b = [...document.querySelectorAll('button')].filter("
            f"{VISIBLE}).find(b => b.innerText.includes(label) && !b.disabled);"
            " if (b) b.click(); return !!b; }"
        )
        self.wait_until(lambda: self.page.evaluate(script, label), f"the button '{label}'")

    def tab(self, name: str) -> None:
        """Turn to a tab of the panel; tabs can be dragged, so it takes a real pointer."""
        find = "[...document.querySelectorAll('[role=tab]')].find(t => t.innerText.trim() === name)"
        box = self.page.evaluate(
            f"name => {{ const r = {find}.getBoundingClientRect();"
            " return [r.x + r.width / 2, r.y + r.height / 2]; }",
            name,
        )
        self.page.mouse.click(*box)
        self.wait_until(
            lambda: self.page.evaluate(f"name => {find}.ariaSelected === 'true'", name),
            f"the tab '{name}'",
        )

    def click_at(self, camera: Any, point: ArrayLike, until: str) -> None:
        """Click with the mouse where a point (3,) of the scene is drawn [m], until a text is shown.

        Args:
            camera: the browser's, as the server knows it.
            point: in world.
            until: what the click brings about; the scene may be drawn late.
        """
        T = se3.from_rt(se3.from_quaternion_wxyz(camera.wxyz), camera.position)
        x, y, z = se3.transform(se3.invert(T), np.reshape(point, (1, 3)))[0]
        size = self.page.viewport_size
        f = 0.5 * size["height"] / np.tan(0.5 * camera.fov)
        at = size["width"] / 2 + f * x / z, size["height"] / 2 + f * y / z
        for _ in range(10):
            self.page.mouse.move(at[0] + 3, at[1])
            self.page.mouse.move(*at)
            self.wait_drawn()
            self.page.mouse.click(*at, delay=50)
            with suppress(AssertionError):
                self.wait_for(until, seconds=WAIT_S / 10)
                return
        self.wait_for(until)

    def wait_drawn(self) -> None:
        """Wait until what has come from the server is drawn."""
        self.page.evaluate(DRAWN)

    def key(self, key: str) -> None:
        """Press a key, no text being written."""
        self.page.evaluate("document.activeElement && document.activeElement.blur()")
        self.page.keyboard.press(key)

    def write(self, label: str, text: str) -> None:
        """Write into the field of this label."""
        self._field(
            label,
            "const set = Object.getOwnPropertyDescriptor(Object.getPrototypeOf(e), 'value').set;"
            " set.call(e, value); e.dispatchEvent(new Event('input', {bubbles: true}));",
            text,
        )

    def value(self, label: str) -> str:
        """Return what stands in the field of this label."""
        return self._field(label, "return e.value;")

    def kept(self) -> list[str]:
        """Return what the browser keeps for this page from one visit to the next."""
        return self.page.evaluate("Object.values(localStorage)")

    def tick(self, label: str) -> None:
        """Click the box of this label."""
        self._field(label, "e.click();")

    def unfold(self, label: str) -> None:
        """Open or close the folder of this label."""
        self.page.evaluate(
            "label => [...document.querySelectorAll('div')].filter(d => d.children.length < 2"
            " && d.innerText === label).at(-1).click()",
            label,
        )

    def choose(self, label: str, option: str) -> None:
        """Choose from the list of this label."""
        for _ in range(4):  # a list that opens while its field is scrolled out of sight is hidden
            self._field(label, "e.focus(); e.click();")
            for _ in range(50):
                if self._option(option):
                    return
                self.page.wait_for_timeout(100)
        raise AssertionError(f"no choice '{option}' of '{label}'; the page shows:\n{self.text()}")

    def _field(self, label: str, script: str, value: str = "") -> Any:
        """Run a script on the field e beside a label; viser ties only some of them to it."""
        return self.page.evaluate(
            "([label, value]) => { let e = [...document.querySelectorAll('label')]"
            ".find(l => l.textContent === label); while (!e.querySelector('input, textarea'))"
            f" e = e.parentElement; e = e.querySelector('input, textarea');"
            f" e.scrollIntoView({{block: 'center'}}); {script} }}",
            [label, value],
        )

    def _option(self, option: str) -> bool:
        return self.page.evaluate(
            "text => { const o = [...document.querySelectorAll('[role=option]')]"
            f".filter({VISIBLE}).find(o => o.innerText.trim() === text);"
            " if (o) o.click(); return !!o; }",
            option,
        )

    def reload(self) -> None:
        """Load the page anew."""
        self.page.reload()


class ReviewBrowser:
    """A browser in which pages are opened; each in a context of its own, as two people's are."""

    def __init__(self, browser: Any) -> None:
        """Take a browser."""
        self.browser = browser

    @contextmanager
    def page(self, url: str, *, width: int = 1000, height: int = 640) -> Generator[ReviewPage]:
        """Open a page for as long as the block lasts; at its end no error may have been heard."""
        # Half the pixels a side: a processor draws them all.
        size = {"width": width, "height": height}
        context = self.browser.new_context(viewport=size, device_scale_factor=0.5)
        opened = ReviewPage(context, url)
        try:
            yield opened
            assert opened.errors == []
        finally:
            context.close()


@contextmanager
def serving(store: SessionStore | list[SessionStore], **options: Any) -> Generator[ReviewServer]:
    """Serve a session's review, small and on a free port, for as long as the block lasts."""
    server = ReviewServer(store, port=0, config=SMALL, **options)
    server.start()
    try:
        yield server
    finally:
        server.stop()


@contextmanager
def review_browser() -> Generator[ReviewBrowser]:
    """Start Chromium for as long as the block lasts."""
    from playwright.sync_api import sync_playwright

    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=CHROMIUM, args=ARGS, headless=True)
        try:
            yield ReviewBrowser(browser)
        finally:
            browser.close()
