"""The four-stage slip test: close, lift, oscillate, swing, in any engine.

Slip is the motion of the object's centre of mass and its rotation, both relative to the gripper,
since the start of the stage; its largest value over the stage counts. In the stage `close` the
object stands on its table among its neighbours (`Stand`), or is free and weightless where the trial
has none, and the reference is where the scene has it: the slip is how far the closing fingers moved
it. In the other stages the reference is where the stage before left it.
"""

from contextlib import ExitStack
from dataclasses import dataclass, field

import numpy as np

from realsim.arrays import Array, Mask, Rows
from realsim.errors import InputError
from realsim.geometry import se3
from realsim.records import STAGES
from realsim.records.checked_arrays import rows_of
from realsim.robots.hand import Hand, find_hand
from realsim_sim_bridge.grasping.antipodal import RaySurface
from realsim_sim_bridge.slip.engines import BulletSettings, MujocoSettings, make_engine
from realsim_sim_bridge.slip.motion import SlipMotion, stage_wrenches
from realsim_sim_bridge.slip.safety import closed_safety, hull_surface, resting
from realsim_sim_bridge.slip.score import ScoreLimits, score_stages
from realsim_sim_bridge.slip.stand import Stand
from realsim_sim_bridge.slip.world import (
    Closing,
    Engine,
    Grips,
    HandWorld,
    Meeting,
    Motion,
    PairStates,
    Replay,
    SlipBody,
    SlipPhysics,
)

CLOSE, LIFT, OSCILLATE, PENDULUM = range(len(STAGES))


NOT_SIMULATED = "not simulated"
"""How the failure of a stage ends that limit analysis decided (`SlipConfig.sure`)."""


@dataclass(frozen=True, kw_only=True, slots=True)
class SlipConfig:
    """Everything the slip test depends on besides the score's limits."""

    physics: SlipPhysics = field(default_factory=SlipPhysics)
    closing: Closing = field(default_factory=Closing)
    motion: SlipMotion = field(default_factory=SlipMotion)
    engine: BulletSettings | MujocoSettings = field(default_factory=BulletSettings)
    sample_s: float = 0.05
    """How often slip and contact are looked at [s]: within it a free fall is 12 mm."""
    lost_m: float = 0.05
    """An object that slipped so far in one stage is lost [m]: a pad is 20 mm."""
    headroom_m: float = 0.004
    """Fingers that stand farther than this outside the object start here [m]: closing through air
    takes time and changes nothing."""
    sure: float | None = 3.0
    """Safety factor, where the last simulated stage left the object, from which a stage is not
    simulated: what rests does not slip in it. One that is not at rest and weighs so many times what
    the grasp bears falls in the lift. None = all are simulated."""

    def __post_init__(self) -> None:
        """Check the factor.

        Raises:
            InputError: it says nothing for sure.
        """
        if self.sure is not None and not self.sure > 1.0:
            raise InputError(
                f"a safety factor of {self.sure:g} makes nothing sure; more than 1 is accepted, "
                "3 is usual, None simulates every stage."
            )

    @classmethod
    def of(cls, hand: Hand) -> "SlipConfig":
        """Return the slip test as a hand does it: with its force, pads, friction and speed."""
        return cls(physics=SlipPhysics.of(hand), closing=Closing.of(hand))


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class SlipTrial:
    """Grasps of one object, ready for the test."""

    body: SlipBody
    Ts_obj_grasp: Array
    """(N, 4, 4) grasps [m]."""
    Ts_table_grasp: Array
    """(N, 4, 4) the same where the object stands; gravity is the table's -z."""
    openings_m: Array
    """(N,) distance of the finger faces before closing [m]."""
    swing_axes: Array
    """(N, 3) unit axis of the joint that swings the hand, grasp frame, as the arm stands."""
    swing_points: Array
    """(N, 3) a point on it, in the grasp frame [m]."""
    swing_ranges: Array
    """(N, 2) least and greatest angle it may swing from there [rad]."""
    stand: Stand | None = None
    """What the object stands on while the fingers close, or None = it is free."""

    def __len__(self) -> int:
        """Return the number of grasps."""
        return len(self.openings_m)

    def part(self, rows: slice | Rows | Mask) -> "SlipTrial":
        """Return the trial of some of the grasps."""
        return rows_of(self, rows)

    def met(self, physics: SlipPhysics, geometry: Hand) -> Meeting:
        """Return what meets in its pairs."""
        return Meeting(self.body, physics, geometry, self.stand)

    def grips(self, headroom_m: float) -> Grips:
        """Return where the hands are, fingers no farther outside the object than `headroom_m`."""
        corners = np.concatenate(self.body.parts)
        T = se3.invert(self.Ts_obj_grasp)
        widest = np.abs(corners @ T[:, 1, :3].T + T[:, 1, 3]).max(axis=0)
        return Grips(
            Ts_table_grasp=self.Ts_table_grasp,
            Ts_obj_grasp=self.Ts_obj_grasp,
            openings_m=np.minimum(self.openings_m, 2.0 * (widest + headroom_m)),
        )


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Slips:
    """What each grasp did in each stage: NaN = not executed, inf = lost.

    A stage that is sure (`SlipConfig.sure`) has slips of exactly 0 or inf, and neither force nor
    duration.
    """

    slip_m: Array
    """(N, 4) [m]."""
    slip_rad: Array
    """(N, 4) [rad]."""
    force_n: Array
    """(N, 4) least normal force of the weaker finger at a look [N]; at the end of `close`."""
    duration_s: Array
    """(N, 4) until the stage ended or the object was lost [s]."""
    failures: tuple[str, ...]
    """(N,) where and why it stopped; '' = passed all."""
    safety: Array
    """(N, 4) of the closed hand, see `closed_safety`; 0 = it did not close on the object."""

    def scores(self, limits: ScoreLimits) -> tuple[Array, Array]:
        """Return the base score and the score (N,) of grasps all of which were tried."""
        tried = np.ones(len(self.slip_m), dtype=np.bool_)
        return score_stages(self.slip_m, self.slip_rad, tried, limits)

    @property
    def passed(self) -> Mask:
        """(N,) whether all four stages were passed."""
        return np.array([not f for f in self.failures], dtype=np.bool_)


def run_slip_test(
    trial: SlipTrial,
    config: SlipConfig | None = None,
    limits: ScoreLimits | None = None,
    geometry: Hand | None = None,
    engine: Engine | None = None,
) -> Slips:
    """Return the slips of all grasps of the trial.

    Args:
        trial: the grasps.
        config: physics, loads and the engine's settings.
        limits: when a stage has failed; a grasp that failed one does not go on to the next.
        geometry: the hand.
        engine: an engine made before with `config.engine`, which may keep what it has compiled;
            None = a new one.

    Raises:
        InputError: the engine is not installed.
    """
    config = config or SlipConfig()
    engine = engine or make_engine(config.engine)
    return _SlipTest(trial, config, limits or ScoreLimits(), geometry or find_hand(), engine).run()


def batches(n: int, size: int) -> list[slice]:
    """Return n rows in slices of at most `size`."""
    return [slice(i, min(i + size, n)) for i in range(0, n, size)]


class _SlipTest:
    """A trial on its way through the stages, in worlds of the engine's size."""

    def __init__(
        self,
        trial: SlipTrial,
        config: SlipConfig,
        limits: ScoreLimits,
        geometry: Hand,
        engine: Engine,
    ) -> None:
        self._trial, self._config, self._limits = trial, config, limits
        self._geometry, self._engine = geometry, engine
        self._met = trial.met(config.physics, geometry)
        self._grips = trial.grips(config.headroom_m)
        n = len(trial)
        shape = (n, len(STAGES))
        self._slip_m, self._slip_rad = np.full(shape, np.nan), np.full(shape, np.nan)
        self._force_n, self._duration_s = np.full(shape, np.nan), np.full(shape, np.nan)
        self._end_n = np.full(n, np.nan)
        self._failures = [""] * n
        self._going: Mask = np.ones(n, dtype=np.bool_)
        self._played: Mask = self._going.copy()
        """Which of them are simulated in this stage."""
        self._safety, self._rests = np.zeros(shape), np.zeros(n, dtype=np.bool_)
        self._borne = self._safety
        """The safety where the last simulated stage left the objects."""
        self._surface: RaySurface | None = None

    def run(self) -> Slips:
        """Go through all stages with all worlds side by side."""
        config = self._config
        with ExitStack() as stack:
            every = np.arange(len(self._trial))
            parts = (every[k] for k in batches(len(every), self._engine.pairs_per_world))
            worlds = [(rows, stack.enter_context(self._world(rows))) for rows in parts]
            for rows, world in worlds:
                start = world.states().Ts_world_body
                self._observe(CLOSE, rows, start, world.close(self._config.closing))
                self._judge(CLOSE, rows)
                world.remove(~self._going[rows])
            self._weigh(worlds, self._going)
            self._safety = self._borne.copy()
            for stage in (LIFT, OSCILLATE, PENDULUM):
                self._stage(stage, worlds)
                if config.sure is not None and stage != PENDULUM:
                    self._weigh(worlds, self._going & self._played)
        return Slips(
            slip_m=self._slip_m,
            slip_rad=self._slip_rad,
            force_n=self._force_n,
            duration_s=self._duration_s,
            failures=tuple(self._failures),
            safety=self._safety,
        )

    def _weigh(self, worlds: list[tuple[Rows, HandWorld]], chosen: Mask) -> None:
        """Note what some grasps (N,) bear where the fingers hold the object now."""
        config = self._config
        for rows, world in worlds:
            held = world.alive & chosen[rows]
            if not held.any():
                continue
            self._surface = self._surface or hull_surface(self._trial.body)
            states = world.states().rows(held)
            self._rests[rows[held]] = resting(self._trial.body, states)
            self._borne[rows[held]] = closed_safety(
                self._surface,
                self._trial.part(rows[held]),
                states,
                config.physics,
                config.motion,
                self._geometry,
            )

    # --- a stage -----------------------------------------------------------------------------

    def _stage(self, stage: int, worlds: list[tuple[Rows, HandWorld]]) -> None:
        """Play a stage in all worlds; what moved in a fast replay is played again at true speed."""
        replay = self._engine.replay
        again: list[tuple[Rows, PairStates]] = []
        self._played = self._going & ~self._sure(stage)
        for rows, world in worlds:
            there = world.alive.copy()
            world.alive[:] = there & self._played[rows]
            if world.alive.any():
                start = world.states()
                self._play(stage, rows, world, replay.speed)
                if replay.speed > 1:
                    moved = self._moved(stage, rows, replay) & world.alive
                    again.append((rows[moved], start.rows(moved)))
            world.alive[:] = there
        played_again = self._at_true_speed(stage, again)
        for rows, world in worlds:
            self._judge(stage, rows)
            world.remove(~self._going[rows])
            if played_again is not None:
                # What was not played again is NaN there, and stays as it is.
                world.put(played_again.rows(rows))

    def _sure(self, stage: int) -> Mask:
        """Return what needs no simulation in a stage (N,), after noting its slips."""
        sure = self._config.sure
        if sure is None:
            return np.zeros_like(self._going)
        held = self._going & self._rests & (self._borne[:, stage] >= sure)
        # A factor of 0, or one of what rests, contradicts the engine: it has to say.
        borne, falls = self._safety[:, CLOSE], self._going & ~self._rests & (stage == LIFT)
        dropped = falls & (borne > 0) & (borne <= 1.0 / sure)
        for slips in (self._slip_m, self._slip_rad):
            slips[held, stage] = 0.0
            slips[dropped, stage] = np.inf
        return held | dropped

    def _play(self, stage: int, rows: Rows, world: HandWorld, speed: int) -> None:
        """Play a stage in one world, `speed` times as fast as it is."""
        config = self._config
        start = world.states().Ts_world_body
        wrenches = stage_wrenches(
            stage, self._trial.part(rows), start, config.motion, speed * world.dt
        )
        sample = max(1, round(config.sample_s / world.dt / speed))
        # What is played again at true speed need not be played to its end.
        far = config.lost_m if speed == 1 else min(self._engine.replay.trigger_m, config.lost_m)
        motion = world.play(np.where(world.alive[:, None, None], wrenches, 0.0), sample, far)
        self._observe(stage, rows, start, motion, speed)

    def _moved(self, stage: int, rows: Rows, replay: Replay) -> Mask:
        """Return whether objects moved more than the triggers (K,)."""
        far = self._slip_m[rows, stage] > replay.trigger_m
        turned = self._slip_rad[rows, stage] > np.radians(replay.trigger_deg)
        loose = self._force_n[rows, stage] < self._config.physics.contact_n
        return far | turned | loose

    def _at_true_speed(self, stage: int, again: list[tuple[Rows, PairStates]]) -> PairStates | None:
        """Play rows again at true speed from where they began.

        Returns:
            where they ended, of all N grasps: NaN = not played again; None = none was.
        """
        rows = np.concatenate([np.zeros(0, dtype=np.int64), *(r for r, _ in again)])
        if len(rows) == 0:
            return None
        began, ended = PairStates.unknown(len(self._trial)), PairStates.unknown(len(self._trial))
        for mine, states in again:
            began.set_rows(mine, states)
        for part in batches(len(rows), self._engine.pairs_per_world):
            with self._world(rows[part]) as world:
                world.put(began.rows(rows[part]))
                self._play(stage, rows[part], world, 1)
                ended.set_rows(rows[part], world.states())
        return ended

    def _world(self, rows: Rows) -> HandWorld:
        """Return a world of some rows."""
        return self._engine.world(self._met, self._grips.rows(rows))

    # --- what is seen --------------------------------------------------------------------------

    def _observe(
        self, stage: int, rows: Rows, start: Array, motion: Motion, speed: int = 1
    ) -> None:
        """Note slips, forces and durations of a stage; overwrites what was noted before."""
        Ts, forces = motion.Ts_world_body, motion.finger_n
        far = np.linalg.norm(Ts[:, :, :3, 3] - start[:, None, :3, 3], axis=-1)
        R = np.swapaxes(start[:, None, :3, :3], -1, -2) @ Ts[:, :, :3, :3]
        turn = se3.angle(np.where(np.isnan(R), np.eye(3), R))
        weaker, both = np.nan_to_num(forces.min(axis=-1)), np.nan_to_num(forces.sum(axis=-1))
        ended = np.maximum(np.sum(~np.isnan(far), axis=1), 1) - 1
        if stage == CLOSE:
            # Before the fingers arrive nothing is touched, and nothing needs to be.
            weaker, both = np.take_along_axis(weaker, ended[:, None], 1), np.ones_like(far)
            far[np.isnan(far)] = 0.0
        gone = ~(far <= self._config.lost_m) | ~(both > 0)
        lost = gone.any(axis=1)
        last = np.where(lost, np.argmax(gone, axis=1), ended)
        seen = {
            "_slip_m": np.where(lost, np.inf, np.nan_to_num(far).max(axis=1)),
            "_slip_rad": np.where(lost, np.inf, np.nan_to_num(turn).max(axis=1)),
            "_force_n": np.where(lost, 0.0, weaker.min(axis=1)),
            "_duration_s": speed * motion.times_s[last],
        }
        going = self._going[rows] & self._played[rows]
        for name, values in seen.items():
            getattr(self, name)[rows[going], stage] = values[going]
        self._end_n[rows[going]] = np.where(lost, 0.0, weaker[:, -1])[going]

    def _judge(self, stage: int, rows: Rows) -> None:
        """Note which grasps failed in this stage and why; they do not go on."""
        limit_m, limit_rad = (limits[stage] for limits in self._limits.by_stage())
        for row in rows[self._going[rows]].tolist():
            slip, turn = self._slip_m[row, stage], self._slip_rad[row, stage]
            if np.isinf(slip) and not self._played[row]:
                why = (
                    f"the object's weight is {1.0 / self._safety[row, CLOSE]:.1f} times what the "
                    f"grasp bears; {NOT_SIMULATED}"
                )
            elif np.isinf(slip):
                why = "the object was lost"
            elif self._end_n[row] <= self._config.physics.contact_n:
                why = "the fingers did not both touch the object"
                self._slip_m[row, stage] = self._slip_rad[row, stage] = np.inf
            elif slip > limit_m or turn > limit_rad:
                turn_deg = np.degrees(turn)
                why = f"the object slipped {1e3 * slip:.1f} mm and turned {turn_deg:.1f} deg"
            else:
                continue
            self._failures[row] = f"{STAGES[stage]}: {why}"
            self._going[row] = False
