"""A scene under physics: what rests must rest, and what cannot stand must be named."""

import shutil
from dataclasses import replace
from functools import partial
from unittest.mock import patch

import cv2
import numpy as np
import pytest
from pybullet_utils.bullet_client import BulletClient

import bop_scenes
from realsim.errors import RealsimError
from realsim.geometry import se3
from realsim.models.properties import physical_properties
from realsim.records import Mesh, ObjectModel, ObjectPose, Scene, SupportPlane
from realsim_sim_bridge.scenes import stable_state, table_world
from realsim_sim_bridge.scenes.importers import from_bop, load_scene_source
from realsim_sim_bridge.scenes.school_scene import Matter, SchoolScene, Support, known_solids
from realsim_sim_bridge.scenes.stable_state import HEADERS, stand_picture, stand_rows
from realsim_sim_bridge.scenes.table_world import TableWorld
from refusals import refused
from trimesh_solids import box

SIDE = 0.05
CUBE = (SIDE, SIDE, SIDE)


def cube(obj_id=1, **kwargs):
    return ObjectModel(obj_id=obj_id, name=f"cube{obj_id}", mesh=box(CUBE), **kwargs)


def place(x, y, z, instance=0, obj_id=1, turn=(0.0, 0.0, 0.0)):
    T = se3.from_rt(se3.exp_so3(np.asarray(turn, float)), [x, y, z])
    return ObjectPose(obj_id=obj_id, instance=instance, T_world_obj=T)


def school_scene(*objects, models=None, T_world_table=None, matter=None, supports=()):
    models = models or {1: cube()}
    T = np.eye(4) if T_world_table is None else T_world_table
    moved = tuple(replace(o, T_world_obj=T @ o.T_world_obj) for o in objects)
    scene = Scene(name="test", objects=moved, plane=SupportPlane(T_world_table=T))
    solids = known_solids(models, matter)
    return SchoolScene(scene=scene, models=models, solids=solids, supports=supports)


def run(scene, seconds=1.0, friction=1.0):
    with (
        patch.multiple(stable_state, SHORTEST_S=seconds, LONGEST_S=seconds),
        patch.object(table_world, "FRICTION", friction),
        TableWorld(scene) as world,
    ):
        return stable_state.stable_state(world)


def verdicts(report):
    return [o.verdict for o in report.objects]


@pytest.mark.parametrize("mass", [0.01, 2.0])
def test_a_box_stands_for_a_second_within_a_tenth_of_a_millimetre(mass):
    report = run(school_scene(place(0, 0, SIDE / 2), matter=Matter(masses_kg={1: mass})))
    (stand,) = report.objects
    assert stand.verdict == "stands" and stand.at_rest
    assert stand.moved_m < 1e-4 and stand.turned_deg < 0.05 and stand.jump_m_s < 0.02
    assert abs(stand.gap_m) < 1e-5 and stand.into == {}


def test_nothing_depends_on_where_the_table_is_in_the_world():
    rng = np.random.default_rng(3)
    objects = (place(0, 0, SIDE / 2), place(0.12, 0, SIDE / 2 + 0.004, 1, turn=(0.3, 0.0, 0.1)))
    T = se3.random_transform(rng)
    here, there = run(school_scene(*objects)), run(school_scene(*objects, T_world_table=T))
    assert verdicts(here) == verdicts(there)
    for a, b in zip(here.objects, there.objects, strict=True):
        assert np.allclose(T @ a.T_world_before, b.T_world_before, atol=1e-9)
        assert abs(a.moved_m - b.moved_m) < 5e-4 and abs(a.turned_deg - b.turned_deg) < 0.5


def on_slope(degrees):
    """A flat box on a slope: it is too low to tip over."""
    R = se3.exp_so3(np.array([0.0, np.radians(degrees), 0.0]))
    T_slope = se3.from_rt(R, [0.0, 0.0, 0.4])
    flat = ObjectModel(obj_id=1, name="flat", mesh=box((0.06, 0.06, 0.01)))
    T = T_slope @ se3.from_translation([0.0, 0.0, 0.015])
    pose = ObjectPose(obj_id=1, instance=0, T_world_obj=T)
    support = Support(name="slope", T_world_support=T_slope, mesh=box((0.8, 0.4, 0.02)))
    return school_scene(pose, models={1: flat}, supports=(support,))


@pytest.mark.parametrize("degrees", [44, 46])
def test_a_box_on_a_wedge_slides_just_where_coulomb_says(degrees):
    """A flat box of mu 1 holds up to 45 degrees and slides beyond."""
    angle, seconds = np.radians(degrees), 0.3
    (stand,) = run(on_slope(degrees), seconds).objects
    expected = 0.5 * 9.81 * seconds**2 * max(0.0, np.sin(angle) - np.cos(angle))
    assert abs(stand.moved_m - expected) < 1e-4 + 0.02 * expected
    assert stand.verdict == ("stands" if degrees < 45 else "falls")


def test_friction_is_of_the_contact_not_its_square():
    """At mu 0.5 the limit is 26.6 degrees; a product of 0.25 would give 14."""
    assert verdicts(run(on_slope(22), friction=0.5)) == ["stands"]
    assert verdicts(run(on_slope(22), friction=0.3)) == ["falls"]


def test_a_heavy_end_shifts_the_centre_of_mass():
    """The matter given decides, not the shape: with the mass at its far end the rod falls."""
    mesh = box((0.2, 0.2, 0.2), (0, 0, 0.1))
    support = Support(name="step", T_world_support=np.eye(4), mesh=mesh)
    rod = ObjectModel(obj_id=1, name="rod", mesh=box((0.1, 0.02, 0.02)))
    scene = school_scene(place(0.08, 0, 0.21), models={1: rod}, supports=(support,))
    solid = scene.solids[1]
    heavy = replace(solid.matter, center_of_mass=np.array([0.04, 0.0, 0.0]))
    assert verdicts(run(scene)) == ["stands"]
    leaning = replace(scene, solids={1: replace(solid, matter=heavy)})
    assert verdicts(run(leaning)) == ["falls"]


def test_an_object_sunk_into_the_table_jumps_and_the_depth_is_named():
    (stand,) = run(school_scene(place(0, 0, SIDE / 2 - 0.006))).objects
    assert stand.verdict == "jumps"
    assert stand.into == pytest.approx({"the table": 0.006}, abs=1e-5)
    assert "6.0 mm inside the table" in stand.sentence


def test_an_object_in_the_air_floats_and_the_gap_is_named():
    (stand,) = run(school_scene(place(0, 0, SIDE / 2 + 0.008))).objects
    assert stand.verdict == "floats" and stand.gap_m == pytest.approx(0.008, abs=1e-5)
    assert stand.moved_m == pytest.approx(0.008, abs=2e-4)


def test_objects_inside_one_another_are_named_in_pairs():
    beside = place(SIDE - 0.01, 0.002, SIDE / 2 + 1e-4, 1)
    report = run(school_scene(place(0, 0, SIDE / 2), beside, place(0.3, 0, SIDE / 2, 2)))
    assert verdicts(report) == ["inside another", "inside another", "stands"]
    ((a, b, depth),) = report.inside
    assert {a, b} == {"cube1 #0", "cube1 #1"} and depth == pytest.approx(0.01, abs=1e-4)


def test_every_parameter_is_read_back_and_a_lost_one_is_an_error(monkeypatch):
    scene = school_scene(place(0, 0, SIDE / 2))
    monkeypatch.setattr(table_world, "FRICTION", 0.6)
    with TableWorld(scene) as world:
        settings = world.settings()
    assert settings["contact_friction"] == pytest.approx(0.6)
    assert settings["iterations"] == 300
    assert settings["collision_margin_m"] == pytest.approx(0.0005)
    whole = BulletClient.__getattr__

    def forgetful(self, name):
        found = whole(self, name)
        if name != "changeDynamics":
            return found
        return lambda body, link, **given: found(
            body, link, **{k: v for k, v in given.items() if k != "lateralFriction"}
        )

    monkeypatch.setattr(BulletClient, "__getattr__", forgetful)
    refused("lateralFriction", TableWorld, scene, error=RealsimError)


def test_blown_up_parts_and_meshes_without_volume_are_named():
    scene = school_scene(place(0, 0, SIDE / 2))
    solid = scene.solids[1]
    fat = replace(solid, parts=replace(solid.parts, volume_ratio=1.4))
    (note,) = run(replace(scene, solids={1: fat})).notes
    assert "cube1" in note and "1.40" in note
    opened = Mesh(vertices=box(CUBE).vertices, faces=box(CUBE).faces[2:])
    lidless = replace(solid, matter=physical_properties(opened))
    (note,) = run(replace(scene, solids={1: lidless})).notes
    assert "cube1" in note and "no volume" in note
    sheet = Mesh(vertices=box(CUBE).vertices * [1, 1, 0], faces=box(CUBE).faces)
    refused(r"sheet.*flat", known_solids, {1: ObjectModel(obj_id=1, name="sheet", mesh=sheet)})


def test_bad_input_is_named(tmp_path):
    shelf = partial(Support, name="shelf", T_world_support=np.eye(4))
    refused("does not exist", shelf, urdf=tmp_path / "shelf.urdf")
    refused("neither a mesh nor", shelf)
    broken = tmp_path / "broken.urdf"
    broken.write_text("<robot name='x'><link")
    scene = school_scene(place(0, 0, SIDE / 2), supports=(shelf(urdf=broken),))
    refused(r"'shelf'.*broken\.urdf", TableWorld, scene)
    refused("mass is given for object 7", known_solids, {1: cube()}, Matter(masses_kg={7: 0.1}))
    scene = Scene(name="bare", objects=(place(0, 0, 0),))
    refused("no supporting plane", SchoolScene, scene=scene, models={1: cube()}, solids={})


def test_an_object_stands_on_a_support_from_a_urdf(tmp_path):
    urdf = tmp_path / "stand.urdf"
    urdf.write_text(
        "<robot name='stand'><link name='base'><collision><origin xyz='0 0 0.05'/><geometry>"
        "<box size='0.2 0.2 0.1'/></geometry></collision></link></robot>"
    )
    support = Support(name="stand", T_world_support=se3.from_translation([1, 0, 0]), urdf=urdf)
    scene = school_scene(
        place(1, 0, 0.1 + SIDE / 2), place(0, 0, 0.1 + SIDE / 2, 1), supports=(support,)
    )
    on_it, beside = run(scene).objects
    assert on_it.verdict == "stands" and on_it.moved_m < 1e-4
    assert beside.verdict == "floats" and beside.moved_m == pytest.approx(0.1, abs=1e-3)


def test_rows_and_picture_say_what_happened():
    scene = school_scene(place(0, 0, SIDE / 2), place(0.2, 0, SIDE / 2 + 0.02, 1))
    report = run(scene)
    rows = stand_rows(report)
    assert all(len(row) == len(HEADERS) for row in rows)
    assert rows[0][1] == "stands" and rows[1][1] == "floats" and rows[1][2] == "20.0"
    png = stand_picture(scene, report)
    rgb = cv2.imdecode(np.frombuffer(png, np.uint8), cv2.IMREAD_COLOR)[..., ::-1].astype(int)
    teal = np.abs(rgb - [0x2A, 0x9D, 0x8F]).max(-1) < 12
    assert teal.sum() > 200  # the floating one's outline and arrow
    assert png == stand_picture(scene, report)


# --- Scenes of other programs: recognised by content, with everything physics needs.

BLOCKS = ((7, -0.1, 0.0, 0.0), (7, 0.12, 0.0, 0.0))
SIZE = bop_scenes.SIZES_M[7]


def write_bop(root, count=1, with_poses=False):
    """Write a dataset of one scene: two alike blocks on a table; return its scene's folder."""
    K = np.array([[200.0, 0, 159.5], [0, 200.0, 119.5], [0, 0, 1]])
    with patch.multiple(bop_scenes, WIDTH=320, HEIGHT=240, K=K):
        return bop_scenes.write_boxes(
            root, count=count, with_poses=with_poses, things=BLOCKS, drift=0.0
        )


@pytest.mark.parametrize(("cameras", "with_poses"), [(3, True), (1, False)])
def test_a_bop_scene_stands_on_the_table_that_its_depth_shows(tmp_path, cameras, with_poses):
    write_bop(tmp_path, cameras, with_poses)
    scene = load_scene_source(tmp_path)
    assert [o.obj_id for o in scene.scene.objects] == [7, 7]
    assert list(scene.names().values()) == ["box7 #0", "box7 #1"]
    for o, x in zip(scene.scene.objects, (-0.1, 0.12), strict=True):
        T = scene.T_table_world @ o.T_world_obj
        assert T[2, 3] == pytest.approx(SIZE[2] / 2, abs=5e-4)
        if with_poses:
            assert np.allclose(o.T_world_obj, se3.from_translation([x, 0, SIZE[2] / 2]), atol=1e-6)
    with TableWorld(scene) as world:
        assert stable_state.stable_state(world).stable


def test_bop_scenes_that_lack_something_are_refused(tmp_path):
    folder = write_bop(tmp_path)
    refused("image 7", from_bop, tmp_path, image=7)
    refused("no scene 9", load_scene_source, tmp_path, scene_id=9)
    shutil.rmtree(folder / "depth")
    refused("no image with annotated objects and depth", from_bop, tmp_path)


def test_a_weighed_mass_reaches_the_engine(tmp_path):
    write_bop(tmp_path)
    scene = load_scene_source(tmp_path, Matter(masses_kg={7: 0.321}))
    assert scene.solids[7].matter.mass_kg == pytest.approx(0.321)
    with TableWorld(scene) as world:
        info = world._engine.getDynamicsInfo(world.bodies[0], -1)
    sides = np.array(SIZE) ** 2
    moments = 0.321 / 12 * np.array([sides[1] + sides[2], sides[0] + sides[2], sides[0] + sides[1]])
    assert info[0] == pytest.approx(0.321)
    assert np.allclose(sorted(info[2]), sorted(moments), rtol=1e-6)


def test_what_is_no_scene_is_named_with_what_was_found(tmp_path):
    (tmp_path / "photo.jpg").write_bytes(b"")
    refused(r"photo\.jpg.*scene\.yaml.*GraspNet.*BOP", load_scene_source, tmp_path)
    refused(r"file of the kind '\.jpg'", load_scene_source, tmp_path / "photo.jpg")
    refused("does not exist", load_scene_source, tmp_path / "gone")
