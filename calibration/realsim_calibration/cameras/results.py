"""What the calibration of several cameras says of itself: each camera, each pair, each view.

What a person should know of several cameras calibrated together.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np

from realsim.arrays import Array
from realsim.errors import InputError
from realsim.geometry import se3
from realsim.records import ArmErrorMap, Check, RobotErrorMap
from realsim_calibration.cameras.rig import Rig
from realsim_calibration.lens.observations import named
from realsim_calibration.results import HandEyeReport
from realsim_calibration.views import TargetDetection

ROBOT_BASE = "robot base"
"""`reference` of a report whose cameras an arm ties to the robot."""


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class PairReport:
    """How two cameras stand to each other."""

    names: tuple[str, str]
    together: int
    """Instants at which both see the same board."""
    T_a_b: Array
    """(4, 4) the second camera in the first [m]; of one in the hand at the first instant at which
    the arm's pose is known."""
    covariance: Array
    """(6, 6) of the right perturbation of T_a_b, rotation first [rad, m]."""
    apart_mm: float
    """RMS distance of the board's middle as either camera alone sees it [mm]; NaN = never together.
    """
    worst: str
    """The instant at which they are furthest apart; empty = never together."""

    @property
    def sigma_mm(self) -> float:
        """Largest 1-sigma of the translation along any axis [mm]."""
        return float(1e3 * np.sqrt(np.linalg.eigvalsh(self.covariance[3:, 3:])[-1]))

    @property
    def sigma_deg(self) -> float:
        """Largest 1-sigma of the rotation about any axis [deg]."""
        return float(np.degrees(np.sqrt(np.linalg.eigvalsh(self.covariance[:3, :3])[-1])))


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class SightingReport:
    """One view's part."""

    camera: str
    board: str
    instant: int
    name: str
    """File name of the image, or camera and instant."""
    used: bool
    reason: str
    """Why it was not used; empty where it was."""
    detection: TargetDetection
    """The points as they took part."""
    residuals: Array
    """(n, 2) through the robot's pose and its map [px]; (0, 2) where not used."""
    seen_px: float
    unseen_px: float
    """RMS predicted by the fit without the view's instant [px]; NaN where not used."""
    unseen_mm: float
    """Board's middle as this view alone sees it, from where that fit expects it [mm]."""
    unseen_deg: float
    T_cam_board: Array
    """(4, 4) as this view alone sees it [m]; NaN where not used."""


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class CamerasReport:
    """Several cameras calibrated together."""

    rig: Rig
    """As it was given."""
    reference: str
    """What the fixed cameras' places are in: "robot base", or the camera that stands for it."""
    cameras: tuple[HandEyeReport, ...]
    """Every camera as a calibration of its own, in the order of `rig.cameras`."""
    covariance: Array
    """(6 C, 6 C) of the right perturbations of all X, rotation first [rad, m]."""
    boards: tuple[Array | None, ...]
    """(4, 4) every board in the base or in the tool [m]; None = moved by hand."""
    pairs: tuple[PairReport, ...]
    views: tuple[SightingReport, ...]
    """Every view, in the order of `rig.sightings`."""
    robot_map: RobotErrorMap | ArmErrorMap | None
    map_name: str
    bad_arm: tuple[str, ...]
    """Instants whose arm pose contradicts all cameras; the cameras alone were used there."""
    checks: tuple[Check, ...]
    """Checks of the cameras together; those of each are in its report."""

    def camera(self, name: str) -> HandEyeReport:
        """Return one camera's report.

        Raises:
            InputError: there is none of this name.
        """
        names = [c.name for c in self.rig.cameras]
        if name not in names:
            raise InputError(f"there is no camera '{name}'; there are {', '.join(names)}.")
        return self.cameras[names.index(name)]

    @property
    def all_checks(self) -> tuple[Check, ...]:
        """Checks of the cameras together and of each one, its name before the check's."""
        own = [
            replace(check, name=f"{camera.name}: {check.name}")
            for camera, report in zip(self.rig.cameras, self.cameras, strict=True)
            for check in report.checks
        ]
        return (*self.checks, *own)

    @property
    def rejected(self) -> tuple[SightingReport, ...]:
        """The views that were not used."""
        return tuple(v for v in self.views if not v.used)

    def disagreeing(self, ratio: float = 3.0, floor_px: float = 0.3) -> tuple[SightingReport, ...]:
        """Return the used views predicted worse than `ratio` times their camera's median.

        Below `floor_px` a view is good, whatever the others do.
        """
        odd: list[SightingReport] = []
        for camera in self.rig.cameras:
            own = [v for v in self.views if v.used and v.camera == camera.name]
            usual = float(np.median([v.unseen_px for v in own]))
            odd += [v for v in own if v.unseen_px > max(ratio * usual, floor_px)]
        return tuple(sorted(odd, key=lambda v: -v.unseen_px))


def pair_reports(
    rig: Rig, X: Array, covariance: Array, views: tuple[SightingReport, ...], A: Array,
    middles: list[Array],
) -> Iterator[PairReport]:  # fmt: skip
    """Yield every pair of cameras.

    T_a_b = (H_a X_a)^-1 H_b X_b with H = A for a camera in the hand; its right perturbation is
    xi_b - Ad(T_a_b^-1) xi_a.

    Args:
        rig: the cameras.
        X: (C, 4, 4) their places [m].
        covariance: (6 C, 6 C) of these.
        views: what they saw.
        A: (I, 4, 4) where the hand was at every instant [m].
        middles: every board's middle (3,) [m].
    """
    used = {(v.camera, v.board, v.instant): v.T_cam_board for v in views if v.used}
    boards = {b.name: k for k, b in enumerate(rig.boards)}
    for a, b in combinations(range(len(rig.cameras)), 2):
        names = (rig.cameras[a].name, rig.cameras[b].name)
        both = [
            (board, i) for camera, board, i in used
            if camera == names[0] and (names[1], board, i) in used
        ]  # fmt: skip

        def world(c: int, i: int) -> Array:
            return A[i] @ X[c] if rig.cameras[c].mount == "hand" else X[c]

        apart: dict[int, float] = {}
        for board, i in both:
            middle = middles[boards[board]][None]
            p, q = (
                se3.transform(world(c, i) @ used[name, board, i], middle)[0]
                for c, name in zip((a, b), names, strict=True)
            )
            apart[i] = max(apart.get(i, 0.0), 1e3 * float(np.linalg.norm(p - q)))
        at = both[0][1] if both else 0
        T = se3.invert(world(a, at)) @ world(b, at)
        J = np.zeros((6, len(covariance)))
        J[:, 6 * b : 6 * b + 6] = np.eye(6)
        J[:, 6 * a : 6 * a + 6] = -se3.adjoint(se3.invert(T))
        worst = max(apart, key=lambda i: apart[i]) if apart else -1
        rms = float(np.sqrt(np.mean(np.square(list(apart.values()))))) if apart else float("nan")
        yield PairReport(
            names=names, together=len(apart), T_a_b=T, covariance=J @ covariance @ J.T,
            apart_mm=rms, worst=rig.instants[worst].name if apart else "",
        )  # fmt: skip


TOGETHER_MM = (2.0, 6.0)
"""Board's middle seen by two cameras at once: as the held-out limits of one camera."""
FEW_VIEWS = (4, 1)
"""Views of a camera: its place then rests on few of them."""
NAMED = 4


def rig_checks(report: CamerasReport) -> tuple[Check, ...]:
    """Return the checks of the cameras together."""
    return (*_few_views(report), *_pairs(report), *_arm(report), *_odd(report), *_base(report))


def armless_checks(
    checks: Sequence[Check], own: HandEyeReport, reference: str
) -> tuple[Check, ...]:
    """Return a camera's checks where no arm gives metres or a base: what they say of one goes.

    Args:
        checks: as of a camera with an arm.
        own: the camera's report.
        reference: the camera that all places are in; empty for that camera itself.
    """
    kept = [c for c in checks if c.name not in {"uncertainty elsewhere", "board size"}]
    place = Check(
        name="uncertainty", verdict="good", value=own.here_mm, unit="mm",
        sentence=f"in camera '{reference}' its place is known to {own.here_mm:.2f} mm and "
        f"{own.here_deg:.3f} deg (1 sigma, worst axis); the board's size, which no arm's metres "
        "prove, is part of it.",
        advice="Measure the board's squares with a calliper.",
    )  # fmt: skip
    return tuple(
        replace(place, verdict=c.verdict) if c.name == "uncertainty" else c
        for c in kept
        if reference or c.name != "uncertainty"
    )


def _few_views(r: CamerasReport) -> Iterator[Check]:
    for camera, own in zip(r.rig.cameras, r.cameras, strict=True):
        used = sum(v.used for v in r.views if v.camera == camera.name)
        if used < FEW_VIEWS[0]:
            yield Check(
                name="few views", verdict="warn", value=used,
                sentence=f"camera '{camera.name}' is placed by {used} view{'s' * (used != 1)} "
                f"only (1 sigma {own.sigma_mm:.2f} mm).",
                advice="Let it see the board at more instants.",
            )  # fmt: skip


def _pairs(r: CamerasReport) -> Iterator[Check]:
    for pair in r.pairs:
        if not np.isfinite(pair.apart_mm) or pair.apart_mm <= TOGETHER_MM[0]:
            continue
        bad = pair.apart_mm > TOGETHER_MM[1]
        yield Check(
            name="pair", verdict="bad" if bad else "warn", value=pair.apart_mm, unit="mm",
            sentence=f"cameras '{pair.names[0]}' and '{pair.names[1]}' see the board "
            f"{pair.apart_mm:.2f} mm apart (RMS of {pair.together} instants; worst: "
            f"{pair.worst}).",
            advice="Are their images of the same moment? Look at the instant named.",
        )  # fmt: skip


def _arm(r: CamerasReport) -> Iterator[Check]:
    if not r.bad_arm:
        return
    names = named(r.bad_arm, NAMED)
    yield Check(
        name="arm poses", verdict="warn", value=len(r.bad_arm),
        sentence=f"all cameras contradict the arm's pose at {names}; there the cameras "
        "alone were used.",
        advice="Was the arm still moving, or is it another instant's pose?",
    )  # fmt: skip


def _odd(r: CamerasReport) -> Iterator[Check]:
    odd = r.disagreeing()
    if not odd:
        return
    names = named([f"{v.name} ({v.unseen_px:.2f} px)" for v in odd], NAMED)
    yield Check(
        name="views that disagree", verdict="warn", value=len(odd),
        sentence=f"predicted three times worse than their camera's other views: {names}.",
        advice="Check these images: is one blurred, did the board move, was the arm at rest?",
        views=tuple(v.instant for v in odd),
    )  # fmt: skip


def _base(r: CamerasReport) -> Iterator[Check]:
    if r.reference == ROBOT_BASE:
        return
    yield Check(
        name="reference", verdict="warn",
        sentence=f"no arm ties the cameras to a robot: all places are in camera "
        f"'{r.reference}'.",
        advice="If you need the robot's base, let the arm carry a board in view "
        "(--held-board), or add a camera in the hand.",
    )  # fmt: skip
