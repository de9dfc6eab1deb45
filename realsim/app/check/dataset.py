"""Do a data set's masks, poses, models and depth agree? Each label against what its pose renders.

A data set's formats can tell whether its files agree with each other; whether they agree with the
poses takes the models, rendered where the poses put them.

What the images of a scene show of each object, and what all of them together say.

A median over images tells whether labels agree as a rule. One image whose label, mask or depth was
damaged does not move it: every image is held against the others, too.
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from realsim import images
from realsim.app.check import agreement
from realsim.app.check.agreement import ObjectAgreement, SceneAgreement
from realsim.app.console import shortened
from realsim.app.upgrade.dataset import SceneRef, UpgradeConfig, open_scene, scenes_of
from realsim.arrays import Array, Array32, Mask
from realsim.errors import InputError, RealsimError
from realsim.formats.labelled_scene import LabelledFrame, LabelledScene
from realsim.records import ObjectModel
from realsim.rendering.labels import LabelRenderer, Labels, PlacedMesh

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


DEPTH_FINDINGS = ("depth in front", "depth behind")
"""What the check of the format says of depth, which it holds against a model's vertices."""


def is_dataset(folder: Path) -> bool:
    """Return whether a folder holds annotated scenes of BOP or GraspNet."""
    try:
        refs = scenes_of(folder, UpgradeConfig())
    except InputError:
        return False
    return any(r.kind == "graspnet" or any(r.folder.glob("scene_gt*.json")) for r in refs)


def checked_scenes(
    folder: Path, *, progress: Callable[[int, int], None] | None = None
) -> Iterator[SceneAgreement]:
    """Yield how every scene of a data set agrees with itself.

    Args:
        folder: a root, split or scene of BOP; a root, scene or camera of GraspNet.
        progress: called with (scenes done, scenes in all).

    Raises:
        InputError: no data set there.
    """
    refs = scenes_of(folder, UpgradeConfig())
    for k, ref in enumerate(refs):
        try:
            scene = open_scene(ref)
            found = checked_scene(scene, ref.place)
            yield _with_the_formats(found, scene, ref)
        except RealsimError as error:
            yield SceneAgreement(place=ref.place, frames=0, objects=(), findings=(str(error),))
        if progress is not None:
            progress(k + 1, len(refs))


def _with_the_formats(found: SceneAgreement, scene: LabelledScene, ref: SceneRef) -> SceneAgreement:
    """Return what was found together with what a scene's files contradict each other in.

    What names an object is a fault of it; the rest, also damage of a session, is the scene's.
    """
    from realsim.formats.bop.check import check_bop_scene
    from realsim.store.session_check import check_session, is_session

    findings = list(found.findings)
    faults: dict[int, list[str]] = {}
    if ref.kind == "bop":
        # Depth is compared with the rendered surface instead, pixel by pixel.
        for f in check_bop_scene(scene).findings:
            if f.what not in DEPTH_FINDINGS:
                faults.setdefault(f.obj_id, []).append(str(f))
    if is_session(ref.folder):
        report = check_session(ref.folder)
        findings += [f"{f.path}: {f.kind}: {f.found}" for f in report.findings if f.is_damage]
    objects = tuple(
        replace(o, faults=(*o.faults, *faults.get(o.obj_id, []))) for o in found.objects
    )
    return replace(found, objects=objects, findings=tuple(findings))


def checked_scene(scene: LabelledScene, place: str) -> SceneAgreement:
    """Return how a scene's masks and depth agree with its poses, frame by frame.

    Raises:
        InputError: something of it cannot be read.
    """
    models = scene.models()
    tallies: dict[int, Tally] = {}
    without: set[int] = set()
    for index in scene.indices:
        frame = scene.frame(index)
        _note_objects(frame, tallies)
        without |= {o.obj_id for o in frame.objects} - models.keys()
        _compare(scene, frame, models, tallies)
    objects = [
        agreement_of(obj_id, models[obj_id].name if obj_id in models else "", tally)
        for obj_id, tally in sorted(tallies.items())
    ]
    notes = list(scene.notes)
    if without:
        notes.append(f"object {', '.join(map(str, sorted(without)))} has no mesh: not compared.")
    if not objects:
        notes.append("no object is annotated: there is nothing to compare.")
    if objects and not any(t.mask or t.visible for t in tallies.values()):
        notes.append("there are no masks: only poses and depth were compared.")
    return SceneAgreement(
        place=place, frames=len(scene.indices), objects=tuple(objects),
        findings=tuple(stray_depth(list(tallies.values()))), notes=tuple(notes),
        approximate=_is_approximate(scene),
    )  # fmt: skip


def _is_approximate(scene: LabelledScene) -> bool:
    """Return whether the labels are of a file that is called something else than scene_gt.json."""
    from realsim.formats.bop.labelled import BopLabelledScene
    from realsim.formats.bop.scene import ground_truth_file

    if not isinstance(scene, BopLabelledScene):
        return False
    file = ground_truth_file(scene.ref)
    return file is not None and file != scene.layout.document("scene_gt")


def _note_objects(frame: LabelledFrame, tallies: dict[int, Tally]) -> None:
    """Note which objects an image shows, and where they are in world."""
    for obj_id in dict.fromkeys(o.obj_id for o in frame.objects):
        things = [o for o in frame.objects if o.obj_id == obj_id]
        tally = tallies.setdefault(obj_id, Tally())
        tally.frames += len(things)
        if frame.T_world_cam is not None:
            positions = [(frame.T_world_cam @ o.T_cam_obj)[:3, 3] for o in things]
            tally.note_places(frame.index, [o.instance for o in things], positions)


def _compare(
    scene: LabelledScene,
    frame: LabelledFrame,
    models: Mapping[int, ObjectModel],
    tallies: dict[int, Tally],
) -> None:
    """Compare one frame: every object's masks and depth with what its pose renders."""
    placed = [
        PlacedMesh(k, models[o.obj_id].mesh, o.T_cam_obj)
        for k, o in enumerate(frame.objects) if o.obj_id in models
    ]  # fmt: skip
    if not placed:
        return
    labels = LabelRenderer(placed).render(frame.intrinsics, np.eye(4))
    depth = None
    file = scene.depth_file(frame.index)
    if file is not None and frame.depth_unit_m is not None:
        depth = images.read_depth(file, frame.depth_unit_m)
    shape = labels.ids.shape
    for p in placed:
        k, tally = p.instance, tallies[frame.objects[p.instance].obj_id]
        given = [scene.mask(frame.index, k, visible=v) for v in (False, True)]
        for mask in (*given, depth):
            if mask is not None and mask.shape != shape:
                raise InputError(
                    f"image {frame.index} of {scene.name}: a mask or depth image has "
                    f"{mask.shape[1]}x{mask.shape[0]} pixels, its camera {shape[1]}x{shape[0]}."
                )
        visible = labels.visible(k)
        if given[0] is not None:
            tally.mask += _overlap(given[0], labels.amodal[k], frame.index)
        if given[1] is not None:
            if depth is not None:
                # A hand or a robot in front has no model: what is measured there tells of it.
                behind_m = labels.depth_m - 1e-3 * agreement.DEPTH_MM
                visible &= given[1] | (depth == 0) | (depth >= behind_m)
            tally.visible += _overlap(given[1], visible, frame.index)
        if depth is not None:
            seen = visible if given[1] is None else visible & given[1]
            tally.depth += _depth_difference(frame.index, depth, labels, seen)


def _overlap(given: Mask, rendered: Mask, image: int) -> list[MaskOverlap]:
    """Return the IoU of a mask with the rendered one; nothing where there is too little of both."""
    union = int(np.count_nonzero(given | rendered))
    if union < agreement.LEAST_PIXELS:
        return []
    both = int(np.count_nonzero(given & rendered))
    iou = both / union
    return [
        MaskOverlap(image=image, iou=iou, outline_px=(union - both) / _outline(given | rendered))
    ]


def _outline(mask: Mask) -> int:
    """Return how many pixels of a mask have a neighbour outside of it; 1 of a whole image."""
    import cv2

    inside: Any = cv2.erode(mask.astype(np.uint8), np.ones((3, 3), np.uint8))
    return max(1, int(np.count_nonzero(mask)) - int(np.count_nonzero(inside)))


def _depth_difference(
    image: int, depth_m: Array32, labels: Labels, seen: Mask
) -> list[DepthDifference]:
    """Return how the measured depth of visible pixels differs from the rendered one."""
    measured = seen & (depth_m > 0)
    if np.count_nonzero(measured) < agreement.LEAST_MEASURED:
        return []
    off_mm = 1e3 * (depth_m[measured] - labels.depth_m[measured])
    return [
        DepthDifference(
            image=image,
            off_mm=float(np.median(off_mm)),
            scale=float(np.median(depth_m[measured] / labels.depth_m[measured])),
            hidden=float(np.mean(off_mm < -agreement.DEPTH_MM)),
        )
    ]
