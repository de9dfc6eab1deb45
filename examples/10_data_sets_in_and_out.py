"""A labelled scene of one's own as a BOP data set, that as a GraspNet tree, and what is kept."""

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np

from realsim import CameraIntrinsics, ObjectModel, images
from realsim.formats.bop.opening import open_labelled_bop
from realsim.formats.bop.root_files import write_bop_models
from realsim.formats.bop.writing import write_bop_scene
from realsim.formats.export_folder import ExportFolder
from realsim.formats.graspnet.opening import open_scene
from realsim.formats.graspnet.scene import open_graspnet
from realsim.formats.graspnet.writing import GraspnetWriteConfig, write_graspnet_scene
from realsim.formats.labelled_scene import LabelledFrame, LabelledObject
from realsim.geometry import se3
from realsim.geometry.parts import part
from realsim.rendering.labels import LabelRenderer, PlacedMesh

K = CameraIntrinsics(width=320, height=240, fx=300.0, fy=300.0, cx=159.5, cy=119.5)
mug = ObjectModel(obj_id=7, name="mug", mesh=part("mug").mesh)
T_world_mug = se3.from_translation([0.0, 0.0, -mug.mesh.bounds[0, 2]])
colour, depth = [[Path(f"{kind}_{i}.png") for i in range(3)] for kind in ("colour", "depth")]
masks, frames = dict[tuple[int, bool], Any](), list[LabelledFrame]()
for i, x in enumerate((-0.2, 0.0, 0.2)):
    T_world_cam = se3.look_at(eye=[x, -0.3, 0.3], target=[0.0, 0.0, 0.04])
    seen = LabelRenderer([PlacedMesh(0, mug.mesh, T_world_mug)]).render(K, T_world_cam)
    colour[i].write_bytes(images.png_bytes((128 + 99 * seen.normals()).astype(np.uint8)))
    depth[i].write_bytes(images.png_bytes(images.depth_counts(seen.depth_m, 1e-4)))
    masks[i, False], masks[i, True] = seen.amodal[0], seen.ids == 0
    objects = (LabelledObject(obj_id=7, T_cam_obj=se3.invert(T_world_cam) @ T_world_mug),)
    frames.append(LabelledFrame(index=i, intrinsics=K, depth_unit_m=1e-4, objects=objects,
                                T_world_cam=T_world_cam))  # fmt: skip


def mask(index: int, k: int, *, visible: bool) -> Any:
    return masks[index, visible]


# What a reader of a data set gives, and all that a writer asks for: a LabelledScene.
own: Any = SimpleNamespace(
    name="own", number=3, split="train", camera="", notes=(), indices=(0, 1, 2), mask=mask,
    frame=frames.__getitem__, colour_file=colour.__getitem__, depth_file=depth.__getitem__,
    models=lambda: {7: mug}, grasps=lambda: None, T_world_table=np.eye(4),
)  # fmt: skip
folder = ExportFolder.begin("bop", {"source": "own"})  # after a kill the same request goes on
write_bop_scene(own, folder)
write_bop_models({7: mug}, folder)
folder.finish({})
bop = open_labelled_bop("bop")  # BOP has no place for the table: that it is z = 0 is said again
folder = ExportFolder.begin("graspnet", {"source": "bop"})
written = write_graspnet_scene(bop, folder, GraspnetWriteConfig(table_is_world=True))
folder.finish({})
print(*written.notes, sep="\n")
for scene in (bop, open_scene(open_graspnet("graspnet").scenes[0])):
    off = [scene.frame(f.index).objects[0].T_cam_obj - f.objects[0].T_cam_obj for f in frames]
    print(f"{scene.name}: {len(off)} images, the mug off by up to {1e3 * np.abs(off).max():.0e} mm")
