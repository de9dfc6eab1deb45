"""Labels of one frame: exact masks, what hides what, and a picture to look at."""

import numpy as np

from realsim import CameraIntrinsics, Mesh
from realsim.geometry import se3
from realsim.geometry.parts import part
from realsim.rendering.labels import LabelRenderer, PlacedMesh
from realsim.rendering.overlay import draw_axes, draw_outlines, instance_color, save_png
from realsim.rendering.overlay_words import write_legend
from realsim.rendering.photo import PhotoRenderer

intrinsics = CameraIntrinsics(
    width=640, height=360, fx=324.0, fy=324.0, cx=319.5, cy=179.5,
    distortion=np.array([-0.05, 0.05]),
)  # fmt: skip
names = ["bottle", "gear", "mug"]
spots = [(-0.05, -0.03), (0.05, 0.02), (-0.088, 0.072)]
# Seen from the side, the bottle hides a part of the mug behind it.
T_world_cam = se3.look_at(eye=[0.13, -0.27, 0.22], target=[-0.03, 0.01, 0.05])

table = Mesh(
    vertices=np.array([[-1.0, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]]),
    faces=np.array([[0, 1, 2], [0, 2, 3]]),
)
placed = [PlacedMesh(-1, table, np.eye(4))]  # -1: it hides things but has no label
for i, (name, (x, y)) in enumerate(zip(names, spots, strict=True)):
    mesh = part(name).mesh
    placed.append(PlacedMesh(i, mesh, se3.from_translation([x, y, -mesh.bounds[0, 2]])))

labels = LabelRenderer(placed).render(intrinsics, T_world_cam)
photo = PhotoRenderer(placed).render(intrinsics, T_world_cam, np.random.default_rng(0))

print("object   visible px   all px   visible share")
for i, name in enumerate(names):
    print(
        f"{name:8s} {labels.px_count_visib[i]:10d} {labels.px_count_all[i]:8d} "
        f"{labels.visible_fraction[i]:12.3f}"
    )

picture = draw_outlines(photo.rgb, labels.ids)
for p in placed[1:]:
    picture = draw_axes(picture, intrinsics, se3.invert(T_world_cam) @ p.T_world_obj, 0.03)
entries = [(name, instance_color(i)) for i, name in enumerate(names)]
picture = write_legend(picture, entries, labels.ids >= 0)
save_png("labels_of_a_frame.png", picture)
print("picture: labels_of_a_frame.png")
