"""The paper's way beside ours: ICP in the one view that looks down.

The paper's way, kept as the baseline: robust ICP of each mesh in ONE reference frame.

The model's points visible from the reference camera at the start pose are brought onto the cropped
cloud of that frame by point-to-plane ICP (Chen and Medioni 1991) with Tukey's kernel, coarse to
fine. It does what Open3D's `registration_icp` does, whose sums over threads end in other last
digits from run to run.
"""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from realsim.arrays import Array
from realsim.errors import DegenerateError
from realsim.geometry import se3
from realsim.geometry.camera import ray_table
from realsim.geometry.depth import points_from_depth
from realsim.geometry.robust import tukey_weights
from realsim.interop import import_open3d
from realsim.records import CameraIntrinsics, ObjectPose, SupportPlane
from realsim.registration.body import Body, footprint
from realsim.registration.compare import Comparer
from realsim.registration.evidence import DepthFrame
from realsim.registration.finding import SceneTask
from realsim.registration.judge import Poses
from realsim.registration.search.records import NotPlaced
from realsim.registration.verify import verify_objects

REACH_M = (0.020, 0.010, 0.005)
"""Greatest distance of a correspondence in each round, coarse to fine: of the variants tried on
real single frames the best."""
TUKEY_M = (0.008, 0.004, 0.0025)
"""Cut-off of Tukey's kernel in each round."""
STEPS = 40
"""Greatest number of iterations in each round."""
CONVERGED = 1e-7
"""A round ends when the share of partners, and their RMS distance [m], change by less."""
SOURCE_POINTS = 4000
"""Visible model points used."""
CROP_M = 0.020
"""The cloud is cropped to the start's bounding sphere plus this."""
TARGET_POINTS = 15_000
"""About so many measured points of the crop are used."""


def reference_frame(
    frames: Sequence[DepthFrame], plane: SupportPlane | None, center: Array
) -> DepthFrame:
    """Return the frame that looks most steeply down onto the objects, as the paper's does."""
    if plane is None:
        distances = [float(np.linalg.norm(f.T_world_cam[:3, 3] - center)) for f in frames]
        return frames[int(np.argmin(distances))]
    up = plane.T_world_table[:3, 2]
    offsets = np.stack([f.T_world_cam[:3, 3] - center for f in frames])
    return frames[int(np.argmax(offsets @ up / np.linalg.norm(offsets, axis=1)))]


def fit_single_view(body: Body, intrinsics: CameraIntrinsics, frame: DepthFrame) -> Array:
    """Return T_world_obj (4, 4) by robust point-to-plane ICP in one frame.

    Raises:
        DegenerateError: the object is not in the frame, or nothing was measured where it should be.
    """
    from scipy.spatial import KDTree

    o3d = import_open3d()
    T_cam_obj = se3.invert(frame.T_world_cam) @ body.T_start
    source = _visible_points(body, intrinsics, T_cam_obj)
    target_points = _cropped(body, intrinsics, frame, T_cam_obj)
    if len(source) < 50 or len(target_points) < 50:
        raise DegenerateError(
            f"view {frame.index} sees {len(source)} model points of object "
            f"{body.model.name} and {len(target_points)} measured points near it; "
            "50 of each are needed."
        )
    vectors = o3d.utility.Vector3dVector(np.ascontiguousarray(target_points))
    target = o3d.geometry.PointCloud(vectors)
    target.estimate_normals(o3d.geometry.KDTreeSearchParamKNN(knn=20))
    target.orient_normals_towards_camera_location(np.zeros(3))
    normals = np.asarray(target.normals)
    T, tree = T_cam_obj, KDTree(target_points)
    for reach, tukey in zip(REACH_M, TUKEY_M, strict=True):
        T = _point_to_plane(source, (target_points, normals, tree), T, (reach, tukey))
    return frame.T_world_cam @ se3.check_rigid(T, "the pose found by ICP")


def _point_to_plane(
    source: Array, target: tuple[Array, Array, Any], T: Array, round_m: tuple[float, float]
) -> Array:
    """Return the pose after one round of ICP: correspondence within reach, one Gauss-Newton step.

    It ends when neither the share of points that have a partner nor their RMS distance changes.

    Args:
        source: (N, 3) points of the model, object frame [m].
        target: (M, 3) measured points [m], (M, 3) their normals, a tree of the points.
        T: (4, 4) the pose before.
        round_m: reach of a correspondence, and Tukey's cut-off [m].
    """
    reach, cut = round_m
    points, normals, tree = target
    before = (np.inf, np.inf)
    for _ in range(STEPS):
        moved = se3.transform(T, source)
        found: tuple[Any, Any] = tree.query(moved, distance_upper_bound=reach)  # pyright: ignore[reportAssignmentType]
        gap, partner = found
        has = np.isfinite(gap)
        if not has.any():
            return T
        now = (float(np.mean(has)), float(np.sqrt(np.mean(np.square(gap[has])))))
        if max(abs(now[0] - before[0]), abs(now[1] - before[1])) < CONVERGED:
            return T
        before = now
        p, q, n = moved[has], points[partner[has]], normals[partner[has]]
        r = np.sum((p - q) * n, axis=1)
        J = np.concatenate([np.cross(p, n), n], axis=1)
        weighted = J * tukey_weights(np.square(r / cut))[:, None]
        # One sum in one order (einsum): a BLAS of several threads would split it anew each time.
        H = np.einsum("ni,nj->ij", weighted, J)
        step = np.linalg.lstsq(H, -np.einsum("ni,n->i", weighted, r), rcond=None)[0]
        T = se3.exp(step) @ T
    return T


def _visible_points(body: Body, intrinsics: CameraIntrinsics, T_cam_obj: Array) -> Array:
    """Return the points (N, 3) of the model that the camera sees, in the object's frame."""
    seen = footprint(body, intrinsics, T_cam_obj, 1)
    every = max(1, int(np.ceil(len(seen.z) / SOURCE_POINTS)))
    rays = ray_table(intrinsics)[seen.rows[::every], seen.columns[::every]]
    return se3.transform(se3.invert(T_cam_obj), rays * seen.z[::every, None])


def _cropped(
    body: Body, intrinsics: CameraIntrinsics, frame: DepthFrame, T_cam_obj: Array
) -> Array:
    """Return the measured points (N, 3) within the start's bounding sphere, in the camera."""
    points, _ = points_from_depth(frame.depth_m, intrinsics, 1)
    near = np.linalg.norm(points - body.center(T_cam_obj), axis=1) < body.radius_m + CROP_M
    points = points[near]
    return points[:: max(1, len(points) // TARGET_POINTS)]


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
