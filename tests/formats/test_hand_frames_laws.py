"""Every format of grasps gives back what was written, moves with the object, and means one hand."""

import json
from dataclasses import asdict, replace

import numpy as np
import pytest
from ruamel.yaml import YAML

from grasp_files import FORMATS, MOUNT, TIP
from realsim.formats.graspnet.grasp_group import grasp_group
from realsim.formats.grasps.acronym import AcronymObject, write_acronym
from realsim.formats.grasps.graspgen import write_graspgen
from realsim.formats.grasps.hand_frames import grasp_poses
from realsim.formats.grasps.isaac_grasp import write_isaac_grasp
from realsim.formats.grasps.scene_grasps import SceneGrasps, executed, labelled
from realsim.geometry import se3
from realsim.robots.hand import find_hand
from refusals import refused
from tried_grasps import tried_set


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
