"""Finding scenes of GraspNet-1Billion: a root, its scenes, one scene, or one camera's folder."""

from collections.abc import Collection
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

from realsim.errors import InputError
from realsim.formats.graspnet.annotations import ANNOTATIONS
from realsim.formats.graspnet.labelled import RGB, GraspnetSceneRef
from realsim.formats.graspnet.meta import META

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
