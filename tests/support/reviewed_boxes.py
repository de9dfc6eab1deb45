"""A small registered session of two boxes on a table, with grasps: what a review is opened on."""

import atexit
import shutil
import tempfile
from functools import cache
from pathlib import Path

import numpy as np

from begun_sessions import add_drawn, begun
from plain_meshes import box
from realsim import CameraIntrinsics, GraspSet, ObjectModel, ObjectPose, Scene, SupportPlane
from realsim.arrays import Array, UInt8
from realsim.formats.bop.models import save_models
from realsim.geometry import se3
from realsim.rendering.labels import LabelRenderer, PlacedMesh
from realsim.review.content.config import SceneConfig
from realsim.store import SessionStore, save_grasps, save_scene
from tried_grasps import plain_grasps

INTRINSICS = CameraIntrinsics(
    width=160, height=120, fx=150.0, fy=150.0, cx=79.5, cy=59.5,
    distortion=np.array([-0.05, 0.02, 1e-3, -1e-3, 0.0]),
)  # fmt: skip
DEPTH_UNIT_M = 1e-4
RED = (180, 60, 40)
CONFIG = SceneConfig(
    voxel_m=0.004, coarse_points=200, piece_points=700, shown_points=1000, thumbnail_px=40
)
CAMERAS = [
    se3.look_at([0.5 + 0.4 * np.cos(a), 0.4 * np.sin(a), 0.3], [0.5, 0.0, 0.03])
    for a in (0.0, 1.6, 3.1, 4.7)
]


MODELS = {
    1: ObjectModel(obj_id=1, name="tall", mesh=box((0.04, 0.04, 0.12), RED)),
    7: ObjectModel(obj_id=7, name="flat", mesh=box((0.08, 0.06, 0.03), RED)),
    9: ObjectModel(obj_id=9, name="spare", mesh=box((0.05, 0.05, 0.05), RED)),
}
SCENE = Scene(
    name="two boxes",
    objects=(
        ObjectPose(
            obj_id=1, instance=0, T_world_obj=se3.from_translation([0.46, 0.0, 0.06]),
            verdict="accepted", checks={"agree": 0.98}, covariance=1e-6 * np.eye(6),
        ),
        ObjectPose(
            obj_id=7, instance=3, T_world_obj=se3.from_translation([0.55, 0.02, 0.015]),
            verdict="doubtful", reasons=("seen by one view",), checks={"agree": 0.71},
        ),
    ),
    plane=SupportPlane(T_world_table=se3.from_translation([0.5, 0.0, 0.0])),
)  # fmt: skip


def grasp_set(obj_id: int, instance: int, n: int = 40) -> GraspSet:
    rng = np.random.default_rng(instance)
    Ts = se3.from_rt(np.diag([1.0, -1.0, -1.0]), rng.normal(scale=0.01, size=(n, 3)))
    stages = np.append(np.arange(n - 1) % 5, np.nan) / 4
    words = {0.0: "close: the object slipped 7.5 mm", 0.25: "lift: the object was lost",
             0.5: "oscillate: it turned", 0.75: "pendulum: it turned", 1.0: ""}  # fmt: skip
    return plain_grasps(
        Ts, obj_id=obj_id, instance=instance, widths_m=rng.uniform(0.02, 0.08, n),
        scores=np.append(np.linspace(0, 1, n - 1), np.nan), base_scores=stages,
        reachable=np.arange(n) % 2 == 0,
        failures=tuple(words.get(float(s), "no inverse kinematics") for s in stages),
    )  # fmt: skip


def boxes_session(folder: Path, larger: int = 1) -> SessionStore:
    """Return a session whose depth is exact to half a count: a copy of one made once a process."""
    return SessionStore.open(Path(shutil.copytree(_original(larger), folder)))


@cache
def _original(larger: int) -> Path:
    folder = Path(tempfile.mkdtemp(prefix="boxes_"))
    atexit.register(shutil.rmtree, folder, ignore_errors=True)
    K = INTRINSICS
    camera = CameraIntrinsics(
        width=larger * K.width, height=larger * K.height, fx=larger * K.fx, fy=larger * K.fy,
        cx=larger * (K.cx + 0.5) - 0.5, cy=larger * (K.cy + 0.5) - 0.5, distortion=K.distortion,
    )  # fmt: skip
    store = begun(folder / "boxes", camera, name="boxes", unit_m=DEPTH_UNIT_M)
    table = PlacedMesh(-1, box((1.0, 1.0, 0.02), RED), se3.from_translation([0.5, 0.0, -0.01]))
    placed = [PlacedMesh(o.instance, MODELS[o.obj_id].mesh, o.T_world_obj) for o in SCENE.objects]
    renderer = LabelRenderer([*placed, table])
    rng = np.random.default_rng(1)

    def noisy(ids: Array) -> UInt8:
        rgb = np.where(ids[..., None] == 0, 200, 90).repeat(3, -1)
        return (rgb + rng.integers(0, 20, rgb.shape)).astype(np.uint8)

    add_drawn(store, renderer, CAMERAS, noisy)
    save_scene(store, SCENE)
    for placed_object in SCENE.objects:
        save_grasps(store, grasp_set(placed_object.obj_id, placed_object.instance))
    save_models(store.folder / "models", MODELS)
    store.close()
    return store.folder
