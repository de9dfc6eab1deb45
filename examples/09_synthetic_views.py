"""Synthetic views of two placed meshes: photograph, labels, and what a depth camera reports."""

import numpy as np

from realsim import CameraIntrinsics, Mesh
from realsim.geometry import se3
from realsim.geometry.parts import part
from realsim.rendering import map_pictures
from realsim.rendering.depth_sensors.model import DepthSensorModel
from realsim.rendering.labels import LabelRenderer, PlacedMesh
from realsim.rendering.overlay import contact_sheet, depth_picture, save_png
from realsim.rendering.photo import PhotoRenderer
from realsim.rendering.procedural.choose import random_environment, random_material
from realsim.rendering.rays import RayScene

rng = np.random.default_rng(3)
intrinsics = CameraIntrinsics(
    width=640, height=360, fx=324.0, fy=324.0, cx=319.5, cy=179.5,
    distortion=np.array([-0.05, 0.05]),
)  # fmt: skip
table = Mesh(
    vertices=np.array([[-0.6, -0.6, 0.0], [0.6, -0.6, 0.0], [0.6, 0.6, 0.0], [-0.6, 0.6, 0.0]]),
    faces=np.array([[0, 1, 2], [0, 2, 3]]),
)
placed = [PlacedMesh(-1, table, np.eye(4), random_material(rng, "oak"))]  # -1: no label
looks = ("painted metal", "glossy plastic")
for i, (name, look) in enumerate(zip(("mug", "l_bracket"), looks, strict=True)):
    mesh = part(name).mesh
    T_world_obj = se3.from_translation([0.11 * i - 0.05, 0.06 * i, -mesh.bounds[0, 2]])
    placed.append(PlacedMesh(i, mesh, T_world_obj, random_material(rng, look)))

# What can be prepared once is prepared once; views are without end.
labeller, scene = LabelRenderer(placed), RayScene(placed)
photographer = PhotoRenderer(placed, environment=random_environment(rng))
camera = DepthSensorModel.from_profile("d405")

print("view  object  visible share   exact depth   measured depth   not measured")
cells = []
for view, eye in enumerate(([0.10, -0.30, 0.20], [-0.28, -0.10, 0.30])):
    T_world_cam = se3.look_at(eye=eye, target=[0.0, 0.02, 0.03])
    labels = labeller.render(intrinsics, T_world_cam)
    photo = photographer.render(intrinsics, T_world_cam, rng)
    measured_m = camera.measure(
        labels.depth_m, intrinsics, rng, scene=scene, T_world_cam=T_world_cam
    )
    for i, share in labels.visible_fraction.items():
        exact, seen = labels.depth_m[labels.visible(i)], measured_m[labels.visible(i)]
        print(
            f"{view:4d} {i:7d} {share:14.3f} {np.median(exact):11.4f} m "
            f"{np.median(seen[seen > 0]):14.4f} m {100 * np.mean(seen == 0):12.1f} %"
        )
    cells += [photo.rgb, map_pictures.instance_picture(labels.ids, photo.rgb)]
    cells += [map_pictures.normals_picture(labels.normals()), depth_picture(measured_m, 0.2, 0.6)]

save_png("synthetic_views.png", contact_sheet(cells, columns=4))
print("picture: synthetic_views.png")
