"""Register from nothing: five parts on a table, which of them are there and where is found out."""

import numpy as np

from realsim.geometry.metrics import mssd_symmetric
from realsim.geometry.parts import part
from realsim.registration.register import RegistrationConfig, register_scene
from realsim.registration.simulated import TableLabConfig, scatter_objects, table_scene

rng = np.random.default_rng(3)
names = ("mug", "gear", "l_bracket", "tube", "wedge", "bowl", "hex_nut", "elbow")
library = {part(name).obj_id: part(name) for name in names}
there = [part(name).obj_id for name in names[:5]]

# A lab whose cameras are off by half a millimetre and a tenth of a degree.
lab = TableLabConfig(views=16, disc_m=0.14)
placed = scatter_objects({i: library[i].mesh for i in there}, there, lab, rng).objects
lab_scene = table_scene(library, placed, lab, rng)
true = {p.obj_id: p.T_world_obj for p in lab_scene.truth}

result = register_scene(
    "five of eight", lab_scene.intrinsics, lab_scene.frames, library, None,
    RegistrationConfig(with_single_view=False),
)  # fmt: skip

print("object      off by     1 sigma in view 0   probability  verdict")
for o in result.scene.objects:
    model = library[o.obj_id]
    off = 1e3 * mssd_symmetric(true[o.obj_id], o.T_world_obj, model)
    px = result.seen[0][o.instance].sigma_px
    p = o.checks["probability"]
    print(f"{model.name:10s} {off:5.2f} mm   {px:5.2f} px            {p:.3f}        {o.verdict}")

claimed = np.stack([f.T_world_cam for f in lab_scene.frames])
refined = np.stack([result.cameras[f.index] for f in lab_scene.frames])
for what, cameras in (("claimed", claimed), ("refined", refined)):
    off_m = np.linalg.norm(cameras[:, :3, 3] - lab_scene.Ts_world_cam[:, :3, 3], axis=1)
    print(f"cameras {what}: {1e3 * np.median(off_m):.2f} mm off")
