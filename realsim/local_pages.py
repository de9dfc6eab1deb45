"""Pages in the browser: who may look and press buttons.

Viser has no login: whoever can open its websocket sees the scene and can press every button. So a
door stands before it, and asks of every request, the page's as well as the websocket's:

- Host: the browser meant this machine. A name of somebody else's that was made to point here (DNS
  rebinding) would let a foreign page pass for ours.
- Origin: the websocket is opened by the page that was served here, not by another page in the
  reviewer's browser.
- Token: where other machines can reach the port, a secret that was printed on the terminal. It
  comes in the address once and stays as a cookie that no script can read.

Nothing is encrypted; over a network that is not one's own, forward the port with ssh instead.
"""

import contextlib
import gzip
import hmac
import http
import inspect
import ipaddress
import logging
import re
import secrets
import socket
import stat
import threading
from collections.abc import Callable, Generator, Mapping, Sequence
from dataclasses import dataclass
from functools import cache, partial
from pathlib import Path
from typing import Any
from urllib.parse import parse_qs

from realsim.errors import InputError

LEAST_TOKEN = 16
"""Characters of a token from a file: 16 of letters and digits are beyond guessing."""
PORTS_TRIED = 20
"""How many ports after the wished one are tried."""
COOKIE_AGE_S = 14 * 24 * 3600
"""How long a browser that was let in stays so [s]: two weeks, the length of a review."""
MOST_TOKEN_BYTES = 4096
"""A token file is no longer: who names a photograph by mistake is told so at once."""
TOKEN_LETTERS = re.compile(r"[A-Za-z0-9_-]*")
"""What an address takes as it is: of any other letter, browsers and people make something else."""
AUTHORITY = re.compile(r"(?:\[([0-9a-f:.]+)\]|([a-z0-9._-]+))(?::([0-9]{1,5}))?", re.IGNORECASE)
"""What a Host header may be, for it is copied into the page's policy: an IPv6 address in brackets,
or a name or IPv4 address; and a port."""
MOST_FRAME_BYTES = 1_000_000
"""A message from a browser is no longer: the page sends clicks, values and short texts."""
_patching = threading.Lock()
log = logging.getLogger(__name__)
_sockets_log = logging.getLogger(f"{__name__}.sockets")
"""Log of the websocket servers behind a door."""


@dataclass(frozen=True, kw_only=True, slots=True)
class Door:
    """Who may enter."""

    token: str = ""
    """The secret; '' = none is asked for: only this machine can reach the port."""
    names: tuple[str, ...] = ()
    """Names of this machine that a browser may have been given, besides its addresses."""

    def __post_init__(self) -> None:
        """Check the token.

        Raises:
            InputError: it is too short, or holds what an address does not take as it is.
        """
        if self.token:
            _check_token(self.token, "the token")

    @property
    def pass_value(self) -> str:
        """What the cookie holds: it lets in, and does not tell the token."""
        return hmac.new(self.token.encode(), b"realsim page cookie", "sha256").hexdigest()


@dataclass(frozen=True, kw_only=True, slots=True)
class Answer:
    """What the door says instead of the page."""

    status: http.HTTPStatus
    text: str
    cookie: str = ""


def is_loopback(host: str) -> bool:
    """Return whether only this machine reaches what listens on this host."""
    if host == "localhost":
        return True
    with contextlib.suppress(ValueError):
        return ipaddress.ip_address(host).is_loopback
    return False


def check_host(host: str, what: str) -> str:
    """Return the host to bind, which must be of the loopback interface.

    Args:
        host: the host that was asked for.
        what: what is to be served, for the message: "the review".

    Raises:
        InputError: other machines could reach it.
    """
    if is_loopback(host):
        return host
    raise InputError(
        f"{what} may not listen on '{host}': it has no login, so anybody who reaches it could "
        "watch it and press its buttons. Use 127.0.0.1, ::1 or localhost; from "
        "another machine, forward the port: ssh -L 8080:127.0.0.1:8080 THIS_MACHINE."
    )


def new_token() -> str:
    """Return a secret of 256 bits for an address."""
    return secrets.token_urlsafe(32)


def token_of_file(path: Path) -> str:
    """Return the token in a file: its one line.

    Raises:
        InputError: there is no such file, others may read it, or it holds no good token.
    """
    try:
        mode = path.stat().st_mode
        if not stat.S_ISREG(mode):
            raise InputError(
                f"the token file {path} is no regular file (mode {stat.filemode(mode)}); a pipe or "
                "a device may never end. Write the token into a file that only you can read."
            )
        with path.open("rb") as file:
            text = file.read(MOST_TOKEN_BYTES).decode().strip()
    except (OSError, ValueError) as error:
        raise InputError(f"the token file {path} cannot be read: {error}.") from error
    if mode & (stat.S_IRWXG | stat.S_IRWXO):
        raise InputError(
            f"the token file {path} may be read by others (mode {stat.filemode(mode)}): "
            f"chmod 600 {path}."
        )
    _check_token(text, f"the token file {path}")
    return text


def _check_token(text: str, what: str) -> None:
    """Raise if a token can be guessed, or would not stay what it is in an address."""
    foreign = sorted({c for c in text if not TOKEN_LETTERS.fullmatch(c)})
    if len(text) >= LEAST_TOKEN and not foreign:
        return
    found = f"{len(text)} characters"
    if foreign:
        found += f", and among them {' '.join(repr(c) for c in foreign[:8])}"
    raise InputError(
        f"{what} must hold one line of at least {LEAST_TOKEN} letters (a to z, A to Z), digits, "
        f"'-' and '_', and nothing else; it holds {found}. Leave --token-file out, and a token is "
        "made."
    )


def names_of_this_machine(host: str) -> tuple[str, ...]:
    """Return the names by which other machines may call this one, and the host to bind."""
    full = socket.gethostname()
    short = full.split(".")[0]
    return tuple(dict.fromkeys(n.lower() for n in (host, full, short, f"{short}.local") if n))


def free_port(host: str, port: int) -> int:
    """Return the first port from the wished one on that can be listened on; 0 stays 0.

    Raises:
        InputError: the host is none of this machine, or the ports are all in use.
    """
    last: OSError | ValueError | None = None
    for wished in range(port, min(port + PORTS_TRIED, 65536)):
        try:
            found = socket.getaddrinfo(host, wished, type=socket.SOCK_STREAM)
            family, kind, protocol, _, address = found[0]
            with socket.socket(family, kind, protocol) as probe:
                probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
                probe.bind(address)
            return wished
        except (socket.gaierror, ValueError) as error:  # ValueError: no name of the internet's
            last = error
            break
        except OSError as error:
            last = error
    name = host if len(host) <= 80 else f"{host[:60]}... ({len(host)} characters)"
    raise InputError(
        f"cannot listen on '{name}', port {port}: {last}. Give --host 127.0.0.1 or an address of "
        "this machine, and another --port (0 = any that is free)."
    )


def answer_to(door: Door, path: str, headers: Any) -> Answer | None:
    """Return what is said instead of the page or the websocket, or None: come in.

    Args:
        door: who may enter.
        path: of the request, with its query.
        headers: of the request, `get_all(name)` -> list of values.
    """
    authority = _only(headers, "Host")
    if authority is None or not _is_ours(authority, door):
        return Answer(
            status=http.HTTPStatus.FORBIDDEN,
            text="This page was asked for under a name that is not this machine's. Open the "
            "address that the terminal shows.",
        )
    origin = _only(headers, "Origin")
    if headers.get_all("Origin") and (origin is None or not _same_place(origin, authority)):
        return Answer(status=http.HTTPStatus.FORBIDDEN, text="Not from a page of another site.")
    if not path.startswith("/") or path.startswith("//"):
        return Answer(status=http.HTTPStatus.BAD_REQUEST, text="This is no address of the page.")
    query = parse_qs(path.partition("?")[2], keep_blank_values=True)
    # Viser's page takes orders from its address, such as which server's messages it shows.
    if set(query) - {"token"}:
        return Answer(
            status=http.HTTPStatus.FORBIDDEN, text="The address has more in it than the page's."
        )
    return _answer_about_token(door, query.get("token", []), authority, headers)


def _answer_about_token(
    door: Door, tokens: Sequence[str], authority: str, headers: Any
) -> Answer | None:
    if not door.token:
        return None
    cookie_name = f"realsim_{_port_of(authority)}"
    if tokens and not _upgrades(headers):
        if _is_same(tokens[0], door.token):
            value = f"{cookie_name}={door.pass_value}; Path=/; Max-Age={COOKIE_AGE_S}"
            return Answer(
                status=http.HTTPStatus.OK, text="", cookie=f"{value}; HttpOnly; SameSite=Strict"
            )
    elif _is_same(_cookie(headers, cookie_name), door.pass_value):
        return None
    return Answer(
        status=http.HTTPStatus.UNAUTHORIZED,
        text="Not without the token: open the whole address that the terminal shows, with what "
        "stands behind '?token='.",
    )


def _is_same(given: str, secret: str) -> bool:
    """Compare in a time that does not tell where they differ; any bytes may have been given."""
    return hmac.compare_digest(given.encode(errors="surrogatepass"), secret.encode())


def _only(headers: Any, name: str) -> str | None:
    """Return the one value of a header; None if there is none, or several."""
    values: list[str] = headers.get_all(name)
    return values[0] if len(values) == 1 else None


def _upgrades(headers: Any) -> bool:
    return any("websocket" in v.lower() for v in headers.get_all("Upgrade"))


def _split_authority(authority: str) -> tuple[str, str]:
    """Return name and port of a Host header; the name is '' where it is none."""
    found = AUTHORITY.fullmatch(authority)
    if found is None or int(found[3] or 80) > 65535:
        return "", ""
    return (found[1] or found[2]).lower(), str(int(found[3] or 80))


def _port_of(authority: str) -> str:
    return _split_authority(authority)[1]


def _is_ours(authority: str, door: Door) -> bool:
    """Return whether a Host header names this machine: no foreign name can be made to do so."""
    name, _ = _split_authority(authority)
    if is_loopback(name):
        return True
    if not door.names:
        return False
    with contextlib.suppress(ValueError):
        ipaddress.ip_address(name)
        return True  # an address is no name that somebody could point elsewhere
    return name in door.names


def _same_place(origin: str, authority: str) -> bool:
    scheme, _, place = origin.partition("://")
    return scheme in ("http", "https") and place.lower() == authority.lower()


def _cookie(headers: Any, name: str) -> str:
    for line in headers.get_all("Cookie"):
        for pair in line.split(";"):
            key, _, value = pair.strip().partition("=")
            if key == name:
                return value
    return ""


PRIVATE = {"Referrer-Policy": "no-referrer", "X-Content-Type-Options": "nosniff"}
"""Headers of every answer."""
WELCOME = (
    "<!doctype html><meta charset=utf-8><title>realsim</title>"
    '<script>location.replace("/" + location.hash)</script>'
    '<noscript><meta http-equiv="refresh" content="0; url=/"></noscript>'
    '<p><a href="/">Go on</a></p>'
)
"""A page of our own goes on to the review: the browser gives a strict cookie only to such."""


@contextlib.contextmanager
def guarded(door: Door, dress: Callable[[bytes], bytes] | None = None) -> Generator[None]:
    """Put a door before the websocket servers that are started inside this block.

    Args:
        door: who may enter.
        dress: makes the HTML page that is served out of the library's; None = it stays as it is.

    Viser checks nothing, but the websockets library that it calls asks a function about every
    request; the door is put before that function.
    """
    from websockets.asyncio import server

    module: Any = server
    with _patching:
        serve = module.serve
        module.serve = partial(_serve_behind, door, None if dress is None else cache(dress), serve)
        try:
            yield
        finally:
            module.serve = serve


def _serve_behind(
    door: Door, dress: Callable[[bytes], bytes] | None, serve: Any, *args: Any, **kwargs: Any
) -> Any:
    inner = kwargs.pop("process_request", None)

    async def process_request(connection: Any, request: Any) -> Any:
        try:
            said = answer_to(door, request.path, request.headers)
            if said is not None:
                return _response(said)
            response = None if inner is None else inner(connection, request)
            if inspect.isawaitable(response):
                response = await response
        except Exception as error:
            # Anybody can send any bytes: what nobody understands is refused, and fills no terminal.
            log.debug("a request was refused: %r", error)
            said = Answer(status=http.HTTPStatus.BAD_REQUEST, text="This was not understood.")
            return _response(said)
        if response is not None:
            kind = response.headers.get("Content-Type", "")
            if dress is not None and kind.startswith("text/html"):
                _dressed(response, dress)
            response.headers.update(_page_headers(request.headers["Host"]))
        return response

    kwargs |= {"logger": _sockets_log, "max_size": MOST_FRAME_BYTES}
    return serve(*args, process_request=process_request, **kwargs)


def _dressed(response: Any, dress: Callable[[bytes], bytes]) -> None:
    """Change the page of a response, whether it is compressed or not."""
    is_packed = response.headers.get("Content-Encoding") == "gzip"
    page = dress(gzip.decompress(response.body) if is_packed else response.body)
    response.body = gzip.compress(page, mtime=0) if is_packed else page
    del response.headers["Content-Length"]
    response.headers["Content-Length"] = str(len(response.body))


def _without_tracebacks(record: logging.LogRecord) -> bool:
    """Keep tracebacks of what strangers send, such as port scanners, off the terminal."""
    said = record.getMessage()
    error = record.exc_info[1] if record.exc_info else None
    left = said == "unexpected internal error" and isinstance(error, AssertionError)
    if said == "opening handshake failed" or left:  # left before it was answered
        log.debug("a connection ended before it was open: %s", error)
    elif said == "connection handler failed":
        _not_understood(None, {"exception": error})
    else:
        return True
    return False


def _not_understood(_loop: object, context: Mapping[str, Any]) -> None:
    """Log in one line that a browser sent what is no message of the page."""
    if error := context.get("exception"):
        log.warning("a message from a browser was not understood: %.200r", error)
    log.debug("the server's loop tells: %s", context.get("message"), exc_info=error)


_sockets_log.addFilter(_without_tracebacks)


def _response(said: Answer) -> Any:
    from websockets import Headers
    from websockets.http11 import Response

    body = WELCOME if said.cookie else said.text + "\n"
    kind = "text/html" if said.cookie else "text/plain"
    headers = Headers()
    headers["Content-Type"] = f"{kind}; charset=utf-8"
    headers["Content-Length"] = str(len(body.encode()))
    headers["Cache-Control"] = "no-store"
    for name, value in PRIVATE.items():
        headers[name] = value
    if said.cookie:
        headers["Set-Cookie"] = said.cookie
    return Response(said.status.value, said.status.phrase, headers, body.encode())


def _page_headers(authority: str) -> dict[str, str]:
    """Return what the page may do: talk to this server only, and stand in no other page's frame."""
    rules = (
        "default-src 'none'; script-src 'self' 'unsafe-inline' 'unsafe-eval' blob: data:; "
        "worker-src 'self' blob: data:; style-src 'self' 'unsafe-inline'; "
        "img-src 'self' data: blob:; font-src 'self' data:; "
        f"connect-src 'self' ws://{authority} wss://{authority} data: blob:; "
        "frame-ancestors 'none'; base-uri 'none'; form-action 'none'"
    )
    return {"Content-Security-Policy": rules, "Cache-Control": "no-cache", **PRIVATE}


def refuse_foreign_messages(server: Any) -> None:
    """Make a viser server deaf to what the page never sends: public tunnels and uploads.

    Hiding a button is not enough: any client can send the message.
    """
    from viser import _messages as viser_messages

    sockets = server._websock_server
    for message in (viser_messages.ShareUrlRequest, viser_messages.ShareUrlDisconnect):
        sockets.unregister_handler(message)
    refuse_uploads(sockets)
    loop = server.get_event_loop()
    loop.call_soon_threadsafe(loop.set_exception_handler, _not_understood)


def refuse_uploads(wire: Any) -> None:
    """Make one end of a viser connection deaf to files, which would fill the memory."""
    from viser import _messages as viser_messages

    for message in (viser_messages.FileTransferStartUpload, viser_messages.FileTransferPart):
        wire.unregister_handler(message)
