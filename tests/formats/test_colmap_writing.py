"""COLMAP models that are written: pycolmap reads them as they are, and so does our own reader."""

from pathlib import Path

import cv2
import numpy as np
import pycolmap
import pytest

from realsim.errors import InputError
from realsim.formats.colmap.model import read_model
from realsim.formats.colmap.source import open_colmap
from realsim.formats.colmap.writing import camera_row, image_row, model_files, write_colmap
from realsim.formats.export_folder import ExportFolder
from realsim.formats.session_scene import open_session_scene
from realsim.geometry import se3
from realsim.records import CameraIntrinsics
from refusals import refused
from tests.support.synthetic_scenes import captured_session

LENSES = {
    "PINHOLE": [0.0] * 8,
    "OPENCV": [-0.1, 0.02, 0.001, -0.002, 0, 0, 0, 0],
    "FULL_OPENCV": [-0.1, 0.02, 0.001, -0.002, 0.01, 0.02, -0.03, 0.004],
}


@pytest.fixture(scope="module")
def store(tmp_path_factory):
    return captured_session(tmp_path_factory.mktemp("session") / "s", 3)


def written(store, folder: Path, points: int = 100_000):
    asked = ExportFolder.begin(folder, {"what": "colmap"})
    return write_colmap(open_session_scene(store), asked, points)


def camera(lens: str) -> CameraIntrinsics:
    return CameraIntrinsics(
        width=641, height=481, fx=600 + 1 / 3, fy=601 + 1 / 7, cx=320.1, cy=239.7,
        distortion=np.array(LENSES[lens]),
    )  # fmt: skip


def test_pycolmap_reads_every_bit(tmp_path):
    """Law: doubles come back as they were written."""
    rng = np.random.default_rng(0)
    cameras = [camera_row(k, camera(lens)) for k, lens in enumerate(LENSES, start=1)]
    assert [c.model for c in cameras] == list(LENSES)
    Ts = se3.random_transform(rng, 9)
    images = [image_row(10 + k, 1 + k % 3, T, f"a/{k}_b.png") for k, T in enumerate(Ts)]
    points, colours = rng.normal(size=(50, 3)), rng.integers(0, 256, (50, 3), dtype=np.uint8)
    for name, data in model_files(cameras, images, points, colours).items():
        (tmp_path / name).write_bytes(data)
    model = pycolmap.Reconstruction(str(tmp_path))
    for row in cameras:
        theirs = model.cameras[row.camera_id]
        assert (theirs.model_name, theirs.width, theirs.height) == (row.model, 641, 481)
        assert tuple(theirs.params) == row.params
    for row, T in zip(images, Ts, strict=True):
        theirs = model.images[row.image_id]
        pose = theirs.cam_from_world()
        assert (theirs.name, theirs.camera_id, theirs.has_pose) == (row.name, row.camera_id, True)
        assert (*np.roll(pose.rotation.quat, 1), *pose.translation) == row.pose
        np.testing.assert_allclose(pose.matrix(), T[:3], atol=1e-14)
    found = [model.points3D[k] for k in sorted(model.points3D)]
    assert np.array_equal([p.xyz for p in found], points)
    assert np.array_equal([p.color for p in found], colours)
    ours = read_model(tmp_path)
    np.testing.assert_allclose([i.T_world_cam for i in ours.images], se3.invert(Ts), atol=1e-14)
    again = {k: camera_row(k, c) for k, c in ours.cameras.items()}
    assert [again[k] for k in (1, 2, 3)] == cameras


def test_a_session_comes_back(store, tmp_path):
    said = written(store, tmp_path / "out")
    views = store.session.views
    assert said.frames == said.frames_written == len(views) and said.counts["cameras"] == 1
    source = open_colmap(tmp_path / "out", metres_per_unit=1.0)
    ours = store.session.intrinsics
    assert np.array_equal(source.intrinsics.distortion, ours.distortion)
    np.testing.assert_allclose(source.intrinsics.K, ours.K, rtol=1e-15)
    for view, frame in zip(views, source.frames(), strict=True):
        assert frame.name == f"{view.index:06d}.png"
        np.testing.assert_allclose(frame.T_world_cam, view.T_world_cam, atol=1e-14)
        assert np.array_equal(frame.rgb, store.rgb(view.index))


def test_points_lie_on_the_scene_with_its_colours(store, tmp_path):
    said = written(store, tmp_path / "out", points=500)
    model = pycolmap.Reconstruction(str(tmp_path / "out/sparse/0"))
    xyz = np.array([p.xyz for p in model.points3D.values()])
    assert len(xyz) == said.counts["points"] and 100 < len(xyz) <= 500
    heights = xyz[:, 2] - 0.1  # the table's top is at z = 0.1 m, the tall box is 0.12 m high
    assert heights.min() > -0.04 and heights.max() < 0.14
    assert np.median(np.abs(heights)) < 0.01
    assert len({tuple(p.color) for p in model.points3D.values()}) > 20
    none = written(store, tmp_path / "none", points=0)
    assert none.counts["points"] == 0
    assert len(pycolmap.Reconstruction(str(tmp_path / "none/sparse/0")).points3D) == 0


def test_what_cannot_be_written_is_said(store, tmp_path):
    refused("-1 points", written, store, tmp_path / "few", points=-1)

    class Poseless:
        def __init__(self, scene):
            self.scene = scene

        def __getattr__(self, name):
            return getattr(self.scene, name)

        def frame(self, index):
            import dataclasses

            return dataclasses.replace(self.scene.frame(index), T_world_cam=None)

    with pytest.raises(InputError, match="none of the 3 images has a camera pose"):
        folder = ExportFolder.begin(tmp_path / "x", {})
        write_colmap(Poseless(open_session_scene(store)), folder)


def text_model(folder: Path, **changed: str) -> Path:
    files = {
        "cameras": "7 PINHOLE 40 30 35 36 20.5 15.25\n",
        "images": "# Number of images: 1\n3 0.5 0.5 -0.5 0.5 0.1 -0.2 0.7 7 a.png\n\n",
        "points3D": "1 0 0 1 9 9 9 -1\n",
    } | changed
    folder.mkdir(exist_ok=True)
    for name, text in files.items():
        (folder / f"{name}.txt").write_text(text)
    cv2.imwrite(str(folder / "a.png"), np.zeros((30, 40, 3), np.uint8))
    return folder


@pytest.mark.parametrize(
    ("file", "text", "said"),
    [
        ("images", "3 0.5 0.5 -0.5 0.4 0.1 -0.2 0.7 7 a.png\n\n", "length 0.95"),
        ("images", "# Number of images: 2\n3 0.5 0.5 -0.5 0.5 0 0 0 7 a.png\n\n", "announces 2"),
        ("images", "3 0.5 0.5 -0.5 0.5 0.1 -0.2 0.7 7 a b.png\n\n", "space"),
        ("cameras", "7 PINHOLE 40 30 0.9 0.9 0.5 0.5\n", "focal length fx is 0.9"),
        ("cameras", "7 OPENCV_FISHEYE 40 30 35 36 20.5 15 0 0 0 0\n", "OPENCV_FISHEYE"),
        ("cameras", "7 NONE 40 30 35 36 20.5\n", "no camera"),
    ],
)
def test_a_text_that_cannot_be_is_refused(tmp_path, file, text, said):
    assert len(open_colmap(text_model(tmp_path / "fine"))) == 1
    refused(said, open_colmap, text_model(tmp_path / "wrong", **{file: text}))


@pytest.mark.parametrize(
    ("pose", "said"),
    [((0.5, 0, 0, 0, 0, 0, 0), r"image 1 of images.bin.*length 0\.5"),
     ((1, 0, 0, 0, np.nan, 0, 0), r"pose of a\.png.* NaN")],
)  # fmt: skip
def test_a_binary_pose_that_is_none_is_refused(tmp_path, pose, said):
    row = image_row(1, 1, np.eye(4), "a.png")
    bad = type(row)(image_id=1, camera_id=1, pose=pose, name="a.png")
    none = np.zeros((0, 3))
    for name, data in model_files([camera_row(1, camera("PINHOLE"))], [bad], none, none).items():
        (tmp_path / name).write_bytes(data)
    refused(said, read_model, tmp_path)
