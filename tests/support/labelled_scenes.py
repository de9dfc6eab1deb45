"""A small labelled scene whose images lie on the disk: three boxes on a table, rendered exactly."""

from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from plain_meshes import box
from realsim import CameraIntrinsics, ObjectModel, images
from realsim.formats.bop.root_files import write_bop_models, write_bop_root
from realsim.formats.bop.writing import write_bop_scene
from realsim.formats.export_folder import ExportFolder
from realsim.formats.graspnet.opening import open_scene
from realsim.formats.graspnet.scene import open_graspnet
from realsim.formats.graspnet.writing import GraspnetWriteConfig, write_graspnet_scene
from realsim.formats.grasps.scene_grasps import SceneGrasps
from realsim.formats.labelled_scene import LabelledFrame, LabelledObject
from realsim.geometry import se3
from realsim.rendering.labels import LabelRenderer
from realsim.rendering.rays import PlacedMesh
from realsim_sim_bridge.synthetic.config import hemisphere_cameras

INTRINSICS = CameraIntrinsics(width=160, height=120, fx=150.0, fy=151.0, cx=78.7, cy=60.2)
TABLE = se3.from_rt(se3.exp_so3([0.0, 0.0, 0.7]), [0.5, -0.1, 0.1])
DEPTH_UNIT_M = 1e-3


MODELS = {
    1: ObjectModel(obj_id=1, name="tall", mesh=box((0.04, 0.05, 0.12), (200, 60, 40))),
    7: ObjectModel(obj_id=7, name="flat", mesh=box((0.08, 0.06, 0.03), (40, 90, 200))),
    30: ObjectModel(obj_id=30, name="long", mesh=box((0.03, 0.12, 0.04), (60, 180, 70))),
}
PLACES = ((1, -0.05, 0.0, 0.2), (7, 0.05, 0.02, -1.1), (30, 0.0, -0.09, 2.0))
"""Object id, x and y on the table [m], turn about its normal [rad]."""


def poses_in_world(places=PLACES):
    """Return (object id, T_world_obj) of the objects."""
    found = []
    for obj_id, x, y, turn in places:
        height = float(MODELS[obj_id].mesh.extent[2]) / 2
        found.append((obj_id, TABLE @ se3.from_rt(se3.exp_so3([0.0, 0.0, turn]), [x, y, height])))
    return found


@dataclass(eq=False)
class SceneInMemory:
    """A LabelledScene; everything may be changed before it is used."""

    folder: Path
    frames: dict
    masks: dict
    """(image, k, visible) -> (H, W)."""
    models_by_id: dict = field(default_factory=lambda: dict(MODELS))
    T_world_table: np.ndarray | None = None
    name: str = "train-000003"
    number: int = 3
    split: str = "train"
    camera: str = ""
    notes: tuple = ()
    tried: SceneGrasps | None = None

    @property
    def indices(self):
        return tuple(sorted(self.frames))

    def frame(self, index):
        return self.frames[index]

    def colour_file(self, index):
        return self.folder / f"{index}.colour.png"

    def depth_file(self, index):
        path = self.folder / f"{index}.depth.png"
        return path if path.is_file() else None

    def mask(self, index, k, *, visible):
        return self.masks.get((index, k, visible))

    def models(self):
        return self.models_by_id

    def grasps(self):
        return self.tried

    def change_frames(self, **changes):
        """Replace fields of all frames; a function gets the frame."""
        for i, f in self.frames.items():
            values = {k: v(f) if callable(v) else v for k, v in changes.items()}
            self.frames[i] = replace(f, **values)
        return self


class ChangedScene:
    """A labelled scene whose frames are what `change` makes of them."""

    def __init__(self, scene, change):
        self.scene, self.change = scene, change

    def __getattr__(self, name):
        return getattr(self.scene, name)

    def frame(self, index):
        return self.change(self.scene.frame(index))


def labelled_scene(
    folder, indices=range(6), *, intrinsics=INTRINSICS, unit_m=DEPTH_UNIT_M, places=PLACES
):
    """Return the scene seen by one camera that goes round it, its images written to a folder."""
    folder.mkdir(parents=True, exist_ok=True)
    rng = np.random.default_rng(11)
    posed = poses_in_world(places)
    placed = [PlacedMesh(k, MODELS[o].mesh, T) for k, (o, T) in enumerate(posed)]
    table = box((1.0, 1.0, 0.02), (90, 80, 70))
    T_slab = TABLE @ se3.from_translation([0.0, 0.0, -0.01])
    renderer = LabelRenderer([*placed, PlacedMesh(-1, table, T_slab)])
    cameras = hemisphere_cameras(TABLE[:3, 3], (0.35, 0.5), len(indices), rng)
    frames, masks = {}, {}
    for index, T_world_cam in zip(indices, cameras, strict=True):
        seen = renderer.render(intrinsics, T_world_cam)
        objects = tuple(
            LabelledObject(obj_id=o, T_cam_obj=se3.invert(T_world_cam) @ T, instance=k)
            for k, (o, T) in enumerate(posed)
        )
        frames[index] = LabelledFrame(
            index=index, intrinsics=intrinsics, depth_unit_m=unit_m, objects=objects,
            T_world_cam=T_world_cam,
        )  # fmt: skip
        for k in range(len(posed)):
            masks[index, k, True] = seen.ids == k
            masks[index, k, False] = seen.amodal[k]
        rgb = rng.integers(0, 255, (*seen.ids.shape, 3), dtype=np.uint8)
        (folder / f"{index}.colour.png").write_bytes(images.png_bytes(rgb))
        counts = images.depth_counts(seen.depth_m, unit_m)
        (folder / f"{index}.depth.png").write_bytes(images.png_bytes(counts))
    return SceneInMemory(folder=folder, frames=frames, masks=masks, T_world_table=TABLE.copy())


def written_bop(folder, *scenes):
    """Write scenes as a finished BOP data set; return its folder."""
    export = ExportFolder.begin(folder, {})
    for scene in scenes:
        write_bop_scene(scene, export)
        write_bop_models(scene.models(), export)
    write_bop_root(export, name="three boxes")
    export.finish({"README.md": b"three boxes\n"})
    return folder


def written_graspnet(folder, scene):
    """Write a scene as a finished GraspNet tree; return its folder."""
    export = ExportFolder.begin(folder, {})
    write_graspnet_scene(scene, export, GraspnetWriteConfig())
    export.finish({})
    return folder


def graspnet_tree(scene, out, **config):
    """Write a scene as an unfinished GraspNet tree; return what the writer says."""
    folder = ExportFolder.begin(out, {"what": "test"})
    return write_graspnet_scene(scene, folder, GraspnetWriteConfig(**config))


def opened_graspnet(out, **which):
    """Return the only scene of a GraspNet tree."""
    (ref,) = open_graspnet(out, **which).scenes
    return open_scene(ref)
