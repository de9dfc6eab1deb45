"""Frames and cameras: where a point of the table lies in a distorted image, and back again."""

import numpy as np

from realsim import CameraIntrinsics
from realsim.geometry import camera, se3

T_world_cam = se3.look_at(eye=[0.35, -0.20, 0.30], target=[0.38, 0.0, 0.0])
intrinsics = CameraIntrinsics(
    width=1280, height=720, fx=645.0, fy=645.0, cx=640.0, cy=360.0,
    distortion=np.array([-0.055, 0.06, 0.0005, 0.0007, -0.02]),
)  # fmt: skip
points_world = np.array([[0.38, 0.0, 0.0], [0.30, 0.05, 0.02], [0.45, -0.05, 0.04]])

points_cam = se3.transform(se3.invert(T_world_cam), points_world)
pixels = camera.project(intrinsics, points_cam)
rays, exists = camera.undistort(intrinsics, pixels)
again = se3.transform(T_world_cam, np.c_[rays, np.ones(3)] * points_cam[:, 2:])

for p, uv in zip(points_world, pixels, strict=True):
    print(f"world {p} m  ->  pixel ({uv[0]:.2f}, {uv[1]:.2f})")
print(f"there and back: {np.abs(again - points_world).max():.1e} m, all exist: {exists.all()}")
