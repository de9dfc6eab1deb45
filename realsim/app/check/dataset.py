"""Do a data set's masks, poses, models and depth agree? Each label against what its pose renders.

A data set's formats can tell whether its files agree with each other; whether they agree with the
poses takes the models, rendered where the poses put them.
"""

from collections.abc import Callable, Iterator, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from realsim import images
from realsim.app.check import agreement
from realsim.app.check.agreement import SceneAgreement
from realsim.app.check.tally import DepthDifference, MaskOverlap, Tally, agreement_of, stray_depth
from realsim.app.upgrade.dataset import SceneRef, UpgradeConfig, open_scene, scenes_of
from realsim.arrays import Array32, Mask
from realsim.errors import InputError, RealsimError
from realsim.formats.labelled_scene import LabelledFrame, LabelledScene
from realsim.records import ObjectModel
from realsim.rendering.labels import LabelRenderer, Labels, PlacedMesh

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
