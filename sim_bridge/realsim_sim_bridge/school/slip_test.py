"""The four-stage slip test: close, lift, oscillate, swing.

Slip is the motion of the object's centre of mass and its rotation, both relative to the gripper,
since the start of the stage; its largest value over the stage counts. In the stage `close` the
object is free and weightless, and the reference is where the scene has it: the slip is how far the
closing fingers moved it. In the other stages the reference is where the stage before left it.
"""

from collections.abc import Iterator
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from realsim.geometry import se3
from realsim.records import STAGES
from realsim_sim_bridge.school import motion as motions
from realsim_sim_bridge.school.hand import HandGeometry
from realsim_sim_bridge.school.score import ScoreLimits
from realsim_sim_bridge.school.slip_world import SlipBody, SlipPhysics, SlipWorld

Array = NDArray[np.float64]
CLOSE, LIFT, OSCILLATE, PENDULUM = range(len(STAGES))


@dataclass(frozen=True, kw_only=True, slots=True)
class SlipConfig:
    """Everything the slip test depends on besides the score's limits."""

    physics: SlipPhysics = field(default_factory=SlipPhysics)
    motion: motions.SlipMotion = field(default_factory=motions.SlipMotion)
    pairs_per_world: int = 16
    """Grasps tested in one world; 16 share the cost of setting up, 64 are slower again."""
    sample_s: float = 0.05
    """How often slip and contact are looked at [s]: within it a free fall is 12 mm."""
    settled_m: float = 2e-5
    """Closing ends when both fingers press and no object moved more than this in a sample [m]."""
    lost_m: float = 0.05
    """An object that slipped so far in one stage is lost [m]: a pad is 20 mm."""


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
    joint5_axes: Array
    """(N, 3) unit axis of joint 5 in the grasp frame, in the arm's configuration."""
    joint5_points: Array
    """(N, 3) a point on it, in the grasp frame [m]."""
    joint5_ranges: Array
    """(N, 2) least and greatest angle it may swing from there [rad]."""

    def part(self, rows: slice) -> "SlipTrial":
        """Return the trial of some of the grasps."""
        return SlipTrial(
            body=self.body,
            Ts_obj_grasp=self.Ts_obj_grasp[rows],
            Ts_table_grasp=self.Ts_table_grasp[rows],
            openings_m=self.openings_m[rows],
            joint5_axes=self.joint5_axes[rows],
            joint5_points=self.joint5_points[rows],
            joint5_ranges=self.joint5_ranges[rows],
        )


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Slips:
    """Slip of each grasp in each stage: NaN = not executed, inf = lost."""

    slip_m: Array
    """(N, 4) [m]."""
    slip_rad: Array
    """(N, 4) [rad]."""
    failures: tuple[str, ...]
    """(N,) where and why it stopped; '' = passed all."""


def run_slip_test(
    trial: SlipTrial,
    config: SlipConfig | None = None,
    limits: ScoreLimits | None = None,
    geometry: HandGeometry | None = None,
) -> Slips:
    """Return the slips of all grasps of the trial, in worlds of `pairs_per_world`."""
    config = config or SlipConfig()
    results = [
        _WorldTest(trial.part(rows), config, limits or ScoreLimits()).run(
            geometry or HandGeometry()
        )
        for rows in batches(len(trial.Ts_obj_grasp), config.pairs_per_world)
    ]
    empty = np.zeros((0, len(STAGES)))
    return Slips(
        slip_m=np.concatenate([empty, *(r.slip_m for r in results)]),
        slip_rad=np.concatenate([empty, *(r.slip_rad for r in results)]),
        failures=tuple(f for r in results for f in r.failures),
    )


def batches(n: int, size: int) -> list[slice]:
    """Return n rows in slices of at most `size`."""
    return [slice(i, min(i + size, n)) for i in range(0, n, size)]


class _WorldTest:
    """The test of the grasps that share one world."""

    def __init__(self, trial: SlipTrial, config: SlipConfig, limits: ScoreLimits) -> None:
        n = len(trial.Ts_obj_grasp)
        self._trial, self._config, self._limits = trial, config, limits
        self._slip_m = np.full((n, len(STAGES)), np.nan)
        self._slip_rad = np.full((n, len(STAGES)), np.nan)
        self._failures = [""] * n
        self._reference = np.zeros((n, 4, 4))

    def run(self, geometry: HandGeometry) -> Slips:
        """Run the stages one after the other; a failed grasp leaves the world."""
        trial, config = self._trial, self._config
        with SlipWorld(
            trial.body,
            trial.Ts_table_grasp,
            trial.Ts_obj_grasp,
            trial.openings_m,
            config.physics,
            geometry,
        ) as world:
            for stage, steps in (
                (CLOSE, self._close),
                (LIFT, self._lift),
                (OSCILLATE, self._oscillate),
                (PENDULUM, self._swing),
            ):
                if not world.alive.any():
                    break
                self._reference = world.Ts_world_body()
                self._slip_m[world.alive, stage] = 0.0
                self._slip_rad[world.alive, stage] = 0.0
                self._play(world, stage, steps(world))
                self._judge(world, stage)
        return Slips(slip_m=self._slip_m, slip_rad=self._slip_rad, failures=tuple(self._failures))

    # --- the stages: each yields once a step, after it has set that step's load ---------------

    def _close(self, world: SlipWorld) -> Iterator[None]:
        """Close without gravity until every object rests between both fingers."""
        motion, config = self._config.motion, self._config
        world.set_acceleration(np.zeros(3))
        world.close_fingers(motion.close_speed)
        arrive_s = float(self._trial.openings_m.max()) / 2 / motion.close_speed
        chunk = _steps(config.sample_s, world.dt)
        before = self._reference
        for i in range(_steps(arrive_s + motion.close_settle_s, world.dt)):
            if i and i % chunk == 0:
                now = world.Ts_world_body()
                moved = np.linalg.norm((now - before)[world.alive, :3, 3], axis=1)
                if self._touched(world)[world.alive].all() and np.all(moved < config.settled_m):
                    return
                before = now
            yield

    def _lift(self, world: SlipWorld) -> Iterator[None]:
        """Lift along the table's normal."""
        return self._translate(world, motions.lift_acceleration(self._config.motion, world.dt))

    def _oscillate(self, world: SlipWorld) -> Iterator[None]:
        """Shake along the table's x, then y."""
        return self._translate(
            world, motions.oscillation_acceleration(self._config.motion, world.dt)
        )

    def _translate(self, world: SlipWorld, acceleration: Array) -> Iterator[None]:
        """Play a translation of all hands (T, 3) [m/s^2]: one field for the whole world."""
        gravity = np.array([0.0, 0.0, -self._config.motion.gravity])
        for a in acceleration:
            world.set_acceleration(gravity - a)
            yield

    def _swing(self, world: SlipWorld) -> Iterator[None]:
        """Turn every hand about its own arm's joint 5."""
        trial, motion = self._trial, self._config.motion
        world.set_acceleration(np.zeros(3))
        Ts_world_body = world.Ts_world_body()
        sweep = np.radians(motion.pendulum_deg)
        wrenches: dict[int, tuple[Array, Array]] = {}
        for k in np.nonzero(world.alive)[0].tolist():
            T = world.Ts_world_hand[k]
            axis = T[:3, :3] @ trial.joint5_axes[k]
            point = T[:3, :3] @ trial.joint5_points[k] + T[:3, 3]
            low, high = np.clip(trial.joint5_ranges[k], -sweep, sweep)
            angle = motions.pendulum_angle(motion, world.dt, float(low), float(high))
            load = motions.pendulum_load(angle, axis, motion.gravity)
            arm = Ts_world_body[k, :3, 3] - point
            wrenches[k] = motions.inertial_wrench(load, arm, world.mass, world.inertia_world(k))
        count = len(next(iter(wrenches.values()))[0])
        for i in range(count):
            for k, (force, torque) in wrenches.items():
                if world.alive[k]:
                    world.push(k, force[i], torque[i])
            yield

    # --- what is seen --------------------------------------------------------------------------

    def _play(self, world: SlipWorld, stage: int, steps: Iterator[None]) -> None:
        """Step through a stage, keep the largest slip, and take out what is lost."""
        chunk = _steps(self._config.sample_s, world.dt)
        for i, _ in enumerate(steps):
            world.step()
            if (i + 1) % chunk == 0:
                self._observe(world, stage)
                if not world.alive.any():
                    return
        self._observe(world, stage)

    def _observe(self, world: SlipWorld, stage: int) -> None:
        """Update the slips, and take out objects that are far away or touch no finger."""
        Ts = world.Ts_world_body()
        held = world.finger_forces().sum(axis=1) > 0 if stage != CLOSE else world.alive
        for k in np.nonzero(world.alive)[0].tolist():
            slip = float(np.linalg.norm(Ts[k, :3, 3] - self._reference[k, :3, 3]))
            turn = float(se3.angle(self._reference[k, :3, :3].T @ Ts[k, :3, :3]))
            self._slip_m[k, stage] = max(self._slip_m[k, stage], slip)
            self._slip_rad[k, stage] = max(self._slip_rad[k, stage], turn)
            if slip > self._config.lost_m or not held[k]:
                self._lose(world, stage, k, "the object was lost")

    def _touched(self, world: SlipWorld) -> NDArray[np.bool_]:
        """Return whether both fingers press on the object (K,)."""
        forces = world.finger_forces()
        return np.all(forces > self._config.physics.touch_n, axis=1)

    def _judge(self, world: SlipWorld, stage: int) -> None:
        """Take out the grasps that failed in this stage and note why."""
        limits = self._limits
        touched = self._touched(world)
        for k in np.nonzero(world.alive)[0].tolist():
            slip, turn_deg = self._slip_m[k, stage], np.degrees(self._slip_rad[k, stage])
            if not touched[k]:
                self._lose(world, stage, k, "the fingers did not both touch the object")
            elif slip > limits.slip_m or turn_deg > limits.slip_deg:
                self._failures[k] = (
                    f"{STAGES[stage]}: the object slipped {1e3 * slip:.1f} mm and turned "
                    f"{turn_deg:.1f} deg"
                )
                world.remove(k)

    def _lose(self, world: SlipWorld, stage: int, k: int, why: str) -> None:
        """Take out a lost object: it has slipped without bound."""
        self._slip_m[k, stage] = self._slip_rad[k, stage] = np.inf
        self._failures[k] = f"{STAGES[stage]}: {why}"
        world.remove(k)


def _steps(duration_s: float, dt: float) -> int:
    """Return how many steps a duration takes."""
    return round(duration_s / dt)
