"""One run over the views of a plan: what it is asked to do, does, and reports.

The arm goes along the plan's checked moves, or on lines that are checked on the spot.
"""

import time
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from datetime import UTC, datetime
from functools import partial
from typing import TYPE_CHECKING, Literal

import numpy as np

from realsim.arrays import Array, UInt8
from realsim.records import View
from realsim_capture_plans.capturing import look
from realsim_capture_plans.capturing.checks import Check
from realsim_capture_plans.capturing.log import CaptureLog, replace_view
from realsim_capture_plans.capturing.operator import CaptureStatus, Command, Operator
from realsim_capture_plans.devices.interfaces import Arm, ArmStoppedError, DepthCamera, DeviceError
from realsim_capture_plans.planning.record import CapturePlan

if TYPE_CHECKING:
    from realsim.store import SessionStore


class NoWayError(DeviceError):
    """Nothing of the plan can be reached freely from where the arm stands."""


class Route:
    """The corners of a plan's tour, and the way from any of them, or from anywhere, to a view."""

    def __init__(self, plan: CapturePlan) -> None:
        """List the corners: home, via points, views."""
        self._plan = plan
        corners, at_view = [plan.home], list[int]()
        for k in range(len(plan)):
            corners.extend(plan.move(k)[1:])
            at_view.append(len(corners) - 1)
        self._corners = np.stack(corners)
        self._at_view = at_view

    def along(self, place: int, k: int) -> list[Array]:
        """Return the joints to pass from view `place` to view k, along the tour either way."""
        start, goal = self._at_view[place], self._at_view[k]
        if start < goal:
            return list(self._corners[start + 1 : goal + 1])
        return list(self._corners[goal:start][::-1])

    def from_anywhere(self, here: Array, k: int) -> list[Array]:
        """Return the joints to pass from joints (6,) [rad] to view k.

        Straight to the view if that is free, else to the nearest corner of the tour that can be
        reached freely, and on along the tour.

        Raises:
            NoWayError: nothing of the tour can be reached freely.
        """
        plan, goal = self._plan, self._at_view[k]
        if np.array_equal(here, self._corners[goal]):
            return []
        model = plan.collision_model()
        stack, step = self._corners, plan.config.edge_step_rad
        if model.edges_free(here[None], stack[goal][None], step)[0]:
            return [stack[goal]]
        free = model.edges_free(np.broadcast_to(here, stack.shape), stack, step)
        if not np.any(free):
            raise NoWayError(
                f"from joints {np.round(here, 3).tolist()} rad no straight move to the plan is "
                f"free. Move the arm by hand to the plan's home {np.round(plan.home, 3).tolist()} "
                "rad."
            )
        nearest = int(np.argmin(np.where(free, np.abs(stack - here).max(-1), np.inf)))
        if nearest <= goal:
            return list(stack[nearest : goal + 1])
        return list(stack[goal : nearest + 1][::-1])


OnView = Callable[[int, UInt8], None]
"""Called with the number and the colour image of every view stored."""
Outcome = Literal["stored", "skipped", "stopped"]


@dataclass(frozen=True, kw_only=True, slots=True)
class CaptureSummary:
    """What a capture did."""

    captured: int
    """Views stored by this call (in a dry run: visited)."""
    skipped: int
    """Views that were there already."""
    seconds: float
    """Wall time [s]."""
    rejected: tuple[tuple[int, str], ...]
    """(view, reason) of every frame that was thrown away and taken again."""
    noted: tuple[tuple[int, str], ...] = ()
    """(view, reason) of every view that was stored although something is doubtful."""
    left_out: tuple[int, ...] = ()
    """Views that the operator skipped; the next run offers them again."""
    warnings: tuple[str, ...] = ()
    """What concerns the whole session, each said once."""
    complete: bool = True
    """Whether every view that was asked for is stored (in a dry run: was visited)."""


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class CaptureJob:
    """What a capture is to do beside taking every view, and whom it may ask."""

    operator: Operator = field(default_factory=Operator)
    """Who is told and asked; by default nobody."""
    board_check: look.BoardCheck | None = None
    """Says what is wrong with an image of the calibration target."""
    views: tuple[int, ...] | None = None
    """Take only these; by default all."""
    retake: tuple[int, ...] = ()
    """Take these again although they are stored; what was there is moved aside."""
    fixed: Sequence["tuple[DepthCamera, SessionStore]"] = ()
    """Cameras that stand still, each with its own session: grabbed when a view is stored."""
    on_view: OnView | None = None
    """Called with every view stored."""
    progress: Callable[[int, int], None] | None = None
    """Called with (views stored, views of the plan)."""


def _now() -> str:
    """Return the time of day (ISO 8601, UTC)."""
    return datetime.now(UTC).isoformat(timespec="milliseconds")


class Run:
    """One run over the views of a plan; without a store nothing is kept, without a camera seen."""

    def __init__(
        self,
        plan: CapturePlan,
        arm: Arm,
        camera: DepthCamera | None,
        config: look.CaptureConfig,
        looker: look.Looker,
        log: CaptureLog,
        job: CaptureJob,
        store: "SessionStore | None",
    ) -> None:
        self._plan, self._arm, self._camera, self._config = plan, arm, camera, config
        self._looker, self._log, self._job, self._store = looker, log, job, store
        self._operator = job.operator
        self._route = Route(plan)
        self._place: int | None = None
        self._done: set[int] = set()
        self._wanted: set[int] = set()
        self._captured = 0
        self._last: int | None = None
        self._queue: deque[int] = deque()
        self._skip = self._stop = False
        self._noted: dict[int, str] = {}
        self._recent: list[list[str]] = []
        self._left_out: list[int] = []
        self._told_warnings = 0
        self._idle_s = 0.0
        self._began = time.monotonic()

    def carry_out(self) -> CaptureSummary:
        """Visit the views in the plan's order."""
        views, retake = self._job.views, self._job.retake
        self._done = set() if self._store is None else set(self._store.completed)
        self._wanted = set(range(len(self._plan)) if views is None else views) | set(retake)
        todo = sorted(self._wanted - (self._done - set(retake)))
        skipped = (len(self._plan) if views is None else len(self._wanted)) - len(todo)
        self._queue = deque(todo)
        self._progress()
        if todo:
            self._log_begin()
        while self._queue and not self._stop:
            self._poll(self._queue[0])
            if self._stop:
                break
            k = self._queue.popleft()
            outcome: Outcome = "skipped" if self._skip else self._visit(k)
            self._skip = False
            if outcome == "stored":
                self._progress()
            if outcome == "skipped":
                self._leave_out(k)
        left = tuple(k for k in dict.fromkeys(self._left_out) if k not in self._done)
        summary = CaptureSummary(
            captured=self._captured,
            skipped=skipped,
            seconds=time.monotonic() - self._began,
            rejected=tuple(self._looker.rejected),
            noted=tuple(sorted(self._noted.items())),
            left_out=left,
            warnings=tuple(self._looker.warnings),
            complete=self._wanted <= self._done,
        )
        # Also of a run that was killed after its last view.
        if todo or any(e.get("event") != "ended" for e in self._log.entries[-1:]):
            self._log.add(
                "ended", at=_now(), captured=summary.captured, left_out=list(left),
                complete=summary.complete, seconds=round(summary.seconds, 1),
            )  # fmt: skip
        return summary

    def _progress(self) -> None:
        if self._job.progress is not None:
            self._job.progress(len(self._done), len(self._plan))

    def _log_begin(self) -> None:
        """Write down with what this run works."""
        self._log.add(
            "begun", at=_now(), plan_hash=self._plan.content_hash, arm=self._arm.description,
            camera=None if self._camera is None else self._camera.description,
            T_ee_tcp=self._arm.state().T_ee_tcp.tolist(),
            settle_s=self._config.settle_s, speed_scale=self._config.speed_scale,
        )  # fmt: skip

    # --- one view -----------------------------------------------------------------------------

    def _visit(self, k: int) -> Outcome:
        """Go to view k, look, store; ask a person where a device stops."""
        while True:
            try:
                self._drive(k)
                self._poll(k)
                if self._skip or self._stop:
                    return "skipped" if self._skip else "stopped"
                show = partial(self._show, k)
                if self._camera is None:
                    self._looker.stand(k, show)
                    self._tell_warnings()
                    self._count(k)
                    return "stored"
                rejected = len(self._looker.rejected)
                shot = self._looker.take(k, show)
                self._poll(k)
                if self._skip:
                    return "skipped"
                self._keep(k, shot, self._looker.rejected[rejected:])
                if self._job.on_view is not None:
                    self._job.on_view(k, shot.frame.rgb)
                return "stored"
            except DeviceError as error:
                self._place = None
                if (outcome := self._cleared(k, error)) is not None:
                    return outcome

    def _drive(self, k: int) -> None:
        """Move to view k on ways that are known to be free."""
        self._show(k, "moving", ())
        here = self._arm.state().joints
        place, self._place = self._place, None
        if place is not None:
            off = float(np.abs(here - self._plan.joints[place]).max())
            if off > self._config.arrival_rad:
                place = None  # somebody moved the arm
        way = self._route.from_anywhere(here, k) if place is None else self._route.along(place, k)
        scale, plan = self._config.speed_scale, self._plan.config
        for joints in way:
            self._arm.move(joints, scale * plan.speed, scale * plan.acceleration)
        self._place = k

    def _keep(self, k: int, shot: look.Shot, rejected: Sequence[tuple[int, str]]) -> None:
        """Put a frame on the disk and say so."""
        self._tell_warnings()
        aside = ""
        if self._store is not None:
            self._keep_fixed(k)
            state, frame = shot.state, shot.frame
            view = View(
                index=k, T_base_ee=state.T_base_ee, joints=state.joints, time_s=frame.time_s
            )
            if k in self._done:
                aside = replace_view(self._store, view, frame.rgb, frame.depth_m)
                self._operator.tell(f"view {k} taken again; the earlier one is {aside}_rgb.png")
            else:
                self._store.add_view(view, frame.rgb, frame.depth_m)
        self._count(k)
        reasons = [reason for _, reason in rejected]
        self._log.add(
            "stored", view=k, at=_now(), attempts=len(reasons) + 1, retaken=reasons,
            notes=shot.notes, measured=shot.numbers.to_json(), settle_s=round(shot.waited_s, 3),
            pose_mm=round(shot.pose_mm, 3), **({"earlier": aside} if aside else {}),
        )  # fmt: skip
        for reason in reasons:
            self._operator.tell(f"view {k} taken again: {reason}", trouble=True)
        self._note(k, shot.notes)
        self._show(k, "stored", shot.checks)

    def _keep_fixed(self, k: int) -> None:
        """Store what the fixed cameras see: first, because the hand's view says that all is there.

        Raises:
            DeviceError: one of them gives no frame.
        """
        frames = [camera.grab() for camera, _ in self._job.fixed]
        for (_, store), frame in zip(self._job.fixed, frames, strict=True):
            view = View(index=k, time_s=frame.time_s)
            if k in store.completed:  # taken again, or the run ended before the hand's view
                replace_view(store, view, frame.rgb, frame.depth_m)
            else:
                store.add_view(view, frame.rgb, frame.depth_m)

    def _count(self, k: int) -> None:
        self._done.add(k)
        self._captured += 1
        self._last = k

    def _tell_warnings(self) -> None:
        for text in self._looker.warnings[self._told_warnings :]:
            self._operator.tell(text, trouble=True)
            self._log.add("warning", at=_now(), text=text)
        self._told_warnings = len(self._looker.warnings)

    def _note(self, k: int, notes: list[str]) -> None:
        """Report a doubtful view; ask where several in a row have the same doubt."""
        self._noted.pop(k, None)
        self._recent.append(notes)
        if not notes:
            return
        self._noted[k] = "; ".join(notes)
        self._operator.tell(f"view {k} stored with a note: {self._noted[k]}", trouble=True)
        again = look.run_of_notes(self._recent, self._config.ask_after)
        if again:
            self._recent.clear()
            self._obey(
                self._ask(
                    f"{self._config.ask_after} views in a row: {again}. Look at lens, light and "
                    "scene.",
                    ("go", "redo", "stop"),
                )
            )

    def _leave_out(self, k: int) -> None:
        if k in self._done:
            self._operator.tell(f"view {k} stays as it was stored")
            return
        self._left_out.append(k)
        self._log.add("skipped", view=k, at=_now(), reason="by the operator")
        self._operator.tell(f"view {k} skipped; the next run offers it again")

    # --- the operator -------------------------------------------------------------------------

    def _show(self, k: int, doing: str, found: tuple[Check, ...]) -> None:
        spent = time.monotonic() - self._began - self._idle_s
        per_view = spent / self._captured if self._captured else None
        status = CaptureStatus(
            stored=len(self._wanted & self._done), total=len(self._wanted), view=k, doing=doing,
            checks=found, retaken=len(self._looker.rejected), noted=len(self._noted),
            skipped=len(self._left_out), dry_run=self._store is None,
            remaining_s=None if per_view is None else per_view * len(self._queue),
        )  # fmt: skip
        self._operator.show(status)

    def _poll(self, k: int) -> None:
        """Do what the operator typed; the arm stands."""
        for command in self._operator.commands():
            if command == "pause":
                self._log.add("paused", at=_now(), view=k)
                answer = self._ask(
                    f"paused before view {k}; nothing moves.", ("go", "redo", "skip", "stop")
                )
                self._log.add("resumed", at=_now(), answer=answer)
                self._obey(answer)
            else:
                self._obey(command)

    def _obey(self, command: Command | None) -> None:
        if command == "skip":
            self._skip = True
        elif command == "stop":
            self._stop = True
        elif command == "redo" and self._last is not None and self._last not in self._queue:
            self._queue.appendleft(self._last)
            self._operator.tell(f"view {self._last} will be taken again")

    def _ask(self, text: str, choices: Sequence[Command]) -> Command | None:
        began = time.monotonic()
        answer = self._operator.ask(text, choices)
        self._idle_s += time.monotonic() - began
        return answer

    def _cleared(self, k: int, error: DeviceError) -> Outcome | None:
        """Wait until a person has cleared what stopped a device; None = try the view again.

        Raises:
            DeviceError: the same, where nobody can be asked.
        """
        while True:
            stop = error.stop if isinstance(error, ArmStoppedError) else type(error).__name__
            self._log.add("trouble", at=_now(), view=k, kind=stop, message=str(error))
            self._operator.tell(str(error), trouble=True)
            answer = self._ask(
                "Clear it at the robot or the camera, step back, then go on.",
                ("go", "skip", "stop"),
            )
            if answer is None:
                raise error
            if answer != "go":
                self._obey(answer)
                self._skip = False
                return "skipped" if answer == "skip" else "stopped"
            try:
                self._recover(error)
            except DeviceError as still:
                error = still
                continue
            self._log.add("recovered", at=_now(), view=k)
            return None

    def _recover(self, error: DeviceError) -> None:
        """Make the device that stopped ready again."""
        if isinstance(error, look.NoGoodFrameError | NoWayError):
            return  # no device has stopped: a person has changed something
        if isinstance(error, ArmStoppedError) or self._camera is None:
            self._arm.recover()
            return
        for camera in (self._camera, *(fixed for fixed, _ in self._job.fixed)):
            camera.recover()
