"""COLMAP models: what pycolmap writes is read as what it was, and agrees with the text by hand."""

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pycolmap
import pytest
from scipy.spatial.transform import Rotation

from labelled_scenes import ChangedScene
from realsim.formats.colmap.model import PARAMETERS, find_model, read_model
from realsim.formats.colmap.source import open_colmap
from realsim.formats.colmap.writing import camera_row, image_row, model_files, write_colmap
from realsim.formats.export_folder import ExportFolder
from realsim.formats.session_scene import open_session_scene
from realsim.geometry import se3
from realsim.interop import rigid3d_from_T
from realsim.records import CameraIntrinsics
from refusals import refused
from tests.support.synthetic_scenes import captured_session

SIZE = (40, 30)
PARAMS = {
    "SIMPLE_PINHOLE": [35.0, 20.5, 15.25],
    "PINHOLE": [35.0, 36.0, 20.5, 15.25],
    "SIMPLE_RADIAL": [35.0, 20.5, 15.25, 0.1],
    "RADIAL": [35.0, 20.5, 15.25, 0.1, -0.02],
    "OPENCV": [35.0, 36.0, 20.5, 15.25, 0.1, -0.02, 0.003, 0.004],
    "SIMPLE_RADIAL_FISHEYE": [35.0, 20.5, 15.25, 0.1],
    "FULL_OPENCV": [35.0, 36.0, 20.5, 15.25, 0.1, -0.02, 0.003, 0.004, 0.01, 0.02, 0.03, 0.04],
}


def poses(n: int) -> np.ndarray:
    rng = np.random.default_rng(1)
    return np.stack([se3.look_at(rng.uniform(0.2, 0.5, 3), [0, 0, 0]) for _ in range(n)])


def rgb_of(k: int) -> np.ndarray:
    return np.random.default_rng(k).integers(0, 256, (SIZE[1], SIZE[0], 3), dtype=np.uint8)


def pycolmap_camera(number: int, model: str) -> pycolmap.Camera:
    width, height = SIZE
    return pycolmap.Camera(
        camera_id=number, model=model, width=width, height=height, params=PARAMS[model]
    )


def make(folder: Path, Ts, cameras=("OPENCV",), *, text: bool = False, place="sparse/0") -> Path:
    """Write a project: image k has the camera k modulo their number."""
    model = pycolmap.Reconstruction()
    for c, name in enumerate(cameras, start=1):
        model.add_camera_with_trivial_rig(pycolmap_camera(c, name))
    for k, T in enumerate(Ts):
        name = f"shot_{k + 8}.png"  # natural order: 8, 9, 10
        image = pycolmap.Image(image_id=len(Ts) - k, camera_id=1 + k % len(cameras), name=name)
        model.add_image_with_trivial_frame(image, rigid3d_from_T(se3.invert(T)))
        (folder / "images").mkdir(parents=True, exist_ok=True)
        assert cv2.imwrite(str(folder / "images" / name), rgb_of(k)[..., ::-1])
    (folder / place).mkdir(parents=True, exist_ok=True)
    (model.write_text if text else model.write_binary)(str(folder / place))
    return folder


@pytest.mark.parametrize("text", [False, True])
@pytest.mark.parametrize("name", sorted(PARAMETERS))
def test_every_camera_model_keeps_its_rays(tmp_path, name, text):
    """Law: our camera projects to COLMAP's pixel less half a pixel, for each model."""
    make(tmp_path, poses(3), (name,), text=text)
    camera = read_model(tmp_path / "sparse/0").cameras[1]
    theirs = pycolmap_camera(1, name)
    points = np.random.default_rng(0).uniform([-0.3, -0.3, 0.9], [0.3, 0.3, 1.5], (50, 3))
    ours, _ = cv2.projectPoints(points, np.zeros(3), np.zeros(3), camera.K, camera.distortion)
    expected = np.array([theirs.img_from_cam(p) for p in points])
    np.testing.assert_allclose(ours[:, 0] + 0.5, expected, atol=1e-9)


@pytest.mark.parametrize("text", [False, True])
def test_poses_and_images_come_back(tmp_path, text):
    Ts = poses(5)
    source = open_colmap(make(tmp_path, Ts, text=text))
    frames = list(source.frames())
    assert [f.name for f in frames] == [f"shot_{k}.png" for k in range(8, 13)]
    for k, frame in enumerate(frames):
        np.testing.assert_allclose(frame.T_world_cam, Ts[k], atol=1e-9)
        assert np.array_equal(frame.rgb, rgb_of(k))
    assert source.depth_unit_m is None and any("scale unknown" in n for n in source.notes)


def text_model(folder: Path, **changed: str) -> Path:
    """Write a model by hand, after COLMAP's own description of its text files."""
    files = {
        "cameras": "# Camera list\n7 PINHOLE 40 30 35 36 20.5 15.25\n",
        "images": "# Number of images: 1\n3 0.5 0.5 -0.5 0.5 0.1 -0.2 0.7 7 a.png\n\n",
        "points3D": "1 0 0 1 9 9 9 -1\n",
    } | changed
    folder.mkdir(exist_ok=True)
    for name, text in files.items():
        (folder / f"{name}.txt").write_text(text)
    cv2.imwrite(str(folder / "a.png"), np.zeros((30, 40, 3), np.uint8))
    return folder


def test_the_text_by_hand(tmp_path):
    """Known answer: a model written by hand is read as what it says, in metres."""
    source = open_colmap(text_model(tmp_path), metres_per_unit=2.0)
    # w x y z of the file are 0.5, 0.5, -0.5, 0.5: a turn by 120 degrees.
    R = Rotation.from_quat([0.5, -0.5, 0.5, 0.5]).as_matrix()
    T = next(source.frames()).T_world_cam
    np.testing.assert_allclose(T[:3, :3], R.T, atol=1e-12)
    np.testing.assert_allclose(T[:3, 3], 2.0 * (-R.T @ [0.1, -0.2, 0.7]), atol=1e-12)
    assert (source.intrinsics.cx, source.intrinsics.cy) == (20.0, 14.75)
    assert not any("scale unknown" in n for n in source.notes)


def test_several_cameras_are_named_and_chosen(tmp_path):
    make(tmp_path, poses(5), ("OPENCV", "PINHOLE"))
    refused(r"2 different cameras: 1 \(3 images.*--camera-id", open_colmap, tmp_path)
    source = open_colmap(tmp_path, camera_id=2)
    assert [f.name for f in source.frames()] == ["shot_9.png", "shot_11.png"]
    assert any("3 images of other cameras" in n for n in source.notes)
    refused("no camera 5", open_colmap, tmp_path, camera_id=5)


def test_a_lens_without_a_place_is_refused(tmp_path):
    make(tmp_path, poses(2), ("SIMPLE_RADIAL_FISHEYE",))
    refused(r"SIMPLE_RADIAL_FISHEYE.*image_undistorter", open_colmap, tmp_path)


def test_damage_is_named(tmp_path):
    make(tmp_path, poses(3))
    (tmp_path / "images/shot_9.png").unlink()
    source = open_colmap(tmp_path)
    assert len(source) == 2 and any("shot_9.png" in n for n in source.notes)
    refused(r"none of the 3 images", open_colmap, tmp_path, images_folder=tmp_path / "elsewhere")
    refused("positive", open_colmap, tmp_path, metres_per_unit=0.0)
    make(tmp_path, poses(2), place="sparse/1")
    refused(r"2 models \(0, 1\)", find_model, tmp_path)
    refused("no COLMAP model", open_colmap, tmp_path / "images")


# --- COLMAP models that are written: pycolmap reads them as they are, and so does our own reader.

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
    assert written(store, tmp_path / "none", points=0).counts["points"] == 0
    assert len(pycolmap.Reconstruction(str(tmp_path / "none/sparse/0")).points3D) == 0


def test_what_cannot_be_written_is_said(store, tmp_path):
    refused("-1 points", written, store, tmp_path / "few", points=-1)
    poseless = ChangedScene(open_session_scene(store), lambda f: replace(f, T_world_cam=None))
    folder = ExportFolder.begin(tmp_path / "x", {})
    refused("none of the 3 images has a camera pose", write_colmap, poseless, folder)


@pytest.mark.parametrize(
    ("file", "text", "said"),
    [
        ("images", "3 0.5 0.5 -0.5 0.4 0.1 -0.2 0.7 7 a.png\n\n", "length 0.95"),
        ("images", "# Number of images: 2\n3 0.5 0.5 -0.5 0.5 0 0 0 7 a.png\n\n", "announces 2"),
        ("images", "3 0.5 0.5 -0.5 0.5 0.1 -0.2 0.7 7 a b.png\n\n", "space"),
        ("images", f"3 0.5 0.5 -0.5 0.5 0 0 0 7 {'9' * 300}\n\n", "no file has such a name"),
        ("images", f"3 0.5 0.5 -0.5 0.5 0 0 0 7 {'9/' * 3000}\n\n", "no file has such a name"),
        ("images", "".join(f"{k} 1 0 0 0 0 0 {k} 7 a.png\n\n" for k in (3, 4)), "2 images named"),
        ("images", "3 0.5 0.5 -0.5 0.5 0 0 0 7 ../a.png\n\n", "leads out of the data set"),
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
