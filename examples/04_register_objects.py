"""Register objects: from rough poses and noisy depth of six views to poses with a verdict."""

import numpy as np

from realsim import CameraIntrinsics, Mesh, ObjectPose
from realsim.geometry import se3
from realsim.geometry.metrics import mssd_symmetric
from realsim.geometry.parts import part
from realsim.registration.register import DepthFrame, register_scene
from realsim.rendering.depth_sensors.model import DepthSensorModel
from realsim.rendering.labels import LabelRenderer, PlacedMesh

rng = np.random.default_rng(0)
intrinsics = CameraIntrinsics(width=640, height=360, fx=324.0, fy=324.0, cx=319.5, cy=179.5)
parts = [part("mug"), part("l_bracket"), part("cylinder_can")]
spots = [(-0.09, 0.00), (0.06, 0.08), (0.07, -0.08)]

# The truth: three parts that stand on a table.
truth: dict[int, np.ndarray] = {}
for i, (model, (x, y)) in enumerate(zip(parts, spots, strict=True)):
    turn = se3.exp_so3([0.0, 0.0, rng.uniform(-np.pi, np.pi)])
    truth[i] = se3.from_rt(turn, [x, y, -model.mesh.bounds[0, 2]])
corners = [[-0.5, -0.5, 0], [0.5, -0.5, 0], [0.5, 0.5, 0], [-0.5, 0.5, 0]]
table = Mesh(vertices=np.array(corners, dtype=float), faces=np.array([[0, 1, 2], [0, 2, 3]]))
renderer = LabelRenderer(
    [PlacedMesh(-1, table, np.eye(4))]
    + [PlacedMesh(i, model.mesh, truth[i]) for i, model in enumerate(parts)]
)

# Six depth pictures from all around, as a D405 would measure them.
sensor = DepthSensorModel()
frames: list[DepthFrame] = []
for k, angle in enumerate(np.linspace(0, 2 * np.pi, 6, endpoint=False)):
    eye = [0.25 * np.cos(angle), 0.25 * np.sin(angle), 0.35]
    T_world_cam = se3.look_at(eye, [0.0, 0.0, 0.03])
    exact = renderer.render(intrinsics, T_world_cam).depth_m
    measured = sensor.measure(exact, intrinsics, rng)
    frames.append(DepthFrame(index=k, depth_m=measured, T_world_cam=T_world_cam))

# A person's rough poses: some 10 mm and 10 degrees off.
starts: list[ObjectPose] = []
for i, model in enumerate(parts):
    off = np.concatenate([rng.normal(scale=0.1, size=3), rng.normal(scale=0.006, size=3)])
    starts.append(ObjectPose(obj_id=model.obj_id, instance=i, T_world_obj=truth[i] @ se3.exp(off)))

models = {model.obj_id: model for model in parts}
result = register_scene("three parts", intrinsics, frames, models, starts)

print("object         start    six views   one view   verdict")
for i, (model, start) in enumerate(zip(parts, starts, strict=True)):
    found = (start, result.scene.object(i), result.single_view.object(i))
    mm = [1e3 * mssd_symmetric(truth[i], p.T_world_obj, model) for p in found]
    verdict = result.scene.object(i).verdict
    print(f"{model.name:12s} {mm[0]:5.1f} mm   {mm[1]:6.2f} mm  {mm[2]:6.2f} mm   {verdict}")
