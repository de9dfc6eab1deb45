"""Files of a GraspNet source that hold for a copy of it unchanged: they go through as they are.

    grasp_label/000_labels.npz, collision_label/scene_0000/collision_labels.npz,
    scenes/scene_0000/{rs_wrt_kn.npy, CAMERA/rect/0000.npy}

They name objects by their numbers, or by their place in the annotation: a scene whose objects got
other ids is no GraspNet source any more. dex_models are pickles, which run what they hold: they
stay behind.
"""

from pathlib import Path

from realsim.formats.graspnet.labelled import GraspnetLabelledScene
from realsim.formats.graspnet.write_plan import WritePlan
from realsim.formats.labelled_scene import LabelledScene

RS_WRT_KN = "rs_wrt_kn.npy"


def label_files(scene: LabelledScene, plan: WritePlan) -> dict[str, Path]:
    """Return what goes along with a scene: path in the new tree -> file of the source."""
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


def rect_file(scene: LabelledScene, index: int) -> Path | None:
    """Return the rectangle grasps of an image, None where there are none to go along."""
    if not isinstance(scene, GraspnetLabelledScene):
        return None
    return scene.rect_file(index)
