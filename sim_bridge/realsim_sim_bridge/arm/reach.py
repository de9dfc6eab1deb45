"""Does an arm reach a grasp: inverse kinematics, straight approach, lift, and the way there.

The arm stands where a lab's does, or hangs above the table with its base tilted by 90 degrees (the
paper's "perfect reach"). For each candidate the closed-form solutions at the grasp are followed
back along the approach and up along the table's normal without changing branch, the nearest to home
first; the first whose moves are free and that can be reached from home is kept.
"""

from dataclasses import dataclass, replace

import numpy as np

from realsim.arrays import Array, Int64, Mask
from realsim.errors import InputError
from realsim.geometry import se3
from realsim.records.grasps import GraspTrajectories
from realsim.robots.compiled_chain import follow_lines
from realsim_sim_bridge.arm import stage_motion
from realsim_sim_bridge.arm.arm_space import AT_LIMITS, FREE, IN_TABLE, ArmSpace, in_words
from realsim_sim_bridge.arm.grasping_arm import GraspingArm
from realsim_sim_bridge.arm.joint_path import connect
from realsim_sim_bridge.arm.obstacles import obstacles_of
from realsim_sim_bridge.arm.reach_config import ReachConfig, base_on_table, home_joints
from realsim_sim_bridge.arm.straight_moves import first_touched, touched_when_lifted
from realsim_sim_bridge.arm.timing import timed_path
from realsim_sim_bridge.grasping.candidates import Surroundings
from realsim_sim_bridge.grasping.hand_free import lowest_corner
from realsim_sim_bridge.slip.motion import SlipMotion

__all__ = ["Reach", "ReachConfig", "ReachTask", "base_on_table", "check_reach", "home_joints"]


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Reach:
    """Which candidates the arm can take."""

    reachable: Mask
    """(N,) whether there is a collision-free trajectory to closure, and a free lift."""
    joints: Array
    """(N, n) joint angles at the grasp [rad]; NaN where there are none."""
    joints_lifted: Array
    """(N, n) after the lift [rad]; NaN likewise."""
    reasons: tuple[str, ...]
    """(N,) why not; '' = reachable."""
    planned: int
    """How many needed more than the straight move from home."""
    stage_possible: Mask
    """(N, 3) whether the arm can lift, oscillate and swing as the slip test does, within its joint
    limits and speeds; False where not reachable or not computed."""
    notes: tuple[str, ...]
    """(N,) why a stage is not possible, or how it is cut; '' = nothing to say."""
    trajectories: GraspTrajectories | None = None
    """The joints over time of each reachable row; None = there is none, or they are not asked
    for."""


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class ReachTask:
    """The grasps of one object among its neighbours, in the table's frame."""

    Ts_table_grasp: Array
    """(N, 4, 4) [m]."""
    widths_m: Array
    """(N,) [m]."""
    openings_m: Array
    """(N,) [m]."""
    obj: Surroundings
    """Points on the grasped object."""
    neighbours: Surroundings
    """Points on the others."""
    middle_xy: tuple[float, float]
    """Middle of the scene on the table [m]: the arm's home is above it."""


def check_reach(
    task: ReachTask,
    config: ReachConfig,
    arm: GraspingArm,
    rng: np.random.Generator,
    motion: SlipMotion | None = None,
) -> Reach:
    """Return which grasps have a collision-free trajectory to closure and lift.

    Args:
        task: the grasps and what is around them.
        config: the arm's place and moves.
        arm: the arm with its hand.
        rng: chance for the planner alone.
        motion: the stages' motions; None = the slip test's own with the configuration's lift.

    Raises:
        InputError: home cannot be reached, or the motion's lift is not the configuration's.
    """
    motion = motion or SlipMotion(lift_height_m=config.lift_m)
    if abs(motion.lift_height_m - config.lift_m) > 1e-9:
        raise InputError(
            f"the slip test lifts by {motion.lift_height_m} m and the arm is asked to lift by "
            f"{config.lift_m} m; make slip.motion.lift_height_m and reach.lift_m equal."
        )
    return _ReachCheck(task, config, arm, motion).run(rng)


IK, AT_GRASP, APPROACH, LIFT, BEFORE, HOME = range(6)
"""How far a grasp got: its reason is that of the branch that got farthest."""
_MOVES = {
    AT_GRASP: "the arm at the grasp",
    APPROACH: "the approach",
    LIFT: "the lift",
    BEFORE: "the arm before the approach",
}


class _ReachCheck:
    """The check of one object's grasps; a `branch` is one solution at one grasp."""

    def __init__(
        self, task: ReachTask, config: ReachConfig, arm: GraspingArm, motion: SlipMotion
    ) -> None:
        self._task, self._config, self._arm, self._motion = task, config, arm, motion
        self._T_table_base = base_on_table(task.middle_xy, config, arm)
        self._T_base_table = se3.invert(self._T_table_base)
        self._Ts_base_grasp = self._T_base_table @ task.Ts_table_grasp
        own, others = task.obj, task.neighbours
        obstacles = obstacles_of(
            np.concatenate([own.points, others.points]),
            np.concatenate([own.instances, others.instances]),
            np.arange(len(own.points) + len(others.points)) < len(own.points),
        )
        self._space = ArmSpace(self._T_table_base, obstacles, config.space, arm)
        self._home = home_joints(config, arm, task.middle_xy)
        n, back, up = (
            len(task.widths_m),
            _distances(config.approach_m, config),
            _distances(config.lift_m, config),
        )
        self._back, self._up = back, up
        self._reasons = ["no inverse kinematics at the grasp"] * n
        self._got = np.full(n, IK)
        self._done = np.zeros(n, dtype=np.bool_)
        self._approach = np.full((n, 2, len(back), arm.joints), np.nan)
        self._lift = np.full((n, 2, len(up), arm.joints), np.nan)
        self._bent: dict[int, Array] = {}

    def run(self, rng: np.random.Generator) -> Reach:
        """Go through the moves: what does not depend on the arm first, then branch by branch."""
        open_rows = self._in_workspace()
        open_rows = open_rows[self._hand_is_free(open_rows)]
        waiting = self._try_branches(open_rows)
        self._plan(waiting, rng)
        done = self._done
        wanted = self._config.with_trajectories and bool(done.any())
        motions = self._motions() if wanted else None
        n = len(done)
        possible, notes = np.zeros((n, len(stage_motion.MOVED_STAGES)), dtype=np.bool_), [""] * n
        if motions is not None:
            possible[done] = motions.possible
            for row, note in zip(np.nonzero(done)[0].tolist(), motions.notes, strict=True):
                notes[row] = note
        return Reach(
            reachable=done,
            joints=np.where(done[:, None], self._approach[:, 0, 0], np.nan),
            joints_lifted=np.where(done[:, None], self._lift[:, 0, -1], np.nan),
            reasons=tuple(
                "" if ok else why for ok, why in zip(done.tolist(), self._reasons, strict=True)
            ),
            planned=len(self._bent),
            stage_possible=possible,
            notes=tuple(notes),
            trajectories=None if motions is None else motions.trajectories,
        )

    # --- before any joint angle ----------------------------------------------------------------

    def _in_workspace(self) -> Int64:
        """Return the rows whose wrist is within reach, and say of the others how far it is."""
        out, reach = self._arm.wrist_distance(self._Ts_base_grasp), self._arm.wrist_reach_m
        for row in np.nonzero(out > reach)[0].tolist():
            self._reasons[row] += (
                f": the wrist would be {out[row]:.2f} m from the arm's shoulder, its reach is "
                f"{reach:.2f} m"
            )
        return np.nonzero(out <= reach)[0].astype(np.int64)

    def _hand_is_free(self, rows: Int64) -> Mask:
        """Return whether hand and lifted object are free on the straight moves, and say if not."""
        task, config = self._task, self._config
        Ts = task.Ts_table_grasp[rows]
        out = -config.approach_m * Ts[:, :3, 2]
        up = np.tile([0.0, 0.0, config.lift_m], (len(rows), 1))
        open_hand = self._arm.hand.boxes(task.openings_m[rows])
        closed_hand = self._arm.hand.boxes(task.widths_m[rows])
        obstacles, clearance = self._space.obstacles, config.hand_clearance_m
        approach = first_touched(open_hand, Ts, out, obstacles, clearance, own_too=True)
        Ts_out = Ts.copy()
        Ts_out[:, :3, 3] += out
        lowest = np.minimum(lowest_corner(open_hand, Ts), lowest_corner(open_hand, Ts_out))
        approach = np.where(lowest < 0, IN_TABLE, approach)
        lift = first_touched(closed_hand, Ts, up, obstacles, clearance, own_too=False)
        touched = touched_when_lifted(
            task.obj, task.neighbours, config.lift_m, config.lifted_clearance_m
        )
        for row, code in zip(rows.tolist(), lift.tolist(), strict=True):
            if code != FREE:
                self._reasons[row] = f"the lift {in_words(code)}"
            elif touched is not None:
                self._reasons[row] = f"the lifted object touches the object of instance {touched}"
        for row, code in zip(rows.tolist(), approach.tolist(), strict=True):
            if code != FREE:
                self._reasons[row] = f"the approach {in_words(code)}"
        return (approach == FREE) & (lift == FREE) & (touched is None)

    # --- branch by branch ------------------------------------------------------------------------

    def _try_branches(self, rows: Int64) -> dict[int, tuple[Array, Array]]:
        """Keep of each row the first branch that is free all the way from home.

        Returns:
            approach and lift, joints and slopes (2, W, n), of the first branch of each other row
            that is free but for the move from home.
        """
        config = self._config
        owner, q = self._arm.inverse(
            self._Ts_base_grasp[rows], config.held_values, config.limit_margin_rad, self._home
        )
        owner = rows[owner]
        order = np.lexsort((np.linalg.norm(q - self._home, axis=1), owner))
        owner, q = owner[order], q[order]
        rank = np.arange(len(owner)) - np.searchsorted(owner, owner)
        followed = np.zeros(len(self._done), dtype=np.int64)
        waiting: dict[int, tuple[Array, Array]] = {}
        home_free = self._at_home() == FREE
        for turn in range(int(rank.max(initial=-1)) + 1):
            branch = (rank == turn) & ~self._done[owner] & (followed[owner] < config.branches)
            at, angles = owner[branch], q[branch]
            free = self._note(at, self._blame(angles[:, None], at), AT_GRASP)
            at, angles = at[free], angles[free]
            followed[at] += 1
            at, approach, lift = self._follow(at, angles)
            before = approach[:, 0, -1]
            free = self._note(at, self._blame(before[:, None], at, with_hand=True), BEFORE)
            at, approach, lift, before = at[free], approach[free], lift[free], before[free]
            moves = np.stack([np.broadcast_to(self._home, before.shape), before], axis=1)
            direct = self._blame(moves, at, with_hand=True) == FREE if home_free else at < 0
            self._keep(at[direct], approach[direct], lift[direct])
            for row, a, b in zip(at[~direct], approach[~direct], lift[~direct], strict=True):
                waiting.setdefault(int(row), (a, b))
        return {row: moves for row, moves in waiting.items() if not self._done[row]}

    def _at_home(self) -> int:
        """Return what stops the arm at home with its hand open, or FREE."""
        widest = np.array([self._task.openings_m.max(initial=0.0)])
        return int(self._space.blame(self._home[None], widest, with_hand=True)[0])

    def _follow(self, at: Int64, q: Array) -> tuple[Int64, Array, Array]:
        """Follow approach and lift from q (B, n); return what is left: rows and both moves."""
        still = self._T_base_table[:3, :3]
        Ts = self._Ts_base_grasp[at]
        approach, free = self._line(q, Ts, -Ts[:, :3, 2], self._back, at, APPROACH)
        at, q, Ts, approach = at[free], q[free], Ts[free], approach[free]
        up = np.tile(still[:, 2], (len(at), 1))
        lift, free = self._line(q, Ts, up, self._up, at, LIFT)
        return at[free], approach[free], lift[free]

    def _line(
        self, q: Array, Ts: Array, directions: Array, distances: Array, at: Int64, move: int
    ) -> tuple[Array, Mask]:
        """Return joints and slopes (B, 2, W, n) along lines, and which are free."""
        joints, slopes, inside = self._followed(q, Ts, directions, distances)
        codes = np.full(len(at), AT_LIMITS)
        codes[inside] = self._blame(joints[inside], at[inside])
        return np.stack([joints, slopes], axis=1), self._note(at, codes, move)

    def _followed(
        self, q: Array, Ts: Array, directions: Array, distances: Array
    ) -> tuple[Array, Array, Mask]:
        """Return joints and slopes (B, W, n) along lines, and whether they keep the limits."""
        config = self._config
        joints, slopes, error = follow_lines(
            self._arm.numbers,
            np.ascontiguousarray(q),
            np.ascontiguousarray(Ts),
            np.ascontiguousarray(directions),
            distances,
        )
        within = self._arm.within_limits(joints, config.limit_margin_rad).all(axis=1)
        return joints, slopes, within & (error < config.tolerance)

    def _blame(self, paths: Array, at: Int64, *, with_hand: bool = False) -> Int64:
        """Return what stops paths (B, W, n) of the rows `at`."""
        openings = np.ascontiguousarray(self._task.openings_m[at], dtype=np.float64)
        return self._space.blame_moves(paths, openings, with_hand=with_hand)

    def _note(self, at: Int64, codes: Int64, move: int) -> Mask:
        """Return which branches are free, and note for the rows `at` why the others are not."""
        free = codes == FREE
        for row, code in zip(at[~free].tolist(), codes[~free].tolist(), strict=True):
            if move > self._got[row]:
                self._got[row] = move
                self._reasons[row] = f"{_MOVES[move]} {in_words(code)}"
        return free

    def _keep(self, at: Int64, approach: Array, lift: Array) -> None:
        """Keep branches of the rows `at`."""
        self._approach[at], self._lift[at], self._done[at] = approach, lift, True

    # --- the way there ---------------------------------------------------------------------------

    def _plan(self, waiting: dict[int, tuple[Array, Array]], rng: np.random.Generator) -> None:
        """Look for paths from home round obstacles."""
        at_home = self._at_home()
        for row in sorted(waiting):
            if at_home != FREE:
                self._reasons[row] = f"no path from home: the arm at home {in_words(at_home)}"
                continue
            approach, lift = waiting[row]
            opening, config = float(self._task.openings_m[row]), self._config.planner
            path = connect(self._home, approach[0, -1], self._space, opening, config, rng)
            if path is None:
                self._reasons[row] = "no path from home"
                continue
            self._bent[row] = path
            at = np.array([row])
            self._keep(at, approach[None], lift[None])

    # --- over time -------------------------------------------------------------------------------

    def _motions(self) -> stage_motion.StageMotions:
        """Return all reachable grasps' attempts over time."""
        task, motion, timing = self._task, self._motion, self._config.timing
        # A slower hand than Franka's closes at its own speed.
        closing = min(timing.close_speed, self._arm.hand.closing_speed)
        timing = replace(timing, close_speed=closing)
        rows = np.nonzero(self._done)[0].astype(np.int64)
        bent: dict[int, tuple[Array, float]] = {}
        for attempt, row in enumerate(rows.tolist()):
            if row in self._bent:
                at = np.array([row])

                def is_free(q: Array, at: Int64 = at) -> bool:
                    return bool(self._blame(q[None], at, with_hand=True)[0] == FREE)

                bent[attempt] = timed_path(self._bent[row], is_free, self._arm.limits, timing)
        lifted = self._lift[rows, 0, -1]
        Ts = self._Ts_base_grasp[rows].copy()
        Ts[:, :3, 3] += self._config.lift_m * self._T_base_table[:3, 2]
        sides = _distances(2 * motion.oscillation_m, self._config)
        yes = np.ones(len(rows), dtype=np.bool_)
        x, y = (self._shaken(lifted, Ts, axis, sides) for axis in (0, 1))
        return stage_motion.stage_motions(
            stage_motion.Attempts(
                arm=self._arm,
                rows=rows,
                home=self._home,
                bent=bent,
                approach=_as_line(self._approach[rows], self._back, yes),
                lift=_as_line(self._lift[rows], self._up, yes),
                along_x=x,
                along_y=y,
                openings_m=task.openings_m[rows],
                widths_m=task.widths_m[rows],
            ),
            motion,
            timing,
        )

    def _shaken(self, lifted: Array, Ts: Array, axis: int, distances: Array) -> stage_motion.Line:
        """Return the line of the lifted hand along a table axis."""
        direction = np.tile(self._T_base_table[:3, axis], (len(lifted), 1))
        joints, slopes, inside = self._followed(lifted, Ts, direction, distances)
        return stage_motion.Line(nodes=distances, joints=joints, slopes=slopes, possible=inside)


def _distances(length_m: float, config: ReachConfig) -> Array:
    """Return distances from 0 to the length, steps of about `step_m`."""
    return np.linspace(0.0, length_m, max(round(length_m / config.step_m), 1) + 1)


def _as_line(moves: Array, distances: Array, possible: Mask) -> stage_motion.Line:
    """Return joints and slopes (A, 2, W, n) as a line."""
    return stage_motion.Line(
        nodes=distances, joints=moves[:, 0], slopes=moves[:, 1], possible=possible
    )
