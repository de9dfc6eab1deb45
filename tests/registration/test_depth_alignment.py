"""Whether depth lies on colour is told on simulated and on real images, shifted on purpose."""

import json
import os
from functools import cache
from pathlib import Path

import cv2
import numpy as np
import pytest

from realsim.records import CameraIntrinsics
from realsim.registration.depth_alignment import check_alignment, pooled_alignment
from refusals import refused
from table_faults import seen_instances
from table_scenes import small_scene

ROOT = Path(__file__).resolve().parents[2]
DATA = Path(os.environ.get("REALSIM_DATA", ROOT.parent / "shared" / "data"))
SCENES = DATA / "scenes"


def warped(depth, sx=1.0, sy=1.0, dx=0.0, dy=0.0):
    """Depth stretched about the image's middle and moved."""
    h, w = depth.shape
    M = np.array([[sx, 0, w / 2 * (1 - sx) + dx], [0, sy, h / 2 * (1 - sy) + dy]])
    return cv2.warpAffine(depth, M, (w, h), flags=cv2.INTER_NEAREST)


@cache
def painted():
    """Camera, and pairs of a colour and a depth image of simulated objects, 640 px wide."""
    scene = small_scene(5, 6, 6)
    rng = np.random.default_rng(0)
    paint = rng.integers(30, 230, (8, 3))
    shown = seen_instances(scene, range(4))
    pairs = []
    for labels, frame in zip(shown, scene.frames[:4], strict=True):
        rgb = np.clip(paint[labels] + rng.normal(0, 4, (*labels.shape, 3)), 0, 255)
        rgb = cv2.resize(rgb.astype(np.uint8), (640, 360), interpolation=cv2.INTER_LINEAR)
        depth = cv2.resize(frame.depth_m, (640, 360), interpolation=cv2.INTER_NEAREST)
        pairs.append((rgb, depth))
    return CameraIntrinsics(width=640, height=360, fx=324, fy=324, cx=319.5, cy=179.5), pairs


@cache
def checked(source, n, warp):
    """The check of one pair of a source, its depth warped; each is made once."""
    camera, pairs = source()
    rgb, depth = pairs[n]
    return check_alignment(rgb, warped(depth, **dict(warp)), camera)


def pooled(source, *which, **warp):
    """The check of the pairs of a source together, or of some of them."""
    pairs, warp = which or range(len(source()[1])), tuple(sorted(warp.items()))
    return pooled_alignment([checked(source, n, warp) for n in pairs])


def test_simulated_depth_is_aligned():
    found = pooled(painted)
    assert found.kind == "aligned" and found.agreeing == found.views == 4
    assert np.hypot(*found.shift_px) < 2


def test_a_shift_is_measured():
    dx, dy = 9, 12
    still, found = pooled(painted), pooled(painted, dx=dx, dy=dy)
    assert found.kind == "not_aligned" and found.stretch == (1.0, 1.0)
    assert np.allclose(np.array(found.shift_px) - still.shift_px, [dx, dy], atol=1.0)
    assert "below" in found.words and f"{found.agreeing} of 4 views" in found.words
    assert found.agreeing >= 3


def test_a_stretch_is_measured():
    found = pooled(painted, sx=0.85, sy=1.12)
    assert found.kind == "not_aligned"
    assert np.allclose(found.stretch, [1 / 0.85, 1 / 1.12], rtol=0.025)
    assert "stretched" in found.words


def test_one_view_is_enough_to_name_a_resized_or_moved_depth():
    for warp in ({}, {"sx": 0.75}, {"sx": 0.85, "sy": 1.12}, {"dx": 9, "dy": 12}):
        kinds = [pooled(painted, n, **warp).kind for n in range(2)]
        assert set(kinds) <= {"not_aligned" if warp else "aligned", "unknown"}
        assert not warp or "not_aligned" in kinds


def test_a_bare_table_says_nothing():
    camera, pairs = painted()
    found = check_alignment(pairs[0][0], np.full((360, 640), 0.4, np.float32), camera)
    assert found.kind == "unknown" and "0 pixels of outlines" in found.words
    assert pooled_alignment([found]).kind == "unknown"


def test_another_size_is_named_at_once():
    camera, pairs = painted()
    found = check_alignment(pairs[0][0], pairs[0][1][:, :600], camera)
    assert found.kind == "other_size" and "600x360" in found.words and "640x360" in found.words
    assert pooled_alignment([found]).kind == "other_size"


def test_senseless_images_are_errors():
    camera, pairs = painted()
    refused("8-bit", check_alignment, pairs[0][0][..., 0], pairs[0][1], camera)
    refused("at least one", pooled_alignment, [])


# --- real data --------------------------------------------------------------------------------


@cache
def ycbv():
    pairs = []
    for scene in (50, 51, 54):
        folder = SCENES / "ycbv_mini/test" / f"{scene:06d}"
        unit = next(iter(json.loads((folder / "scene_camera.json").read_text()).values()))
        counts = cv2.imread(str(next((folder / "depth").iterdir())), cv2.IMREAD_UNCHANGED)
        rgb = cv2.imread(str(next((folder / "rgb").iterdir())))[..., ::-1].copy()
        pairs.append((rgb, (counts * (unit["depth_scale"] / 1000)).astype(np.float32)))
    return CameraIntrinsics.from_K(unit["cam_K"], 640, 480), pairs


@pytest.mark.real
@pytest.mark.skipif(not SCENES.is_dir(), reason=f"no scenes under {DATA} (set REALSIM_DATA)")
def test_published_images_are_aligned_and_no_longer_when_shifted():
    still, found = pooled(ycbv), pooled(ycbv, dx=-14)
    assert still.kind == "aligned" and still.agreeing == still.views
    assert found.kind == "not_aligned" and "left" in found.words
    assert abs(found.shift_px[0] - still.shift_px[0] + 14) < 2
    assert found.agreeing == found.views


@pytest.mark.real
@pytest.mark.skipif(not SCENES.is_dir(), reason=f"no scenes under {DATA} (set REALSIM_DATA)")
def test_one_real_view_tells_resized_depth_from_aligned():
    assert all(pooled(ycbv, n).kind == "aligned" for n in range(3))
    for warp in ({"sx": 0.8, "sy": 0.85, "dx": 10}, {"dx": 12, "dy": 6}, {"sx": 1.2, "sy": 1.2}):
        assert all(pooled(ycbv, n, **warp).kind == "not_aligned" for n in range(3))
    # Depth of 1024x768 beside colour of 1920x1080, one taken for the other after a resize.
    named = 0
    for n in (0, 1, 6):
        folder = DATA / "handeye/rtde_ur5e/Hand-Eye-Data"
        rgb = cv2.imread(str(folder / f"{n}.jpg"))[..., ::-1].copy()
        counts = cv2.imread(str(folder / f"{n}.png"), cv2.IMREAD_UNCHANGED)
        metres = (counts / 1000).astype(np.float32)
        depth = cv2.resize(metres, (1920, 1080), interpolation=cv2.INTER_NEAREST)
        lens = CameraIntrinsics(width=1920, height=1080, fx=1350, fy=1350, cx=959.5, cy=539.5)
        found = pooled_alignment([check_alignment(rgb, depth, lens)])
        named += found.kind == "not_aligned" and "stretched by 1.00 in x and 1." in found.words
    assert named == 3
