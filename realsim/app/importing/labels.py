"""What a data set knows beside its images: kept in the session, and made ready to be registered."""

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from realsim.app.console import Console
from realsim.app.stages import save_starts
from realsim.arrays import Array
from realsim.errors import InputError
from realsim.formats.bop.models import INFO_FILE, save_models
from realsim.formats.bop.source import BopSource
from realsim.formats.frame_source import FrameSource
from realsim.formats.graspnet.cameras import CameraPlacer
from realsim.formats.graspnet.models import what_to_give
from realsim.formats.imported_labels import load_imported, save_imported
from realsim.formats.labelled_scene import LabelledFrames, LabelledScene
from realsim.records import ObjectPose
from realsim.store import SessionStore

if TYPE_CHECKING:
    from realsim.app.importing.source import ImportRequest

SAME_PLACE_M = 0.02
"""Objects of one id that the data set does not number, and that lie this near in two frames, are
one thing: annotations are a few millimetres off, things of one kind stand farther apart."""


def labels_of(
    request: "ImportRequest", source: FrameSource
) -> tuple[LabelledScene, tuple[int, ...]] | None:
    """Return the labelled scene of an opened source and the numbers of its frames, if it is one.

    Raises:
        InputError: its labels contradict each other, or the images.
    """
    if isinstance(source, LabelledFrames):
        return source.scene, source.indices
    if not isinstance(source, BopSource):
        return None
    from realsim.formats.bop.opening import open_labelled_bop

    scene = open_labelled_bop(
        request.source, scene=request.scene, camera=request.camera_name, models=request.models
    )
    has_any = any(scene.frame(i).objects for i in source.indices)
    return (scene, source.indices) if has_any else None


def save_labels(
    scene: LabelledScene, indices: tuple[int, ...], store: SessionStore, console: Console
) -> bool:
    """Keep the labels and models of a data set in the session that its images were imported into.

    The labels lie in SESSION/imported, untouched by what realsim computes. Where the cameras'
    places are known, the poses become the starts that `realsim register` begins from.

    Args:
        scene: the data set's scene.
        indices: numbers of its images, in the order of the session's views.
        store: the session.
        console: where progress goes.

    Returns:
        False where the labels were there.

    Raises:
        InputError: a pose, a mask or a model cannot be used.
    """
    models = scene.models()
    if models and not (store.folder / "models" / INFO_FILE).is_file():
        save_models(store.folder / "models", models)
    if load_imported(store) is not None:
        return False
    _place_cameras(store, scene, indices, console)
    starts = starts_of(scene, indices, {v.index: v.T_world_cam for v in store.session.views})
    if starts:
        save_starts(store, starts, f"labels of {scene.name}")
    with console.stage("labels", scene.name) as tick:
        save_imported(store, scene, dict(enumerate(indices)), tick)
    return True


def show_labels(
    scene: LabelledScene, indices: tuple[int, ...], folder: Path, console: Console, *,
    can_register: bool,
) -> None:  # fmt: skip
    """Say which labels a session has now, what they are worth, and what to do with them.

    Args:
        scene: the data set's scene.
        indices: numbers of its images.
        folder: the session.
        console: where it is said.
        can_register: whether there is depth to register by.
    """
    ids = {o.obj_id for i in indices for o in scene.frame(i).objects}
    for note in scene.notes:
        if note.startswith("the labels"):  # what they are worth must not be missed
            console.warn(f"{scene.name}: {note}")
    poses = sum(len(scene.frame(i).objects) for i in indices)
    models = scene.models()
    missing = sorted(ids - set(models))
    then = f" `realsim register {folder}` refines and judges them." if can_register else ""
    console.say(
        f"labels    {poses} poses in {len(indices)} frames, {len(models)} models: kept in "
        f"{folder / 'imported'} as they are, not checked." + ("" if missing else then)
    )
    if missing:
        console.warn(
            f"{what_to_give(missing)} The same import again with it adds the models.{then}"
        )


def require_models(scene: LabelledScene, indices: tuple[int, ...], folder: Path) -> None:
    """Check that a folder of models that was given has a mesh of some object of the scene.

    Raises:
        InputError: it has none.
    """
    ids = {o.obj_id for i in indices for o in scene.frame(i).objects}
    if ids and not scene.models():
        raise InputError(f"{what_to_give(sorted(ids))} '{folder}' has none of them.")


def _place_cameras(
    store: SessionStore, scene: LabelledScene, indices: tuple[int, ...], console: Console
) -> None:
    """Place the cameras of a scene that does not tell by the objects, which stand still.

    World is then the first image's camera.
    """
    if store.session.Ts_world_cam:
        return
    placer = CameraPlacer()
    try:
        for index in indices:
            placer.add(scene.frame(index))
        placer.require_all(scene.name)
    except InputError as error:
        console.warn(f"{scene.name}: the cameras could not be placed by the objects: {error}")
        return
    views = {index: view for view, index in enumerate(indices)}
    store.set_cameras(store.session.intrinsics, {views[i]: T for i, T in placer.Ts_0_cam.items()})
    if len(indices) > 1:
        console.warn(
            f"{scene.name} has no camera poses: they were taken from the poses of its objects, "
            f"which agree within {1e3 * placer.worst_m:.1f} mm. World is the camera of image "
            f"{indices[0]}."
        )


def starts_of(
    scene: LabelledScene, indices: tuple[int, ...], Ts_world_cam: Mapping[int, Array | None]
) -> list[ObjectPose]:
    """Return each thing's pose in world, from the first frame that shows it.

    Args:
        scene: the data set's scene.
        indices: numbers of its images, in the order of the session's views.
        Ts_world_cam: the session's view -> (4, 4) camera in world [m]; None = not known.
    """
    starts: list[ObjectPose] = []
    known: set[tuple[int, int]] = set()
    for view, index in enumerate(indices):
        T_world_cam = Ts_world_cam.get(view)
        if T_world_cam is None:
            continue
        for o in scene.frame(index).objects:
            T = T_world_cam @ o.T_cam_obj
            if o.instance is not None:
                is_known = (o.obj_id, o.instance) in known
                known.add((o.obj_id, o.instance))
            else:
                alike = [s for s in starts if s.obj_id == o.obj_id]
                gaps = [np.linalg.norm(s.T_world_obj[:3, 3] - T[:3, 3]) for s in alike]
                is_known = any(gap < SAME_PLACE_M for gap in gaps)
            if not is_known:
                starts.append(ObjectPose(obj_id=o.obj_id, instance=len(starts), T_world_obj=T))
    return starts
