"""Depth views of a table full of known objects, with the errors of a real lab and a known truth.

What registration can be worth is found out here: the same views with the same errors serve the
tests, the benchmark, and whoever asks which accuracy a scene allows.
"""

import hashlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from realsim.arrays import Array, Array32, UInt16
from realsim.errors import InputError
from realsim.geometry import se3
from realsim.geometry.mesh import sample_surface
from realsim.records import CameraIntrinsics, ObjectModel, ObjectPose, names_of
from realsim.registration.evidence import DepthFrame
from realsim.registration.simulated_lab import (
    T_EE_CAM,
    Scattered,
    TableLabConfig,
    arm_error,
    camera_of,
    full_size,
    hemisphere,
    offset,
    resized,
    scatter_objects,
    sensor_of,
    table_square,
    with_found_symmetries,
)
from realsim.rendering.depth_sensors.model import DepthSensorModel
from realsim.rendering.rays import BACKGROUND, PlacedMesh, RayScene
from realsim.store.arrays_on_disk import is_whole, read_arrays, write_arrays

__all__ = [
    "DEPTH_UNIT_M", "Scattered", "TableLabConfig", "TableScene", "full_size", "render_depth",
    "resized", "scatter_objects", "table_scene", "with_found_symmetries",
]  # fmt: skip

DEPTH_UNIT_M = 1e-4
"""Depth images are stored in 0.1 mm, as sessions store them [m]."""
LOOK_AT_M = 0.03
"""Views look at this height over the table: the middle of the things that stand there [m]."""
CLEARANCE_SAMPLES = 400
"""Points of an object's surface to which a camera keeps its distance."""
BACKING_M = 0.01
"""A camera that is too near is moved back in steps of this [m]."""
LARGEST_SEED = 2**63
"""Seeds of the sensor's noise are below this."""


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class TableScene:
    """What the lab reports, and what is true; the world is the robot's base, the table z = 0."""

    intrinsics: CameraIntrinsics
    frames: tuple[DepthFrame, ...]
    """Depth images with the camera poses that forward kinematics and hand-eye claim."""
    models: Mapping[int, ObjectModel]
    """The objects that stand there, by id."""
    truth: tuple[ObjectPose, ...]
    """Where they really stand."""
    Ts_world_cam: Array
    """(F, 4, 4) where the camera really was [m]."""
    Ts_base_ee: Array
    """(F, 4, 4) where the robot says its hand was [m]."""
    T_ee_cam: Array
    """(4, 4) the hand-eye that the calibration claims [m]."""
    T_ee_cam_true: Array
    """(4, 4) where the camera really sits on the hand [m]."""
    sensor: DepthSensorModel
    """The depth camera in pixels of these images."""


def table_scene(
    models: Mapping[int, ObjectModel],
    placed: Sequence[ObjectPose],
    config: TableLabConfig,
    rng: np.random.Generator,
    keep: Path | None = None,
) -> TableScene:
    """Return depth views of objects on the table z = 0, in whatever poses they are.

    The errors are those of `realsim.scanning.simulated`: a constant error of the hand-eye, an
    error of every robot pose, and the sensor's own. The generator is used alike whether images are
    made or found in `keep`.

    Args:
        models: the objects, by id.
        placed: where each instance stands in the world.
        config: views and errors.
        rng: of the views, the errors and the sensor's noise.
        keep: folder in which depth images are kept between runs; None = made anew.

    Raises:
        InputError: nothing is placed, an id has no model, or two instances have one number.
    """
    _check(models, placed)
    camera, sensor = camera_of(config), sensor_of(config)
    middle = np.array([0.0, 0.0, LOOK_AT_M])
    wished = hemisphere(middle, config.views, config.distance_m, config.top_distance_m, rng)
    true = _cleared(wished, _surface_points(models, placed), config.clearance_m)
    T_ee_cam_true = T_EE_CAM @ offset(
        rng, config.hand_eye_mm / 1e3, np.radians(config.hand_eye_deg)
    )
    errors = np.stack([arm_error(rng, config.arm_mm, config.arm_deg) for _ in true])
    seed = int(rng.integers(LARGEST_SEED))
    Ts_base_ee = true @ se3.invert(T_ee_cam_true) @ se3.exp(errors)
    things = [PlacedMesh(k, models[p.obj_id].mesh, p.T_world_obj) for k, p in enumerate(placed)] + [
        PlacedMesh(BACKGROUND, table_square(middle[:2]), np.eye(4))
    ]
    depths = render_depth(things, camera, true, sensor, seed, keep)
    claimed = Ts_base_ee @ T_EE_CAM
    frames = tuple(
        DepthFrame(index=k, depth_m=metres, T_world_cam=claimed[k])
        for k, metres in enumerate(_in_metres(d) for d in depths)
    )
    return TableScene(
        intrinsics=camera,
        frames=frames,
        models=dict(models),
        truth=tuple(placed),
        Ts_world_cam=true,
        Ts_base_ee=Ts_base_ee,
        T_ee_cam=T_EE_CAM.copy(),
        T_ee_cam_true=T_ee_cam_true,
        sensor=sensor,
    )


def render_depth(
    things: Sequence[PlacedMesh],
    camera: CameraIntrinsics,
    Ts_world_cam: Array,
    sensor: DepthSensorModel,
    seed: int,
    keep: Path | None = None,
) -> UInt16:
    """Return what a depth camera measures (F, H, W), in units of 0.1 mm, 0 = none.

    The noise of a view depends on the seed and the view's number only.

    Args:
        things: everything that can be seen.
        camera: of all views.
        Ts_world_cam: (F, 4, 4) where it is.
        sensor: what it makes of exact depth.
        seed: of its noise.
        keep: folder in which images are kept under a hash of all of the above; None = made anew.
    """
    name = _key(things, camera, Ts_world_cam, sensor, seed)
    path = None if keep is None else keep / f"{name}.npz"
    if path is not None and path.is_file() and is_whole(path):
        return read_arrays(path)[0]["depth"]
    scene = RayScene(things)
    images = np.empty((len(Ts_world_cam), camera.height, camera.width), np.uint16)
    for k, T_world_cam in enumerate(Ts_world_cam):
        exact = scene.view(camera, T_world_cam).depth_m
        measured = sensor.measure(exact, camera, np.random.default_rng([seed, k]))
        images[k] = np.round(measured / np.float32(DEPTH_UNIT_M))
    if path is not None:
        path.parent.mkdir(parents=True, exist_ok=True)
        write_arrays(path, {"depth": images}, {"unit_m": DEPTH_UNIT_M})
    return images


def _check(models: Mapping[int, ObjectModel], placed: Sequence[ObjectPose]) -> None:
    """Raise InputError if the scene is empty, a model is missing or a number is used twice."""
    if not placed:
        raise InputError("nothing stands on the simulated table; place at least one object.")
    unknown = sorted({p.obj_id for p in placed} - set(models))
    if unknown:
        raise InputError(
            f"there is no model for the object ids {unknown}; there are: "
            f"{names_of(list(models.values()))}."
        )
    if len({p.instance for p in placed}) != len(placed):
        raise InputError("two placed objects have the same instance number; each needs its own.")


def _surface_points(models: Mapping[int, ObjectModel], placed: Sequence[ObjectPose]) -> Array:
    """Return points (N, 3) on all objects in the world [m]; always the same of one layout."""
    rng = np.random.default_rng(0)
    return np.concatenate([
        se3.transform(
            p.T_world_obj, sample_surface(models[p.obj_id].mesh, CLEARANCE_SAMPLES, rng)[0]
        )
        for p in placed
    ])  # fmt: skip


def _cleared(Ts_world_cam: Array, points: Array, clearance_m: float) -> Array:
    """Return the poses (F, 4, 4), those too near to a point moved back along their view."""
    moved = Ts_world_cam.copy()
    for T in moved:
        while np.linalg.norm(points - T[:3, 3], axis=1).min() < clearance_m:
            T[:3, 3] -= BACKING_M * T[:3, 2]
    return moved


def _in_metres(depth: UInt16) -> Array32:
    """Return a depth image (H, W) in metres, not to be written."""
    metres = depth.astype(np.float32) * np.float32(DEPTH_UNIT_M)
    metres.setflags(write=False)
    return metres


def _key(
    things: Sequence[PlacedMesh],
    camera: CameraIntrinsics,
    Ts_world_cam: Array,
    sensor: DepthSensorModel,
    seed: int,
) -> str:
    """Return a name for depth images that depends on all that makes them."""
    digest = hashlib.blake2b(digest_size=16)
    for thing in things:
        for array in (thing.mesh.vertices, thing.mesh.faces, thing.T_world_obj):
            digest.update(str(array.shape).encode())
            digest.update(array.tobytes())
    digest.update(np.ascontiguousarray(Ts_world_cam).tobytes())
    digest.update(f"{camera!r} {sensor!r} {seed} {DEPTH_UNIT_M}".encode())
    return digest.hexdigest()
