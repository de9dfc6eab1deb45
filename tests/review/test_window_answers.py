"""What the review page answers when something is amiss; asked by a program, without a browser."""

import errno
import json
import os
import re
import shutil
import threading
from collections.abc import Callable, Generator, Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import msgspec
import numpy as np
import pytest
from websockets.sync.client import connect
from websockets.sync.connection import Connection
from zstandard import ZstdDecompressor

from realsim import InputError, ObjectModel, ObjectPose, Scene
from realsim.formats.bop.models import save_models
from realsim.geometry import se3
from realsim.review import ReviewServer
from realsim.review.window.browser import Place
from realsim.review.window.from_browser import check_update
from realsim.review.window.window import Window
from realsim.store import SessionStore, save_grasps, save_scene
from realsim.store.session_store import rgb_path
from review_browser import CAMERA, SOCKET, serving
from reviewed_boxes import MODELS, SCENE, boxes_session, grasp_set
from waiting import comes_about

RED, ORANGE = "realsim-message alarm", "realsim-message refused"


class Page:
    """A client that speaks as the page does, and the window that the server made for it."""

    def __init__(self, server: ReviewServer, line: Connection) -> None:
        self.server, self._line = server, line
        # Who does not read what comes is not let go for 10 s; who does not say what he keeps is
        # waited for.
        threading.Thread(target=self._read, daemon=True).start()
        self.send(CAMERA)
        self.wait(lambda: bool(server.windows) and server.windows[0].selected is not None)
        self.window: Window = server.windows[0]

    def _read(self) -> None:
        """Say to all that is asked for that it is not kept."""
        for data in self._line:
            assert isinstance(data, bytes)
            size = int.from_bytes(data[8:16], "little")
            told = msgspec.msgpack.decode(ZstdDecompressor().decompress(data[16 : 16 + size]))
            for asked in told["messages"]:
                if asked["type"] == "LocalStorageGetItemRequestMessage":
                    self.send({"type": "LocalStorageGetItemResponseMessage", "value": None,
                               "error": None, "request_uuid": asked["request_uuid"]})  # fmt: skip

    def send(self, message: dict[str, Any]) -> None:
        self._line.send(msgspec.msgpack.encode(message))

    def set(self, handle: Any, value: Any, prop: str = "value") -> None:
        """Set a control, whatever it offers."""
        updates = {prop: value}
        self.send({"type": "GuiUpdateMessage", "uuid": handle._impl.uuid, "updates": updates})

    @property
    def message(self) -> str:
        return self.window._message.content  # pyright: ignore[reportPrivateUsage]

    def wait(self, until: Callable[[], bool], seconds: float = 30.0) -> None:
        assert comes_about(until, seconds), "it did not come about"

    def wait_message(self, words: str, color: str) -> None:
        try:
            self.wait(lambda: re.search(words, self.message) is not None)
        except AssertionError:
            raise AssertionError(f"'{words}' was not said, but: {self.message}") from None
        assert color in self.message


@contextmanager
def opened(store: SessionStore | list[SessionStore]) -> Generator[Page]:
    with serving(store, reviewer="ada") as server:
        address = server.url.replace("http", "ws")
        with connect(address, subprotocols=[SOCKET], max_size=None, ping_interval=None) as line:
            yield Page(server, line)


@pytest.fixture
def page(tmp_path: Path) -> Iterator[Page]:
    with opened(boxes_session(tmp_path / "boxes")) as page:
        yield page


def test_a_choice_that_is_not_offered_is_refused_and_never_held(
    page: Page, caplog: pytest.LogCaptureFixture
) -> None:
    window = page.window
    panels: Any = (window.list, window.show, window.correct, window.grasps, window.views)
    show, listed, correct = panels[1], panels[0], panels[2]
    for handle in (show._look, listed._which, listed._scene, correct._mm, correct._object,
                   correct._symmetry, panels[3]._stage, panels[4]._view):  # fmt: skip
        held = handle.value
        for value in ("<b>nothing</b>", "", 3, None, [held]):
            window.say("so far")
            page.set(handle, value)
            page.wait_message("is not one of the choices", ORANGE)
            assert handle.value == held
    assert "<b>" not in page.message
    page.set(show._look, "hidden")
    page.wait(lambda: show._look.value == "hidden")
    window.say("so far")
    page.set(show._look, ["x"], "update_cb")
    page.wait_message("may set the value", ORANGE)
    assert callable(show._look._impl.update_cb[0])
    assert [r for r in caplog.records if r.levelname == "ERROR"] == []


def test_numbers_and_texts_are_what_they_say() -> None:
    for held, good, bad in (
        (0.5, [1, 0.25], [float("nan"), float("inf"), 10**400, "1", True, None]),
        (True, [False], ["False", 1, None]),
        ("text", ["", "x" * 20_000], [3, None, "x" * 20_001]),
    ):
        for value in good:
            check_update(SimpleNamespace(value=held), {"value": value})
        for value in bad:
            with pytest.raises(InputError):
                check_update(SimpleNamespace(value=held), {"value": value})


def test_a_full_disk_is_told_and_is_no_bug(
    page: Page, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    window = page.window

    def refused(*_: object) -> int:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    with monkeypatch.context() as patched:
        patched.setattr("realsim.review.journal.os.write", refused)
        assert not window.attempt(lambda: window.object.decide("accept"))
    page.wait_message("Not recorded: the disk is full", ORANGE)
    window.attempt(refused)
    page.wait_message("Not done: the disk is full", ORANGE)
    assert "bug" not in page.message
    assert [r for r in caplog.records if r.levelname == "ERROR"] == []
    assert window.attempt(lambda: window.object.decide("accept"))


def test_what_fails_counts_as_done_so_that_the_page_goes_on(
    page: Page, monkeypatch: pytest.MonkeyPatch
) -> None:
    hands: Any = page.window.hands
    monkeypatch.setattr(page.window.photographs, "tell", lambda: 1 / 0)
    page.set(page.window.list._step, "Next \u25b6")
    page.wait(lambda: "bug in realsim" in page.message)
    page.wait(lambda: 'data-at-work="0"' in hands._html.content)


@pytest.mark.filterwarnings("ignore:Queued a GuiUpdateMessage")
def test_work_that_outlives_the_server_sets_controls_that_call_nothing(page: Page) -> None:
    show: Any = page.window.grasps._show  # pyright: ignore[reportPrivateUsage]
    page.server.stop()
    show.value = not show.value  # no "Event loop is closed", no callback that is never awaited


def test_a_failure_whose_refresh_fails_too_does_not_raise(
    page: Page, monkeypatch: pytest.MonkeyPatch
) -> None:
    def broken(*_: object, **__: object) -> None:
        raise KeyError("on purpose")

    monkeypatch.setattr(page.window, "refresh", broken)
    assert page.window.attempt(broken) is False
    assert "This is a bug in realsim" in page.message and RED in page.message


def test_a_journal_that_vanishes_is_told_in_red_until_it_is_back(page: Page) -> None:
    window, server = page.window, page.server
    window.attempt(lambda: window.object.decide("reject"))
    page.wait_message("Recorded", "realsim-message ok")
    path = server.sessions[0].journal_path
    path.rename(path.with_name("aside"))
    page.wait_message("the journal that was read is gone", RED)
    window.attempt(lambda: window.object.decide("accept"))
    assert not path.exists() and RED in page.message
    assert [e.action for e in server.decisions()] == ["reject"]
    path.with_name("aside").rename(path)
    page.wait_message("can be read again", "realsim-message ok")


def test_a_scene_that_cannot_be_read_is_told_until_it_can(page: Page) -> None:
    window = page.window
    path = page.server.sessions[0].store.path("registration/scene.json")
    whole = path.read_bytes()
    path.write_bytes(whole[:100])
    page.wait_message("scene.json", ORANGE)
    window.attempt(lambda: window.object.decide("accept"))  # its answer takes the place of that
    page.wait_message("Recorded", "realsim-message ok")
    assert "scene.json" in window.list._remarks.content
    path.write_bytes(whole)
    page.wait_message("can be read again", "realsim-message ok")
    page.wait(lambda: "scene.json" not in window.list._remarks.content)


def test_a_page_with_a_swap_to_a_missing_model_stays_usable(page: Page) -> None:
    window, session = page.window, page.server.sessions[0]
    placed = session.standing.scene.object(3)
    session.decide("swap", placed, "bob", pose=placed.T_world_obj, obj_id=99)
    panel: Any = window.object
    page.wait(lambda: "object 99 (its model is missing)" in panel._text.content)
    assert "obj\\_000099.ply" in panel._text.content
    assert window.attempt(lambda: window.select(0)) and window.attempt(lambda: window.select(3))
    assert window.attempt(window.stand.look_at_object)
    assert not window.attempt(window.correct.begin) and "obj_000099.ply" in page.message
    assert window.attempt(window.correct.require_saved), "nothing was begun"
    assert window.attempt(lambda: window.object.decide("reject"))
    for _ in range(2):
        assert window.attempt(lambda: (window.refresh(force=True), window.object.undo()))
    assert session.standing.scene.object(3).obj_id == 7


def test_keys_change_and_save_nothing_while_a_snap_is_computed(page: Page) -> None:
    window, session = page.window, page.server.sessions[0]
    window.correct.nudge("x", 1, "move")
    moved = window.correct.moved
    assert moved is not None
    window.correct.enable(False)
    for act in (
        lambda: window.correct.nudge("x", 1, "move"), window.correct.save, window.correct.to_table
    ):  # fmt: skip
        assert not window.attempt(act) and "wait until it is" in page.message
    assert window.correct.moved is not None
    assert np.array_equal(window.correct.moved.T_world_obj, moved.T_world_obj)
    assert not session.standing.state.entries
    window.correct.enable(True)
    assert window.attempt(lambda: window.correct.nudge("x", -1, "move"))


def test_points_are_clicked_anew_when_the_copy_has_moved_and_put_back_is_all_back(
    page: Page,
) -> None:
    window: Any = page.window
    correct: Any = window.correct
    correct.by_points()
    assert correct.points.is_on and window.attempt(lambda: correct.nudge("x", 1, "move"))
    assert not correct.points.is_on and "begin the three points anew" in page.message
    own = correct._object.value
    other = next(o for o in correct._object.options if o != own)
    page.set(correct._object, other)
    page.wait(lambda: correct.moved is not None and f"{correct.moved.obj_id}" == other.split()[0])
    assert window.attempt(correct.put_back) and correct._object.value == own
    page.set(correct._object, other)
    page.wait(lambda: correct.moved is not None)
    assert window.attempt(correct.save)
    page.wait(lambda: correct._object.value.split()[0] == other.split()[0])
    assert window.attempt(window.object.undo)
    page.wait(lambda: correct._object.value == own)


def test_scenes_of_one_name_keep_their_own_corrections(tmp_path: Path) -> None:
    stores = [boxes_session(tmp_path / half / "000050") for half in ("test", "train")]
    with opened(stores) as page:
        window = page.window
        assert [s.name for s in page.server.sessions] == ["test/000050", "train/000050"]
        here = window.session.number
        assert window.attempt(lambda: (window.go_to(here, 3), window.correct.nudge("x", 1, "move")))
        ((place, instance),) = window.browser.drafts
        assert (place, instance) == (str(stores[here].folder.resolve()), 3)
        assert window.attempt(lambda: window.go_to(1 - here, 3)) and window.correct.moved is None
        assert window.attempt(lambda: window.go_to(here, 3)) and window.correct.moved is not None


# --- scenes that lack something, or hold much ---------------------------------------------------


@pytest.mark.parametrize("lost", ["rgb", "depth"])
def test_a_scene_without_images_is_drawn_and_told(tmp_path: Path, lost: str) -> None:
    folder = boxes_session(tmp_path / "boxes").folder
    shutil.rmtree(folder / lost)
    with opened(SessionStore.open(folder)) as page:
        page.wait_message("No view of this scene has a photograph, its depth and", ORANGE)
        window = page.window
        assert window.client.scene.get_handle_by_name("/objects/3/appearance") is not None
        assert np.isfinite(window.content.look.position).all()
        assert "No view" in answered(page, "strip")["error"]
        assert not window.attempt(window.views.show_chosen) and "no view to choose" in page.message
        assert not window.attempt(window.correct.snap) and "nothing can be snapped" in page.message
        assert window.attempt(lambda: (window.correct.put_back(), window.object.decide("accept")))


def answered(page: Page, what: str) -> Any:
    path = f"/photograph/{page.window.client.client_id}/-/{what}"
    kind, data = page.server._asked(path)  # pyright: ignore[reportPrivateUsage]
    assert kind == "application/json"
    return json.loads(data)


def test_a_thousand_objects_without_texture_and_with_names_of_other_scripts(tmp_path: Path) -> None:
    store = boxes_session(tmp_path / "\u573a\u666f")
    names = {1: "\u7ea2\u8272\u676f\u5b50", 7: "\u0645\u0635\u0628\u0627\u062d", 9: "a" * 300}
    plain = {k: ObjectModel(obj_id=k, name=n, mesh=replace(MODELS[k].mesh, colors=None))
             for k, n in names.items()}  # fmt: skip
    save_models(store.folder / "models", plain)
    placed = [
        ObjectPose(obj_id=(1, 7, 9)[k % 3], instance=k, verdict="doubtful",
                   T_world_obj=se3.from_translation([0.1 * (k % 45), 0.1 * (k // 45), 0.02]))
        for k in range(1000)
    ]  # fmt: skip
    save_scene(store, Scene(name="many", objects=tuple(placed)))
    with opened(SessionStore.open(store.folder)) as page:
        window: Any = page.window
        page.wait(lambda: "page 1 of 63" in window.list._remarks.content)
        assert window.attempt(lambda: window.select(997)) and names[7] not in page.message
        assert window.attempt(lambda: window.select(499))
        window._name.value = "\u0645\u062d\u0645\u062f"
        assert window.attempt(lambda: window.object.decide("reject"))
        page.wait_message(f"{names[7]} rejected, signed \u0645\u062d\u0645\u062f", "ok")
        page.wait(lambda: "1 of 1000" in re.sub("<.*?>", "", window.list._head.content))
        window.list._which.value = "judged"
        window.refresh(force=True)
        assert window.list._buttons[0].label.splitlines()[0] == f"\u25b6 499 {names[7]}"
        place = Place.of(Place(scene=store.folder.name, instance=499).text(names[7]))
        assert (place.scene, place.instance) == ("\u573a\u666f", 499)


def test_a_session_that_changes_on_disk_is_shown_as_it_stands(page: Page) -> None:
    window, store = page.window, page.server.sessions[0].store
    for index in range(4):
        store.path(rgb_path(index)).unlink()
    assert "000001.png" in answered(page, "photo/1")["error"]
    assert "bug in realsim" in answered(page, "photo/inf")["error"]
    aside = replace(SCENE.objects[0], T_world_obj=se3.from_translation([0.2, 0.1, 0.06]))
    save_scene(store, replace(SCENE, objects=(aside, SCENE.objects[1])))
    save_grasps(store, grasp_set(1, 0, 7))
    page.wait_message("has changed on disk", "ok")
    page.wait(lambda: [len(s) for s in window.content.grasp_sets] == [7, 40])
    np.testing.assert_allclose(window.standing.scene.object(0).T_world_obj, aside.T_world_obj)
    (store.folder / "models/obj_000001.ply").unlink()
    save_scene(store, SCENE)
    page.wait_message("obj_000001.ply|no model of", ORANGE)
