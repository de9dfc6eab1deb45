"""The review page in a real browser: judge, correct, undo, reload, two reviewers, photographs."""

import shutil
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from realsim.geometry import se3
from realsim.records import SupportPlane
from realsim.review import ReviewServer
from realsim.review.drawing.grasp_drawing import FINGER_M
from realsim.review.journal import Entry
from realsim.review.static.static_page import write_static
from realsim.store import SessionStore, load_scene, save_scene
from review_browser import (
    CHROMIUM,
    ReviewBrowser,
    ReviewPage,
    needs_chromium,
    review_browser,
    serving,
)
from reviewed_boxes import boxes_session

TABLE_RGB, BOX_RGB = (100, 100, 100), (210, 210, 210)
"""Colours of the photographs, with noise of 10."""
pytestmark = [needs_chromium, pytest.mark.slow]


@pytest.fixture(scope="module")
def browser() -> Iterator[ReviewBrowser]:
    with review_browser() as opened:
        yield opened


@pytest.fixture
def server(tmp_path: Path) -> Iterator[ReviewServer]:
    """Return a server of a session that nobody has judged, for a reviewer without a name."""
    with serving(boxes_session(tmp_path / "boxes")) as review:
        yield review


def lines(server: ReviewServer) -> list[Entry]:
    return list(server.sessions[0].standing.state.entries)


def loaded(page: ReviewPage) -> str:
    """Wait until a scene is open and an object selected, sign; return the text of the page."""
    text = page.wait_for("objects judged", "computed:")
    page.write("Your name", "ada")
    page.wait_until(lambda: "ada" in page.kept(), "the browser to keep it")
    return text


def rows(page: ReviewPage) -> list[str]:
    """Return the labels of the list."""
    return [b for b in page.buttons() if "tall" in b or "flat" in b]


def share_of(image: Any, rgb: tuple[int, int, int]) -> float:
    """Return the share of pixels of about this colour."""
    return float(np.mean(np.abs(image.astype(int) - np.array(rgb)).max(-1) < 30))


def test_the_list_is_as_high_as_its_rows_and_at_most_half_of_the_window(
    browser: ReviewBrowser, tmp_path: Path
) -> None:
    stores = [boxes_session(tmp_path / f"boxes{k}") for k in range(3)]
    with serving(stores) as many, browser.page(many.url, width=1500, height=950) as page:
        loaded(page)
        row = "[...document.querySelectorAll('button')].find(b => b.innerText.includes('flat'))"
        height = f"{row}.closest('.mantine-Paper-root').offsetHeight"
        page.wait_until(lambda: page.page.evaluate(height) == 475, "half of the window")


def test_a_scene_of_any_up_is_framed_at_once_and_a_link_shows_the_same(
    browser: ReviewBrowser, server: ReviewServer, tmp_path: Path
) -> None:
    shutil.copytree(server.sessions[0].store.folder, tmp_path / "tilted")
    store = SessionStore.open(tmp_path / "tilted")
    turned = se3.from_rt(se3.exp_so3(np.array([2.2, 0.4, 0.0])), np.array([0.5, 0.0, 0.0]))
    save_scene(store, replace(load_scene(store), plane=SupportPlane(T_world_table=turned)))
    with serving(store) as tilted:
        with browser.page(tilted.url, width=1280, height=800) as page:
            page.wait_for("objects judged", "computed:")
            page.wait_until(lambda: _scene_share(page) > 0.02, "the scene in the middle")
            assert page.page.title() == "flat \u00b7 tilted \u00b7 realsim review"
            panels = page.page.evaluate(PANELS)
            assert len(panels) == 2 and 1 - sum(panels) / (1280 * 800) >= 0.75
            page.press("0 tall")
            page.wait_until(lambda: "object=tall" in page.page.url, "the address")
            page.tab("Views")
            link = page.page.url
        with browser.page(link, width=1280, height=800) as page:
            page.wait_for("\u25b6 0 tall", "Leave this view out")
            page.wait_until(lambda: "tab=Views" in page.page.url, "the tab")


PANELS = """[...document.querySelectorAll('[data-dock-window], .mantine-Paper-root')]
    .map(e => e.getBoundingClientRect()).filter(r => r.width > 150 && r.height > 250)
    .map(r => r.width * r.height)"""
"""Areas of the panels that float over the scene [px^2]."""


def _scene_share(page: ReviewPage) -> float:
    """Return how much of the window's middle shows the measured table and boxes."""
    image = page.screenshot()[100:300, 150:450]
    return share_of(image, TABLE_RGB) + share_of(image, BOX_RGB)


def test_the_worst_object_stands_first_and_is_judged(
    browser: ReviewBrowser, server: ReviewServer
) -> None:
    with browser.page(server.url) as page:
        page.wait_for("objects judged", "computed:")
        page.press("Accept")
        page.wait_message("fill in your name")
        text = loaded(page)
        assert [r.splitlines() for r in rows(page)] == [
            ["\u25b6 3 flat", "computed: doubtful \u00b7 fits 71 %"],
            ["0 tall", "computed: accepted \u00b7 fits 98 %"],
        ]
        assert "0 of 2 objects judged" in text and "computed: doubtful" in text
        assert "seen by one view" in text
        page.write("Comment", "it <b>floats</b>")
        page.press("Reject")
        page.wait_for("1 of 2 objects judged", "rejected by ada", "it <b>floats</b>")
        assert page.message() == "Recorded: flat rejected, signed ada."
        page.press("Undo: ada rejected")
        page.wait_for("0 of 2 objects judged", "nobody has judged it yet")
        page.key("y")
        page.wait_for("1 of 2 objects judged", "accepted by ada")
        page.key("n")
        page.wait_for("instance 0, object 1")
        page.key("x")
        page.wait_for("2 of 2 objects judged")
        # Judged bad, it is the worst now.
        page.wait_until(
            lambda: rows(page)[0].startswith("\u25b6 0 tall\n\u2717 rejected"), "another order"
        )
        page.reload()
        page.wait_for("2 of 2 objects judged")
        page.wait_until(lambda: page.value("Your name") == "ada", "the name")
    assert [(e.action, e.instance) for e in lines(server)] == [
        ("reject", 3), ("undo", 3), ("accept", 3), ("reject", 0),
    ]  # fmt: skip
    assert lines(server)[0].comment == "it <b>floats</b>"
    assert {e.reviewer for e in lines(server)} == {"ada"}


def test_keys_move_a_copy_and_saving_writes_one_line(
    browser: ReviewBrowser, server: ReviewServer
) -> None:
    before = server.sessions[0].registered.object(3)
    with browser.page(server.url) as page:
        loaded(page)
        page.tab("Correct")
        for key in ("l", "l", "i", "u", "Shift+U"):
            page.key(key)
        page.wait_for("turned 5.0 deg", "Nothing is written yet")
        assert lines(server) == []
        page.tab("Object")
        page.press("Accept")
        page.wait_message("save the pose or put it back first")
        page.key("b")
        page.tab("Correct")
        page.wait_for("stands as it is in the journal")
        page.press("Save the pose")
        page.wait_message("nothing was moved")
        for _ in range(3):
            page.key("l")
        page.wait_for("moved 15.0 mm, turned 0.0 deg")
        page.press("Save the pose")
        page.wait_message("moved 15.0 mm")
        page.wait_for("stands as it is in the journal")
        page.tab("Object")
        page.wait_for("moved by ada (steps)", "computed: unchecked")
        page.tab("Correct")
        page.press("Snap by ICP")
        page.wait_until(lambda: "agrees" in page.message(), "the snap")
        page.press("Save the pose")
        page.wait_message("Recorded")
        page.wait_until(lambda: len(lines(server)) == 2, "the second line")
    line, back = lines(server)
    assert (line.action, line.instance, line.how) == ("move", 3, "steps")
    assert line.pose is not None and back.pose is not None
    assert back.how == "icp" and back.checks["agree"] > 0.9
    assert np.linalg.norm(back.pose[:3, 3] - before.T_world_obj[:3, 3]) < 0.002
    step = line.pose[:3, 3] - before.T_world_obj[:3, 3]
    np.testing.assert_allclose(step, [0.015, 0, 0], atol=1e-9)


def in_photograph(page: ReviewPage, kind: str, what: str = "innerText") -> Any:
    """Return what an element of the photographs says; None where there is none."""
    return page.page.evaluate(f"(document.querySelector('.rs-photograph {kind}') || {{}}).{what}")


REACHED = """[...document.querySelectorAll('.rs-bar button, .rs-panes, .rs-legend i')].every(e => {
    const r = e.getBoundingClientRect();
    return e.contains(document.elementFromPoint(r.x + r.width / 2, r.y + r.height / 2)); })"""
"""Whether nothing stands before the photograph, its buttons and its legend."""


def test_the_photographs_open_at_the_worst_view_and_follow_the_object(
    browser: ReviewBrowser, server: ReviewServer
) -> None:
    with browser.page(server.url, width=1280, height=800) as page:
        page.page.keyboard.press("g")  # before anything stands
        page.wait_for("flat \u00b7 view", "against the pose")
        page.wait_until(lambda: share_of(page.screenshot(), BOX_RGB) > 0.003, "the photograph")
        zoom = float(in_photograph(page, ".rs-zoom").split()[0])
        assert zoom > 1  # the object fills a third of a photograph of 160 pixels
        page.page.mouse.move(640, 300)
        page.page.mouse.wheel(0, -400)
        page.wait_until(
            lambda: float(in_photograph(page, ".rs-zoom").split()[0]) > 2 * zoom, "a closer look"
        )
        page.key("4")
        page.wait_until(
            lambda: in_photograph(page, ".rs-pane", "dataset?.layer") == "depth", "the depth"
        )
        assert "in front of it" in page.text() and page.page.evaluate(REACHED)
        page.page.set_viewport_size({"width": 390, "height": 844})  # a phone
        page.wait_until(lambda: page.page.evaluate(REACHED), "the whole photograph")
        page.page.set_viewport_size({"width": 1280, "height": 800})
        page.key("s")
        page.wait_until(lambda: in_photograph(page, ".rs-panes", "children.length") == 3, "three")
        assert "photo=" in page.page.url
        held: list[Any] = []  # the comparison of the next object takes long
        page.page.route("**/strip", lambda route: route.continue_() if held else held.append(route))
        page.key("n")
        page.wait_until(lambda: bool(held), "the next object's comparison")
        assert in_photograph(page, ".rs-caption").endswith("tall")  # nothing of the one before
        assert in_photograph(page, ".rs-panes", "children.length") == 0
        held[0].continue_()
        page.wait_for("tall \u00b7 view")
        page.key("g")
        page.wait_until(lambda: in_photograph(page, ".rs-bar") is None, "the scene")
        page.tab("Views")
        page.write("Your name", "ada")
        page.write("Why", "blurred")
        page.press("Leave it out")
        page.wait_for("view 0: ada", "blurred", "Take it in again (view 0)")
        page.press("Show its photograph")
        page.wait_for("tall \u00b7 view 0")
    assert [(e.action, e.view) for e in lines(server)] == [("exclude", 0)]


def test_a_correction_outlives_a_reload_and_the_edit_of_another(
    browser: ReviewBrowser, server: ReviewServer
) -> None:
    session = server.sessions[0]
    with browser.page(server.url) as page:
        loaded(page)
        page.tab("Correct")
        page.key("l")
        page.key("l")
        page.wait_for("moved 10.0 mm", "your correction is not saved")
        page.reload()
        page.wait_message("Your correction of flat goes on")
        page.wait_for("moved 10.0 mm")
        with browser.page(server.url) as other:
            other.wait_for("objects judged", "computed:")
            other.write("Your name", "bob")
            other.wait_for("ada corrects 3 flat")
            page.wait_for("bob looks at 3 flat")
        tab = ReviewPage(page.context, server.url)
        tab.wait_message("Your correction of flat goes on")
        tab.page.set_viewport_size({"width": 390, "height": 844})  # a phone: the list is hidden
        tab.page.locator("[data-realsim-key=n]").click()
        tab.wait_for("instance 0, object 1")
        tab.key("l")
        both = '"instance":3', '"instance":0'
        page.wait_until(lambda: all(t in str(page.kept()) for t in both), "both corrections")
        tab.page.close()
        placed = session.standing.scene.object(3)
        aside = se3.from_translation([0.0, 0.02, 0.0]) @ placed.T_world_obj
        session.decide("move", placed, "bob", pose=aside, how="steps")
        page.wait_message("bob has changed flat meanwhile. Your copy is kept")
        page.press("0 tall")
        page.wait_for("\u25b6 0 tall")
        page.press("3 flat")
        page.wait_message("goes on")
        page.tab("Correct")
        page.press("Save the pose")
        page.wait_message("Recorded: moved 22.4 mm")
        page.wait_gone("your correction is not saved")
        server.stop()
        said = "getComputedStyle(document.body, '::after').content.includes('does not answer')"
        page.wait_until(lambda: page.page.evaluate(said), "that nothing is recorded")
    assert [e.reviewer for e in lines(server)] == ["bob", "ada"]


def test_filters_legends_and_marks(browser: ReviewBrowser, server: ReviewServer) -> None:
    with browser.page(server.url) as page:
        loaded(page)
        page.press("0 tall")
        page.wait_for("instance 0, object 1")
        page.tab("Grasps")
        page.tick("Show grasps")
        page.wait_for("40 of 80 grasps drawn")
        page.tick("The arm reaches it")
        page.wait_for("20 of 80 grasps drawn")
        page.tab("Show")
        page.choose("Points", "distance from the models")
        page.wait_for("pale green = on the surface", "mm")
        page.tab("Correct")
        page.unfold("Symmetry of the model")
        page.choose("It is", "alike after a quarter turn about z")
        page.press("Mark it")
        page.wait_for("marked z:4 by ada")
        page.choose("It really is", "9 spare")
        page.wait_for("it is spare")
        page.press("Save the pose")
        page.wait_message("it is spare")
        page.wait_until(lambda: any("0 spare" in b for b in page.buttons()), "the other name")
    assert [e.action for e in lines(server)] == ["symmetric", "swap"]


def test_the_mouse_chooses_objects_frustums_grasps_and_three_points(
    browser: ReviewBrowser, server: ReviewServer
) -> None:
    scene = server.sessions[0].registered
    with browser.page(server.url, width=1280, height=800) as page:
        loaded(page)
        window: Any = server.windows[0]
        page.wait_until(lambda: _scene_share(page) > 0.02, "the scene")
        camera = window.client.camera
        window.stand.first_look()
        window.browser.wait()
        page.click_at(camera, [0.46, 0.0, 0.12], "\u25b6 0 tall")
        T_cam = max((v.T_world_cam for v in window.content.views),
                    key=lambda T: np.linalg.norm(T[:3, 3] - camera.position))  # fmt: skip
        page.click_at(camera, T_cam[:3, 3] + 0.025 * T_cam[:3, 2], "tall \u00b7 view")
        page.key("g")
        page.wait_until(lambda: in_photograph(page, ".rs-bar") is None, "the scene")
        page.tab("Grasps")
        page.tick("Show grasps")
        page.wait_for("40 of 80 grasps drawn")
        grasps = window.content.grasps_of(0)
        widest = int(np.argmax(grasps.widths_m))
        T_grasp = scene.object(0).T_world_obj @ grasps.Ts_obj_grasp[widest]
        finger = [[0.0, 0.52 * grasps.widths_m[widest], -0.5 * FINGER_M]]
        page.click_at(camera, se3.transform(T_grasp, np.array(finger)), "of 40, tall (instance 0)")
        clicked = int(page.text().partition("Grasp ")[2].split()[0])  # or one that stands before it
        page.press("Next")
        page.wait_for(
            f"Grasp {(clicked + 1) % 40} of 40", ("not reach it", "reaches it")[clicked % 2]
        )
        page.tick("Show grasps")
        page.press("3 flat")
        page.wait_for("\u25b6 3 flat")
        page.tab("Correct")
        page.key("l")
        page.key("l")
        page.wait_for("moved 10.0 mm")
        page.press("Place by three points")
        cloud = window.content.cloud.points
        middle = scene.object(3).T_world_obj[:3, 3] + [0, 0, 0.015]
        top = cloud[(np.abs(cloud - middle) < [0.035, 0.025, 0.002]).all(1)]
        said = ("second point on the blue", "third point on the blue", "placed by 3 points")
        for k, corner in enumerate(([-0.03, -0.02], [0.03, -0.02], [0.0, 0.02])):
            point = top[np.argmin(np.linalg.norm((top - middle)[:, :2] - corner, axis=1))]
            page.click_at(camera, point + np.array([0.01, 0, 0]), f"(pair {k + 1})")
            page.click_at(camera, point, said[k])
        page.press("Save the pose")
        page.wait_message("Recorded")
    (line,) = lines(server)
    assert line.how == "steps+points" and line.pose is not None
    assert np.linalg.norm(line.pose[:3, 3] - scene.object(3).T_world_obj[:3, 3]) < 0.003


def test_a_browser_without_webgl_says_so(
    browser: ReviewBrowser, server: ReviewServer, tmp_path: Path
) -> None:
    session, path = server.sessions[0], tmp_path / "scene.html"
    write_static(session.content(), session.standing.state, path, title="Scene")
    args = ["--no-sandbox", "--disable-gpu", "--disable-webgl", "--disable-3d-apis"]
    bare = browser.browser.browser_type.launch(executable_path=CHROMIUM, args=args)
    try:
        page = bare.new_page()
        for address, note in ((server.url, ".realsim-no-webgl"), (path.as_uri(), "#wait")):
            page.goto(address)
            told = page.get_by_text("cannot draw in three dimensions").and_(page.locator(note))
            told.wait_for()
            assert told.is_visible()
    finally:
        bare.close()


def test_a_key_counts_for_the_object_that_was_shown_when_it_was_pressed(
    browser: ReviewBrowser, server: ReviewServer
) -> None:
    with browser.page(server.url) as page:
        loaded(page)
        page.page.evaluate(
            "for (const key of 'ynyny') document.body.dispatchEvent(new KeyboardEvent('keydown', "
            "{key, code: 'Key' + key.toUpperCase(), bubbles: true}))"
        )
        page.wait_for("pressed while another object was shown")
        page.wait_message("Recorded")
        first = lines(server)[0].instance
        assert {line.instance for line in lines(server)} == {first}, "no other was shown"
        page.wait_until(lambda: f"0/{first}" != page.page.evaluate("realsimShown()"), "the next")
        page.page.keyboard.press("x")
        page.wait_message("rejected")
        page.write("Comment", "of the second")
        page.page.evaluate(CLICKED, [rows(page)[1].splitlines()[0], "Accept"])
        page.wait_for("Accept was pressed while another object was shown", "accepted by ada")
        assert page.value("Comment") == ""
        page.write("Comment", "of the first")
        page.page.evaluate(CLICKED, ["Comment only"])  # at once: the text is still on its way
        page.wait_message("comment")
        page.page.get_by_role("button", name="Undo").click()
        page.wait_message("taken back")
        page.page.keyboard.press("Enter")  # a button that was clicked takes no key
        page.page.evaluate(HELD)
        page.page.keyboard.press("v")
        page.wait_message("Recorded: moved")  # what was held leaves room for the next
        page.press("0 tall")
        page.wait_until(lambda: page.value("Comment") == "of the second", "what was written of it")
    assert [(e.action, e.instance == first, e.comment) for e in lines(server)] == [
        ("accept", True, ""), ("reject", False, ""), ("comment", True, "of the first"),
        ("undo", True, ""), ("move", True, ""),
    ]  # fmt: skip


HELD = """for (let k = 0; k < 40; ++k) document.body.dispatchEvent(new KeyboardEvent('keydown',
    {key: 'l', code: 'KeyL', bubbles: true, repeat: k > 0}))"""
CLICKED = """labels => labels.forEach(label => [...document.querySelectorAll('button')]
    .find(b => b.offsetParent && b.innerText.includes(label)).click())"""
