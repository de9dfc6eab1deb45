"""What an exported calibration says of itself: frames, the transform, accuracy, warnings.

Other programs know no robot error map, so what they get is `X_alone`, the place of the camera that
predicts unseen views best without one, with `Z_alone` and `intrinsics_alone` of the same fit:
numbers of two fits do not fit one another. The camera frame is always the OPTICAL one (x right, y
down, z forward), unless a `camera_link` is asked for.
"""

import re
from dataclasses import dataclass, field

import numpy as np

from realsim import __version__
from realsim.arrays import Array
from realsim.errors import InputError
from realsim.geometry import metrics, se3
from realsim.records.calibration import worst_sigmas
from realsim.records.checked_arrays import rigid
from realsim_calibration.results import HandEyeReport

FRAME_NAME = re.compile(r"[A-Za-z_][A-Za-z0-9_.\-]*(/[A-Za-z0-9_.\-]+)*")
"""What tf2 takes for a frame: no spaces, no leading slash."""
FILE_NAME = re.compile(r"[A-Za-z0-9_][A-Za-z0-9_.\-]*")
LOCK_COSINE = 1e-12
"""Cosine of the pitch below which roll and yaw turn about the same axis."""


def _optical_in_link() -> Array:
    """Return T_link_optical (4, 4) of REP 103 axes, x forward, y left, z up, at the same origin."""
    return se3.from_rt([[0, 0, 1], [-1, 0, 0], [0, -1, 0]], [0.0, 0.0, 0.0])


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class FrameNames:
    """How the frames are called in the program that reads the export."""

    robot_base: str = "base"
    """Frame in which the controller gives the tool's pose. On UR robots that is `base`, not
    `base_link`: the two are turned by 180 deg about z."""
    hand: str = "tool0"
    """Frame whose pose the controller gave: the flange only where no tool offset was active. The
    same as `robot_base` where a camera and its target both stand still."""
    camera_optical: str = "camera_color_optical_frame"
    """Optical frame of the calibrated image: x right, y down, z forward."""
    target: str = "calibration_target"
    """The printed target; easy_handeye wants a name for it."""
    camera_link: str = ""
    """Body frame of the camera to publish instead of the optical one, empty = the optical one.
    Needed where the camera's driver publishes the optical frame below its `camera_link` already: a
    frame of tf has one parent only."""
    T_link_optical: Array = field(default_factory=_optical_in_link)
    """(4, 4) optical frame in `camera_link` [m], as the camera's driver publishes it. The default
    turns the axes (REP 103: x forward, y left, z up) and takes the origins for one; the colour
    camera of a RealSense is off by up to 15 mm (59 mm on some models)."""
    name: str = "hand_eye"
    """Name of the calibration, and of its easy_handeye files."""

    def __post_init__(self) -> None:
        """Check that the names can be used."""
        names = self.frames
        if self.camera_link:
            names["camera_link"] = self.camera_link
        for what, name in names.items():
            if not FRAME_NAME.fullmatch(name):
                raise InputError(
                    f"the frame name {name!r} of {what} cannot be used: letters, digits and _ - . "
                    "/ are accepted, without a leading slash (tf2 refuses it) and without spaces."
                )
        if self.hand == self.robot_base:
            del names["hand"]  # of an eye to hand whose target hangs on no hand; see parent_frame
        if len(set(names.values())) < len(names):
            raise InputError(f"two frames have the same name: {names}. Every frame needs its own.")
        if not FILE_NAME.fullmatch(self.name):
            raise InputError(
                f"the calibration's name {self.name!r} cannot be a file name: letters, digits and "
                "_ - . are accepted."
            )
        object.__setattr__(self, "T_link_optical", rigid(self.T_link_optical, "T_link_optical"))

    @property
    def frames(self) -> dict[str, str]:
        """The names of the four frames by what they are."""
        kinds = ("robot_base", "hand", "camera_optical", "target")
        return {kind: getattr(self, kind) for kind in kinds}


def parent_frame(report: HandEyeReport, frames: FrameNames) -> str:
    """Return the frame that carries the camera: the hand, or the robot's base (eye to hand).

    Raises:
        InputError: hand and base of a camera in the hand have the same name.
    """
    if report.mode != "eye_in_hand":
        return frames.robot_base
    if frames.hand == frames.robot_base:
        raise InputError(
            f"robot_base and hand have the same name: {frames.hand!r}. Every frame needs its own."
        )
    return frames.hand


def published_transform(report: HandEyeReport, frames: FrameNames) -> tuple[Array, str, str]:
    """Return (T_parent_child (4, 4) [m], parent, child): what the ROS formats carry."""
    parent = parent_frame(report, frames)
    if not frames.camera_link:
        return np.asarray(report.X_alone), parent, frames.camera_optical
    return report.X_alone @ se3.invert(frames.T_link_optical), parent, frames.camera_link


def quaternion_xyzw(T: Array) -> list[float]:
    """Return the unit quaternion x y z w, the order of ROS, w >= 0, of T (4, 4)."""
    w, x, y, z = (float(v) for v in se3.quaternion_wxyz(T[:3, :3]))
    return [x, y, z, w]


def roll_pitch_yaw(R: Array) -> tuple[float, float, float]:
    """Return roll, pitch, yaw [rad] with R = Rz(yaw) Ry(pitch) Rx(roll), R (3, 3).

    These are URDF's angles about FIXED axes x, y, z. The roll is taken from Rz(-yaw) R, so that the
    three together give R to machine precision for every pitch, +-90 deg included.
    """
    level = np.hypot(R[0, 0], R[1, 0]) > LOCK_COSINE
    yaw = float(np.arctan2(R[1, 0], R[0, 0])) if level else 0.0
    rest = se3.exp_so3([0.0, 0.0, -yaw]) @ R
    pitch = float(np.arctan2(-rest[2, 0], rest[0, 0]))
    return float(np.arctan2(-rest[1, 2], rest[1, 1])), pitch, yaw


def _accuracy_line(report: HandEyeReport) -> str:
    """Return how well unseen views are predicted."""
    if not np.isfinite(report.held_out_px):
        return "WARNING: how well it predicts views that it had not seen is not known."
    through = " and its error map" if report.robot_map is not None else ""
    line = (
        f"Views that the fit had not seen: {report.held_out_px:.2f} px, {report.held_out_mm:.2f} "
        f"mm, {report.held_out_deg:.3f} deg RMS, through the robot's own pose{through}."
    )
    plain = dict(report.plain_scores).get(report.plain_name, np.nan)
    if report.robot_map is None or not np.isfinite(plain):
        return line
    return f"{line} Without the map, as exported here: {plain:.2f} px."


def _sigma_line(report: HandEyeReport) -> str:
    """Return both sigmas of what is exported: for this arm, and absolute."""
    mm, deg = worst_sigmas(report.X_alone_covariance)
    if report.X_alone_here_covariance is None:
        return (
            f"1 sigma along the worst axis: {mm:.3f} mm, {deg:.4f} deg. Numbers read back exactly."
        )
    here_mm, here_deg = worst_sigmas(report.X_alone_here_covariance)
    return (
        f"1 sigma along the worst axis for this arm as it moves here: {here_mm:.3f} mm, "
        f"{here_deg:.4f} deg; for another arm, a new mount or a drawing: {mm:.3f} mm, {deg:.4f} "
        "deg. Numbers read back exactly."
    )


def fit_line(report: HandEyeReport) -> str:
    """Return which fit the camera's and the target's numbers of an export belong to."""
    if report.robot_map is None:
        return "Camera matrix, distortion, and the target's place belong to this hand-eye: one fit."
    return (
        "Camera matrix, distortion, and the target's place belong to this hand-eye, used "
        "WITHOUT the robot's error map: do not mix them with those of calibration.json that need "
        "the map."
    )


def note_lines(
    report: HandEyeReport, frames: FrameNames, *, child: str | None = None
) -> tuple[str, ...]:
    """Return what must be known of the numbers: frames, units, accuracy, warnings; a line each.

    Args:
        report: the calibration.
        frames: names of the frames.
        child: the frame exported; None = the optical one.
    """
    parent = parent_frame(report, frames)
    child = child or frames.camera_optical
    axes = (
        "the camera's OPTICAL frame: x right, y down, z forward"
        if child == frames.camera_optical
        else "the camera's body: x forward, y left, z up (REP 103)"
    )
    reported = (
        f"{frames.hand} must be the frame whose pose the controller reported (tool offset and all)."
        if report.mode == "eye_in_hand"
        else f"{frames.robot_base} must be the frame in which the controller reports its tool."
    )
    lines = [
        f"Hand-eye calibration by realsim {__version__}, {report.mode.replace('_', ' ')}.",
        f"Maps points of {child} ({axes}) into {parent}. Metres, radians.",
        reported,
        _sigma_line(report),
        _accuracy_line(report),
    ]
    if report.robot_map is not None:
        moved = float(metrics.translation_error_mm(report.X, report.X_alone))
        turned = float(metrics.rotation_error_deg(report.X, report.X_alone))
        lines.append(
            "This is X_alone, the camera's place WITHOUT the robot's error map, for programs that "
            f"know none: {moved:.2f} mm and {turned:.3f} deg from X in calibration.json, which is "
            "valid with the map only."
        )
    if report.plain_scores:
        held = ", ".join(f"{name} {px:.2f}" for name, px in report.plain_scores)
        lines.append(
            f"It is that of '{report.plain_name}', which predicts unseen views best without a map "
            f"[px]: {held}."
        )
    if report.clock is not None:
        lines.append(report.clock.sentence)
    if not report.checks:
        lines.append("WARNING: nothing was checked.")
    lines += [f"WARNING: {w}" for w in report.warnings]
    return tuple(" ".join(line.split()) for line in lines)


def comments(lines: tuple[str, ...]) -> str:
    """Return lines as comments of shell, YAML and Python."""
    return "".join(f"# {line}\n" for line in lines)
