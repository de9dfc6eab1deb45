"""From depth images to points, noise, table and sound views; frames that are read when asked."""

from dataclasses import replace

import numpy as np
import pytest

from realsim.arrays import Array32
from realsim.geometry import se3
from realsim.records.depth_bias import DepthBias
from realsim.registration.config import RegistrationConfig
from realsim.registration.evidence import LazyFrame, correct_frame
from realsim.registration.intake import take_in
from realsim.registration.simulated import TableScene
from refusals import refused
from table_faults import without_any_depth
from table_scenes import SMALL_LAB, small_scene

CONFIG = RegistrationConfig()


def scene() -> TableScene:
    return small_scene(0)


def taken(frames, config: RegistrationConfig = CONFIG):
    return take_in(scene().intrinsics, frames, config)


# --- frames that are read when asked -------------------------------------------------------------


class Reader:
    """An image on disk, so to speak: it counts how often it is read."""

    def __init__(self, image: Array32) -> None:
        self.image, self.times = image, 0

    def __call__(self) -> Array32:
        self.times += 1
        return self.image


def test_a_corrected_frame_has_its_bias_taken_out_and_its_camera_moved():
    bias = DepthBias(scale=1.01, offset_per_m=-0.02)
    z = np.array([[0.0, 0.2, 0.4]], np.float32)
    reader = Reader(bias.measured(z).astype(np.float32))
    T = se3.from_translation([1, 2, 3])
    frame = correct_frame(LazyFrame(3, np.eye(4), reader), T, bias)
    assert reader.times == 0
    np.testing.assert_allclose(frame.depth_m, z, atol=1e-7)
    assert frame.depth_m.dtype == np.float32 and frame.index == 3
    np.testing.assert_array_equal(frame.T_world_cam, T)
    twice = correct_frame(frame, np.eye(4), DepthBias(scale=2.0 / 1.5))
    np.testing.assert_allclose(twice.depth_m, 0.75 * z, atol=1e-7)


# --- what is taken in ----------------------------------------------------------------------------


def test_table_noise_and_points_are_those_of_the_scene():
    intake = taken(scene().frames)
    assert intake.findings == () and len(intake.views) == SMALL_LAB.views
    assert intake.plane is not None and intake.no_plane == ""
    T = intake.plane.T_world_table
    assert np.degrees(np.arccos(T[2, 2])) < 0.1 and abs(T[2, 3]) < 7e-4
    k = scene().sensor.disparity_noise_px / (scene().intrinsics.fx * 0.018)
    assert intake.noise.per_m == pytest.approx(k, rel=0.35)
    np.testing.assert_array_equal(intake.cameras, scene().Ts_base_ee @ scene().T_ee_cam)


def test_a_known_bias_is_taken_out():
    bias = DepthBias(scale=1.003, offset_per_m=-0.01)
    spoilt = [
        replace(f, depth_m=np.where(f.depth_m > 0, bias.measured(f.depth_m), 0).astype(np.float32))
        for f in scene().frames
    ]
    here, there = taken(scene().frames), taken(spoilt, RegistrationConfig(bias=bias))
    for a, b in zip(here.views, there.views, strict=True):
        assert abs(len(a.points) - len(b.points)) < 0.001 * len(a.points)
        assert b.points[:, 2].mean() == pytest.approx(a.points[:, 2].mean(), abs=5e-6)
    np.testing.assert_allclose(there.frames[0].depth_m, scene().frames[0].depth_m, atol=1e-6)
    # What is only unsure leaves the images as they are.
    unsure = taken(scene().frames, RegistrationConfig(bias=DepthBias.unmeasured()))
    assert unsure.frames[0].depth_m is scene().frames[0].depth_m


@pytest.mark.parametrize("value", [0.0, np.nan])
def test_an_empty_view_is_left_out_and_named(value: float):
    frames = list(scene().frames)
    frames[0] = replace(frames[0], depth_m=np.full_like(frames[0].depth_m, value))
    frames[5] = without_any_depth(frames[5])
    intake = taken(frames)
    assert [f.index for f in intake.frames] == [k for k in range(12) if k not in (0, 5)]
    assert [v.index for v in intake.views] == [f.index for f in intake.frames]
    found = {f.index: f for f in intake.findings}
    assert set(found) == {0, 5} and all(f.exclude for f in found.values())
    assert "view 5" in found[5].words and "empty" in found[5].words


def test_nothing_to_use_is_refused_by_name():
    refused("at least one", taken, [])
    refused("unique", taken, [scene().frames[0], replace(scene().frames[1], index=0)])
    empty = [without_any_depth(f) for f in scene().frames[:3]]
    refused(r"3 depth images.*all zero", taken, empty)
    given = RegistrationConfig(evidence=replace(CONFIG.evidence, noise_per_m=0.007))
    refused(r"none of the 3 views can be used.*view 0.*view 2", taken, empty, given)
    small = replace(scene().frames[1], depth_m=np.ones((9, 16), np.float32))
    refused("shape", taken, [scene().frames[0], small])


def test_one_view_is_enough():
    intake = taken(scene().frames[:1])
    assert len(intake.views) == 1 and intake.plane is not None
