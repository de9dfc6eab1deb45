"""The offset between the clocks of arm and camera: laws, known answers, sigma, named errors."""

from dataclasses import dataclass
from functools import cache

import numpy as np
import pytest

from realsim.arrays import Array
from realsim.errors import DegenerateError, InputError
from realsim.geometry import se3
from realsim_calibration import ClockOffset, estimate_clock_offset, solve_pose_pairs
from realsim_calibration.clock.offset import autocorrelation_factor, interpolated
from realsim_calibration.pairs.drift import Drift, estimate_drift
from realsim_calibration.results import Mode
from refusals import refused

X_TRUE = se3.exp([0.1, -0.2, 0.7, 0.03, -0.05, 0.08])


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Streams:
    """Stamped poses of an arm and of the board in its camera."""

    tr: Array
    A: Array
    tc: Array
    C: Array

    def offset(self, later: float = 0.0) -> ClockOffset:
        """Return the estimate with the camera's stamps so much later."""
        return estimate_clock_offset(self.tr, self.A, self.tc + later, self.C)


def hand(seed: int, t: Array) -> Array:
    """Return T_base_ee (n, 4, 4) of a smooth motion that does not repeat."""
    rng = np.random.default_rng(seed)
    f, phase = rng.uniform(0.1, 0.6, (3, 6)), rng.uniform(0, 2 * np.pi, (3, 6))
    size = np.array([0.25, 0.25, 0.4, 0.06, 0.06, 0.06]) / np.sqrt(3)
    x = (np.sin(2 * np.pi * f * t[:, None, None] + phase)).sum(1) * size
    return se3.from_rt(se3.exp_so3(x[:, :3]) @ np.diag([1.0, -1, -1]), x[:, 3:] + [0.4, 0, 0.5])


def streams(
    seed: int = 0, d: float = 0.0, jitter: float = 0.0, noise: float = 1.0, seconds: float = 10.0
) -> Streams:
    """Return ten seconds at 125 and 15 Hz; the camera stamps a frame of time t as t + d."""
    rng = np.random.default_rng(1000 + seed)
    tr, t = np.arange(0, seconds, 0.008), np.arange(0.01, seconds, 1 / 15)
    Z = se3.from_rt(np.diag([1.0, -1, -1]), [0.4, 0.05, 0.0])
    A = hand(seed, tr) @ se3.exp(rng.normal(scale=2e-4 * noise, size=(len(tr), 6)))
    C = se3.invert(hand(seed, t) @ X_TRUE) @ Z
    C = C @ se3.exp(np.pad(rng.normal(scale=2e-3 * noise, size=(len(t), 3)), ((0, 0), (0, 3))))
    C[:, :3, 3] += rng.normal(scale=1e-3 * noise, size=(len(t), 3))
    return Streams(tr=tr, A=A, tc=t + d + rng.normal(scale=jitter, size=len(t)), C=C)


@cache
def base() -> ClockOffset:
    """Return the estimate of the first streams, whose clocks agree."""
    return streams().offset()


def test_exact_streams_give_the_offset() -> None:
    """Without noise 37 ms come back to a tenth of a millisecond, and X to a tenth of a mm."""
    found = streams(d=0.037, noise=0.01).offset()
    assert found.offset_s == pytest.approx(0.037, abs=1e-4)
    assert np.linalg.norm((se3.invert(found.X) @ X_TRUE)[:3, 3]) < 1e-4


@pytest.mark.parametrize("d", [0.25, -0.6])
def test_a_shift_of_the_stamps_shifts_the_offset(d: float) -> None:
    """Law: stamps later by d give an offset larger by d."""
    assert streams().offset(d).offset_s - base().offset_s == pytest.approx(d, abs=5e-5)


def test_one_constant_on_both_clocks_changes_nothing() -> None:
    """Law: seconds since 1970 and seconds since the start are the same to the microsecond."""
    s = streams()
    later = estimate_clock_offset(s.tr + 1.7e9, s.A, s.tc + 1.7e9, s.C)
    assert later.offset_s == pytest.approx(base().offset_s, abs=2e-6)


def test_sigma_is_that_of_the_errors() -> None:
    """Over eight motions with jitter of 4 ms the offset is off by one sigma on the average."""
    found = [streams(seed, d=0.05, jitter=0.004).offset() for seed in range(8)]
    z = np.array([(f.offset_s - 0.05) / f.sigma_s for f in found])
    assert 0.45 < np.sqrt(np.mean(z**2)) < 1.6
    assert np.median([f.jitter_s for f in found]) == pytest.approx(0.004, rel=0.3)
    assert np.median([abs(f.offset_s - 0.05) for f in found]) < 1e-3


def test_whether_it_matters() -> None:
    """A tenth of a second does, half a millisecond does not; the words say so."""
    assert not streams(d=0.0005).offset().matters
    far = streams(d=0.1).offset()
    assert far.matters and "it matters" in far.sentence
    assert far.moved_mm > 5.0


def test_clocks_that_start_at_different_times_are_told_in_seconds() -> None:
    """What an offset of years would move the board by is no figure."""
    told = streams().offset(1.7e9).sentence
    assert "+1699999999.99" in told and " s off" in told
    assert "start at different times" in told and "moves the board" not in told


def test_frames_without_a_board_and_wrong_ones_do_no_harm() -> None:
    """NaN frames are left out, invented poses are gated."""
    s = streams(d=0.02)
    rng = np.random.default_rng(3)
    C = s.C.copy()
    C[::7] = np.nan
    C[3::11] = se3.random_transform(rng, len(C[3::11]), 0.3)
    found = estimate_clock_offset(s.tr, s.A, s.tc, C)
    assert abs(found.offset_s - 0.02) < 1e-3
    assert np.linalg.norm((se3.invert(found.X) @ X_TRUE)[:3, 3]) < 3e-3


def test_streams_that_tell_no_time_are_named() -> None:
    """A still arm; motions that have nothing in common; two poses; stamps of another number."""
    s, other = streams(0), streams(1)
    still = np.repeat(s.A[:1], len(s.A), 0)
    said = r"robot's stream shows no motion.*--clock-offset"
    refused(said, estimate_clock_offset, s.tr, still, s.tc, s.C)
    refused("agree at no offset", estimate_clock_offset, s.tr, s.A, other.tc, other.C)
    refused("camera's stream has 2 poses", estimate_clock_offset, s.tr, s.A, s.tc[:2], s.C[:2])
    refused("clock: the robot's stream has", estimate_clock_offset, s.tr[:-1], s.A, s.tc, s.C)


def test_an_offset_larger_than_the_recording_is_named() -> None:
    """The robot saw the beginning of a motion and the camera its end."""
    s = streams(seconds=20.0)
    early, late = s.tr < 8, s.tc > 11
    with pytest.raises(InputError, match="larger than the recording"):
        estimate_clock_offset(s.tr[early], s.A[early], s.tc[late], s.C[late])


def test_neighbours_that_share_errors_widen_sigma() -> None:
    """White scores have factor 1, a moving average of five has several times as much."""
    white = np.random.default_rng(0).normal(size=2000)
    assert autocorrelation_factor(white) == pytest.approx(1.0, abs=0.25)
    assert autocorrelation_factor(np.convolve(white, np.ones(5))) > 3.0


def test_interpolation_between_two_poses() -> None:
    """Half way between two poses lies half the turn and half the way; outside is said."""
    Ts = np.stack([np.eye(4), se3.from_rt(se3.exp_so3([0, 0, 1.0]), [0.2, 0, 0])])
    found, inside = interpolated(np.array([0.0, 2.0]), Ts, np.array([1.0, 3.0]))
    np.testing.assert_allclose(found[0, :3, :3], se3.exp_so3([0, 0, 0.5]), atol=1e-12)
    np.testing.assert_allclose(found[0, :3, 3], [0.1, 0, 0], atol=1e-12)
    assert inside.tolist() == [True, False]


# --- The hand-eye of pose pairs: the truth, its sigma, wrong pairs, and frames that do not matter.
Z_TRUE = se3.exp([3.0, 0.1, 0.2, 0.5, 0.1, 0.05])


def pairs(
    seed: int, n: int = 25, camera: tuple[float, float] = (2e-3, 1e-3), robot: float = 3e-4
) -> tuple[Array, Array]:
    """Return T_base_ee and T_cam_board of a camera in the hand that circles a board."""
    rng = np.random.default_rng(seed)
    A, C = np.zeros((n, 4, 4)), np.zeros((n, 4, 4))
    for k in range(n):
        side, roll = rng.uniform(-0.6, 0.6, 2), rng.uniform(-np.pi, np.pi)
        eye = np.array([*side * 0.5, -rng.uniform(0.35, 0.6)])
        T_cam_board = se3.invert(se3.look_at(eye, rng.normal(scale=0.03, size=3), roll))
        A[k] = Z_TRUE @ se3.invert(T_cam_board) @ se3.invert(X_TRUE)
        A[k] = A[k] @ se3.exp(rng.normal(scale=robot, size=6))
        C[k] = T_cam_board @ se3.exp([*rng.normal(scale=camera[0], size=3), 0, 0, 0])
        C[k, :3, 3] += rng.normal(scale=camera[1], size=3) * [1, 1, 3]
    return A, C


def off(T: Array, truth: Array) -> Array:
    """Return the right twist from an estimate to the truth (6,)."""
    return se3.log(se3.invert(T) @ truth)


def test_exact_pairs_give_the_truth() -> None:
    """Without errors X and Z come back to the micrometre."""
    A, C = pairs(0, camera=(0.0, 0.0), robot=0.0)
    found = solve_pose_pairs(A, C)
    assert np.abs(off(found.X, X_TRUE)).max() < 1e-6
    assert np.abs(off(found.Z, Z_TRUE)).max() < 1e-6
    assert found.used.all()


@cache
def trials() -> tuple[tuple[Array, Array, Array], ...]:
    """Return (off, covariance, off of the unweighted closed form) of 14 sets."""
    from realsim_calibration import shah

    rows: list[tuple[Array, Array, Array]] = []
    for seed in range(14):
        A, C = pairs(100 + seed, camera=(8e-3, 5e-4))
        found = solve_pose_pairs(A, C)
        rows.append((off(found.X, X_TRUE), found.covariance[:6, :6], off(shah(A, C)[0], X_TRUE)))
    return tuple(rows)


def test_sigma_of_a_pair_is_that_of_the_errors() -> None:
    """The squared distance of the truth in the stated covariance is 6 on the average."""
    nees = [float(d @ np.linalg.solve(S, d)) for d, S, _ in trials()]
    assert 3.5 < np.mean(nees) < 9.5
    assert np.mean(np.array(nees) < 12.6) > 0.8


def test_weighing_what_is_sure_beats_a_closed_form() -> None:
    """The error of X is well below that of Shah's closed form."""
    ours = np.median([np.linalg.norm(d[3:]) for d, _, _ in trials()])
    closed = np.median([np.linalg.norm(d[3:]) for _, _, d in trials()])
    assert ours < 0.6 * closed


def test_half_of_the_pairs_may_be_wrong() -> None:
    """Every invented pose is named and X stays."""
    A, C = pairs(3, n=30)
    rng = np.random.default_rng(4)
    bad = rng.permutation(30)[:14]
    for k in bad:
        t = rng.normal(size=3)
        C[k] = se3.from_rt(se3.random_rotation(rng), 0.5 * t / np.linalg.norm(t))
    found = solve_pose_pairs(A, C)
    assert not found.used[bad].any()
    assert found.used.sum() >= 15
    assert np.linalg.norm(off(found.X, X_TRUE)[3:]) < 3e-3


@pytest.mark.parametrize("mode", ["eye_in_hand", "eye_to_hand"])
def test_a_fixed_camera_is_the_inverse_problem(mode: Mode) -> None:
    """The same cameras and boards with the hand inverted give the same frames."""
    A, C = pairs(5)
    found = solve_pose_pairs(A if mode == "eye_in_hand" else se3.invert(A), C, mode=mode)
    assert np.linalg.norm(off(found.X, X_TRUE)[3:]) < 3e-3
    assert np.linalg.norm(off(found.Z, Z_TRUE)[3:]) < 3e-3


def test_another_base_frame_moves_z_alone() -> None:
    """X and its covariance do not depend on where the base is."""
    A, C = pairs(6)
    G = se3.exp([0.3, 0.2, -0.5, 1.0, 2.0, -0.5])
    one, other = solve_pose_pairs(A, C), solve_pose_pairs(G @ A, C)
    np.testing.assert_allclose(one.X, other.X, atol=2e-6)
    np.testing.assert_allclose(G @ one.Z, other.Z, atol=1e-5)
    np.testing.assert_allclose(one.covariance[:6, :6], other.covariance[:6, :6], rtol=0.03)


def test_bad_stacks_are_named() -> None:
    """Shuffled poses agree with no place of the camera; lengths, values and motion are checked."""
    A, C = pairs(7)
    refused("belong together", solve_pose_pairs, A, np.roll(C, 7, axis=0))
    A, C = pairs(8)
    refused("25 hand poses and 24 camera poses", solve_pose_pairs, A, C[:-1])
    C[3, 0, 0] = np.nan
    refused("the first is pair 3", solve_pose_pairs, A, C)
    with pytest.raises(DegenerateError, match="does not turn"):
        solve_pose_pairs(np.repeat(A[:1], 10, 0), np.repeat(pairs(8)[1][:1], 10, 0))


# --- Whether the camera still sits where it was calibrated: known slips, false alarms, sigma.

SLIP = np.array([0.004, -0.006, 0.002, 0.003, -0.001, 0.002])


def cameras(n: int, seed: int) -> Array:
    """Return T_world_cam of cameras around a table, tilted and rolled."""
    rng = np.random.default_rng(seed)
    Ts: list[Array] = []
    for k in range(n):
        a = 2 * np.pi * k / n
        eye = [0.35 * np.cos(a), 0.35 * np.sin(a), 0.25 + 0.1 * (k % 3)]
        Ts.append(se3.look_at(eye, rng.normal(scale=0.02, size=3), rng.uniform(-1, 1)))
    return np.array(Ts)


def drift(slip: Array, seed: int = 0, noise: tuple[float, float] = (5e-4, 3e-4)) -> Drift:
    """Return what is found of a slip; the objects' frame is off by a centimetre, too."""
    rng = np.random.default_rng(50 + seed)
    now = cameras(12, seed)
    claimed = now @ se3.exp(-slip)
    claimed = claimed @ se3.exp(rng.normal(size=(12, 6)) * np.repeat(noise, 3))
    frame = se3.exp([0.01, -0.02, 0.03, 0.01, 0.005, -0.01])
    return estimate_drift(claimed, frame @ now, 0.45)


def test_a_known_slip_is_found() -> None:
    """Without noise the slip comes back whatever the objects' frame is."""
    found = drift(SLIP, noise=(1e-8, 1e-8))
    np.testing.assert_allclose(found.twist, SLIP, atol=2e-5)
    assert found.moved


def test_sigma_and_false_alarms() -> None:
    """None of 24 sessions without a slip is called moved; the squared distance is that of F."""
    found = [drift(np.zeros(6), seed) for seed in range(24)]
    assert not any(f.moved for f in found)
    distance = [float(f.twist @ np.linalg.solve(f.covariance, f.twist)) for f in found]
    assert 4.0 < np.mean(distance) < 10.0


@pytest.mark.parametrize("seed", range(3))
def test_three_millimetres_are_told_from_noise(seed: int) -> None:
    """A slip of 3.7 mm and 0.43 deg is named, with a size that fits its sigma."""
    found = drift(SLIP, seed)
    assert found.moved
    off = found.twist - SLIP
    assert off @ np.linalg.solve(found.covariance, off) < 25.0


def test_a_slip_within_the_tolerance_holds() -> None:
    """What shifts the objects by a fifth of a millimetre is seen and is of no matter."""
    now = cameras(24, 1)
    claimed = now @ se3.exp([0, 0, 0, -2e-4, 0, 0])
    assert not estimate_drift(claimed, now, 0.45, tolerance_mm=1.0).moved
    assert estimate_drift(claimed, now, 0.45, tolerance_mm=0.1).moved


def test_a_short_scan_says_that_it_cannot_tell() -> None:
    """Cameras that only slide have a sigma of many millimetres and raise no alarm."""
    now = np.array([se3.from_rt(np.eye(3), [0.02 * k, 0.01 * (k % 3), 0.0]) for k in range(8)])
    rng = np.random.default_rng(0)
    claimed = now @ se3.from_translation(SLIP[3:]) @ se3.exp(rng.normal(scale=2e-4, size=(8, 6)))
    found = estimate_drift(claimed, now, 0.45)
    assert found.sigmas[1] > 20.0
    assert not found.moved


def test_few_views_are_named() -> None:
    """Four views do not determine slip and frame."""
    now = cameras(4, 0)
    refused("at least 5 views", estimate_drift, now, now, 0.4)
