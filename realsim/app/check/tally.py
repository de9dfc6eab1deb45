"""What the images of a scene show of each object, and what all of them together say.

A median over images tells whether labels agree as a rule. One image whose label, mask or depth was
damaged does not move it: every image is held against the others, too.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field

import numpy as np

from realsim.app.check import agreement
from realsim.app.check.agreement import ObjectAgreement
from realsim.app.console import shortened
from realsim.arrays import Array

LISTED = 5
"""Images that are told one by one; more of one kind are told in one line."""


@dataclass(frozen=True, kw_only=True, slots=True)
class MaskOverlap:
    """How a mask overlaps with what its pose renders, in one image."""

    image: int
    iou: float
    outline_px: float
    """Pixels that only one of them has, by the length of the outline of both together [px]: by so
    much the outline is off on average, about half of what one is shifted."""


@dataclass(frozen=True, kw_only=True, slots=True)
class DepthDifference:
    """How the depth of an object's pixels differs from the rendered one, in one image."""

    image: int
    off_mm: float
    """Median of measured minus rendered [mm]."""
    scale: float
    """Median of measured / rendered."""
    hidden: float
    """Share of the pixels that are measured in front of the object."""


@dataclass(slots=True)
class Tally:
    """What was found of one object so far."""

    frames: int = 0
    mask: list[MaskOverlap] = field(default_factory=list[MaskOverlap])
    visible: list[MaskOverlap] = field(default_factory=list[MaskOverlap])
    depth: list[DepthDifference] = field(default_factory=list[DepthDifference])
    places: dict[int | None, list[tuple[int, Array]]] = field(
        default_factory=dict[int | None, list[tuple[int, Array]]]
    )
    """Instance -> image and (3,) position in world [m]."""
    is_ambiguous: bool = False
    """Whether an image shows it several times, and nothing tells which is which."""

    def note_places(
        self, image: int, instances: Sequence[int | None], positions: Sequence[Array]
    ) -> None:
        """Note where one image sees the things of this object in world."""
        self.is_ambiguous |= len(instances) > 1 and None in instances
        for instance, position in zip(instances, positions, strict=True):
            self.places.setdefault(instance, []).append((image, position))


def agreement_of(obj_id: int, name: str, tally: Tally) -> ObjectAgreement:
    """Return what was found of an object over all images."""
    faults: list[str] = []
    figures: dict[str, tuple[float | None, float | None, int | None]] = {}
    for what, found, least in (
        ("mask", tally.mask, agreement.LEAST_MASK_IOU),
        ("mask_visib", tally.visible, agreement.LEAST_VISIBLE_IOU),
    ):
        if not found:
            figures[what] = None, None, None
            continue
        median = float(np.median([o.iou for o in found]))
        worst = min(found, key=lambda o: (o.iou, o.image))
        figures[what] = round(median, 4), round(worst.iou, 4), worst.image
        if median < least:
            faults.append(f"{what} has the IoU {median:.2f} with what its pose renders")
        else:
            faults += _listed(list(_stray_masks(what, found)))
    depth = float(np.median([d.off_mm for d in tally.depth])) if tally.depth else None
    if depth is not None and abs(depth) > agreement.DEPTH_MM:
        faults.append(f"the depth is measured {depth:+.0f} mm from where its pose puts it")
    hidden = float(np.median([d.hidden for d in tally.depth])) if tally.depth else None
    if hidden is not None and hidden > agreement.MOST_HIDDEN and tally.visible:
        faults.append(f"{hidden:.0%} of mask_visib are measured in front of what its pose renders")
    faults += _listed(list(_stray_places(obj_id, tally)))
    return ObjectAgreement(
        obj_id=obj_id, name=name, frames=tally.frames, mask_iou=figures["mask"][0],
        mask_iou_worst=figures["mask"][1], mask_worst_image=figures["mask"][2],
        visible_iou=figures["mask_visib"][0], visible_iou_worst=figures["mask_visib"][1],
        visible_worst_image=figures["mask_visib"][2],
        depth_mm=None if depth is None else round(depth, 2),
        hidden=None if hidden is None else round(hidden, 4), faults=tuple(faults),
    )  # fmt: skip


def _stray_masks(what: str, found: Sequence[MaskOverlap]) -> Iterator[tuple[float, str]]:
    """Yield the images whose IoU is far below that of the others, or too small for any."""
    iou = np.array([o.iou for o in found])
    outline_px = np.array([o.outline_px for o in found])
    for k, o in enumerate(found):
        others = np.delete(iou, k)
        usual, is_stray = 1.0, False
        lacking = 1.0 - o.iou
        if len(others):
            usual = float(np.median(others))
            usual_px = float(np.median(np.delete(outline_px, k)))
            is_stray = lacking > agreement.STRAY_TIMES * (1.0 - usual) + agreement.STRAY_IOU
            is_stray &= o.outline_px > agreement.STRAY_TIMES * usual_px + agreement.STRAY_OUTLINE_PX
        if o.iou < agreement.LEAST_SINGLE_IOU or is_stray:
            told = f"{what} of image {o.image} has the IoU {o.iou:.2f} with its pose"
            yield lacking, told + (f", the others {usual:.2f}" if len(others) else "")


def _stray_places(obj_id: int, tally: Tally) -> Iterator[tuple[float, str]]:
    """Yield the images that see an object in another place of the world than the others do."""
    if tally.is_ambiguous:
        return
    for seen in tally.places.values():
        images = [image for image, _ in seen]
        points = 1e3 * np.array([p for _, p in seen])
        if len(points) == 2:  # which of the two is off, nothing can tell
            off = float(np.linalg.norm(points[1] - points[0]))
            if off > agreement.STRAY_MM:
                both = f"images {images[0]} and {images[1]}"
                yield off, f"{both}: object {obj_id} stands {off:.1f} mm apart in them"
        if len(points) < agreement.FEWEST_IMAGES:
            continue
        for k, point in enumerate(points):
            others = np.delete(points, k, axis=0)
            middle = np.median(others, axis=0)
            spread = float(np.median(np.linalg.norm(others - middle, axis=1)))
            off = float(np.linalg.norm(point - middle))
            if off > max(agreement.STRAY_MM, agreement.STRAY_SPREADS * spread):
                told = f"image {images[k]}: object {obj_id} stands {off:.1f} mm from where the "
                yield off, told + f"other {len(others)} images see it"


def stray_depth(tallies: Sequence[Tally]) -> list[str]:
    """Return the images whose depth is off that of the others.

    Each object is held against itself in the other images, so that a model or a surface which is
    always measured a bit off says nothing; of an image, the median over its objects counts.
    """
    off_mm: dict[int, list[float]] = {}
    scale: dict[int, list[float]] = {}
    for tally in tallies:
        if len(tally.depth) < agreement.FEWEST_IMAGES:
            continue
        usual_mm = float(np.median([d.off_mm for d in tally.depth]))
        usual_scale = float(np.median([d.scale for d in tally.depth]))
        for d in tally.depth:
            off_mm.setdefault(d.image, []).append(d.off_mm - usual_mm)
            scale.setdefault(d.image, []).append(d.scale / usual_scale)
    images = sorted(off_mm)
    of_image = np.array([np.median(off_mm[image]) for image in images])
    if len(images) < agreement.FEWEST_IMAGES:
        return []
    found: list[tuple[float, str]] = []
    for k, image in enumerate(images):
        others = np.delete(of_image, k)
        middle = float(np.median(others))
        spread = float(np.median(np.abs(others - middle)))
        off = float(of_image[k]) - middle
        if abs(off) > max(agreement.STRAY_MM, agreement.STRAY_SPREADS * spread):
            way = "farther" if off > 0 else "nearer"
            told = f"depth of image {image} is {abs(off):.0f} mm {way} than that of the others: "
            found.append((abs(off), f"{told}scale {float(np.median(scale[image])):.3f}"))
    return _listed(found)


def _listed(found: Sequence[tuple[float, str]]) -> list[str]:
    """Return what was found of single images: the worst one by one, the rest counted."""
    worst = [text for _, text in sorted(found, key=lambda f: -f[0])]
    return shortened(worst, LISTED, "... and {} images more, off by less than these")
