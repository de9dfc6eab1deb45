"""A small synthetic scene, its cameras, and a session of it as if it had been captured."""

import re
from dataclasses import replace

import numpy as np

from begun_sessions import begun
from plain_meshes import box
from realsim import CameraIntrinsics, ObjectModel, ObjectPose, Scene, SupportPlane, View
from realsim.formats.bop.models import save_models
from realsim.geometry import se3
from realsim.rendering.appearance import Environment, Material
from realsim.rendering.depth_sensors.model import DepthSensorModel
from realsim.rendering.photo import PhotoRenderer
from realsim.rendering.rays import PlacedMesh
from realsim.store import save_scene
from realsim_sim_bridge.synthetic.config import hemisphere_cameras
from realsim_sim_bridge.synthetic.scene import SyntheticScene

INTRINSICS = CameraIntrinsics(
    width=160, height=120, fx=150.0, fy=151.0, cx=78.7, cy=60.2,
    distortion=np.array([-0.08, 0.02, 0.001, -0.001, 0.0]),
)  # fmt: skip
TABLE = se3.from_translation([0.5, 0.0, 0.1])
DEPTH_UNIT_M = 1e-4


MODELS = {
    1: ObjectModel(obj_id=1, name="tall", mesh=box((0.04, 0.04, 0.12), (200, 60, 40))),
    7: ObjectModel(obj_id=7, name="flat", mesh=box((0.08, 0.06, 0.03), (40, 90, 200))),
}


def placed(obj_id, instance, x, y, verdict="accepted", **more):
    height = float(MODELS[obj_id].mesh.extent[2]) / 2
    T = TABLE @ se3.from_rt(se3.exp_so3([0, 0, 0.3 * instance]), [x, y, height])
    return ObjectPose(obj_id=obj_id, instance=instance, T_world_obj=T, verdict=verdict, **more)


def two_boxes(*more):
    """Return the scene: a tall box that hides a part of a flat one."""
    objects = (placed(1, 0, -0.04, 0.0), placed(7, 3, 0.04, 0.01), *more)
    return Scene(name="two boxes", objects=objects, plane=SupportPlane(T_world_table=TABLE))


def sky(brightness=0.6):
    panorama = np.full((8, 16, 3), brightness, np.float32)
    return Environment(panorama=panorama, sun=(0.3, 0.3, 0.3), name="even sky")


def table():
    material = Material(base_color=(0.4, 0.3, 0.2), name="brown")
    T = TABLE @ se3.from_translation([0.0, 0.0, -0.01])
    return PlacedMesh(-1, box((4.0, 4.0, 0.02)), T, material)


def synthetic_scene(**changed):
    fields = {
        "name": "two boxes", "scene": two_boxes(), "models": MODELS, "environment": sky(),
        "surroundings": (table(),), "provenance": {"made by": "a test"},
    }  # fmt: skip
    return SyntheticScene(**fields | changed)


def cameras(count=3, seed=0):
    return hemisphere_cameras([0.5, 0.0, 0.13], (0.35, 0.5), count, np.random.default_rng(seed))


def captured_session(folder, count=3, scene=None):
    """Write a session as a robot would have captured it, and register it exactly."""
    scene = two_boxes() if scene is None else scene
    store = begun(folder, INTRINSICS, {"camera": "simulated D405"}, unit_m=DEPTH_UNIT_M)
    shown = [PlacedMesh(o.instance, MODELS[o.obj_id].mesh, o.T_world_obj) for o in scene.objects]
    renderer = PhotoRenderer([*shown, table()])
    rng = np.random.default_rng(5)
    for k, T in enumerate(cameras(count, seed=9)):
        photo = renderer.render(INTRINSICS, T, rng)
        depth_m = DepthSensorModel().measure(photo.depth_m, INTRINSICS, rng)
        store.add_view(View(index=2 * k, T_world_cam=T), photo.rgb, depth_m)
    save_models(store.folder / "models", MODELS)
    save_scene(store, scene)
    return store


def rejected(scene, instance):
    """Return the scene with one object rejected."""
    objects = (
        replace(o, verdict="rejected", reasons=("wrong",)) if o.instance == instance else o
        for o in scene.objects
    )
    return replace(scene, objects=tuple(objects))


VOLATILE = ("session.json", "session.begun.json", "manifest.jsonl")
"""They tell when the session was made, and in which order."""


def content(folder):
    """Return the bytes of every file of a session that do not depend on the time of day."""
    found = {}
    for path in sorted(p for p in folder.rglob("*") if p.is_file() and p.name not in VOLATILE):
        data = path.read_bytes()
        if path.name == "scene_gt_coco.json":
            data = re.sub(rb'"date_created": "[^"]*"', b"", data)
        found[str(path.relative_to(folder))] = data
    return found
