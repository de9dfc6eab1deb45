"""The static page: one file, opened from the disk without a network, in a real browser."""

import json
import re
import time
from collections.abc import Iterator
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from realsim.review import journal
from realsim.review.content.config import SceneConfig
from realsim.review.content.content import SceneContent
from realsim.review.static.page_nodes import LABEL_EDGES, drawn_grasps, label_class
from realsim.review.static.static_page import PageWords, StaticSummary, write_static
from realsim.store import save_grasps, save_scene
from refusals import refused
from registered_sessions import registered_by_hand, table_session, true_poses
from review_browser import CHROMIUM, WAIT_S, review_browser
from reviewed_boxes import grasp_set

NASTY = "</script><script>document.title='taken'</script> & \"quoted\" <img src=http://e.example/x>"
MADE = datetime(2026, 1, 2, 3, 4, tzinfo=UTC)


@pytest.fixture(scope="module")
def content(tmp_path_factory: pytest.TempPathFactory) -> SceneContent:
    store = table_session(tmp_path_factory.mktemp("static") / "session", views=4)
    save_scene(store, registered_by_hand(store).scene)
    save_grasps(store, grasp_set(true_poses()[0].obj_id, 0, 30))
    return SceneContent.load(store, SceneConfig(voxel_m=0.004))


@pytest.fixture(scope="module")
def state(content: SceneContent) -> journal.ReviewState:
    first, second = content.scene.objects
    one = journal.new_entry("reject", first, "Ada <b>L</b>", comment=NASTY)
    other = journal.new_entry("comment", second, "Grace", comment="seen from one side only")
    return journal.replay([one, other])


@pytest.fixture(scope="module")
def written(
    content: SceneContent, state: journal.ReviewState, tmp_path_factory: pytest.TempPathFactory
) -> StaticSummary:
    path = tmp_path_factory.mktemp("page") / "scene.html"
    words = PageWords(caption=f"Figure 1. {NASTY}", licence="CC BY 4.0", made=MADE)
    return write_static(content, state, path, title=f"Scene {NASTY}", words=words)


# --- the file -----------------------------------------------------------------------------------


def test_the_summary_is_what_is_on_disk(written: StaticSummary, content: SceneContent) -> None:
    assert written.path.stat().st_size == written.size_bytes < 3e6
    assert written.points == written.points_in_all == len(content.cloud) > 0
    assert (written.cameras, written.cameras_in_all) == (4, 4)
    assert (written.grasps, written.grasps_in_all) == (30, 30)


def test_the_file_names_no_path_of_the_machine_and_loads_nothing(
    written: StaticSummary, content: SceneContent
) -> None:
    page = written.path.read_text()
    assert str(content.store.folder) not in page and str(written.path.parent) not in page
    outside = page[: page.index("srcdoc=")] + page[page.index("</iframe>") :]
    # What people wrote names an address, but as text.
    assert not re.search(r"<[^>]*\s(src|href)\s*=\s*[\"']?(https?:)?//", outside)
    assert "default-src &#x27;none&#x27;" in outside


def test_what_people_wrote_is_text(written: StaticSummary) -> None:
    page = written.path.read_text()
    assert "<script>document" not in page and "<img src=http" not in page
    assert "Ada &lt;b&gt;L&lt;/b&gt;" in page
    data = json.loads(re.search(r'id="data">(.*?)</script>', page, re.S).group(1))  # pyright: ignore[reportOptionalMemberAccess]
    assert [o["instance"] for o in data["objects"]] == [0, 1]


def test_texts_of_people_stay_on_their_line(content: SceneContent, tmp_path: Path) -> None:
    first = content.scene.objects[0]
    line = journal.new_entry("reject", first, "eve\nbob", comment="no\r\nbob, 2026: accepted")
    made = write_static(content, journal.replay([line]), tmp_path / "scene.html", title="Scene")
    page = made.path.read_text()
    assert "no bob, 2026: accepted" in page and "reviewed by eve bob" in page
    assert "<p>rejected by eve bob, " in page


def test_a_swap_to_a_missing_model_is_refused_with_the_file(
    content: SceneContent, tmp_path: Path
) -> None:
    first = content.scene.objects[0]
    line = journal.new_entry("swap", first, "ada", pose=first.T_world_obj, obj_id=99)
    why, state = r"instance 0 .* object 99, .*obj_000099\.ply", journal.replay([line])
    refused(why, write_static, content, state, tmp_path / "scene.html", title="Scene")
    assert list(tmp_path.iterdir()) == []


def test_the_verdicts_are_the_reviewers(written: StaticSummary) -> None:
    page = written.path.read_text()
    assert "2 objects: 1 rejected, 1 doubtful" in page
    assert page.index('data-instance="0"') < page.index('data-instance="1"'), "worst first"
    assert "2026-01-02 03:04 UTC" in page and "Data: CC BY 4.0" in page


def test_a_page_that_is_too_large_is_drawn_with_less(
    content: SceneContent, state: journal.ReviewState, tmp_path: Path, written: StaticSummary
) -> None:
    steps: list[tuple[int, int]] = []
    most = written.size_bytes - 20_000
    small = write_static(
        content, state, tmp_path / "s.html", title="small", most_bytes=most,
        progress=lambda done, of: steps.append((done, of)),
    )  # fmt: skip
    assert small.size_bytes <= most and small.points <= written.points
    assert small.texels < written.texels
    assert steps[-1][0] == steps[-1][1] and [d for d, _ in steps] == sorted(d for d, _ in steps)
    few = write_static(content, state, tmp_path / "f.html", title="few", most_points=500)
    assert few.points == 500


def test_what_cannot_be_written_is_refused_and_nothing_is_left(
    content: SceneContent, state: journal.ReviewState, tmp_path: Path
) -> None:
    given: list[tuple[str, str, dict[str, Any]]] = [
        ("a", "title", {"title": "  "}), ("no/a", "folder", {"title": "a"}),
        ("a", "positive", {"title": "a", "most_points": 0}),
        ("a", "smaller", {"title": "a", "most_bytes": 1e5}),
    ]  # fmt: skip
    for name, words, how in given:
        refused(words, write_static, content, state, tmp_path / name, **how)
    assert list(tmp_path.iterdir()) == []


def test_every_grasp_has_the_class_of_its_label() -> None:
    scores = np.array([np.nan, 0.0, 0.24, 0.25, 0.5, 0.74, 0.75, 1.0])
    assert label_class(scores).tolist() == [-1, 0, 0, 1, 2, 2, 3, 3]
    assert len(LABEL_EDGES) == 4


def test_the_drawn_grasps_keep_good_and_bad_in_proportion() -> None:
    grasps = grasp_set(1, 0, 30)
    assert drawn_grasps(grasps, 30).tolist() == list(range(30))
    rows = drawn_grasps(grasps, 10)
    assert len(rows) == len(set(rows.tolist())) == 10
    assert np.nanmedian(grasps.scores[rows]) == pytest.approx(0.5, abs=0.1)


# --- in a browser -------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def page(
    content: SceneContent, state: journal.ReviewState, tmp_path_factory: pytest.TempPathFactory
) -> Iterator[Any]:
    """A small scene in a small window: nothing here has a graphics card."""
    if CHROMIUM is None:
        pytest.skip("no chromium on this machine")
    path = tmp_path_factory.mktemp("browser") / "scene.html"
    write_static(content, state, path, title=f"Scene {NASTY}", most_points=2000)
    with review_browser() as browser:
        context = browser.browser.new_context(
            viewport={"width": 820, "height": 300}, offline=True, device_scale_factor=0.5
        )
        opened = context.new_page()
        opened.said, opened.asked = [], []
        opened.on("console", lambda m: opened.said.append((m.type, m.text)))
        opened.on("pageerror", lambda e: opened.said.append(("error", str(e))))
        opened.on("request", lambda r: opened.asked.append(r.url))
        opened.goto(f"file://{path}")
        opened.wait_for_function("document.body.dataset.ready === 'yes'", timeout=WAIT_S * 1e3)
        yield opened


def inside(page: Any, script: str) -> Any:
    """Return what a script says in the viewer's frame."""
    return page.frames[1].evaluate(script)


def becomes(page: Any, name: str, drawn: bool) -> bool:
    """Return whether a node is drawn, or not, before long: messages wait for a frame."""
    end = time.monotonic() + WAIT_S
    while time.monotonic() < end:
        inside(page, "__viserMutable.requestRender()")
        waiting = inside(page, "__viserMutable.messageQueue.length")
        state = inside(page, f"__viserSceneTree.getState()['{name}'].effectiveVisibility")
        if waiting == 0 and state is drawn:
            return True
        page.wait_for_timeout(50)
    return False


@pytest.mark.slow
def test_the_page_asks_nobody_and_complains_of_nothing(page: Any) -> None:
    assert [u for u in page.asked if not u.startswith(("data:", "blob:", "about:"))] == [page.url]
    assert page.url.startswith("file:///")
    assert [text for kind, text in page.said if kind == "error"] == []
    assert page.title().startswith("Scene </script>"), "the title is text, no script has run"


PIXELS = """async () => {
  const { canvas, requestRender } = __viserMutable;
  requestRender();
  const small = document.createElement("canvas");
  small.width = 96; small.height = 64;
  const flat = small.getContext("2d");
  // The picture can be read in the frame that drew it only.
  for (let k = 0; k < 3; k++) await new Promise((go) => requestAnimationFrame(go));
  flat.drawImage(canvas, 0, 0, 96, 64);
  return Array.from(flat.getImageData(0, 0, 96, 64).data);
}"""


@pytest.mark.slow
def test_the_scene_is_drawn(page: Any) -> None:
    end = time.monotonic() + WAIT_S
    share, kinds = 0.0, 0
    while time.monotonic() < end and not (share > 0.2 and kinds > 5):
        rgba = np.array(inside(page, PIXELS)).reshape(-1, 4)
        drawn = (rgba[:, 3] > 0) & np.any(rgba[:, :3] < 225, axis=-1)
        share, kinds = float(drawn.mean()), len(np.unique(rgba[drawn, :3] // 32, axis=0))
    assert share > 0.2, "the table and the objects fill a part of the window"
    assert kinds > 5, "more than one plain colour"


@pytest.mark.slow
def test_a_click_in_the_list_chooses_an_object(page: Any) -> None:
    items = page.locator(".object")
    assert items.count() == 2 and "rejected" in items.nth(0).inner_text()
    assert becomes(page, "/boxes/0", False)
    page.evaluate("document.querySelector('[data-instance=\"0\"] button').click()")
    assert "Ada <b>L</b>" in items.nth(0).inner_text()
    assert NASTY in items.nth(0).inner_text()
    assert becomes(page, "/boxes/0", True) and becomes(page, "/boxes/1", False)
    assert becomes(page, "/grasps/0/3", True)
    page.evaluate("document.querySelector('[data-instance=\"1\"] button').click()")
    assert becomes(page, "/boxes/1", True) and becomes(page, "/boxes/0", False)
    assert becomes(page, "/grasps/0/3", False), "grasps of the chosen object only"
    page.evaluate("document.querySelector('[data-instance=\"1\"] button').click()")
    assert becomes(page, "/boxes/1", False) and becomes(page, "/grasps/0/3", True)


@pytest.mark.slow
def test_the_switches_show_and_hide(page: Any) -> None:
    nodes = {"cloud": "/cloud", "objects": "/objects/1", "table": "/table", "cameras": "/cameras/2"}
    for what, node in nodes.items():
        page.evaluate(f"document.querySelector('[data-show={what}]').click()")
        assert becomes(page, node, False), what
        page.evaluate(f"document.querySelector('[data-show={what}]').click()")


@pytest.mark.slow
def test_the_slider_leaves_out_worse_grasps(page: Any) -> None:
    def put(value: int) -> None:
        page.evaluate("v => { const s = document.getElementById('least'); s.value = v;"
                      "s.dispatchEvent(new Event('input')); }", value)  # fmt: skip

    assert becomes(page, "/grasps/0/-1", True) and becomes(page, "/grasps/0/0", True)
    put(2)
    assert becomes(page, "/grasps/0/1", False) and becomes(page, "/grasps/0/2", True)
    put(3)
    assert becomes(page, "/grasps/0/2", False) and becomes(page, "/grasps/0/3", True)
    assert "0.75" in page.inner_text("#least-word")


@pytest.mark.slow
def test_a_photograph_brings_one_to_its_camera(page: Any, content: SceneContent) -> None:
    page.evaluate("document.querySelector('[data-view=\"2\"]').click()")
    where = (
        "() => { const m = __viserMutable, p = m.camera.position.clone();"
        "m.cameraControl.getPosition(p); return [p.x, p.y, p.z]; }"
    )
    asked = pytest.approx(float(np.linalg.norm(content.pose_of(2)[:3, 3])), abs=2e-3)
    end = time.monotonic() + WAIT_S
    while (now := np.linalg.norm(inside(page, where))) != asked and time.monotonic() < end:
        inside(page, "__viserMutable.requestRender()")
        page.wait_for_timeout(100)
    assert now == asked


@pytest.mark.slow
def test_a_click_in_the_scene_chooses_an_object(page: Any) -> None:
    # As the viewer reports a click on a node.
    inside(page, "__viserMutable.sendMessage({type:'SceneNodeClickMessage', name:'/objects/1'})")
    assert page.locator(".object.chosen").get_attribute("data-instance") == "1"
    bindings = inside(page, "__viserSceneTree.getState()['/objects/1'].clickBindings")
    assert bindings == [{"button": "left", "modifier": None}]
