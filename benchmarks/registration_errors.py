"""How far results are from the truth: surfaces, pixels, cameras.

Imported by the registration benchmark. Continuous symmetries are aligned exactly, not sampled.
"""

from collections.abc import Mapping, Sequence

import numpy as np
from registration_figures import LOST_MM, RIGHT_MM, Row

from realsim.arrays import Array, Mask
from realsim.geometry import se3
from realsim.geometry.mesh import sample_surface
from realsim.geometry.metrics import add_s, aligned_pose, mssd_symmetric, reprojection_px
from realsim.records import CameraIntrinsics, ObjectModel, ObjectPose
from realsim.registration.simulated import TableScene
from realsim.registration.simulated_lab import FULL_FOCAL_PX

SURFACE_POINTS = 120
"""Points of a model whose place in the image is compared."""


def rows_of(
    part: str, seed: int, scene: TableScene, found: Sequence[ObjectPose], with_adds: bool = False
) -> list[Row]:
    """Return one row per object of the scene, found by its instance; lost ones included."""
    by = {p.instance: p for p in found}
    return [
        _row(part, seed, scene.models[t.obj_id], t, by.get(t.instance), with_adds)
        for t in scene.truth
    ]


def _row(
    part: str, seed: int, model: ObjectModel, true: ObjectPose, found: ObjectPose | None,
    with_adds: bool,
) -> Row:  # fmt: skip
    """Return one object's row."""
    if found is None:
        return Row(seed=seed, part=part, name=model.name)
    off = 1e3 * mssd_symmetric(true.T_world_obj, found.T_world_obj, model)
    adds = 1e3 * add_s(true.T_world_obj, found.T_world_obj, model) if with_adds else LOST_MM
    said = {"checks": {k: float(v) for k, v in found.checks.items()}, "reasons": [*found.reasons]}
    return Row(
        seed=seed, part=part, name=model.name, mssd_mm=off, adds_mm=adds, verdict=found.verdict,
        said=said,
    )  # fmt: skip


def rows_of_unknown(
    part: str,
    seed: int,
    scene: TableScene,
    found: Sequence[ObjectPose],
    models: Mapping[int, ObjectModel],
) -> list[Row]:
    """Return rows where ids were not given: every true object takes the best result of its id.

    What is left over stands where there is no such object: a false one.
    """
    left = list(found)
    rows: list[Row] = []
    for t in scene.truth:
        model = scene.models[t.obj_id]
        same = [p for p in left if p.obj_id == t.obj_id]
        errors = [mssd_symmetric(t.T_world_obj, p.T_world_obj, model) for p in same]
        best = int(np.argmin(errors)) if errors else -1
        # A pose on another object's place is no bad pose of this one.
        near = best >= 0 and 1e3 * errors[best] < LOST_MM
        near = near and (1e3 * errors[best] < RIGHT_MM or _same_place(model, t, same[best]))
        rows.append(_row(part, seed, model, t, same[best] if near else None, False))
        if near:
            left = [p for p in left if p is not same[best]]
    for p in left:
        rows.append(
            Row(seed=seed, part=part, name=models[p.obj_id].name, verdict=p.verdict, extra=True,
                said={"checks": {k: float(v) for k, v in p.checks.items()}})
        )  # fmt: skip
    return rows


def _same_place(model: ObjectModel, true: ObjectPose, found: ObjectPose) -> bool:
    """Return whether the middles of both poses are nearer than half the object's smallest side."""
    low, high = model.mesh.bounds
    middle = 0.5 * (low + high)[None]
    gap = se3.transform(true.T_world_obj, middle) - se3.transform(found.T_world_obj, middle)
    return bool(np.linalg.norm(gap) < 0.5 * float(model.mesh.extent.min()))


def image_errors_px(
    scene: TableScene, found: Sequence[ObjectPose], cameras: Mapping[int, Array]
) -> list[float]:
    """Return how far the points of right objects are off in every image, mean per view and object.

    In pixels of an image of 1280 columns. A point is projected by the true camera from the true
    pose, and by the found camera from the found pose; objects whose middle is beyond the image do
    not count.
    """
    errors: list[float] = []
    by = {t.instance: t for t in scene.truth}
    rng = np.random.default_rng(0)
    indices = sorted(cameras)
    true_cams = se3.invert(scene.Ts_world_cam[indices])
    found_cams = se3.invert(np.stack([cameras[k] for k in indices]))
    for p in found:
        true = by.get(p.instance)
        if true is None:
            continue
        model = scene.models[true.obj_id]
        if 1e3 * mssd_symmetric(true.T_world_obj, p.T_world_obj, model) > RIGHT_MM:
            continue
        T = aligned_pose(true.T_world_obj, p.T_world_obj, model)
        points = sample_surface(model.mesh, SURFACE_POINTS, rng)[0]
        a = true_cams @ true.T_world_obj
        seen = _in_image(scene.intrinsics, se3.transform(a, model.mesh.bounds.mean(0)[None])[:, 0])
        off = reprojection_px(scene.intrinsics, a[seen], found_cams[seen] @ T, points)
        errors += [float(v) for v in FULL_FOCAL_PX / scene.intrinsics.fx * np.atleast_1d(off)]
    return errors


def _in_image(intrinsics: CameraIntrinsics, points: Array) -> Mask:
    """Return which points (N, 3) of the camera's frame are in its image (N,)."""
    i, z = intrinsics, np.maximum(points[:, 2], 1e-3)
    u, v = i.fx * points[:, 0] / z + i.cx, i.fy * points[:, 1] / z + i.cy
    return (u > 0) & (u < i.width - 1) & (v > 0) & (v < i.height - 1)


def camera_errors(
    scene: TableScene, cameras: Mapping[int, Array]
) -> tuple[list[float], list[float]]:
    """Return how far the cameras are off [mm], [deg]."""
    indices = sorted(cameras)
    D = se3.invert(scene.Ts_world_cam[indices]) @ np.stack([cameras[k] for k in indices])
    mm = 1e3 * np.linalg.norm(D[:, :3, 3], axis=1)
    deg = np.degrees(se3.angle(D[:, :3, :3]))
    return [float(v) for v in mm], [float(v) for v in np.atleast_1d(deg)]
