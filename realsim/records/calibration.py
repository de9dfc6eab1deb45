"""What a calibration found: the hand-eye, the robot's error map, the checks with their advice.

By how much a stereo depth camera is wrong, smoothly and everywhere, and how sure that is.

A stereo camera measures a disparity d and reports z = f B / d. A wrong focal length or baseline
scales 1/z, a rectification that is off shifts it:

    1 / z_true = scale / z_measured + offset
"""

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from realsim.arrays import Array
from realsim.errors import InputError
from realsim.geometry import se3
from realsim.geometry.dh import DhArm
from realsim.records.capture import CameraIntrinsics
from realsim.records.checked_arrays import freeze, frozen, rigid
from realsim.untrusted.own_json import Real, Tagged

MAP_FEATURES = 12
"""Features of a pose in an error map: position (3) and rotation matrix (9)."""


def worst_sigmas(covariance: Array) -> tuple[float, float]:
    """Return the largest 1-sigma of translation [mm] and rotation [deg] of a covariance (6, 6)."""
    mm = float(1e3 * np.sqrt(np.linalg.eigvalsh(covariance[3:, 3:])[-1]))
    return mm, float(np.degrees(np.sqrt(np.linalg.eigvalsh(covariance[:3, :3])[-1])))


@dataclass(frozen=True, kw_only=True, slots=True)
class Check:
    """One thing that was looked at, what was found, and what to do about it."""

    name: str
    """Short, the same for every run: "board scale"."""
    verdict: Literal["good", "warn", "bad", "unknown"]
    sentence: str
    """What was found, with the figures."""
    advice: str = ""
    """What to do; empty where the verdict is good."""
    value: Real = float("nan")
    """The figure that was judged; NaN where there is none."""
    unit: str = ""
    views: tuple[int, ...] = ()
    """Views that the check names."""

    @property
    def words(self) -> str:
        """Return what was found and what to do about it."""
        return f"{self.sentence} {self.advice}".strip()


def worst_first(checks: Sequence[Check]) -> list[Check]:
    """Return checks, worst first, else in their own order."""
    order = ("bad", "warn", "unknown", "good")
    return sorted(checks, key=lambda c: order.index(c.verdict))


class RobotMap(Tagged):
    """A robot's error: a RobotErrorMap or an ArmErrorMap."""

    __slots__ = ()


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class RobotErrorMap(RobotMap):
    """The robot's pose error as a linear function of its pose: T_true = T Exp(B(T) W).

    B(T) W = W phi(T) ("ee": error in the axes of the tool) or R^T W phi(T) for both halves ("base":
    in the axes of the base), phi = [(p - mean_p) / sd_p, vec(R) - mean_R]. It is an interpolator:
    beyond the poses it was fitted on it is a guess.
    """

    kind: Literal["pose map"] = "pose map"
    frame: Literal["ee", "base"]
    mean: Array
    """(12,) mean of position [m] and of the rotation matrix, row by row."""
    sd_m: Real
    """Spread of the positions, the same for all three axes [m]."""
    weights: Array
    """(6, 12) W, rotation first [rad, m per unit feature]."""
    reach: Array
    """(views, 12) features of the poses it was fitted on."""

    def __post_init__(self) -> None:
        """Freeze the arrays."""
        n = MAP_FEATURES
        freeze(self, mean=(n,), weights=(6, n), reach=(None, n))

    def features(self, T: ArrayLike) -> Array:
        """Return phi (..., 12) of robot poses (..., 4, 4)."""
        T = np.asarray(T, dtype=np.float64)
        raw = np.concatenate([T[..., :3, 3], T[..., :3, :3].reshape(*T.shape[:-2], 9)], -1)
        return (raw - self.mean) / np.array([self.sd_m] * 3 + [1.0] * 9)

    def twist(self, T: ArrayLike) -> Array:
        """Return the error (..., 6) right of robot poses (..., 4, 4), rotation first [rad, m]."""
        T = np.asarray(T, dtype=np.float64)
        error = self.features(T) @ self.weights.T
        if self.frame == "ee":
            return error
        to_tool = np.swapaxes(T[..., :3, :3], -1, -2)
        halves = [(to_tool @ error[..., h, None])[..., 0] for h in (slice(0, 3), slice(3, 6))]
        return np.concatenate(halves, -1)

    def corrected(self, T: ArrayLike) -> Array:
        """Return where the robot really is, T Exp(B(T) W) (..., 4, 4)."""
        return np.asarray(T, dtype=np.float64) @ se3.exp(self.twist(T))

    def beyond(self, T: ArrayLike) -> Array:
        """Return how far poses (..., 4, 4) lie from the nearest fitted one, in spreads of those.

        1 is the largest distance that a fitted pose has to its own nearest neighbour: beyond about
        2 the map is a guess.
        """
        phi = self.features(T)
        between = np.linalg.norm(self.reach[:, None] - self.reach[None], axis=-1)
        np.fill_diagonal(between, np.inf)
        usual = float(between.min(1).max())
        away = np.linalg.norm(phi[..., None, :] - self.reach, axis=-1).min(-1)
        return away / max(usual, 1e-9)


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class ArmErrorMap(RobotMap):
    """The robot's error as errors of its arm's Denavit-Hartenberg numbers; needs the joints."""

    kind: Literal["arm"] = "arm"
    arm: DhArm
    """The arm as it is said to be."""
    errors: Array
    """(4 n,) to be added to its theta, alpha [rad], a, d [m], n of each."""
    T_flange_tool: Array
    """(4, 4) the controller's tool frame in the flange [m]."""

    def __post_init__(self) -> None:
        """Freeze the arrays, and keep of an arm its numbers alone."""
        object.__setattr__(self, "arm", self.arm.bare())
        freeze(self, errors=(4 * self.arm.joints,))
        object.__setattr__(self, "T_flange_tool", rigid(self.T_flange_tool, "T_flange_tool"))

    def corrected(self, T: ArrayLike, joints: ArrayLike) -> Array:
        """Return where the robot really is (..., 4, 4) at poses (..., 4, 4) and joints (..., n)."""
        moved = se3.invert(self.arm.forward(joints)) @ self.arm.corrected(self.errors).forward(
            joints
        )
        G = self.T_flange_tool
        return np.asarray(T, dtype=np.float64) @ se3.invert(G) @ moved @ G


if TYPE_CHECKING:
    AnyRobotMap = RobotErrorMap | ArmErrorMap
else:  # what a file is read as: its word tells which
    AnyRobotMap = RobotMap


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class HandEye:
    """A hand-eye calibration: the camera in the hand, and everything that says how good it is."""

    T_ee_cam: Array
    """(4, 4) camera in the controller's tool frame [m]."""
    covariance: Array
    """(6, 6) of the right perturbation of T_ee_cam, rotation first [rad, m]: absolute, with what
    the arm may be off by everywhere."""
    T_base_board: Array
    """(4, 4) board in base [m]."""
    intrinsics: CameraIntrinsics
    """The camera as calibrated together with the hand-eye."""
    intrinsics_sd: Array
    """(4 + 8,) 1-sigma of fx fy cx cy [px] and of the 8 distortion terms (0 = held fixed)."""
    view_indices: tuple[int, ...]
    """Views used."""
    view_rms_px: Array
    """(views used,) reprojection RMS of each view through the robot pose [px]."""
    held_out_px: Real
    """RMS of views predicted by a fit without them, through the robot pose [px]."""
    rejected: tuple[tuple[int, str], ...] = ()
    """(view, reason) of every view that was not used."""
    method: str = ""
    starts: tuple[tuple[str, Real], ...] = ()
    """(closed form, its reprojection RMS [px]) of every start tried."""
    robot_map: AnyRobotMap | None = None
    """The robot's error map that belongs to T_ee_cam; None = the controller's poses are taken as
    they are."""
    checks: tuple[Check, ...] = ()
    """Everything that was checked, with verdict and advice."""
    here_covariance: Array | None = None
    """(6, 6) of the camera's place for this arm as it moves at the calibrated poses: what the arm
    is off by everywhere cancels. None = not estimated."""

    def __post_init__(self) -> None:
        """Check that the poses are rigid and freeze the arrays."""
        object.__setattr__(self, "T_ee_cam", rigid(self.T_ee_cam, "T_ee_cam"))
        object.__setattr__(self, "T_base_board", rigid(self.T_base_board, "T_base_board"))
        freeze(self, covariance=(6, 6), intrinsics_sd=(12,), view_rms_px=(None,))
        freeze(self, here_covariance=(6, 6))

    @property
    def sigma_deg(self) -> float:
        """Largest 1-sigma of the rotation about any axis, absolute [deg]."""
        return worst_sigmas(self.covariance)[1]

    @property
    def sigma_mm(self) -> float:
        """Largest 1-sigma of the translation along any axis, absolute [mm]."""
        return worst_sigmas(self.covariance)[0]

    @property
    def here_sigmas(self) -> tuple[float, float]:
        """Largest 1-sigma [mm], [deg] for this arm as it moves here; absolute where unknown."""
        known = self.here_covariance
        return worst_sigmas(self.covariance if known is None else known)

    def camera_poses(self, Ts_base_ee: ArrayLike, joints: ArrayLike | None = None) -> Array:
        """Return T_base_cam (..., 4, 4) [m] at the controller's poses (..., 4, 4).

        Args:
            Ts_base_ee: the controller's poses [m].
            joints: (..., n) joint angles [rad]; needed where the robot's error is one of its arm.

        Raises:
            InputError: the robot's error map needs joints and there are none.
        """
        T = np.asarray(Ts_base_ee, dtype=np.float64)
        if isinstance(self.robot_map, RobotErrorMap):
            T = self.robot_map.corrected(T)
        elif isinstance(self.robot_map, ArmErrorMap):
            if joints is None:
                raise InputError(
                    "the hand-eye calibration corrects errors of the arm's joints and links, so "
                    "joint angles are needed for a camera pose. Give them, or calibrate without."
                )
            T = self.robot_map.corrected(T, joints)
        return T @ self.T_ee_cam


LARGEST_SCALE_ERROR = 0.5
"""A camera that is wrong by half has another fault (its unit, its resolution) than a bias."""


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class DepthBias:
    """1 / z_true = scale / z_measured + offset_per_m, with its covariance."""

    scale: float = 1.0
    """(f B) that the camera assumes over the true one."""
    offset_per_m: float = 0.0
    """Offset of the inverse depth [1/m]; a disparity that is too large makes it negative."""
    covariance: Array = field(default_factory=lambda: np.zeros((2, 2)))
    """(2, 2) of (scale, offset_per_m); zero = taken for exact."""
    noise_per_m: Real = float("nan")
    """k of one pixel's noise sigma_z = k z^2 [1/m]; NaN = not measured."""
    range_m: tuple[Real, Real] = (0.0, float("inf"))
    """Distances at which it was measured [m]; beyond them it is extrapolated."""
    separable: bool = True
    """Whether scale and offset were told apart; if not, only their sum at the middle distance is
    known, and the covariance is long in one direction."""

    def __post_init__(self) -> None:
        """Check the ranges and freeze the covariance."""
        if not abs(self.scale - 1.0) <= LARGEST_SCALE_ERROR:
            raise InputError(
                f"the depth scale is {self.scale}; between {1 - LARGEST_SCALE_ERROR:g} and "
                f"{1 + LARGEST_SCALE_ERROR:g} is accepted. A larger one is a wrong depth unit."
            )
        if not np.isfinite(self.offset_per_m):
            raise InputError(f"the inverse depth offset is {self.offset_per_m}; it must be finite.")
        if not 0.0 <= self.range_m[0] < self.range_m[1]:
            raise InputError(f"the range of distances {self.range_m} m is empty.")
        C = frozen(self.covariance, np.float64, (2, 2), "covariance of the depth bias")
        if not np.all(np.isfinite(C)) or np.linalg.eigvalsh(C)[0] < -1e-12:
            raise InputError(f"the depth bias' covariance {C.tolist()} has a negative variance.")
        object.__setattr__(self, "covariance", C)

    @classmethod
    def none(cls) -> "DepthBias":
        """Return the bias of a camera whose depth is taken as it is."""
        return cls()

    @classmethod
    def unmeasured(cls, scale_sd: float = 0.005, offset_sd_per_m: float = 0.0086) -> "DepthBias":
        """Return what is known of a camera that was not measured: no bias, with these 1-sigmas.

        The defaults are 0.5 % and 0.1 px of disparity of a RealSense D405 (f = 648 px, 18 mm).
        """
        return cls(covariance=np.diag([scale_sd**2, offset_sd_per_m**2]), separable=False)

    @property
    def is_none(self) -> bool:
        """Whether depth is taken as it is; what is known of the bias may still be uncertain."""
        return self.scale == 1.0 and self.offset_per_m == 0.0

    def corrected(self, depth_m: ArrayLike) -> NDArray[np.floating]:
        """Return the true depth of measured depth, any shape [m]; 0 and NaN stay what they are.

        float32 stays float32. Where the correction has no positive depth, 0 is returned.
        """
        z = np.asarray(depth_m)
        z = z if z.dtype == np.float32 else z.astype(np.float64)
        bottom = self.scale + self.offset_per_m * z
        # Written so that NaN, which is no measurement, stays NaN.
        fine = ~(bottom <= 0)
        return np.where(fine, z / np.where(fine, bottom, 1), 0).astype(z.dtype)

    def measured(self, depth_m: ArrayLike) -> Array:
        """Return what the camera reports for true depth, any shape [m]; inverse of `corrected`."""
        z = np.asarray(depth_m, dtype=np.float64)
        bottom = 1.0 - self.offset_per_m * z
        fine = ~(bottom <= 0)
        return np.where(fine, self.scale * z / np.where(fine, bottom, 1.0), 0.0)

    def bias_m(self, depth_m: ArrayLike) -> Array:
        """Return measured minus true depth at measured depths, any shape [m]."""
        z = np.asarray(depth_m, dtype=np.float64)
        return z - self.corrected(z)

    def sigma_m(self, depth_m: ArrayLike) -> Array:
        """Return the 1-sigma of corrected depth that comes from this bias, at measured depths [m].

        It is common to all pixels: it does not average out. d z_true = -z_true^2 (da / z + db).
        """
        z = np.asarray(depth_m, dtype=np.float64)
        known = z > 0
        inverse = 1.0 / np.where(known, z, 1.0)
        C = self.covariance
        variance = C[0, 0] * inverse**2 + 2 * C[0, 1] * inverse + C[1, 1]
        true = self.corrected(z)
        return np.where(known, true**2 * np.sqrt(np.maximum(variance, 0.0)), 0.0)

    def disparity_px(self, focal_px: float, baseline_m: float) -> float:
        """Return by how much the measured disparity is too large, the scale set aside [px]."""
        return -self.offset_per_m / self.scale * focal_px * baseline_m
