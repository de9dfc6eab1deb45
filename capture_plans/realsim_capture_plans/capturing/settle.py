"""Wait until the arm stands still, by its own joint readings."""

import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from realsim_capture_plans.devices.interfaces import Arm, ArmState, ArmStoppedError


@dataclass(frozen=True, kw_only=True, slots=True)
class SettleConfig:
    """When an arm counts as standing."""

    tolerance_rad: float = 2e-4
    """Greatest spread of any joint over the window [rad]: 0.17 mm at the stretched arm's tip, and
    several times the noise of a UR's encoders."""
    window_s: float = 0.05
    """Length of the window [s]: half a period of an arm that swings with 10 Hz, so that a turning
    point is not taken for standing."""
    interval_s: float = 0.01
    """Between two readings [s]; a UR5 sends one every 8 ms."""
    timeout_s: float = 10.0
    """Waited at most [s]; a UR5 stands within half a second."""


def until_still(
    arm: Arm,
    config: SettleConfig,
    *,
    clock: Callable[[], float] = time.monotonic,
    sleep: Callable[[float], None] = time.sleep,
) -> tuple[ArmState, float]:
    """Return the arm's state once its joints are still, and the seconds that took.

    Raises:
        ArmStoppedError: the joints do not come to rest, or the arm does not answer.
    """
    began = clock()
    readings: deque[tuple[float, ArmState]] = deque()
    while True:
        state, now = arm.state(), clock()
        readings.append((now, state))
        # The oldest reading still kept is the first that is a window old.
        while len(readings) > 2 and now - readings[1][0] >= config.window_s:
            readings.popleft()
        joints = np.stack([s.joints for _, s in readings])
        spread = float(np.ptp(joints, axis=0).max())
        if now - readings[0][0] >= config.window_s and spread <= config.tolerance_rad:
            return state, now - began
        if now - began > config.timeout_s:
            raise ArmStoppedError(
                f"{arm.name} does not come to rest: its joints moved by {spread:.4f} rad within "
                f"{config.window_s:g} s, {now - began:.0f} s after the move (at most "
                f"{config.tolerance_rad:g} is accepted). Is it in freedrive, or is the base loose?",
                "not ready",
            )
        sleep(config.interval_s)
