"""The session of the review's benchmark: 256 views of 1280x720, 8 objects, 5,000 grasps.

The views are rendered at a quarter of the size and enlarged; noise like a camera's is laid over
them, another for every view, so that each file costs what a photograph's does.
"""

from pathlib import Path

import numpy as np
from labels_scene import cameras
from labels_scene import scene as labels_scene

from realsim.arrays import Array
from realsim.formats.bop.models import save_models
from realsim.geometry import se3
from realsim.records import (
    CameraIntrinsics,
    CaptureSession,
    GraspSet,
    ObjectModel,
    ObjectPose,
    Scene,
    SupportPlane,
    View,
)
from realsim.rendering.labels import LabelRenderer
from realsim.rendering.rays import BACKGROUND, PlacedMesh
from realsim.store import SessionStore, save_grasps, save_scene

WIDTH, HEIGHT = 1280, 720
SHRINK = 4
DEPTH_UNIT_M = 1e-4
NOISE_SIGMA = 4.0
"""Noise of the photographs [of 255]: a PNG of 1.3 MB, as those of a D405 are."""
DEPTH_SIGMA = 8.0
"""Noise of the depth [counts]: 0.8 mm, that of a D405 at 0.5 m."""
GRASPS = 5_000
OBJECTS = 8
"""Every other one of the 15 real CAD meshes of the labels' benchmark: 190,000 faces."""
CAMERA = CameraIntrinsics(
    width=WIDTH, height=HEIGHT, fx=650.0, fy=650.0, cx=(WIDTH - 1) / 2, cy=(HEIGHT - 1) / 2,
    distortion=np.array([-0.055, 0.062, 0.0005, -0.0007, -0.02]),
)  # fmt: skip


def make_session(folder: Path, views: int, seed: int) -> SessionStore:
    """Return a new registered session with its grasps."""
    import cv2

    rng = np.random.default_rng(seed)
    session = CaptureSession(name="review", intrinsics=CAMERA, views=(), depth_unit_m=DEPTH_UNIT_M)
    store = SessionStore.create(folder, session)
    placed = scene()
    renderer = LabelRenderer(placed)
    small = _shrunk()
    colors = rng.integers(40, 220, (32, 3), dtype=np.uint8)
    noise = rng.normal(0, NOISE_SIGMA, (HEIGHT, WIDTH, 3)).astype(np.int16)
    depth_noise = rng.normal(0, DEPTH_SIGMA, (HEIGHT, WIDTH)).astype(np.int32)
    for index, T in enumerate(cameras(views, 0.4, 0.6)):
        labels = renderer.render(small, T)
        light = np.clip(1.4 - labels.depth_m, 0.3, 1.2)[..., None]
        rgb = np.clip(colors[np.maximum(labels.ids, -1) + 1] * light, 0, 255).astype(np.uint8)
        rgb = cv2.resize(rgb, (WIDTH, HEIGHT), interpolation=cv2.INTER_LINEAR)
        shift = tuple(int(s) for s in rng.integers(0, HEIGHT, 2))
        rgb = np.clip(rgb + np.roll(noise, shift, (0, 1)), 0, 255).astype(np.uint8)
        depth = cv2.resize(labels.depth_m, (WIDTH, HEIGHT), interpolation=cv2.INTER_NEAREST)
        counts = np.rint(depth / DEPTH_UNIT_M).astype(np.int32)
        counts = np.where(counts > 0, counts + np.roll(depth_noise, shift, (0, 1)), 0)
        store.add_view(
            View(index=index, T_world_cam=T), rgb,
            depth_counts=np.clip(counts, 0, 65535).astype(np.uint16),
        )  # fmt: skip
    _save_scene(store, rng)
    store.close()
    return store


def scene() -> list[PlacedMesh]:
    """Return the table and the objects on it."""
    table, *placed = labels_scene()
    return [table, *placed[::2][:OBJECTS]]


def _shrunk() -> CameraIntrinsics:
    """Return the camera of the small pictures: their pixels are blocks of the large ones."""
    half = (SHRINK - 1) / 2
    return CameraIntrinsics(
        width=WIDTH // SHRINK, height=HEIGHT // SHRINK, fx=CAMERA.fx / SHRINK,
        fy=CAMERA.fy / SHRINK, cx=(CAMERA.cx - half) / SHRINK, cy=(CAMERA.cy - half) / SHRINK,
        distortion=CAMERA.distortion,
    )  # fmt: skip


def _save_scene(store: SessionStore, rng: np.random.Generator) -> None:
    placed = [p for p in scene() if p.instance != BACKGROUND]
    covariance = np.diag([1e-5] * 3 + [1e-7] * 3)
    objects = tuple(
        ObjectPose(
            obj_id=p.instance + 1, instance=p.instance, T_world_obj=p.T_world_obj,
            covariance=covariance, verdict=("accepted", "doubtful", "rejected")[p.instance % 3],
            checks={"agree": float(rng.uniform(0.5, 1.0))},
        )
        for p in placed
    )  # fmt: skip
    plane = SupportPlane(T_world_table=np.eye(4))
    save_scene(store, Scene(name="review", objects=objects, plane=plane))
    save_models(
        store.folder / "models",
        {p.instance + 1: ObjectModel(obj_id=p.instance + 1, name=f"part {p.instance}", mesh=p.mesh)
         for p in placed},
    )  # fmt: skip
    each = GRASPS // len(placed)
    for k, p in enumerate(placed):
        n = each + (GRASPS - each * len(placed) if k == 0 else 0)
        save_grasps(store, _grasps(p.instance, p.mesh.vertices, n, rng))


def _grasps(instance: int, vertices: Array, n: int, rng: np.random.Generator) -> GraspSet:
    at = vertices[rng.integers(0, len(vertices), n)]
    Ts = se3.from_rt(se3.exp_so3(rng.normal(size=(n, 3))), at)
    stages = rng.integers(0, 5, n)
    words = ("close: the object slipped", "lift: the object was lost", "oscillate: it turned",
             "pendulum: it slipped", "")  # fmt: skip
    return GraspSet(
        obj_id=instance + 1, instance=instance, Ts_obj_grasp=Ts,
        widths_m=rng.uniform(0.01, 0.08, n), scores=np.clip(stages / 4, 0, 1),
        base_scores=stages / 4, slip_m=np.full((n, 4), np.nan), slip_rad=np.full((n, 4), np.nan),
        reachable=rng.random(n) < 0.5, failures=tuple(words[s] for s in stages),
    )  # fmt: skip
