"""The review's own title, icon, style and script, put into the page that viser serves."""

import re
from functools import cache
from importlib.resources import files

TITLE = "realsim review"
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
    style, script = (folder.joinpath(f"page.{kind}").read_text("utf-8") for kind in ("css", "js"))
    return f"\n<style>{style}</style>\n<script>{script}</script>"
