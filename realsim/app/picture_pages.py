"""Pages of pictures in one file: before and after, contact sheets, layers, tables.

A page needs no server and no network: pictures are JPEGs inside it, within a budget. Where not all
views fit, views spread evenly are kept and the page says how many. Everything works by keyboard,
and without JavaScript all pictures stand one below the other.
"""

import base64
import html
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from importlib.resources import files
from pathlib import Path
from string import Template

import numpy as np
from numpy.typing import NDArray

from realsim import __version__
from realsim.errors import InputError

Image = NDArray[np.uint8]
Picture = Image | Callable[[], Image]
"""(H, W, 3) RGB or (H, W) grey, or what makes it: only views that are shown are made."""
BUDGET_BYTES = 15_000_000
"""Largest page: a browser opens it at once, and mail servers let it pass."""
MARKUP_BYTES = 250_000
"""Of the budget kept for the text of the page."""
WIDTH_PX = 1280
"""Wider pictures are reduced to this: twice what a page's column shows on a plain screen."""
QUALITY = 84
"""Of the JPEGs: outlines two pixels wide stay clean."""
LEAST_QUALITY = 40
"""Below this a picture does not show what it is to show."""


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Pair:
    """Two pictures of the same view under one slider."""

    before: Picture
    after: Picture
    caption: str
    before_label: str = "before"
    after_label: str = "after"


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class LayeredView:
    """One view in several layers, of which one is shown at a time."""

    layers: Mapping[str, Picture]
    """Name of the layer -> picture, in the order of the buttons."""
    caption: str


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Sliders:
    """A section of before/after pairs."""

    title: str
    pairs: Sequence[Pair]
    text: str = ""


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Layers:
    """A section that switches between RGB, labels, depth, normals, coordinates, ..."""

    title: str
    views: Sequence[LayeredView]
    text: str = ""


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Sheet:
    """A contact sheet; a picture opens large."""

    title: str
    pictures: Sequence[tuple[str, Picture]]
    """Caption and picture."""
    text: str = ""


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Table:
    """A table, one row per object."""

    title: str
    header: Sequence[str]
    rows: Sequence[Sequence[object]]
    colors: Sequence[tuple[int, int, int]] | None = None
    """Colour of every row's object in the pictures; None = no chips."""
    text: str = ""


Section = Sliders | Layers | Sheet | Table


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class PageSummary:
    """What a page came out as."""

    path: Path
    size_bytes: int
    shown: dict[str, tuple[int, int]] = field(default_factory=dict[str, tuple[int, int]])
    """Title of the section -> views shown, views there are."""


def slider_page(
    path: Path | str,
    title: str,
    pairs: Sequence[Pair],
    sections: Sequence[Section] = (),
    *,
    about: str = "",
    pairs_title: str = "Before and after",
    budget_bytes: int = BUDGET_BYTES,
) -> PageSummary:
    """Write a page that begins with before/after sliders; see `picture_page`."""
    first = Sliders(title=pairs_title, pairs=pairs)
    return picture_page(path, title, [first, *sections], about=about, budget_bytes=budget_bytes)


def picture_page(
    path: Path | str,
    title: str,
    sections: Sequence[Section],
    *,
    about: str = "",
    notes: Sequence[str] = (),
    budget_bytes: int = BUDGET_BYTES,
) -> PageSummary:
    """Write a self-contained page of pictures.

    Args:
        path: the HTML file; its folder must exist.
        title: of the page.
        sections: what it shows, in this order.
        about: one line under the title.
        notes: what the reader must know first.
        budget_bytes: largest size of the file [bytes].

    Returns:
        Its size, and how many views of every section it shows.

    Raises:
        InputError: a section without pictures, pictures of a pair that differ in size, or a
            budget that does not hold one view of every section.
    """
    from realsim.store.atomic import write_bytes

    if not sections:
        raise InputError(f"the page '{title}' has no sections; there is nothing to show.")
    kept = _fitting(title, sections, budget_bytes - MARKUP_BYTES)
    shown: dict[str, tuple[int, int]] = {}
    parts: list[str] = [f'<p class="note">{html.escape(n)}</p>' for n in notes]
    for section, views in zip(sections, kept, strict=True):
        parts.append(_section(section, views))
        if not isinstance(section, Table):
            shown[section.title] = len(views), _view_count(section)
    template = Template((files("realsim.app") / "picture_page.html").read_text("utf-8"))
    text = template.substitute(
        title=html.escape(title), about=html.escape(about), body="\n".join(parts),
        version=__version__, slider_style=slider_style(),
    )  # fmt: skip
    data = text.encode("utf-8")
    if len(data) > budget_bytes:
        raise InputError(
            f"the page '{title}' would have {len(data) / 1e6:.1f} MB and {budget_bytes / 1e6:.1f} "
            "MB are allowed: its tables and captions are too long. Split it."
        )
    write_bytes(path, data)
    return PageSummary(path=Path(path), size_bytes=len(data), shown=shown)


def _view_count(section: Section) -> int:
    """Return how many views a section would like to show."""
    if isinstance(section, Sliders):
        return len(section.pairs)
    if isinstance(section, Layers):
        return len(section.views)
    return len(section.pictures) if isinstance(section, Sheet) else 0


def _view(section: Section, k: int, quality: int) -> str:
    """Return the markup of one view of a section."""
    if isinstance(section, Sliders):
        return pair_markup(section.pairs[k], quality)
    if isinstance(section, Layers):
        return _layers(section.views[k], quality)
    assert isinstance(section, Sheet)
    return _thumbnail(*section.pictures[k], quality)


def _section(section: Section, views: Sequence[str]) -> str:
    """Return the markup of a section that shows these views."""
    head = f"<h2>{html.escape(section.title)}</h2>"
    head += f"<p>{html.escape(section.text)}</p>" if section.text else ""
    if isinstance(section, Table):
        return head + _table(section)
    is_sheet = isinstance(section, Sheet)
    what = "pictures" if is_sheet else "views"
    total = _view_count(section)
    count = f'<p class="count">{len(views)} of {total} {what} are shown.</p>' if total > 1 else ""
    return f'{head}{count}<div class="{"sheet" if is_sheet else "views"}">{"".join(views)}</div>'


def _fitting(title: str, sections: Sequence[Section], room: int) -> list[list[str]]:
    """Return the markup of as many views of every section, spread evenly, as there is room for.

    Every section shows one view at least; the rest is shared by the number of views.

    Raises:
        InputError: a section has no pictures, or one view of each does not fit.
    """
    totals = [_view_count(s) for s in sections]
    for section, total in zip(sections, totals, strict=True):
        if total == 0 and not isinstance(section, Table):
            raise InputError(
                f"the section '{section.title}' has no pictures; leave it away or give it some."
            )
    pictured = [k for k, total in enumerate(totals) if total]
    kept: list[dict[int, str]] = [{} for _ in sections]
    quality = QUALITY
    while True:
        for k in pictured:
            kept[k] = {0: _view(sections[k], 0, quality)}
        used = sum(len(kept[k][0]) for k in pictured)
        if used <= room:
            break
        if quality == LEAST_QUALITY:
            raise InputError(
                f"the page '{title}': one view of each of its {len(pictured)} sections needs "
                f"{used / 1e6:.2f} MB and there is room for {max(room, 0) / 1e6:.2f} MB. Give the "
                "page a larger budget or smaller pictures."
            )
        quality = max(quality - 15, LEAST_QUALITY)
    room -= used
    for place, k in enumerate(pictured):
        # What a section does not use is the next ones'.
        allowance = room * totals[k] / sum(totals[m] for m in pictured[place:])
        for view in list(spread(totals[k]))[1:]:
            text = _view(sections[k], view, quality)
            if len(text) > allowance:
                break
            kept[k][view] = text
            allowance -= len(text)
            room -= len(text)
    return [[views[v] for v in sorted(views)] for views in kept]


def spread(total: int) -> Iterator[int]:
    """Yield 0 .. total - 1 such that the first ones, however many, lie spread over the range."""
    bits = max(total - 1, 1).bit_length()
    for k in range(1 << bits):
        mirrored = int(f"{k:0{bits}b}"[::-1], 2)
        if mirrored < total:
            yield mirrored


def _made(picture: Picture) -> Image:
    """Return a picture as (H, W, 3) bytes of at most 1280 columns.

    Raises:
        InputError: it is no picture.
    """
    import cv2

    image = np.asarray(picture() if callable(picture) else picture)
    if image.ndim == 2:
        image = np.repeat(image[..., None], 3, -1)
    if image.ndim != 3 or image.shape[2] != 3 or image.dtype != np.uint8 or image.size == 0:
        raise InputError(
            f"a picture of shape {image.shape} and type {image.dtype} cannot be shown; (H, W, 3) "
            "or (H, W) of uint8 is accepted."
        )
    if image.shape[1] > WIDTH_PX:
        height = max(1, round(image.shape[0] * WIDTH_PX / image.shape[1]))
        image = cv2.resize(image, (WIDTH_PX, height), interpolation=cv2.INTER_AREA)
    return np.asarray(image, np.uint8)


def _img(image: Image, alt: str, quality: int, kind: str = "") -> str:
    """Return an <img> with its JPEG inside."""
    import cv2

    ok, data = cv2.imencode(
        ".jpg", np.ascontiguousarray(image[..., ::-1]), [cv2.IMWRITE_JPEG_QUALITY, quality]
    )
    if not ok:
        raise InputError(f"the picture '{alt}' of shape {image.shape} cannot be encoded as JPEG.")
    code = base64.b64encode(np.asarray(data).tobytes()).decode()
    height, width = image.shape[:2]
    css = f' class="{kind}"' if kind else ""
    return (
        f'<img{css} width="{width}" height="{height}" alt="{html.escape(alt)}" '
        f'src="data:image/jpeg;base64,{code}">'
    )


def slider_style() -> str:
    """Return the CSS that sliders need on a page."""
    return (files("realsim.app") / "slider_style.css").read_text("utf-8")


def pair_markup(pair: Pair, quality: int = QUALITY) -> str:
    """Return the slider of a pair; a page that holds it needs `slider_style`.

    Raises:
        InputError: its pictures differ in size.
    """
    before, after = _made(pair.before), _made(pair.after)
    if before.shape != after.shape:
        raise InputError(
            f"'{pair.caption}': '{pair.before_label}' is {before.shape[1]}x{before.shape[0]} and "
            f"'{pair.after_label}' {after.shape[1]}x{after.shape[0]}; a slider needs two pictures "
            "of the same size."
        )
    name, first, second = (
        html.escape(t) for t in (pair.caption, pair.before_label, pair.after_label)
    )
    alt = f"{pair.caption}, "
    return (
        f'<figure class="view" data-name="{name}"><div class="pair">'
        f"{_img(before, alt + pair.before_label, quality)}"
        f"{_img(after, alt + pair.after_label, quality, 'after')}"
        f'<input type="range" min="0" max="100" step="1" value="50" '
        f"""oninput="this.parentNode.style.setProperty('--at', this.value + '%')" """
        f'aria-label="{name}: left of the handle {first}, right of it {second}">'
        f'<div class="handle"></div><span class="tag first">{first}</span>'
        f'<span class="tag second">{second}</span></div>'
        f"<figcaption>{name}</figcaption></figure>"
    )


def _layers(view: LayeredView, quality: int) -> str:
    """Return the layers of a view.

    Raises:
        InputError: it has none.
    """
    if not view.layers:
        raise InputError(f"the view '{view.caption}' has no layers; give it at least one picture.")
    name = html.escape(view.caption)
    parts = [
        f'<figure data-layer="{html.escape(layer)}">'
        f"{_img(_made(picture), f'{view.caption}, {layer}', quality)}"
        f"<figcaption>{html.escape(layer)}</figcaption></figure>"
        for layer, picture in view.layers.items()
    ]
    return (
        f'<figure class="view" data-name="{name}"><div class="layers">{"".join(parts)}</div>'
        f"<figcaption>{name}</figcaption></figure>"
    )


def _thumbnail(caption: str, picture: Picture, quality: int) -> str:
    """Return a picture of a contact sheet."""
    name = html.escape(caption)
    return (
        f'<figure><button aria-label="{name}, open large">{_img(_made(picture), caption, quality)}'
        f"</button><figcaption>{name}</figcaption></figure>"
    )


def _table(table: Table) -> str:
    """Return a table with its chips.

    Raises:
        InputError: a row of another length than the header, or another number of colours.
    """
    if table.colors is not None and len(table.colors) != len(table.rows):
        raise InputError(
            f"the table '{table.title}' has {len(table.rows)} rows and {len(table.colors)} colours."
        )
    body: list[str] = []
    for k, row in enumerate(table.rows):
        if len(row) != len(table.header):
            raise InputError(
                f"the table '{table.title}': row {k} has {len(row)} cells and the header "
                f"{len(table.header)}."
            )
        chip = ""
        if table.colors is not None:
            r, g, b = table.colors[k]
            chip = f'<span class="chip" style="background:rgb({r},{g},{b})"></span>'
        cells = [html.escape(str(c)) for c in row]
        body.append("<tr>" + "".join(f"<td>{chip if i == 0 else ''}{c}</td>"
                                     for i, c in enumerate(cells)) + "</tr>")  # fmt: skip
    head = "".join(f"<th>{html.escape(h)}</th>" for h in table.header)
    return f'<div class="scroll"><table><tr>{head}</tr>{"".join(body)}</table></div>'
