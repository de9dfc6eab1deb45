"""Opening BOP scenes with their labels: what is there is read, compared and checked."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from realsim import images
from realsim.arrays import Array, evenly
from realsim.errors import InputError
from realsim.formats.bop import evidence
from realsim.formats.bop.instances import stated_instances, tell_apart
from realsim.formats.bop.labelled import BopLabelledScene, SceneContent, model_ids
from realsim.formats.bop.rows import GroundTruth, Json, read_ground_truth, read_object_lists
from realsim.formats.bop.run_lengths import read_coco_masks
from realsim.formats.bop.scene import GT_FILE, BopSceneRef, cameras_with_images, ground_truth_file
from realsim.formats.bop.source import choose_scene
from realsim.formats.bop.surfaces import LabelledDepth, require_surfaces
from realsim.formats.evidence import depth_ratio
from realsim.formats.folders.listing import image_header, shown
from realsim.records import ObjectModel
from realsim.records import bop_units as units
from realsim.records.capture import CaptureSession
from realsim.untrusted.values import number

MODEL_FOLDERS = ("models", "models_cad", "models_reconst", "models_eval")
"""T-LESS has two kinds of models; those made in CAD are its default."""
DEPTH_SAMPLES = 3
"""Images whose depth is compared with the labels: one program wrote them all."""


def open_labelled_bop(
    root: Path | str,
    *,
    scene: int | None = None,
    camera: str = "",
    models: Path | str | Mapping[int, ObjectModel] | None = None,
) -> BopLabelledScene:
    """Open the scene of a data set that was asked for, or its only one.

    `find_scenes` lists all scenes, for `open_labelled_scene`.

    Args:
        root: data set, split or scene.
        scene: its number.
        camera: type of its camera, where it has several.
        models: a models folder, or models by object id; None = beside the split.

    Raises:
        InputError: no such scene, several, or one that cannot be read; see `open_labelled_scene`.
    """
    return open_labelled_scene(choose_scene(root, scene, camera=camera), models=models)


def open_labelled_scene(
    ref: BopSceneRef, *, models: Path | str | Mapping[int, ObjectModel] | None = None
) -> BopLabelledScene:
    """Open a scene of `find_scenes` with its labels.

    Args:
        ref: the scene.
        models: a models folder, or models by object id; None = beside the split.

    Raises:
        InputError: something is missing, broken, or contradicts something else: counts of rows and
            masks, sizes of images, the direction or the order of poses.
        NotRigidError: a rotation that is none.
        UnitError: lengths or depth in another unit than BOP's.
    """
    layout = ref.layout
    notes: list[str] = []
    cameras, colour, missing = cameras_with_images(ref)
    if missing:
        listed = shown([str(i) for i in missing], 12)
        name = layout.document("scene_camera").name
        notes.append(f"{name} lists images that are not there: {listed}.")
    there = layout.depth_files()
    depth = {i: there[i] for i in cameras if i in there}
    truth = _ground_truth(ref, cameras, notes)
    infos = _infos(layout.document("scene_gt_info"), truth, notes)
    masks = (layout.mask_numbers(visible=False), layout.mask_numbers(visible=True))
    _require_masks(ref, truth, masks)
    run_lengths: dict[tuple[int, int], Json] = {}
    coco = layout.document("scene_gt_coco")
    if truth is not None and not masks[True] and coco.is_file():
        run_lengths, doubtful = read_coco_masks(coco, truth.rows, infos)
        if doubtful:
            notes.append(
                f"{len(doubtful)} images have masks in {coco.name} that could not be paired with "
                f"the rows of {GT_FILE}: {shown([str(i) for i in doubtful], 12)}."
            )
    content = SceneContent(
        cameras=cameras,
        colour=colour,
        depth=depth,
        sizes=_sizes(cameras, colour, depth),
        truth=truth,
        infos=infos,
        masks=masks,
        run_lengths=run_lengths,
        models=_models(ref, models),
    )
    found = BopLabelledScene(ref, content, notes)
    _check(found, infos)
    return found


def _ground_truth(
    ref: BopSceneRef, cameras: Mapping[int, Json], notes: list[str]
) -> GroundTruth | None:
    file = ground_truth_file(ref)
    if file is None:
        notes.append("the scene has no scene_gt.json: its objects are not known.")
        return None
    if file != ref.layout.document("scene_gt"):
        notes.append(f"the labels are those of {file.name}: no reference, only a rough start.")
    truth = read_ground_truth(file)
    without = [i for i in cameras if i not in truth.rows]
    if without:
        notes.append(f"{file.name} has no entry for {len(without)} of {len(cameras)} images.")
    if beyond := [str(i) for i in truth.rows if i not in cameras]:
        notes.append(
            f"{file.name} has labels of images that are not there; they are left out: "
            f"{shown(beyond, 12)}."
        )
    return truth


def _infos(path: Path, truth: GroundTruth | None, notes: list[str]) -> dict[int, list[Json]]:
    """Return the rows of scene_gt_info.json, as many per image as scene_gt.json has."""
    if truth is None or not path.is_file():
        return {}
    infos = read_object_lists(path)
    for i, rows in truth.rows.items():
        if i in infos and len(infos[i]) != len(rows):
            raise InputError(
                f"{path} has {len(infos[i])} objects in image {i}, {truth.file.name} has "
                f"{len(rows)}: they belong together one by one. Compute {path.name} again."
            )
    without = [i for i in truth.rows if i not in infos]
    if without:
        notes.append(f"{path.name} has no entry for {len(without)} images.")
    return infos


def _require_masks(
    ref: BopSceneRef,
    truth: GroundTruth | None,
    masks: tuple[Mapping[int, set[int]], Mapping[int, set[int]]],
) -> None:
    """Raise if an image has masks, but not one for each of its objects."""
    if truth is None:
        return
    for visible in (False, True):
        folder = ref.layout.images("mask_visib" if visible else "mask")
        for i, rows in truth.rows.items():
            places = masks[visible].get(i)
            if places and places != set(range(len(rows))):
                raise InputError(
                    f"{folder} has {len(places)} masks of image {i} (up to {i:06d}_"
                    f"{max(places):06d}.png), {truth.file.name} has {len(rows)} objects in it: one "
                    "for each is expected. Make the masks again, or delete those of this image."
                )


def _sizes(
    cameras: Mapping[int, Json], colour: Mapping[int, Path], depth: Mapping[int, Path]
) -> dict[int, tuple[int, int]]:
    """Return width and height of each image; depth has the same."""
    sizes: dict[int, tuple[int, int]] = {}
    for i in cameras:
        sizes[i] = image_header(colour[i]).size
        if i not in depth:
            continue
        header = image_header(depth[i])
        if header.size != sizes[i] or not header.deep:
            raise InputError(
                f"{depth[i]} has {header.width}x{header.height} pixels of "
                f"{'16' if header.deep else '8'} bit; {sizes[i][0]}x{sizes[i][1]} of 16 bit are "
                f"expected, on the pixels of {colour[i].name}."
            )
    return sizes


def _models(
    ref: BopSceneRef, given: Path | str | Mapping[int, ObjectModel] | None
) -> Path | Mapping[int, ObjectModel] | None:
    if isinstance(given, (str, Path)):
        if not model_ids(Path(given)):
            found = "has no models" if Path(given).is_dir() else "does not exist"
            raise InputError(f"{given} {found}; obj_000001.ply, ... are expected.")
        return Path(given)
    if given is not None:
        return given
    root = ref.folder.parent.parent
    folders = [ref.folder / "models", *(root / name for name in MODEL_FOLDERS)]
    return next((f for f in folders if f.is_dir() and model_ids(f)), None)


# --- what contradicts ---------------------------------------------------------------------------


def _check(scene: BopLabelledScene, infos: Mapping[int, Sequence[Json]]) -> None:
    """Check every camera and what the labels say of units, directions and order."""
    poses: dict[int, Array | None] = {}
    beside: list[str] = []
    where = str(scene.ref.folder)
    for i in scene.indices:
        camera = scene.intrinsics(i)
        unit_m = scene.depth_unit_m(i)
        if unit_m is not None:  # the record knows which units a count may have
            CaptureSession(name=scene.name, intrinsics=camera, depth_unit_m=unit_m)
        poses[i] = scene.T_world_cam(i)
        if not (0 <= camera.cx < camera.width and 0 <= camera.cy < camera.height):
            beside.append(str(i))
    if beside:
        scene.notes_found.append(
            f"cam_K has its principal point outside of image {shown(beside, 12)}: is it of another "
            "camera, or of another image size?"
        )
    truth = scene.truth
    if truth is None:
        return
    posed = [i for i in scene.indices if poses[i] is not None]
    if not posed:
        scene.notes_found.append("the images have no camera poses (cam_R_w2c, cam_t_w2c).")
    elif len(posed) < len(scene.indices):
        scene.notes_found.append(
            f"{len(scene.indices) - len(posed)} of {len(scene.indices)} images have no camera pose."
        )
    if len(posed) > 1:
        Ts = np.stack([T for T in (poses[i] for i in posed) if T is not None])
        said = evidence.check_camera_poses(Ts, _things(truth, posed), where)
        scene.notes_found.append(said.removeprefix(f"{where}: "))
    _check_boxes(scene, truth, infos, where)
    _check_depth(scene, where)
    _check_masks(scene, where)
    _tell_apart(scene, truth, poses)
    _name_missing_models(scene, truth)


def _things(truth: GroundTruth, posed: Sequence[int]) -> list[evidence.Thing]:
    """Return the views of each object that no image shows twice."""
    found: dict[int, evidence.Thing] = {}
    doubled: set[int] = set()
    for view, i in enumerate(posed):
        ids = truth.obj_ids[truth.places(i)].tolist()
        doubled |= {obj_id for obj_id in ids if ids.count(obj_id) > 1}
        for obj_id, T in zip(ids, truth.Ts_cam_obj[truth.places(i)], strict=True):
            found.setdefault(obj_id, []).append((view, T))
    return [rows for obj_id, rows in found.items() if obj_id not in doubled]


def _check_boxes(
    scene: BopLabelledScene, truth: GroundTruth, infos: Mapping[int, Sequence[Json]], where: str
) -> None:
    corners = _corners(scene)
    boxes: list[Any] = []
    for i in evenly(scene.indices, evidence.MOST_BOXES):
        Ts = truth.Ts_cam_obj[truth.places(i)]
        for k, info in enumerate(infos.get(i, ())):
            box = info.get("bbox_obj")
            if k < len(Ts) and isinstance(box, list) and len(box) == 4:  # pyright: ignore[reportUnknownArgumentType]
                numbers = [number(v, f"bbox_obj of object {k} of image {i}") for v in box]  # pyright: ignore[reportUnknownVariableType]
                obj_id = int(truth.obj_ids[truth.places(i)][k])
                boxes.append((numbers, obj_id, Ts[k], scene.intrinsics(i)))
    evidence.require_boxes(boxes, corners, where)


def _corners(scene: BopLabelledScene) -> dict[int, Array]:
    """Return the corners (8, 3) [m] of the objects' boxes, as models_info.json has them."""
    corners: dict[int, Array] = {}
    for obj_id, row in scene.models_info().items():
        if all(f"{side}_{axis}" in row for side in ("min", "size") for axis in "xyz"):
            name = f"object {obj_id} of models_info.json"
            low = np.array([number(row[f"min_{a}"], f"min_{a} of {name}") for a in "xyz"])
            size = np.array([number(row[f"size_{a}"], f"size_{a} of {name}") for a in "xyz"])
            grid = np.stack(np.meshgrid([0, 1], [0, 1], [0, 1]), -1).reshape(-1, 3)
            corners[obj_id] = (low + grid * size) / units.MM_PER_M
    return corners


def _check_masks(scene: BopLabelledScene, where: str) -> None:
    """Check that the objects are seen where camera and poses project them to."""
    corners = _corners(scene)
    found: list[bool] = []
    for i in evenly(scene.indices, DEPTH_SAMPLES):
        for k, o in enumerate(scene.frame(i).objects):
            mask = scene.mask(i, k, visible=True) if o.obj_id in corners else None
            if mask is not None and np.any(mask):
                camera, box = scene.intrinsics(i), corners[o.obj_id]
                found.append(evidence.is_seen_in_box(mask, camera, o.T_cam_obj, box))
    evidence.require_projection(found, where)


def _check_depth(scene: BopLabelledScene, where: str) -> None:
    deep = [i for i in scene.indices if scene.depth_file(i) is not None]
    if not deep:
        scene.notes_found.append("the images have no depth.")
        return
    ratios: list[float] = []
    measured: list[LabelledDepth] = []
    unit_m = 0.0
    try:
        models = scene.models()
    except InputError:
        models = {}  # a broken mesh is told where it is needed
    for i in evenly(deep, DEPTH_SAMPLES):
        file, unit = scene.depth_file(i), scene.depth_unit_m(i)
        if file is None or unit is None:
            continue
        unit_m = unit
        depth_m = images.read_depth(file, unit)
        frame = scene.frame(i)
        known = [(o.obj_id, o.T_cam_obj) for o in frame.objects if o.obj_id in models]
        measured.append(LabelledDepth(depth_m=depth_m, intrinsics=frame.intrinsics, objects=known))
        for k, o in enumerate(frame.objects):
            mask = scene.mask(i, k, visible=True)
            ratio = depth_ratio(depth_m, mask, frame.intrinsics, o.T_cam_obj)
            ratios += [] if ratio is None else [ratio]
    # Poses first: inverted ones look like another unit of the depth.
    notes = [
        require_surfaces(measured, models, where),
        evidence.require_depth_unit(ratios, unit_m, where).removeprefix(f"{where}: "),
    ]
    scene.notes_found += [note for note in notes if note]


def _tell_apart(
    scene: BopLabelledScene, truth: GroundTruth, poses: Mapping[int, Array | None]
) -> None:
    stated = stated_instances({i: truth.rows.get(i, []) for i in scene.indices})
    if stated is not None:
        scene.instances = stated
        return
    ids = {i: truth.obj_ids[truth.places(i)].tolist() for i in scene.indices}
    positions: dict[int, Array | None] = {}
    for i in scene.indices:
        T, p_cam = poses[i], truth.Ts_cam_obj[truth.places(i), :3, 3]
        positions[i] = None if T is None else p_cam @ T[:3, :3].T + T[:3, 3]
    found = tell_apart(ids, positions)
    scene.instances = found.numbers
    if found.ambiguous:
        scene.notes_found.append(
            "instances of object "
            f"{', '.join(map(str, found.ambiguous))} could not be told apart from image to image: "
            "their positions in the world do not agree, or camera poses are missing."
        )


def _name_missing_models(scene: BopLabelledScene, truth: GroundTruth) -> None:
    folder = scene.models_folder
    used = sorted(set(truth.obj_ids.tolist()))
    present = set(scene.models()) if folder is None else set(model_ids(folder))
    missing = [i for i in used if i not in present]
    if missing:
        where = "among the models that were given" if folder is None else f"in {folder}"
        scene.notes_found.append(f"object {', '.join(map(str, missing))} has no mesh {where}.")
