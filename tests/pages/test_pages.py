"""Pages: whole in one file, escaped, within the budget, usable by keyboard in a real browser."""

import base64
import io
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from PIL import Image as PillowImage

from page_tags import Tags
from realsim.pages import Cell, Page, View, plots, spread
from refusals import refused
from review_browser import needs_chromium, review_browser


def flat(r: int, g: int, b: int, width: int = 320, height: int = 180) -> np.ndarray:
    return np.full((height, width, 3), (r, g, b), np.uint8)


def noisy(seed: int, width: int = 640) -> np.ndarray:
    rough = np.random.default_rng(seed).integers(0, 256, (90, width // 4, 3)).astype(np.uint8)
    return np.asarray(cv2.resize(rough, (width, 360), interpolation=cv2.INTER_CUBIC))


def everything() -> Page:
    """A page with every part that there is."""
    page = Page(title="A & B", about="<b>two</b> views", hidden={"/data/s": "SESSION"})
    page.verdict("good", "Accepted.", "Use it.", [[Cell("warn", kind="warn"), "but <look>"]])
    page.cards([("0.2 mm", "1 sigma")])
    page.lead(flat(7, 7, 7), "first of all", [("3 of 4", "objects")])
    page.section("Folded", "Inside.", key="folded", folded="2 of 3")
    page.section("Objects", "Worst first.", key="objects")
    page.heading("Part")
    page.text("in /data/s and /home/me/secret/file.txt", "note")
    cells = [Cell("<mug>", hover='a "cup"', note="1", href="objects"), 0.4]
    page.table(["object", "error [mm]"], [cells, ["bowl", 1.2]], colors=[(1, 2, 3), (4, 5, 6)])
    page.table(["x"], [["y"]], folded="More")
    page.code("T = [1, 0]")
    page.picture(flat(9, 9, 9, 1920, 1080), "large")
    page.picture(flat(9, 9, 9, 1920, 1080), "large, again")
    figure, ax = plots.axes()
    ax.plot([0, 1], [0, 1])
    page.plots([(plots.png(figure), "a line")])
    page.videos([("v.mp4#t=0,1", flat(1, 1, 1))])
    page.section("Sliders")
    pair = {"CAD start": flat(200, 30, 30), "registered": flat(30, 30, 200)}
    page.sliders([View(f"view {k}", pair) for k in range(2)])
    page.section("Layers")
    page.layers([View("view 0", {"RGB": flat(1, 2, 3), "depth": flat(9, 9, 9)[..., 0]})])
    page.section("Sheet")
    page.sheet([View(f"picture {k}", {"": flat(40 * k, 90, 90)}) for k in range(3)])
    page.document = {"figure": "</script>"}
    return page


def test_a_page_is_whole_escaped_and_asks_for_nothing() -> None:
    page = everything()
    text = page.encode().decode()
    assert page.encode().decode() == text == everything().encode().decode()
    assert "http" not in text and "/data" not in text and "/home" not in text
    assert "in SESSION and file.txt" in text and '<link rel="icon" href="data:,">' in text
    for told in ("A &amp; B", "&lt;b&gt;two", "&lt;look&gt;", "&lt;mug&gt;", "rgb(1,2,3)",
                 ">1.2<", "a &#34;cup&#34;", '{"figure": "\\u003c/script>"}'):  # fmt: skip
        assert told in text, told
    sources = [a["src"] for tag, a in Tags(text).seen if tag == "img" and "src" in a]
    # The large picture stands there once; the dialog's picture has no source of its own.
    assert len(sources) == 1 + 1 + 1 + 4 + 2 + 3
    shown = [_picture(s) for s in sources]
    assert shown[1].shape == (720, 1280, 3)
    np.testing.assert_allclose(shown[3], flat(200, 30, 30), atol=4)
    np.testing.assert_allclose(shown[4], flat(30, 30, 200), atol=4)
    assert page.shown == {"Sliders": (2, 2), "Layers": (1, 1), "Sheet": (3, 3)}


def _picture(src: str | None) -> np.ndarray:
    assert src is not None and src.startswith("data:image/")
    data = base64.b64decode(src.partition(",")[2])
    return np.asarray(PillowImage.open(io.BytesIO(data)).convert("RGB"))


def test_nothing_on_a_page_is_markup() -> None:
    hostile = '<script>alert("1")</script>'
    page = Page(title=hostile, about=hostile)
    page.verdict("bad", hostile, hostile, [[hostile]])
    page.section(hostile, hostile, key=hostile)
    page.heading(hostile)
    cell = Cell(hostile, kind="bad", hover=hostile, note=hostile)
    page.table([hostile], [[cell]], folded=hostile)
    page.picture(b"\x89PNG", hostile)
    page.sliders([View(hostile, {hostile: flat(1, 1, 1), "b": flat(1, 1, 1)})])
    text = page.encode().decode()
    assert text.count("<script") == 1 and text.count("alert") == text.count("&lt;script&gt;alert")


@pytest.mark.parametrize(
    "text", ["1.2 mm / 0.3 deg", "0.0013 1/m", "RGB/depth", "and/or", "reports/report.html"]
)
def test_words_with_slashes_are_no_paths(text: str) -> None:
    assert Page().plain(text) == text


@pytest.mark.parametrize("budget", [1_000_000, 2_000_000])
def test_the_budget_is_kept_and_the_page_says_what_is_left_out(budget: int) -> None:
    made: list[int] = []

    def picture(k: int) -> np.ndarray:
        made.append(k)
        return noisy(k)

    page = Page(title="much")
    page.section("Pairs")
    page.sliders([View(f"pair {k}", {"a": noisy(k), "b": noisy(k + 1)}) for k in range(3)])
    page.section("Views")
    page.sheet([View(f"view {k}", {"": lambda k=k: picture(k)}) for k in range(64)])
    data = page.encode(budget)
    assert len(data) <= budget
    shown, total = page.shown["Views"]
    assert total == 64 and 0 < shown < 64
    assert f"{shown} of 64 pictures are shown." in data.decode()
    assert len(made) <= shown + 5  # views that are not shown are not made
    captions = [int(c) for c in re.findall(r'aria-label="view (\d+), open', data.decode())]
    assert captions == sorted(captions) and len(captions) == shown
    if shown > 2:
        assert np.diff([*captions, 64]).max() <= 2 * 64 / shown + 1


@pytest.mark.parametrize("total", [1, 2, 7, 64, 100])
def test_a_first_part_of_the_spread_covers_the_range(total: int) -> None:
    order = list(spread(total))
    assert sorted(order) == list(range(total))
    for n in range(1, total + 1):
        assert np.diff([*sorted(order[:n]), total]).max() <= 4 * total / n + 1


@pytest.mark.parametrize(
    ("part", "content", "message"),
    [
        ("sliders", [], "'Pairs' has no pictures"),
        ("sliders", [View("view 7", {"a": flat(1, 1, 1), "b": flat(1, 1, 1, 100)})],
         "'view 7'.*320x180.*100x180"),
        ("sheet", [View("a", {"": np.zeros((4, 4), np.float32)})], "float32 cannot be"),
        ("layers", [View("v", {})], "'v' has no layers"),
        ("sheet", [View("a", {"": noisy(0)})], "larger budget"),
    ],
)  # fmt: skip
def test_pictures_that_cannot_be_shown_are_named(part: str, content: Any, message: str) -> None:
    page = Page(title="x")
    page.section("Pairs")
    getattr(page, part)(content)
    refused(message, page.encode, 260_000)


def test_tables_that_do_not_fit_are_named() -> None:
    refused("row 0 has 2 cells and the header 1", Page().table, ["a"], [["b", "c"]])
    refused("1 rows and 0 colours", Page().table, ["a"], [["b"]], colors=[])


# --- in a real browser ------------------------------------------------------------------------


@pytest.fixture
def browser(tmp_path: Path) -> Iterator[Any]:
    (tmp_path / "page.html").write_bytes(everything().encode())
    with review_browser() as opened:
        page = opened.browser.new_page(viewport={"width": 1100, "height": 900})
        page.goto((tmp_path / "page.html").as_uri())
        yield page


def red_share(page: Any) -> float:
    """Return which share of the slider's width is red: the picture before."""
    data = page.locator(".view.on .pair").screenshot()
    row = np.asarray(PillowImage.open(io.BytesIO(data)).convert("RGB"))[-12].astype(int)
    return float((row[:, 0] > row[:, 2] + 80).mean())


@pytest.mark.slow
@needs_chromium
def test_in_chromium_sliders_views_layers_and_the_lightbox_work(browser: Any) -> None:
    assert red_share(browser) == pytest.approx(0.5, abs=0.02)
    browser.locator(".view.on .pair input").focus()
    for _ in range(30):
        browser.keyboard.press("ArrowRight")
    assert red_share(browser) == pytest.approx(0.8, abs=0.02)
    box = browser.locator(".view.on .pair").bounding_box()
    browser.mouse.click(box["x"] + 0.25 * box["width"], box["y"] + box["height"] / 2)
    assert red_share(browser) == pytest.approx(0.25, abs=0.03)

    browser.locator('[aria-label="next view"]').first.click()
    assert browser.locator(".views .view.on").first.get_attribute("data-name") == "view 1"
    assert browser.locator(".layers figure.on").get_attribute("data-layer") == "RGB"
    browser.get_by_role("button", name="depth").click()
    assert browser.locator(".layers figure.on").get_attribute("data-layer") == "depth"

    browser.locator(".sheet button").first.click()
    assert browser.locator("dialog").is_visible()
    browser.keyboard.press("ArrowRight")
    assert browser.locator("dialog span").text_content() == "picture 1"
    browser.keyboard.press("Escape")
    assert not browser.locator("dialog").is_visible()
    assert not browser.locator("details:not(.stage)").get_attribute("open")
    browser.emulate_media(media="print")
    browser.evaluate("dispatchEvent(new Event('beforeprint'))")
    assert browser.locator(".views .view").last.is_visible()
    assert browser.locator("details:not(.stage)").get_attribute("open") is not None
