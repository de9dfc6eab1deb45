"""Synthetic scenes: parts on a table, seen by a small noisy stereo camera from a hemisphere."""

from dataclasses import dataclass

import numpy as np
import pytest

from realsim.geometry import se3
from realsim.geometry.parts import part
from realsim.records import CameraIntrinsics, Mesh, ObjectModel, ObjectPose
from realsim.registration.register import DepthFrame
from realsim.rendering.labels import LabelRenderer, PlacedMesh

CAMERA = CameraIntrinsics(width=320, height=180, fx=230.0, fy=230.0, cx=159.5, cy=89.5)
NOISE_PER_M = 0.08 / (645.0 * 0.018)


@dataclass
class SyntheticScene:
    intrinsics: CameraIntrinsics
    frames: list[DepthFrame]
    models: dict[int, ObjectModel]
    truth: list[ObjectPose]

    def starts(self, rng: np.random.Generator, mm: float = 10, deg: float = 10):
        """The truth, each object moved by `mm` and turned by `deg` about its box centre."""
        return [perturbed(p, self.models[p.obj_id], rng, mm, deg) for p in self.truth]


def perturbed(pose: ObjectPose, model: ObjectModel, rng, mm: float, deg: float) -> ObjectPose:
    w, v = rng.normal(size=3), rng.normal(size=3)
    w *= np.radians(deg) / np.linalg.norm(w)
    v *= 1e-3 * mm / np.linalg.norm(v)
    C = se3.from_translation(model.mesh.bounds.mean(0))
    T = pose.T_world_obj @ C @ se3.from_rt(se3.exp_so3(w), v) @ se3.invert(C)
    return ObjectPose(obj_id=pose.obj_id, instance=pose.instance, T_world_obj=T)


def table_mesh(half: float = 0.4) -> Mesh:
    v = half * np.array([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]], dtype=np.float64)
    return Mesh(vertices=v, faces=np.array([[0, 1, 2], [0, 2, 3]], dtype=np.int32))


def standing(name: str, instance: int, xy, yaw: float, tip=(0.0, 0.0, 0.0)) -> ObjectPose:
    """A part at xy, turned by `tip` and then by `yaw`, its lowest vertex on the table z = 0."""
    model = part(name)
    R = se3.exp_so3([0, 0, yaw]) @ se3.exp_so3(tip)
    lowest = (model.mesh.vertices @ R.T)[:, 2].min()
    T = se3.from_rt(R, [xy[0], xy[1], -lowest])
    return ObjectPose(obj_id=model.obj_id, instance=instance, T_world_obj=T)


def build_scene(objects, views: int, seed: int, noise_per_m: float = NOISE_PER_M) -> SyntheticScene:
    """`objects` are (name, xy, yaw, tip); the first view looks straight down."""
    rng = np.random.default_rng(seed)
    truth = [standing(n, i, xy, yaw, tip) for i, (n, xy, yaw, tip) in enumerate(objects)]
    models = {part(o[0]).obj_id: part(o[0]) for o in objects}
    placed = [PlacedMesh(-1, table_mesh(), np.eye(4))]
    placed += [PlacedMesh(p.instance, models[p.obj_id].mesh, p.T_world_obj) for p in truth]
    renderer = LabelRenderer(placed)
    frames: list[DepthFrame] = []
    for i in range(views):
        if i == 0:
            eye = np.array([0.0, 0.001, 0.4])
        else:
            azimuth = 2 * np.pi * i / (views - 1) + rng.uniform(-0.2, 0.2)
            elevation = np.radians(rng.uniform(35, 65))
            flat = np.cos(elevation)
            eye = rng.uniform(0.32, 0.4) * np.array(
                [flat * np.cos(azimuth), flat * np.sin(azimuth), np.sin(elevation)]
            )
        T = se3.look_at(eye, [0.0, 0.0, 0.02])
        z = renderer.render(CAMERA, T).depth_m.astype(np.float64)
        noisy = z + rng.normal(size=z.shape) * noise_per_m * z**2
        frames.append(
            DepthFrame(index=i, depth_m=np.where(z > 0, noisy, 0).astype(np.float32), T_world_cam=T)
        )
    return SyntheticScene(intrinsics=CAMERA, frames=frames, models=models, truth=truth)


CLUTTER = (
    ("box", (-0.06, 0.03), 0.4, (0.0, 0.0, 0.0)),
    ("wedge", (0.05, 0.05), 1.1, (0.0, 0.0, 0.0)),
    ("l_bracket", (0.055, -0.05), -0.7, (np.pi / 2, 0.0, 0.0)),
    ("t_profile", (-0.05, -0.06), 2.0, (np.pi / 2, 0.0, 0.0)),
)


@pytest.fixture(scope="session")
def clutter() -> SyntheticScene:
    return build_scene(CLUTTER, 8, 5)


@pytest.fixture(scope="session")
def make_scene():
    """The function `build_scene(objects, views, seed, noise_per_m)`."""
    return build_scene
