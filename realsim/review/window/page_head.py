"""What the review adds to the page that viser serves: title, icon, style, scripts, answers."""

import asyncio
import contextlib
import re
from collections.abc import Callable, Generator
from functools import cache
from importlib.resources import files
from typing import Any

TITLE = "realsim review"
ASKED = "/photograph/"
"""What the page's script asks for begins so."""
SOON_S, MOST_PENDING = 4.0, 32
"""A request lasts at most 10 s: what takes longer than this is said to be asked for again [s]; and
how many answers wait to be fetched."""
Ask = Callable[[str], tuple[str, bytes]]
ICON = (
    "data:image/svg+xml,%3Csvg xmlns='http://www.w3.org/2000/svg' viewBox='0 0 32 32'%3E"
    "%3Crect width='32' height='32' rx='7' fill='%23143d59'/%3E"
    "%3Cpath d='M16 5 26 10.5v11L16 27 6 21.5v-11z' fill='none' stroke='%23f4b41a' "
    "stroke-width='2.4' stroke-linejoin='round'/%3E"
    "%3Cpath d='m11 16 4 4 7-8' fill='none' stroke='%23fff' stroke-width='2.8'/%3E%3C/svg%3E"
)
"""A box with its outline and a check mark."""


def dressed(html: bytes) -> bytes:
    """Return viser's page with the review's title, icon, style and script."""
    text = html.decode()
    text = re.sub(r"<title>.*?</title>", f"<title>{TITLE}</title>", text, count=1)
    text = re.sub(
        r'<link\s+rel="icon"\s+href="[^"]*"', f'<link rel="icon" href="{ICON}"', text, count=1
    )
    return text.replace("</title>", "</title>" + _head(), 1).encode()


@cache
def _head() -> str:
    folder = files("realsim.review.window")
    names = ("page.css", "page.js", "photograph.js")
    style, *scripts = (folder.joinpath(name).read_text("utf-8") for name in names)
    return "\n".join([f"\n<style>{style}</style>", *(f"<script>{s}</script>" for s in scripts)])


@contextlib.contextmanager
def answering(ask: Ask) -> Generator[None]:
    """Answer what the page asks for, of servers that are started inside this block.

    To be entered before `local_pages.guarded`: what its door refuses is not asked.

    Args:
        ask: path -> media type and content; called in a thread of its own.
    """
    from websockets.asyncio import server

    module: Any = server
    serve = module.serve
    pending: dict[str, asyncio.Future[tuple[str, bytes]]] = {}

    async def found(path: str) -> tuple[str, bytes]:
        task = pending.get(path)
        if task is None:
            task = pending[path] = asyncio.ensure_future(asyncio.to_thread(ask, path))
            if len(pending) > MOST_PENDING:
                del pending[next(iter(pending))]
        if not (await asyncio.wait([task], timeout=SOON_S))[0]:
            return "application/json", b'{"wait": true}'
        pending.pop(path, None)
        return task.result()

    def answered(*args: Any, **kwargs: Any) -> Any:
        inner = kwargs.pop("process_request")

        async def process_request(connection: Any, request: Any) -> Any:
            response = await inner(connection, request)
            if request.path.startswith(ASKED) and getattr(response, "status_code", 0) == 404:
                kind, response.body = await found(request.path)
                response.status_code, response.reason_phrase = 200, "OK"
                response.headers.pop("Content-Length", None)
                response.headers["Content-Type"] = kind
                response.headers["Content-Length"] = str(len(response.body))
            return response

        return serve(*args, process_request=process_request, **kwargs)

    module.serve = answered
    try:
        yield
    finally:
        module.serve = serve
