"""Formats of grasps have all that is known, and mean one hand, which moves with the object."""

import json
from dataclasses import asdict, replace

import h5py
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from ruamel.yaml import YAML

from grasp_files import FORMATS, MOUNT, TIP, IsaacGrasp, read_acronym
from real_data import DATA, needs
from realsim.formats.graspnet.grasp_group import grasp_group
from realsim.formats.grasps.acronym import AcronymObject, write_acronym
from realsim.formats.grasps.graspgen import write_graspgen
from realsim.formats.grasps.hand_frames import HAND_FRAMES, grasp_poses, hand_poses
from realsim.formats.grasps.hdf5 import COLUMNS
from realsim.formats.grasps.isaac_grasp import write_isaac_grasp
from realsim.formats.grasps.scene_grasps import (
    SceneGrasps,
    executed,
    held,
    labelled,
    measures_of_json,
)
from realsim.geometry import se3
from realsim.geometry.mesh import sample_surface
from realsim.records.grasps import MEASURES
from realsim.robots.hand import find_hand
from realsim.untrusted.own_json import array_from_json
from refusals import refused
from tried_grasps import tried_set

MUG = DATA / "school/acronym_mug"
OBJECT = AcronymObject(
    file="meshes/mug.obj", scale=0.001, density=150.0, friction=1.0, mass_kg=0.013,
    volume_m3=8.7e-5, center_of_mass=np.array([0.0, -0.002, 0.09]), inertia=np.eye(3) * 2e-5,
)  # fmt: skip


# --- frames -----------------------------------------------------------------------------------


@given(st.integers(0, 2**32 - 1), st.sampled_from(sorted(HAND_FRAMES)))
@settings(max_examples=10, deadline=None)
def test_to_a_hand_frame_and_back_is_the_same_grasp(seed, frame):
    Ts = se3.random_transform(np.random.default_rng(seed), 10)
    back = grasp_poses(hand_poses(Ts, frame), frame)
    np.testing.assert_array_equal(back[:, :3, :3], Ts[:, :3, :3])  # signed permutations
    np.testing.assert_allclose(back, Ts, rtol=0, atol=4e-16 * (1 + np.abs(Ts).max()))


def test_the_axes_of_acronyms_hand_are_known():
    """In a grasp at the origin the fingers close along y, 0.1034 m before the mounting face."""
    T = hand_poses(np.eye(4), "acronym")
    np.testing.assert_array_equal(T[:3, 0], [0, 1, 0])  # its closing axis x is our y
    np.testing.assert_array_equal(T[:3, 2], [0, 0, 1])  # the approach stays
    tip = T @ [0.041, 0.0, 0.1122, 1.0]  # ACRONYM's own marker of a fingertip
    np.testing.assert_allclose(tip[:3], [0.0, 0.041, 0.0088], atol=1e-12)
    T_acronym_panda = se3.invert(T) @ hand_poses(np.eye(4), "panda_hand")
    np.testing.assert_allclose(se3.log_so3(T_acronym_panda[:3, :3]), [0, 0, -np.pi / 2])
    np.testing.assert_allclose(T_acronym_panda[:3, 3], 0, atol=1e-15)  # one origin


# --- files ------------------------------------------------------------------------------------


@given(st.integers(0, 2**32 - 1))
@settings(max_examples=10, deadline=None)
def test_acronym_has_all_that_is_known_of_tried_grasps(tmp_path_factory, seed):
    s = tried_set(np.random.default_rng(seed), 30)
    path = write_acronym(tmp_path_factory.mktemp("a") / "mug.h5", s, OBJECT)
    rows = executed(s)
    with h5py.File(path) as file:
        obj, flex = file["object"], file["grasps/qualities/flex"]
        assert obj["file"][()].decode() == OBJECT.file and obj["scale"][()] == OBJECT.scale
        assert obj["mass"][()] == OBJECT.mass_kg and obj["volume"][()] == OBJECT.volume_m3
        assert obj["density"][()] == OBJECT.density and obj["friction"][()] == OBJECT.friction
        assert np.array_equal(obj["com"], OBJECT.center_of_mass)
        assert np.array_equal(obj["inertia"], OBJECT.inertia)
        assert np.array_equal(flex["object_in_gripper"][()] == 1, held(s)[rows])
        ours = file["grasps/qualities/realsim"]
        for name, (field, _, _) in COLUMNS.items():
            assert np.array_equal(ours[name], getattr(s, field)[rows], equal_nan=True)
    assert path.read_bytes() == write_acronym(path, s, OBJECT).read_bytes()


def test_our_physics_does_not_pass_for_flex(tmp_path):
    s = tried_set(np.random.default_rng(1), 40)
    with h5py.File(write_acronym(tmp_path / "mug.h5", s, OBJECT)) as file:
        flex = file["grasps/qualities/flex"]
        assert list(flex) == ["object_in_gripper"]  # no score, no motion of ours under that name
        assert "not FleX" in flex.attrs["simulator"]
        ours = file["grasps/qualities/realsim"]
        assert ours.attrs["left_out"] == len(s) - int(executed(s).sum()) > 0
        np.testing.assert_array_equal(s.scores[ours["row"][()]], ours["score"][()])


# --- NVIDIA's example -------------------------------------------------------------------------


def fingers_and_gap(Ts, points):
    """Return (N,) whether the open fingers are free of points, and whether some lie between."""
    x, y, depth = np.moveaxis(se3.transform(se3.invert(Ts), points), -1, 0)
    x, y = np.abs(x), np.abs(y)
    in_finger = (x < 0.008) & (y > 0.0405) & (y < 0.05) & (depth > -0.04) & (depth < 0.0088)
    between = (x < 0.008) & (y < 0.04) & (np.abs(depth) < 0.0088)
    return ~in_finger.any(axis=1), between.any(axis=1)


@pytest.mark.real
@needs(MUG)
def test_real_grasps_close_on_the_mug_and_only_in_the_right_frame():
    import trimesh

    from realsim.records import Mesh

    Ts, label, scale = read_acronym(next(MUG.glob("*.h5")))
    assert len(Ts) == 2000 and label.sum() == 1290
    loaded = trimesh.load(next(MUG.glob("*.obj")), force="mesh", process=False)
    mesh = Mesh(vertices=np.asarray(loaded.vertices) * scale, faces=loaded.faces)
    points = sample_surface(mesh, 1000, np.random.default_rng(0))[0]
    Ts = Ts[::10]
    free, between = fingers_and_gap(Ts, points)
    # Fingers that are open touch nothing, and the pads have something between them.
    assert free.all() and between.all()
    unturned, _ = fingers_and_gap(grasp_poses(hand_poses(Ts, "acronym"), "panda_hand"), points)
    assert unturned.mean() < 0.6  # without the quarter turn the fingers stand in the mug
    deeper, _ = fingers_and_gap(Ts @ se3.from_translation([0, 0, 0.02]), points)
    _, short = fingers_and_gap(Ts @ se3.from_translation([0, 0, -0.02]), points)
    assert deeper.mean() < 0.95 and short.mean() < 0.9  # and the shift is right to 2 cm


# --- GraspGen's JSON: its loader finds what it looks for, and the grasps come back.


@given(st.integers(0, 2**32 - 1), st.sampled_from(["acronym", "panda_hand", "grasp"]))
@settings(max_examples=10, deadline=None)
def test_graspgen_has_all_that_is_known_of_tried_grasps(tmp_path_factory, seed, frame):
    s = tried_set(np.random.default_rng(seed), 25)
    path = tmp_path_factory.mktemp("gg") / "mug.json"
    write_graspgen(path, s, file="mug.obj", scale=0.5, frame=frame)
    found, rows = json.loads(path.read_text()), executed(s)
    assert found["object"] == {"file": "mug.obj", "scale": 0.5}
    Ts = grasp_poses(found["grasps"]["transforms"], frame) if rows.any() else np.zeros((0, 4, 4))
    np.testing.assert_allclose(Ts, s.Ts_obj_grasp[rows], rtol=0, atol=1e-15)
    np.testing.assert_array_equal(found["grasps"]["object_in_gripper"], held(s)[rows])
    ours, n = found["realsim"], int(rows.sum())
    for name in ("scores", "base_scores", "widths_m"):
        np.testing.assert_array_equal(array_from_json(ours[name], (n,)), getattr(s, name)[rows])
    for name, values in measures_of_json(ours["measures"], n, "the file").items():
        np.testing.assert_array_equal(values, s.measures[name][rows])
    assert list(ours["measures"]) == list(s.measures)


def test_the_file_has_graspgens_keys_and_axes(tmp_path):
    s = tried_set(np.random.default_rng(2), 25)
    data = json.loads(write_graspgen(tmp_path / "a.json", s, file="mug.obj").read_text())
    assert data["object"] == {"file": "mug.obj", "scale": 1.0}
    T, mask = (np.asarray(data["grasps"][name]) for name in ("transforms", "object_in_gripper"))
    assert mask.dtype == bool and mask.shape == T.shape[:1]
    rows = executed(s)
    # approach +z, closing along x, from the hand's base
    np.testing.assert_array_equal(T[:, :3, 2], s.Ts_obj_grasp[rows, :3, 2])
    np.testing.assert_array_equal(T[:, :3, 0], s.Ts_obj_grasp[rows, :3, 1])
    np.testing.assert_array_equal(T, hand_poses(s.Ts_obj_grasp[rows], "acronym"))
    assert data["realsim"]["left_out"] == int((~rows).sum()) > 0


# --- isaac_grasp YAML: any YAML reader reads it, and finds everything.


@given(st.integers(0, 2**32 - 1))
@settings(max_examples=10, deadline=None)
def test_isaac_grasp_has_all_that_is_known_of_tried_grasps(tmp_path_factory, seed):
    rng = np.random.default_rng(seed)
    some = tuple(name for name in MEASURES if rng.random() < 0.7)
    s = tried_set(rng, 25, measures=some)
    path = tmp_path_factory.mktemp("ig") / "mug.yaml"
    found = YAML(typ="safe").load(write_isaac_grasp(path, s, object_frame="mug"))["grasps"]
    rows = labelled(s)
    assert list(found) == [f"grasp_{row}" for row in np.flatnonzero(rows)]
    assert [g["confidence"] for g in found.values()] == s.labels[rows].tolist()
    assert f"# confidence: {s.label}" in path.read_text()
    fingers = [g["cspace_position"]["panda_finger_joint1"] for g in found.values()]
    np.testing.assert_array_equal(2 * np.array(fingers), s.widths_m[rows])
    assert {g["pregrasp_cspace_position"]["panda_finger_joint1"] for g in found.values()} <= {0.04}
    ours = [g["realsim"] for g in found.values()]
    for name, values in (("score", s.scores), ("base_score", s.base_scores)):
        found = array_from_json([t[name] for t in ours], (len(ours),))
        np.testing.assert_array_equal(found, values[rows])
    columns = {name: [t[name] for t in ours] for name in some}
    for name, values in measures_of_json(columns, len(ours), "the file").items():
        np.testing.assert_array_equal(values, s.measures[name][rows])


def test_the_quaternion_is_scalar_first_and_turns_the_right_way(tmp_path):
    s = tried_set(np.random.default_rng(3), 25)
    path = write_isaac_grasp(tmp_path / "a.yaml", s, object_frame="a")
    data = YAML(typ="safe").load(path)
    assert data["format"] == "isaac_grasp" and data["format_version"] == 1.0
    assert data["gripper_frame_link"] == "panda_hand"
    assert list(data["grasps"]) == [f"grasp_{row}" for row in np.flatnonzero(labelled(s))]
    Rs = IsaacGrasp().raw(path)[:, :3, :3]
    np.testing.assert_allclose(Rs, s.Ts_obj_grasp[labelled(s), :3, :3], atol=1e-14)


def test_a_width_that_the_hand_cannot_take_is_refused(tmp_path):
    s = tried_set(np.random.default_rng(5), 40)
    for width in (0.09, np.nan):
        wide = replace(s, widths_m=np.full(40, width))
        refused("width", write_isaac_grasp, tmp_path / "a.yaml", wide, object_frame="a")
    assert list(tmp_path.iterdir()) == []


# --- Every format gives back what was written, moves with the object, and means one hand.


@pytest.fixture(params=FORMATS, ids=[f.__name__ for f in FORMATS])
def form(request):
    return request.param()


def tried(seed=0, n=25):
    """Return a set of which a part was tried; of those all have a score."""
    s = tried_set(np.random.default_rng(seed), n, measures=())
    return replace(s, scores=np.where(executed(s), np.nan_to_num(s.scores), np.nan))


def written(form, folder, s):
    """Write a set; return the file, and the poses that must be in it."""
    form.rows = executed(s)
    assert 0 < form.rows.sum() < len(s)
    return form.write(folder, s), s.Ts_obj_grasp[form.rows]


def test_what_is_written_is_read(form, tmp_path):
    path, Ts = written(form, tmp_path / "grasps", tried())
    np.testing.assert_allclose(form.read(path), Ts, rtol=0, atol=form.rounding)


def test_the_hand_in_the_file_moves_with_the_object(form, tmp_path):
    s, T = tried(1), se3.random_transform(np.random.default_rng(5))
    here, _ = written(form, tmp_path / "here", s)
    there, Ts = written(form, tmp_path / "there", replace(s, Ts_obj_grasp=T @ s.Ts_obj_grasp))
    atol = 2 * form.rounding + 1e-14
    np.testing.assert_allclose(form.raw(there), T @ form.raw(here), rtol=0, atol=atol)
    np.testing.assert_allclose(form.read(there), Ts, rtol=0, atol=atol)


def test_the_pose_in_the_file_is_that_of_a_rigid_hand(form, tmp_path):
    """One and the same motion leads from every grasp to the hand in the file: no mirror, no scale.

    Distances and angles between any two hands are then known, too.
    """
    path, Ts = written(form, tmp_path / "grasps", tried(2))
    offsets = np.linalg.inv(Ts) @ form.raw(path)
    np.testing.assert_allclose(offsets, np.tile(offsets[:1], (len(Ts), 1, 1)), atol=5e-6)
    np.testing.assert_allclose(np.linalg.det(offsets[:, :3, :3]), 1.0, atol=5e-6)


def test_a_hand_straight_down_has_its_fingertips_where_they_are_drawn(form, tmp_path):
    """The hand hangs over the point (0.1, 0.02, 0.05) and closes along the object's x."""
    R = np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])
    s, down = tried(3), se3.from_rt(R, [0.1, 0.02, 0.05])
    hanging = replace(s, Ts_obj_grasp=np.tile(down, (len(s), 1, 1)))
    path, Ts = written(form, tmp_path / "grasps", hanging)
    atol = form.rounding + 1e-12
    for T in form.raw(path):
        np.testing.assert_allclose(T[:3, form.approach], [0, 0, -1], atol=atol)
        np.testing.assert_allclose(T[:3, form.closing], [1, 0, 0], atol=atol)
        tip = T[:3, :3] @ form.tip + T[:3, 3]
        np.testing.assert_allclose(tip, [0.1, 0.02, 0.05 - (TIP - MOUNT)], atol=atol)
    assert len(form.raw(path)) == len(Ts)


def of_hand(name, seed=3):
    """Return tried grasps of a hand, as the School leaves them."""
    s, hand = tried_set(np.random.default_rng(seed), 25), find_hand(name)
    known = {"config": {"hand": asdict(hand)}}
    if hand.arc_radius_m:
        known["pad_heights_m"] = hand.z_pad(s.widths_m).tolist()
    return replace(s, parameters=json.loads(json.dumps(known)))


def test_another_hand_s_frame_and_joint_are_its_description_s(tmp_path):
    """The flange of the 2F-85, and its joint, which closes from 85.4 mm on by 0.81 rad."""
    s, hand = of_hand("robotiq_2f85"), find_hand("robotiq_2f85")
    tried = executed(s)
    data = json.loads(write_graspgen(tmp_path / "a.json", s, file="a.obj").read_text())
    T, grasps = np.array(data["grasps"]["transforms"]), s.Ts_obj_grasp[tried]
    np.testing.assert_allclose(T[:, :3, 3], grasps[:, :3, 3] - 0.155046 * grasps[:, :3, 2])
    np.testing.assert_allclose(grasp_poses(T, "acronym", hand), grasps, rtol=0, atol=1e-15)

    data = YAML(typ="safe").load(write_isaac_grasp(tmp_path / "a.yaml", s, object_frame="a"))
    assert data["gripper_frame_link"] == "robotiq_2f85"
    for row in np.flatnonzero(labelled(s)):
        joint = data["grasps"][f"grasp_{row}"]["cspace_position"]["finger_joint"]
        # The URDF's chain: where the pad is when its joint is there.
        y = 0.0306011 + 0.0376009 * np.cos(joint) - 0.0430400 * np.sin(joint) - 0.0255
        assert 2 * y == pytest.approx(s.widths_m[row], abs=2e-5)
    Ts = grasp_group([s], {s.instance: np.eye(4)}).Ts_a_grasp
    scored = ~np.isnan(s.labels)
    np.testing.assert_array_equal(Ts, s.Ts_obj_pads[scored])
    moved = np.linalg.norm((s.Ts_obj_pads - s.Ts_obj_grasp)[:, :3, 3], axis=1)
    np.testing.assert_allclose(moved, np.abs(hand.z_pad(s.widths_m)), atol=1e-12)


def test_what_is_the_panda_s_alone_and_two_hands_at_once_are_refused(tmp_path):
    panda, robotiq, four = of_hand("franka_hand"), of_hand("robotiq_2f85"), of_hand("parallel")
    words, file = r"'robotiq_2f85'; an ACRONYM file.*--to graspgen", tmp_path / "a"
    refused(words, write_acronym, file, robotiq, AcronymObject(file="a.obj"))
    refused(r"'parallel' does not say.*joint = ", write_isaac_grasp, file, four, object_frame="a")
    nameless = tried_set(np.random.default_rng(3), 25)
    assert nameless.hand[0] == panda.hand[0] == "franka_hand"

    def beside_panda(s):
        return SceneGrasps(sets=(panda, replace(s, instance=panda.instance + 1)))

    beside_panda(nameless)
    refused(r"franka_hand .*and robotiq_2f85", beside_panda, robotiq)
    other = json.loads(json.dumps(panda.parameters))
    other["config"]["hand"]["digest"] = "0" * 64
    unlike = replace(panda, parameters=other)
    refused(r"franka_hand \(.{8}\) and franka_hand \(00000000\)", beside_panda, unlike)
