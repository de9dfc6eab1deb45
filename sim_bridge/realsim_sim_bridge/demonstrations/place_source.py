"""Attempts that go on after the lift: the object is carried somewhere, let go, and left alone.

The grasp and the lift are those of the School, replayed. The hand then keeps its orientation, moves
level over the goal, straight down, opens and withdraws: gravity pulls at the object in the hand as
it did at the end of the lift, slower moves than that one change nothing, and what was held goes on
being held. Let go a millimetre over the table, the object falls by PyBullet among its neighbours
(`falling`); where it is then decides whether the goal is met. A grasp that was lost before the end
of the lift is an attempt that failed.
"""

from dataclasses import replace
from typing import Any

import numpy as np

from realsim.arrays import Array, Int64
from realsim.errors import InputError
from realsim.geometry import se3
from realsim.records.checked_arrays import rows_of
from realsim.records.grasps import PHASES
from realsim.robots.compiled_chain import follow_lines
from realsim_sim_bridge.arm.timing import trapezoid, trapezoid_share
from realsim_sim_bridge.demonstrations.attempt_motion import AttemptMotion, fall
from realsim_sim_bridge.demonstrations.placing import PlaceGoal, Standing, goals_of, middle, unmet
from realsim_sim_bridge.demonstrations.records import ALL_PHASES, GraspGoal
from realsim_sim_bridge.demonstrations.source import (
    AttemptName,
    Demonstration,
    DemonstrationSource,
    NotAttempted,
    in_words,
)

LIFT = PHASES.index("lift")
CARRY, LOWER, RELEASE, WITHDRAW = (
    ALL_PHASES.index(n) for n in ("carry", "lower", "release", "withdraw")
)
SPEED, ACCELERATION = 0.15, 0.5
"""Speed and acceleration of the hand as it carries [m/s, m/s^2]: less than in the lift."""
DROP_M = 0.001
"""Height over the table at which the fingers open [m]."""
WITHDRAW_M = 0.10
"""How far the hand withdraws [m]."""
REST_S = 0.5
"""How long the object is watched after the hand has gone [s]."""
OVER_M = 0.01
"""Least height of what is carried over everything that stands there [m]."""


class PlacingSource(DemonstrationSource):
    """The attempts of a School, each with a place where its object is to be put."""

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        """Compose the goals; arguments as of `DemonstrationSource`.

        Raises:
            InputError: as there, or there is no attempt with a goal.
        """
        super().__init__(*args, **kwargs)
        scenery = self.scenery
        ahead = scenery.pictures.middle_xy - scenery.T_table_base[:2, 3]
        length = float(np.linalg.norm(ahead))
        self.standing = Standing(
            corners={
                i: se3.transform(T, scenery.models[i].mesh.vertices)
                for i, T in scenery.Ts_table_obj.items()
            },
            names={i: in_words(m.name) for i, m in scenery.models.items()},
            ahead=ahead / length if length > 1e-6 else np.array([1.0, 0.0]),
        )
        self._places: dict[AttemptName, PlaceGoal] = {}
        without: list[NotAttempted] = []
        for number, name in enumerate(self.attempts):
            place = self._place(name, number)
            if place is None:
                why = "there is no place on the table that the arm reaches with this grasp"
                without.append(NotAttempted(instance=name.instance, grasp=name.grasp, why=why))
            else:
                self._places[name] = place
        self.attempts = tuple(self._places)
        self.not_attempted = (*self.not_attempted, *without)
        if not self.attempts:
            raise InputError(
                f"no grasp of '{self._grasps.name}' can be followed by putting the object "
                "somewhere: there is no free place that the arm reaches. Leave out --task place."
            )

    def goal(self, attempt: int) -> GraspGoal:
        """Return what an attempt is at, without replaying it."""
        place = self._places[self.attempts[attempt]]
        return replace(super().goal(attempt), language=place.language, place=place)

    def _place(self, name: AttemptName, number: int) -> PlaceGoal | None:
        """Return the goal of an attempt: of those that the arm reaches, each in its turn."""
        phase, joints = self._lifted(name)
        if not np.any(phase == LIFT):
            return None
        goals = list(goals_of(self.standing, name.instance, number))
        lowest = float(self.standing.corners[name.instance][:, 2].min())
        lift_m = self._configs[name.instance].reach.lift_m
        for k in range(len(goals)):
            goal = goals[(number + k) % len(goals)]
            if self._path(joints, goal.shift_m, lift_m - lowest) is not None:
                return goal
        return None

    def _lifted(self, name: AttemptName) -> tuple[Int64, Array]:
        """Return the phases of an attempt's samples, and the joints (n,) at the lift's end."""
        attempts = self._grasps.trajectories[name.instance]
        rows = attempts.attempt(name.grasp)
        assert rows is not None, "the name comes from the trajectories"
        phase = attempts.phase[rows]
        last = int(np.flatnonzero(phase <= LIFT)[-1])
        return phase, attempts.joints_rad[rows][last]

    def _path(
        self, joints: Array, shift_m: tuple[float, float], down_m: float
    ) -> tuple[tuple[Array, Array], ...] | None:
        """Return distances (W,) [m] and joints (W, n) of the moves: level, down, up; None = none.

        The arm keeps its limits and the table's plane; objects are passed above.
        """
        tops = max(float(c[:, 2].max()) for c in self.standing.corners.values())
        if down_m < tops + OVER_M:
            return None
        R = se3.invert(self.scenery.T_table_base)[:3, :3]
        level = np.array([*shift_m, 0.0])
        length = float(np.linalg.norm(level))
        moves = ((level / length, length), (np.array([0.0, 0.0, -1.0]), down_m - DROP_M),
                 (np.array([0.0, 0.0, 1.0]), WITHDRAW_M))  # fmt: skip
        out: list[tuple[Array, Array]] = []
        for direction, distance in moves:
            along = np.linspace(0.0, distance, max(2, int(np.ceil(distance / 0.01)) + 1))
            path, _, worst = follow_lines(
                self.arm.numbers, np.ascontiguousarray(joints[None]),
                np.ascontiguousarray(self.arm.forward(joints)[None]),
                np.ascontiguousarray((R @ direction)[None]), along,
            )  # fmt: skip
            if worst[0] > 1e-4 or not np.all(self.arm.within_limits(path[0], 0.01)):
                return None
            out.append((along, path[0]))
            joints = path[0, -1]
        return tuple(out)

    def _replayed(self, name: AttemptName) -> Demonstration:
        """Return an attempt, replayed, and what became of its goal."""
        grasped = super()._replayed(name)
        motion, place = grasped.motion, self._places[name]
        end = int(np.flatnonzero(motion.phase <= LIFT)[-1])
        held = bool(motion.held[end]) and np.any(motion.phase == LIFT)
        if not held:
            why = grasped.outcome.failure or "the object was lost before it was lifted"
            outcome = replace(grasped.outcome, success=False, failure=why)
            return replace(grasped, outcome=outcome)
        lifted = replace(rows_of(motion, slice(end + 1)), notes=())
        T_lifted = motion.Ts_table_obj[end]
        corners = se3.transform(T_lifted, self.scenery.models[name.instance].mesh.vertices)
        # What has slipped in the hand is put where it is to be, not the hand.
        x, y = middle(self.standing.corners[name.instance]) + place.shift_m - middle(corners)
        path = self._path(motion.joints_rad[end], (float(x), float(y)), float(corners[:, 2].min()))
        if path is None:
            why = "place: the arm cannot carry the object there as the hand holds it"
            outcome = replace(grasped.outcome, success=False, failure=why)
            return replace(grasped, motion=lifted, outcome=outcome)
        motion = self._placed(name, lifted, path)
        missing = unmet(
            place, self.standing, name.instance,
            self.scenery.Ts_table_obj[name.instance], motion.Ts_table_obj[-1],
        )  # fmt: skip
        failure = f"place: {missing}" if missing else ""
        outcome = replace(grasped.outcome, success=not missing, failure=failure)
        return replace(grasped, motion=motion, outcome=outcome)

    def _placed(
        self, name: AttemptName, lifted: AttemptMotion, path: tuple[tuple[Array, Array], ...]
    ) -> AttemptMotion:
        """Return a motion that goes on after the lift along a path, and the object's fall."""
        dt, config = 1.0 / self.config.rate_hz, self._configs[name.instance]
        opening, speed = float(lifted.opening_m[-1]), 2.0 * config.reach.timing.close_speed
        opened = float(lifted.opening_m.max())
        joints: list[Array] = []
        phases: list[int] = []
        openings: list[float] = []
        for number, (along, corners) in zip((CARRY, LOWER, WITHDRAW), path, strict=True):
            if number == WITHDRAW:
                count = max(1, int(np.ceil((opened - opening) / speed / dt)))
                joints += [joints[-1]] * count
                phases += [RELEASE] * count
                openings += [min(opened, opening + speed * dt * (k + 1)) for k in range(count)]
            share = _trapezoid(float(along[-1]), dt)
            at = share * along[-1]
            joints += [np.array([np.interp(s, along, q) for q in corners.T]) for s in at]
            phases += [number] * len(at)
            openings += [opened if number == WITHDRAW else opening] * len(at)
        rest = round(REST_S / dt)
        joints, phases, openings = (
            joints + [joints[-1]] * rest, phases + [WITHDRAW] * rest, openings + [opened] * rest,
        )  # fmt: skip
        q = np.array(joints)
        Ts_base_ee = self.arm.forward(q)
        phase = np.array(phases, np.int64)
        first = int(np.argmax(phase == RELEASE))
        Ts = np.empty((len(q), 4, 4))
        T_ee_obj = se3.invert(self.scenery.T_table_base @ lifted.Ts_base_ee[-1])
        T_ee_obj = T_ee_obj @ lifted.Ts_table_obj[-1]
        Ts[:first] = self.scenery.T_table_base @ Ts_base_ee[:first] @ T_ee_obj
        others = [c for i, c in self.standing.corners.items() if i != name.instance]
        times = (np.arange(1, len(q) - first + 1) * dt).astype(np.float64)
        Ts[first:] = fall(self._body(name.instance), Ts[first - 1], np.zeros(6), others, times)
        held = np.arange(len(q)) < first
        command = np.where(held, 0.0, np.array(openings))
        steps = lifted.time_s[-1] + dt * np.arange(1, len(q) + 1)
        return replace(
            lifted,
            time_s=np.concatenate([lifted.time_s, steps]),
            joints_rad=np.concatenate([lifted.joints_rad, q]),
            opening_m=np.concatenate([lifted.opening_m, np.array(openings)]),
            command_m=np.concatenate([lifted.command_m, command]),
            phase=np.concatenate([lifted.phase, phase]),
            held=np.concatenate([lifted.held, held]),
            Ts_base_ee=np.concatenate([lifted.Ts_base_ee, Ts_base_ee]),
            Ts_table_obj=np.concatenate([lifted.Ts_table_obj, Ts]),
        )


def _trapezoid(length_m: float, dt: float) -> Array:
    """Return the shares (S,) of a move that are done after each step; the last is 1."""
    one = np.array([length_m])
    ramp, duration = trapezoid(one, np.array([SPEED]), np.array([ACCELERATION]))
    times = np.arange(1, int(np.ceil(float(duration[0]) / dt)) + 1) * dt
    return trapezoid_share(times.astype(np.float64), float(ramp[0]), float(duration[0]))
