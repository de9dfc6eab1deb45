"""Label transfer: the registered scene and its grasps, back-projected onto every real frame.

    mask/000000_000001.png        silhouette of object 1 of view 0, also where something hides it
    mask_visib/000000_000001.png  its visible part
    grasps/views/000000.npz       grasps in that camera: pose, score, seen, reachable
    annotations/000000.json       poses, boxes, counts, agreement with the measured depth
    annotations/objects.json      per object: verdict, checks, mass properties
    scene_gt.json  scene_gt_info.json  scene_gt_coco.json     BOP, made of the parts above

A view's annotation file is written last and carries a digest of all its inputs. Running again after
a kill skips the views whose digest still holds, and does the others.
"""

import hashlib
import json
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from realsim.errors import InputError
from realsim.formats import bop_labels
from realsim.geometry import mesh_shape
from realsim.records import GraspSet, Mesh, ObjectModel, ObjectPose, Scene, View, names_of
from realsim.rendering.labels import LabelRenderer, PlacedMesh
from realsim.store import SessionStore
from realsim.store.records_json import object_pose_to_json
from realsim_sim_bridge import transfer_files as files
from realsim_sim_bridge.frame_labels import FrameLabel, label_object
from realsim_sim_bridge.transfer_grasps import (
    GraspsInView,
    GraspVisibility,
    SightConfig,
    grasps_in_view,
)
from realsim_sim_bridge.transfer_pictures import overlay_picture

__all__ = ["TransferConfig", "TransferSummary", "annotate", "overlay_picture"]

Progress = Callable[[int, int], None]
MOST_NAMED = 8
"""So many views are named in a message."""


@dataclass(frozen=True, kw_only=True, slots=True)
class TransferConfig:
    """Settings of the label transfer."""

    agreement_tolerance_m: float = 0.01
    """Up to which difference measured and rendered depth agree [m]: about three sigma of a D405 at
    0.5 m plus a few millimetres of pose error; BOP's own tolerance is 0.015."""
    plane_clearance_m: float = 0.002
    """How far under the fitted plane the table that hides things lies [m], so that the error of
    plane and pose does not cut off an object's lowest pixels."""
    table_m: float = 4.0
    """Edge of the table that hides things [m]: larger than any table, seen from any view."""
    table_thickness_m: float = 0.02
    """Thickness of that table [m]; a camera under it sees its underside."""
    sight: SightConfig = field(default_factory=SightConfig)
    """When a grasp contact counts as seen."""


@dataclass(frozen=True, kw_only=True, slots=True)
class TransferSummary:
    """What was annotated."""

    views: int
    """Views annotated, those of an earlier run included."""
    skipped: int
    """Views whose annotation of an earlier run still holds."""
    objects: tuple[int, ...]
    """Instances annotated, in the order of the masks."""
    left_out: tuple[int, ...]
    """Instances not annotated because they are rejected."""
    doubtful: tuple[int, ...]
    """Instances annotated and flagged: their verdict is not 'accepted'."""
    views_left_out: tuple[int, ...]
    """Views not annotated because the objects were not registered in them."""
    agreement: dict[int, float]
    """Per instance, the share of measured visible pixels that agree with the rendered depth, over
    all views; NaN = never seen with a measurement."""
    grasps: int
    """Grasps per view."""
    seen_grasps: int
    """Grasps of which both contacts are seen, summed over the views."""

    def __str__(self) -> str:
        """Return one line for the terminal."""
        shares = ", ".join(f"{i}: {100 * a:.0f} %" for i, a in self.agreement.items())
        which = ", ".join(map(str, self.views_left_out[:MOST_NAMED]))
        which += ", ..." if len(self.views_left_out) > MOST_NAMED else ""
        without = f", {len(self.views_left_out)} not registered ({which})" if which else ""
        return (
            f"{self.views} views annotated ({self.skipped} still held{without}), "
            f"{len(self.objects)} objects ({len(self.doubtful)} not accepted, "
            f"{len(self.left_out)} rejected and left out), {self.grasps} grasps a view; "
            f"agreement with the depth {shares or 'unknown'}"
        )


@dataclass(frozen=True, eq=False, slots=True)
class _Inputs:
    """Everything a view's annotation depends on, besides the view."""

    store: SessionStore
    config: TransferConfig
    objects: tuple[ObjectPose, ...]
    models: Mapping[int, ObjectModel]
    grasp_sets: tuple[GraspSet, ...]
    renderer: LabelRenderer
    digest: str


def annotate(
    store: SessionStore,
    scene: Scene,
    models: Mapping[int, ObjectModel],
    grasp_sets: Sequence[GraspSet],
    config: TransferConfig | None = None,
    *,
    only: Collection[int] | None = None,
    progress: Progress | None = None,
) -> TransferSummary:
    """Write masks, poses, visibility and grasps for every view of a session.

    Args:
        store: the session; its views must be calibrated.
        scene: where the objects stand; rejected ones are left out.
        models: obj_id -> model.
        grasp_sets: the scored grasps of the instances; those of rejected ones are left out.
        config: settings; None = the defaults.
        only: the views in which the objects were registered; None = all. Others get no labels:
            their camera, or their depth, is not to be trusted.
        progress: called with (views done, views in all).

    Raises:
        InputError: a view has no camera pose, a model is missing, or grasps are of an instance
            that is not in the scene.
    """
    config = config or TransferConfig()
    views = _calibrated_views(store, only)
    inputs = _gathered(store, scene, models, grasp_sets, config)
    files.write_objects(store, _object_entries(scene, models))
    parts: dict[int, dict[str, Any]] = {}
    skipped = 0
    for done, view in enumerate(views, start=1):
        depth_m = _measured_depth(store, view)
        digest = _view_digest(inputs, view, depth_m)
        part = files.finished_part(store, view.index, digest)
        skipped += part is not None
        parts[view.index] = part or _annotate_view(inputs, view, depth_m, digest)
        if progress is not None:
            progress(done, len(views))
    files.remove_stale(store, parts)
    names = {o.obj_id: models[o.obj_id].name for o in inputs.objects}
    files.write_bop(store, parts, names)
    return _summary(scene, inputs, parts, skipped)


def _calibrated_views(store: SessionStore, only: Collection[int] | None) -> tuple[View, ...]:
    """Return the views that are annotated, all of which must know their camera."""
    views = tuple(v for v in store.session.views if only is None or v.index in only)
    missing = [v.index for v in views if v.T_world_cam is None]
    if missing or not views:
        which = ", ".join(map(str, missing[:MOST_NAMED]))
        which += "..." if len(missing) > MOST_NAMED else ""
        raise InputError(
            f"session '{store.session.name}' has "
            + (f"no camera pose for view {which}" if missing else "no views")
            + ": calibrate first (labels are projected through the camera's pose)."
        )
    return views


def _gathered(
    store: SessionStore,
    scene: Scene,
    models: Mapping[int, ObjectModel],
    grasp_sets: Sequence[GraspSet],
    config: TransferConfig,
) -> _Inputs:
    """Return the checked inputs with the renderer of the scene."""
    chosen = sorted((o for o in scene.objects if o.verdict != "rejected"), key=lambda o: o.instance)
    missing = sorted({o.obj_id for o in chosen} - set(models))
    if missing:
        raise InputError(
            f"scene '{scene.name}' holds objects {missing} without a model; the models given are: "
            f"{names_of(list(models.values()))}. Put the missing ones into models/."
        )
    for g in grasp_sets:
        if scene.object(g.instance).obj_id != g.obj_id:
            raise InputError(
                f"the grasps of instance {g.instance} are of object {g.obj_id}, but in the scene "
                f"this instance is object {scene.object(g.instance).obj_id}. Run the school again."
            )
    instances = {o.instance for o in chosen}
    kept = sorted((g for g in grasp_sets if g.instance in instances), key=lambda g: g.instance)
    return _Inputs(
        store=store,
        config=config,
        objects=tuple(chosen),
        models=models,
        grasp_sets=tuple(kept),
        renderer=LabelRenderer(_placed(scene, chosen, models, config)),
        digest=_scene_digest(scene, chosen, models, kept, config),
    )


def _placed(
    scene: Scene,
    chosen: Sequence[ObjectPose],
    models: Mapping[int, ObjectModel],
    config: TransferConfig,
) -> list[PlacedMesh]:
    """Return the meshes that are seen or hide things: the objects and the table."""
    placed = [PlacedMesh(o.instance, models[o.obj_id].mesh, o.T_world_obj) for o in chosen]
    if scene.plane is not None:
        placed.append(PlacedMesh(-1, table_slab(config), scene.plane.T_world_table))
    return placed


def table_slab(config: TransferConfig) -> Mesh:
    """Return the table as a closed box under the plane z = 0 of frame `table` [m]."""
    half, top = config.table_m / 2, -config.plane_clearance_m
    corners = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (0, 1)], float)
    corners[:, :2] *= half
    corners[:, 2] = top - config.table_thickness_m * (1 - corners[:, 2])
    faces = [
        [0, 1, 3], [0, 3, 2], [4, 6, 7], [4, 7, 5], [0, 4, 5], [0, 5, 1],
        [2, 3, 7], [2, 7, 6], [0, 2, 6], [0, 6, 4], [1, 5, 7], [1, 7, 3],
    ]  # fmt: skip
    return Mesh(vertices=corners, faces=np.array(faces, dtype=np.int32))


def _scene_digest(
    scene: Scene,
    chosen: Sequence[ObjectPose],
    models: Mapping[int, ObjectModel],
    grasp_sets: Sequence[GraspSet],
    config: TransferConfig,
) -> str:
    """Return the digest of what all views have in common."""
    digest = hashlib.sha256(json.dumps([files.FORMAT_VERSION, asdict(config)]).encode())
    for o in chosen:
        digest.update(json.dumps(object_pose_to_json(o), sort_keys=True).encode())
    for obj_id in sorted({o.obj_id for o in chosen}):
        model = models[obj_id]
        digest.update(f"{obj_id} {model.name} ".encode())
        digest.update(model.mesh.vertices.tobytes() + model.mesh.faces.tobytes())
    for g in grasp_sets:
        digest.update(f"{g.instance} {g.obj_id} {len(g)} ".encode())
        for array in (g.Ts_obj_grasp, g.widths_m, g.scores, g.reachable):
            digest.update(np.ascontiguousarray(array).tobytes())
    if scene.plane is not None:
        digest.update(scene.plane.T_world_table.tobytes())
    return digest.hexdigest()


def _view_digest(inputs: _Inputs, view: View, depth_m: NDArray[np.float32]) -> str:
    """Return the digest of everything this view's annotation depends on."""
    i = inputs.store.session.intrinsics
    digest = hashlib.sha256(inputs.digest.encode())
    digest.update(np.array([i.width, i.height, i.fx, i.fy, i.cx, i.cy, *i.distortion]).tobytes())
    digest.update(np.asarray(view.T_world_cam).tobytes() + depth_m.tobytes())
    return digest.hexdigest()


def _measured_depth(store: SessionStore, view: View) -> NDArray[np.float32]:
    """Return the depth of a view; no measurement anywhere if it was recorded without."""
    if store.has_depth(view.index):
        return store.depth_m(view.index)
    return np.zeros((store.session.intrinsics.height, store.session.intrinsics.width), np.float32)


def _annotate_view(
    inputs: _Inputs, view: View, depth_m: NDArray[np.float32], digest: str
) -> dict[str, Any]:
    """Write the files of one view, its annotation last, and return the annotation."""
    config, intrinsics = inputs.config, inputs.store.session.intrinsics
    T_world_cam = np.asarray(view.T_world_cam)
    files.reopen_view(inputs.store, view.index)
    labels = inputs.renderer.render(intrinsics, T_world_cam)
    frame: list[FrameLabel] = []
    for placed in inputs.objects:
        mesh = inputs.models[placed.obj_id].mesh
        frame.append(
            label_object(
                placed, mesh, labels, depth_m, intrinsics, T_world_cam,
                config.agreement_tolerance_m,
            )
        )  # fmt: skip
    masks = [(labels.amodal[o.instance], labels.visible(o.instance)) for o in inputs.objects]
    bop_labels.write_masks(inputs.store, view.index, masks)
    poses = {o.instance: o.T_world_obj for o in inputs.objects}
    grasps = [
        grasps_in_view(inputs.renderer, intrinsics, T_world_cam, poses[g.instance], g, config.sight)
        for g in inputs.grasp_sets
    ]
    files.write_grasps(inputs.store, view.index, grasps)
    objects = [(o, inputs.models[o.obj_id]) for o in inputs.objects]
    part = files.part_of_view(view.index, digest, T_world_cam, objects, frame, _counts(grasps))
    files.write_part(inputs.store, view.index, part)
    return part


def _counts(grasps: Sequence[GraspsInView]) -> dict[int, dict[str, int]]:
    """Return per instance how many grasps are visible, partly visible and hidden."""
    return {
        g.instance: {
            code.name.lower(): int(np.count_nonzero(g.visibility == code))
            for code in GraspVisibility
        }
        for g in grasps
    }


def _object_entries(scene: Scene, models: Mapping[int, ObjectModel]) -> list[dict[str, Any]]:
    """Return what holds for an object in every view: verdict, checks, mass properties."""
    entries: list[dict[str, Any]] = []
    for placed in scene.objects:
        entry = object_pose_to_json(placed)
        if placed.obj_id in models:
            model = models[placed.obj_id]
            matter = mesh_shape.mass_properties(model.mesh, model.density)
            entry["name"] = model.name
            entry["annotated"] = placed.verdict != "rejected"
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


def _summary(
    scene: Scene, inputs: _Inputs, parts: Mapping[int, dict[str, Any]], skipped: int
) -> TransferSummary:
    """Return the summary of all views."""
    agreed = dict.fromkeys((o.instance for o in inputs.objects), 0.0)
    measured = dict.fromkeys(agreed, 0.0)
    seen = 0
    for part in parts.values():
        for entry in part["objects"]:
            share = entry["depth"]["measured"]
            if share and entry["depth"]["agree"] is not None:
                pixels = share * entry["px_count_visib"]
                measured[entry["instance"]] += pixels
                agreed[entry["instance"]] += pixels * entry["depth"]["agree"]
            seen += entry["grasps"].get("visible", 0)
    return TransferSummary(
        views=len(parts),
        skipped=skipped,
        objects=tuple(agreed),
        left_out=tuple(o.instance for o in scene.objects if o.verdict == "rejected"),
        doubtful=tuple(o.instance for o in inputs.objects if o.verdict != "accepted"),
        views_left_out=tuple(v.index for v in inputs.store.session.views if v.index not in parts),
        agreement={i: agreed[i] / n if n > 0 else float("nan") for i, n in measured.items()},
        grasps=sum(len(g) for g in inputs.grasp_sets),
        seen_grasps=seen,
    )
