"""Who may enter the review page: host, origin, token, tunnel; asked with raw sockets."""

import contextlib
import http.client
import logging
import os
import re
import socket
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import pytest
from msgspec.msgpack import encode as msgpack
from websockets.exceptions import ConnectionClosed, InvalidStatus
from websockets.sync.client import connect
from websockets.typing import Origin

from realsim import local_pages
from realsim.local_pages import Door
from realsim.review import ReviewServer
from realsim.store import SessionStore
from refusals import refused
from review_browser import CAMERA, SOCKET, serving
from waiting import comes_about

TOKEN = "a-secret-of-more-than-16"


@pytest.fixture(scope="module")
def server(store: SessionStore) -> Iterator[ReviewServer]:
    with serving(store) as review:
        yield review


@pytest.fixture(scope="module")
def locked(store: SessionStore) -> Iterator[ReviewServer]:
    """Return a server that asks for a token, listening on all interfaces."""
    with serving(store, host="0.0.0.0", token=TOKEN) as review:
        yield review


def port_of(server: ReviewServer) -> int:
    return int(server.url.rsplit(":", 1)[1])


def asked(server: ReviewServer, path: str = "/", **headers: str) -> tuple[int, dict[str, str]]:
    """Return status and headers of a GET with these headers besides or instead of its own."""
    connection = http.client.HTTPConnection("127.0.0.1", port_of(server), timeout=20)
    connection.request("GET", path, headers=headers)
    answer = connection.getresponse()
    body = answer.read()
    assert (b"<html" in body.lower()) == (len(body) > 100_000)
    return answer.status, dict(answer.headers) | {"body": body.decode(errors="replace")[:400]}


def raw(server: ReviewServer, request: str) -> str:
    """Return the first line of the answer to these bytes."""
    with socket.create_connection(("127.0.0.1", port_of(server)), timeout=20) as line:
        line.sendall(request.replace("\n", "\r\n").encode(errors="surrogateescape"))
        return line.recv(200).decode(errors="replace").split("\r\n")[0]


def handshake(server: ReviewServer, origin: str | None = None, **headers: str) -> int:
    """Return 101 if the websocket is opened and the page's messages come, else the refusal."""
    address = f"ws://127.0.0.1:{port_of(server)}"
    try:
        with connect(
            address, origin=None if origin is None else Origin(origin), subprotocols=[SOCKET],
            additional_headers=headers, max_size=None,
        ) as line:  # fmt: skip
            assert len(line.recv(timeout=20)) > 0
            return 101
    except InvalidStatus as refused:
        return refused.response.status_code


def troubles(caplog: pytest.LogCaptureFixture) -> list[logging.LogRecord]:
    return [r for r in caplog.records if r.levelname in ("WARNING", "ERROR")]


# --- where it listens -------------------------------------------------------------------------


@pytest.mark.parametrize("host", ["0.0.0.0", "::", "192.168.1.5", "example.org", ""])
def test_other_machines_are_refused_without_a_token(store: SessionStore, host: str) -> None:
    refused("no login", ReviewServer, store, host=host)


@pytest.mark.parametrize("host", ["127.0.0.1", "127.1.2.3", "::1", "localhost"])
def test_loopback_is_accepted(host: str) -> None:
    assert local_pages.check_host(host, "the review") == host


def test_a_host_that_is_not_here_is_told_before_anything_listens() -> None:
    words = {"203.0.113.77": "cannot listen on", "no.such.machine.invalid": "cannot listen on"}
    for host, told in (words | {"a" * 300: "300 characters"}).items():
        refused(told, local_pages.free_port, host, 8080)


def test_a_port_in_use_is_passed_over() -> None:
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        port = taken.getsockname()[1]
        assert port < local_pages.free_port("127.0.0.1", port) < port + local_pages.PORTS_TRIED


# --- the page of this machine only ------------------------------------------------------------


def test_the_page_is_served_under_the_names_of_this_machine(server: ReviewServer) -> None:
    port = port_of(server)
    for host in (f"127.0.0.1:{port}", "localhost", "LOCALHOST:9000", "[::1]:8080"):
        assert asked(server, Host=host)[0] == 200


@pytest.mark.parametrize(
    "host", ["evil.example", "127.0.0.1.evil.example", "localhost.evil.example:8080", "10.0.0.5",
             "127.0.0.1@evil.example", "evil.example#127.0.0.1", "", "[", "[::1]; script-src *",
             "[::1] x", "[::1]:80;x", "localhost:99999", "localhost:x", "localhost,evil.example",
             "[::1]x", "127.0.0.1;a"]
)  # fmt: skip
def test_a_foreign_host_gets_neither_page_nor_socket(server: ReviewServer, host: str) -> None:
    """A name that somebody else made to point here is DNS rebinding."""
    assert asked(server, Host=host)[0] == 403
    upgrade = "Upgrade: websocket\nConnection: Upgrade\nSec-WebSocket-Version: 13\n"
    key = "Sec-WebSocket-Key: dGhlIHNhbXBsZSBub25jZQ==\n"
    assert " 403 " in raw(server, f"GET / HTTP/1.1\nHost: {host}\n{upgrade}{key}\n")


def test_no_host_and_two_hosts_are_refused(server: ReviewServer) -> None:
    assert " 403 " in raw(server, "GET / HTTP/1.1\n\n")
    assert " 403 " in raw(server, "GET / HTTP/1.1\nHost: localhost\nHost: evil.example\n\n")


@pytest.mark.parametrize(
    "origin", ["https://evil.example", "http://127.0.0.1.evil.example", "null",
               "http://localhost:1", "file://"]
)  # fmt: skip
def test_foreign_pages_are_refused(server: ReviewServer, origin: str) -> None:
    """Even a page of another server of this machine is a foreign one."""
    assert handshake(server, origin) == 403


def test_own_pages_get_the_scene_and_so_do_programs_of_this_machine(server: ReviewServer) -> None:
    assert handshake(server, server.url) == handshake(server, None) == 101


def test_a_forwarded_port_is_our_own_page(server: ReviewServer) -> None:
    """With `ssh -L 9000:127.0.0.1:8080` the browser calls us localhost:9000."""
    assert asked(server, Host="localhost:9000", Origin="http://localhost:9000")[0] == 200
    assert asked(server, Host="localhost:9000", Origin="http://localhost:9001")[0] == 403


def test_no_link_can_give_the_page_orders(server: ReviewServer) -> None:
    """Viser's page would show the messages of any server that its address names."""
    assert asked(server, "/?websocket=wss://evil.example")[0] == 403
    assert asked(server, "/?playbackPath=https://evil.example/x")[0] == 403
    policy = asked(server)[1]["Content-Security-Policy"]
    assert "frame-ancestors 'none'" in policy
    sources = re.search("connect-src ([^;]*)", policy)
    port = port_of(server)
    assert sources is not None
    assert sources[1] == f"'self' ws://127.0.0.1:{port} wss://127.0.0.1:{port} data: blob:"


def test_nobody_can_ask_for_a_public_tunnel(server: ReviewServer) -> None:
    from viser import _messages

    handlers = server._running()._websock_server._incoming_handlers  # type: ignore[reportPrivateUsage]
    assert _messages.ShareUrlRequest not in handlers
    assert _messages.ShareUrlDisconnect not in handlers
    called: list[bool] = []
    running = server._running()  # type: ignore[reportPrivateUsage]
    running.request_share_url = lambda verbose=True: called.append(True)  # type: ignore[method-assign]
    with connect(f"ws://127.0.0.1:{port_of(server)}", subprotocols=[SOCKET], max_size=None) as line:
        line.recv(timeout=20)
        line.send(msgpack({"type": "ShareUrlRequest"}))
        assert line.ping().wait(20)
    assert called == []


@pytest.mark.parametrize(
    "head", ["GET //[bad/ HTTP/1.1\nHost: localhost\n", "GET /%00 HTTP/1.1\nHost: localhost\n",
             "GET http://[x/ HTTP/1.1\nHost: localhost\n"]
)  # fmt: skip
def test_addresses_that_are_none_are_answered_without_a_traceback(
    server: ReviewServer, head: str, caplog: pytest.LogCaptureFixture
) -> None:
    assert raw(server, f"{head}\n").split(" ")[1] in ("400", "404")
    assert troubles(caplog) == []


def test_a_browser_that_leaves_before_it_is_answered_fills_no_terminal(
    server: ReviewServer, caplog: pytest.LogCaptureFixture
) -> None:
    with caplog.at_level("DEBUG", "realsim.local_pages"):
        with server._lock:  # pyright: ignore[reportPrivateUsage]
            with socket.create_connection(("127.0.0.1", port_of(server)), 20) as line:
                line.sendall(b"GET /photograph/9/-/strip HTTP/1.1\r\nHost: localhost\r\n\r\n")
                time.sleep(0.2)
            time.sleep(0.2)
        assert comes_about(lambda: any("ended before" in r.getMessage() for r in caplog.records))
    assert troubles(caplog) == []


@pytest.mark.parametrize(
    "frame", [b"", b"\xff" * 9, "text", msgpack(None), msgpack([1]), msgpack({"type": "No"}),
              msgpack({"type": "GuiUpdateMessage", "uuid": [], "updates": 3}),
              msgpack({"type": "FileTransferStartUpload", "part_count": -1}),
              msgpack({"type": "ViewerCameraMessage", "position": "far"}),
              msgpack(CAMERA | {"position": []}),
              [msgpack(CAMERA), msgpack(CAMERA | {"look_at": 1})]]
)  # fmt: skip
def test_a_frame_that_is_no_message_gets_a_line_in_the_log(
    server: ReviewServer, frame: bytes | str | list[bytes], caplog: pytest.LogCaptureFixture
) -> None:
    with connect(f"ws://127.0.0.1:{port_of(server)}", subprotocols=[SOCKET], max_size=None) as line:
        for part in frame if isinstance(frame, list) else [frame]:
            line.send(part)
        with contextlib.suppress(ConnectionClosed):
            pong = line.ping()  # a closed line never answers
            assert comes_about(lambda: pong.is_set() or line.close_code is not None)
    assert handshake(server) == 101
    # A connection that it closes is logged after that.
    assert comes_about(lambda: troubles(caplog))
    for record in troubles(caplog):
        assert "was not understood" in record.getMessage() and not record.exc_info


def test_a_frame_beyond_all_sizes_and_an_upload_fill_no_memory(server: ReviewServer) -> None:
    from viser import _messages

    running = server._running()  # type: ignore[reportPrivateUsage]
    assert _messages.FileTransferPart not in running._websock_server._incoming_handlers  # type: ignore[reportPrivateUsage]
    with connect(f"ws://127.0.0.1:{port_of(server)}", subprotocols=[SOCKET], max_size=None) as line:
        with pytest.raises(ConnectionClosed, match="1009"):
            line.send(b"\x00" * (local_pages.MOST_FRAME_BYTES + 1))
            while True:
                line.recv(timeout=20)


# --- with a token -----------------------------------------------------------------------------


def test_without_the_token_neither_page_nor_socket_answers(locked: ReviewServer) -> None:
    assert asked(locked)[0] == 401
    assert handshake(locked) == 401
    for wrong in ("", "x", TOKEN[:-1], TOKEN + "x", TOKEN.upper(), "\u00fc" * 20):
        from urllib.parse import quote

        assert asked(locked, f"/?token={quote(wrong)}")[0] == 401
    host = f"Host: localhost:{port_of(locked)}"
    bytes_cookie = f"Cookie: realsim_{port_of(locked)}=\udcff\udcfe"
    assert " 401 " in raw(locked, f"GET / HTTP/1.1\n{host}\n{bytes_cookie}\n\n")
    assert " 401 " in raw(locked, f"GET /?token=\udcff HTTP/1.1\n{host}\n\n")
    cookie = f"realsim_{port_of(locked)}={TOKEN}"
    assert asked(locked, Cookie=cookie)[0] == 401  # the token itself is no cookie
    assert handshake(locked, Cookie=cookie) == 401


def test_the_token_comes_once_in_the_address_and_stays_as_a_cookie(locked: ReviewServer) -> None:
    path = locked.address.split("/", 3)[3]
    assert path == f"?token={TOKEN}"
    status, headers = asked(locked, f"/{path}")
    assert status == 200 and 'url=/"' in headers["body"]
    assert headers["Referrer-Policy"] == "no-referrer" and headers["Cache-Control"] == "no-store"
    cookie = headers["Set-Cookie"]
    assert {"HttpOnly", "SameSite=Strict", "Path=/"} <= set(cookie.split("; "))
    assert TOKEN not in cookie
    value = cookie.split(";")[0]
    assert asked(locked, Cookie=value)[0] == 200
    assert asked(locked, Cookie=f"a=b; {value}; c=d")[0] == 200
    assert handshake(locked, Cookie=value) == 101
    assert handshake(locked, f"http://127.0.0.1:{port_of(locked)}", Cookie=value) == 101
    # A page of another site that has the browser's cookie sent along is still a foreign page.
    assert handshake(locked, "https://evil.example", Cookie=value) == 403
    assert asked(locked, Cookie=value, Host="evil.example")[0] == 403


def test_an_open_server_answers_to_its_addresses_and_names_only(locked: ReviewServer) -> None:
    cookie = asked(locked, f"/?token={TOKEN}", Host="192.0.2.7:8080")[1]["Set-Cookie"].split(";")[0]
    assert cookie.startswith("realsim_8080=")
    for host in ("192.0.2.7:8080", f"{socket.gethostname()}:8080"):
        assert asked(locked, Host=host, Cookie=cookie)[0] == 200
    assert asked(locked, Host="somewhere.example:8080", Cookie=cookie)[0] == 403


def test_a_token_file_must_be_ones_own_and_long(tmp_path: Path) -> None:
    path = tmp_path / "token"
    refused("cannot be read", local_pages.token_of_file, path)
    path.write_text(TOKEN + "\n")
    path.chmod(0o644)
    refused("chmod 600", local_pages.token_of_file, path)
    path.chmod(0o600)
    assert local_pages.token_of_file(path) == TOKEN
    for bad in ("short", "two words of a long token", "\u00fcmlaut-in-a-long-token"):
        path.write_text(bad)
        refused("at least 16", local_pages.token_of_file, path)
    for letter in "+%&#/=?.~ \u00fc\x00":
        path.write_text(f"{TOKEN}{letter}{TOKEN}")
        said = refused("and among them", local_pages.token_of_file, path)
        assert repr(letter) in said and TOKEN not in said
        refused("letters", Door, token=f"{TOKEN}{letter}{TOKEN}")
    refused("at least 16", Door, token="short")
    assert len({local_pages.new_token() for _ in range(8)}) == 8


def test_a_token_file_that_never_ends_is_refused(tmp_path: Path) -> None:
    pipe = tmp_path / "pipe"
    os.mkfifo(pipe, 0o600)
    for path in (pipe, Path("/dev/zero"), tmp_path):
        refused("no regular file", local_pages.token_of_file, path)


def test_an_unregistered_session_is_refused(store: SessionStore, tmp_path: Path) -> None:
    bare = SessionStore.create(tmp_path / "s", replace(store.session, views=()))
    refused(r"scene\.json", ReviewServer, bare)


def test_the_first_scene_is_read_before_any_browser_comes(server: ReviewServer) -> None:
    server._reader.join(60)  # type: ignore[reportPrivateUsage]
    assert server.sessions[0]._content is not None  # type: ignore[reportPrivateUsage]
