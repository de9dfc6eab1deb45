"""COLMAP models: what pycolmap writes is read as what it was, and agrees with the text by hand."""

from pathlib import Path

import cv2
import numpy as np
import pycolmap
import pytest
from scipy.spatial.transform import Rotation

from realsim.formats.colmap.model import PARAMETERS, find_model, read_model
from realsim.formats.colmap.source import open_colmap
from realsim.geometry import se3
from realsim.interop import rigid3d_from_T
from refusals import refused

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


def make(folder: Path, Ts, cameras=("OPENCV",), *, text: bool = False, place="sparse/0") -> Path:
    """Write a project: image k has the camera k modulo their number."""
    model = pycolmap.Reconstruction()
    for c, name in enumerate(cameras, start=1):
        params = PARAMS[name]
        camera = pycolmap.Camera(
            camera_id=c, model=name, width=SIZE[0], height=SIZE[1], params=params
        )
        model.add_camera_with_trivial_rig(camera)
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
    theirs = pycolmap.Camera(
        camera_id=1, model=name, width=SIZE[0], height=SIZE[1], params=PARAMS[name]
    )
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


def test_the_text_by_hand(tmp_path):
    """Known answer: a model written by hand, after COLMAP's own description of its text files."""
    q, t = [0.5, 0.5, -0.5, 0.5], [0.1, -0.2, 0.7]  # w x y z: a turn by 120 degrees
    model = tmp_path / "sparse"
    model.mkdir()
    (model / "cameras.txt").write_text("# Camera list\n7 PINHOLE 40 30 35 36 20.5 15.25\n")
    (model / "images.txt").write_text(
        f"# Image list\n3 {' '.join(map(str, q))} {' '.join(map(str, t))} 7 a.png\n\n"
    )
    (model / "points3D.txt").write_text("# 3D point list\n")
    (tmp_path / "images").mkdir()
    cv2.imwrite(str(tmp_path / "images/a.png"), rgb_of(0)[..., ::-1])
    source = open_colmap(tmp_path, metres_per_unit=2.0)
    R = Rotation.from_quat([*q[1:], q[0]]).as_matrix()
    T = next(source.frames()).T_world_cam
    np.testing.assert_allclose(T[:3, :3], R.T, atol=1e-12)
    np.testing.assert_allclose(T[:3, 3], 2.0 * (-R.T @ t), atol=1e-12)
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
