"""The annotation of one view: a pure function from the scene, the camera and the measured depth.

Nothing is written here, so that views can be computed in other processes.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np

from realsim.arrays import Array, Array32
from realsim.formats.bop.labels import mask_path
from realsim.images.png import encode_window
from realsim.rendering.labels import LabelRenderer, Labels
from realsim_sim_bridge.annotation import files
from realsim_sim_bridge.annotation.frame_grasps import GraspsInView, GraspVisibility, grasps_in_view
from realsim_sim_bridge.annotation.frame_labels import (
    DepthAgreement,
    UnknownOccluder,
    depth_agreement,
    label_object,
    unknown_occluder,
)
from realsim_sim_bridge.annotation.frame_maps import map_files
from realsim_sim_bridge.annotation.inputs import FrameInputs, FrameView
from realsim_sim_bridge.annotation.unmodelled import (
    ObjectMasks,
    UnmodelledRegion,
    object_masks,
    union_of,
    unmodelled_region,
)

Depth = Array32


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class FrameFiles:
    """What one view's annotation consists of."""

    files: dict[str, bytes]
    """Path in the session -> content; the annotation itself comes last."""
    part: dict[str, Any]
    """The annotation as JSON values."""


Evidence = tuple[DepthAgreement, UnknownOccluder]
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
        label_object(
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
) -> tuple[list[ObjectMasks], list[Evidence], UnmodelledRegion | None]:
    """Return the masks of all objects, checked against the measured depth, and what hides them."""
    config, instances = inputs.config, [o.instance for o in inputs.objects]
    masks = [object_masks(labels, i) for i in instances]
    window = union_of([m.window for m in masks])
    region = unmodelled_region(labels.depth_m, depth_m, window, inputs.intrinsics, config.occluder)
    evidence: list[Evidence] = []
    for k, i in enumerate(instances):
        rendered_m, measured_m = labels.depth_m[masks[k].window], depth_m[masks[k].window]
        agreement = depth_agreement(
            masks[k].rendered, rendered_m, measured_m, config.agreement_tolerance_m
        )
        covered = object_masks(labels, i, region)
        unknown = unknown_occluder(covered, rendered_m, measured_m, agreement, config.occluder)
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
