"""Annotation of a session: the registered scene and its grasps on every view.

A view's annotation file is written last and carries a digest of all its inputs. Running again after
a kill skips the views whose digest still holds, and does the others. Views can be computed by
several processes or machines; this one alone writes.

The annotation of one view: a pure function from the scene, the camera and the measured depth.

Nothing is written here, so that views can be computed in other processes.
"""

from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np

from realsim import images
from realsim.arrays import Array, Array32
from realsim.errors import InputError
from realsim.formats.bop.labels import mask_path
from realsim.geometry import mesh_shape
from realsim.images.png import encode_window
from realsim.many import Outcome, Sent, Shared, Task, Workers, at_most, open_pool, run_many
from realsim.records import GraspSet, Mesh, ObjectModel, Scene, View
from realsim.rendering.labels import LabelRenderer, Labels
from realsim.rendering.rays import PlacedMesh
from realsim.store import SessionStore
from realsim.store.atomic import npz_bytes
from realsim.store.session_store import depth_path
from realsim.untrusted.own_json import to_json
from realsim_sim_bridge.annotation import files, frame_labels, unmodelled
from realsim_sim_bridge.annotation.config import AnnotationConfig
from realsim_sim_bridge.annotation.files import (
    OBJECTS_FILE,
    GraspsInView,
    GraspVisibility,
    grasps_in_view,
    surface_path,
)
from realsim_sim_bridge.annotation.frame_labels import map_files
from realsim_sim_bridge.annotation.inputs import (
    FORMAT_VERSION,
    FrameInputs,
    FrameView,
    frame_view,
    gathered,
)
from realsim_sim_bridge.annotation.summary import AnnotationSummary, numbers, summary_of

Depth = Array32


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class FrameFiles:
    """What one view's annotation consists of."""

    files: dict[str, bytes]
    """Path in the session -> content; the annotation itself comes last."""
    part: dict[str, Any]
    """The annotation as JSON values."""


Evidence = tuple[frame_labels.DepthAgreement, frame_labels.UnknownOccluder]
"""How the measured depth bears out an object's mask, and what hides it that is not in the scene."""


@lru_cache(maxsize=1)
def renderer_of(inputs: FrameInputs) -> LabelRenderer:
    """Return the renderer of the scene; the last one is kept for the scene's other views."""
    return LabelRenderer(inputs.placed())


@lru_cache(maxsize=1)
def boxes_of(inputs: FrameInputs) -> Array:
    """Return (G, 2, 3) the box of every mesh of the renderer's scene in its own frame [m].

    Kept like the renderer: finding a box walks all vertices of the mesh.
    """
    boxes = [p.mesh.bounds for p in inputs.placed()]
    return np.concatenate([np.zeros((0, 2, 3)), *(b[None] for b in boxes)])


def frame_files(inputs: FrameInputs, view: FrameView, depth_m: Depth) -> FrameFiles:
    """Return every file of a view's annotation.

    Args:
        inputs: what all views of the session have in common.
        view: the view.
        depth_m: (H, W) its measured depth [m], 0 = none.
    """
    renderer, intrinsics, config = renderer_of(inputs), inputs.intrinsics, inputs.config
    labels = renderer.render(intrinsics, view.T_world_cam)
    (all_masks, evidence, region), boxes = _seen(inputs, labels, depth_m), boxes_of(inputs)
    own_boxes = boxes[: len(inputs.objects)]
    frame = [
        frame_labels.label_object(
            placed, (inputs.models[placed.obj_id].mesh, box), masks, labels, depth_m,
            (intrinsics, view.T_world_cam), said,
        )
        for placed, box, masks, said in zip(
            inputs.objects, own_boxes, all_masks, evidence, strict=True
        )
    ]  # fmt: skip
    poses = {o.instance: o.T_world_obj for o in inputs.objects}
    grasps = grasps_in_view(
        renderer, intrinsics, view.T_world_cam,
        [(poses[g.instance], g) for g in inputs.grasp_sets], config.sight, region,
    )  # fmt: skip

    size = (intrinsics.width, intrinsics.height)
    out: dict[str, bytes] = {}
    for k, masks in enumerate(all_masks):
        for is_visible, mask in ((False, masks.amodal), (True, masks.visible)):
            path = mask_path(view.index, k, visible=is_visible)
            out[path] = encode_window(mask, masks.origin, size)
    by_instance = list(zip((o.instance for o in inputs.objects), all_masks, strict=True))
    out |= map_files(config.maps, view.index, labels, by_instance, boxes, inputs.depth_unit_m)
    out[files.grasps_path(view.index)] = files.grasps_bytes(grasps)
    part = files.part_of_view(inputs, view, labels, frame, _counts(grasps))
    out[files.part_path(view.index)] = files.part_bytes(part)
    return FrameFiles(files=out, part=part)


def _seen(
    inputs: FrameInputs, labels: Labels, depth_m: Depth
) -> tuple[list[unmodelled.ObjectMasks], list[Evidence], unmodelled.UnmodelledRegion | None]:
    """Return the masks of all objects, checked against the measured depth, and what hides them."""
    config, instances = inputs.config, [o.instance for o in inputs.objects]
    masks = [unmodelled.object_masks(labels, i) for i in instances]
    window = unmodelled.union_of([m.window for m in masks])
    region = unmodelled.unmodelled_region(
        labels.depth_m, depth_m, window, inputs.intrinsics, config.occluder
    )
    evidence: list[Evidence] = []
    for k, i in enumerate(instances):
        rendered_m, measured_m = labels.depth_m[masks[k].window], depth_m[masks[k].window]
        agreement = frame_labels.depth_agreement(
            masks[k].rendered, rendered_m, measured_m, config.agreement_tolerance_m
        )
        covered = unmodelled.object_masks(labels, i, region)
        unknown = frame_labels.unknown_occluder(
            covered, rendered_m, measured_m, agreement, config.occluder
        )
        evidence.append((agreement, unknown))
        if unknown.is_removed:
            masks[k] = covered
        elif region is not None:
            region = region.without(masks[k].window, masks[k].rendered)
    return masks, evidence, region


def _counts(grasps: Sequence[GraspsInView]) -> dict[int, dict[str, int]]:
    """Return per instance how many grasps are visible, partly visible and hidden."""
    return {
        g.grasp_set.instance: {
            code.name.lower(): int(np.count_nonzero(g.visibility == code))
            for code in GraspVisibility
        }
        for g in grasps
    }


# --- What holds for an object in every view: verdict, matter, box, and points on its surface -----


def write_objects(
    store: SessionStore, scene: Scene, models: Mapping[int, ObjectModel], config: AnnotationConfig
) -> None:
    """Write annotations/objects.json, and the surface cloud of every model that is annotated."""
    annotated = sorted({o.obj_id for o in scene.objects if o.verdict != "rejected"})
    for obj_id in annotated:
        _write_surface(store, obj_id, models[obj_id].mesh, config.surface_points)
    entries = _object_entries(scene, models)
    store.write_json(OBJECTS_FILE, {"format_version": FORMAT_VERSION, "objects": entries})


def _write_surface(store: SessionStore, obj_id: int, mesh: Mesh, count: int) -> None:
    """Write points (N, 3) [m] and normals (N, 3) in the object's frame, float32.

    The object's number seeds them, so that the same model has the same points in every session.
    """
    points, normals = mesh_shape.sample_surface(mesh, count, np.random.default_rng(obj_id))
    data = npz_bytes(points=points.astype(np.float32), normals=normals.astype(np.float32))
    path = surface_path(obj_id)
    if not store.has(path) or store.path(path).read_bytes() != data:
        store.write_bytes(path, data)


def _object_entries(scene: Scene, models: Mapping[int, ObjectModel]) -> list[dict[str, Any]]:
    """Return one entry per object of the scene, rejected ones included."""
    entries: list[dict[str, Any]] = []
    for placed in scene.objects:
        entry = to_json(placed)
        if placed.obj_id in models:
            model = models[placed.obj_id]
            low, high = model.mesh.bounds
            matter = mesh_shape.mass_properties(model.mesh, model.density)
            is_annotated = placed.verdict != "rejected"
            entry["name"] = model.name
            entry["annotated"] = is_annotated
            entry["box_obj_m"] = {"low": low.tolist(), "high": high.tolist()}
            entry["surface"] = surface_path(placed.obj_id) if is_annotated else None
            entry["physical"] = {
                "extent_m": model.mesh.extent.tolist(),
                "diameter_m": mesh_shape.diameter(model.mesh),
                "centroid_obj_m": matter.center_of_mass.tolist(),
                "volume_m3": matter.volume_m3,
                "density_kg_m3": model.density,
                "mass_kg": matter.mass_kg,
                "inertia_kg_m2": matter.inertia.tolist(),
                "convex_hull_volume_fraction": matter.hull_volume_fraction,
                "is_watertight": matter.is_watertight,
            }
        entries.append(entry)
    return entries


__all__ = ["AnnotationConfig", "AnnotationSummary", "annotate"]

Progress = Callable[[int, int], None]
Parts = dict[int, dict[str, Any]]


def annotate(  # noqa: PLR0913 - keywords, each with a meaning of its own
    store: SessionStore,
    scene: Scene,
    models: Mapping[int, ObjectModel],
    grasp_sets: Sequence[GraspSet],
    config: AnnotationConfig | None = None,
    *,
    only: Collection[int] | None = None,
    progress: Progress | None = None,
    workers: Workers = 1,
    surroundings: Sequence[PlacedMesh] | None = None,
    damaged: Collection[str] = (),
) -> AnnotationSummary:
    """Write masks, maps, poses, visibility and grasps for every view of a session.

    Args:
        store: the session; its views must be calibrated.
        scene: where the objects stand; rejected ones are left out.
        models: obj_id -> model.
        grasp_sets: the scored grasps of the instances; those of rejected ones are left out.
        config: settings; None = the defaults.
        only: the views in which the objects were registered; None = all. Others get no labels:
            their camera, or their depth, is not to be trusted.
        progress: called with (views done, views in all).
        workers: who computes views; 1 = this process. The files are the same.
        surroundings: what hides things without carrying a label, where it is known exactly, as in
            a synthetic scene; None = a table under the scene's plane, if it has one.
        damaged: paths of files that are not as they were written; views that have one are done
            again.

    Raises:
        InputError: a view has no camera pose, a model is missing, an image is not of the camera's
            size, or grasps are of an instance that is not in the scene.
    """
    views = _calibrated_views(store, only)
    inputs = gathered(store, scene, models, grasp_sets, config or AnnotationConfig(), surroundings)
    todo = [frame_view(store, inputs, v) for v in views]
    found = {v.index: files.finished_part(store, v.index, v.digest, damaged) for v in todo}
    parts: Parts = {index: part for index, part in found.items() if part is not None}
    skipped = len(parts)
    write_objects(store, scene, models, inputs.config)
    if progress is not None:
        progress(skipped, len(views))
    new = [v for v in todo if v.index not in parts]

    def keep(index: int, frame: FrameFiles) -> None:
        files.write_view(store, index, frame.files)
        parts[index] = frame.part
        if progress is not None:
            progress(len(parts), len(views))

    _compute(store, inputs, new, workers, keep)
    parts = {index: parts[index] for index in sorted(parts)}
    files.remove_stale(store, parts, inputs.models)
    files.write_bop(store, parts, {i: m.name for i, m in inputs.models.items()})
    return summary_of(scene, inputs, parts, skipped, [v.index for v in store.session.views])


def _calibrated_views(store: SessionStore, only: Collection[int] | None) -> tuple[View, ...]:
    """Return the views that are annotated, all of which must know their camera."""
    views = tuple(v for v in store.session.views if only is None or v.index in only)
    missing = [v.index for v in views if v.T_world_cam is None]
    if missing or not views:
        raise InputError(
            f"session '{store.session.name}' has "
            + (f"no camera pose for view {numbers(missing)}" if missing else "no views")
            + ": calibrate first (labels are projected through the camera's pose)."
        )
    return views


def _compute(
    store: SessionStore,
    inputs: FrameInputs,
    views: Sequence[FrameView],
    workers: Workers,
    keep: Callable[[int, FrameFiles], None],
) -> None:
    """Compute the files of views, and hand on each view's as they are done."""
    if not views:
        return
    shared = Shared(inputs)

    def task(view: FrameView) -> Task:
        depth = _depth(store, view)
        sent = None if depth is None else Sent(depth)
        return Task(name=str(view.index), fn=_frame, args=(shared, view, sent))

    def done(outcome: Outcome) -> None:
        keep(int(outcome.task.name), outcome.found())

    with open_pool(at_most(workers, len(views))) as pool:
        run_many(map(task, views), pool, done)


def _depth(store: SessionStore, view: FrameView) -> Path | None:
    """Return where a view's depth is; None = it was recorded without."""
    return store.path(depth_path(view.index)) if store.has_depth(view.index) else None


def _measured(inputs: FrameInputs, path: Path | None) -> Array32:
    """Return the depth of a view; no measurement anywhere if it was recorded without."""
    if path is not None:
        return images.read_depth(path, inputs.depth_unit_m)
    return np.zeros((inputs.intrinsics.height, inputs.intrinsics.width), np.float32)


def _frame(inputs: FrameInputs, view: FrameView, depth: Path | None) -> FrameFiles:
    """Return the files of a view."""
    return frame_files(inputs, view, _measured(inputs, depth))
