"""All views of a session on one picture, in the order in which they are taken."""

from collections.abc import Iterator, Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from realsim.arrays import Image, UInt8
from realsim_capture_plans.capturing.log import CaptureLog

if TYPE_CHECKING:
    from realsim.store import SessionStore

Colour = tuple[int, int, int]
SHEET_FILE = "reports/contact_sheet.png"
WIDTH_PX = 2560
"""Width of the sheet: 256 views are then 16 columns of 160 pixels, in which objects and
tags can be told apart."""
LARGEST_CELL_PX = 320
"""Widest cell: a dozen views need no more."""
FRAME_PX = 4
"""Width of a noted view's frame."""
LEAST_WIDTH_PX = 480
"""Least width of the sheet: under it a head line of a few words does not fit."""
HEAD_PX = 46
"""Height of a head of one line."""
LINE_PX = 30
"""Height of each further line of the head."""
TEXT_SCALE = 0.8
"""Size of the head's letters (OpenCV's font scale)."""
LEAST_TEXT_SCALE = 0.5
"""A title too long for a line is written smaller, down to this; then it is broken."""


PAPER, INK, PALE, STRIP = (250, 250, 248), (30, 30, 30), (215, 215, 212), (40, 40, 40)
AMBER, BLUE, RED = (255, 170, 0), (30, 120, 255), (214, 40, 40)
"""Noted, taken again, missing."""

MARGIN, GAP = 10, 40
"""Left and right of the head, and between its texts [px]."""


class Thumbnails:
    """Small pictures of the views, kept while they are captured: nothing is read again."""

    def __init__(self, cell: tuple[int, int]) -> None:
        """Keep pictures of a cell's (width, height)."""
        self.cell = cell
        self.images: dict[int, Image] = {}

    def add(self, k: int, rgb: Image) -> None:
        """Keep view k (H, W, 3), reduced by area."""
        import cv2

        small = cv2.resize(rgb, self.cell, interpolation=cv2.INTER_AREA)
        self.images[k] = np.asarray(small, dtype=np.uint8)


def cell_size(n: int, image_size: tuple[int, int]) -> tuple[int, int, int]:
    """Return (columns, cell width, cell height) for n views of (width, height) pixels."""
    w, h = image_size
    columns = max(1, int(np.ceil(np.sqrt(n))))
    cell = min(LARGEST_CELL_PX, WIDTH_PX // columns)
    return columns, cell, max(1, round(cell * h / w))


def contact_sheet(
    images: Mapping[int, Image],
    entries: Mapping[int, Mapping[str, Any]],
    n: int,
    title: str,
    image_size: tuple[int, int],
) -> Image:
    """Return the sheet (H, W, 3): view numbers, amber frames round noted views, blue corners on
    those taken again, grey cells for those that are missing.

    Args:
        images: view -> thumbnail (h, w, 3) of the cell's size.
        entries: view -> what the capture log says of it.
        n: views of the plan.
        title: the head line.
        image_size: (width, height) of the camera's images.
    """  # noqa: D205 - the first sentence needs two lines
    columns, w, h = cell_size(n, image_size)
    rows = -(-n // columns)
    noted = sum(bool(entries.get(k, {}).get("notes")) for k in images)
    again = sum(bool(entries.get(k, {}).get("retaken")) for k in images)
    parts = [
        (title, INK),
        (f"{len(images)} of {n} views", INK),
        (f"{noted} noted", AMBER if noted else INK),
        (f"{again} taken again", BLUE if again else INK),
        (f"{n - len(images)} missing", RED if n > len(images) else INK),
    ]
    width = max(columns * w, LEAST_WIDTH_PX)
    lines = _head_lines(parts, width - 2 * MARGIN)
    head = HEAD_PX + (len(lines) - 1) * LINE_PX
    sheet = np.full((head + rows * h, width, 3), PAPER, dtype=np.uint8)
    for k in range(n):
        y, x = head + k // columns * h, k % columns * w
        cell = sheet[y : y + h, x : x + w]
        entry = entries.get(k, {})
        _fill_cell(cell, k, images.get(k), entry)
    for i, line in enumerate(lines):
        x = MARGIN
        for text, colour, scale in line:
            at = (x, HEAD_PX - 16 + i * LINE_PX)
            x += _write(sheet, text, at, colour, scale) + GAP
    return sheet


def _head_lines(
    parts: Sequence[tuple[str, Colour]], width: int
) -> list[list[tuple[str, Colour, float]]]:
    """Return (text, colour, scale) of every line of a head of so many pixels; nothing is cut."""
    lines: list[list[tuple[str, Colour, float]]] = [[]]
    left = width
    for whole, colour in parts:
        scale = TEXT_SCALE
        if (size := _text_width(whole, scale)) > width:
            scale = max(LEAST_TEXT_SCALE, scale * (width - 2) / size)
        for text in _broken(whole, width, scale):
            size = _text_width(text, scale)
            if lines[-1] and size > left:
                lines.append([])
                left = width
            lines[-1].append((text, colour, scale))
            left -= size + GAP
    return lines


def _broken(text: str, width: int, scale: float) -> Iterator[str]:
    """Yield a text in pieces that fit the width [px]."""
    while text:
        n = len(text)
        while n > 1 and _text_width(text[:n], scale) > width:
            n -= 1
        yield text[:n].strip()
        text = text[n:]


def _text_width(text: str, scale: float) -> int:
    """Return the width of a text [px]."""
    import cv2

    return int(cv2.getTextSize(_plain(text), cv2.FONT_HERSHEY_SIMPLEX, scale, 1)[0][0])


def _plain(text: str) -> str:
    """Return a text in the letters that OpenCV's font has."""
    return text.encode("ascii", errors="replace").decode()


def _fill_cell(cell: UInt8, k: int, image: Image | None, entry: Mapping[str, Any]) -> None:
    """Draw one view into its cell (h, w, 3)."""
    h, w = cell.shape[:2]
    scale = max(0.42, w / 400)
    if image is None:
        cell[1:-1, 1:-1] = PALE
        said = "skipped" if entry.get("event") == "skipped" else "missing"
        _write(cell, said, (w // 2 - round(70 * scale), h // 2 + 5), RED, scale)
    else:
        cell[:] = image
        cell[0], cell[:, 0] = PAPER, PAPER
        if entry.get("notes"):
            f = FRAME_PX
            cell[:f], cell[-f:], cell[:, :f], cell[:, -f:] = AMBER, AMBER, AMBER, AMBER
            _label(cell, _first_words(entry["notes"][0]), (f + 1, h - f - 3), AMBER, scale)
        if entry.get("retaken") or entry.get("earlier"):
            side = h // 5
            corner = np.add.outer(np.arange(side), np.arange(side)) < side
            cell[:side, w - side :][corner[:, ::-1]] = BLUE
    _label(cell, str(k), (3, round(24 * scale) + 3), PAPER, scale)


def _first_words(note: str) -> str:
    """Return as much of a note as fits under a thumbnail."""
    return note.split(":", maxsplit=1)[0].split(",", maxsplit=1)[0][:22]


def _label(
    image: UInt8, text: str, at: tuple[int, int], colour: tuple[int, int, int], scale: float
) -> None:
    """Write on a dark strip: legible on every picture."""
    import cv2

    (w, h), below = cv2.getTextSize(text, cv2.FONT_HERSHEY_SIMPLEX, scale, 1)
    x, y = at
    image[max(y - h - 3, 0) : y + below, max(x - 2, 0) : x + w + 3] = STRIP
    _write(image, text, at, colour, scale)


def _write(
    image: UInt8, text: str, at: tuple[int, int], colour: tuple[int, int, int], scale: float
) -> int:
    """Write ASCII text at its lower left corner (x, y); return its width [px]."""
    import cv2

    plain = _plain(text)
    canvas = np.ascontiguousarray(image)
    cv2.putText(canvas, plain, at, cv2.FONT_HERSHEY_SIMPLEX, scale, colour, 1, cv2.LINE_AA)
    image[:] = canvas
    return _text_width(plain, scale)


def write_contact_sheet(
    store: "SessionStore", n: int, title: str, taken: Thumbnails | None = None
) -> str:
    """Write SESSION/reports/contact_sheet.png of n views and return its path in the session.

    Args:
        store: the session.
        n: views of the plan.
        title: the head line.
        taken: pictures kept by the run; views of earlier runs are read from the session.
    """
    camera = store.session.intrinsics
    size = (camera.width, camera.height)
    _, w, h = cell_size(n, size)
    thumbnails = Thumbnails((w, h))
    if taken is not None and taken.cell == (w, h):
        thumbnails.images.update(taken.images)
    there = store.completed
    for k in sorted(there - set(thumbnails.images)):
        thumbnails.add(k, store.rgb(k))
    images = {k: v for k, v in thumbnails.images.items() if k in there and k < n}
    sheet = contact_sheet(images, CaptureLog(store).views(), n, title, size)
    store.write_image(SHEET_FILE, sheet)
    return SHEET_FILE
