import time

import numpy as np
import pytest

from realsim.errors import InputError
from realsim.geometry import camera, se3
from realsim.records import CameraIntrinsics, TagBoard
from realsim_calibration.detect.edges import EdgeConfig, bilinear, fit_lines
from realsim_calibration.detect.tags import DetectionConfig, TagDetections, detect_tags

BOARD = TagBoard(rows=2, columns=3, tag_size_m=0.032, gap_m=0.008)
CAMERA = CameraIntrinsics(width=480, height=360, fx=600.0, fy=600.0, cx=239.5, cy=179.5)


def truth(T, board=BOARD, intrinsics=CAMERA):
    points = se3.transform(T, board.corners_board.reshape(-1, 3))
    return camera.project(intrinsics, points).reshape(-1, 4, 2)


def errors(render, look, seed, views, blur, noise):
    rng = np.random.default_rng(seed)
    found = []
    for _ in range(views):
        T = look(rng, BOARD, rng.uniform(0.22, 0.4), 55.0)
        d = detect_tags(render(BOARD, CAMERA, T, rng, blur, noise), BOARD)
        found.append((d.corners_px - truth(T)[d.ids]).reshape(-1, 2))
    return np.concatenate(found)


def test_corners_are_sharp_and_unbiased_under_moderate_blur(render, look):
    e = errors(render, look, 0, 10, 0.8, 4.0)
    assert len(e) > 0.9 * 10 * 24
    assert np.sqrt(np.mean(np.sum(e**2, -1))) < 0.06  # 0.10 is the target
    assert np.abs(e.mean(0)).max() < 0.01  # 0.02 is the target


def test_corners_survive_strong_blur(render, look):
    e = errors(render, look, 1, 6, 1.5, 6.0)
    assert np.sqrt(np.mean(np.sum(e**2, -1))) < 0.25


def test_turning_the_image_turns_the_corners(render, look):
    rng = np.random.default_rng(2)
    image = render(BOARD, CAMERA, look(rng, BOARD, 0.3, 40.0), rng, 0.8, 2.0)
    d = detect_tags(image, BOARD)
    turned = detect_tags(np.ascontiguousarray(image[::-1, ::-1]), BOARD)
    both = np.intersect1d(d.ids, turned.ids)
    assert len(both) >= 5
    a = d.corners_px[np.isin(d.ids, both)]
    b = [CAMERA.width - 1, CAMERA.height - 1] - turned.corners_px[np.isin(turned.ids, both)]
    assert np.abs(a - b).max() < 0.02


def test_lens_model_changes_little_without_distortion_and_helps_with_it(render, look):
    rng = np.random.default_rng(3)
    image = render(BOARD, CAMERA, look(rng, BOARD, 0.3, 20.0), rng, 0.8, 0.0)
    plain = detect_tags(image, BOARD)
    ideal = detect_tags(image, BOARD, intrinsics=CAMERA)
    assert np.abs(plain.corners_px - ideal.corners_px).max() < 1e-6
    import cv2

    bent = CameraIntrinsics.from_K(CAMERA.K, 480, 360, [-0.35, 0.1])
    xy, _ = camera.undistort(bent, camera.pixel_grid(480, 360))
    where = (xy * 600.0 + [239.5, 179.5]).astype(np.float32)
    warped = cv2.remap(image, where, None, cv2.INTER_CUBIC)
    expected = camera.distort(bent.distortion, (plain.corners_px - [239.5, 179.5]) / 600.0)
    expected = expected * 600.0 + [239.5, 179.5]
    gain = []
    for intrinsics in (None, bent):
        d = detect_tags(warped, BOARD, intrinsics=intrinsics)
        e = d.corners_px - expected[np.searchsorted(plain.ids, d.ids)]
        gain.append(np.sqrt(np.mean(np.sum(e**2, -1))))
    assert gain[1] < 0.06 and gain[1] < gain[0]


def test_bad_tags_are_rejected_with_a_reason(render, look):
    rng = np.random.default_rng(4)
    T = look(rng, BOARD, 0.3, 10.0)
    image = render(BOARD, CAMERA, T, rng, 0.6, 1.0)
    pale = (118 + (image.astype(float) - 118) * 0.1).astype(np.uint8)
    d = detect_tags(pale, BOARD)
    assert not len(d) and d.rejected and all("low contrast" in r for _, r in d.rejected)
    d = detect_tags(image, BOARD, DetectionConfig(min_side_px=100.0))
    assert [i for i, _ in d.rejected] == BOARD.ids.tolist()
    assert all("too small" in r for _, r in d.rejected)
    other = TagBoard(rows=1, columns=2, tag_size_m=0.032, gap_m=0.008, first_id=4)
    d = detect_tags(image, other)
    assert d.ids.tolist() == [4, 5]
    assert {r for _, r in d.rejected} == {"not a tag of this board"}


def test_a_speck_on_an_edge_does_not_move_the_corners_and_a_blot_drops_the_tag(render, look):
    import cv2

    rng = np.random.default_rng(5)
    T = look(rng, BOARD, 0.3, 10.0)
    image = render(BOARD, CAMERA, T, rng, 0.6, 1.0)
    x, y = (int(v) for v in np.rint(truth(T)[0][:2].mean(0)))
    speck = detect_tags(cv2.circle(image.copy(), (x, y), 6, 215, -1), BOARD)
    assert 0 in speck.ids and np.abs(speck.corners_px[0] - truth(T)[0]).max() < 0.1
    blot = detect_tags(cv2.circle(image.copy(), (x, y), 14, 215, -1), BOARD)
    assert 0 not in blot.ids and len(blot) == 5


def test_an_empty_image_has_no_tags_and_a_float_image_is_refused():
    assert len(detect_tags(np.full((100, 100, 3), 128, np.uint8), BOARD)) == 0
    with pytest.raises(InputError, match="8-bit RGB"):
        detect_tags(np.zeros((10, 10, 3)), BOARD)  # type: ignore[arg-type]


def test_detections_are_sorted_checked_and_frozen():
    corners = np.arange(16.0).reshape(2, 4, 2)
    d = TagDetections(ids=np.array([5, 2]), corners_px=corners, sharpness_px=np.array([1.0, 2.0]))
    assert d.ids.tolist() == [2, 5]
    assert np.array_equal(d.corners_px[0], corners[1]) and d.sharpness_px[0] == 2.0
    assert np.isnan(d.contrast).all()
    with pytest.raises(ValueError, match="read-only"):
        d.corners_px[0] = 0
    with pytest.raises(InputError, match="twice"):
        TagDetections(ids=np.array([2, 2]), corners_px=corners)


def test_sampling_is_exact_on_a_ramp_at_integer_pixel_centres():
    y, x = np.mgrid[0:20, 0:30].astype(float)
    where = np.random.default_rng(0).uniform(0, 18, size=(50, 2))
    assert np.allclose(bilinear(3 * x - 2 * y, where), 3 * where[:, 0] - 2 * where[:, 1])


def test_line_fit_ignores_outliers_and_does_not_care_for_direction():
    rng = np.random.default_rng(0)
    s = np.linspace(0, 50, 28)
    for angle in np.linspace(0, np.pi, 7):
        u = np.array([np.cos(angle), np.sin(angle)])
        n = np.array([-u[1], u[0]])
        p = s[:, None] * u + rng.normal(scale=0.03, size=28)[:, None] * n
        p[[3, 9, 20]] += 1.5 * n
        center, normal, weight, rms = fit_lines(p, np.ones(28, bool), EdgeConfig())
        assert abs(center @ n) < 0.03 and abs(normal @ u) < 2e-3
        assert weight[[3, 9, 20]].sum() == 0 and rms < 0.05


@pytest.mark.slow
def test_a_frame_of_24_tags_takes_little_time(render, look):
    board = TagBoard(rows=4, columns=6, tag_size_m=0.032, gap_m=0.008)
    intrinsics = CameraIntrinsics(width=1280, height=720, fx=640, fy=640, cx=639.5, cy=359.5)
    rng = np.random.default_rng(0)
    image = render(board, intrinsics, look(rng, board, 0.35, 30.0), rng, 0.8, 4.0)
    detect_tags(image, board)
    start = time.process_time()
    for _ in range(5):
        assert len(detect_tags(image, board)) == 24
    assert (time.process_time() - start) / 5 < 0.15  # 0.06 on a quiet core
