"""The review in the browser: sessions, windows, and who may enter.

    server = ReviewServer([store], port=0)
    server.start()
    print(server.url)

Every browser that connects gets a `Window` of its own. Once a second the journals on the disk are
looked at, so that what another reviewer decides appears by itself, even one at another server.
"""

import contextlib
import gc
import io
import json
import logging
import threading
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path

import viser

from realsim import local_pages
from realsim.errors import InputError, RealsimError
from realsim.interop import give_back_memory
from realsim.local_pages import Door
from realsim.review import journal, scene_list
from realsim.review.content.config import SceneConfig
from realsim.review.drawing.scene_nodes import light
from realsim.review.journal import Entry
from realsim.review.replaying.grasp_replay import Motions
from realsim.review.reviewed_session import ReviewedSession
from realsim.review.window import page_head, window_text
from realsim.review.window.from_browser import is_camera
from realsim.review.window.window import Window
from realsim.store import SessionStore

__all__ = ["ReviewServer", "SceneConfig"]

POLL_S = 1.0
"""How often the journals are looked at [s]: another's decision is seen about as it is made."""
log = logging.getLogger(__name__)


class ReviewServer:
    """The review of one session or of many; `start` returns at once, threads do the rest."""

    def __init__(
        self,
        stores: SessionStore | Sequence[SessionStore],
        *,
        host: str = "127.0.0.1",
        port: int = 8080,
        token: str = "",
        reviewer: str = "",
        config: SceneConfig | None = None,
        motions: Callable[[Path], Motions] | None = None,
        remarks: Sequence[str] = (),
    ) -> None:
        """Read the scenes; nothing listens yet.

        Args:
            stores: registered sessions.
            host: where to listen; beyond the loopback interface only with a token.
            port: where to listen; the next free one is taken if it is in use, 0 = any.
            token: the secret that lets in; '' = none is asked for.
            reviewer: name that a browser begins with; '' = what it keeps.
            config: how much is shown.
            motions: returns where the motions of the grasps in a session's folder come from.
            remarks: what the reviewers should know, such as which sessions cannot be opened.

        Raises:
            InputError: other machines could enter without a token, a session is not registered, or
                a model is missing.
        """
        given = [stores] if isinstance(stores, SessionStore) else list(stores)
        if not token:
            local_pages.check_host(host, "the review")
        hosts = () if local_pages.is_loopback(host) else local_pages.names_of_this_machine(host)
        self._door = Door(token=token, names=hosts)
        self._host, self._port, self._reviewer = host, port, reviewer
        self._config = config or SceneConfig()
        self._make_motions = motions
        self._motions: dict[int, Motions | None] = {}
        self._sessions = [ReviewedSession(s, k, self._config) for k, s in enumerate(given)]
        names = scene_list.names_of([s.folder for s in given])
        for session, name in zip(self._sessions, names, strict=True):
            session.name = name
        self.remarks = tuple(remarks)
        """What the reviewers should know."""
        self._warned: set[str] = set()
        self._begun = {e.id for s in self._sessions for e in s.standing.state.entries}
        self._server: viser.ViserServer | None = None
        self._windows: dict[int, Window] = {}
        self._reader = threading.Thread()
        self._lock = threading.Lock()
        self._motions_lock = threading.Lock()
        self._stop = threading.Event()
        self._is_told = threading.Event()

    # --- what the windows ask ---------------------------------------------------------------------

    @property
    def sessions(self) -> Sequence[ReviewedSession]:
        """All sessions under review."""
        return self._sessions

    @property
    def windows(self) -> list[Window]:
        """The windows of all connected browsers."""
        with self._lock:
            return list(self._windows.values())

    def motions_of(self, session: ReviewedSession) -> Motions | None:
        """Return where the motions of a session's grasps come from; None = there are none."""
        if self._make_motions is None:
            return None
        with self._motions_lock:
            if session.number not in self._motions:
                try:
                    found = self._make_motions(session.store.folder)
                except InputError as error:
                    log.info("no motions of %s: %s", session.name, error)
                    found = None
                self._motions[session.number] = found
            return self._motions[session.number]

    def tell(self) -> None:
        """Show a decision in all windows at once."""
        self._is_told.set()

    def others(self, window: Window) -> list[str]:
        """Return what the other reviewers look at, in words."""
        return sorted(w.browser.looks_at() for w in self.windows if w is not window)

    # --- running ----------------------------------------------------------------------------------

    @property
    def url(self) -> str:
        """The address to open in a browser, without the token.

        Raises:
            InputError: the server is not started.
        """
        host = self._host
        if host in ("0.0.0.0", "::"):
            host = self._door.names[-2] if len(self._door.names) > 1 else "localhost"
        host = f"[{host}]" if ":" in host else host
        return f"http://{host}:{self._running().get_port()}"

    @property
    def address(self) -> str:
        """The address to open in a browser, with the token where one is asked for."""
        return f"{self.url}/?token={self._door.token}" if self._door.token else self.url

    def _running(self) -> viser.ViserServer:
        if self._server is None:
            raise InputError("the review server is not running; call start() first.")
        return self._server

    def start(self) -> None:
        """Listen; returns when a browser may come."""
        if self._server is not None:
            return
        port = local_pages.free_port(self._host, self._port)
        # Looking for garbage among all that is sent costs a tenth of the opening; 700 is usual.
        gc.set_threshold(max(50_000, gc.get_threshold()[0]))
        self._stop.clear()
        # Viser prints a banner with its address; the caller says what is to be said.
        with (
            page_head.answering(self._asked),
            local_pages.guarded(self._door, page_head.dressed),
            contextlib.redirect_stdout(io.StringIO()),
        ):
            server = viser.ViserServer(
                host=self._host, port=port, label="realsim review", verbose=False
            )
        local_pages.refuse_foreign_messages(server)
        self._server = server
        light(server.scene, (0.0, 0.0, 1.0))
        server.gui.configure_theme(show_logo=False, show_share_button=False, control_width="large")
        server.on_client_connect(self._came)
        server.on_client_disconnect(self._went)
        threading.Thread(target=self._watch, name="review-journals", daemon=True).start()
        self._reader = threading.Thread(target=self._read_first, name="review-first", daemon=True)
        self._reader.start()

    def stop(self) -> None:
        """Stop listening; the journals stay."""
        self._stop.set()
        self._is_told.set()
        for window in self.windows:
            window.close()
        if self._server is not None:
            with contextlib.redirect_stdout(io.StringIO()):
                self._server.stop()
            self._server = None
        if self._reader.is_alive():
            self._reader.join()
        with self._lock:
            self._windows.clear()

    def _read_first(self) -> None:
        """Read what a browser shows first, while it still loads the page.

        What goes wrong is said when a window opens that scene.
        """

        def go_on(*_: int) -> None:
            if self._stop.is_set():
                raise InputError("the server was stopped.")

        try:
            first = scene_list.first_wanted([row for s in self._sessions for row in s.rows()])
            session = self._sessions[0 if first is None else first.session]
            content = session.content(go_on)
            for placed in session.registered.objects:
                go_on()
                _ = content.meshes[placed.obj_id]
        except Exception as error:
            log.debug("the first scene was not read ahead: %r", error)

    def decisions(self) -> list[Entry]:
        """Return the lines that were written to the journals since the server was made.

        They are remembered: a session that was moved meanwhile does not make them none.
        """
        return [e for s in self._sessions for e in s.entries_seen() if e.id not in self._begun]

    def _asked(self, path: str) -> tuple[str, bytes]:
        """Answer what a page's script asks for: /photograph/BROWSER/STATE/WHAT/NUMBERS..."""
        try:
            client, _, what, *numbers = path.removeprefix(page_head.ASKED).split("/")
            with self._lock:
                window = self._windows[int(client)]
            return window.photographs.answer(what, [float(n) for n in numbers])
        except (RealsimError, OSError) as error:
            said = {"error": str(error)}
        except (LookupError, ValueError):
            said = {"error": "there is nothing of this address; load the page anew."}
        except Exception as error:
            log.exception("a photograph could not be shown")
            said = {"error": window_text.BUG.format(error)}
        return "application/json", json.dumps(said).encode()

    # --- browsers come and go ---------------------------------------------------------------------

    def _came(self, client: viser.ClientHandle) -> None:
        if not is_camera(client.camera):
            return log.warning("a message from a browser was not understood: its camera is none")
        try:
            window = Window(client, self, self._reviewer)
        except Exception:
            log.exception("a window could not be built")
            client.add_notification(
                "This is a bug in realsim", "Please report it with the log.", color="red"
            )
            return
        with self._lock:
            self._windows[client.client_id] = window
        window.attempt(window.start)

    def _went(self, client: viser.ClientHandle) -> None:
        with self._lock:
            window = self._windows.pop(client.client_id, None)
        if window is not None:
            window.close()
        gc.collect()  # a window is a circle of parts, and garbage is looked for seldom
        give_back_memory()

    def _watch(self) -> None:
        """Look at the journals once a second, and at once after a decision made here."""
        while not self._stop.is_set():
            self._is_told.wait(POLL_S)
            self._is_told.clear()
            troubles = self._renew()
            for window in self.windows:
                if not self._stop.is_set():
                    number = window.session.number if window.is_open else 0
                    window.follow(troubles.get(number))

    def _renew(self) -> dict[int, Exception]:
        """Read sessions again that have changed on disk, and show them so.

        Returns:
            Number of a session -> why it cannot be read.
        """
        troubles: dict[int, Exception] = {}
        for number, session in enumerate(self._sessions):
            try:
                session.check_folder()
                if not session.has_changed():
                    _ = session.standing  # Read also while no window is open, to be remembered.
                    continue
                store = SessionStore.open(session.store.folder)
                renewed = ReviewedSession(store, number, self._config, before=session)
            except (RealsimError, OSError) as error:
                troubles[number] = error
                self._warn_once(f"{session.name} cannot be read: {error}")
                continue
            self._sessions[number] = renewed
            with self._motions_lock:
                self._motions.pop(number, None)
            for window in self.windows:
                if window.is_open and window.session is session:
                    window.attempt(partial(window.renew, renewed))
        return troubles

    def _warn_once(self, text: str) -> None:
        """Say on the terminal what is looked at once a second, but say it once."""
        if text not in self._warned:
            self._warned.add(text)
            log.warning("%s", text)


def counted(sessions: Sequence[ReviewedSession]) -> tuple[int, int]:
    """Return how many objects a person has judged, and how many there are."""
    return scene_list.counts([row for s in sessions for row in s.latest.rows])


def words_of(entries: Sequence[journal.Entry]) -> str:
    """Return how many lines of which kind there are: '3 accept, 1 move'."""
    actions = [e.action for e in entries]
    return ", ".join(f"{actions.count(a)} {a}" for a in dict.fromkeys(actions)) or "none"
