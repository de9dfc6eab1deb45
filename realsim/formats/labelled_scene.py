"""A labelled scene as any data set gives it: images on disk, cameras, objects and their poses.

Readers of data sets give one (BOP, GraspNet, a session of realsim), writers take one, so that every
conversion is one reader and one writer. It is lazy: a frame is read when it is asked for, and a
scene of any length passes through bounded memory.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Protocol

from realsim.arrays import Array, Mask
from realsim.formats.grasps.scene_grasps import SceneGrasps
from realsim.records import CameraIntrinsics, ObjectModel
from realsim.records.checked_arrays import rigid


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class LabelledObject:
    """One object in one frame."""

    obj_id: int
    """realsim's and BOP's id, 1 or more (GraspNet's number + 1)."""
    T_cam_obj: Array
    """(4, 4) object in the frame's camera [m]."""
    instance: int | None = None
    """The same number in all frames of a scene is the same thing; None = the source does not tell.
    Two cans of one model are two instances."""
    visible_fraction: float | None = None
    """Visible pixels / all pixels of the silhouette; None = the source does not tell."""
    gt_info: Mapping[str, Any] | None = None
    """The object's entry of BOP's scene_gt_info.json; None = there is none."""
    entry: Mapping[str, Any] | None = None
    """The source's own row. A writer of the same format writes its numbers again, to the last
    digit, and keys that are not known here survive."""

    def __post_init__(self) -> None:
        """Check that the pose is rigid and freeze it."""
        object.__setattr__(
            self, "T_cam_obj", rigid(self.T_cam_obj, f"pose of object {self.obj_id}")
        )


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class LabelledFrame:
    """One image: its camera, where it stood, what it shows."""

    index: int
    """Number of the image in its scene."""
    intrinsics: CameraIntrinsics
    """Intrinsics of this image; data sets with cropped images have another one for each."""
    depth_unit_m: float | None
    """Metres per count of its depth image; None = it has no depth."""
    objects: tuple[LabelledObject, ...]
    """In the source's order: masks are numbered by it."""
    T_world_cam: Array | None = None
    """(4, 4) camera in world [m]; None = the source does not tell."""
    entry: Mapping[str, Any] | None = None
    """The source's own row of the camera, likewise."""

    def __post_init__(self) -> None:
        """Check that the pose is rigid and freeze it."""
        if self.T_world_cam is not None:
            T = rigid(self.T_world_cam, f"T_world_cam of image {self.index}")
            object.__setattr__(self, "T_world_cam", T)


class LabelledScene(Protocol):
    """One scene seen by one camera; opened and checked."""

    @property
    def name(self) -> str:
        """What messages and files call it, such as test-000050 or scene_0100-kinect."""
        ...

    @property
    def number(self) -> int:
        """The scene's number in its data set."""
        ...

    @property
    def split(self) -> str:
        """BOP's split, such as test; 'train' where the source has no splits."""
        ...

    @property
    def camera(self) -> str:
        """Which of several cameras: 'kinect', 'cam1'; '' where the source has one."""
        ...

    @property
    def indices(self) -> tuple[int, ...]:
        """Numbers of the images, increasing."""
        ...

    @property
    def T_world_table(self) -> Array | None:
        """(4, 4) supporting plane in world, z up [m]; None = not known."""
        ...

    @property
    def notes(self) -> tuple[str, ...]:
        """What a person should know: what was left out, what was assumed and why."""
        ...

    def frame(self, index: int) -> LabelledFrame:
        """Return one frame.

        Raises:
            InputError: there is no such image, or what is said of it cannot be.
        """
        ...

    def colour_file(self, index: int) -> Path:
        """Return the file of the colour (or grey) image."""
        ...

    def depth_file(self, index: int) -> Path | None:
        """Return the file of the 16-bit depth image; None = there is none."""
        ...

    def mask(self, index: int, k: int, *, visible: bool) -> Mask | None:
        """Return the mask (H, W) of a frame's k-th object; None = the source has none.

        Args:
            index: of the image.
            k: place in the frame's `objects`.
            visible: the visible part; else the whole silhouette, as if nothing stood in front.
        """
        ...

    def models(self) -> Mapping[int, ObjectModel]:
        """Return the models of the objects, by object id; those without a mesh are not there."""
        ...

    def grasps(self) -> SceneGrasps | None:
        """Return the grasps that were tried by physics; None = there are none."""
        ...


@dataclass(frozen=True, kw_only=True, slots=True)
class WrittenScene:
    """What a writer did with one scene."""

    name: str
    """The scene's name in its source."""
    folder: Path
    """Where it was written."""
    frames: int
    """Frames of the scene."""
    frames_written: int
    """Frames written in this run; the others were there from an interrupted one."""
    objects: int
    """Objects in all frames."""
    notes: tuple[str, ...] = ()
    """What was lost or changed on the way: rounded depth, distortion that the format has no place
    for, poses that are not there."""
    counts: Mapping[str, int] = field(default_factory=dict[str, int])
    """What else was written, by name: 'masks', 'grasps' ..."""
