"""Which of the known kinds of scene a path holds."""

from collections.abc import Sequence
from pathlib import Path

from realsim.errors import InputError
from realsim.formats.graspit.scene import SCENE_FILE, QuaternionOrder, is_graspit_scene
from realsim.formats.graspnet.cameras import POSES
from realsim.formats.graspnet.scene import cameras_of
from realsim.store.session_store import CAMERA_FILE
from realsim_sim_bridge.scenes.importers import from_bop, from_graspit_yaml, from_graspnet
from realsim_sim_bridge.scenes.school_scene import Matter, SchoolScene, Support


def load_scene_source(
    path: Path | str,
    matter: Matter | None = None,
    *,
    models: Path | None = None,
    scene_id: int | None = None,
    supports: Sequence[Support] = (),
    order: QuaternionOrder | None = None,
) -> SchoolScene:
    """Read a scene of any known kind, told apart by what the folder holds.

    Args:
        path: a scene.yaml or its folder, a GraspNet scene, or a BOP dataset, split or scene.
        matter: weighed masses, convex parts.
        models: folder of the models (meshes), where it is not at its usual place.
        scene_id: number of the scene in a BOP dataset of several.
        supports: bodies besides the table that stand still.
        order: of a scene.yaml's quaternions, where its content does not tell it.

    Raises:
        InputError: nothing there is known; what was found and what is read is named.
    """
    path = Path(path)
    if not path.exists():
        raise InputError(f"'{path}' does not exist; a scene's file or folder is expected.")
    if is_graspit_scene(path):
        return from_graspit_yaml(path, matter, supports=supports, order=order, meshes=models)
    if path.is_dir():
        if cameras_of(path) or ((path / POSES).is_file() and cameras_of(path.parent)):
            return from_graspnet(path, matter, models=models, supports=supports)
        if any(next(path.glob(f"{p}{CAMERA_FILE}"), None) for p in ("", "*/", "*/*/")):
            return from_bop(path, scene_id, matter, models=models, supports=supports)
    raise InputError(
        f"'{path}' holds no scene that is known: {_contents(path)}. Read are a {SCENE_FILE} of "
        "GraspIT (object1: {file_path, name, orientation, position}), a scene of GraspNet-1Billion "
        f"(realsense/{POSES} or kinect/{POSES}), and a BOP dataset, split or scene "
        f"({CAMERA_FILE})."
    )


def _contents(path: Path) -> str:
    if path.is_file():
        return (
            f"it is a file of the kind '{path.suffix or 'no suffix'}' without the keys of a scene"
        )
    names = sorted(p.name for p in path.iterdir())
    return (
        f"the folder has {', '.join(names[:12]) or 'nothing'}{', ...' if len(names) > 12 else ''}"
    )
