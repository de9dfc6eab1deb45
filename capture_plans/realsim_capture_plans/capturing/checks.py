"""Is this view good? What is measured of every frame, and what it is judged by.

Every check is a small function of measured numbers; its threshold stands above with its
reason. Sharpness, brightness and depth are judged against the views of the same session that
were accepted before, so that nobody has to know absolute numbers for a lens and a scene.

A `fault` is a frame that is never stored (black, frozen, taken while the arm moved). A `doubt` is
one that is taken again and then stored with a note: it may be the scene and not the camera.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from realsim.arrays import Array, UInt8
from realsim.geometry import se3
from realsim_capture_plans.devices.interfaces import ArmState, Frame

Mark = Literal["good", "doubt", "fault"]

STRIDE = 4
"""Every fourth pixel of every fourth row decides exposure and depth: 58 000 samples of a
1280x720 image, in which a share is known to 0.2 %."""
COARSE = 8
"""Edges are compared with those of an image this many times smaller, which no blur of a few
pixels changes."""
GRADIENT_SCALE = 0.25
"""Brings a Sobel response of at most 1020 into 8 bits."""
EDGE_SHARE = 0.9995
"""Only the steepest edges count, 260 pixels of a 1280x720 image: they are far above the noise,
and every scene has some."""
LEAST_PIXELS = 57_600
"""Images smaller than 320x180 have fewer than 20 such pixels: their sharpness is not judged."""
MOTION_MM = 0.2
"""Greatest motion of the flange during an exposure [mm]: a third of a pixel at 0.35 m."""
MOTION_DEG = 0.05
"""Greatest turn of the flange during an exposure [deg]: half a pixel of a D405."""
LEAST_BRIGHTNESS = 4.0
"""Mean grey value (0-255) below which the image counts as black: lens cap, light off."""
LEAST_DEPTH_SHARE = 0.02
"""Share of pixels with depth below which the depth counts as missing."""
SHARPNESS_OF_MEDIAN = 0.75
"""Least sharpness, as a share of the session's median. Sharp views of one scene lie between
0.85 and 1.15, a blur of 1.5 px (sigma) at 0.5-0.65, motion by 8 px at 0.3-0.55."""
BRIGHTNESS_OF_MEDIAN = 0.6
"""Least brightness as a share of the session's median, and its inverse the greatest: a lamp
that went out, an exposure that has not settled. Shadow of the arm takes 20 %."""
SATURATED_SHARE = 0.25
"""Greatest share of pixels at the upper end: beyond it texture and tags are burnt out."""
SATURATED_VALUE = 250
"""Value (0-255) of any channel from which a pixel counts as saturated."""
DEPTH_OF_MEDIAN = 0.6
"""Least depth fill in the middle of the image, as a share of the session's median. Views of
one scene lie between 0.8 and 1.05; a projector off, glare or a hand in the view is below."""
LEAST_HISTORY = 4
"""Accepted views before anything is judged against their median."""
POSE_MM = 0.5
"""Greatest distance between the controller's flange pose and the plan's chain [mm]: five
times a UR5's repeatability; an uncalibrated chain is 1 to 5 mm off."""
POSE_DEG = 0.05
"""Greatest angle between the two [deg]."""
WRONG_ARM_MM = 30.0
"""Distance from which the arm is another model: no factory calibration is 30 mm, a UR5e taken
for a UR5 is 64 mm off."""
TOOL_MM = 0.01
"""Greatest change of the controller's tool offset during a session [mm]: it is a setting and
does not drift."""


@dataclass(frozen=True, kw_only=True, slots=True)
class Check:
    """What one check found."""

    name: str
    """'sharpness', 'exposure', 'depth', 'board', 'still', 'pose', 'clock'."""
    mark: Mark
    value: str
    """The measured number with its unit, for the operator's view."""
    reason: str = ""
    """What is wrong, in a sentence; empty where nothing is."""


@dataclass(frozen=True, kw_only=True, slots=True)
class Measured:
    """The numbers of one frame."""

    sharpness: float
    """Slope of the steepest edges against the same edges in a small image (0-1)."""
    brightness: float
    """Mean grey value (0-255)."""
    saturated: float
    """Share of saturated pixels."""
    depth_share: float
    """Share of the whole image that has depth."""
    depth_fill: float
    """Share of the image's middle half (each way) that has depth."""

    def to_json(self) -> dict[str, Any]:
        """Return plain values for the capture log, rounded to what they mean."""
        return {name: round(float(getattr(self, name)), 4) for name in self.__slots__}


def measured(frame: Frame) -> Measured:
    """Return the numbers of a frame; 4 ms of CPU at 1280x720."""
    few = np.ascontiguousarray(frame.rgb[::STRIDE, ::STRIDE])
    # Three maxima of planes take a twentieth of one along the last axis.
    brightest = np.maximum(np.maximum(few[..., 0], few[..., 1]), few[..., 2])
    depth = frame.depth_m[::STRIDE, ::STRIDE] > 0
    h, w = depth.shape
    middle = depth[h // 4 : h - h // 4, w // 4 : w - w // 4]
    return Measured(
        sharpness=sharpness(frame.rgb),
        brightness=float(few.mean()),
        saturated=float(np.mean(brightest >= SATURATED_VALUE)),
        depth_share=float(depth.mean()),
        depth_fill=float(middle.mean()),
    )


def sharpness(rgb: UInt8) -> float:
    """Return how steep the steepest edges are: near 1 for a step, lower for every blur.

    The steepest slopes of the image's middle three quarters are divided by those of the same
    part reduced `COARSE` times: contrast and content cancel, the width of the edges stays. The
    least of four directions counts, because motion only blurs along itself.

    Args:
        rgb: (H, W, 3) uint8; its green channel is used, of which a sensor has most pixels. Of
            an image with fewer than `LEAST_PIXELS`, 0 is returned: not known.
    """
    import cv2

    if rgb.shape[0] * rgb.shape[1] < LEAST_PIXELS:
        return 0.0
    h, w = rgb.shape[:2]
    middle = rgb[h // 8 : h - h // 8, w // 8 : w - w // 8]
    grey = cv2.extractChannel(middle, 1)
    size = (grey.shape[1] // COARSE, grey.shape[0] // COARSE)
    small = cv2.resize(grey, size, interpolation=cv2.INTER_AREA)
    fine, coarse = _steepest(np.asarray(grey)), _steepest(np.asarray(small))
    return min(f / max(c, 1.0) for f, c in zip(fine, coarse, strict=True))


def _steepest(grey: NDArray[Any]) -> list[float]:
    """Return the slopes along x, y and both diagonals that only the steepest edges exceed."""
    import cv2

    x, y = cv2.Sobel(grey, cv2.CV_16S, 1, 0), cv2.Sobel(grey, cv2.CV_16S, 0, 1)
    diagonal = GRADIENT_SCALE / np.sqrt(2.0)
    slopes = ((x, GRADIENT_SCALE), (y, GRADIENT_SCALE), (cv2.add(x, y), diagonal),
              (cv2.subtract(x, y), diagonal))  # fmt: skip
    found: list[float] = []
    for slope, scale in slopes:
        levels = cv2.convertScaleAbs(slope, alpha=scale)
        count = np.cumsum(cv2.calcHist([levels], [0], None, [256], [0, 256]).ravel())
        found.append(float(np.interp(EDGE_SHARE * count[-1], count, np.arange(256))))
    return found


def _check(name: str, reason: str, value: str, mark: Mark = "doubt") -> Check:
    """Return a check that has the mark where there is a reason, else is good."""
    return Check(name=name, mark=mark if reason else "good", value=value, reason=reason)


def check_still(before: ArmState, after: ArmState) -> Check:
    """Did the flange stand still during the exposure?"""
    mm, deg = pose_gap(before.T_base_ee, after.T_base_ee)
    wrong = mm > MOTION_MM or deg > MOTION_DEG
    reason = f"the flange moved {mm:.2f} mm, {deg:.3f} deg during the exposure" if wrong else ""
    return _check("still", reason, f"{mm:.2f} mm", "fault")


def check_exposure(now: Measured, earlier: Sequence[Measured]) -> Check:
    """Is the image neither black nor burnt out, and as bright as the others?"""
    mark: Mark = "doubt"
    reason = ""
    usual = _median([m.brightness for m in earlier])
    if now.brightness < LEAST_BRIGHTNESS:
        mark, reason = "fault", f"the image is black (mean {now.brightness:.1f} of 255)"
    elif now.saturated > SATURATED_SHARE:
        reason = f"{100 * now.saturated:.0f} % of the pixels are saturated: less light or exposure"
    elif usual is not None and not (
        BRIGHTNESS_OF_MEDIAN <= now.brightness / usual <= 1 / BRIGHTNESS_OF_MEDIAN
    ):
        reason = (
            f"the brightness is {now.brightness:.0f}, the other views' {usual:.0f} of 255: is a "
            "lamp off, or something before the lens?"
        )
    return _check("exposure", reason, f"{now.brightness:.0f}", mark)


def check_sharpness(now: Measured, earlier: Sequence[Measured]) -> Check:
    """Is the image as sharp as the others?"""
    usual = _median([m.sharpness for m in earlier])
    value = f"{now.sharpness:.2f}" if now.sharpness > 0 else "-"
    if usual is None or usual <= 0:
        return Check(name="sharpness", mark="good", value=value)
    share = now.sharpness / usual
    wrong = share < SHARPNESS_OF_MEDIAN
    reason = f"blurred: {100 * share:.0f} % of the other views' sharpness" if wrong else ""
    return _check("sharpness", reason, f"{100 * share:.0f} %")


def check_depth(now: Measured, earlier: Sequence[Measured]) -> Check:
    """Is there depth, and as much in the middle of the image as in the others?"""
    mark: Mark = "doubt"
    reason = ""
    usual = _median([m.depth_fill for m in earlier])
    if now.depth_share < LEAST_DEPTH_SHARE:
        mark, reason = "fault", f"only {100 * now.depth_share:.1f} % of the pixels have depth"
    elif usual is not None and now.depth_fill < DEPTH_OF_MEDIAN * usual:
        reason = (
            f"depth fills {100 * now.depth_fill:.0f} % of the image's middle, in the other views "
            f"{100 * usual:.0f} %: glare, or nearer than the sensor sees?"
        )
    return _check("depth", reason, f"{100 * now.depth_fill:.0f} %", mark)


def check_size(frame: Frame, size: tuple[int, int]) -> Check:
    """Does the image have the camera's (height, width)?"""
    found = frame.rgb.shape[:2]
    reason = "" if found == size else f"the image is {found}, not {size} (height, width)"
    return _check("size", reason, f"{found[1]}x{found[0]}", "fault")


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Earlier:
    """What is kept of the frame before, to notice a camera that repeats itself."""

    samples: UInt8
    """Every fourth pixel of every fourth row."""
    time_s: float
    joints: Array
    """(6,) where the arm stood [rad]."""


def kept(frame: Frame, state: ArmState) -> Earlier:
    """Return what is kept of a frame."""
    return Earlier(
        samples=frame.rgb[::STRIDE, ::STRIDE].copy(), time_s=frame.time_s, joints=state.joints
    )


def check_clock(frame: Frame, state: ArmState, before: Earlier | None) -> Check:
    """Is this a new frame: a later stamp, and from another place another image?"""
    reason = ""
    if before is not None:
        step = frame.time_s - before.time_s
        elsewhere = not np.array_equal(state.joints, before.joints)
        if elsewhere and np.array_equal(frame.rgb[::STRIDE, ::STRIDE], before.samples):
            reason = (
                "the image is the one of the place before, to the last bit: the camera is frozen"
            )
        elif step <= 0:
            reason = f"the camera's time stamp did not go on ({step:+.3f} s)"
    return _check("clock", reason, f"{frame.time_s:.2f} s", "fault")


def pose_gap(T_from: Array, T_to: Array) -> tuple[float, float]:
    """Return how far two poses (4, 4) are apart [mm], [deg]."""
    step = se3.invert(T_from) @ T_to
    return 1e3 * float(np.linalg.norm(step[:3, 3])), float(np.degrees(se3.angle(step)))


def check_pose(state: ArmState, T_base_ee: Array) -> Check:
    """Does the plan's chain put the flange where the controller says it is?"""
    mm, deg = pose_gap(T_base_ee, state.T_base_ee)
    wrong = (
        f"the controller's flange pose is {mm:.1f} mm, {deg:.2f} deg from the plan's chain: give "
        "the controller's calibration.conf when the plan is made. The poses stored are the "
        "controller's own"
    )
    return _check("pose", wrong if mm > POSE_MM or deg > POSE_DEG else "", f"{mm:.1f} mm")


def check_tool(state: ArmState, T_ee_tcp: Array) -> Check:
    """Is the controller's tool offset what it was at the first view?"""
    mm, deg = pose_gap(T_ee_tcp, state.T_ee_tcp)
    wrong = (
        f"the controller's tool offset changed by {mm:.1f} mm, {deg:.2f} deg since the first view; "
        "the flange poses stored do not depend on it, programs at the pendant do"
    )
    return _check("tool", wrong if mm > TOOL_MM or deg > MOTION_DEG else "", f"{mm:.2f} mm")


def _median(values: Sequence[float]) -> float | None:
    """Return the median of earlier views, None as long as there are too few."""
    return float(np.median(values)) if len(values) >= LEAST_HISTORY else None
