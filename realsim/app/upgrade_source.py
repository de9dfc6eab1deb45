"""A BOP scene read and checked whole before an upgrade writes anything: poses, models, images."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from realsim.errors import InputError, UnitError
from realsim.formats.bop.scene import BopScene, BopSceneRef
from realsim.geometry import se3
from realsim.records import ObjectModel, ObjectPose

Array = NDArray[np.float64]
DEPTH_UNIT_FACTOR = 1.5
"""The objects may be so much nearer or farther than all measured depth; units differ by 10."""
CAMERA_SPREAD_LIMIT_M = 0.010
"""Camera poses taken from the annotations of several objects may differ by so much, no more."""


@dataclass(frozen=True, kw_only=True, slots=True)
class UpgradeConfig:
    """How a dataset is upgraded."""

    start: str = "gt"
    """'gt' = the dataset's own annotations, else a folder name under keyframe_poses/."""
    scenes: tuple[int, ...] = ()
    """Scene numbers; none = all."""
    models: Path | None = None
    """Folder of the models, when it is not DATASET/models."""
    grasps_per_object: int = 60
    """Grasp candidates tried on each object, at most."""
    seed: int = 0
    """Seed of everything random."""
    workers: int = 2
    """Processes in the Robot School."""


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class SceneSource:
    """A scene that has been read and checked whole, before anything is written."""

    bop: BopScene
    annotations: dict[int, list[tuple[int, Array]]]
    """Image -> [(obj_id, T_cam_obj)] to start from."""
    Ts_world_cam: dict[int, Array]
    models: dict[int, ObjectModel]
    """The models that the scene needs."""
    notes: list[str]


def prepare(
    ref: BopSceneRef, root: Path, models: dict[int, ObjectModel], config: UpgradeConfig
) -> SceneSource:
    """Read a scene and check all of it: poses, models, cameras, every image.

    Raises:
        InputError: something is missing or broken.
        UnitError: something has another unit than it claims.
    """
    from realsim.formats.bop.models import require_meshes
    from realsim.formats.bop.scene import read_scene

    bop = read_scene(ref)
    annotations, notes = _start_poses(bop, root, config)
    used = sorted({obj for rows in annotations.values() for obj, _ in rows})
    require_meshes(used, models, str(config.models or root / "models"))
    Ts_world_cam = camera_poses(bop, annotations)
    for view in bop.session.views:
        bop.rgb(view.index)
        if not bop.has_depth(view.index):
            raise InputError(
                f"image {view.index} of {ref.folder} has no depth image; poses are refined against "
                "the depth, so each image needs one."
            )
        _check_depth(bop, view.index, annotations.get(view.index, []))
    return SceneSource(
        bop=bop, annotations=annotations, Ts_world_cam=Ts_world_cam,
        models={k: models[k] for k in used}, notes=notes,
    )  # fmt: skip


def _check_depth(bop: BopScene, index: int, rows: list[tuple[int, Array]]) -> None:
    """Raise if the depth cannot have the unit that scene_camera.json claims for it.

    The annotated objects say how far the scene is: measured depth around them is compared.
    """
    depth = bop.depth_m(index)
    measured = depth[depth > 0]
    if not len(measured):
        raise InputError(f"the depth image of image {index} of {bop.ref.folder} is empty.")
    if not rows:
        return
    distance = float(np.median([T[2, 3] for _, T in rows]))
    near, far = np.percentile(measured, [1, 99])
    if not near / DEPTH_UNIT_FACTOR < distance < far * DEPTH_UNIT_FACTOR:
        raise UnitError(
            f"image {index} of {bop.ref.folder}: the objects are {distance:.3g} m away, but the "
            f"measured depth lies between {near:.3g} and {far:.3g} m with depth_scale "
            f"{1e3 * bop.session.depth_unit_m:g}. Correct depth_scale in scene_camera.json (mm per "
            "count), or the translations in scene_gt.json (mm)."
        )


def _start_poses(
    bop: BopScene, root: Path, config: UpgradeConfig
) -> tuple[dict[int, list[tuple[int, Array]]], list[str]]:
    """Return {image: [(obj_id, T_cam_obj)]} to start from, and what must be said about it."""
    from realsim.formats.bop.scene import read_keyframe_poses

    notes: list[str] = []
    if config.start == "gt":
        if not any(bop.ground_truth.values()):
            raise InputError(
                f"scene {bop.ref.scene_id} has no annotated object; nothing to start from. Give "
                "--start a folder of estimates under keyframe_poses/."
            )
        if bop.approximate:
            notes.append(
                f"its annotations come from {bop.ground_truth_file}, which calls itself "
                "approximate: they serve as a rough start only, and are not a reference."
            )
        rows = {k: [(a.obj_id, a.T_cam_obj) for a in v] for k, v in bop.ground_truth.items()}
        return rows, notes
    rows = {}
    for view in bop.session.views:
        found = read_keyframe_poses(root, bop.ref.scene_id, view.index, source=config.start)
        rows[view.index] = sorted(found.items())
    return rows, notes


def camera_poses(
    bop: BopScene, annotations: dict[int, list[tuple[int, Array]]]
) -> dict[int, Array]:
    """Return T_world_cam of every image: the dataset's own, or from objects that stand still.

    Without camera poses in the dataset, world is the first image's camera, and the others follow
    from the objects seen in both images: T_first_cam = T_first_obj @ T_obj_cam, averaged.

    Raises:
        InputError: the objects of two images do not agree on how the camera moved.
    """
    if bop.Ts_world_cam is not None:
        return bop.Ts_world_cam
    indices = [v.index for v in bop.session.views]
    first = dict(annotations[indices[0]])
    cameras = {indices[0]: np.eye(4)}
    for index in indices[1:]:
        shared = [(o, T) for o, T in annotations[index] if o in first]
        if not shared:
            raise InputError(
                f"image {index} of scene {bop.ref.scene_id} has no camera pose (cam_R_w2c) and no "
                f"object in common with image {indices[0]}; its place cannot be found."
            )
        Ts = np.stack([first[o] @ se3.invert(T) for o, T in shared])
        centre = np.median(Ts[:, :3, 3], axis=0)
        spread = float(np.max(np.linalg.norm(Ts[:, :3, 3] - centre, axis=1)))
        if spread > CAMERA_SPREAD_LIMIT_M:
            raise InputError(
                f"the annotations of images {indices[0]} and {index} of scene {bop.ref.scene_id} "
                f"disagree by {1e3 * spread:.0f} mm about how the camera moved (at most "
                f"{1e3 * CAMERA_SPREAD_LIMIT_M:.0f} mm): the objects were moved between them, or "
                "an annotation is wrong. Upgrade such images as scenes of their own."
            )
        cameras[index] = se3.from_rt(se3.mean_rotation(Ts[:, :3, :3]), centre)
    return cameras


def world_starts(
    annotations: dict[int, list[tuple[int, Array]]], Ts_world_cam: dict[int, Array]
) -> list[ObjectPose]:
    """Return one start per object of the scene, from the first image that shows it."""
    starts: list[ObjectPose] = []
    first = next(iter(annotations))
    for k, (obj_id, T_cam_obj) in enumerate(annotations[first]):
        T = Ts_world_cam[first] @ T_cam_obj
        starts.append(ObjectPose(obj_id=obj_id, instance=k, T_world_obj=T))
    known = {s.obj_id for s in starts}
    for index, rows in annotations.items():
        for obj_id, T_cam_obj in rows:
            if obj_id not in known:
                known.add(obj_id)
                T = Ts_world_cam[index] @ T_cam_obj
                starts.append(ObjectPose(obj_id=obj_id, instance=len(starts), T_world_obj=T))
    return starts
