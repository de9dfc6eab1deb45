"""Who may open a replay: this machine only, unless somebody says otherwise.

Viser has no login: whoever reaches its websocket sees everything and can press every button.
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


def is_local(host: str) -> bool:
    """Return whether only this machine can reach a server on that host."""
    with contextlib.suppress(ValueError):
        return ipaddress.ip_address(host).is_loopback
    return host == "localhost"


def check_host(host: str, allow_remote: bool) -> str:
    """Return the host to listen on.

    Raises:
        InputError: other machines could reach it, and that was not asked for.
    """
    if allow_remote or is_local(host):
        return host
    raise InputError(
        f"the replay may not listen on '{host}': it has no login, so anybody who reaches it could "
        "watch and steer it. Use 127.0.0.1, ::1 or localhost; from another machine, forward the "
        "port (ssh -L 8080:127.0.0.1:8080 THIS_MACHINE), write a file with write_replay, or allow "
        "it explicitly with allow_remote."
    )


@contextlib.contextmanager
def origins_of(host: str) -> Generator[None]:
    """Make websocket servers started in this block refuse pages that another site serves.

    Viser checks no Origin and offers no setting for it, but the websockets library it calls does.
    A host that other machines may reach has origins that are not known here: nothing is refused.
    """
    from websockets.asyncio import server

    module: Any = server
    if not is_local(host):
        yield
        return
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
