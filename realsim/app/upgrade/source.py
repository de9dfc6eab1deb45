"""A scene read and checked whole before an upgrade writes anything: poses, models, images.

Which annotations of several images are the same thing, too, and where it starts from in world.
"""

import hashlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from realsim import images
from realsim.app.upgrade.dataset import GT, SceneRef, UpgradeConfig
from realsim.arrays import Array, evenly
from realsim.errors import InputError, UnitError
from realsim.formats.labelled_scene import LabelledFrame, LabelledScene
from realsim.geometry import se3
from realsim.records import CameraIntrinsics, ObjectModel, ObjectPose

DEPTH_UNIT_FACTOR = 1.5
"""The objects may be so much nearer or farther than all measured depth; units differ by 10."""
CAMERA_SPREAD_LIMIT_M = 0.010
"""Camera poses taken from the annotations of several objects may differ by so much, no more."""
SAME_CAMERA_PX = 1e-6
"""Camera matrices that differ by less are the same camera, written by another program."""


LEAST_APART_M = 0.02
"""Two things of one model stand at least so far apart, however flat they are [m]."""
TOLD_APART_M = 0.01
"""Annotations of one standing thing that differ by more between images are named [m]."""


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Seen:
    """One thing as one image's annotation has it."""

    obj_id: int
    instance: int
    """The same number in all images is the same thing."""
    T_cam_obj: Array
    """(4, 4) [m]."""


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class SceneSource:
    """A scene that has been read and checked whole, before anything is written."""

    scene: LabelledScene
    indices: tuple[int, ...]
    """Places of the images that are used."""
    intrinsics: CameraIntrinsics
    depth_unit_m: float
    digests: dict[int, str]
    """Image -> hash of its colour and depth files."""
    seen: dict[int, list[Seen]]
    """Image -> where it says that things are: the poses to start from."""
    Ts_world_cam: dict[int, Array]
    models: dict[int, ObjectModel]
    """The models that the scene needs."""
    notes: list[str]


def prepare(scene: LabelledScene, ref: SceneRef, config: UpgradeConfig) -> SceneSource:
    """Read a scene and check all of it: poses, models, cameras, every image.

    Raises:
        InputError: something is missing or broken.
        UnitError: something has another unit than it claims.
    """
    from realsim.formats.bop.models import require_meshes
    from realsim.formats.graspnet.models import require_meshes as require_graspnet

    indices = tuple(evenly(scene.indices, config.views or len(scene.indices)))
    frames = {i: scene.frame(i) for i in indices}
    intrinsics, depth_unit_m = _one_camera(frames, scene.name)
    poses = _start_poses(scene, frames, ref, config)
    used = sorted({obj_id for rows in poses.values() for obj_id, _, _ in rows})
    models = scene.models()
    require = require_graspnet if ref.kind == "graspnet" else require_meshes
    require(used, models, str(ref.models))
    Ts_world_cam = camera_poses(frames, poses, scene.name)
    seen, notes = told_apart(poses, Ts_world_cam, models)
    digests: dict[int, str] = {}
    first_of: dict[str, int] = {}
    for index in indices:
        depths = [float(T[2, 3]) for _, _, T in poses[index]]
        digests[index] = _checked_images(scene, frames[index], depths)
        first = first_of.setdefault(digests[index], index)
        if first != index and not np.allclose(Ts_world_cam[first], Ts_world_cam[index]):
            notes.append(
                f"images {first} and {index} are the same picture with two camera poses: one of "
                "them is wrong."
            )
    return SceneSource(
        scene=scene, indices=indices, intrinsics=intrinsics, depth_unit_m=depth_unit_m,
        digests=digests, seen=seen, Ts_world_cam=Ts_world_cam,
        models={k: models[k] for k in used}, notes=[*scene.notes, *notes],
    )  # fmt: skip


def _one_camera(frames: Mapping[int, LabelledFrame], name: str) -> tuple[CameraIntrinsics, float]:
    """Return the camera and the depth unit that all images have.

    Raises:
        InputError: an image without depth, or two cameras or units: a session has one.
    """
    first = frames[next(iter(frames))]
    for index, frame in frames.items():
        if frame.depth_unit_m is None:
            raise InputError(
                f"image {index} of {name} has no depth image; poses are refined against the "
                "depth, so each image needs one."
            )
        a, b = first.intrinsics, frame.intrinsics
        same = (a.width, a.height) == (b.width, b.height) and np.array_equal(
            a.distortion, b.distortion
        )
        if not same or np.abs(a.K - b.K).max() > SAME_CAMERA_PX:
            raise InputError(
                f"images {first.index} and {index} of {name} have different cameras, and a session "
                "has one. Upgrade the images of one camera at a time."
            )
        if frame.depth_unit_m != first.depth_unit_m:
            raise InputError(
                f"images {first.index} and {index} of {name} have different depth_scale, and a "
                "session has one. Convert the depth images to one scale."
            )
    assert first.depth_unit_m is not None
    return first.intrinsics, first.depth_unit_m


def _start_poses(
    scene: LabelledScene, frames: Mapping[int, LabelledFrame], ref: SceneRef, config: UpgradeConfig
) -> dict[int, list[tuple[int, int | None, Array]]]:
    """Return {image: [(obj_id, instance, T_cam_obj)]} to start from."""
    if config.start == GT:
        if not any(frame.objects for frame in frames.values()):
            raise InputError(
                f"scene {scene.number} has no annotated object; nothing to start from. Give "
                "--start a folder of estimates under keyframe_poses/."
            )
        return {
            k: [(o.obj_id, o.instance, o.T_cam_obj) for o in f.objects] for k, f in frames.items()
        }
    from realsim.formats.bop.scene import read_keyframe_poses

    rows: dict[int, list[tuple[int, int | None, Array]]] = {}
    for index in frames:
        found = read_keyframe_poses(ref.root, scene.number, index, source=config.start)
        rows[index] = [(obj_id, None, T) for obj_id, T in sorted(found.items())]
    if not any(rows.values()):
        raise InputError(
            f"'{config.start}' found no object in the images of scene {scene.number}; there is "
            "nothing to start from. Leave --start away to start from the annotations."
        )
    return rows


def _checked_images(scene: LabelledScene, frame: LabelledFrame, distances_m: list[float]) -> str:
    """Return the hash of an image's files, both of which can be read and fit to the poses.

    The annotated objects say how far the scene is: measured depth around them is compared.

    Raises:
        InputError: an image that is missing, broken, empty, or of another size.
        UnitError: the depth cannot have the unit that is claimed for it.
    """
    index, unit_m = frame.index, frame.depth_unit_m
    colour, depth_file = scene.colour_file(index), scene.depth_file(index)
    if depth_file is None or unit_m is None:
        raise InputError(f"image {index} of {scene.name} has no depth image.")
    size = (frame.intrinsics.height, frame.intrinsics.width)
    rgb, depth = images.read_rgb(colour), images.read_depth(depth_file, unit_m)
    for file, shape in ((colour, rgb.shape[:2]), (depth_file, depth.shape)):
        if shape != size:
            raise InputError(
                f"{file} has {shape[1]}x{shape[0]} pixels, and its camera {size[1]}x{size[0]}."
            )
    measured = depth[depth > 0]
    if not len(measured):
        raise InputError(f"the depth image of image {index} of {scene.name} is empty.")
    if distances_m:
        distance = float(np.median(distances_m))
        near, far = np.percentile(measured, [1, 99])
        if not near / DEPTH_UNIT_FACTOR < distance < far * DEPTH_UNIT_FACTOR:
            raise UnitError(
                f"image {index} of {scene.name}: the objects are {distance:.3g} m away, but the "
                f"measured depth lies between {near:.3g} and {far:.3g} m with {1e3 * unit_m:g} mm "
                "per count. Correct the depth unit (depth_scale in scene_camera.json, factor_depth "
                "of GraspNet), or the translations (mm in scene_gt.json)."
            )
    digest = hashlib.sha256(colour.read_bytes())
    digest.update(depth_file.read_bytes())
    return digest.hexdigest()


def camera_poses(
    frames: Mapping[int, LabelledFrame],
    poses: Mapping[int, list[tuple[int, int | None, Array]]],
    name: str,
) -> dict[int, Array]:
    """Return T_world_cam of every image: the data set's own, or from objects that stand still.

    Without camera poses in the data set, world is the first image's camera, and the others follow
    from the objects seen in both images: T_first_cam = T_first_obj @ T_obj_cam, averaged. Objects
    that an image shows twice say nothing of it.

    Raises:
        InputError: the objects of two images do not agree on how the camera moved.
    """
    known = {k: f.T_world_cam for k, f in frames.items() if f.T_world_cam is not None}
    if len(known) == len(frames):
        return known
    indices = list(frames)
    first = _single(poses[indices[0]])
    cameras = {indices[0]: np.eye(4)}
    for index in indices[1:]:
        shared = [(o, T) for o, T in _single(poses[index]).items() if o in first]
        if not shared:
            raise InputError(
                f"image {index} of {name} has no camera pose (cam_R_w2c) and no object in common "
                f"with image {indices[0]}; its place cannot be found."
            )
        Ts = np.stack([first[o] @ se3.invert(T) for o, T in shared])
        centre = np.median(Ts[:, :3, 3], axis=0)
        spread = float(np.max(np.linalg.norm(Ts[:, :3, 3] - centre, axis=1)))
        if spread > CAMERA_SPREAD_LIMIT_M:
            raise InputError(
                f"the annotations of images {indices[0]} and {index} of {name} disagree by "
                f"{1e3 * spread:.0f} mm about how the camera moved (at most "
                f"{1e3 * CAMERA_SPREAD_LIMIT_M:.0f} mm): the objects were moved between them, or "
                "an annotation is wrong. Upgrade such images as scenes of their own."
            )
        cameras[index] = se3.from_rt(se3.mean_rotation(Ts[:, :3, :3]), centre)
    return cameras


def _single(rows: Sequence[tuple[int, int | None, Array]]) -> dict[tuple[int, int | None], Array]:
    """Return the objects that an image shows once, by id and instance."""
    keys = [(obj_id, instance) for obj_id, instance, _ in rows]
    return {(o, i): T for o, i, T in rows if keys.count((o, i)) == 1}


# --- which annotations are one thing ----------------------------------------------------------


def told_apart(
    poses: Mapping[int, Sequence[tuple[int, int | None, Array]]],
    Ts_world_cam: Mapping[int, Array],
    models: Mapping[int, ObjectModel],
) -> tuple[dict[int, list[Seen]], list[str]]:
    """Return the annotations with instances, counted from 0 in the order of appearance.

    A source that has instances is believed. Else a model of which no image shows two is one thing;
    of others, annotations that lie nearer to a known thing than its smallest extent are that thing:
    two solid things of one model cannot stand there.

    Args:
        poses: image -> (object id, instance or None, T_cam_obj).
        Ts_world_cam: image -> (4, 4) camera in world [m].
        models: object id -> model.

    Returns:
        Annotations by image, and what a person should know.
    """
    most = _most_at_once(poses)
    known: list[tuple[int, int | None, Array]] = []
    out: dict[int, list[Seen]] = {}
    off: dict[int, float] = {}
    for index, rows in poses.items():
        out[index] = []
        taken: set[int] = set()
        for obj_id, given, T_cam_obj in rows:
            T = Ts_world_cam[index] @ T_cam_obj
            free = [
                k for k, (o, g, _) in enumerate(known) if o == obj_id and g == given
                and k not in taken
            ]  # fmt: skip
            apart = [float(np.linalg.norm(known[k][2][:3, 3] - T[:3, 3])) for k in free]
            reach = max(LEAST_APART_M, float(models[obj_id].mesh.extent.min()))
            sure = given is not None or most[obj_id] == 1
            if free and (sure or min(apart) < reach):
                instance = free[int(np.argmin(apart))]
                off[instance] = max(off.get(instance, 0.0), min(apart))
            else:
                instance = len(known)
                known.append((obj_id, given, T))
            taken.add(instance)
            out[index].append(Seen(obj_id=obj_id, instance=instance, T_cam_obj=T_cam_obj))
    notes = [
        f"the annotations of object {known[k][0]} (instance {k}) lie up to {1e3 * d:.0f} mm apart "
        "between images, by the cameras' poses; the first image's was started from."
        for k, d in sorted(off.items()) if d > TOLD_APART_M
    ]  # fmt: skip
    return out, notes


def _most_at_once(poses: Mapping[int, Sequence[tuple[int, int | None, Array]]]) -> dict[int, int]:
    """Return how many of a model an image shows at most."""
    most: dict[int, int] = {}
    for rows in poses.values():
        ids = [obj_id for obj_id, _, _ in rows]
        for obj_id in ids:
            most[obj_id] = max(most.get(obj_id, 0), ids.count(obj_id))
    return most


def world_starts(
    seen: Mapping[int, Sequence[Seen]], Ts_world_cam: Mapping[int, Array]
) -> list[ObjectPose]:
    """Return one start per thing, from the first image that shows it, by instance."""
    starts: dict[int, ObjectPose] = {}
    for index, rows in seen.items():
        for s in rows:
            if s.instance not in starts:
                T = Ts_world_cam[index] @ s.T_cam_obj
                starts[s.instance] = ObjectPose(obj_id=s.obj_id, instance=s.instance, T_world_obj=T)
    return [starts[k] for k in sorted(starts)]


def moved_from_start(
    pose: ObjectPose, starts: Sequence[ObjectPose], models: Mapping[int, ObjectModel]
) -> tuple[float, float]:
    """Return how far an object moved from its start: [mm] and [deg], nearest symmetry."""
    start = next(s for s in starts if s.instance == pose.instance)
    model = models[pose.obj_id]
    ends = pose.T_world_obj @ model.symmetries
    angles = se3.angle(se3.invert(start.T_world_obj) @ ends)
    k = int(np.argmin(angles))
    # At the middle of the box: a mesh's origin may lie beside it and swing with every turn.
    middle = model.mesh.bounds.mean(0)[None]
    step = se3.transform(ends[k], middle) - se3.transform(start.T_world_obj, middle)
    return 1e3 * float(np.linalg.norm(step)), float(np.degrees(angles[k]))
