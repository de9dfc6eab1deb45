import numpy as np
import pytest

from realsim.errors import InputError
from realsim.geometry import camera, se3
from realsim.records import CameraIntrinsics, TagBoard
from realsim_calibration.detect.edges import bilinear
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
