"""Whether a camera still sits where it was calibrated: from cameras that a registration refined.

A registration moves every camera to where the objects are seen best. Were the calibration right,
these moves would be the arm's noise; a camera that slipped by D in the hand shows as

    claimed_i D = G refined_i

with one D for all views. G, where the objects' frame lies, is free: no object pose is needed to be
known, only that the objects stood still. It is a hand-eye problem whose hand is the claimed camera.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from realsim.arrays import Array
from realsim.errors import InputError
from realsim.geometry import se3
from realsim.records.calibration import worst_sigmas
from realsim_calibration.pairs.noise import Noise, RobotParts, estimate_noise, linearise, solve
from realsim_calibration.pairs.solve import jackknifed

STEPS = 4
"""Steps of the least squares: a slip is small, two are enough."""
LOOSE = 0.1
"""Prior 1-sigma of slip and frame [rad, m]: holds what a short scan does not determine."""
CHANCE = 1e-3
"""A camera that did not move is called moved with this probability at most."""
MIN_VIEWS = 5
"""Fewest refined views: two frames are 12 unknowns, a view has 6 numbers."""


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Drift:
    """How far the camera seems to have moved in the hand since it was calibrated."""

    twist: Array
    """(6,) T_ee_cam_now = T_ee_cam Exp(twist), rotation first [rad, m]."""
    covariance: Array
    """(6, 6) of it."""
    shift_mm: float
    """What it moves the objects by in the camera, at their distance [mm]."""
    sigma_mm: float
    """1-sigma of that [mm]."""
    chance: float
    """Probability of as much if the camera did not move."""
    moved: bool
    views: int

    @property
    def mm(self) -> float:
        """Length of the translation [mm]."""
        return float(1e3 * np.linalg.norm(self.twist[3:]))

    @property
    def deg(self) -> float:
        """Angle of the rotation [deg]."""
        return float(np.degrees(np.linalg.norm(self.twist[:3])))

    @property
    def sigmas(self) -> tuple[float, float]:
        """Largest 1-sigma along any axis: rotation [deg], translation [mm]."""
        mm, deg = worst_sigmas(self.covariance)
        return deg, mm


def estimate_drift(
    claimed: ArrayLike, refined: ArrayLike, distance_m: float, tolerance_mm: float = 1.0
) -> Drift:
    """Return how far the camera moved in the hand.

    Args:
        claimed: (n, 4, 4) T_world_cam by robot and calibration [m].
        refined: (n, 4, 4) T_world_cam by the registered objects [m].
        distance_m: of the objects from the camera [m].
        tolerance_mm: moves that shift the objects in the camera by less are of no matter [mm].

    Raises:
        InputError: too few views.
    """
    from scipy.stats import f as fisher

    A, C = np.asarray(claimed, dtype=np.float64), np.asarray(refined, dtype=np.float64)
    if len(A) != len(C) or len(A) < MIN_VIEWS:
        raise InputError(
            f"drift: {len(A)} claimed and {len(C)} refined cameras; at least {MIN_VIEWS} "
            "views with both are needed. Register a scene with more views (12 are advised)."
        )
    seen = se3.invert(C)
    # Residuals are taken at the objects, not at the origin of the world.
    ahead = se3.from_translation([0.0, 0.0, distance_m])
    middle = (C @ ahead)[:, :3, 3].mean(0)
    seen = seen @ se3.from_translation(middle)
    X, Z = np.eye(4), se3.from_translation(middle)
    linear = linearise(A, seen, X, Z, to_hand=False)
    parts = RobotParts()
    noise, _ = estimate_noise(linear, Noise.start("axes", parts), parts)
    prior = np.eye(12) / LOOSE**2
    solved = solve(linear, noise, parts)
    for k in range(STEPS):
        solved = solve(linear, noise, parts)
        at = np.concatenate([se3.log(X), se3.log(se3.invert(se3.from_translation(middle)) @ Z)])
        # The prior pulls towards no move; its share of the step is that of its information.
        H = solved.information + prior
        step = np.linalg.solve(H, solved.information @ solved.step - prior @ at)
        X, Z = X @ se3.exp(step[:6]), Z @ se3.exp(step[6:])
        linear = linearise(A, seen, X, Z, to_hand=False)
        if k == 0:
            noise, _ = estimate_noise(linear, noise, parts)
    ratio = float(np.trace(jackknifed(solved)) / np.trace(solved.covariance))
    inverse = np.asarray(np.linalg.inv(solved.information + prior), dtype=np.float64)
    covariance = inverse[:6, :6] * ratio
    twist = se3.log(X)
    freedom = 6 * len(A) - 12
    distance = float(twist @ np.linalg.solve(covariance, twist)) / 6
    chance = float(fisher.sf(distance, 6, freedom))
    lever = np.concatenate([-se3.hat([0.0, 0.0, distance_m]), np.eye(3)], 1)
    shift = lever @ twist
    spread = lever @ covariance @ lever.T
    shift_mm = float(1e3 * np.linalg.norm(shift))
    along = shift / max(float(np.linalg.norm(shift)), 1e-12)
    return Drift(
        twist=twist, covariance=covariance, shift_mm=shift_mm,
        sigma_mm=float(1e3 * np.sqrt(along @ spread @ along)), chance=chance,
        moved=chance < CHANCE and shift_mm > tolerance_mm, views=len(A),
    )  # fmt: skip
