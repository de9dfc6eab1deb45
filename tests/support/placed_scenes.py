"""A scene for engines: two brackets (not symmetric, coloured), a textured box, a turned table."""

from dataclasses import replace

import numpy as np
import trimesh

from realsim.formats.export_folder import ExportFolder
from realsim.formats.robot_scenes.placed_scene import SceneCamera, seen_from
from realsim.formats.robot_scenes.placing import Matter, place_scene
from realsim.geometry import se3
from realsim.records import CameraIntrinsics, ObjectModel, ObjectPose, Scene, SupportPlane
from trimesh_solids import solid

T_WORLD_TABLE = se3.from_rt(se3.exp_so3([0, 0, 0.3]), [0.5, 0.1, 0.7])
CAMERA = CameraIntrinsics(width=640, height=480, fx=600, fy=610, cx=300.5, cy=250.25)
FRICTION = 0.6


def bracket_bars():
    foot = trimesh.creation.box((0.08, 0.04, 0.02))
    foot.apply_translation([0.04, 0.02, 0.01])
    back = trimesh.creation.box((0.02, 0.03, 0.06))
    back.apply_translation([0.01, 0.015, 0.05])
    return foot, back


def bracket():
    """Return the bracket, and its matter: full inertia, centre of mass far from the origin."""
    bars = bracket_bars()
    both = trimesh.util.concatenate(bars)
    colors = np.random.default_rng(0).integers(0, 255, (len(both.vertices), 3)).astype(np.uint8)
    volume = sum(b.volume for b in bars)
    com = sum(b.volume * b.center_mass for b in bars) / volume
    inertia = np.zeros((3, 3))
    for b in bars:
        d = b.center_mass - com
        inertia += b.moment_inertia + b.volume * (d @ d * np.eye(3) - np.outer(d, d))
    matter = Matter(
        mass_kg=1000 * volume, center_of_mass=com, inertia=1000 * inertia,
        parts=[np.array(b.vertices) for b in bars],
    )  # fmt: skip
    return ObjectModel(obj_id=1, name="bracket", mesh=solid(both, colors=colors)), matter


def textured_box():
    shape = trimesh.creation.box((0.05, 0.06, 0.1))
    rng = np.random.default_rng(1)
    texture = rng.integers(0, 255, (32, 16, 3)).astype(np.uint8)
    mesh = solid(shape, uv=rng.random((8, 2)), texture=texture)
    return ObjectModel(obj_id=2, name="2 box/é", mesh=mesh)


def standing(x, y, yaw, z=0.0):
    return T_WORLD_TABLE @ se3.from_rt(se3.exp_so3([0, 0, yaw]), [x, y, z])


def registered():
    """Return scene, models and matter as a session has them."""
    one, matter = bracket()
    two = textured_box()
    objects = (
        ObjectPose(obj_id=1, instance=0, T_world_obj=standing(0, 0, 0.4)),
        ObjectPose(obj_id=2, instance=1, T_world_obj=standing(0.2, 0.1, 1.0, 0.05)),
        ObjectPose(obj_id=1, instance=2, T_world_obj=standing(-0.2, 0.1, 2.0)),
    )
    table = SupportPlane(T_world_table=T_WORLD_TABLE)
    scene = Scene(name="three things", objects=objects, plane=table)
    return scene, {1: one, 2: two}, {1: matter}


def placed_scene():
    T = se3.look_at([0.5, -0.5, 1.2], [0.5, 0.1, 0.7])
    view = SceneCamera(name="view_0", intrinsics=CAMERA, T_world_cam=T)
    scene = place_scene(*registered(), cameras=[view])
    bodies = {i: replace(body, friction=FRICTION) for i, body in scene.bodies.items()}
    return replace(scene, bodies=bodies)


def corners(body):
    """Return the corners of the faces (F, 3, 3) [m], the same whatever vertices are shared."""
    seen = body.model.mesh
    return seen.vertices[seen.faces]


def same_bodies(scene, found, tolerance=0.0, shapes=0.0):
    """Assert that two scenes have the same things at the same places."""
    assert [o.name for o in found.objects] == [o.name for o in scene.objects]
    for a, b in zip(scene.objects, found.objects, strict=True):
        A, B = scene.body(a), found.body(b)
        assert np.allclose(b.T_world_obj, a.T_world_obj, rtol=0, atol=1e-14 + tolerance)
        assert np.isclose(B.mass_kg, A.mass_kg, rtol=tolerance, atol=0)
        assert np.allclose(B.center_of_mass, A.center_of_mass, rtol=0, atol=1e-15 + tolerance)
        largest = np.abs(A.inertia).max()
        assert np.allclose(B.inertia, A.inertia, rtol=0, atol=(1e-12 + tolerance) * largest)
        assert np.isclose(B.friction, A.friction)
        assert np.allclose(corners(B), corners(A), rtol=0, atol=shapes)
    table, other = scene.table, found.table
    assert np.allclose(other.T_world_table, table.T_world_table, rtol=0, atol=1e-12)
    assert np.allclose(other.size_m, table.size_m)
    assert np.isclose(other.thickness_m, table.thickness_m)


def turned_to(scene, seed=3):
    """Return the scene in another world: its table stands aslant there."""
    return seen_from(scene, se3.random_transform(np.random.default_rng(seed)))


def written(write, scene, folder):
    """Write a scene as an export of its own by a format's writer."""
    out = ExportFolder.begin(folder, {"scene": scene.name})
    told = write(scene, out)
    out.finish({})
    return told
