"""What stands on a page, from top to bottom, and its bytes."""

import json
import re
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from functools import cache
from typing import Any

from jinja2 import Environment, PackageLoader, StrictUndefined, Template, pass_context
from jinja2.runtime import Context
from markupsafe import Markup

from realsim import __version__
from realsim.errors import InputError
from realsim.pages.pictures import Gallery, Picture, Shown, View, fit, shown

ABSOLUTE = re.compile(r"(?<![\w.:/<])(?:[A-Za-z]:\\|/)(?:[\w.@+~-]+[\\/])+([\w.@+~-]*)")
"""A path from the root of a machine; its last part is group 1."""
BUDGET_BYTES = 15_000_000
"""Largest page: a browser opens it at once, and mail servers let it pass."""
MARKUP_BYTES = 250_000
"""Bytes of the budget kept for the text of the page."""
PLOT_PX = 530
"""Width of a plot: two stand side by side."""
VERDICT_KIND = {"accepted": "good", "doubtful": "warn", "rejected": "bad", "unchecked": "off"}
"""Verdict on an object -> kind of its cell and banner."""


@dataclass(frozen=True, slots=True)
class Cell:
    """A cell of a table that is more than text."""

    text: str
    kind: str = ""
    """good, warn, bad, off: a coloured word; num: not broken into lines."""
    hover: str = ""
    """Explanation, shown when the pointer rests on it."""
    note: str = ""
    """Mark of a footnote, such as 1."""
    href: str = ""
    """Anchor on the same page, or with a slash a page beside it."""
    color: tuple[int, int, int] | None = None
    """RGB of a chip before the text: the object's colour in the pictures."""

    def __str__(self) -> str:
        """Return the text alone."""
        return self.text


def counted(n: int, what: str) -> str:
    """Return a number of things in words: 1 view, 2 views."""
    return f"{n} {what}" if n == 1 else f"{n} {what}s"


def _cells(row: Sequence[object]) -> list[Cell]:
    return [c if isinstance(c, Cell) else Cell(str(c)) for c in row]


@dataclass(eq=False, kw_only=True, slots=True)
class Page:
    """A page while it is being written; see `realsim.pages`."""

    title: str = ""
    about: str = ""
    """One line under the title."""
    hidden: dict[str, str] = field(default_factory=dict[str, str])
    """Text that must not appear on the page -> what stands there instead."""
    parts: list[dict[str, Any]] = field(default_factory=list[dict[str, Any]])
    """Kind and content of everything on it, for the template."""
    document: Any = None
    """Plain JSON values that programs find in the page; None = none."""

    def plain(self, value: object) -> str:
        """Return a text without paths of this machine."""
        text = str(value)
        for secret, instead in self.hidden.items():
            text = text.replace(secret, instead)
        return ABSOLUTE.sub(r"\1", text)

    def _add(self, part: str, **content: Any) -> None:
        self.parts.append({"part": part, **content})

    def verdict(
        self, kind: str, title: str, text: str = "", rows: Sequence[Sequence[object]] = ()
    ) -> None:
        """Add a banner.

        Args:
            kind: good, warn, bad or off.
            title: in bold.
            text: behind it.
            rows: list under it; each of texts and cells.
        """
        self._add("verdict", kind=kind, title=title, text=text, rows=[_cells(r) for r in rows])

    def cards(self, figures: Sequence[tuple[str, str]]) -> None:
        """Add lead figures: value and what it is."""
        self._add("cards", figures=figures)

    def lead(
        self, picture: Picture | None, caption: str, figures: Sequence[tuple[str, str]]
    ) -> None:
        """Add what is seen first: one picture, with the figures that matter beside it.

        Args:
            picture: the picture; None = there is none.
            caption: under it.
            figures: value and what it is.
        """
        made = [] if picture is None else [shown(picture, caption)]
        self._add("lead", pictures=made, figures=figures)

    def section(self, title: str, text: str = "", key: str = "", *, folded: str = "") -> None:
        """Begin a section.

        Args:
            title: of the section.
            text: its first paragraph.
            key: its anchor.
            folded: what is said beside the title of a section that opens when it is asked for; '' =
                it is open.
        """
        self._add("section", title=title, key=key, folded=folded)
        if text:
            self.text(text)

    def heading(self, title: str) -> None:
        """Begin a part of a section."""
        self._add("heading", title=title)

    def text(self, text: str, kind: str = "") -> None:
        """Add a paragraph; kind: note (a warning), foot, missing, or none."""
        self._add("text", text=text, kind=kind)

    def code(self, text: str) -> None:
        """Add text as it is, to be copied."""
        self._add("code", text=text)

    def table(
        self,
        header: Sequence[object],
        rows: Iterable[Sequence[object]],
        *,
        colors: Sequence[tuple[int, int, int]] | None = None,
        folded: str = "",
    ) -> None:
        """Add a table; it scrolls by itself where it is wider than the page.

        Args:
            header: texts or cells.
            rows: of texts and cells.
            colors: of every row's object in the pictures, shown as a chip.
            folded: title of a table that opens when it is asked for.

        Raises:
            InputError: a row of another length than the header, or another number of colours.
        """
        body = [_cells(row) for row in rows]
        for k, row in enumerate(body):
            if len(row) != len(header):
                raise InputError(
                    f"a table: row {k} has {len(row)} cells and the header {len(header)}."
                )
        if colors is not None:
            if len(colors) != len(body):
                raise InputError(f"a table has {len(body)} rows and {len(colors)} colours.")
            for row, color in zip(body, colors, strict=True):
                row[0] = replace(row[0], color=color)
        self._add("table", header=_cells(header), rows=body, folded=folded)

    def picture(self, picture: Picture, caption: str) -> None:
        """Add a picture, unless it stands on the page already."""
        self.pictures([(picture, caption)], kind="")

    def pictures(
        self, pictures: Sequence[tuple[Picture, str]], *, width_px: int = 0, kind: str = "pictures"
    ) -> None:
        """Add pictures with captions, side by side where the page is wide enough."""
        made = [shown(p, caption) for p, caption in pictures]
        if made:
            self._add("pictures", pictures=made, width_px=width_px, kind=kind)

    def plots(self, plots: Sequence[tuple[bytes, str]]) -> None:
        """Add plots (PNG and caption) side by side where the page is wide enough."""
        self.pictures(plots, width_px=PLOT_PX, kind="plots")

    def videos(self, videos: Sequence[tuple[str, Picture]]) -> None:
        """Add videos that lie beside the page: address, and what is shown before it is played."""
        made = [(address, shown(poster, "")) for address, poster in videos]
        self._add("videos", videos=made)

    def sliders(self, views: Sequence[View]) -> None:
        """Add views of two pictures each under a slider."""
        self._gallery("sliders", views)

    def layers(self, views: Sequence[View]) -> None:
        """Add views in layers, of which one is shown at a time."""
        self._gallery("layers", views)

    def sheet(self, views: Sequence[View]) -> None:
        """Add a contact sheet of views of one picture each; a picture opens large."""
        self._gallery("sheet", views)

    def _gallery(self, kind: str, views: Sequence[View]) -> None:
        titles = [p["title"] for p in self.parts if p["part"] == "section"]
        title = titles[-1] if titles else self.title
        self._add("gallery", gallery=Gallery(kind=kind, title=title, views=views))

    @property
    def shown(self) -> dict[str, tuple[int, int]]:
        """Return title of the section -> views shown, views there are; after `encode`."""
        return {g.title: (len(g.kept), len(g.views)) for g in self._galleries()}

    def _galleries(self) -> list[Gallery]:
        return [p["gallery"] for p in self.parts if p["part"] == "gallery"]

    def encode(self, budget_bytes: float = BUDGET_BYTES) -> bytes:
        """Return the page.

        Args:
            budget_bytes: its largest size, of a page with sliders, layers or sheets.

        Raises:
            InputError: a gallery without pictures, pictures under a slider that differ in size,
                or a budget that does not hold one view of every gallery.
        """
        galleries = self._galleries()
        parts = list(_once(self.parts))
        fixed = sum(len(s.src) for p in parts for s in p.get("pictures", ()))
        fit(galleries, budget_bytes - MARKUP_BYTES - fixed, self.title)
        # "</" would end the script, "<!--" would begin a comment in it.
        document = json.dumps(self.document, allow_nan=False).replace("<", "\\u003c")
        text = template("page.html").render(
            page=self, parts=parts, version=__version__,
            document=Markup(document) if self.document else None,
        )  # fmt: skip
        data = text.encode("utf-8")
        if galleries and len(data) > budget_bytes:
            raise InputError(
                f"the page '{self.title}' would have {len(data) / 1e6:.1f} MB and "
                f"{budget_bytes / 1e6:.1f} MB are allowed: its tables and captions are too long. "
                "Split it."
            )
        return data


def _once(parts: Sequence[dict[str, Any]]) -> Iterator[dict[str, Any]]:
    """Return the parts without pictures that stand further up already."""
    seen: set[str] = set()
    for part in parts:
        new: list[Shown] = [p for p in part.get("pictures", ()) if p.src not in seen]
        seen |= {p.src for p in new}
        yield part | {"pictures": new}


@pass_context
def _without_paths(context: Context, value: Any) -> Any:
    return context["page"].plain(value) if type(value) is str else value


@cache
def template(name: str, package: str = "realsim.pages") -> Template:
    """Return a template in which every text is escaped and, as on its `page`, loses private paths.

    Args:
        name: of the template's file; it is rendered with a `page`, whose rules on text hold.
        package: that the file lies in.
    """
    return Environment(
        loader=PackageLoader(package, ""), autoescape=True, undefined=StrictUndefined,
        trim_blocks=True, lstrip_blocks=True, keep_trailing_newline=True, finalize=_without_paths,
    ).get_template(name)  # fmt: skip
