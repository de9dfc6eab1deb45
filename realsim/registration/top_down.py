"""The paper's way beside ours: ICP in the one view that looks down."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from realsim.arrays import Array
from realsim.errors import DegenerateError
from realsim.records import ObjectPose
from realsim.registration.compare import Comparer
from realsim.registration.finding import SceneTask
from realsim.registration.judge import Poses
from realsim.registration.search.records import NotPlaced
from realsim.registration.single_view import fit_single_view, reference_frame
from realsim.registration.verify import verify_objects


def not_seen(
    given: Poses, single: Sequence[ObjectPose], report: Mapping[str, Any]
) -> list[NotPlaced]:
    """Return the objects that the single view could not be fitted to."""
    fitted = {o.instance for o in single}
    starts = [b.start for b in given.bodies if b.start.instance not in fitted]
    return [
        NotPlaced(obj_id=s.obj_id, instance=s.instance, reason=f"in view {report['frame']}: {why}")
        for s, why in zip(starts, report["not_fitted"], strict=True)
    ]


def top_down_poses(
    task: SceneTask, given: Poses, comparer: Comparer
) -> tuple[list[ObjectPose], dict[str, Any]]:
    """Return the baseline's poses and which frame it used; objects it cannot see are left out."""
    config, intake = task.config, task.intake
    if not (config.with_single_view or config.method == "top-down"):
        return [], {"frame": None, "not_fitted": []}
    center = np.mean([b.center(b.T_start) for b in given.bodies], axis=0)
    frame = reference_frame(intake.frames, given.plane, center)
    kept: list[int] = []
    poses: list[Array] = []
    missing: list[str] = []
    for i, body in enumerate(given.bodies):
        try:
            T = fit_single_view(body, intake.intrinsics, frame)
        except DegenerateError as error:
            missing.append(f"instance {body.start.instance}: {error}")
            continue
        kept.append(i)
        poses.append(T)
    checked = verify_objects(
        [given.bodies[i] for i in kept], poses, [given.clouds[i] for i in kept], comparer,
    )  # fmt: skip
    objects = [
        ObjectPose(
            obj_id=given.bodies[i].start.obj_id, instance=given.bodies[i].start.instance,
            T_world_obj=T, checks=c.checks, verdict=c.verdict, reasons=c.reasons,
        )
        for i, T, c in zip(kept, poses, checked, strict=True)
    ]  # fmt: skip
    return objects, {"frame": frame.index, "not_fitted": missing}
