"""Writing a scene as GraspNet-1Billion's tree: one camera of one scene at a time.

    scenes/scene_0000/object_id_list.txt
    scenes/scene_0000/CAMERA/{rgb,depth,label}/0000.png, annotations/0000.xml, meta/0000.mat,
                             camK.npy, camera_poses.npy, cam0_wrt_table.npy
    models/000/{nontextured.ply, textured.obj, textured.mtl, texture_map.png}

Grasps that physics tried become labels (`tried_labels`), when all scenes are there, and rectangles.

GraspNet's grasps as rectangles of the image: rect/NNNN.npy.

    (N, 7) float32: centre x, centre y, open x, open y, height, score, object id

Pixels. The open point is the middle of the rectangle's side at one finger, so that the gripper's
opening is twice the distance from the centre to it; height is the rectangle's extent across. The
score is 1.1 - friction, objects count from 0. Only grasps along the camera's axis have a rectangle:
where their palm's face is seen (graspnetAPI: to_rect_grasp_group, get_batch_key_points).
"""

from collections.abc import Callable, Mapping
from dataclasses import asdict
from pathlib import Path

import numpy as np

from realsim.arrays import Array
from realsim.errors import InputError
from realsim.formats.export_folder import Content, ExportFolder
from realsim.formats.graspnet.cameras import FIRST, MATRIX, POSES, npy_bytes
from realsim.formats.graspnet.frame_files import Loss, frame_files
from realsim.formats.graspnet.grasp_group import GraspGroup, grasp_group
from realsim.formats.graspnet.gripper_frame import BASE_M, HEIGHT_M, graspnet_poses
from realsim.formats.graspnet.labelled import OBJECT_LIST, GraspnetLabelledScene
from realsim.formats.graspnet.models import model_files
from realsim.formats.graspnet.tried_labels import OBJECTS, told_of
from realsim.formats.graspnet.write_plan import GraspnetWriteConfig, WritePlan, plan_scene
from realsim.formats.grasps.scene_grasps import SceneGrasps
from realsim.formats.labelled_scene import LabelledFrame, LabelledScene, WrittenScene
from realsim.geometry import se3
from realsim.records import CameraIntrinsics, ObjectModel
from realsim.store.atomic import json_bytes

ALONG_AXIS = 0.99
"""Least cosine of approach and camera axis of a grasp that has a rectangle (8 deg)."""


def rect_rows(group: GraspGroup, intrinsics: CameraIntrinsics) -> Array:
    """Return the rectangles (N, 7) of the grasps that approach along the camera's axis.

    Args:
        group: in the camera's frame.
        intrinsics: of the camera; GraspNet's are used without distortion.
    """
    Ts = graspnet_poses(group.Ts_a_grasp, group.depths_m)
    rows = np.flatnonzero((Ts[:, 2, 0] > ALONG_AXIS) & (Ts[:, 2, 3] > BASE_M))
    half = 0.5 * group.openings_m[rows]
    corners = np.zeros((len(rows), 4, 3))
    corners[:, :, 0] = -BASE_M
    corners[:, 1:, 1] = -half[:, None]
    corners[:, 2, 2], corners[:, 3, 2] = 0.5 * HEIGHT_M, -0.5 * HEIGHT_M
    p = se3.transform(Ts[rows], corners)
    fx, fy, cx, cy = intrinsics.fx, intrinsics.fy, intrinsics.cx, intrinsics.cy
    uv = np.stack([fx * p[..., 0] / p[..., 2] + cx, fy * p[..., 1] / p[..., 2] + cy], axis=-1)
    heights_px = np.linalg.norm(uv[:, 2] - uv[:, 3], axis=-1)
    numbers = group.obj_ids[rows].astype(np.float64) - 1.0
    return np.column_stack([uv[:, 0], uv[:, 1], heights_px, group.scores[rows], numbers])


__all__ = ["GraspnetWriteConfig", "write_graspnet_models", "write_graspnet_scene"]

TAKEN = "graspnet_cameras.json"
"""Rows of the export that say which source a camera's folder is of."""
FRAMES_FILE = "frames.json"
RS_WRT_KN = "rs_wrt_kn.npy"
Progress = Callable[[], None]


def write_graspnet_scene(
    scene: LabelledScene,
    folder: ExportFolder,
    config: GraspnetWriteConfig,
    *,
    progress: Progress | None = None,
) -> WrittenScene:
    """Write one scene of one camera, frame by frame; models once for all scenes.

    Args:
        scene: the source.
        folder: the export that is being filled; what is there of an interrupted run stays.
        config: how.
        progress: called once per frame.

    Raises:
        InputError: the source lacks what the format needs (depth, masks, camera poses or objects
            to find them by, a table), or has what it has no place for (distortion).
        StorageError: the disk is full.
    """
    plan, grasps = plan_scene(scene, config), scene.grasps()
    home = f"scenes/scene_{plan.number:04d}"
    camera = f"{home}/{config.camera}"
    _claim(folder, camera, scene.name)
    models = _write_models(scene, folder, plan)
    written, objects = 0, 0
    for new, index in enumerate(plan.indices):
        frame = scene.frame(index)
        objects += len(frame.objects)
        written += _write_frame(scene, frame, folder, f"{camera}/{new:04d}", plan, config, grasps)
        if progress is not None:
            progress()
    _write_cameras(scene, folder, camera, plan)
    _write_object_list(folder, home, plan)
    labels = _label_files(scene, plan)
    for relative, file in labels.items():
        folder.write_piece(relative, {relative: file})
    held, told = (0, ()) if grasps is None else told_of(grasps)
    losses = [Loss(**row) for _, row in folder.rows(f"{camera}.losses")]
    return WrittenScene(
        name=scene.name,
        folder=folder.folder / camera,
        frames=len(plan.indices),
        frames_written=written,
        objects=objects,
        notes=(
            *scene.notes, *plan.notes, *_loss_notes(losses), *_model_notes(plan, models), *told,
        ),
        counts={
            "labels": 0 if config.without_labels else len(plan.indices),
            "models": len(models),
            "copied_labels": len(labels),
            **({} if grasps is None else {"grasps": held}),
        },
    )  # fmt: skip


def _claim(folder: ExportFolder, camera: str, source: str) -> None:
    """Take the folder of a camera for a source.

    Raises:
        InputError: another scene of the same export has it.
    """
    for key, name in folder.rows(TAKEN):
        if key == camera and name != source:
            raise InputError(
                f"{source} would be written into {camera}, where {name} is. Give another camera "
                "or scene number (GraspnetWriteConfig)."
            )
    folder.write_piece(f"{camera} of {source}", {}, {TAKEN: (camera, source)})


def _write_frame(
    scene: LabelledScene, frame: LabelledFrame, folder: ExportFolder, piece: str,
    plan: WritePlan, config: GraspnetWriteConfig, grasps: SceneGrasps | None,
) -> int:  # fmt: skip
    """Write the files of an image; return 1, or 0 if they were there."""
    if folder.has(piece):
        return 0
    camera, _, name = piece.rpartition("/")
    found, loss = frame_files(
        scene, frame, _order(scene, frame, plan), plan.numbers,
        with_label=not config.without_labels,
    )  # fmt: skip
    files: dict[str, Content] = {
        f"{camera}/{kind.replace('/', f'/{name}')}": content for kind, content in found.items()
    }
    rect: Content | None = None
    if isinstance(scene, GraspnetLabelledScene):
        rect = scene.rect_file(frame.index)
    if rect is None and grasps is not None:
        rect = _rectangles(frame, grasps)
    if rect is not None:
        files[f"{camera}/rect/{name}.npy"] = rect
    folder.write_piece(piece, files, {f"{camera}.losses": (name, asdict(loss))})
    return 1


def _label_files(scene: LabelledScene, plan: WritePlan) -> dict[str, Path]:
    """Return what holds for a copy unchanged and goes along: path in the new tree -> own file.

    Such files name objects by their numbers, or by their place in the annotation: a scene whose
    objects got other ids is no GraspNet source any more. dex_models are pickles, which run what
    they hold: they stay behind.
    """
    if not isinstance(scene, GraspnetLabelledScene):
        return {}
    home = scene.ref.folder.parent
    root = home.parent.parent
    number = f"scene_{plan.number:04d}"
    files = {
        f"scenes/{number}/{RS_WRT_KN}": home / RS_WRT_KN,
        f"collision_label/{number}/collision_labels.npz": (
            root / "collision_label" / home.name / "collision_labels.npz"
        ),
    }
    for n in plan.numbers.values():
        name = f"grasp_label/{n:03d}_labels.npz"
        files[name] = root / name
    return {name: file for name, file in files.items() if file.is_file()}


def _rectangles(frame: LabelledFrame, grasps: SceneGrasps) -> bytes:
    """Return the rectangles of the grasps that held, of those along the camera's axis."""
    poses = {o.instance: o.T_cam_obj for o in frame.objects if o.instance is not None}
    sets = [s for s in grasps.sets if s.instance in poses]
    rows = rect_rows(grasp_group(sets, poses, scores="tried"), frame.intrinsics)
    return npy_bytes(rows.astype(np.float32))


def _order(scene: LabelledScene, frame: LabelledFrame, plan: WritePlan) -> list[int]:
    """Return the places of a frame's objects in the order of the object list.

    graspnetAPI takes collision labels by the order of the annotation, so it is the same in all
    images; a GraspNet source has its own.
    """
    places = list(range(len(frame.objects)))
    if isinstance(scene, GraspnetLabelledScene):
        return places
    keys = [(o.obj_id, o.instance) for o in frame.objects]
    return sorted(places, key=lambda k: plan.places[keys[k]])


def _write_cameras(
    scene: LabelledScene, folder: ExportFolder, camera: str, plan: WritePlan
) -> None:
    files: dict[str, Content] = {
        f"{camera}/{MATRIX}": npy_bytes(plan.K),
        f"{camera}/{POSES}": npy_bytes(plan.camera_poses),
        f"{camera}/{FIRST}": npy_bytes(plan.cam0_wrt_table),
    }
    if plan.indices != tuple(range(len(plan.indices))):
        files[f"{camera}/{FRAMES_FILE}"] = json_bytes(
            {
                "source": scene.name,
                "images": {f"{new:04d}": index for new, index in enumerate(plan.indices)},
                "object_ids": {f"{n:03d}": i for i, n in plan.numbers.items()},
            }
        )
    folder.write_piece(f"{camera} cameras", files)


def _write_object_list(folder: ExportFolder, home: str, plan: WritePlan) -> None:
    """Write object_id_list.txt, one for both cameras.

    Raises:
        InputError: the other camera's scene has other objects.
    """
    relative = f"{home}/{OBJECT_LIST}"
    things = sorted(plan.places, key=lambda key: plan.places[key])
    rows = [[plan.numbers[obj_id], instance] for obj_id, instance in things]
    folder.write_piece(f"{home} objects", {}, {OBJECTS: (str(plan.number), rows)})
    text = "".join(f"{n}\n" for n in plan.order).encode("ascii")
    if folder.has(relative):
        there = (folder.folder / relative).read_bytes()
        if sorted(there.split()) != sorted(text.split()):
            raise InputError(
                f"the cameras of {home} do not show the same objects: "
                f"{there.decode('ascii').split()} and {list(plan.order)}. They are not one scene; "
                "give another scene number (GraspnetWriteConfig)."
            )
        return
    folder.write_piece(relative, {relative: text})


def _write_models(scene: LabelledScene, folder: ExportFolder, plan: WritePlan) -> set[int]:
    """Write the models that are not there yet; return the numbers of all of the scene's."""
    for number, home in _own_model_folders(scene, plan.numbers).items():
        files: dict[str, Content] = {
            f"models/{number:03d}/{p.name}": p for p in sorted(home.iterdir()) if p.is_file()
        }
        folder.write_piece(_model_piece(number), files)
    needed = [i for i, n in plan.numbers.items() if not folder.has(_model_piece(n))]
    if needed:
        found = scene.models()
        models = {i: found[i] for i in needed if i in found}
        write_graspnet_models(models, folder)
    return {n for n in plan.numbers.values() if folder.has(_model_piece(n))}


def write_graspnet_models(models: Mapping[int, ObjectModel], folder: ExportFolder) -> None:
    """Write models that are not there yet; scenes bring those that they show.

    Args:
        models: by object id.
        folder: the export that is being filled.

    Raises:
        StorageError: the disk is full.
    """
    for obj_id, model in models.items():
        number = obj_id - 1
        if not folder.has(_model_piece(number)):
            content: dict[str, Content] = {
                f"models/{number:03d}/{name}": data for name, data in model_files(model).items()
            }
            folder.write_piece(_model_piece(number), content)


def _model_piece(number: int) -> str:
    return f"models/{number:03d}"


def _own_model_folders(scene: LabelledScene, numbers: Mapping[int, int]) -> dict[int, Path]:
    """Return the folders of a GraspNet source's models, to be copied, by the written number."""
    if not isinstance(scene, GraspnetLabelledScene) or scene.ref.models is None:
        return {}
    homes = {n: scene.ref.models / f"{i - 1:03d}" for i, n in numbers.items()}
    return {n: home for n, home in homes.items() if home.is_dir() and any(home.iterdir())}


def _loss_notes(losses: list[Loss]) -> list[str]:
    notes: list[str] = []
    rounded = max((x.depth_mm for x in losses), default=0.0)
    if rounded > 0:
        notes.append(f"depth was rounded to GraspNet's millimetres: by up to {rounded:.2f} mm.")
    for count, text in (
        (sum(x.too_far_px for x in losses), "depth pixels beyond 65.535 m are left out"),
        (sum(x.shared_px for x in losses), "pixels were in two masks; the nearer object has them"),
        (sum(x.merged for x in losses), "objects share their label value with an equal object"),
    ):
        if count:
            notes.append(f"{count} {text}.")
    return notes


def _model_notes(plan: WritePlan, models: set[int]) -> list[str]:
    missing = sorted(set(plan.numbers.values()) - models)
    if not missing:
        return []
    return [f"the source has no mesh of object(s) {', '.join(f'{n:03d}' for n in missing[:10])}."]
