"""What a check of a data set's labels finds, and when labels and poses disagree."""

from dataclasses import asdict, dataclass
from typing import Any

LEAST_MASK_IOU = 0.90
"""Median over the frames, of the silhouette: renderers differ along the outline only, which is
a twentieth of an object 80 px wide."""
LEAST_VISIBLE_IOU = 0.80
"""Median over the frames, of the visible part, for which BOP uses the noisy measured depth."""
LEAST_SINGLE_IOU = 0.50
"""Least IoU of one frame's silhouette and visible part: below it the mask is another
thing's."""
LEAST_PIXELS = 200
"""Smaller silhouettes are not judged: their outline is too much of them [px]."""
DEPTH_MM = 15.0
"""Median difference of measured and rendered depth: BOP's own tolerance of visibility [mm]."""
MOST_HIDDEN = 0.10
"""Share of an object's visible pixels that are measured nearer than it by `DEPTH_MM`: BOP calls
such pixels hidden. A stereo camera spreads a near edge over 4 px of what lies behind it, which
along one side is a twentieth of an object 80 px wide; realsim's masks keep these pixels."""
LEAST_MEASURED = 50
"""Pixels with depth that a median is taken over."""
STRAY_MM = 5.0
"""One image against the others, of an object's place and of depth: labels and camera poses of
public data sets are good to some millimetres, and so is depth averaged over objects [mm]."""
STRAY_SPREADS = 5.0
"""It must stand off by this many times what the others differ by, too (median distance from
their median): where all images differ, none stands off."""
STRAY_IOU = 0.05
"""One image against the others, of an IoU: by which it may be less."""
STRAY_TIMES = 3.0
"""It must be less by so many times what the others lack, too."""
STRAY_OUTLINE_PX = 0.5
"""The outline, too, must be off by so much [px] more than so many times the others': half
hidden things are all outline, so that a rounded pose costs a tenth of them."""
FEWEST_IMAGES = 3
"""From which on one image of places or depth can be told to be the one that is off."""


@dataclass(frozen=True, kw_only=True, slots=True)
class ObjectAgreement:
    """How the labels of one object agree with its poses, over the frames of a scene."""

    obj_id: int
    name: str
    frames: int
    """In which it is annotated."""
    mask_iou: float | None
    """Median; None = the data set has no such masks."""
    mask_iou_worst: float | None
    mask_worst_image: int | None
    visible_iou: float | None
    visible_iou_worst: float | None
    visible_worst_image: int | None
    depth_mm: float | None
    """Median over the frames of measured minus rendered depth [mm]; None = nothing measured."""
    hidden: float | None
    """Median share of the visible, measured pixels that lie nearer than the object by BOP's 15 mm;
    None likewise."""
    faults: tuple[str, ...]
    """What disagrees; empty = nothing."""


@dataclass(frozen=True, kw_only=True, slots=True)
class SceneAgreement:
    """How one scene agrees with itself."""

    place: str
    frames: int
    objects: tuple[ObjectAgreement, ...]
    findings: tuple[str, ...]
    """What its files contradict each other in, or why it could not be read."""
    notes: tuple[str, ...] = ()
    """What could not be compared, and what the reader says."""
    approximate: bool = False
    """Whether the data set itself calls its labels a rough start only."""

    @property
    def agrees(self) -> bool:
        """Whether nothing disagrees."""
        return not self.findings and not any(o.faults for o in self.objects)

    def to_json(self) -> dict[str, Any]:
        """Return plain JSON values."""
        return asdict(self) | {"agrees": self.agrees}
