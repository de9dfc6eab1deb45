"""The parts that the finders are made of: laws and known answers."""

import numpy as np

from realsim.geometry import se3
from realsim_calibration.detect.ellipses import outline_bias
from realsim_calibration.detect.homography import (
    apply_homography,
    fit_homography,
    seen_from_front,
)
from realsim_calibration.detect.saddles import refine_saddles

K = np.array([[600.0, 0, 319.5], [0, 600.0, 239.5], [0, 0, 1]])
MIDDLE = np.array([0.07, 0.05, 0.0])


def board_to_image(tilt_deg, azimuth_deg=30.0, roll_deg=20.0):
    """Return H (3, 3) of a camera 0.4 m from the board's middle."""
    tilt, azimuth = np.radians([tilt_deg, azimuth_deg])
    away = [np.sin(tilt) * np.cos(azimuth), np.sin(tilt) * np.sin(azimuth), -np.cos(tilt)]
    T = se3.invert(se3.look_at(MIDDLE + 0.4 * np.array(away), MIDDLE, np.radians(roll_deg)))
    return K @ T[:3, [0, 1, 3]]


def test_the_bias_of_an_ellipse_is_that_of_its_conic():
    # Middle of the ellipse from the dual conic H C* H^T, C* = diag(r^2, r^2, -1) moved by p.
    H = board_to_image(50.0)
    p, r = np.array([[0.03, 0.02], [0.1, 0.08]]), np.array([0.006, 0.01])
    bias = outline_bias(lambda q: apply_homography(H, q), p, r)
    for k in range(2):
        move = np.array([[1, 0, p[k, 0]], [0, 1, p[k, 1]], [0, 0, 1]])
        D = H @ move @ np.diag([r[k] ** 2, r[k] ** 2, -1.0]) @ move.T @ H.T
        expected = D[:2, 2] / D[2, 2] - apply_homography(H, p[k])
        assert np.allclose(bias[k], expected, atol=1e-8) and np.linalg.norm(expected) > 0.03


def test_a_saddle_is_exact_without_noise_and_needs_the_right_colours():
    y, x = np.mgrid[:60, :60].astype(float)
    for centre, angle in (((30.3, 29.6), 0.2), ((29.5, 30.9), 0.9)):
        u, v = x - centre[0], y - centre[1]
        a = u * np.cos(angle) + v * np.sin(angle)
        b = -u * np.sin(angle + 0.2) + v * np.cos(angle + 0.2)
        image = np.rint(120 + 80 * np.tanh(1.2 * a) * np.tanh(1.2 * b)).astype(np.uint8)
        along_a = 20 * np.array([np.cos(angle + 0.2), np.sin(angle + 0.2)])  # where b = 0
        along_b = 20 * np.array([-np.sin(angle), np.cos(angle)])
        arms = np.stack([along_a, along_b, -along_a, -along_b])[None]
        start = np.array([centre]) + np.array([0.8, -0.6])
        found = refine_saddles(image, start, arms, np.array([False]))
        assert found.good.all() and np.abs(found.uv - centre).max() < 0.01
        wrong = refine_saddles(image, start, arms, np.array([True]))
        assert not wrong.good.any() and "contrast" in wrong.faults[0]
    assert (
        len(refine_saddles(image, np.zeros((0, 2)), np.zeros((0, 4, 2)), np.zeros(0, bool)).uv) == 0
    )


def test_homography_round_trip_and_handedness():
    rng = np.random.default_rng(0)
    board = 0.02 * np.stack(np.meshgrid(np.arange(7.0), np.arange(6.0)), -1).reshape(-1, 2)
    for _ in range(5):
        expected = board_to_image(*rng.uniform(0, [60, 360, 360]))
        H = fit_homography(board, apply_homography(expected, board))
        assert np.allclose(H / H[2, 2], expected / expected[2, 2], atol=1e-6)
        assert seen_from_front(H, board)
        assert not seen_from_front(np.diag([-1.0, 1.0, 1.0]) @ H, board)
