"""Carry out a capture plan: move, wait, read the arm, grab, check, store; go on after a kill.

View k of the plan becomes view k of the session. The arm only goes where the plan's collision
model was asked: along the plan's moves or, at the beginning, on a line that is checked first.
"""

import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from realsim.errors import InputError
from realsim.geometry import se3
from realsim.records import View
from realsim_capture_plans.devices.interfaces import Arm, ArmState, DepthCamera, DeviceError, Frame
from realsim_capture_plans.plan_files.plan_json import plan_to_json
from realsim_capture_plans.planning.record import CapturePlan

if TYPE_CHECKING:
    from realsim.store import SessionStore

Array = NDArray[np.float64]
PLAN_FILE = "plan.json"


@dataclass(frozen=True, kw_only=True, slots=True)
class CaptureConfig:
    """When a frame counts."""

    settle_s: float = 0.0
    """Waited after every move [s], for arms that swing after they report standing still."""
    attempts: int = 3
    """Frames tried per view before the capture gives up."""
    motion_mm: float = 0.2
    """Greatest motion of the flange during an exposure [mm]: a third of a pixel at 0.35 m."""
    motion_deg: float = 0.05
    """Greatest turn of the flange during an exposure [deg]: half a pixel of a D405."""
    arrival_rad: float = 0.005
    """Greatest distance of any joint from its goal when the arm says it has arrived [rad]."""
    least_brightness: float = 4.0
    """Mean grey value (0-255) below which the image counts as black: lens cap, light off."""
    least_depth_share: float = 0.02
    """Share of pixels with depth below which the depth counts as missing."""


@dataclass(frozen=True, kw_only=True, slots=True)
class CaptureSummary:
    """What a capture did."""

    captured: int
    """Views stored by this call."""
    skipped: int
    """Views that were there already."""
    seconds: float
    """Wall time [s]."""
    rejected: tuple[tuple[int, str], ...]
    """(view, reason) of every frame that was thrown away and taken again."""


def capture(
    plan: CapturePlan,
    arm: Arm,
    camera: DepthCamera,
    store: "SessionStore",
    *,
    progress: Callable[[int, int], None] | None = None,
    settle_s: float = 0.0,
    config: CaptureConfig | None = None,
) -> CaptureSummary:
    """Capture every view of the plan that the session does not have yet.

    Args:
        plan: where to go.
        arm: the arm, anywhere from where the way to the plan is free.
        camera: the camera on its flange.
        store: the session; created with `extra={"plan_hash": plan.content_hash}`.
        progress: called with (views stored, views of the plan).
        settle_s: waited after every move [s]; used where no config is given.
        config: when a frame counts.

    Raises:
        InputError: the session belongs to another plan, arm or camera.
        DeviceError: a device stopped, or a view gave no good frame.
    """
    settings = CaptureConfig(settle_s=settle_s) if config is None else config
    began = time.monotonic()
    _check_session(plan, arm, camera, store)
    done = store.completed
    todo = [k for k in range(len(plan)) if k not in done]
    skipped = len(plan) - len(todo)
    rejected: list[tuple[int, str]] = []
    if progress is not None:
        progress(skipped, len(plan))
    place: int | None = None
    for count, k in enumerate(todo, start=1):
        for joints in _way(plan, arm, place, k):
            arm.move(joints)
        place = k
        state, frame = _steady_frame(plan.joints[k], k, arm, camera, settings, rejected)
        view = View(index=k, T_base_ee=state.T_base_ee, joints=state.joints, time_s=frame.time_s)
        store.add_view(view, frame.rgb, frame.depth_m)
        if progress is not None:
            progress(skipped + count, len(plan))
    return CaptureSummary(
        captured=len(todo),
        skipped=skipped,
        seconds=time.monotonic() - began,
        rejected=tuple(rejected),
    )


def _check_session(plan: CapturePlan, arm: Arm, camera: DepthCamera, store: "SessionStore") -> None:
    """Refuse a session of another plan or camera; put the plan into it the first time."""
    expected = store.extra.get("plan_hash")
    if expected != plan.content_hash:
        raise InputError(
            f"the session was begun with the plan {str(expected)[:12]}..., this plan is "
            f"{plan.content_hash[:12]}... Go on with the plan in the session's {PLAN_FILE}, or "
            'create a new session with extra={"plan_hash": plan.content_hash}.'
        )
    camera_now, camera_then = camera.intrinsics, store.session.intrinsics
    if (camera_now.width, camera_now.height) != (camera_then.width, camera_then.height):
        raise InputError(
            f"{camera.name} gives {camera_now.width}x{camera_now.height} images; the session has "
            f"{camera_then.width}x{camera_then.height}. Set the camera to that size."
        )
    if not np.all(arm.limits.contains(plan.joints)):
        raise InputError(
            f"the plan, made for a {plan.robot}, leaves the joint limits of {arm.name}."
        )
    if not store.has(PLAN_FILE):
        store.write_json(PLAN_FILE, plan_to_json(plan))


def _way(plan: CapturePlan, arm: Arm, place: int | None, k: int) -> list[Array]:
    """Return the joints to pass, the last one view k's.

    From a known place of the tour: along its moves. At the beginning the arm may stand anywhere:
    straight to the goal if that is free, else to the nearest corner of the tour that can be
    reached freely, and on along the tour.

    Raises:
        DeviceError: nothing of the tour can be reached freely from where the arm stands.
    """
    corners, at_view = _tour(plan)
    goal = at_view[k]
    if place is not None:
        return corners[at_view[place] + 1 : goal + 1]
    here = arm.state().joints
    model = plan.collision_model()
    stack = np.stack(corners)
    free = model.edges_free(np.broadcast_to(here, stack.shape), stack, plan.config.edge_step_rad)
    if free[goal]:
        return [corners[goal]]
    if not np.any(free):
        raise DeviceError(
            f"from joints {np.round(here, 3).tolist()} rad no straight move to the plan is free. "
            f"Move the arm by hand to the plan's home {np.round(plan.home, 3).tolist()} rad."
        )
    nearest = int(np.argmin(np.where(free, np.abs(stack - here).max(-1), np.inf)))
    if nearest <= goal:
        return corners[nearest : goal + 1]
    return corners[goal : nearest + 1][::-1]


def _tour(plan: CapturePlan) -> tuple[list[Array], list[int]]:
    """Return all corners of the tour from home on, and the corner of every view."""
    corners, at_view = [plan.home], list[int]()
    for k in range(len(plan)):
        corners.extend(plan.move(k)[1:])
        at_view.append(len(corners) - 1)
    return corners, at_view


def _steady_frame(
    goal: Array,
    k: int,
    arm: Arm,
    camera: DepthCamera,
    config: CaptureConfig,
    rejected: list[tuple[int, str]],
) -> tuple[ArmState, Frame]:
    """Return a frame during which the arm stood still, and the arm's state.

    Raises:
        DeviceError: the arm is not where it was sent, or no attempt gave a good frame.
    """
    reason = ""
    for _ in range(config.attempts):
        if config.settle_s > 0:
            time.sleep(config.settle_s)
        before = arm.state()
        frame = camera.grab()
        after = arm.state()
        off = float(np.abs(after.joints - goal).max())
        if off > config.arrival_rad:
            raise DeviceError(
                f"view {k}: {arm.name} stands {off:.4f} rad off its goal (at most "
                f"{config.arrival_rad} is accepted). Was it stopped? Clear the stop and run the "
                "capture again; it goes on from here."
            )
        reason = _fault(before, after, frame, camera, config)
        if not reason:
            return after, frame
        rejected.append((k, reason))
    raise DeviceError(
        f"view {k}: no good frame in {config.attempts} attempts; the last one: {reason}. The views "
        "before it are stored; run the capture again to go on."
    )


def _fault(
    before: ArmState, after: ArmState, frame: Frame, camera: DepthCamera, config: CaptureConfig
) -> str:
    """Return what is wrong with a frame, or an empty text."""
    moved = se3.invert(before.T_base_ee) @ after.T_base_ee
    moved_mm = 1e3 * float(np.linalg.norm(moved[:3, 3]))
    turned_deg = float(np.degrees(se3.angle(moved)))
    if moved_mm > config.motion_mm or turned_deg > config.motion_deg:
        return f"the flange moved {moved_mm:.2f} mm, {turned_deg:.3f} deg during the exposure"
    size = (camera.intrinsics.height, camera.intrinsics.width)
    if frame.rgb.shape[:2] != size:
        return f"the image is {frame.rgb.shape[:2]}, not {size} (height, width)"
    brightness = float(frame.rgb.mean())
    if brightness < config.least_brightness:
        return f"the image is black (mean {brightness:.1f} of 255)"
    share = float(np.mean(frame.depth_m > 0))
    if share < config.least_depth_share:
        return f"only {100 * share:.1f} % of the pixels have depth"
    return ""
