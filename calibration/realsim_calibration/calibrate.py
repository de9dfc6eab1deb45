"""The whole calibration of a set of views: the lens, then the hand-eye."""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from realsim.geometry.dh import DhArm
from realsim.records import CameraIntrinsics, Check, Target
from realsim_calibration.hand_eye import HandEyeConfig, calibrate_hand_eye_report
from realsim_calibration.lens.fit import IntrinsicsConfig
from realsim_calibration.lens.intrinsics import calibrate_intrinsics
from realsim_calibration.lens.report import IntrinsicsReport
from realsim_calibration.results import HandEyeReport
from realsim_calibration.views import BoardView


@dataclass(frozen=True, kw_only=True, slots=True)
class CalibrationConfig:
    """Everything a calibration may be told."""

    hand_eye: HandEyeConfig = field(default_factory=HandEyeConfig)
    intrinsics: IntrinsicsConfig = field(default_factory=IntrinsicsConfig)
    border_px: float = 5.0
    """How far one sigma of a distortion term that the own lens calibration refused may move the
    image's corner in the hand-eye fit [px]."""
    own_focal_sd: float = 0.1
    """Prior of the focal length in the hand-eye fit around an own calibration of the same views,
    relative: hardly any, since these views say it themselves."""


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Calibration:
    """A calibrated camera on a robot."""

    hand_eye: HandEyeReport
    lens: IntrinsicsReport | None
    """The camera's own calibration from the same views; None where a given camera was used."""

    @property
    def checks(self) -> tuple[Check, ...]:
        """Every check of both."""
        lens = () if self.lens is None else self.lens.checks
        return (*self.hand_eye.checks, *lens)


DISTORTION = ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")
RADIAL_POWERS = {"k1": 3, "k2": 5, "k3": 7}
"""Power of the radius with which a term moves a point."""


def _determined(
    sd: tuple[float, ...], lens: IntrinsicsReport, border_px: float
) -> tuple[float, ...]:
    """Return the priors of the distortion, tight for terms that the views do not determine.

    Freed entirely, such terms bend the lens outside of the corners until it folds inside the image;
    held, they leave what they could explain to the robot.
    """
    camera = lens.intrinsics
    radius = 0.5 * float(np.hypot(camera.width / camera.fx, camera.height / camera.fy))
    priors: list[float] = []
    for name, prior in zip(DISTORTION, sd, strict=True):
        limit = np.inf
        if name not in lens.terms and name in RADIAL_POWERS:
            limit = border_px / (camera.fx * radius ** RADIAL_POWERS[name])
        priors.append(float(min(prior, limit)))
    return tuple(priors)


def calibrate(
    views: Sequence[BoardView],
    target: Target,
    *,
    intrinsics0: CameraIntrinsics | None = None,
    arm: DhArm | None = None,
    config: CalibrationConfig | None = None,
) -> Calibration:
    """Return lens and hand-eye of a set of views.

    Args:
        views: views of a target that stands still (or sits in the hand), in any order.
        target: the printed target.
        intrinsics0: a camera known beforehand (the factory's); without it the lens is calibrated
            from the same views first.
        arm: the arm's kinematics; with the views' joints its errors are modelled.
        config: gates, priors, steps, and where the camera sits.

    Raises:
        InputError: wrong conventions, mixed-up views, images of several sizes, another target.
        UnitError: hand poses or target in the wrong unit.
        DegenerateError: the views do not determine lens or hand-eye; says what to add.
    """
    config = config or CalibrationConfig()
    lens: IntrinsicsReport | None = None
    hand_eye = config.hand_eye
    camera = intrinsics0
    if camera is None:
        ordered = sorted(views, key=lambda v: v.index)
        detections = [v.detection for v in ordered]
        lens = calibrate_intrinsics(
            detections, target, names=[v.label for v in ordered], config=config.intrinsics
        )
        camera = lens.intrinsics
        joint = replace(
            hand_eye.joint,
            focal_sd=config.own_focal_sd,
            distortion_sd=_determined(hand_eye.joint.distortion_sd, lens, config.border_px),
        )
        hand_eye = replace(hand_eye, joint=joint)
    report = calibrate_hand_eye_report(views, target, camera, hand_eye, arm)
    return Calibration(hand_eye=report, lens=lens)
