"""At a view: wait until the arm stands, take a frame, judge it, take another where that helps."""

import time
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from realsim.arrays import Array, UInt8
from realsim.errors import InputError
from realsim.robots.arm import known_chains
from realsim_capture_plans.capturing import checks
from realsim_capture_plans.capturing.checks import WRONG_ARM_MM, Check, Earlier, Measured
from realsim_capture_plans.devices.interfaces import (
    Arm,
    ArmState,
    ArmStoppedError,
    DepthCamera,
    DeviceError,
    Frame,
)
from realsim_capture_plans.planning.record import CapturePlan


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


LONGEST_SETTLE_S = 60.0
"""A longer wait after every move was given in milliseconds [s]."""
BoardCheck = Callable[[UInt8], str]
"""Returns what is wrong with a colour image (H, W, 3) of the board, or an empty text."""
Seen = Callable[[str, tuple[Check, ...]], None]
"""Called with what is being done and what was found."""


class NoGoodFrameError(DeviceError):
    """No attempt at a view gave a frame that may be stored."""


@dataclass(frozen=True, kw_only=True, slots=True)
class CaptureConfig:
    """When a frame counts, how often it is tried, how fast the arm goes."""

    settle_s: float = 0.0
    """Waited after every move [s], for arms that swing after they report standing still."""
    attempts: int = 3
    """Frames tried per view before the operator is asked, or the capture gives up."""
    doubt_attempts: int = 2
    """Frames tried for a good one before a doubtful one is stored with a note: a second frame
    shows whether it was a passing thing (exposure, vibration) or the scene."""
    ask_after: int = 3
    """Views noted in a row for the same reason before the operator is asked: one is the scene,
    three are a dirty lens or a lamp."""
    arrival_rad: float = 0.005
    """Greatest distance of any joint from its goal when the arm says it has arrived [rad]."""
    speed_scale: float = 1.0
    """Speed and acceleration of the moves as a share of the plan's."""
    still: SettleConfig = field(default_factory=SettleConfig)
    """When the arm counts as standing."""

    def __post_init__(self) -> None:
        """Check ranges."""
        if min(self.attempts, self.doubt_attempts, self.ask_after) < 1:
            raise InputError(
                "CaptureConfig: attempts, doubt_attempts, ask_after must be 1 or more."
            )
        if not 0 < self.speed_scale <= 1:
            raise InputError(
                f"the speed is {self.speed_scale:g} of the plan's; more than 0 and at most 1 is "
                "accepted: the plan's moves were timed at its own speed."
            )
        if not 0 <= self.settle_s <= LONGEST_SETTLE_S:
            raise InputError(
                f"the settle time is {self.settle_s:g} s; 0 to {LONGEST_SETTLE_S:g} s is accepted."
            )


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Shot:
    """A frame that may be stored, and what is known of it."""

    state: ArmState
    frame: Frame
    numbers: Measured
    checks: tuple[Check, ...]
    waited_s: float
    """Until the joints were still, the settle time included [s]."""
    pose_mm: float
    """Between the controller's flange and the plan's chain [mm]."""

    @property
    def notes(self) -> list[str]:
        """What is doubtful."""
        return [c.reason for c in self.checks if c.mark == "doubt"]


class Looker:
    """Takes the frames of one run and remembers what the accepted ones were like."""

    def __init__(
        self,
        plan: CapturePlan,
        arm: Arm,
        camera: DepthCamera | None,
        config: CaptureConfig,
        *,
        board_check: BoardCheck | None = None,
        earlier: Mapping[int, Mapping[str, Any]] | None = None,
        T_ee_tcp: Array | None = None,
    ) -> None:
        """Set up.

        Args:
            plan: where the views are.
            arm: the arm.
            camera: the camera on its flange; without one there is `stand` only.
            config: when a frame counts.
            board_check: whether the calibration target is seen.
            earlier: what the capture log says of the views stored before.
            T_ee_tcp: (4, 4) the tool offset at the session's first view [m].
        """
        self._plan, self._arm, self._camera, self._config = plan, arm, camera, config
        self._board_check = board_check
        self._tool = T_ee_tcp
        self._before: Earlier | None = None
        self._history = [m for m in map(_measured_of, (earlier or {}).values()) if m is not None]
        self.rejected: list[tuple[int, str]] = []
        self.warnings: list[str] = []
        self._warned: set[str] = set()

    def take(self, k: int, seen: Seen) -> Shot:
        """Return a frame of view k, at which the arm stands.

        Raises:
            ArmStoppedError: the arm is not where it was sent, or does not come to rest.
            NoGoodFrameError: no attempt gave a frame that may be stored.
            DeviceError: the camera gave no frame.
        """
        reason = ""
        best: Shot | None = None
        doubts = 0
        for _ in range(self._config.attempts):
            shot = self._attempt(k, seen)
            seen("looking", shot.checks)
            fault = next((c.reason for c in shot.checks if c.mark == "fault"), "")
            if not fault and not shot.notes:
                return self._accepted(shot)
            if not fault:
                doubts += 1
                best = _better(best, shot)
                if doubts >= self._config.doubt_attempts:
                    break
            reason = fault or "; ".join(shot.notes)
            self.rejected.append((k, reason))
        if best is not None:
            return self._accepted(best)
        raise NoGoodFrameError(
            f"view {k}: no good frame in {self._config.attempts} attempts; the last one: {reason}. "
            "The views before it are stored; run the capture again to go on."
        )

    def stand(self, k: int, seen: Seen) -> tuple[ArmState, float]:
        """Return the arm's state at view k once it is still, and the seconds waited.

        Raises:
            ArmStoppedError: the arm is not where it was sent, or does not come to rest.
        """
        seen("settling", ())
        began = time.monotonic()
        if self._config.settle_s > 0:
            time.sleep(self._config.settle_s)
        state, _ = until_still(self._arm, self._config.still)
        self._require_goal(k, state)
        self._warn_once(state)
        return state, time.monotonic() - began

    def _require_goal(self, k: int, state: ArmState) -> None:
        off = float(np.abs(state.joints - self._plan.joints[k]).max())
        if off > self._config.arrival_rad:
            raise ArmStoppedError(
                f"view {k}: {self._arm.name} stands {off:.4f} rad off its goal (at most "
                f"{self._config.arrival_rad} is accepted). Was it stopped? Clear the stop and run "
                "the capture again; it goes on from here.",
                "off goal",
            )

    def _attempt(self, k: int, seen: Seen) -> Shot:
        assert self._camera is not None  # without one there is `stand` only
        before, waited = self.stand(k, seen)
        frame = self._camera.grab()
        after = self._arm.state()
        self._require_goal(k, after)
        intrinsics = self._camera.intrinsics
        found, numbers = self._judged(before, after, frame, (intrinsics.height, intrinsics.width))
        gap_mm, _ = checks.pose_gap(self._plan.chain.forward(after.joints), after.T_base_ee)
        return Shot(
            state=after, frame=frame, numbers=numbers, checks=found, waited_s=waited,
            pose_mm=gap_mm,
        )  # fmt: skip

    def _judged(
        self, before: ArmState, after: ArmState, frame: Frame, image_size: tuple[int, int]
    ) -> tuple[tuple[Check, ...], Measured]:
        """Return every check of a frame, faults of the devices first, and its numbers."""
        size = checks.check_size(frame, image_size)
        numbers = checks.measured(frame)
        found = [
            size,
            checks.check_still(before, after),
            checks.check_exposure(numbers, self._history),
            checks.check_clock(frame, after, self._before),
            checks.check_sharpness(numbers, self._history),
            checks.check_depth(numbers, self._history),
        ]
        if self._board_check is not None and all(c.mark != "fault" for c in found):
            said = self._board_check(frame.rgb)
            mark: checks.Mark = "doubt" if said else "good"
            value = "no" if said else "seen"
            found.append(Check(name="board", mark=mark, value=value, reason=said))
        # The size is worth a mark only where it is wrong.
        return tuple(c for c in found if c is not size or c.mark == "fault"), numbers

    def _warn_once(self, state: ArmState) -> None:
        """Compare the controller with the plan's chain and with its own first tool offset."""
        found = [checks.check_pose(state, self._plan.chain.forward(state.joints))]
        if self._tool is None:
            self._tool = state.T_ee_tcp
        found.append(checks.check_tool(state, self._tool))
        for check in found:
            if check.mark != "good" and check.name not in self._warned:
                self._warned.add(check.name)
                self.warnings.append(check.reason)

    def _accepted(self, shot: Shot) -> Shot:
        self._before = checks.kept(shot.frame, shot.state)
        if not shot.notes:  # what is doubtful must not become what is usual
            self._history.append(shot.numbers)
        return shot


def check_arm(plan: CapturePlan, arm: Arm) -> ArmState:
    """Return the arm's state if it is the arm that the plan was made for.

    Raises:
        InputError: by its name or by its flange pose it is another one.
    """
    remedy = "Use the plan of this arm, or make one: `realsim plan --arm`."
    if arm.name in known_chains() and arm.name != plan.robot:
        raise InputError(
            f"the plan was made for a {plan.robot}, this arm is a {arm.name}. {remedy}"
        )
    if len(arm.limits.lower) != plan.chain.joints:
        raise InputError(
            f"the plan, made for a {plan.robot}, moves {plan.chain.joints} joints; {arm.name} has "
            f"{len(arm.limits.lower)}. {remedy}"
        )
    if not np.all(arm.limits.contains(plan.joints)):
        raise InputError(
            f"the plan, made for a {plan.robot}, leaves the joint limits of {arm.name}. {remedy}"
        )
    state = arm.state()
    gap_mm, _ = checks.pose_gap(plan.chain.forward(state.joints), state.T_base_ee)
    if gap_mm > WRONG_ARM_MM:
        alike = known_chains(len(state.joints)).items()
        gaps = {n: checks.pose_gap(c.forward(state.joints), state.T_base_ee)[0] for n, c in alike}
        likely = min(gaps, key=lambda name: gaps[name])
        hint = f" It moves like a {likely}." if gaps[likely] < WRONG_ARM_MM else ""
        raise InputError(
            f"the plan's {plan.robot} would have its flange {gap_mm:.0f} mm from where the "
            f"controller of {arm.name} says it is (a factory calibration explains 5 mm).{hint} "
            f"{remedy}"
        )
    return state


def _better(a: Shot | None, b: Shot) -> Shot:
    """Return the shot with fewer doubts, of equals the sharper one."""
    if a is None:
        return b
    return min(a, b, key=lambda s: (len(s.notes), -s.numbers.sharpness))


def _measured_of(entry: Mapping[str, Any]) -> Measured | None:
    """Return the numbers that the log keeps of a view stored without a note, else None."""
    numbers = entry.get("measured")
    if entry.get("event") != "stored" or entry.get("notes") or not isinstance(numbers, dict):
        return None
    try:
        return Measured(**{str(k): float(v) for k, v in numbers.items()})  # pyright: ignore[reportUnknownArgumentType, reportUnknownVariableType]
    except (TypeError, ValueError):
        return None


def run_of_notes(recent: Sequence[Sequence[str]], length: int) -> str:
    """Return the note that each of the last `length` views has, by its first word, or ''."""
    if len(recent) < length:
        return ""
    common = set.intersection(*({n.split()[0] for n in notes} for notes in recent[-length:]))
    return next((n for n in recent[-1] if n.split()[0] in common), "")
