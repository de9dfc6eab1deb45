"""The body of a page while it is being written: headings, tables, pictures, all of it escaped.

Nothing on a page names a folder of the machine that made it, and a picture stands on it once.
"""

import base64
import hashlib
import html
import re
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from realsim.errors import InputError

ABSOLUTE = re.compile(r"(?<![\w.:/<])(?:[A-Za-z]:\\|/)(?:[\w.@+~-]+[\\/])+([\w.@+~-]*)")
"""A path from the root of a machine; its last part is group 1."""
JPEG_QUALITY = 84
"""Outlines two pixels wide stay clean."""


@dataclass(frozen=True, kw_only=True, slots=True)
class Cell:
    """A cell of a table that is more than text."""

    text: str
    kind: str = ""
    """CSS class: good, warn, bad, off or num."""
    hover: str = ""
    """Explanation, shown when the pointer rests on it."""
    note: str = ""
    """Mark of a footnote, such as 1."""
    href: str = ""
    """Anchor on the same page."""

    def __str__(self) -> str:
        """Return the text alone."""
        return self.text


@dataclass(eq=False, kw_only=True, slots=True)
class Page:
    """The body of a page."""

    parts: list[str] = field(default_factory=list[str])
    hidden: dict[str, str] = field(default_factory=dict[str, str])
    """Text that must not appear on the page -> what stands there instead."""
    seen: set[str] = field(default_factory=set[str])
    """Digests of the pictures that stand on the page."""

    def plain(self, value: object) -> str:
        """Return a text without paths of this machine."""
        text = str(value)
        for secret, instead in self.hidden.items():
            text = text.replace(secret, instead)
        return ABSOLUTE.sub(r"\1", text)

    def escaped(self, value: object) -> str:
        """Return a text as it may stand on the page."""
        return html.escape(self.plain(value))

    def section(self, title: str, text: str = "", key: str = "") -> None:
        """Begin a section."""
        anchor = f' id="{html.escape(key)}"' if key else ""
        self.parts.append(f"<h2{anchor}>{self.escaped(title)}</h2>")
        if text:
            self.text(text)

    def heading(self, title: str) -> None:
        """Begin a part of a section."""
        self.parts.append(f"<h3>{self.escaped(title)}</h3>")

    def text(self, text: str, kind: str = "") -> None:
        """Add a paragraph."""
        css = f' class="{kind}"' if kind else ""
        self.parts.append(f"<p{css}>{self.escaped(text)}</p>")

    def table(self, header: Sequence[object], rows: Sequence[Sequence[object]]) -> None:
        """Add a table; it scrolls by itself where it is wider than the page."""
        head = "".join(self._cell(h, "th") for h in header)
        body = "".join("<tr>" + "".join(self._cell(c, "td") for c in row) + "</tr>" for row in rows)
        self.parts.append(f'<div class="scroll"><table><tr>{head}</tr>{body}</table></div>')

    def _cell(self, value: object, tag: str) -> str:
        if not isinstance(value, Cell):
            return f"<{tag}>{self.escaped(value)}</{tag}>"
        inner = self.escaped(value.text)
        if value.kind in ("good", "warn", "bad", "off"):
            inner = f'<span class="tag {value.kind}">{inner}</span>'
        if value.hover:
            inner = f'<abbr title="{self.escaped(value.hover)}">{inner}</abbr>'
        if value.href:
            inner = f'<a href="#{html.escape(value.href)}">{inner}</a>'
        if value.note:
            inner += f"<sup>{self.escaped(value.note)}</sup>"
        css = ' class="num"' if value.kind == "num" else ""
        return f"<{tag}{css}>{inner}</{tag}>"

    def folded(
        self, title: str, header: Sequence[object], rows: Sequence[Sequence[object]]
    ) -> None:
        """Add a long table that opens when it is asked for."""
        self.parts.append(f"<details><summary>{self.escaped(title)}</summary>")
        self.table(header, rows)
        self.parts.append("</details>")

    def picture(self, path: Path, caption: str) -> None:
        """Add a picture of a file, inside the page itself."""
        self.image(path.read_bytes(), caption)

    def image(self, data: bytes, caption: str, width_px: int = 0, kind: str = "") -> None:
        """Add an encoded picture (PNG or JPEG), unless it stands on the page already.

        Args:
            data: the file's bytes.
            caption: what it shows.
            width_px: at which it is drawn; 0 = its own, as far as the page is wide.
            kind: CSS class of the figure.
        """
        digest = hashlib.sha256(data).hexdigest()
        if digest in self.seen:
            return
        self.seen.add(digest)
        form = "jpeg" if data[:2] == b"\xff\xd8" else "png"
        text = self.escaped(caption)
        width = f' width="{width_px}"' if width_px else ""
        css = f' class="{kind}"' if kind else ""
        code = base64.b64encode(data).decode()
        self.parts.append(
            f'<figure{css}><img{width} src="data:image/{form};base64,{code}" alt="{text}">'
            f"<figcaption>{text}</figcaption></figure>"
        )

    def plots(self, plots: Sequence[tuple[bytes, str]], width_px: int) -> None:
        """Add plots side by side where the page is wide enough.

        Args:
            plots: PNG and caption of each.
            width_px: width of one.
        """
        if plots:
            self.parts.append('<div class="plots">')
            for data, caption in plots:
                self.image(data, caption, width_px)
            self.parts.append("</div>")


def jpeg_bytes(rgb: NDArray[np.uint8], quality: int = JPEG_QUALITY) -> bytes:
    """Return a picture (H, W, 3) as JPEG.

    Raises:
        InputError: it cannot be encoded.
    """
    import cv2

    flags = [cv2.IMWRITE_JPEG_QUALITY, quality]
    ok, data = cv2.imencode(".jpg", np.ascontiguousarray(rgb[..., ::-1]), flags)
    if not ok:
        raise InputError(f"a picture of shape {rgb.shape} cannot be encoded as JPEG.")
    return np.asarray(data).tobytes()
