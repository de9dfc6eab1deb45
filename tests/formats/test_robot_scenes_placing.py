"""Registered scenes as engines take them: bodies, names, table; what cannot be is refused."""

from dataclasses import replace

import numpy as np
import pytest

import placed_scenes
from realsim.formats.robot_scenes.mesh_obj import look_of
from realsim.formats.robot_scenes.placed_scene import RigidBody, file_name, seen_from, unique_names
from realsim.formats.robot_scenes.placing import TABLE_MARGIN_M, place_scene
from realsim.geometry import se3
from realsim.geometry.mesh import mass_properties
from refusals import refused


def test_another_world_frame_moves_everything_alike_and_back():
    scene = placed_scenes.placed_scene()
    T = se3.random_transform(np.random.default_rng(0))
    moved = seen_from(scene, T)
    a, b = scene.objects[0], moved.objects[0]
    assert np.allclose(T @ b.T_world_obj, a.T_world_obj)
    assert np.allclose(T[:3, :3] @ moved.gravity, scene.gravity)
    assert np.allclose(T @ moved.cameras[0].T_world_cam, scene.cameras[0].T_world_cam)
    placed_scenes.same_bodies(scene, seen_from(moved, se3.invert(T)), 1e-12)


def test_gravity_and_table_follow_the_plane_wherever_the_world_is():
    scene, models, matter = placed_scenes.registered()
    T = se3.random_transform(np.random.default_rng(1))
    objects = tuple(replace(o, T_world_obj=T @ o.T_world_obj) for o in scene.objects)
    plane = replace(scene.plane, T_world_table=T @ scene.plane.T_world_table)
    turned = place_scene(replace(scene, objects=objects, plane=plane), models, matter)
    straight = place_scene(scene, models, matter)
    assert np.allclose(turned.gravity, T[:3, :3] @ straight.gravity)
    assert np.allclose(turned.table.T_world_table, T @ straight.table.T_world_table)
    assert np.allclose(turned.table.size_m, straight.table.size_m)


def test_the_table_carries_all_objects_with_its_margin():
    scene = placed_scenes.placed_scene()
    low, high = np.full(2, np.inf), np.full(2, -np.inf)
    for o in scene.objects:
        at = se3.invert(scene.table.T_world_table) @ o.T_world_obj
        points = se3.transform(at, scene.body(o).model.mesh.vertices)
        low, high = np.minimum(low, points[:, :2].min(0)), np.maximum(high, points[:, :2].max(0))
        assert abs(points[:, 2].min()) < 1e-12
    half = np.array(scene.table.size_m) / 2
    assert np.allclose(low, -half + TABLE_MARGIN_M) and np.allclose(high, half - TABLE_MARGIN_M)


def test_an_object_without_known_matter_has_its_hull_and_its_density_and_a_note_says_so():
    scene = placed_scenes.placed_scene()
    box = scene.bodies[2]
    assert box.parts is None and np.isclose(box.mass_kg, 1000 * 0.05 * 0.06 * 0.1)
    assert any("2 box" in n and "hull" in n and "0.3 kg" in n for n in scene.notes)
    assert not any("bracket" in n for n in scene.notes)


def test_convex_parts_are_closed_and_keep_their_volume():
    foot, back = placed_scenes.bracket_bars()
    parts = placed_scenes.placed_scene().bodies[1].parts
    solids = [mass_properties(p, 1.0) for p in parts]
    assert all(s.is_watertight for s in solids)
    assert np.allclose([s.volume_m3 for s in solids], [foot.volume, back.volume])


def test_scenes_that_cannot_be_simulated_are_refused():
    scene, models, matter = placed_scenes.registered()
    for change, says in (({"plane": None}, "no supporting plane"), ({"objects": ()}, "no objects")):
        refused(says, place_scene, replace(scene, **change), models, matter)
    one_model = {1: models[1]}
    refused(r"object 2 .* has no model; there are: bracket", place_scene, scene, one_model, matter)
    flat = {1: replace(matter[1], parts=[np.zeros((5, 3))])}
    refused(r"part 0 of object 'bracket' .* flat", place_scene, scene, models, flat)


@pytest.mark.parametrize(
    ("change", "what"),
    [
        ({"mass_kg": 0.0}, "mass"),
        ({"mass_kg": float("nan")}, "mass"),
        ({"inertia": np.diag([1.0, 1.0, 3.0])}, "two exceed the third"),
        ({"inertia": -np.eye(3)}, "positive"),
        ({"inertia": np.array([[1.0, 0.5, 0], [0, 1, 0], [0, 0, 1]])}, "not symmetric"),
        ({"inertia": np.full((3, 3), np.nan)}, "NaN"),
        ({"friction": -0.1}, "friction"),
        ({"parts": ()}, "convex parts"),
    ],
)
def test_bodies_that_cannot_be_are_refused(change, what):
    body = placed_scenes.placed_scene().bodies[1]
    refused(what, replace, body, **change)
    assert isinstance(body, RigidBody)


def test_names_are_files_and_prims_and_differ():
    assert file_name("2 box/é") == "_2_box" and file_name("") == "object"
    names = unique_names({0: "mug", 1: "Mug", 2: "table", 3: "can", 4: "mug_0"})
    assert len({n.lower() for n in names.values()}) == 5 and names[3] == "can"
    assert all(n == file_name(n) and n != "table" for n in names.values())
    scene = placed_scenes.placed_scene()
    refused("letters, digits", replace, scene.objects[0], name="a b")
    twice = tuple(replace(o, name="one") for o in scene.objects)
    refused("used twice", replace, scene, objects=twice)


def test_colours_of_vertices_become_a_texture_of_the_faces_mean_colours():
    model, _ = placed_scenes.bracket()
    look = look_of(model.mesh)
    height, width = look.texture.shape[:2]
    at = look.corner_uv[:, 0]
    shown = look.texture[((1 - at[:, 1]) * height).astype(int), (at[:, 0] * width).astype(int)]
    wanted = np.rint(model.mesh.colors[model.mesh.faces].mean(axis=1))
    assert np.array_equal(shown, wanted)
