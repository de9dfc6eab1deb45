"""`realsim depth-fit`: from a folder of plane frames to a sensor's file, and refusals that help."""

import json
from pathlib import Path

import numpy as np
import pytest

from example_inputs import D405, wall, walls
from realsim.images import depth_counts, png_bytes
from realsim.records import CameraIntrinsics
from realsim.rendering.depth_sensors.model import DepthSensorModel
from realsim.rendering.stereo import StereoConfig
from typed_commands import complained, finished

CAMERA = CameraIntrinsics(width=400, height=300, fx=380, fy=380, cx=199.5, cy=149.5)
UNIT = 1e-4
K = "380 0 199.5\n0 380 149.5\n0 0 1\n"


@pytest.fixture(scope="module")
def frames(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a folder with three frames of a wall by a known D405 and its camera."""
    folder = tmp_path_factory.mktemp("walls") / "frames"
    walls(folder, CAMERA)
    (folder / "cam_K.txt").write_text(K)
    return folder


def test_a_folder_gives_a_sensor_that_is_what_it_was(frames: Path, tmp_path: Path) -> None:
    out = tmp_path / "sensor.json"
    result = finished("depth-fit", frames, "--out", out, "--quiet")
    found = DepthSensorModel.load(out)
    assert found.disparity_noise_px == pytest.approx(0.06, rel=0.05)
    assert found.depth_unit_m == UNIT and found.baseline_m == 0.018
    assert str(out.with_suffix(".png")) in result.output
    assert out.with_suffix(".png").read_bytes().startswith(b"\x89PNG")
    # What the frames do not tell is said, with the value that is kept.
    assert "not determined" in result.output and "bias_px" in result.output
    fitted = json.loads(out.read_text())["fit"]["frames"]
    assert [f["name"] for f in fitted] == ["000000.png", "000001.png", "000002.png"]


@pytest.mark.slow
def test_the_stereo_camera_is_fitted_to_the_same_folder(frames: Path, tmp_path: Path) -> None:
    out = tmp_path / "stereo.json"
    options = ("--simulator", "stereo", "--only-views", "0-1", "--quiet")
    result = finished("depth-fit", frames, *options, "--out", out)
    config = StereoConfig.load(out)
    fitted = json.loads(out.read_text())["fit"]["frames"]
    assert len(fitted) == 2 and config != StereoConfig()
    for f in fitted:
        ratio = f["simulated"]["sigma_px"] / f["measured"]["sigma_px"]
        assert 1 / 1.2 < ratio < 1.2
    assert "full_well" in result.output and out.with_suffix(".png").is_file()


def test_the_wrong_unit_is_named(frames: Path, tmp_path: Path) -> None:
    out = tmp_path / "out.json"
    for unit, words in (
        ("1", "0.001 where the counts are millimetres"),
        ("nan", "0.001 where the counts are millimetres"),
        ("0.01", "millimetres"),  # a wall 26 m away
        ("0.001", "measures from 0.1 to 1.5 m"),  # a wall at 2.6 m, where a D405 measures nothing
    ):
        said = complained("depth-fit", frames, "--depth-unit", unit, "--out", out, "--quiet")
        assert words in said, said
    assert "--depth-unit" in said and not out.exists()


def test_frames_without_a_plane_are_named(tmp_path: Path) -> None:
    rough = np.random.default_rng(0).uniform(0.2, 0.9, (300, 400)).astype(np.float32)
    (tmp_path / "rough.png").write_bytes(png_bytes(depth_counts(rough, UNIT)))
    (tmp_path / "cam_K.txt").write_text(K)
    out = tmp_path / "out.json"
    said = complained("depth-fit", tmp_path, "--out", out, "--quiet")
    assert "rough.png" in said and "plane" in said
    assert not out.exists() and not out.with_suffix(".png").exists()


def test_folders_that_hold_nothing_to_fit_are_named(frames: Path, tmp_path: Path) -> None:
    assert "no folder" in complained("depth-fit", tmp_path / "nowhere")
    assert "holds no PNG" in complained("depth-fit", tmp_path)
    assert "names none" in complained("depth-fit", frames, "--only-views", "40-50")
    assert "is a folder" in complained("depth-fit", frames, "--out", tmp_path)
    (tmp_path / "a.png").write_bytes(png_bytes(depth_counts(wall(CAMERA, 0.3, 0.1), UNIT)))
    assert "--intrinsics FILE" in complained("depth-fit", tmp_path)
    np.save(tmp_path / "a.npy", wall(CAMERA, 0.3, 0.1))
    assert "uint16" in complained("depth-fit", tmp_path, "--quiet")
    (tmp_path / "a.npy").write_bytes(b"\x93NUMPY")
    assert "is not a numpy array" in complained("depth-fit", tmp_path, "--quiet")


def test_counts_in_arrays_are_taken_with_the_kinds_own_focal_length(tmp_path: Path) -> None:
    camera = CameraIntrinsics(width=640, height=480, fx=386.3, fy=386.3, cx=319.5, cy=239.5)
    seen = D405.measure(wall(camera, 0.4, 0.1), camera, np.random.default_rng(0))
    np.save(tmp_path / "depth.npy", depth_counts(seen, UNIT))
    (tmp_path / "color.png").write_bytes(png_bytes(np.zeros((480, 640, 3), np.uint8)))
    result = finished("depth-fit", tmp_path, "--out", tmp_path / "sensor.json", "--quiet")
    assert "386.3 px, is taken" in result.output
    found = DepthSensorModel.load(tmp_path / "sensor.json")
    assert found.disparity_noise_px == pytest.approx(0.06, rel=0.1)
    assert found.whole_pixel_gain == pytest.approx(D405.whole_pixel_gain, abs=0.1)
    assert found.border_margin_px == pytest.approx(D405.border_margin_px, abs=0.5)
