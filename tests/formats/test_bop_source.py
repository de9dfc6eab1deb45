"""BOP scenes as frame sources: cameras, counts and poses exactly as the scene has them."""

from pathlib import Path

import numpy as np

from begun_sessions import begun, random_views
from bop_scenes import edit
from realsim.formats.bop.source import open_bop
from realsim.records import CameraIntrinsics
from realsim.store import SessionStore
from refusals import refused

CAMERA = CameraIntrinsics(
    width=64, height=48, fx=60.1, fy=60.2, cx=31.3, cy=24.7, distortion=np.array([0.1, -0.01])
)


def make_scene(folder: Path, n: int = 4) -> SessionStore:
    store = begun(folder, CAMERA)
    random_views(store, range(0, 3 * n, 3))
    return store


def test_a_scene_comes_back(tmp_path):
    """Law: cameras to 1e-9, pixels and counts exactly, in the order of the images' numbers."""
    store = make_scene(tmp_path / "000007")
    source = open_bop(tmp_path / "000007")
    frames = list(source.frames())
    assert [f.time_s for f in frames] == [0, 3, 6, 9] and source.depth_unit_m == 1e-4
    np.testing.assert_allclose(source.intrinsics.K, CAMERA.K, atol=1e-9)
    np.testing.assert_allclose(source.intrinsics.distortion, CAMERA.distortion, atol=1e-9)
    for frame, view in zip(frames, store.session.views, strict=True):
        np.testing.assert_allclose(frame.T_world_cam, view.T_world_cam, atol=1e-9)
        assert np.array_equal(frame.rgb, store.rgb(view.index))
        assert frame.depth_counts is not None
        metres = (frame.depth_counts * np.float64(1e-4)).astype(np.float32)
        assert np.array_equal(metres, store.depth_m(view.index))


def test_images_without_depth_are_named_and_left_out(tmp_path):
    make_scene(tmp_path / "1")
    (tmp_path / "1/depth/000003.png").unlink()
    source = open_bop(tmp_path / "1")
    assert len(source) == 3 and any("no depth" in n and " 3." in n for n in source.notes)
    colour = open_bop(tmp_path / "1", use_depth=False)
    assert len(colour) == 4 and colour.depth_unit_m is None


def test_several_scenes_are_listed(tmp_path):
    for k in (4, 9):
        make_scene(tmp_path / f"test/{k:06d}", 1)
    refused(r"2 scenes: 4 \(test/000004\), 9.*--scene", open_bop, tmp_path)
    assert open_bop(tmp_path, scene=9).extra["scene"] == 9
    refused("no scene 5", open_bop, tmp_path, scene=5)


def test_missing_poses_are_said(tmp_path):
    make_scene(tmp_path / "1")
    for key in ("cam_R_w2c", "cam_t_w2c"):
        edit(tmp_path / "1/scene_camera.json", lambda entries, k=key: entries["3"].pop(k))
    source = open_bop(tmp_path / "1")
    assert any("1 of 4 images have no camera pose" in n for n in source.notes)
    assert [f.T_world_cam is None for f in source.frames()] == [False, True, False, False]
