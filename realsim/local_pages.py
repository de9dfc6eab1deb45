"""Pages in the browser for this machine only: who may look and press buttons.

Viser has no login: whoever can open its websocket sees the scene and can press every button. So
the server listens on the loopback interface, refuses websockets that a foreign web page opened in
the operator's own browser (their Origin tells), and cannot be asked for a public tunnel.
"""

import contextlib
import ipaddress
import re
import threading
from collections.abc import Generator
from functools import partial
from typing import Any

from realsim.errors import InputError

LOCAL_ORIGIN = re.compile(r"https?://(localhost|127(\.\d{1,3}){3}|\[::1\])(:\d{1,5})?")
"""The pages that this machine itself serves."""
_patching = threading.Lock()


def check_host(host: str, what: str) -> str:
    """Return the host to bind, which must be of the loopback interface.

    Args:
        host: the host that was asked for.
        what: what is to be served, for the message: "the review".

    Raises:
        InputError: other machines could reach it.
    """
    if host == "localhost":
        return host
    with contextlib.suppress(ValueError):
        if ipaddress.ip_address(host).is_loopback:
            return host
    raise InputError(
        f"{what} may not listen on '{host}': it has no login, so anybody who reaches it could "
        "watch it and press its buttons. Use 127.0.0.1, ::1 or localhost; from "
        "another machine, forward the port: ssh -L 8080:127.0.0.1:8080 THIS_MACHINE."
    )


@contextlib.contextmanager
def local_origins_only() -> Generator[None]:
    """Make websocket servers started inside this block refuse pages of other origins.

    Viser checks no Origin and offers no setting for it, but the websockets library it calls does;
    so the check is put into that call. Programs that are no browsers send no Origin and may enter:
    they run on this machine, and could read the files as well.
    """
    from websockets.asyncio import server

    module: Any = server
    with _patching:
        serve = module.serve
        module.serve = partial(serve, origins=[None, LOCAL_ORIGIN])
        try:
            yield
        finally:
            module.serve = serve


def refuse_share(server: Any) -> None:
    """Make a viser server deaf to its clients' requests for a public tunnel.

    Hiding the button is not enough: any client can send the message.
    """
    from viser import _messages as viser_messages

    server._websock_server.unregister_handler(viser_messages.ShareUrlRequest)
