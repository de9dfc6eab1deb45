"""What a robot's pose error may look like: bases of smooth errors, weighted by a ridge.

The controller's pose is off by e_i = B_i w + noise (right twist, rotation first). A basis holds the
error of every view per prior standard deviation of each weight:

    ee, base   linear in the pose's features, in tool or base axes: needs no joints (RobotErrorMap)
    arm        errors of the arm's 4 n Denavit-Hartenberg numbers: needs joints (ArmErrorMap)
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from realsim.arrays import Array
from realsim.geometry import se3
from realsim.geometry.dh import DH_NUMBERS, DhArm
from realsim.records import ArmErrorMap, RobotErrorMap
from realsim.records.calibration import MAP_FEATURES

LEAST_SPREAD_M = 1e-4
"""Positions that differ by less carry no feature."""
MIN_ARM_VIEWS = 6
"""Fewer poses do not tell one arm from another."""
ARM_ANGLE_SD = 2e-4
"""Error of a joint zero or twist [rad]: 0.1-0.3 mm at the tool is left after a factory
calibration; re-estimated from the views (`scales`)."""
ARM_LENGTH_SD = 1e-4
"""Error of a link length [m]; re-estimated likewise."""
ARM_FIT_M = 0.01
"""An arm is the robot's when its nominal kinematics place the tool this well [m]: real arms
differ from nominal by 1 to 3 mm."""
ARM_MARGIN = 3.0
"""It must place it this many times better than any other arm."""


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class ErrorBasis:
    """A candidate for the smooth part of the robot's error."""

    name: str
    """"ee 0.3", "base 0.1", "arm"."""
    kind: Literal["ee", "base", "arm"]
    columns: Array
    """(views, 6, p) right twist per prior standard deviation."""
    unit: Array
    """(p,) one standard deviation of each weight [rad or m (per unit feature)]."""
    T_flange_tool: Array | None = None
    """(4, 4) of an arm basis."""

    def scaled(self, factors: Array) -> "ErrorBasis":
        """Return the basis with its prior standard deviations multiplied by (p,) factors."""
        return replace(self, columns=self.columns * factors, unit=self.unit * factors)


def pose_features(Ts: Array) -> tuple[Array, Array, float]:
    """Return centred features (views, 12), their mean (12,), and the spread of the positions [m].

    The positions share one spread, so that the features turn and move with the base frame.
    """
    raw = np.concatenate([Ts[:, :3, 3], Ts[:, :3, :3].reshape(-1, 9)], axis=1)
    mean = raw.mean(0)
    spread = float(np.sqrt(np.mean(np.sum((raw[:, :3] - mean[:3]) ** 2, -1)) / 3))
    spread = max(spread, LEAST_SPREAD_M)
    return (raw - mean) / np.array([spread] * 3 + [1.0] * 9), mean, spread


def map_basis(Ts: Array, kind: Literal["ee", "base"], strength: float, unit: float) -> ErrorBasis:
    """Return the basis of a RobotErrorMap over controller poses (views, 4, 4).

    Weights are numbered row by row: (rotation x, y, z, translation x, y, z) x 12 features.
    """
    phi, _, _ = pose_features(Ts)
    columns = np.einsum("rs,nf->nrsf", np.eye(6), phi)
    if kind == "base":
        turn = np.zeros((len(Ts), 6, 6))
        turn[:, :3, :3] = turn[:, 3:, 3:] = np.swapaxes(Ts[:, :3, :3], 1, 2)
        columns = np.einsum("nrs,nf->nrsf", turn, phi)
    size = 6 * MAP_FEATURES
    return ErrorBasis(
        name=f"{kind} {strength:g}",
        kind=kind,
        columns=columns.reshape(len(Ts), 6, size) * strength * unit,
        unit=np.full(size, strength * unit),
    )


def arm_basis(
    arm: DhArm, joints: Array, Ts: Array,
    angle_sd: float = ARM_ANGLE_SD, length_sd: float = ARM_LENGTH_SD,
) -> ErrorBasis:  # fmt: skip
    """Return the basis of errors of an arm at joints (views, n) and controller poses (views, 4, 4).

    The controller's tool frame may stand off the flange: that constant is taken from the poses.
    """
    G = tool_in_flange(arm, joints, Ts)
    to_tool = se3.adjoint(se3.invert(G))
    # Of an arm's 4 n errors the first half are angles, the others lengths.
    unit = np.repeat([angle_sd, length_sd], 2 * arm.joints)
    columns = to_tool @ arm.error_basis(joints) * unit
    return ErrorBasis(name="arm", kind="arm", columns=columns, unit=unit, T_flange_tool=G)


def tool_in_flange(arm: DhArm, joints: Array, Ts: Array) -> Array:
    """Return the mean tool frame in the flange (4, 4) of controller poses at joints [m]."""
    off = se3.invert(arm.forward(joints)) @ Ts
    return se3.from_rt(se3.mean_rotation(off[:, :3, :3]), np.median(off[:, :3, 3], axis=0))


def matching_arm(joints: Array, Ts: Array, arms: Sequence[DhArm]) -> DhArm | None:
    """Return the arm whose kinematics explain the controller's poses, None where none does.

    The tool may stand anywhere on the flange, and the base may be turned: an arm fits when its
    flange and the poses differ by two constants, better than any other by far. Arms of the same
    numbers count as one, the first.
    """
    alike = [arm for arm in arms if arm.joints == joints.shape[-1]]
    if not alike or len(joints) < MIN_ARM_VIEWS:
        return None
    misfits = sorted(
        ((arm_misfit_m(arm, joints, Ts), arm) for arm in alike), key=lambda pair: pair[0]
    )
    least, best = misfits[0]
    rest = min((m for m, arm in misfits[1:] if not _same_numbers(arm, best)), default=np.inf)
    return best if least < ARM_FIT_M and rest > ARM_MARGIN * least else None


def _same_numbers(first: DhArm, second: DhArm) -> bool:
    """Return whether two arms' DH numbers are the same; base and flange do not tell them apart."""
    return all(
        np.allclose(getattr(first, name), getattr(second, name), atol=1e-6) for name in DH_NUMBERS
    )


def arm_misfit_m(arm: DhArm, joints: Array, Ts: Array) -> float:
    """Return the RMS distance [m] of the tool from flange times a constant tool."""
    off = arm.forward(joints) @ tool_in_flange(arm, joints, Ts)
    return float(np.sqrt(np.mean(np.sum((off[:, :3, 3] - Ts[:, :3, 3]) ** 2, -1))))


def map_record(
    basis: ErrorBasis, weights: Array, Ts: Array, arm: DhArm | None
) -> RobotErrorMap | ArmErrorMap:
    """Return the map of fitted weights (p,) in prior standard deviations."""
    if basis.kind == "arm":
        assert arm is not None and basis.T_flange_tool is not None
        return ArmErrorMap(arm=arm, errors=weights * basis.unit, T_flange_tool=basis.T_flange_tool)
    phi, mean, spread = pose_features(Ts)
    return RobotErrorMap(
        frame=basis.kind,
        mean=mean,
        sd_m=spread,
        weights=(weights * basis.unit).reshape(6, MAP_FEATURES),
        reach=phi,
    )
