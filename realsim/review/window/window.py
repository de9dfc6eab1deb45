"""One reviewer's browser: its own name, scene, selection, filters and camera.

Everything is built on the client's own gui and scene, so that two reviewers do not get into one
another's way. What they share is the journal on the disk, and what was read of a session.
"""

import contextlib
import logging
import threading
from collections.abc import Callable, Generator
from dataclasses import dataclass, replace
from functools import cache, partial
from types import SimpleNamespace
from typing import TYPE_CHECKING, Any, Literal
from zipfile import ZipFile

import numpy as np
import viser

from realsim.errors import InputError, RealsimError
from realsim.records import ObjectModel, ObjectPose
from realsim.review import scene_list
from realsim.review.content.content import SceneContent
from realsim.review.drawing.scene_nodes import SceneNodes, light
from realsim.review.journal import Entry
from realsim.review.refusals import SessionGone, disk_words
from realsim.review.reviewed_session import ReviewedSession, Standing
from realsim.review.window import window_text
from realsim.review.window.browser import Browser, Standpoint
from realsim.review.window.from_browser import (
    Hands,
    bind_keys,
    forget_callbacks,
    refuse_foreign_values,
)
from realsim.review.window.panel_correct import CorrectPanel
from realsim.review.window.panel_grasps import GraspsPanel
from realsim.review.window.panel_views import PhotographLink, ViewsPanel
from realsim.review.window.panels import ListPanel, ObjectPanel, ShowPanel

if TYPE_CHECKING:
    from realsim.review.server import ReviewServer

PANEL_PX, PANEL_HEIGHT_PX, EDGE_PX = 300, 530, 8
"""Width, height and distance from the edges of the panel [px]: the scene keeps 3/4 of 1280."""
log = logging.getLogger(__name__)
# Viser reads the list of its 5,000 icons anew for every icon, at 10 ms; the archive stays open.
with contextlib.suppress(AttributeError):  # another viser reads them otherwise
    _icons: Any = viser._icons  # pyright: ignore
    _icons.zipfile = SimpleNamespace(ZipFile=cache(lambda *a: contextlib.nullcontext(ZipFile(*a))))


@dataclass(frozen=True, eq=False, slots=True)
class Opened:
    """The scene that a window shows."""

    session: ReviewedSession
    content: SceneContent
    nodes: SceneNodes
    stands: dict[int, ObjectPose]
    """instance -> object as it is drawn."""


class Window:
    """What one connected browser shows; the methods may be called from any thread."""

    def __init__(
        self, client: viser.ClientHandle, server: "ReviewServer", reviewer: str = ""
    ) -> None:
        """Build the panels; `start` opens the first scene.

        Args:
            client: the browser.
            server: all sessions.
            reviewer: the name to begin with; '' = what this browser keeps.
        """
        self.client, self.server = client, server
        self.lock = threading.RLock()
        self.selected: int | None = None
        """Instance of the object that is looked at."""
        self.stands = False
        """Whether a scene is there and an object chosen: keys and buttons wait for it."""
        self._opened: Opened | None = None
        self._busy = threading.Lock()
        self.browser = Browser(self)
        self._seen: object = None
        self._standing: Standing | None = None
        self._is_closed = False
        self.trouble: Exception | None = None
        """What kept the journals from being shown when they were looked at last."""
        gui = client.gui
        gui.main_panel.float(x=-EDGE_PX, y=EDGE_PX, width=PANEL_PX, height=PANEL_HEIGHT_PX)
        self._name = gui.add_text("Your name", reviewer, hint="Decisions are signed with it.")
        self._message = gui.add_html("")
        self.hands, self.photographs = Hands(self), PhotographLink(self)
        self.stand = Standpoint(self)
        self.list = ListPanel(self)
        tabs = gui.add_tab_group()
        with tabs.add_tab("Object"):
            self.object = ObjectPanel(self)
        with tabs.add_tab("Correct"):
            self.correct = CorrectPanel(self)
        with tabs.add_tab("Views"):
            self.views = ViewsPanel(self)
        with tabs.add_tab("Grasps"):
            self.grasps = GraspsPanel(self)
        with tabs.add_tab("Show"):
            self.show = ShowPanel(self)
        self._name.on_update(self.guarded(lambda _: self.browser.keep_name(self.reviewer)))
        self._up = np.array([0.0, 0.0, 1.0])
        """What is up in the browser's scene, in world."""
        client.camera.on_update(lambda _: self._looked())
        bind_keys(self)
        refuse_foreign_values(gui, self.refuse)

    def start(self) -> None:
        """Open what the address names, else the worst object that nobody judged."""
        self.browser.read_drafts()
        if not self.browser.go_to_place():
            self._go_to_worst()
        if kept := "" if self.reviewer else self.browser.name():
            self._name.value = kept
        self.hands.do(lambda: None)

    def _go_to_worst(self) -> None:
        first = scene_list.first_wanted(self.rows())
        if first is not None:
            self.go_to(*first.key)
        elif self.server.sessions:
            self.go_to(0, None)

    def close(self) -> None:
        """Forget the browser: it is gone."""
        self._is_closed = True
        forget_callbacks(self.client.gui)
        self.grasps.close()
        self.hands.close()

    # --- what is looked at ------------------------------------------------------------------------

    @property
    def reviewer(self) -> str:
        """Who decides here."""
        return self._name.value

    @property
    def opened(self) -> Opened:
        """The scene that is shown.

        Raises:
            InputError: none is yet.
        """
        if self._opened is None:
            raise InputError("no scene is open yet; wait until it is loaded, or choose one.")
        return self._opened

    @property
    def is_open(self) -> bool:
        """Whether a scene is shown."""
        return self._opened is not None

    @property
    def session(self) -> ReviewedSession:
        """The session whose scene is shown."""
        return self.opened.session

    @property
    def nodes(self) -> SceneNodes:
        """The scene's nodes."""
        return self.opened.nodes

    @property
    def content(self) -> SceneContent:
        """What is shown of it."""
        return self.opened.content

    @property
    def standing(self) -> Standing:
        """The journal as this reviewer sees it, which may be older than that on the disk."""
        return self._standing or self.session.standing

    @property
    def placed(self) -> ObjectPose:
        """The selected object as it stands, with the reviewers' verdict.

        Raises:
            InputError: none is selected.
        """
        if self.selected is None:
            raise InputError("no object is selected; click one in the scene or in the list.")
        return self.standing.scene.object(self.selected)

    def shown_objects(self) -> tuple[ObjectPose, ...]:
        """Return the objects that can be drawn, as they stand here, the moved copy among them."""
        objects = list(self.standing.scene.objects)
        moved = self.correct.moved
        if moved is not None:
            now = [moved if o.instance == moved.instance else o for o in objects]
            objects = [replace(o, reasons=()) for o in now]
        return self.session.with_models(objects)

    def model_of(self, placed: ObjectPose) -> ObjectModel:
        """Return an object's model, symmetric as it was marked; a stand-in where it is missing."""
        return self.session.shown_model(placed)

    def rows(self) -> list[scene_list.ObjectRow]:
        """Return all objects of all sessions."""
        return [row for session in self.server.sessions for row in session.rows()]

    def go_to(self, number: int, instance: int | None) -> None:
        """Show an object, and its scene if another one is shown."""
        session = self.server.sessions[number]
        if self._opened is None or self._opened.session is not session:
            self._open(session)
        self.select(instance)
        if instance is not None:
            self.stand.look_at_object()

    def renew(self, session: ReviewedSession) -> None:
        """Show a session that has changed on disk in place of what is shown of it."""
        instance = self.selected
        self._open(session)
        known = {o.instance for o in session.registered.objects}
        self.say(f"{session.name} has changed on disk; this is how it stands now.")
        self.select(instance if instance in known else None)
        self.hands.do(lambda: None)

    def select(self, instance: int | None) -> None:
        """Look at an object of this scene."""
        with self.lock:
            self.stands = True
            if instance != self.selected:
                self.correct.set_aside()
                self.selected = instance
                if self._opened is not None:
                    self._opened.nodes.highlight(instance)
            self.refresh(force=True)
            for panel in (self.object, self.correct, self.grasps):
                panel.selected()

    def next_undecided(self, step: Literal[1, -1]) -> None:
        """Go to the next object that waits for a person, or the one before."""
        rows = scene_list.worst_first(self.rows())
        now = None if self._opened is None or self.selected is None else (
            self._opened.session.number, self.selected
        )  # fmt: skip
        row = scene_list.next_undecided(rows, now, step)
        if row is None:
            self.say("All objects are judged. Thank you.")
            return
        self.go_to(*row.key)

    def _open(self, session: ReviewedSession) -> None:
        """Load a session's scene and show it in place of the one before."""
        with self.working("Opening the scene", session.name) as progress:
            content = session.content(progress)
            with self.lock:
                if self._opened is not None:
                    self.correct.set_aside()
                    self.grasps.closed()
                    self._opened.nodes.clear()
                nodes = SceneNodes(self.client.scene, content, session.config)
                with self.client.atomic():
                    light(self.client.scene, content.look.up)
                    nodes.build()
                nodes.on_object(self._guarded_call(self.select))
                nodes.on_camera(self._guarded_call(self.views.show_photograph))
                nodes.grasps.on_click(self._guarded_call(self.grasps.clicked))
                self._opened = Opened(session, content, nodes, {})
                self.selected, self._seen, self._standing = None, None, None
                for panel in (self.grasps, self.show):
                    panel.opened()
            # A browser maps a camera by the direction that was up before the batch it comes in:
            # the camera is sent when the browser has answered that it has turned the scene.
            self.client.flush()
            if not np.allclose(content.look.up, self._up):
                self.browser.wait()
                self._up = content.look.up
            with self.lock:
                self.stand.first_look()
            # A browser without a graphics card would draw the fine cloud before it shows anything.
            nodes.cloud.refine(session.config.shown_points, self.browser.wait)
            if words := content.remarks if content.views else [window_text.NO_PHOTOGRAPHS]:
                more = f" {len(words) - 3} more stand in the tab Views." * (len(words) > 3)
                self.refuse(" ".join(words[:3]) + more)

    # --- what changed -----------------------------------------------------------------------------

    def refresh(self, *, force: bool = False) -> None:
        """Show the journals as they stand on disk; nothing is sent where nothing changed."""
        if self._is_closed:
            return
        with self.lock:
            others = tuple(self.server.others(self))
            drafts = tuple(self.browser.drafts)
            seen = (*(id(s.standing) for s in self.server.sessions), others, drafts)
            if seen == self._seen and not force:
                return
            self._seen = seen
            if self._opened is not None:
                self._standing = self._opened.session.standing
            with self.client.atomic():
                self.list.refresh(others)
                if self._opened is not None:
                    self._place_all()
                    for panel in (self.object, self.correct, self.views, self.grasps, self.show):
                        panel.refresh()

    def follow(self, trouble: Exception | None) -> None:
        """Show what is new in the journals, or what keeps them from being read.

        Args:
            trouble: why the session that is shown cannot be read; None = it can.
        """
        try:
            self.refresh()
        except Exception as error:
            trouble = trouble or error
        before, self.trouble = self.trouble, trouble
        # It is looked at once a second; a bug is logged once.
        if is_new := repr(trouble) != repr(before):
            self.say("The session can be read again.") if trouble is None else self.fail(trouble)
        elif isinstance(trouble, SessionGone):
            self.alarm(str(trouble))
        if is_new:
            with contextlib.suppress(Exception):
                self.refresh(force=True)

    def _looked(self) -> None:
        """The browser's camera was moved: the address follows, and frustums make way."""
        if self._is_closed or self._opened is None:
            return
        camera = self.client.camera
        self._opened.nodes.clear_sight(camera.position, camera.look_at)
        self.browser.tell_place(self._opened.session.name)

    def _place_all(self) -> None:
        """Put every object where the reviewers left it, in the colour of its verdict."""
        opened, session = self.opened, self.session
        for placed in self.standing.scene.objects:
            if opened.stands.get(placed.instance) is placed:
                continue
            opened.stands[placed.instance] = placed
            drawn = placed.obj_id
            if not session.has_model(drawn):
                drawn = session.registered.object(placed.instance).obj_id
            opened.nodes.swap(placed.instance, drawn)
            opened.nodes.place(placed.instance, placed.T_world_obj)
            opened.nodes.color_verdict(placed.instance, placed.verdict)

    def hide_object(self, instance: int, is_hidden: bool) -> None:
        """Hide one object, because a copy of it is moved or carried; or show it again."""
        node = self.client.scene.get_handle_by_name(f"/objects/{instance}")
        if node is not None:
            node.visible = not is_hidden

    def decided(self, entry: Entry, words: str = "") -> None:
        """Say that a line is in the journal, and show it everywhere."""
        done = words or window_text.ACTION_WORDS.get(entry.action, "taken back")
        self.say(f"Recorded: {done}, signed {entry.reviewer}.")
        self.refresh()  # what comes next begins with it
        self.server.tell()

    # --- answers ----------------------------------------------------------------------------------

    def say(self, text: str) -> None:
        """Answer that something was done."""
        self._message.content = window_text.message_html(text, "ok")

    def refuse(self, text: str) -> None:
        """Answer why something was not done."""
        self._message.content = window_text.message_html(text, "refused")

    def alarm(self, text: str) -> None:
        """Say in red that decisions may be lost, or that the page itself failed."""
        if (content := window_text.message_html(text, "alarm")) != self._message.content:
            self._message.content = content

    def fail(self, error: Exception) -> None:
        """Answer what went wrong."""
        if isinstance(error, SessionGone):
            self.alarm(str(error))
        elif isinstance(error, RealsimError):
            self.refuse(str(error))
        elif isinstance(error, OSError):
            self.refuse(f"Not done: {disk_words(error)}.")
        else:
            log.error("the review page failed", exc_info=error)
            self.alarm(window_text.BUG.format(error))

    def guarded(self, action: Callable[[Any], object]) -> Any:
        """Return a callback that never ends silently."""

        async def callback(event: Any) -> None:
            # What the server itself changes comes with no client; only a person's hand counts.
            if getattr(event, "client", self) is not None:
                self.hands.do(lambda: action(event))

        return callback

    def attempt(self, action: Callable[[], object]) -> bool:
        """Do something; say what went wrong. Return whether it was done."""
        try:
            action()
        except Exception as error:
            self.fail(error)
        else:
            return True
        try:
            self.refresh(force=True)
        except Exception as error:
            # What is said of the action itself stays; `follow` says the rest.
            log.debug("after a failure, the page could not be shown anew: %r", error)
        return False

    def _guarded_call(self, action: Callable[..., object]) -> Callable[..., None]:
        def callback(*given: Any) -> None:
            # A click that places an object by points chooses nothing.
            if not (self._is_closed or self.correct.points.is_on):
                self.hands.do(lambda: action(*given))

        return callback

    @contextlib.contextmanager
    def working(self, title: str, body: str) -> Generator[Callable[[int, int], None]]:
        """Show that something takes long; a second such thing is refused meanwhile.

        Yields:
            A function to call with (done, total).

        Raises:
            InputError: something else is still under way.
        """
        if not self._busy.acquire(blocking=False):
            raise InputError("something else is still under way; wait until it is done.")
        note = self.client.add_notification(title, body, loading=True, with_close_button=False)
        self.correct.enable(False)
        try:
            yield partial(_tell, note, body)
        finally:
            note.remove()
            self._busy.release()
            self.correct.enable(True)


def _tell(note: Any, body: str, done: int, total: int) -> None:
    note.body = f"{body}: {100 * np.clip(done / max(total, 1), 0.0, 1.0):.0f} %"
