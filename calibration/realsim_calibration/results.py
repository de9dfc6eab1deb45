"""What a hand-eye calibration says of itself: the estimate, every view, every check."""

from dataclasses import dataclass
from typing import Literal

import numpy as np

from realsim.arrays import Array, Int64
from realsim.errors import InputError
from realsim.geometry import se3
from realsim.records import ArmErrorMap, CameraIntrinsics, Check, HandEye, RobotErrorMap, Target
from realsim.records.calibration import worst_sigmas
from realsim.records.checked_arrays import freeze
from realsim.untrusted.own_json import Real

Mode = Literal["eye_in_hand", "eye_to_hand"]


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class BoardShape:
    """How the printed target differs from its drawing.

    P = middle + s ((x, (1 + a) y, L (w1 x'^2 + w2 x' y' + w3 y'^2))), x' = x / L, y' = y / L, with
    x, y from the middle and L half the longer side.
    """

    scale: float
    """Size relative to the drawing."""
    aspect: float
    """a: the height's scale relative to the width's, less 1."""
    warp: Array
    """(3,) w1, w2, w3: bending along x, twist, bending along y; multiply by L for metres."""
    sd: Array
    """(5,) 1-sigma of scale, aspect, w1, w2, w3 (0 = held)."""
    half_extent_m: float
    """L."""
    half_sides_m: tuple[float, float] | None = None
    """Half the extent of the points along x and y; the larger one is L. None: both are L."""

    @classmethod
    def fitted(cls, target: Target, terms: Array, sd: Array) -> "BoardShape":
        """Return the shape of a print by fitted terms (5,), scale, aspect and warps, and sigmas."""
        x, y, _ = (float(side) / 2 for side in np.ptp(target.points_board, axis=0))
        return cls(
            scale=float(terms[0]), aspect=float(terms[1]), warp=terms[2:], sd=sd,
            half_extent_m=max(x, y), half_sides_m=(x, y),
        )  # fmt: skip

    @property
    def warp_mm(self) -> float:
        """Largest lift of the target's points from their flat drawing [mm]."""
        along = np.linspace(-1, 1, 21)
        sides = self.half_sides_m or (self.half_extent_m, self.half_extent_m)
        x, y = np.meshgrid(*(along * side / self.half_extent_m for side in sides))
        lift = self.warp[0] * x**2 + self.warp[1] * x * y + self.warp[2] * y**2
        return float(1e3 * self.half_extent_m * np.abs(lift).max())


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class ViewReport:
    """One view's part in the calibration."""

    index: int
    label: str
    """File name, or the index."""
    used: bool
    reason: str
    """Why it was not used; empty where it was."""
    T_base_ee: Array
    """(4, 4) as the controller gave it [m]."""
    joints: Array | None
    """(n,) joint angles [rad]; None where they are not known."""
    point_ids: Int64
    """(n,) which points of the target were detected."""
    uv: Array
    """(n, 2) detected points [px]."""
    residuals: Array
    """(n, 2) predicted through the robot's pose minus detected [px]; (0, 2) where not used."""
    seen_px: Real
    """RMS of the residuals [px]; NaN where not used."""
    unseen_px: Real
    """The same, predicted by the fit without this view [px]; NaN where not used."""
    unseen_mm: Real
    """Distance of the board's middle, as the camera alone sees it, from where the fit without this
    view expects it [mm]; NaN where not used."""
    unseen_deg: Real
    """Angle between the two board poses [deg]; NaN where not used."""
    robot_error: Array
    """(6,) estimated robot error right of T_base_ee, map and rest together [rad, m]."""

    def __post_init__(self) -> None:
        """Check that all points are there; freeze the arrays."""
        for name in ("uv", "residuals"):
            object.__setattr__(self, name, np.reshape(getattr(self, name), (-1, 2)))
        freeze(self, T_base_ee=(4, 4), joints=(None,), uv=(len(self.point_ids), 2),
                robot_error=(6,))  # fmt: skip


@dataclass(frozen=True, kw_only=True, slots=True)
class Stretch:
    """How a robot map does beyond the poses it was fitted on: the outermost views held out."""

    views: tuple[int, ...]
    """Which views, by index."""
    map_px: Real
    """RMS with the map, fitted on the others [px]."""
    plain_px: Real
    """RMS without a map [px]."""


@dataclass(frozen=True, kw_only=True, slots=True)
class Clock:
    """The offset between the clocks of arm and camera."""

    offset_s: float
    """A frame stamped t was taken at t - offset_s of the robot's clock [s]."""
    sigma_s: Real
    """Its 1-sigma [s]; NaN where it was given."""
    applied: bool
    """Whether the arm's poses follow it; False where it is too small to matter."""

    @property
    def sentence(self) -> str:
        """The offset in words."""
        ms = f"{1e3 * self.offset_s:+.2f} ms"
        offset = ms if abs(self.offset_s) < 1 else f"{self.offset_s:+.6f} s"
        sigma = f" +-{1e3 * self.sigma_s:.2f} ms" if np.isfinite(self.sigma_s) else ""
        source = "found from the motion" if sigma else "as given"
        follows = "the arm's poses follow it" if self.applied else "too small to matter, left out"
        return f"The camera's clock is {offset}{sigma} ahead of the robot's ({source}; {follows})."


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class HandEyeReport:
    """A hand-eye calibration with its diagnosis.

    X is where the camera sits: T_ee_cam (eye in hand) or T_base_cam (eye to hand). Z is where the
    target sits: T_base_board (eye in hand) or T_ee_board (eye to hand).
    """

    mode: Mode
    target: Target
    X: Array
    """(4, 4) camera in hand or base, to be used WITH the map [m]."""
    X_covariance: Array
    """(6, 6) of the right perturbation of X, rotation first [rad, m]."""
    Z: Array
    """(4, 4) target in base or hand [m]."""
    X_alone: Array
    """(4, 4) the camera's place WITHOUT a map, for tools that know none [m]: of `plain_scores` the
    one that predicts unseen views best."""
    X_alone_covariance: Array
    """(6, 6) of the right perturbation of X_alone [rad, m]."""
    Z_alone: Array
    """(4, 4) the target's place that belongs to X_alone [m]."""
    intrinsics_alone: CameraIntrinsics
    """The camera that belongs to X_alone."""
    X_here: Array | None = None
    """(4, 4) X for this arm as it moves here [m]: what the robot gets wrong everywhere, and what
    its map says on average, is in it. None: not estimated, X stands for it."""
    X_here_covariance: Array | None = None
    """(6, 6) of its right perturbation; X_covariance is absolute: for another arm, a drawing."""
    X_alone_here_covariance: Array | None = None
    """(6, 6) of X_alone, for this arm as it moves here."""
    plain_name: str = "joint"
    """Where X_alone comes from: the chosen one of `plain_scores`."""
    plain_scores: tuple[tuple[str, Real], ...] = ()
    """(candidate for X_alone, RMS of the unseen views without a map [px])."""
    stretch: Stretch | None = None
    """The map beyond its poses; None without a map, or where too few views would be left."""
    intrinsics: CameraIntrinsics
    intrinsics_covariance: Array
    """(12, 12) of fx fy cx cy k1 k2 p1 p2 k3 k4 k5 k6; zero rows = held."""
    board: BoardShape
    robot_map: RobotErrorMap | ArmErrorMap | None
    """None: no map predicts unseen views better than the controller's own poses."""
    map_name: str
    """The chosen one of `map_scores`."""
    map_scores: tuple[tuple[str, float], ...]
    """(candidate, geometric mean of the unseen views' RMS [px]), "none" first."""
    joint_offsets: Array | None
    """(n, 2) joint zero offsets and their 1-sigma [rad] where joints and arm are known. Those of
    the first and the last joint cannot be told from another board or camera place."""
    sigma_px: float
    """Unit-weight standard deviation of a corner coordinate [px]."""
    robot_ratio: float
    """lambda: the robot's share in the error of a view relative to the corners'."""
    views: tuple[ViewReport, ...]
    """Every view that was given, by index."""
    seen_px: float
    """RMS over the used views, through the robot's pose [px]: in-sample."""
    held_out_px: float
    """RMS over the used views, each predicted by a fit without it [px]."""
    held_out_mm: float
    """RMS of unseen_mm [mm]."""
    held_out_deg: float
    """RMS of unseen_deg [deg]."""
    starts: tuple[tuple[str, float], ...]
    """(closed form, its reprojection RMS [px])."""
    mismatch_deg: float
    """Median mismatch of the turns of hand and camera over all pairs, before any gate [deg]."""
    screw_ratio: float
    """Slide of the hand / slide of the camera along the screw axes; NaN = hardly any slide."""
    roll_range_deg: float
    """Range of camera roll about the optical axis [deg]."""
    checks: tuple[Check, ...]
    nominal_lens: bool = False
    """Whether nobody knows the lens: of pose pairs without a camera, px are those of a nominal one.
    """
    T_points_board: Array | None = None
    """(4, 4) the board's frame in that of the target's points [m], where they differ: poses without
    images come with a frame of their own. None: one frame."""
    clock: Clock | None = None
    """How the clocks of arm and camera were brought together; None: they were not looked at."""
    information: Array
    """(29, 29) information about X (6), Z (6), the camera (12) and the board's shape (5: scale,
    aspect, warp) with the robot's map held: for the next best view. What X_covariance has beyond
    its inverse no further view lowers at once: errors of the arm that look like another X."""

    def __post_init__(self) -> None:
        """Check the arrays' shapes and freeze them."""
        freeze(self, X=(4, 4), Z=(4, 4), X_alone=(4, 4), Z_alone=(4, 4), X_covariance=(6, 6),
                X_alone_covariance=(6, 6), intrinsics_covariance=(12, 12), joint_offsets=(None, 2),
                X_here=(4, 4), X_here_covariance=(6, 6), X_alone_here_covariance=(6, 6),
                T_points_board=(4, 4), information=(None, None))  # fmt: skip

    @property
    def Z_points(self) -> Array:
        """(4, 4) the frame of the target's points in base or hand [m]."""
        known = self.T_points_board
        return self.Z if known is None else self.Z @ se3.invert(known)

    @property
    def floor_px(self) -> float:
        """Error that a perfect calibration of this kind would leave, sqrt(seen held-out) [px]."""
        return float(np.sqrt(self.seen_px * self.held_out_px))

    @property
    def used(self) -> tuple[ViewReport, ...]:
        """The views that took part."""
        return tuple(v for v in self.views if v.used)

    @property
    def rejected(self) -> tuple[tuple[int, str], ...]:
        """(index, reason) of the others."""
        return tuple((v.index, v.reason) for v in self.views if not v.used)

    @property
    def warnings(self) -> tuple[str, ...]:
        """The sentence of every check that is not good."""
        return tuple(c.words for c in self.checks if c.verdict in ("warn", "bad"))

    @property
    def sigma_mm(self) -> float:
        """Largest 1-sigma of X's translation along any axis, absolute [mm]."""
        return worst_sigmas(self.X_covariance)[0]

    @property
    def sigma_deg(self) -> float:
        """Largest 1-sigma of X's rotation about any axis, absolute [deg]."""
        return worst_sigmas(self.X_covariance)[1]

    @property
    def here_mm(self) -> float:
        """Largest 1-sigma of the camera's place for this arm as it moves here [mm]."""
        return worst_sigmas(self.place_covariance)[0]

    @property
    def here_deg(self) -> float:
        """Largest 1-sigma of the camera's rotation for this arm as it moves here [deg]."""
        return worst_sigmas(self.place_covariance)[1]

    @property
    def place_covariance(self) -> Array:
        """(6, 6) of the camera's place for this arm as it moves here; absolute where unknown."""
        return self.X_covariance if self.X_here_covariance is None else self.X_here_covariance

    @property
    def hand_eye(self) -> HandEye:
        """The session's record of an eye-in-hand calibration.

        Raises:
            InputError: the camera does not sit in the hand.
        """
        if self.mode != "eye_in_hand":
            raise InputError("a camera that stands still has no place in the hand: use X.")
        return HandEye(
            T_ee_cam=self.X,
            covariance=self.X_covariance,
            here_covariance=self.X_here_covariance,
            T_base_board=self.Z,
            intrinsics=self.intrinsics,
            intrinsics_sd=np.sqrt(np.diag(self.intrinsics_covariance)),
            view_indices=tuple(v.index for v in self.used),
            view_rms_px=np.array([v.seen_px for v in self.used]),
            held_out_px=self.held_out_px,
            rejected=self.rejected,
            method="joint reprojection fit: hand-eye, board and its shape, lens, robot error per "
            "view" + (", robot error map" if self.robot_map is not None else ""),
            starts=self.starts,
            robot_map=self.robot_map,
            checks=self.checks,
        )
