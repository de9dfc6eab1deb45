"""What a GraspNet tree of a scene will hold, found out before anything is written."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from realsim.arrays import Array
from realsim.errors import InputError
from realsim.formats.graspnet.annotations import LARGEST_NUMBER
from realsim.formats.graspnet.cameras import CameraPlacer
from realsim.formats.graspnet.frame_files import own_values
from realsim.formats.graspnet.labelled import GraspnetLabelledScene
from realsim.formats.graspnet.scene import CAMERAS
from realsim.formats.labelled_scene import LabelledFrame, LabelledScene
from realsim.geometry import se3
from realsim.geometry.camera import pixel_grid, undistort
from realsim.records import CameraIntrinsics

LARGEST_OFFICIAL = 87
"""GraspNet-1Billion has the objects 0 to 87; loops of graspnetAPI end there."""
SAME_POSE = 1e-6
"""[m, rad] A source's own matrices are written again if they give the pose to so much."""


@dataclass(frozen=True, kw_only=True, slots=True)
class GraspnetWriteConfig:
    """How a scene is written."""

    camera: str = "realsense"
    """'realsense' or 'kinect': the folder that the scene's camera becomes."""
    number: int | None = None
    """Number of the scene; None = the source's. Needed where scenes of several splits have one
    number."""
    ignore_distortion: bool = False
    """Write images of a lens with distortion as they are. GraspNet has no place for it, so its
    readers would be wrong by what the notes then say."""
    table_is_world: bool = False
    """Take z = 0 of the source's world as the table where the source knows no table."""
    without_labels: bool = False
    """Write no label images, for a source without masks."""

    def __post_init__(self) -> None:
        """Check the camera and the number."""
        if self.camera not in CAMERAS:
            raise InputError(
                f"GraspNet has no camera '{self.camera}'; {' and '.join(CAMERAS)} are."
            )
        if self.number is not None and not 0 <= self.number <= LARGEST_NUMBER:
            raise InputError(f"scene number {self.number}; 0 to {LARGEST_NUMBER} can be written.")


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class WritePlan:
    """What a tree of a scene will hold."""

    number: int
    """Number of the scene."""
    indices: tuple[int, ...]
    """Places of the source's images; their places are the written numbers."""
    numbers: Mapping[int, int]
    """Object id -> GraspNet's number, which is one less."""
    order: tuple[int, ...]
    """Object numbers as object_id_list.txt has them."""
    places: Mapping[tuple[int, int | None], int]
    """(object id, instance) -> place in `order`."""
    camera_poses: Array
    """(N, 4, 4) cameras in the first one [m]."""
    cam0_wrt_table: Array
    """(4, 4) the first camera in the table's frame [m]."""
    K: Array
    """(3, 3) of the first image [px]."""
    notes: tuple[str, ...]


class _Survey:
    """What all frames of a scene say together."""

    def __init__(self) -> None:
        self.first: LabelledFrame | None = None
        self.Ts_world_cam: list[Array | None] = []
        self.own_poses: list[Array | None] = []
        self.instances: dict[tuple[int, int | None], None] = {}
        self.cameras: dict[tuple[float, ...], CameraIntrinsics] = {}

    def add(self, frame: LabelledFrame) -> None:
        self.first = self.first or frame
        self.Ts_world_cam.append(frame.T_world_cam)
        own = own_values(frame.entry).get("camera_pose")
        self.own_poses.append(None if own is None else np.array(own, np.float64))
        for o in frame.objects:
            self.instances.setdefault((o.obj_id, o.instance))
        c = frame.intrinsics
        key = (c.width, c.height, c.fx, c.fy, c.cx, c.cy, *c.distortion.tolist())
        if len(self.cameras) < 100:  # of images that are cropped one by one, a hundred will do
            self.cameras.setdefault(key, c)


def plan_scene(scene: LabelledScene, config: GraspnetWriteConfig) -> WritePlan:
    """Look at all frames of a scene, without their images.

    Raises:
        InputError: what the format needs is not there, or has no place in it.
    """
    survey = _Survey()
    for index in scene.indices:
        survey.add(scene.frame(index))
    if survey.first is None:
        raise InputError(f"{scene.name} has no images.")
    notes = _lens(survey, scene, config)
    notes += _several_cameras(survey)
    numbers = _numbers(survey, notes)
    poses, first = _cameras(scene, survey, config, notes)
    order, places = _object_list(scene, survey, numbers)
    if tuple(range(len(scene.indices))) != tuple(scene.indices):
        notes.append(
            "images are numbered from 0 without gaps; frames.json says which number of the "
            "source is which."
        )
    own_K = own_values(survey.first.entry).get("camK")
    K = survey.first.intrinsics.K
    return WritePlan(
        number=scene.number if config.number is None else config.number,
        indices=tuple(scene.indices),
        numbers=numbers,
        order=order,
        places=places,
        camera_poses=poses,
        cam0_wrt_table=first,
        K=K if own_K is None else np.array(own_K),
        notes=tuple(notes),
    )


def _lens(survey: _Survey, scene: LabelledScene, config: GraspnetWriteConfig) -> list[str]:
    distorted = [c for c in survey.cameras.values() if c.is_distorted]
    if not distorted:
        return []
    off = max(greatest_displacement_px(c) for c in distorted)
    if not config.ignore_distortion:
        raise InputError(
            f"the lens of {scene.name} has distortion, which moves pixels by up to {off:.1f} px; "
            "GraspNet's format has no place for it. Undistort them (--undistort), or "
            "accept the error (--keep-distortion)."
        )
    return [
        f"lens distortion is not written, the format has no place for it: readers take pixels up "
        f"to {off:.1f} px from where they belong."
    ]


def greatest_displacement_px(camera: CameraIntrinsics) -> float:
    """Return by how much the lens moves a pixel of the image, at most [px]."""
    grid = pixel_grid(camera.width, camera.height)
    step = max(1, min(camera.width, camera.height) // 32)
    rows = np.unique([*range(0, camera.height, step), camera.height - 1])
    columns = np.unique([*range(0, camera.width, step), camera.width - 1])
    uv = grid[np.ix_(rows, columns)]
    xy, _ = undistort(camera, uv)
    ideal = xy * [camera.fx, camera.fy] + [camera.cx, camera.cy]
    return float(np.nanmax(np.linalg.norm(ideal - uv, axis=-1)))


def _several_cameras(survey: _Survey) -> list[str]:
    if len(survey.cameras) < 2:
        return []
    cameras = list(survey.cameras.values())
    off = max(float(np.max(np.abs(c.K - cameras[0].K))) for c in cameras)
    return [
        f"images have different camera matrices (up to {off:.2f} px): meta/%04d.mat has each "
        "image's own, camK.npy the first one's, which graspnetAPI takes for all."
    ]


def _numbers(survey: _Survey, notes: list[str]) -> dict[int, int]:
    ids = sorted({obj_id for obj_id, _ in survey.instances})
    numbers = {i: i - 1 for i in ids}
    wrong = [n for n in numbers.values() if not 0 <= n <= LARGEST_NUMBER]
    if wrong:
        raise InputError(f"object number {wrong[0]}; 0 to {LARGEST_NUMBER} can be written.")
    beyond = [n for n in numbers.values() if n > LARGEST_OFFICIAL]
    if beyond:
        notes.append(
            f"object numbers up to {max(beyond)} are written; GraspNet-1Billion has 0 to "
            f"{LARGEST_OFFICIAL}, where loops of graspnetAPI end. Give the models smaller ids if "
            "its evaluation is to run."
        )
    return numbers


def _object_list(
    scene: LabelledScene, survey: _Survey, numbers: Mapping[int, int]
) -> tuple[tuple[int, ...], dict[tuple[int, int | None], int]]:
    """Return the object numbers in their order, and the place of each instance."""
    known = sorted((k for k in survey.instances if k[1] is not None), key=lambda k: k[1] or 0)
    keys = [*known, *(k for k in survey.instances if k[1] is None)]
    places = {key: place for place, key in enumerate(keys)}
    if isinstance(scene, GraspnetLabelledScene):
        return scene.object_numbers, places
    return tuple(numbers[obj_id] for obj_id, _ in keys), places


def _cameras(
    scene: LabelledScene, survey: _Survey, config: GraspnetWriteConfig, notes: list[str]
) -> tuple[Array, Array]:
    """Return camera_poses (N, 4, 4) and cam0_wrt_table (4, 4) [m]."""
    known = [T for T in survey.Ts_world_cam if T is not None]
    T_world_table = scene.T_world_table
    if len(known) < len(survey.Ts_world_cam):
        return _cameras_by_objects(scene, survey, config, notes)
    Ts = np.stack(known)
    if T_world_table is None:
        _require_table(scene, config)
        notes.append(_no_table("the source's world"))
        T_world_table = np.eye(4)
    own = _own_cameras(scene, survey, se3.invert(T_world_table) @ Ts)
    if own is not None:
        return own
    return se3.invert(Ts[0]) @ Ts, se3.invert(T_world_table) @ Ts[0]


def _own_cameras(
    scene: LabelledScene, survey: _Survey, Ts_table_cam: Array
) -> tuple[Array, Array] | None:
    """Return the matrices of a GraspNet source as its files have them, if they still hold."""
    first = own_values(survey.first.entry if survey.first else None).get("cam0_wrt_table")
    poses = [p for p in survey.own_poses if p is not None]
    whole = tuple(scene.indices) == tuple(range(len(survey.own_poses)))
    if first is None or len(poses) < len(survey.own_poses) or not whole:
        return None
    own, first = np.stack(poses), np.array(first, np.float64)
    is_same = np.allclose(first @ own, Ts_table_cam, rtol=0, atol=SAME_POSE)
    return (own, first) if is_same else None


def _cameras_by_objects(
    scene: LabelledScene, survey: _Survey, config: GraspnetWriteConfig, notes: list[str]
) -> tuple[Array, Array]:
    placer = CameraPlacer()
    for index in scene.indices:
        placer.add(scene.frame(index))
    placer.require_all(scene.name)
    Ts_0_cam = np.stack([placer.Ts_0_cam[i] for i in scene.indices])
    notes.append(
        "the source does not know where all cameras stood: it follows from the objects, which "
        f"stand still and agree to {1e3 * placer.worst_m:.2f} mm."
    )
    k = next((k for k, T in enumerate(survey.Ts_world_cam) if T is not None), None)
    if k is not None and scene.T_world_table is not None:
        T_world_cam = survey.Ts_world_cam[k]
        assert T_world_cam is not None
        T_table_cam = se3.invert(scene.T_world_table) @ T_world_cam
        return Ts_0_cam, T_table_cam @ se3.invert(Ts_0_cam[k])
    _require_table(scene, config)
    notes.append(_no_table("the first camera"))
    return Ts_0_cam, np.eye(4)


def _require_table(scene: LabelledScene, config: GraspnetWriteConfig) -> None:
    if not config.table_is_world:
        raise InputError(
            f"{scene.name} knows no table in the frame of its cameras, and GraspNet's "
            "cam0_wrt_table.npy needs one. Register the scene first (realsim register), or take "
            "the world's z = 0 for it (--table-is-world)."
        )


def _no_table(what: str) -> str:
    return (
        f"NO TABLE IS KNOWN: cam0_wrt_table.npy takes the frame of {what} for the table's. "
        "Heights above the table, workspaces and collision checks with the table that are "
        "computed of this tree are WRONG unless z = 0 of that frame is the table."
    )
