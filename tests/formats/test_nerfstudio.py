"""transforms.json: what is written has nerfstudio's rays and comes back; wrong files are found.

nerfstudio itself is not needed: its rays are recomputed here by the formulas of its documentation.
"""

import json
import math
from pathlib import Path

import cv2
import numpy as np
import pytest

from bop_scenes import edit
from realsim.formats.export_folder import ExportFolder
from realsim.formats.nerfstudio.source import open_nerfstudio
from realsim.formats.nerfstudio.writing import NerfstudioWriteConfig, write_nerfstudio
from realsim.formats.session_scene import open_session_scene
from realsim.geometry import se3
from realsim.geometry.camera import project
from refusals import refused
from tests.support.synthetic_scenes import DEPTH_UNIT_M, captured_session

GL = np.diag([1.0, -1, -1, 1])


@pytest.fixture(scope="module")
def store(tmp_path_factory):
    return captured_session(tmp_path_factory.mktemp("session") / "s", 4)


@pytest.fixture
def data(store, tmp_path):
    """Return a written data set, and a function that changes its file."""
    write(store, tmp_path / "data", depth_unit_m=None)
    path = tmp_path / "data/transforms.json"

    def change(f):
        edit(path, f)
        return path.parent

    return change


def write(store, folder: Path, **config):
    asked = ExportFolder.begin(folder, {"what": "nerfstudio"})
    config = NerfstudioWriteConfig(**{"points": 2000} | config)
    return write_nerfstudio(open_session_scene(store), asked, config)


def moved(change):
    """Return a change of every frame's pose in a file."""

    def of_file(top):
        for frame in top["frames"]:
            frame["transform_matrix"] = change(np.array(frame["transform_matrix"])).tolist()

    return of_file


def grown(T, factor):
    return se3.from_rt(T[:3, :3], factor * T[:3, 3])


def counts_of(store, index):
    return cv2.imread(str(store.folder / f"depth/{index:06d}.png"), cv2.IMREAD_UNCHANGED)


def test_a_session_comes_back_to_the_last_bit(store, tmp_path):
    said = write(store, tmp_path / "out", depth_unit_m=None)
    assert said.frames == said.frames_written == 4 and 0 < said.counts["points"] <= 2000
    assert any("--depth-unit-scale-factor 0.0001" in n for n in said.notes)
    source = open_nerfstudio(tmp_path / "out")
    ours = store.session.intrinsics
    np.testing.assert_allclose(source.intrinsics.K, ours.K, rtol=1e-15)
    assert np.array_equal(source.intrinsics.distortion, ours.distortion)
    assert source.depth_unit_m == DEPTH_UNIT_M
    for view, frame in zip(store.session.views, source.frames(), strict=True):
        np.testing.assert_allclose(frame.T_world_cam, view.T_world_cam, atol=1e-15)
        assert np.array_equal(frame.rgb, store.rgb(view.index))
        assert np.array_equal(frame.depth_counts, counts_of(store, view.index))
    assert any(n.startswith("checked: camera poses") for n in source.notes)
    assert any("scale checked" in n for n in source.notes)


def test_nerfstudios_rays_meet_our_points(store, tmp_path):
    """Its formulas: pixel (u, v) is at (u + 0.5 - cx) / fl_x, up is +y, forward is -z."""
    write(store, tmp_path / "out")
    top = json.loads((tmp_path / "out/transforms.json").read_text())
    world = np.random.default_rng(0).uniform([0.4, -0.1, 0.1], [0.6, 0.1, 0.2], (40, 3))
    for view, entry in zip(store.session.views, top["frames"], strict=True):
        c2w = np.array(entry["transform_matrix"])
        p = (world - c2w[:3, 3]) @ c2w[:3, :3]
        x, y = p[:, 0] / -p[:, 2], -p[:, 1] / -p[:, 2]
        r = x * x + y * y
        d = 1 + r * (top["k1"] + r * (top["k2"] + r * top["k3"]))
        xd = x * d + 2 * top["p1"] * x * y + top["p2"] * (r + 2 * x * x)
        yd = y * d + 2 * top["p2"] * x * y + top["p1"] * (r + 2 * y * y)
        theirs = np.stack([xd * top["fl_x"] + top["cx"], yd * top["fl_y"] + top["cy"]], -1) - 0.5
        ours = project(store.session.intrinsics, se3.transform(se3.invert(view.T_world_cam), world))
        np.testing.assert_allclose(theirs, ours, atol=1e-9)


def test_depth_is_in_millimetres_unless_asked_otherwise(store, tmp_path):
    said = write(store, tmp_path / "out")
    top = json.loads((tmp_path / "out/transforms.json").read_text())
    assert top["depth_unit_scale_factor"] == 0.001 and top["camera_model"] == "OPENCV"
    counts = cv2.imread(str(tmp_path / "out" / top["frames"][0]["depth_file_path"]), -1)
    exact = counts_of(store, 0) * (DEPTH_UNIT_M / 0.001)
    assert counts.dtype == np.uint16 and np.abs(counts - exact).max() <= 0.5 + 1e-6
    assert any("rounded" in n for n in said.notes)


# --- reading ----------------------------------------------------------------------------------


def test_what_was_applied_to_the_world_is_undone(store, data):
    """Law: p_file = s (A p); the poses come back as they were, however A and s are."""
    A = se3.random_transform(np.random.default_rng(3))

    def apply(top):
        moved(lambda T: grown(A @ T, 0.37))(top)
        top["applied_transform"], top["applied_scale"] = A[:3].tolist(), 0.37

    source = open_nerfstudio(data(apply), use_depth=False)
    for view, frame in zip(store.session.views, source.frames(), strict=True):
        np.testing.assert_allclose(frame.T_world_cam, view.T_world_cam, atol=1e-12)


@pytest.mark.parametrize(
    ("wrong", "said"),
    [
        (np.linalg.inv, "world to camera"),
        (lambda T: T @ GL, "OpenGL's camera axes"),
        (lambda T: np.linalg.inv(T @ GL), "not what they are said to be"),
    ],
)
def test_poses_of_another_convention_are_refused_with_the_evidence(data, wrong, said):
    assert "mm" in refused(said, open_nerfstudio, data(moved(wrong)))


def test_poses_in_another_unit_are_refused_unless_it_is_said(store, data):
    folder = data(moved(lambda T: grown(T, 0.25)))
    refused(r"--scale (3\.9|4)", open_nerfstudio, folder)
    told = open_nerfstudio(folder, metres_per_unit=4.0, use_depth=False)
    frame = next(iter(told.frames()))
    np.testing.assert_allclose(frame.T_world_cam, store.session.views[0].T_world_cam, atol=1e-12)
    source = open_nerfstudio(folder, use_depth=False)
    assert source.depth_unit_m is None and any("scale unknown" in n for n in source.notes)


def ngp(folder: Path, frames=None, **top):
    folder.mkdir(exist_ok=True)
    rows = []
    for k in range(3):
        cv2.imwrite(str(folder / f"r_{k}.png"), np.full((30, 40, 3), k, np.uint8))
        T = se3.look_at([0.4 + 0.1 * k, 0, 0.5], [0, 0, 0]) @ GL
        rows.append({"file_path": f"./r_{k}", "transform_matrix": T.tolist()})
    top = {"frames": rows if frames is None else frames(rows)} | top
    (folder / "transforms.json").write_text(json.dumps(top))
    return folder


def test_instant_ngp_and_nerf_by_hand(tmp_path):
    """Known answer: f = w / (2 tan(angle / 2)), the centre is the middle of the image."""
    angle = 2 * math.atan(0.5)
    folder = ngp(tmp_path / "n", camera_angle_x=angle, aabb_scale=4, scale=0.33, offset=[0, 0, 0])
    source = open_nerfstudio(folder, metres_per_unit=2.0)
    K = source.intrinsics
    assert (K.fx, K.fy) == (pytest.approx(40), pytest.approx(40))
    assert (K.cx, K.cy) == (19.5, 14.5)
    frames = list(source.frames())
    assert [f.name for f in frames] == ["./r_0", "./r_1", "./r_2"]
    np.testing.assert_allclose(frames[0].T_world_cam[:3, 3], [0.8, 0, 1.0], atol=1e-12)
    assert any("aabb_scale, scale, offset" in n for n in source.notes)
    degrees = open_nerfstudio(ngp(tmp_path / "d", x_fov=math.degrees(angle)))
    assert degrees.intrinsics.fx == pytest.approx(40)


STRETCHED = np.diag([1.01, 1, 1, 1]).tolist()


@pytest.mark.parametrize(
    ("top", "said"),
    [
        ({}, "no focal length"),
        ({"fl_x": 40, "camera_model": "OPENCV_FISHEYE"}, "OPENCV_FISHEYE"),
        ({"fl_x": 40, "k4": 0.01}, "r\\^8"),
        ({"fl_x": 40, "from_na": True}, "from_na"),
        ({"fl_x": 40, "w": 80, "h": 60}, "80x60"),
        ({"fl_x": 40, "camera_angle_x": 0.2}, "Remove the wrong one"),
        ({"fl_x": 40, "applied_transform": [[2, 0, 0, 0], [0, 2, 0, 0], [0, 0, 2, 0]]}, "rigid"),
    ],
)
def test_a_file_that_cannot_be_is_refused(tmp_path, top, said):
    refused(said, open_nerfstudio, ngp(tmp_path / "x", **top))


@pytest.mark.parametrize(
    ("frames", "said"),
    [
        (lambda rows: [rows[0], rows[1] | {"transform_matrix": STRETCHED}], "not rigid"),
        (lambda rows: [rows[0], rows[1] | {"file_path": "../r_1.png"}], "leads out"),
        (lambda rows: [3], "frame 1"),
        (lambda rows: [*rows, rows[0]], "two frames of the image"),
        (lambda rows: [r | {"fl_x": 41.0 + k} for k, r in enumerate(rows)], "takes the first"),
        (lambda rows: [r | {"file_path": f"x{k}"} for k, r in enumerate(rows)], "--images"),
    ],
)
def test_frames_that_cannot_be_are_refused(tmp_path, frames, said):
    refused(said, open_nerfstudio, ngp(tmp_path / "x", frames, fl_x=40))


@pytest.mark.parametrize("images", [None, "."])
def test_a_name_that_no_file_has_is_refused(tmp_path, images):
    folder = ngp(tmp_path / "x", lambda rows: [r | {"file_path": "9" * 252} for r in rows], fl_x=40)
    refused("no file has such a name", open_nerfstudio, folder, images_folder=images)


def test_images_found_by_their_base_names_belong_to_one_pose_each(tmp_path):
    def alike(rows):
        return [r | {"file_path": f"cam{k}/r_1"} for k, r in enumerate(rows)]

    folder = ngp(tmp_path / "x", alike, fl_x=40)
    refused("two frames of the image .*r_1", open_nerfstudio, folder, images_folder=folder)


def test_an_image_that_is_not_there_is_named(tmp_path):
    folder = ngp(tmp_path / "x", fl_x=40)
    (folder / "r_1.png").unlink()
    source = open_nerfstudio(folder)
    assert len(source) == 2 and any("r_1" in n for n in source.notes)
    refused(r"holds no transforms\.json", open_nerfstudio, tmp_path)
