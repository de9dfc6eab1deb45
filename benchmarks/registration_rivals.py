"""The paper's way: ICP of every mesh in one top-down view, by Open3D, in several variants.

Imported by the registration benchmark. The starts, the images and the camera's claimed pose are
those that the registration gets. 'p2l' is realsim's own `single_view`: point-to-plane with Tukey's
kernel, model to scene; the others share its crop, its points and its stages.
"""

import time
from collections.abc import Callable
from typing import Any

import numpy as np
from registration_cases import starts_of
from registration_errors import rows_of
from registration_figures import Done, Row
from registration_methods import Given

from realsim.arrays import Array
from realsim.errors import DegenerateError
from realsim.geometry import se3
from realsim.geometry.depth import points_from_depth
from realsim.geometry.mesh import sample_surface
from realsim.interop import import_open3d
from realsim.records import ObjectPose
from realsim.registration import top_down as ours
from realsim.registration.body import Body, make_body
from realsim.registration.evidence import DepthFrame

SAMPLES = 4000
"""Points of the whole model, for the variants that seek the scene's points on it."""
LEAST_POINTS = 50
VARIANTS = ("p2l", "p2p", "gicp", "p2l to CAD")
"""Point-to-plane with Tukey (visible model points to scene); point-to-point; generalized ICP; and
point-to-plane with Tukey from the scene, its table cut off, to the whole model."""


def rivals(g: Given) -> Done:
    """Return every variant's result from fine and from rough starts; view 0 looks down."""
    rows: list[Row] = []
    frame = g.scene.frames[0]
    began = time.process_time()
    for kind in ("fine", "rough"):
        starts = starts_of(g.scene, g.key.seed, kind)
        bodies = [
            make_body(s, g.models[s.obj_id], g.config.field_cells, g.config.samples,
                      g.config.field_folder) for s in starts
        ]  # fmt: skip
        for variant in VARIANTS:
            found = [_result(g, body, frame, variant) for body in bodies]
            part = f"rival {variant.replace(' ', '-')} {kind}"
            rows += rows_of(part, g.key.seed, g.scene, found, with_adds=True)
    return Done(rows=tuple(rows), samples={"cpu_s_rival": [time.process_time() - began]})


def _result(g: Given, body: Body, frame: DepthFrame, variant: str) -> ObjectPose:
    """Return a variant's pose; the start where it finds nothing to fit."""
    methods: dict[str, Callable[[Given, Body, DepthFrame], Array]] = {
        "p2l": lambda g, b, f: ours.fit_single_view(b, g.scene.intrinsics, f),
        "p2p": lambda g, b, f: _icp(g, b, f, "p2p"),
        "gicp": lambda g, b, f: _icp(g, b, f, "gicp"),
        "p2l to CAD": _scene_to_model,
    }
    try:
        T = methods[variant](g, body, frame)
    except DegenerateError:
        T = body.T_start
    return ObjectPose(obj_id=body.start.obj_id, instance=body.start.instance, T_world_obj=T)


def _icp(g: Given, body: Body, frame: DepthFrame, how: str) -> Array:
    """Return T_world_obj by Open3D's point-to-point or generalized ICP, model to scene."""
    o3d = import_open3d()
    registration: Any = o3d.pipelines.registration
    T = se3.invert(frame.T_world_cam) @ body.T_start
    source = _cloud(_seen_from(body, T))
    target = _cloud(_crop(g, body, frame, T))
    for reach, tukey in zip(ours.REACH_M, ours.TUKEY_M, strict=True):
        criteria = registration.ICPConvergenceCriteria(1e-7, 1e-7, ours.STEPS)
        if how == "gicp":
            method = registration.TransformationEstimationForGeneralizedICP(
                1e-3, registration.TukeyLoss(k=tukey)
            )
            run = registration.registration_generalized_icp
        else:
            method = registration.TransformationEstimationPointToPoint()
            run = registration.registration_icp
        T = np.array(run(source, target, reach, T, method, criteria).transformation)
    return frame.T_world_cam @ se3.check_rigid(T, "the pose found by ICP")


def _scene_to_model(g: Given, body: Body, frame: DepthFrame) -> Array:
    """Return T_world_obj by point-to-plane ICP with Tukey's kernel, scene to model."""
    o3d = import_open3d()
    registration: Any = o3d.pipelines.registration
    T = se3.invert(frame.T_world_cam) @ body.T_start
    scene = _cloud(_crop(g, body, frame, T))
    points, normals = sample_surface(body.model.mesh, SAMPLES, np.random.default_rng(0))
    model = _cloud(points)
    model.normals = o3d.utility.Vector3dVector(normals)
    T = se3.invert(T)
    for reach, tukey in zip(ours.REACH_M, ours.TUKEY_M, strict=True):
        method = registration.TransformationEstimationPointToPlane(registration.TukeyLoss(k=tukey))
        criteria = registration.ICPConvergenceCriteria(1e-7, 1e-7, ours.STEPS)
        T = np.array(
            registration.registration_icp(scene, model, reach, T, method, criteria).transformation
        )
    return frame.T_world_cam @ se3.invert(se3.check_rigid(T, "the pose found by ICP"))


def _seen_from(body: Body, T_cam_obj: Array) -> Array:
    """Return points (N, 3) of the model that face the camera and hide no other, object's frame."""
    o3d = import_open3d()
    points, _ = sample_surface(body.model.mesh, 2 * SAMPLES, np.random.default_rng(0))
    eye = se3.invert(T_cam_obj)[:3, 3]
    towards = points - eye
    far = np.linalg.norm(towards, axis=1, keepdims=True)
    rays = np.concatenate([np.broadcast_to(eye, points.shape), towards / far], 1)
    t = body.ray_scene.cast_rays(o3d.core.Tensor(rays.astype(np.float32)), 1)["t_hit"].numpy()
    return points[t > far[:, 0] - 5e-4]


def _crop(g: Given, body: Body, frame: DepthFrame, T_cam_obj: Array) -> Array:
    """Return the measured points (N, 3) around the start, the true table cut off, in the camera."""
    points, _ = points_from_depth(frame.depth_m, g.scene.intrinsics, 1)
    height = se3.transform(frame.T_world_cam, points)[:, 2]
    near = np.linalg.norm(points - body.center(T_cam_obj), axis=1) < body.radius_m + ours.CROP_M
    points = points[near & (height > 0.003)]
    if len(points) < LEAST_POINTS:
        raise DegenerateError(
            f"view {frame.index} holds {len(points)} points near {body.model.name}."
        )
    return points[:: max(1, len(points) // ours.TARGET_POINTS)]


def _cloud(points: Array) -> Any:
    """Return an Open3D cloud."""
    o3d = import_open3d()
    return o3d.geometry.PointCloud(o3d.utility.Vector3dVector(np.ascontiguousarray(points)))
