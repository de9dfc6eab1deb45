"""Scenes of other programs as school scenes: GraspIT's scene.yaml, GraspNet-1Billion, BOP."""

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from realsim import images
from realsim.arrays import Array, Array32
from realsim.errors import InputError
from realsim.formats.graspit.scene import (
    SCENE_FILE,
    GraspitScene,
    QuaternionOrder,
    is_graspit_scene,
    read_graspit_scene,
)
from realsim.formats.graspnet.cameras import POSES
from realsim.formats.graspnet.models import require_meshes
from realsim.formats.graspnet.opening import is_graspnet_frame, open_graspnet_frame
from realsim.formats.graspnet.scene import GraspnetScene, cameras_of, read_graspnet_scene
from realsim.geometry import se3
from realsim.models.model_records import KnownSolid
from realsim.records import CameraIntrinsics, ObjectModel, ObjectPose, Scene, SupportPlane
from realsim.store.opening import CAMERA_FILE
from realsim_sim_bridge.scenes.school_scene import Matter, SchoolScene, known_solids

TABLE_STRIDE = 6
"""Every how many rows and columns of a depth image is looked at for the table."""
SUNK_M = 0.0015
"""What all objects reach into the table beyond this is common to them [m]: depth cameras are right
to about a millimetre at half a metre."""


def _with_matter(found: GraspitScene | GraspnetScene, matter: Matter | None) -> SchoolScene:
    """Return what a reader found, with masses and convex parts."""
    return SchoolScene(
        scene=found.scene,
        models=found.models,
        solids=known_solids(found.models, matter),
        notes=found.notes,
    )


def from_bop(
    folder: Path | str,
    scene_id: int | None = None,
    matter: Matter | None = None,
    *,
    image: int | None = None,
    models: Path | None = None,
) -> SchoolScene:
    """Return a scene of a BOP dataset, its objects as annotated, its table as the depth shows it.

    World is the dataset's own where every image has cam_R_w2c: then the objects are those of all
    images, each at its median position. Else world is the camera of one image, and the objects are
    those annotated in it.

    Args:
        folder: dataset, split or scene.
        scene_id: number of the scene, where there are several.
        matter: weighed masses, convex parts.
        image: number of the image; None = the first that has annotations and depth.
        models: folder of the models; None = 'models' of the dataset.

    Raises:
        InputError: no scene or several, no annotation, no depth, no table in it, no model.
    """
    from realsim.formats.bop.models import load_models
    from realsim.formats.bop.scene import BopScene, read_scene
    from realsim.formats.bop.source import choose_scene

    bop: BopScene = read_scene(choose_scene(folder, scene_id))
    usable = [i for i, rows in sorted(bop.ground_truth.items()) if rows and bop.has_depth(i)]
    if image is not None and image not in usable:
        raise InputError(
            f"image {image} of {bop.ref.folder} has no annotated object, or no depth; these have "
            f"both: {', '.join(map(str, usable[:12])) or 'none'}."
        )
    if not usable:
        raise InputError(
            f"{bop.ref.folder} has no image with annotated objects and depth; poses and table "
            "come from there. Register its images first: `realsim upgrade`."
        )
    cameras = bop.Ts_world_cam if image is None else None
    notes: list[str] = []
    if bop.approximate:
        notes.append(f"the poses are of {bop.ground_truth_file}, which calls itself approximate.")
    if cameras is None:
        first = usable[0] if image is None else image
        cameras = {first: np.eye(4)}
        notes.append(f"the poses are those of image {first}; world is its camera.")
    used = [i for i in usable if i in cameras]
    rows = {i: [(a.obj_id, a.T_cam_obj) for a in bop.ground_truth[i]] for i in used}
    objects, said = _consensus(rows, cameras)
    notes += said
    depths = {i: bop.depth_m(i) for i in _some(used)}
    plane, said = _table(str(bop.ref.folder), bop.session.intrinsics, depths, cameras)
    notes += said
    models_folder = models or bop.ref.folder.parent.parent / "models"
    loaded = load_models(models_folder, {o.obj_id for o in objects})
    notes += _sunk(objects, loaded, plane)
    scene = Scene(name=f"{bop.ref.split}-{bop.ref.folder.name}", objects=objects, plane=plane)
    return SchoolScene(
        scene=scene,
        models=loaded,
        solids=known_solids(loaded, matter, _library_solids(models_folder, loaded)),
        notes=tuple(notes),
    )


def _library_solids(folder: Path, models: Mapping[int, ObjectModel]) -> dict[int, KnownSolid]:
    """Return what a model library already knows; a plain BOP folder knows nothing."""
    from realsim.models.library_reading import LibraryReader

    library = LibraryReader.open(folder)
    found = {i: library.solid(i)[0] for i in models}
    return {i: solid for i, solid in found.items() if solid is not None}


def _consensus(
    rows: Mapping[int, list[tuple[int, Array]]], cameras: Mapping[int, Array]
) -> tuple[tuple[ObjectPose, ...], list[str]]:
    """Return the objects in world: of several images each at its median position.

    The k-th row of one id in an image counts as its k-th instance.
    """
    seen: dict[tuple[int, int], list[Array]] = {}
    for image, annotations in rows.items():
        counts: dict[int, int] = {}
        for obj_id, T_cam_obj in annotations:
            k = counts[obj_id] = counts.get(obj_id, -1) + 1
            seen.setdefault((obj_id, k), []).append(cameras[image] @ T_cam_obj)
    objects: list[ObjectPose] = []
    worst = 0.0
    for instance, ((obj_id, _), found) in enumerate(seen.items()):
        Ts = np.stack(found)
        middle = np.median(Ts[:, :3, 3], axis=0)
        off = np.linalg.norm(Ts[:, :3, 3] - middle, axis=1)
        worst = max(worst, float(off.max()))
        # A pose that was given, not a mean: symmetric objects may be annotated turned.
        objects.append(
            ObjectPose(obj_id=obj_id, instance=instance, T_world_obj=Ts[int(np.argmin(off))])
        )
    if len(rows) == 1:
        return tuple(objects), []
    words = f"the annotations of {len(rows)} images differ by up to {1e3 * worst:.1f} mm."
    return tuple(objects), [words]


def from_graspnet_frame(
    folder: Path | str, matter: Matter | None = None, *, models: Path | None = None
) -> SchoolScene:
    """Return one image of GraspNet on its own: objects as its meta file has them, world its camera.

    Raises:
        InputError: a file is missing or damaged, an object has no mesh, the depth shows no table.
    """
    found = open_graspnet_frame(folder, models=models or Path(folder) / "models")
    frame, loaded = found.frame(0), dict(found.models())
    require_meshes(
        [o.obj_id for o in frame.objects], loaded, str(models or Path(folder) / "models")
    )
    objects = tuple(
        ObjectPose(obj_id=o.obj_id, instance=k, T_world_obj=o.T_cam_obj)
        for k, o in enumerate(frame.objects)
    )
    depth_file, unit_m = found.depth_file(0), frame.depth_unit_m
    assert depth_file is not None and unit_m is not None
    depths = {0: images.read_depth(depth_file, unit_m)}
    plane, said = _table(str(folder), frame.intrinsics, depths, {0: np.eye(4)})
    return SchoolScene(
        scene=Scene(name=found.name, objects=objects, plane=plane),
        models=loaded,
        solids=known_solids(loaded, matter),
        notes=(*found.notes, *said, *_sunk(objects, loaded, plane)),
    )


def _some(images: Sequence[int]) -> Sequence[int]:
    """Return the images whose depth is looked at for the table."""
    return images[:: max(1, -(-len(images) // 8))]


def _table(
    name: str, intrinsics: CameraIntrinsics, depths_m: Mapping[int, Array32],
    cameras: Mapping[int, Array],
) -> tuple[SupportPlane, list[str]]:  # fmt: skip
    """Return the table that depth images (H, W) [m] show.

    Raises:
        InputError: they show none.
    """
    from realsim.registration.evidence import DepthFrame, EvidenceConfig, measure_noise
    from realsim.registration.find_table import find_table
    from realsim.registration.views import SampleConfig, sample_views

    frames = [DepthFrame(index=i, depth_m=d, T_world_cam=cameras[i]) for i, d in depths_m.items()]
    noise = measure_noise(frames, EvidenceConfig())
    views = sample_views(intrinsics, frames, noise, SampleConfig(stride=TABLE_STRIDE))
    found = find_table(views, noise)
    if found.plane is None:
        raise InputError(f"no table is seen in the depth of {name}: {found.reason}")
    return found.plane, [
        f"the table is the plane of {100 * found.share:.0f} % of the depth around the middle, RMS "
        f"{1e3 * found.plane.rms_m:.1f} mm."
    ]


def _sunk(
    objects: Sequence[ObjectPose], models: Mapping[int, ObjectModel], plane: SupportPlane
) -> list[str]:
    """Say when all objects lie below the table alike: then it is the poses or the depth."""
    T = se3.invert(plane.T_world_table)
    low = [
        float(se3.transform(T @ o.T_world_obj, models[o.obj_id].mesh.vertices)[:, 2].min())
        for o in objects
    ]
    if max(low) > -SUNK_M:
        return []
    return [
        f"all {len(low)} objects reach {-1e3 * max(low):.1f} to {-1e3 * min(low):.1f} mm into the "
        "table: the depth reads short, or the poses are off as a whole. `realsim upgrade` fits the "
        "poses to the depth."
    ]


# --- Which of the known kinds of scene a path holds ----------------------------------------------


def load_scene_source(
    path: Path | str,
    matter: Matter | None = None,
    *,
    models: Path | None = None,
    scene_id: int | None = None,
    order: QuaternionOrder | None = None,
) -> SchoolScene:
    """Read a scene of any known kind, told apart by what the folder holds.

    Args:
        path: a scene.yaml or its folder, a GraspNet scene or image, a BOP dataset, split or scene.
        matter: weighed masses, convex parts.
        models: folder of the models (meshes), where it is not at its usual place.
        scene_id: number of the scene in a BOP dataset of several.
        order: of a scene.yaml's quaternions, where its content does not tell it.

    Raises:
        InputError: nothing there is known; what was found and what is read is named.
    """
    path = Path(path)
    if not path.exists():
        raise InputError(f"'{path}' does not exist; a scene's file or folder is expected.")
    if is_graspit_scene(path):
        return _with_matter(read_graspit_scene(path, order=order, meshes=models), matter)
    if path.is_dir():
        if is_graspnet_frame(path):
            return from_graspnet_frame(path, matter, models=models)
        if cameras_of(path) or ((path / POSES).is_file() and cameras_of(path.parent)):
            return _with_matter(read_graspnet_scene(path, models), matter)
        if any(next(path.glob(f"{p}{CAMERA_FILE}"), None) for p in ("", "*/", "*/*/")):
            return from_bop(path, scene_id, matter, models=models)
    raise InputError(
        f"'{path}' holds no scene that is known: {_contents(path)}. Read are a {SCENE_FILE} of "
        "GraspIT (object1: {file_path, name, orientation, position}), a scene of GraspNet-1Billion "
        f"(realsense/{POSES} or kinect/{POSES}), one image of it (color.png, depth.png, meta.mat), "
        f"and a BOP dataset, split or scene ({CAMERA_FILE}). Of a folder of meshes make a scene: "
        "`realsim generate NEW --pool MESHES --scenes 1`, then `realsim school NEW/scene_000000`."
    )


def _contents(path: Path) -> str:
    if path.is_file():
        return f"it is a file of the kind '{path.suffix}' without the keys of a scene"
    names = sorted(p.name for p in path.iterdir())
    return (
        f"the folder has {', '.join(names[:12]) or 'nothing'}{', ...' if len(names) > 12 else ''}"
    )
