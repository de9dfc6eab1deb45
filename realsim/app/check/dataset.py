"""Do a data set's masks, poses, models and depth agree? Each label against what its pose renders.

A data set's formats can tell whether its files agree with each other; whether they agree with the
poses takes the models, rendered where the poses put them.
"""

from collections.abc import Callable, Iterator, Mapping
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from realsim.app.upgrade.config import UpgradeConfig
from realsim.app.upgrade.dataset import SceneRef, open_scene, scenes_of
from realsim.errors import InputError, RealsimError
from realsim.formats import images
from realsim.formats.labelled_scene import LabelledFrame, LabelledScene
from realsim.records import ObjectModel
from realsim.rendering.labels import LabelRenderer, Labels, PlacedMesh

Mask = NDArray[np.bool_]
Array = NDArray[np.float64]


DEPTH_FINDINGS = ("depth in front", "depth behind")
"""What the check of the format says of depth, which it holds against a model's vertices."""


@dataclass(frozen=True, kw_only=True, slots=True)
class AgreementConfig:
    """When labels and poses disagree."""

    least_mask_iou: float = 0.90
    """Median over the frames, of the silhouette: renderers differ along the outline only, which is
    a twentieth of an object 80 px wide."""
    least_visible_iou: float = 0.80
    """Likewise of the visible part: there BOP asks the measured depth, which is noisy."""
    least_single_iou: float = 0.50
    """Of one frame, of silhouette and visible part: below it the mask is another thing's."""
    least_pixels: int = 200
    """Smaller silhouettes are not judged: their outline is too much of them [px]."""
    depth_mm: float = 15.0
    """Median difference of measured and rendered depth: BOP's own tolerance of visibility [mm]."""
    most_hidden: float = 0.10
    """Share of an object's visible pixels that are measured nearer than it by `depth_mm`: BOP calls
    such pixels hidden. A stereo camera spreads a near edge over 4 px of what lies behind it, which
    along one side is a twentieth of an object 80 px wide; realsim's masks keep these pixels."""
    least_measured: int = 50
    """Pixels with depth that a median is taken over."""


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

    @property
    def agrees(self) -> bool:
        """Whether nothing disagrees."""
        return not self.findings and not any(o.faults for o in self.objects)

    def to_json(self) -> dict[str, Any]:
        """Return plain JSON values."""
        return asdict(self) | {"agrees": self.agrees}


@dataclass(slots=True)
class _Tally:
    """What was found of one object so far."""

    frames: int = 0
    mask: list[tuple[float, int]] = field(default_factory=list[tuple[float, int]])
    visible: list[tuple[float, int]] = field(default_factory=list[tuple[float, int]])
    depth_mm: list[float] = field(default_factory=list[float])
    hidden: list[float] = field(default_factory=list[float])


def is_dataset(folder: Path) -> bool:
    """Return whether a folder holds annotated scenes of BOP or GraspNet."""
    try:
        refs = scenes_of(folder, UpgradeConfig())
    except InputError:
        return False
    return any(r.kind == "graspnet" or any(r.folder.glob("scene_gt*.json")) for r in refs)


def checked_scenes(
    folder: Path,
    config: AgreementConfig | None = None,
    *,
    progress: Callable[[int, int], None] | None = None,
) -> Iterator[SceneAgreement]:
    """Yield how every scene of a data set agrees with itself.

    Args:
        folder: a root, split or scene of BOP; a root, scene or camera of GraspNet.
        config: when labels and poses disagree.
        progress: called with (scenes done, scenes in all).

    Raises:
        InputError: no data set there.
    """
    refs = scenes_of(folder, UpgradeConfig())
    for k, ref in enumerate(refs):
        try:
            scene = open_scene(ref)
            found = checked_scene(scene, ref.place, config or AgreementConfig())
            findings = (*found.findings, *_by_the_format(scene, ref))
            yield replace(found, findings=findings)
        except RealsimError as error:
            yield SceneAgreement(place=ref.place, frames=0, objects=(), findings=(str(error),))
        if progress is not None:
            progress(k + 1, len(refs))


def _by_the_format(scene: LabelledScene, ref: SceneRef) -> list[str]:
    """Return what a scene's files contradict each other in, and what is damaged of a session."""
    from realsim.formats.bop.check import check_bop_scene
    from realsim.store.session_check import check_session, is_session

    findings: list[str] = []
    if ref.kind == "bop":
        # Depth is compared with the rendered surface instead, pixel by pixel.
        found = check_bop_scene(scene).findings
        findings += [str(f) for f in found if f.what not in DEPTH_FINDINGS]
    if is_session(ref.folder):
        report = check_session(ref.folder)
        findings += [f"{f.path}: {f.kind}: {f.found}" for f in report.findings if f.is_damage]
    return findings


def checked_scene(scene: LabelledScene, place: str, config: AgreementConfig) -> SceneAgreement:
    """Return how a scene's masks and depth agree with its poses, frame by frame.

    Raises:
        InputError: something of it cannot be read.
    """
    models = scene.models()
    tallies: dict[int, _Tally] = {}
    without: set[int] = set()
    for index in scene.indices:
        frame = scene.frame(index)
        for o in frame.objects:
            tallies.setdefault(o.obj_id, _Tally()).frames += 1
        without |= {o.obj_id for o in frame.objects} - models.keys()
        _compare(scene, frame, models, tallies, config)
    objects = [
        _agreement(obj_id, models[obj_id].name if obj_id in models else "", tally, config)
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
        place=place, frames=len(scene.indices), objects=tuple(objects), findings=(),
        notes=tuple(notes),
    )  # fmt: skip


def _compare(
    scene: LabelledScene,
    frame: LabelledFrame,
    models: Mapping[int, ObjectModel],
    tallies: dict[int, _Tally],
    config: AgreementConfig,
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
        visible = labels.visible(k)
        given = [scene.mask(frame.index, k, visible=v) for v in (False, True)]
        for mask in (*given, depth):
            if mask is not None and mask.shape != shape:
                raise InputError(
                    f"image {frame.index} of {scene.name}: a mask or depth image has "
                    f"{mask.shape[1]}x{mask.shape[0]} pixels, its camera {shape[1]}x{shape[0]}."
                )
        if given[0] is not None:
            _note_iou(tally.mask, given[0], labels.amodal[k], frame.index, config)
        if given[1] is not None:
            _note_iou(tally.visible, given[1], visible, frame.index, config)
        if depth is not None:
            seen = visible if given[1] is None else visible & given[1]
            _note_depth(tally, depth, labels, seen, config)


def _note_iou(
    into: list[tuple[float, int]], given: Mask, rendered: Mask, index: int, config: AgreementConfig
) -> None:
    """Note the IoU of a mask with the rendered one, where there is enough of either."""
    union = int(np.count_nonzero(given | rendered))
    if union >= config.least_pixels:
        into.append((int(np.count_nonzero(given & rendered)) / union, index))


def _note_depth(
    tally: _Tally,
    depth_m: NDArray[np.float32],
    labels: Labels,
    seen: Mask,
    config: AgreementConfig,
) -> None:
    """Note how the measured depth of visible pixels differs from the rendered one."""
    measured = seen & (depth_m > 0)
    if np.count_nonzero(measured) < config.least_measured:
        return
    off_mm = 1e3 * (depth_m[measured] - labels.depth_m[measured])
    tally.depth_mm.append(float(np.median(off_mm)))
    tally.hidden.append(float(np.mean(off_mm < -config.depth_mm)))


def _agreement(obj_id: int, name: str, tally: _Tally, config: AgreementConfig) -> ObjectAgreement:
    """Return what was found of an object over all frames."""
    faults: list[str] = []
    figures: dict[str, tuple[float | None, float | None, int | None]] = {}
    for what, found, least in (
        ("mask", tally.mask, config.least_mask_iou),
        ("mask_visib", tally.visible, config.least_visible_iou),
    ):
        if not found:
            figures[what] = None, None, None
            continue
        median, (worst, image) = float(np.median([iou for iou, _ in found])), min(found)
        figures[what] = round(median, 4), round(worst, 4), image
        if median < least:
            faults.append(f"{what} has the IoU {median:.2f} with what its pose renders")
        elif worst < config.least_single_iou:
            faults.append(f"{what} of image {image} has the IoU {worst:.2f} with its pose")
    depth = float(np.median(tally.depth_mm)) if tally.depth_mm else None
    if depth is not None and abs(depth) > config.depth_mm:
        faults.append(f"the depth is measured {depth:+.0f} mm from where its pose puts it")
    hidden = float(np.median(tally.hidden)) if tally.hidden else None
    if hidden is not None and hidden > config.most_hidden and tally.visible:
        faults.append(f"{hidden:.0%} of mask_visib are measured in front of what its pose renders")
    return ObjectAgreement(
        obj_id=obj_id, name=name, frames=tally.frames, mask_iou=figures["mask"][0],
        mask_iou_worst=figures["mask"][1], mask_worst_image=figures["mask"][2],
        visible_iou=figures["mask_visib"][0], visible_iou_worst=figures["mask_visib"][1],
        visible_worst_image=figures["mask_visib"][2],
        depth_mm=None if depth is None else round(depth, 2),
        hidden=None if hidden is None else round(hidden, 4), faults=tuple(faults),
    )  # fmt: skip
