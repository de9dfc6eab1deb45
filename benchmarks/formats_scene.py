"""A labelled scene of any length that costs nothing to make: what writers and readers cost is left.

Boxes stand on a table, a camera goes over it and looks straight down. Every frame has its own pose
with all its digits; colour and depth are one small file each, masks are squares at the projected
origins. Labels, depth and cameras agree, so that every reader accepts what is written.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np

from realsim import images
from realsim.arrays import Array, Mask
from realsim.formats.grasps.scene_grasps import SceneGrasps
from realsim.formats.labelled_scene import LabelledFrame, LabelledObject
from realsim.geometry import se3
from realsim.records import CameraIntrinsics, Mesh, ObjectModel

WIDTH, HEIGHT, FOCAL_PX = 64, 48, 60.0
HEIGHT_M = 0.7
"""Height of the camera over the table."""
BETWEEN_M = 0.1
"""Between two objects."""
COLUMNS = 5
HALF_PX = 3
"""A mask is a square of 2 HALF_PX + 1 pixels; the last row is hidden."""
DEPTH_UNIT_M = 1e-3


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class LongScene:
    """A `LabelledScene`; made by `long_scene`."""

    folder: Path
    """Folder of the two images."""
    frames: int
    objects: int
    number: int = 0
    with_info: bool = False
    """Whether objects bring a row of scene_gt_info.json, so that no mask need be counted."""
    intrinsics: CameraIntrinsics = field(
        default_factory=lambda: CameraIntrinsics(
            width=WIDTH, height=HEIGHT, fx=FOCAL_PX, fy=FOCAL_PX, cx=WIDTH / 2, cy=HEIGHT / 2
        )
    )
    split: str = "train"
    camera: str = ""
    notes: tuple[str, ...] = ()

    @property
    def name(self) -> str:
        """Return what messages call it."""
        return f"train-{self.number:06d}"

    @property
    def indices(self) -> tuple[int, ...]:
        """Return the numbers of the images."""
        return tuple(range(self.frames))

    @property
    def T_world_table(self) -> Array:
        """Return the table: z = 0 of the world."""
        return np.eye(4)

    def frame(self, index: int) -> LabelledFrame:
        """Return one frame."""
        T_world_cam = _camera(index)
        T_cam_world = se3.invert(T_world_cam)
        return LabelledFrame(
            index=index, intrinsics=self.intrinsics, depth_unit_m=DEPTH_UNIT_M,
            objects=tuple(
                LabelledObject(
                    obj_id=k + 1, T_cam_obj=T_cam_world @ _stand(k), instance=k,
                    gt_info=self._info(index, k) if self.with_info else None,
                )
                for k in range(self.objects)
            ),
            T_world_cam=T_world_cam,
        )  # fmt: skip

    def colour_file(self, index: int) -> Path:
        """Return the one colour image."""
        return self.folder / "colour.png"

    def depth_file(self, index: int) -> Path | None:
        """Return the one depth image."""
        return self.folder / "depth.png"

    def mask(self, index: int, k: int, *, visible: bool) -> Mask | None:
        """Return a square at the object's origin (H, W)."""
        column, row = self._pixel(index, k)
        mask = np.zeros((self.intrinsics.height, self.intrinsics.width), np.bool_)
        last = row + HALF_PX + (0 if visible else 1)
        mask[max(row - HALF_PX, 0) : max(last, 0),
             max(column - HALF_PX, 0) : max(column + HALF_PX + 1, 0)] = True  # fmt: skip
        return mask

    def _pixel(self, index: int, k: int) -> tuple[int, int]:
        """Return column and row of an object's origin."""
        T_world_cam = _camera(index)
        x, y, z = T_world_cam[:3, :3].T @ (_stand(k)[:3, 3] - T_world_cam[:3, 3])
        return round(WIDTH / 2 + FOCAL_PX * float(x / z)), round(
            HEIGHT / 2 + FOCAL_PX * float(y / z)
        )

    def _info(self, index: int, k: int) -> dict[str, Any]:
        column, row = self._pixel(index, k)
        side = 2 * HALF_PX + 1
        box = [column - HALF_PX, row - HALF_PX, side, side]
        return {
            "bbox_obj": box,
            "bbox_visib": [*box[:3], side - 1],
            "px_count_all": side * side,
            "px_count_valid": side * side,
            "px_count_visib": side * (side - 1),
            "visib_fract": (side - 1) / side,
        }

    def models(self) -> Mapping[int, ObjectModel]:
        """Return boxes."""
        return {k + 1: _model(k) for k in range(self.objects)}

    def grasps(self) -> SceneGrasps | None:
        """Return none."""
        return None


def long_scene(
    folder: Path, frames: int, objects: int, *, number: int = 0, with_info: bool = False
) -> LongScene:
    """Return the scene; its two images are written to a folder."""
    scene = LongScene(
        folder=folder, frames=frames, objects=objects, number=number, with_info=with_info
    )
    folder.mkdir(parents=True, exist_ok=True)
    rng = np.random.default_rng(0)
    rgb = rng.integers(0, 256, (HEIGHT, WIDTH, 3), np.uint8)
    depth = np.full((HEIGHT, WIDTH), round(HEIGHT_M / DEPTH_UNIT_M), np.uint16)
    (folder / "colour.png").write_bytes(images.png_bytes(rgb))
    (folder / "depth.png").write_bytes(images.png_bytes(depth))
    return scene


@lru_cache(maxsize=4)
def _camera(index: int) -> Array:
    """Return where the camera is (4, 4) [m]: turned by the golden angle from frame to frame."""
    turn = 2.399963 * index
    R = se3.exp_so3([np.pi, 0.0, 0.0]) @ se3.exp_so3([0.0, 0.0, 0.05 * np.sin(turn)])
    return se3.from_rt(R, [0.01 * np.cos(turn), 0.01 * np.sin(turn), HEIGHT_M])


@lru_cache(maxsize=64)
def _stand(k: int) -> Array:
    """Return where an object stands in the world (4, 4) [m]."""
    row, column = divmod(k, COLUMNS)
    R = se3.exp_so3([0.0, 0.0, 0.7 * k])
    return se3.from_rt(R, [BETWEEN_M * (column - 2), BETWEEN_M * (row - 1), 0.02])


def _model(k: int) -> ObjectModel:
    size = np.array([0.03, 0.04, 0.03 + 0.001 * k])
    corners = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)], np.float64)
    faces = [
        [0, 1, 3], [0, 3, 2], [4, 6, 7], [4, 7, 5], [0, 4, 5], [0, 5, 1],
        [2, 3, 7], [2, 7, 6], [0, 2, 6], [0, 6, 4], [1, 5, 7], [1, 7, 3],
    ]  # fmt: skip
    mesh = Mesh(vertices=corners * size / 2, faces=np.array(faces))
    return ObjectModel(obj_id=k + 1, name=f"box {k + 1}", mesh=mesh)
