"""Benchmark of several cameras calibrated together: a simulated lab with a UR3.

    uv run python benchmarks/calibration_cameras.py [--quick] [--json FILE] [--seed N] [--labs N]

A camera in the hand and three that stand round it see a board on the table and one that the arm
carries (`calibration_cameras_lab.py`: an arm of its own with wrong zeros and links, sag and play;
corners off by 0.1 to 0.2 px; lenses that no five terms describe). 25 instants calibrate, 15 others
judge: every camera finds the boards in noisy images through its own calibrated lens and places
their points in the robot's base, the one in the hand through the reported pose and the map.

    cameras_mm          these points from where they really are in the real arm's base, RMS over
                        all cameras; the arm's joints are known, as a UR reports them
    cameras_poses_mm    the same from poses alone; an error that the arm makes everywhere turns and
                        shifts the whole lab, which no camera can see ...
    cameras_tied_mm     ... with that one rigid motion, common to all cameras and instants, out
    wrist_mm_N          poses alone, N cameras: the board on the table as the camera in the hand
                        sees it, from where the calibration expects it
    cameras_monotone    1: with each camera more, that error does not grow beyond chance (its mean
                        logarithm over the labs by less than two standard errors, and 1 %)
    coverage95_*        share of the stated 95 % regions that hold the truth: X of the camera in
                        the hand, of the fixed ones (absolute), of their pairs
    bad_arm_named       an instant whose reported pose is off by 2 cm is named, and costs nothing

What was chosen was chosen on labs 1000 to 1009; labs 0 to 9 were seen once before the covariance
was jackknifed in every case. Nothing was chosen on any other lab.
"""

import argparse
import multiprocessing
import os
import time
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace

import blas_threads  # noqa: F401
import numpy as np
from calibration_cameras_lab import HELD, NAMES, TABLE, UR3, Lab
from calibration_real import shaped
from figures import Figure, Found, Goal, median_of, run
from scipy.stats import chi2

from realsim.arrays import Array
from realsim.geometry import se3
from realsim.records import ArmErrorMap, RobotErrorMap
from realsim_calibration.cameras.calibrate import calibrate_cameras
from realsim_calibration.cameras.results import CamerasReport
from realsim_calibration.fit.view_system import planar_poses

PACKAGES = ("realsim", "numpy", "scipy", "numba", "opencv-python-headless")
VIEWS, HELD_OUT = 25, 15
LIMIT = float(chi2.ppf(0.95, 6))
LABS, QUICK_LABS = 40, 2
WORTH = 0.01
"""A change of the wrist's error by this share is none."""
ONE = Goal(low=1.0, high=1.0)
FIGURES = {
    "cameras_mm": Figure(unit="mm", goal=Goal(high=0.6)),
    "cameras_monotone": Figure(unit="", goal=ONE),
    "cameras_poses_mm": Figure(unit="mm"),
    "cameras_tied_mm": Figure(unit="mm", goal=Goal(high=0.6)),
    "cameras_tied_joints_mm": Figure(unit="mm", goal=Goal(high=0.6)),
    **{f"wrist_mm_{n}": Figure(unit="mm") for n in range(1, len(NAMES) + 1)},
    "coverage95_wrist": Figure(unit=""),
    "coverage95_fixed": Figure(unit=""),
    "coverage95_pairs": Figure(unit=""),
    "coverage95_wrist_poses": Figure(unit=""),
    "coverage95_fixed_poses": Figure(unit=""),
    "coverage95_pairs_poses": Figure(unit=""),
    "bad_arm_named": Figure(unit="", goal=ONE),
    "cameras_cpu_s": Figure(unit="s"),
}


@dataclass(frozen=True, kw_only=True, slots=True)
class Judged:
    """What a calibration is worth on instants that it has not seen [mm]."""

    absolute: float
    tied: float
    wrist: float


def hand_of(r: CamerasReport, told: Array, joints: Array) -> Array:
    """Return where the calibration says the hand is (4, 4)."""
    if isinstance(r.robot_map, ArmErrorMap):
        return r.robot_map.corrected(told, joints)
    return told if not isinstance(r.robot_map, RobotErrorMap) else r.robot_map.corrected(told)


def judge(lab: Lab, r: CamerasReport, seed: int) -> Judged:
    """Return the errors at instants of the same lab that were not calibrated with."""
    lab.rng = np.random.default_rng([seed, 1])
    names = [c.name for c in r.rig.cameras]
    shapes = {id(own.target): own.board for own in r.cameras}
    seen: list[Array] = []
    true: list[Array] = []
    wrist: list[float] = []
    for q in lab.joints(HELD_OUT):
        hand, told = lab.arm.pose(q, lab.rng), UR3.forward(q)
        for c, eye in enumerate(lab.eyes):
            for b, board in ((0, TABLE), (1, HELD)):
                noise = lab.rng.normal(scale=lab.pixel, size=(len(board.points_board), 2))
                uv = lab.sight(c, b, hand)
                if eye.name not in names or uv is None or (c == 0 and b == 1):
                    continue
                own = r.cameras[names.index(eye.name)]
                shape = shapes.get(id(board))
                if shape is None:
                    continue
                ok = np.isfinite(uv[:, 0])
                points = shaped(shape, board.points_board)
                T = planar_poses(points[ok], (uv + noise)[ok], own.intrinsics,
                                 board.points_board[ok])[0][1]  # fmt: skip
                at = hand_of(r, told, q) if c == 0 else np.eye(4)
                seen.append(se3.transform(at @ own.X @ T, points))
                truth = hand @ lab.held if b else lab.table
                true.append(se3.transform(truth, lab.prints[b]))
                Z = r.boards[b]
                if c == 0 and Z is not None:
                    off = se3.transform(Z, points) - seen[-1]
                    wrist.append(float(np.mean(np.sum(off**2, -1))))
    p, t = np.concatenate(seen), np.concatenate(true)
    U, _, Vt = np.linalg.svd((p - p.mean(0)).T @ (t - t.mean(0)))
    R = (U @ np.diag([1.0, 1.0, np.linalg.det(U @ Vt)]) @ Vt).T
    tied = (p - p.mean(0)) @ R.T + t.mean(0)
    return Judged(
        absolute=_rms_mm(p - t), tied=_rms_mm(tied - t), wrist=1e3 * float(np.sqrt(np.mean(wrist)))
    )


def _rms_mm(off: Array) -> float:
    return 1e3 * float(np.sqrt(np.mean(np.sum(off**2, -1))))


def misfits(lab: Lab, r: CamerasReport) -> tuple[list[float], list[float]]:
    """Return chi^2 of 6 of every camera's place and of every pair of fixed cameras."""

    def normalized(truth: Array, found: Array, covariance: Array) -> float:
        e = se3.log(se3.invert(truth) @ found)
        return float(e @ np.linalg.solve(covariance, e))

    places = {eye.name: eye.place for eye in lab.eyes}
    own = [
        normalized(places[c.name], one.X, one.X_covariance)
        for c, one in zip(r.rig.cameras, r.cameras, strict=True)
    ]
    pairs = [
        normalized(se3.invert(places[a]) @ places[b], p.T_a_b, p.covariance)
        for p in r.pairs
        for a, b in [p.names]
        if "wrist" not in p.names
    ]
    return own, pairs


@dataclass(frozen=True, kw_only=True, slots=True)
class Trial:
    """One lab."""

    seed: int
    joints: Judged
    poses: Judged
    wrist: list[float]
    """Wrist's held-out error with 1, 2, ... cameras [mm]."""
    chi2: tuple[list[float], list[float]]
    chi2_poses: tuple[list[float], list[float]]
    bad_arm: bool
    cpu_s: float
    map_name: str


def trial(seed: int) -> Trial:
    """Return one lab's figures."""
    lab = Lab(seed)
    state = lab.rng.bit_generator.state

    def rig(cameras: tuple[str, ...], *, joints: bool) -> CamerasReport:
        lab.rng = np.random.default_rng()
        lab.rng.bit_generator.state = state
        return calibrate_cameras(lab.rig(VIEWS, cameras, with_joints=joints)[0], arm=UR3)

    begin = time.process_time()
    known = rig(NAMES, joints=True)
    cpu = time.process_time() - begin
    fewer = [rig(NAMES[:n], joints=False) for n in range(1, len(NAMES))]
    plain = rig(NAMES, joints=False)
    judged = judge(lab, plain, seed)
    wrist = [*(judge(lab, r, seed).wrist for r in fewer), judged.wrist]
    own, pairs = misfits(lab, known)
    own_poses, pairs_poses = misfits(lab, plain)
    return Trial(
        seed=seed, joints=judge(lab, known, seed), poses=judged, wrist=wrist, chi2=(own, pairs),
        chi2_poses=(own_poses, pairs_poses), bad_arm=_bad_arm(seed, judged.tied), cpu_s=cpu,
        map_name=plain.map_name,
    )  # fmt: skip


def _bad_arm(seed: int, clean_mm: float) -> bool:
    """Return whether a wrong pose of one instant is named and does no harm."""
    lab = Lab(seed)
    given, _ = lab.rig(VIEWS)
    at = next(
        i for i in range(VIEWS) if sum(s.instant == i and s.board == 1 for s in given.sightings) > 1
    )
    instants = list(given.instants)
    T = instants[at].T_base_ee
    assert T is not None
    instants[at] = replace(instants[at], T_base_ee=T @ se3.from_translation([0.02, 0.0, 0.0]))
    r = calibrate_cameras(replace(given, instants=tuple(instants)))
    harmless = judge(lab, r, seed).tied < 1.5 * clean_mm
    return r.bad_arm == (instants[at].name,) and harmless


def measure(a: argparse.Namespace) -> Found:
    """Measure labs of seeds from the one given on."""
    found = Found()
    count = a.labs or (QUICK_LABS if a.quick else LABS)
    seeds = range(a.seed, a.seed + count)
    with ProcessPoolExecutor(a.workers, mp_context=multiprocessing.get_context("spawn")) as pool:
        trials = list(pool.map(trial, seeds))
    over = f"median of {count} labs, {HELD_OUT} held-out instants"
    found.add("cameras_mm", median_of([t.joints.absolute for t in trials]), over)
    found.add("cameras_tied_joints_mm", median_of([t.joints.tied for t in trials]), over)
    found.add("cameras_poses_mm", median_of([t.poses.absolute for t in trials]), over)
    found.add("cameras_tied_mm", median_of([t.poses.tied for t in trials]), over)
    wrist = np.array([t.wrist for t in trials])
    for n in range(len(NAMES)):
        found.add(f"wrist_mm_{n + 1}", median_of(wrist[:, n].tolist()), f"{n + 1} cameras")
    steps = np.diff(np.log(wrist), axis=1)
    error = steps.std(axis=0, ddof=1) / np.sqrt(count) if count > 1 else np.full(3, np.inf)
    worse = steps.mean(0) - 2 * error > np.log(1 + WORTH)
    found.add("cameras_monotone", float(not worse.any()),
              "mean change a camera "
              + ", ".join(f"{100 * s:+.1f} +-{100 * e:.1f} %"
                          for s, e in zip(steps.mean(0), error, strict=True)))  # fmt: skip
    for name, part in (("", [t.chi2 for t in trials]), ("_poses", [t.chi2_poses for t in trials])):
        own, pairs = np.array([c[0] for c in part]), np.array([c[1] for c in part])
        found.add(f"coverage95_wrist{name}", float(np.mean(own[:, 0] < LIMIT)))
        found.add(f"coverage95_fixed{name}", float(np.mean(own[:, 1:] < LIMIT)))
        found.add(f"coverage95_pairs{name}", float(np.mean(pairs < LIMIT)))
    found.add("bad_arm_named", float(np.mean([t.bad_arm for t in trials])), f"{count} labs")
    found.add("cameras_cpu_s", median_of([t.cpu_s for t in trials]), f"4 cameras, {VIEWS} instants")
    found.cases["labs"] = [
        {"seed": t.seed, "joints_mm": t.joints.absolute, "poses_mm": t.poses.absolute,
         "tied_mm": t.poses.tied, "wrist_mm": t.wrist, "map": t.map_name,
         "chi2": t.chi2, "chi2_poses": t.chi2_poses}
        for t in trials
    ]  # fmt: skip
    return found


def options(parser: argparse.ArgumentParser) -> None:
    """Add the options of this benchmark."""
    parser.add_argument("--labs", type=int, default=0, help="number of labs")
    parser.add_argument("--workers", type=int, default=os.cpu_count() or 1, help="processes")


if __name__ == "__main__":
    run("calibration_cameras", __doc__ or "", PACKAGES, FIGURES, {"labs": measure}, options=options)
