"""ACRONYM files: the hand's frame, the label's name, and NVIDIA's own example."""

import os
from pathlib import Path

import h5py
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from grasp_files import read_acronym
from realsim.formats.grasps.acronym import AcronymObject, write_acronym
from realsim.formats.grasps.hand_frames import HAND_FRAMES, grasp_poses, hand_poses
from realsim.formats.grasps.hdf5 import COLUMNS
from realsim.formats.grasps.scene_grasps import executed, held
from realsim.geometry import se3
from realsim.geometry.mesh import sample_surface
from tried_grasps import tried_set

DATA = Path(os.environ.get("REALSIM_DATA", Path(__file__).parents[2] / "../shared/data"))
MUG = DATA / "school/acronym_mug"
needs_mug = pytest.mark.skipif(not MUG.is_dir(), reason=f"no ACRONYM example at {MUG}")
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
def test_tried_grasps_are_written_with_all_that_is_known(tmp_path_factory, seed):
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
@needs_mug
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
