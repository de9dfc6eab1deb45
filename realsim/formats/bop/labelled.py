"""A BOP scene with everything that is in it, as a `LabelledScene`.

Each image has its own camera and depth_scale (T-LESS), a scene may have several cameras, masks come
from files or from run lengths, and every row is kept as it was (`entry`), so that a writer repeats
its numbers and its unknown keys. What cannot be is refused when the scene is opened.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from realsim import images
from realsim.arrays import Array, Mask
from realsim.errors import InputError
from realsim.formats.bop.models import INFO_FILE, load_models
from realsim.formats.bop.rows import GroundTruth, Json
from realsim.formats.bop.run_lengths import decoded
from realsim.formats.bop.scene import BopSceneRef
from realsim.formats.folders.listing import shown
from realsim.formats.frame_source import require_plausible
from realsim.formats.grasps.scene_grasps import SceneGrasps
from realsim.formats.labelled_scene import LabelledFrame, LabelledObject
from realsim.records import CameraIntrinsics, ObjectModel
from realsim.records import bop_units as units
from realsim.untrusted.json_text import read_json


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class SceneContent:
    """What was read of a scene, and checked."""

    cameras: Mapping[int, Json]
    """Rows of scene_camera.json, by image, of images that are there."""
    colour: Mapping[int, Path]
    depth: Mapping[int, Path]
    sizes: Mapping[int, tuple[int, int]]
    """Width and height of each image [px]."""
    truth: GroundTruth | None
    """The annotations; None = the scene has none."""
    infos: Mapping[int, Sequence[Json]]
    """Rows of scene_gt_info.json, by image."""
    masks: tuple[Mapping[int, set[int]], Mapping[int, set[int]]]
    """Rows with a mask file, by image: of the whole silhouettes, and of their visible parts."""
    run_lengths: Mapping[tuple[int, int], Json]
    """Visible masks by image and row, where they are only in scene_gt_coco.json."""
    models: Path | Mapping[int, ObjectModel] | None
    """Where the models are, or the models."""


class BopLabelledScene:
    """A `LabelledScene`; made by `realsim.formats.bop.opening.open_labelled_scene`."""

    T_world_table: Array | None = None
    """BOP has no table."""

    def __init__(self, ref: BopSceneRef, content: SceneContent, notes: Sequence[str]) -> None:
        """Take over what was read and checked."""
        self.ref, self.content = ref, content
        self.name = ref.name
        """Split, scene and camera, such as test-000050."""
        self.number = ref.scene_id
        """The scene's number; of onboarding folders the object's."""
        self.split = ref.split
        """Such as test, train_pbr, onboarding_static."""
        self.camera = ref.camera
        """Type of the camera; '' where the scene has one."""
        self.layout = ref.layout
        """Names of its files."""
        self.indices = tuple(content.cameras)
        """Numbers of the images, increasing."""
        self.models_folder = content.models if isinstance(content.models, Path) else None
        """Where the models are; None = they were given, or there are none."""
        self.truth = content.truth
        """All annotations; None = the scene has none."""
        self.notes_found = list(notes)
        self.instances: Mapping[int, tuple[int | None, ...]] = {}
        """Image -> which thing each row is; see `realsim.formats.bop.instances`."""
        self._models: Mapping[int, ObjectModel] | None = None
        self._intrinsics: dict[Any, CameraIntrinsics] = {}

    @property
    def notes(self) -> tuple[str, ...]:
        """What a person should know."""
        return tuple(self.notes_found)

    def frame(self, index: int) -> LabelledFrame:
        """Return one frame.

        Raises:
            InputError: there is no such image, or what is said of it cannot be.
        """
        row = self.camera_row(index)
        return LabelledFrame(
            index=index,
            intrinsics=self.intrinsics(index),
            depth_unit_m=self.depth_unit_m(index),
            objects=self._objects(index),
            T_world_cam=self.T_world_cam(index),
            entry=row,
        )

    def _objects(self, index: int) -> tuple[LabelledObject, ...]:
        truth = self.content.truth
        if truth is None:
            return ()
        rows = truth.rows.get(index, [])
        infos = self.content.infos.get(index)
        numbers = self.instances.get(index, (None,) * len(rows))
        Ts = truth.Ts_cam_obj[truth.places(index)]
        return tuple(
            LabelledObject(
                obj_id=int(row["obj_id"]),
                T_cam_obj=Ts[k],
                instance=numbers[k],
                visible_fraction=None if infos is None else _fraction(infos[k]),
                gt_info=None if infos is None else infos[k],
                entry=row,
            )
            for k, row in enumerate(rows)
        )

    # --- one image's camera -----------------------------------------------------------------------

    def camera_row(self, index: int) -> Json:
        """Return the image's row of scene_camera.json.

        Raises:
            InputError: there is no such image.
        """
        if index not in self.content.cameras:
            there = shown([str(i) for i in self.indices], 12)
            raise InputError(f"{self.ref.folder} has no image {index}; it has {there}.")
        return self.content.cameras[index]

    def _named(self, index: int) -> str:
        return f"image {index} of {self.layout.document('scene_camera')}"

    def intrinsics(self, index: int) -> CameraIntrinsics:
        """Return the image's camera.

        Raises:
            InputError: cam_K is missing, or not a camera matrix.
        """
        row, size = self.camera_row(index), self.content.sizes[index]
        # Most images of a scene have the same camera: it is made once.
        key = (str(row.get("cam_K")), str(row.get("cam_distortion")), size)
        if key not in self._intrinsics:
            if "cam_K" not in row and "cam_model" in row:
                raise InputError(
                    f"{self._named(index)} has no cam_K but a cam_model "
                    f"({str(row['cam_model'])[:80]}): a lens that is no pinhole with Brown's "
                    "distortion, such as HOT3D's fisheye. Undistort the images first."
                )
            self._intrinsics[key] = units.intrinsics_of(row, *size, self._named(index))
            require_plausible(self._intrinsics[key], self._named(index))
        return self._intrinsics[key]

    def depth_unit_m(self, index: int) -> float | None:
        """Return metres per count of the image's depth; None = it has no depth.

        Raises:
            InputError: it has depth and no depth_scale.
        """
        if index not in self.content.depth:
            return None
        return units.depth_unit_of(self.camera_row(index), self._named(index))

    def T_world_cam(self, index: int) -> Array | None:
        """Return where the camera stood (4, 4) [m]; None = not known."""
        return units.T_world_cam_of(self.camera_row(index), self._named(index))

    # --- files ------------------------------------------------------------------------------------

    def colour_file(self, index: int) -> Path:
        """Return the file of the colour (or grey) image."""
        self.camera_row(index)
        return self.content.colour[index]

    def depth_file(self, index: int) -> Path | None:
        """Return the file of the 16-bit depth image; None = there is none."""
        self.camera_row(index)
        return self.content.depth.get(index)

    def mask(self, index: int, k: int, *, visible: bool) -> Mask | None:
        """Return the mask (H, W) of a frame's k-th object; None = the source has none.

        Raises:
            InputError: the mask is damaged or has another size than the image.
        """
        self.camera_row(index)
        file = self.layout.mask_file(index, k, visible=visible)
        if k in self.content.masks[visible].get(index, ()):
            found = images.read_grey(file) > 0
            name = str(file)
        elif visible and (index, k) in self.content.run_lengths:
            name = f"mask of object {k} of image {index} of {self.layout.document('scene_gt_coco')}"
            found = decoded(self.content.run_lengths[index, k], name)
        else:
            return None
        width, height = self.content.sizes[index]
        if found.shape != (height, width):
            raise InputError(
                f"{name} has {found.shape[1]}x{found.shape[0]} pixels; its image has "
                f"{width}x{height}. Masks and images belong together pixel by pixel."
            )
        return found

    # --- models -----------------------------------------------------------------------------------

    def models(self) -> Mapping[int, ObjectModel]:
        """Return the models of the scene's objects; those without a mesh are not there.

        Raises:
            InputError: a mesh or models_info.json is broken.
            UnitError: a mesh is not in millimetres.
        """
        if self._models is None:
            used: set[int] = (
                set() if self.content.truth is None else set(self.content.truth.obj_ids.tolist())
            )
            if isinstance(self.content.models, Path):
                present = used & set(model_ids(self.content.models))
                looks: list[str] = []
                folder = self.content.models
                self._models = load_models(folder, present, notes=looks) if present else {}
                self.notes_found += looks
            else:
                given = self.content.models or {}
                self._models = {i: given[i] for i in sorted(used & set(given))}
        return self._models

    def models_info(self) -> dict[int, Json]:
        """Return the rows of models_info.json as they are, by object id; {} where there is none."""
        return {} if self.models_folder is None else read_models_info(self.models_folder)

    def grasps(self) -> SceneGrasps | None:
        """BOP has no grasps."""
        return None


def model_ids(folder: Path) -> list[int]:
    """Return the object ids that a models folder has meshes of."""
    return sorted(int(p.stem[4:]) for p in folder.glob("obj_*.ply") if p.stem[4:].isdecimal())


def read_models_info(folder: Path) -> dict[int, Json]:
    """Return the rows of a models folder's models_info.json by object id; {} where there is none.

    Raises:
        InputError: not such a file.
    """
    path = folder / INFO_FILE
    if not path.is_file():
        return {}
    data = read_json(path)
    rows: Json = data if isinstance(data, dict) else {}
    if not rows or not all(k.isdecimal() and isinstance(v, dict) for k, v in rows.items()):
        raise InputError(f"{path} must be an object with one object per model id.")
    return {int(k): v for k, v in rows.items()}


def _fraction(info: Json) -> float | None:
    value = info.get("visib_fract")
    return float(value) if type(value) in (int, float) and value is not None else None
