"""What `realsim review` does: open the sessions, serve the page until Ctrl-C, sum up."""

import contextlib
import os
import signal
import threading
import warnings
import webbrowser
from collections.abc import Generator
from dataclasses import dataclass
from pathlib import Path
from shlex import quote
from typing import Any

from realsim import local_pages
from realsim.app.console import Console
from realsim.app.reviewed import damage_words
from realsim.app.stages import open_session
from realsim.errors import InputError, RealsimError
from realsim.review import scene_list
from realsim.store import SessionStore, load_scene


@dataclass(frozen=True, kw_only=True, slots=True)
class ReviewRequest:
    """What is asked for on the command line."""

    folders: tuple[Path, ...]
    """Sessions, or folders of sessions."""
    host: str = "127.0.0.1"
    port: int = 8080
    token_file: Path | None = None
    """Holds the secret; None = one is made where it is needed."""
    reviewer: str = ""
    """The name that a browser begins with."""
    opens_browser: bool = True


def run_review(request: ReviewRequest, console: Console) -> None:
    """Serve the review page until somebody presses Ctrl-C.

    Raises:
        InputError: there is nothing to review, or the page cannot be served there.
    """
    from realsim.app.review.motions import SessionMotions
    from realsim.review.server import ReviewServer, counted, words_of

    token = _token(request)
    stores, remarks = open_all(request.folders)
    server = ReviewServer(
        stores, host=request.host, port=request.port, token=token, reviewer=request.reviewer,
        motions=SessionMotions.of_session, remarks=remarks,
    )  # fmt: skip
    console.warn(*remarks)
    # A browser may leave while its page is changed; viser would tell that in the terminal.
    warnings.filterwarnings("ignore", "Queued .* on a closed connection", UserWarning)
    with _until_interrupted() as ended:
        server.start()
        try:
            _tell_address(request, server.url, server.address, console)
            ended.wait()
        finally:
            decisions = server.decisions()
            judged, objects = counted(server.sessions)
            url = server.url
            gone = [t for t in (s.trouble() for s in server.sessions) if t]
            server.stop()
    console.warn(*gone)
    console.say(f"decisions in this run: {words_of(decisions)}")
    console.say(f"judged by people: {judged} of {objects} objects in {len(stores)} session(s)")
    changed = sorted({str(s.store.folder) for s in server.sessions if s.has_pending})
    if changed:
        console.say("decisions count in every later command; to fit the other poses to them, too:")
    for folder in changed:
        console.say(f"next      realsim register {quote(folder)} --from-review")
    console.result(
        {
            "sessions": [str(s.folder) for s in stores],
            "not_opened": remarks,
            "url": url,
            "judged": judged,
            "objects": objects,
            "decisions": [_as_row(e) for e in decisions],
            "to_register": changed,
        }
    )


def write_page(request: ReviewRequest, path: Path, console: Console) -> None:
    """Write the reviewed scene as one HTML file that needs no server.

    Raises:
        InputError: the file cannot be made there, there are several sessions, or a model is
            missing.
    """
    from realsim.app.reviewed import review_of
    from realsim.review.content.content import SceneConfig, SceneContent
    from realsim.review.static.static_page import write_static

    folders = scene_list.sessions_under(request.folders)
    if len(folders) != 1:
        raise InputError(
            f"--static writes one scene, and there are {len(folders)}: {folders[0]}, {folders[1]}, "
            "... Give the one that is meant."
        )
    store = _opened(folders[0])
    state = review_of(store)
    with console.stage("read", store.session.name) as tick:
        content = SceneContent.load(store, SceneConfig(), tick)
    console.warn(*content.remarks)
    title = store.session.name or store.folder.resolve().name
    with console.stage("write", str(path)) as tick:
        summary = write_static(content, state, path, title=title, progress=tick)
    console.say(f"{summary.path}   {summary.size_bytes / 1e6:.1f} MB, opens without a server")
    console.result(summary)


def open_all(folders: tuple[Path, ...]) -> tuple[list[SessionStore], list[str]]:
    """Open all sessions that are meant; return also which cannot be reviewed, and why.

    Raises:
        InputError: there is none that can.
    """
    stores: list[SessionStore] = []
    remarks: list[str] = []
    found = scene_list.sessions_under(folders)
    for folder in found:
        try:
            stores.append(_opened(folder))
            remarks += filter(None, [damage_words(stores[-1])])
        except RealsimError as error:
            if len(found) == 1:
                raise
            remarks.append(f"{folder} is left out: {error}")
    if not stores:
        raise InputError(f"none of {len(found)} sessions can be reviewed; the first: {remarks[0]}")
    return stores, remarks


def _opened(folder: Path) -> SessionStore:
    """Open one registered session."""
    from realsim.app.register.files import finish_interrupted

    store = open_session(folder)
    finish_interrupted(store)
    if not store.has(scene_list.SCENE_FILE):
        raise InputError(
            f"session '{folder}' is not registered yet: run `realsim register {folder}` first."
        )
    load_scene(store)  # a damaged one is told before anything is served
    return store


def _token(request: ReviewRequest) -> str:
    """Return the secret to be asked for; '' where only this machine reaches the page."""
    if request.token_file is not None:
        return local_pages.token_of_file(request.token_file)
    return "" if local_pages.is_loopback(request.host) else local_pages.new_token()


def _tell_address(request: ReviewRequest, url: str, address: str, console: Console) -> None:
    port = url.rsplit(":", 1)[1]
    if request.port and port != str(request.port):
        console.warn(f"port {request.port} is in use; another one was taken.")
    console.say(f"review    {address}   (Ctrl-C ends)")
    if local_pages.is_loopback(request.host):
        console.say(f"from another machine: ssh -L {port}:127.0.0.1:{port} THIS_MACHINE")
    else:
        console.warn(
            "nothing is encrypted: whoever listens on the network reads the token and the "
            f"pictures. Better: --host 127.0.0.1, and ssh -L {port}:127.0.0.1:{port} THIS_MACHINE "
            "on the other machine."
        )
    # Without a display, Python would start a browser of the terminal, in this terminal.
    if request.opens_browser and (os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")):
        with contextlib.suppress(webbrowser.Error):
            webbrowser.open(address)


@contextlib.contextmanager
def _until_interrupted() -> Generator[threading.Event]:
    """Yield an event that Ctrl-C and a polite kill set, so that both end with a summary."""
    ended = threading.Event()
    if threading.current_thread() is not threading.main_thread():
        yield ended
        return
    numbers = (signal.SIGINT, signal.SIGTERM)

    def end(number: int, frame: object) -> None:
        ended.set()

    before = {n: signal.signal(n, end) for n in numbers}
    try:
        yield ended
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def _as_row(entry: Any) -> dict[str, Any]:
    names = ("id", "time", "reviewer", "action", "instance", "obj_id", "view", "comment", "how")
    return {name: getattr(entry, name) for name in names}
