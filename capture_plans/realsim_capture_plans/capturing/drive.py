"""Drive a plan without a camera: the rehearsal of the moves alone."""

import time
from collections import deque
from collections.abc import Sequence

import numpy as np

from realsim_capture_plans.capturing import checks
from realsim_capture_plans.capturing.look import CaptureConfig, check_arm
from realsim_capture_plans.capturing.operator import CaptureStatus, Operator
from realsim_capture_plans.capturing.route import NoWayError, Route
from realsim_capture_plans.capturing.run import CaptureSummary, Outcome
from realsim_capture_plans.capturing.settle import until_still
from realsim_capture_plans.devices.interfaces import Arm, ArmState, ArmStoppedError, DeviceError
from realsim_capture_plans.planning.record import CapturePlan


def drive_only(
    plan: CapturePlan,
    arm: Arm,
    *,
    config: CaptureConfig,
    operator: Operator,
    views: Sequence[int] = (),
) -> CaptureSummary:
    """Visit the views in the plan's order on the ways of a capture; look at nothing, store nothing.

    Args:
        plan: where to go.
        arm: the arm, anywhere from where the way to the plan is free.
        config: how fast, and when the arm counts as standing at its goal.
        operator: who is told and asked.
        views: only these; empty = all.

    Returns:
        What was visited (`captured`), skipped (`left_out`), and found wrong of the flange's pose.

    Raises:
        InputError: the plan was made for another arm.
        DeviceError: the arm stopped, and nobody could be asked.
    """
    check_arm(plan, arm, config.checks)
    return _Drive(plan, arm, config, operator).carry_out(sorted(set(views)) or range(len(plan)))


class _Drive:
    """One tour of the arm."""

    def __init__(
        self, plan: CapturePlan, arm: Arm, config: CaptureConfig, operator: Operator
    ) -> None:
        self._plan, self._arm, self._config, self._operator = plan, arm, config, operator
        self._route = Route(plan)
        self._place: int | None = None
        self._total = 0
        self._visited: list[int] = []
        self._skipped: list[int] = []
        self._warning = ""
        self._queue: deque[int] = deque()

    def carry_out(self, views: Sequence[int]) -> CaptureSummary:
        """Visit the views."""
        began = time.monotonic()
        self._queue, self._total = deque(views), len(views)
        while self._queue:
            k = self._queue.popleft()
            outcome = self._asked_before(k) or self._visit(k)
            if outcome == "stopped":
                break
            (self._visited if outcome == "stored" else self._skipped).append(k)
            self._show(k, "stored")
        return CaptureSummary(
            captured=len(self._visited), skipped=0, seconds=time.monotonic() - began, rejected=(),
            left_out=tuple(self._skipped), warnings=(self._warning,) if self._warning else (),
            complete=len(self._visited) == self._total,
        )  # fmt: skip

    def _visit(self, k: int) -> Outcome:
        while True:
            try:
                self._go(k)
                return "stored"
            except DeviceError as error:
                self._place = None
                if (outcome := self._cleared(error)) is not None:
                    return outcome

    def _go(self, k: int) -> None:
        """Move to view k and wait until the arm stands there."""
        self._show(k, "moving")
        here, limit = self._arm.state().joints, self._config.arrival_rad
        place, self._place = self._place, None
        if place is not None and np.abs(here - self._plan.joints[place]).max() > limit:
            place = None  # somebody moved the arm
        way = self._route.from_anywhere(here, k) if place is None else self._route.along(place, k)
        scale, moves = self._config.speed_scale, self._plan.config
        for joints in way:
            self._arm.move(joints, scale * moves.speed, scale * moves.acceleration)
        self._show(k, "settling")
        state, _ = until_still(self._arm, self._config.still)
        off = float(np.abs(state.joints - self._plan.joints[k]).max())
        if off > limit:
            raise ArmStoppedError(
                f"view {k}: {self._arm.name} stands {off:.4f} rad off its goal (at most {limit} is "
                "accepted). Was it stopped? Clear the stop, then go on.",
                "off goal",
            )
        self._place = k
        self._warn_once(state)

    def _warn_once(self, state: ArmState) -> None:
        chain = self._plan.chain
        check = checks.check_pose(state, chain.forward(state.joints), self._config.checks)
        if check.mark != "good" and not self._warning:
            self._warning = check.reason
            self._operator.tell(check.reason, trouble=True)

    def _asked_before(self, k: int) -> Outcome | None:
        """Do what the operator typed; the arm stands."""
        for command in self._operator.commands():
            answer = command
            if command == "pause":
                text = f"paused before view {k}; nothing moves."
                answer = self._operator.ask(text, ("go", "skip", "stop"))
            if answer in ("skip", "stop"):
                return "skipped" if answer == "skip" else "stopped"
        return None

    def _cleared(self, error: DeviceError) -> Outcome | None:
        """Wait until a person has cleared what stopped the arm; None = try the view again.

        Raises:
            DeviceError: the same, where nobody can be asked.
        """
        while True:
            self._operator.tell(str(error), trouble=True)
            answer = self._operator.ask(
                "Clear it at the robot, step back, then go on.", ("go", "skip", "stop")
            )
            if answer is None:
                raise error
            if answer != "go":
                return "skipped" if answer == "skip" else "stopped"
            try:
                if not isinstance(error, NoWayError):
                    self._arm.recover()
                return None
            except DeviceError as still:
                error = still

    def _show(self, k: int, doing: str) -> None:
        status = CaptureStatus(
            stored=len(self._visited), total=self._total, view=k, doing=doing,
            skipped=len(self._skipped), dry_run=True,
        )  # fmt: skip
        self._operator.show(status)
