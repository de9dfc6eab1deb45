"""What a data set knows beside its images: kept in the session, and made ready to be registered."""

from pathlib import Path

import numpy as np

from realsim.app.console import Console
from realsim.app.stages import save_starts
from realsim.formats.bop.models import save_models
from realsim.formats.imported_labels import load_imported, save_imported
from realsim.formats.labelled_scene import LabelledScene
from realsim.records import ObjectPose
from realsim.store import SessionStore
from realsim.store.lock import only_run_in

SAME_PLACE_M = 0.02
"""Objects of one id that the data set does not number, and that lie this near in two frames, are
one thing: annotations are a few millimetres off, things of one kind stand farther apart."""


def import_labels(
    scene: LabelledScene, indices: tuple[int, ...], folder: Path, console: Console
) -> None:
    """Keep the labels and models of a data set in the session that its images were imported into.

    The labels lie in SESSION/imported, untouched by what realsim computes. Where the cameras'
    places are known, the poses become the starts that `realsim register` begins from.

    Args:
        scene: the data set's scene.
        indices: numbers of its images, in the order of the session's views.
        folder: the session.
        console: where progress goes.

    Raises:
        InputError: a pose, a mask or a model cannot be used.
    """
    with only_run_in(folder), SessionStore.open(folder) as store:
        if load_imported(store) is not None:
            return
        models = scene.models()
        if models:
            save_models(folder / "models", models)
        starts = starts_of(scene, indices)
        if starts:
            save_starts(store, starts, f"labels of {scene.name}")
        with console.stage("labels", scene.name) as tick:
            save_imported(store, scene, dict(enumerate(indices)), tick)
    poses = sum(len(scene.frame(i).objects) for i in indices)
    console.say(
        f"labels    {poses} poses in {len(indices)} frames, {len(models)} models: kept in "
        f"{folder / 'imported'} as they are, not checked. `realsim register {folder}` refines and "
        "judges them."
    )


def starts_of(scene: LabelledScene, indices: tuple[int, ...]) -> list[ObjectPose]:
    """Return each thing's pose in world, from the first frame that shows it.

    Frames whose camera has no pose are passed over, unless there is only one frame: then its camera
    is the world.
    """
    starts: list[ObjectPose] = []
    taken: dict[tuple[int, int], ObjectPose] = {}
    for index in indices:
        frame = scene.frame(index)
        T_world_cam = frame.T_world_cam
        if T_world_cam is None and len(indices) == 1:
            T_world_cam = np.eye(4)
        if T_world_cam is None:
            continue
        for o in frame.objects:
            T = T_world_cam @ o.T_cam_obj
            if o.instance is not None:
                is_known = (o.obj_id, o.instance) in taken
            else:
                alike = [s for s in starts if s.obj_id == o.obj_id]
                gaps = [np.linalg.norm(s.T_world_obj[:3, 3] - T[:3, 3]) for s in alike]
                is_known = any(gap < SAME_PLACE_M for gap in gaps)
            if is_known:
                continue
            start = ObjectPose(obj_id=o.obj_id, instance=len(starts), T_world_obj=T)
            starts.append(start)
            if o.instance is not None:
                taken[o.obj_id, o.instance] = start
    return starts
