"""One image of GraspNet-1Billion on its own, as graspnet-baseline's demo has it.

    FOLDER/{color.png, depth.png, meta.mat, workspace_mask.png}

No annotation, no camera pose, no label image: the meta file has the poses and the camera matrix.
"""

from collections.abc import Mapping
from pathlib import Path

from realsim import images
from realsim.arrays import Array, Mask
from realsim.errors import InputError
from realsim.formats.graspnet import evidence, labelled
from realsim.formats.graspnet.image_objects import joined_objects
from realsim.formats.graspnet.instances import number_instances
from realsim.formats.graspnet.labelled import ENTRY
from realsim.formats.graspnet.meta import read_meta
from realsim.formats.graspnet.models import load_models
from realsim.formats.grasps.scene_grasps import SceneGrasps
from realsim.formats.labelled_scene import LabelledFrame, LabelledObject
from realsim.records import ObjectModel

COLOUR_FILE, DEPTH_FILE, META_FILE = "color.png", "depth.png", "meta.mat"


class GraspnetFrame:
    """One image as a LabelledScene of one frame, number 0."""

    number = 0
    """Nothing tells which scene it is of."""
    split = "train"
    """Without splits."""
    camera = ""
    """Nothing tells which camera took it."""
    indices = (0,)
    """The one image."""
    T_world_table: Array | None = None
    """Not known."""

    def __init__(
        self, folder: Path, models: Path | None, frame: LabelledFrame, notes: list[str]
    ) -> None:
        """Take over what was read; see `open_graspnet_frame`."""
        self.folder = folder
        self.name = folder.resolve().name
        """The folder's."""
        self._models_folder = models
        self._frame = frame
        self._notes = notes

    @property
    def notes(self) -> tuple[str, ...]:
        """What a person should know."""
        return tuple(self._notes)

    def frame(self, index: int) -> LabelledFrame:
        """Return the frame.

        Raises:
            InputError: another number than 0.
        """
        if index != 0:
            raise InputError(f"{self.folder} holds one image, number 0; there is no {index}.")
        return self._frame

    def colour_file(self, index: int) -> Path:
        """Return the colour image."""
        self.frame(index)
        return self.folder / COLOUR_FILE

    def depth_file(self, index: int) -> Path | None:
        """Return the depth image."""
        self.frame(index)
        return self.folder / DEPTH_FILE

    def mask(self, index: int, k: int, *, visible: bool) -> Mask | None:
        """None: there are no masks of objects."""
        self.frame(index)
        return None

    def models(self) -> Mapping[int, ObjectModel]:
        """Return the models by object id; none unless their folder was given."""
        if self._models_folder is None or not self._models_folder.is_dir():
            return {}
        numbers = {o.obj_id - 1 for o in self._frame.objects}
        return load_models(self._models_folder, numbers, [])

    def grasps(self) -> SceneGrasps | None:
        """None: there are none."""
        return None


def is_graspnet_frame(folder: Path) -> bool:
    """Return whether a folder is one image as GraspNet's demo has it."""
    return all((folder / name).is_file() for name in (COLOUR_FILE, DEPTH_FILE, META_FILE))


def open_graspnet_frame(folder: Path | str, *, models: Path | str | None = None) -> GraspnetFrame:
    """Open a folder of one image and check its depth against its objects.

    Args:
        folder: holds color.png, depth.png and meta.mat.
        models: folder of the models; None = without.

    Raises:
        InputError: a file is missing or damaged, or the images differ in size.
        UnitError: the objects are not as far as the depth image says.
    """
    folder = Path(folder)
    needed = (COLOUR_FILE, DEPTH_FILE, META_FILE)
    missing = [name for name in needed if not (folder / name).is_file()]
    if missing:
        raise InputError(
            f"{folder} has no {', '.join(missing)}; one image of GraspNet has {', '.join(needed)}."
        )
    meta = read_meta(folder / META_FILE)
    size = labelled.same_size([folder / COLOUR_FILE, folder / DEPTH_FILE])
    intrinsics = labelled.intrinsics_of(meta.K, size, str(folder / META_FILE))
    objects = joined_objects(None, meta, str(folder / META_FILE))
    unit_m = 1.0 / meta.factor_depth
    seen = evidence.SeenImage(
        index=0, intrinsics=intrinsics, objects=objects, label=None,
        depth_m=images.read_depth(folder / DEPTH_FILE, unit_m),
    )  # fmt: skip
    evidence.check_depth([seen], unit_m, str(folder))
    instances, notes = number_instances(meta.numbers, [(meta.numbers, None)])
    frame = LabelledFrame(
        index=0,
        intrinsics=intrinsics,
        depth_unit_m=unit_m,
        objects=tuple(
            LabelledObject(
                obj_id=o.number + 1, T_cam_obj=o.T_cam_obj, instance=i, entry={ENTRY: o.entry}
            )
            for o, i in zip(objects, instances.of(meta.numbers, None), strict=True)
        ),
    )
    notes.append("one image on its own: no camera pose, no table, no masks.")
    return GraspnetFrame(folder, None if models is None else Path(models), frame, notes)
