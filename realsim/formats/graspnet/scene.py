"""The scenes of GraspNet-1Billion (Fang et al. 2020): annotated objects in the table's frame.

    SCENE/{realsense,kinect}/{annotations/0000.xml, camera_poses.npy, cam0_wrt_table.npy}
    MODELS/000/{nontextured.ply, textured.obj, ...}

Metres, OpenCV cameras. In spite of its name, pos_in_world/ori_in_world is the object's pose in
THIS image's camera, the quaternion w x y z (graspnetAPI's xmlhandler), so that

    T_table_obj = cam0_wrt_table @ camera_poses[i] @ T_cam_obj

GraspNet's objects count from 0, realsim's ids are one more (as are the dataset's cls_indexes). The
data set's numbers have four decimals: 0.05 mm and 0.01 deg at best.

Finding scenes of GraspNet-1Billion: a root, its scenes, one scene, or one camera's folder.
"""

from collections.abc import Collection
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

import numpy as np

from realsim.arrays import Array
from realsim.errors import InputError
from realsim.formats.graspnet.annotations import ANNOTATIONS, read_objects
from realsim.formats.graspnet.cameras import POSES, read_camera_poses
from realsim.formats.graspnet.image_objects import META
from realsim.formats.graspnet.labelled import RGB, GraspnetSceneRef
from realsim.formats.graspnet.models import load_models, require_meshes
from realsim.geometry import se3
from realsim.records import ObjectModel, ObjectPose, Scene, SupportPlane

CAMERAS = ("realsense", "kinect")
SCENES, MODELS, SCENE_PREFIX = "scenes", "models", "scene_"


@dataclass(frozen=True, kw_only=True, slots=True)
class GraspnetTree:
    """What was found; scenes are opened one by one, by `open_scene`."""

    scenes: tuple[GraspnetSceneRef, ...]
    """By number, then camera."""
    notes: tuple[str, ...]


def open_graspnet(
    root: Path | str,
    *,
    scenes: Collection[int] | None = None,
    cameras: Collection[str] | None = None,
    models: Path | str | None = None,
) -> GraspnetTree:
    """Find the scenes of a tree.

    Args:
        root: the data set, its folder 'scenes', one scene, or the folder of one of its cameras.
        scenes: only these numbers; None = all.
        cameras: only these of 'realsense' and 'kinect'; None = all.
        models: folder of the models; None = 'models' beside 'scenes', where it is there.

    Raises:
        InputError: no scene there, or not one that was asked for.
    """
    root = Path(root)
    unknown = sorted(set(cameras or ()) - set(CAMERAS))
    if unknown:
        raise InputError(f"GraspNet has no camera '{unknown[0]}'; it has {', '.join(CAMERAS)}.")
    if models is not None and not Path(models).is_dir():
        raise InputError(f"{models} is no folder; the models' folder was expected.")
    folders = _camera_folders(root)
    wanted = [f for f in folders if cameras is None or f.name in cameras]
    if not wanted:
        there = sorted({f.name for f in folders})
        raise InputError(
            f"{root} has no scene of GraspNet-1Billion{' by those cameras' * bool(there)} "
            f"(cameras found: {', '.join(there) or 'none'}); the data set's root with "
            "scenes/scene_0000/realsense/rgb/0000.png, its folder 'scenes', one scene, or one of "
            "a scene's cameras is expected."
        )
    refs = [_ref(folder, models) for folder in wanted]
    if scenes is not None:
        missing = sorted(set(scenes) - {r.number for r in refs})
        if missing:
            raise InputError(
                f"{root} has no scene {missing[0]}; it has "
                f"{', '.join(str(n) for n in sorted({r.number for r in refs})[:20])}."
            )
        refs = [r for r in refs if r.number in scenes]
    refs.sort(key=lambda r: (r.number, r.camera))
    _require_once(refs)
    return GraspnetTree(scenes=tuple(refs), notes=tuple(_notes(refs)))


def _camera_folders(root: Path) -> list[Path]:
    """Return the folders of cameras under any of the places that may be given."""
    if _is_camera(root):
        return [root]
    if any(_is_camera(root / c) for c in CAMERAS):
        return [root / c for c in CAMERAS if _is_camera(root / c)]
    home = root / SCENES if (root / SCENES).is_dir() else root
    scenes = sorted(p for p in home.glob(f"{SCENE_PREFIX}*") if p.is_dir())
    return [s / c for s in scenes for c in CAMERAS if _is_camera(s / c)]


def _is_camera(folder: Path) -> bool:
    has_poses = (folder / ANNOTATIONS).is_dir() or (folder / META).is_dir()
    return (folder / RGB).is_dir() and has_poses


def _ref(folder: Path, models: Path | str | None) -> GraspnetSceneRef:
    scene = folder.resolve().parent
    digits = scene.name.removeprefix(SCENE_PREFIX)
    number = int(digits) if digits.isascii() and digits.isdigit() and len(digits) <= 9 else 0
    beside = scene.parent.parent / MODELS
    home = Path(models) if models is not None else beside if beside.is_dir() else None
    return GraspnetSceneRef(number=number, camera=folder.resolve().name, folder=folder, models=home)


def _require_once(refs: list[GraspnetSceneRef]) -> None:
    for a, b in pairwise(refs):
        if a.name == b.name:
            raise InputError(
                f"{a.folder} and {b.folder} are both {a.name}; name scenes scene_0000 and on."
            )


def _notes(refs: list[GraspnetSceneRef]) -> list[str]:
    notes: list[str] = []
    if any(r.models is None for r in refs):
        notes.append("there is no folder 'models' beside 'scenes': the objects have no meshes.")
    unnumbered = [r for r in refs if not r.folder.resolve().parent.name[-4:].isdigit()]
    if unnumbered:
        notes.append(
            f"{unnumbered[0].folder} is in no scene_0000 folder: its number is taken as 0."
        )
    strange = sorted({r.camera for r in refs} - set(CAMERAS))
    if strange:
        notes.append(f"GraspNet has no camera '{strange[0]}'; its name is kept.")
    return notes


CHECKED_VIEWS = 8
"""Other images whose annotations are compared with the one that is used."""
AGREE_M = 0.005
"""Annotations of one standing object that differ by more between images are named."""


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class GraspnetScene:
    """One scene as seen by one camera."""

    scene: Scene
    """World is the table's frame, z up."""
    models: dict[int, ObjectModel]
    notes: tuple[str, ...]


def cameras_of(folder: Path) -> list[str]:
    """Return the cameras of a GraspNet scene folder; none if it is not one."""
    return [c for c in CAMERAS if (folder / c / POSES).is_file()]


def read_graspnet_scene(folder: Path | str, models: Path | str | None = None) -> GraspnetScene:
    """Read one scene, its objects as image 0 is annotated.

    Args:
        folder: scene_0000 (of its cameras realsense is read where it is there), or the folder of
            one of its cameras.
        models: folder of the models; None = 'models' beside 'scenes', as the dataset has it.

    Raises:
        InputError: a file is missing, damaged, or of another scene.
        NotRigidError: a matrix that is no rigid transform.
    """
    root = Path(folder)
    if root.name not in CAMERAS or not (root / POSES).is_file():
        there = cameras_of(root)
        if not there:
            raise InputError(
                f"{folder} has no {' or '.join(CAMERAS)}/{POSES}; a scene of GraspNet-1Billion is "
                "expected (cameras found: none)."
            )
        root = root / there[0]
    Ts_table_cam = read_camera_poses(root)
    files = _annotation_files(root)
    if 0 not in files:
        raise InputError(
            f"{root / ANNOTATIONS} has no annotation of image 0 with a camera pose; there are "
            f"{len(files)} annotations and {len(Ts_table_cam)} poses."
        )
    Ts = _objects_on_table(files[0], Ts_table_cam[0])
    folder = Path(models) if models is not None else root.parent.parent.parent / "models"
    notes = ["ids are GraspNet's object numbers + 1; names are its numbers."]
    loaded = load_models(folder, list(Ts), notes)
    require_meshes([i + 1 for i in Ts], loaded, str(folder))
    notes += _disagreements(files, Ts_table_cam, Ts)
    notes.append(_heights(loaded, Ts))
    objects = tuple(
        ObjectPose(obj_id=i + 1, instance=k, T_world_obj=T) for k, (i, T) in enumerate(Ts.items())
    )
    plane = SupportPlane(T_world_table=np.eye(4))
    name = f"{root.parent.name} {root.name}"
    scene = Scene(name=name, objects=objects, plane=plane)
    return GraspnetScene(scene=scene, models=loaded, notes=tuple(notes))


def _annotation_files(root: Path) -> dict[int, Path]:
    files = {int(p.stem): p for p in (root / ANNOTATIONS).glob("*.xml") if p.stem.isdecimal()}
    if not files:
        raise InputError(f"{root} has no {ANNOTATIONS}/0000.xml; the objects' poses are in there.")
    return dict(sorted(files.items()))


def _objects_on_table(path: Path, T_table_cam: Array) -> dict[int, Array]:
    """Return T_table_obj (4, 4) by GraspNet's object number, in the order of the file."""
    return {i: T_table_cam @ T for i, T in read_annotation(path).items()}


def read_annotation(path: Path) -> dict[int, Array]:
    """Return T_cam_obj (4, 4) [m] by GraspNet's object number.

    Raises:
        InputError: missing, too large, with entities, not GraspNet's XML, or an object twice.
    """
    found: dict[int, Array] = {}
    for o in read_objects(path):
        if o.number in found:
            raise InputError(f"{path} has the obj_id {o.number} twice; whole numbers, each once.")
        found[o.number] = o.T_cam_obj
    if not found:
        raise InputError(f"{path} holds no <obj>; <scene><obj>...</obj></scene> is expected.")
    return found


def _disagreements(files: dict[int, Path], Ts_table_cam: Array, Ts: dict[int, Array]) -> list[str]:
    """Compare with other images' annotations: the objects stand still."""
    others = [i for i in files if 0 < i < len(Ts_table_cam)]
    others = others[:: max(1, len(others) // CHECKED_VIEWS)][:CHECKED_VIEWS]
    worst, name, at = 0.0, -1, -1
    for i in others:
        seen = _objects_on_table(files[i], Ts_table_cam[i])
        for k in Ts.keys() & seen.keys():
            off = float(np.linalg.norm(Ts[k][:3, 3] - seen[k][:3, 3]))
            if off > worst:
                worst, name, at = off, k, i
    if worst <= AGREE_M:
        return []
    return [
        f"object {name:03d} lies {1e3 * worst:.1f} mm elsewhere by the annotation of image {at}: "
        "that of image 0 was used."
    ]


def _heights(models: dict[int, ObjectModel], Ts: dict[int, Array]) -> str:
    """Say where the objects' lowest points lie: nothing else tells whether z = 0 is the table."""
    low = [
        1e3 * float(se3.transform(T, models[i + 1].mesh.vertices)[:, 2].min())
        for i, T in Ts.items()
    ]
    return (
        f"the objects' lowest points lie {min(low):.1f} to {max(low):.1f} mm above the table's "
        "z = 0 of cam0_wrt_table."
    )
