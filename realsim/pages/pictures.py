"""Pictures as they stand inside a page, and as many views as a budget of bytes has room for."""

import base64
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
from markupsafe import Markup

from realsim.arrays import Image
from realsim.errors import InputError
from realsim.images import resized

Picture = bytes | Image | Callable[[], Image]
"""PNG or JPEG, (H, W, 3) RGB or (H, W) grey, or what makes it: only shown views are made."""
WIDTH_PX = 1280
"""Wider pictures are reduced to this: twice what a page's column shows on a plain screen."""
QUALITY = 84
"""Quality of the JPEGs: outlines two pixels wide stay clean."""
LEAST_QUALITY = 40
"""Below this a picture does not show what it is to show."""


@dataclass(frozen=True, eq=False, slots=True)
class View:
    """One view in one picture or several, such as before and after, or layers of labels."""

    caption: str
    pictures: Mapping[str, Picture]
    """Label -> picture, in order."""


@dataclass(frozen=True, slots=True)
class Shown:
    """A picture as it stands on the page."""

    src: Markup
    alt: str
    label: str = ""
    size: tuple[int, int] | None = None
    """Width and height [px]; None = the file's own."""


@dataclass(eq=False, kw_only=True, slots=True)
class Gallery:
    """Views of a section that share the page's budget with those of other sections."""

    kind: str
    """sliders, layers or sheet."""
    title: str
    views: Sequence[View]
    kept: dict[int, list[Shown]] = field(default_factory=dict[int, list[Shown]])
    """Number of the view -> its pictures."""

    def add(self, k: int, quality: int) -> int:
        """Keep view k and return its size [bytes]."""
        self.kept[k] = self.pictures(k, quality)
        return _bytes_of(self.kept[k])

    def pictures(self, k: int, quality: int) -> list[Shown]:
        """Return the pictures of view k.

        Raises:
            InputError: none, or two under a slider that differ in size.
        """
        view = self.views[k]
        if not view.pictures:
            raise InputError(f"the view '{view.caption}' has no layers; give it a picture.")
        made = [
            shown(p, f"{view.caption}, {label}" if label else view.caption, quality, label)
            for label, p in view.pictures.items()
        ]
        if self.kind == "sliders" and (len(made) != 2 or made[0].size != made[1].size):
            told = " and ".join(
                f"'{p.label}' {p.size[0]}x{p.size[1]}" for p in made if p.size is not None
            )
            raise InputError(
                f"'{view.caption}' has {told}; a slider needs two pictures of the same size."
            )
        return made


def _bytes_of(pictures: Sequence[Shown]) -> int:
    return sum(len(p.src) for p in pictures)


def shown(picture: Picture, alt: str, quality: int = QUALITY, label: str = "") -> Shown:
    """Return a picture inside the page; arrays as JPEG of at most 1280 columns.

    Raises:
        InputError: it is no picture.
    """
    if isinstance(picture, bytes):
        return Shown(src=data_url(picture), alt=alt, label=label)
    image = np.asarray(picture() if callable(picture) else picture)
    if image.ndim not in (2, 3) or image.dtype != np.uint8 or image.size == 0 or (
        image.ndim == 3 and image.shape[2] != 3
    ):  # fmt: skip
        raise InputError(
            f"a picture of shape {image.shape} and type {image.dtype} cannot be shown; (H, W, 3) "
            "or (H, W) of uint8 is accepted."
        )
    if image.shape[1] > WIDTH_PX:
        image = resized(image, WIDTH_PX)
    height, width = image.shape[:2]
    src = data_url(jpeg_bytes(image, quality))
    return Shown(src=src, alt=alt, label=label, size=(width, height))


def data_url(data: bytes) -> Markup:
    """Return a PNG or JPEG as it stands inside a page."""
    form = "jpeg" if data[:2] == b"\xff\xd8" else "png"
    return Markup(f"data:image/{form};base64,{base64.b64encode(data).decode()}")


def jpeg_bytes(image: Image, quality: int = QUALITY) -> bytes:
    """Return a picture (H, W, 3) RGB or (H, W) as JPEG.

    Raises:
        InputError: it cannot be encoded.
    """
    import cv2

    bgr = np.ascontiguousarray(image[..., ::-1] if image.ndim == 3 else image)
    ok, data = cv2.imencode(".jpg", bgr, [cv2.IMWRITE_JPEG_QUALITY, quality])
    if not ok:
        raise InputError(f"a picture of shape {image.shape} cannot be encoded as JPEG.")
    return np.asarray(data).tobytes()


def spread(total: int) -> Iterator[int]:
    """Yield 0 .. total - 1 such that the first ones, however many, lie spread over the range."""
    bits = max(total - 1, 1).bit_length()
    for k in range(1 << bits):
        mirrored = int(f"{k:0{bits}b}"[::-1], 2)
        if mirrored < total:
            yield mirrored


def fit(galleries: Sequence[Gallery], room: float, page: str) -> None:
    """Keep as many views of every gallery, spread evenly, as there is room for.

    Every gallery shows one view at least; the rest is shared by the number of views.

    Args:
        galleries: to fill.
        room: for their pictures [bytes].
        page: what it is called where there is too little room.

    Raises:
        InputError: a gallery without views, or one view of each does not fit.
    """
    for gallery in galleries:
        if not gallery.views:
            raise InputError(
                f"the section '{gallery.title}' has no pictures; leave it away or give it some."
            )
    for quality in (QUALITY, 69, 54, LEAST_QUALITY):
        used = sum(gallery.add(0, quality) for gallery in galleries)
        if used <= room:
            break
    else:
        raise InputError(
            f"the page '{page}': one view of each of its {len(galleries)} sections needs "
            f"{used / 1e6:.2f} MB and there is room for {max(room, 0) / 1e6:.2f} MB. Give the "
            "page a larger budget or smaller pictures."
        )
    room -= used
    for place, gallery in enumerate(galleries):
        # What a section does not use is the next ones'.
        allowance = room * len(gallery.views) / sum(len(g.views) for g in galleries[place:])
        for k in list(spread(len(gallery.views)))[1:]:
            pictures = gallery.pictures(k, quality)
            size = _bytes_of(pictures)
            if size > allowance:
                break
            gallery.kept[k] = pictures
            allowance -= size
            room -= size
