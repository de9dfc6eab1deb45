"""An attempt over time: where arm, fingers and object are at every step.

The arm's joints are those that the school planned (`GraspTrajectories`); the object's motion in the
hand is that of the slip test tried again (`slip_replay`). The two clocks are put together so that
the fingers reach the object when they did in the test, and every later stage begins with the arm's.

    before the stage `close`     the object stands where the scene has it
    close                        the hand rests, the object moves in it as the test says
    lift, oscillate, pendulum    T_base_obj = T_base_grasp(joints) @ T_grasp_obj(test)
    lost                         the object falls (`falling`), the fingers close on nothing

The slip test knows no table. Where an object would slide out of the hand into it, the table holds
it: the object is shifted up until it stands on it. A failed attempt ends where it failed; a lost
object may fall for a moment.

What a lost object does: it falls onto the table, among the others.

The slip test ends where an object is lost; what a camera sees after that is made here, by PyBullet:
the object's convex parts with its true matter fall under gravity, the others stand still as the
hulls of their meshes, and the hand is not in the way any more.
"""

import tempfile
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from realsim import interop
from realsim.arrays import Array, Int64, Mask
from realsim.geometry import se3
from realsim.records.grasps import PHASES, GraspTrajectories
from realsim_sim_bridge.arm.grasping_arm import GraspingArm
from realsim_sim_bridge.demonstrations.slip_replay import HeldStage, SlipReplay
from realsim_sim_bridge.slip.bullet_shapes import drawn_in_shape
from realsim_sim_bridge.slip.world import SlipBody

RATE_HZ = 960.0
"""Steps per second: at Bullet's own 240 an object sinks 8 mm into the table as it lands."""
ITERATIONS = 100
"""Solver iterations a step: resting contacts of hulls need more than Bullet's 50."""
FRICTION = 0.5
"""Coulomb coefficient of object and table: wood on plastic."""
MARGIN_M = 0.0005
"""Bullet's margin around hulls [m], which are drawn in by it first; the slip test's."""
GRAVITY = 9.81
"""[m/s^2], along -z of the table."""
TABLE_M = 4.0
"""Edge of the table [m]: nothing falls off it in a second."""


def fall(
    body: SlipBody, T_table_obj: Array, twist: Array, others: Sequence[Array], times_s: Array
) -> Array:
    """Return where a lost object is (S, 4, 4), table frame [m].

    Args:
        body: the object's convex parts and matter.
        T_table_obj: (4, 4) where it is lost [m].
        twist: (6,) its angular [rad/s] and linear velocity of the centre of mass [m/s], table axes.
        others: corners (V, 3) of what else stands there, each taken as its convex hull, table frame
            [m].
        times_s: (S,) since it was lost, not decreasing [s].
    """
    engine = interop.pybullet_client()
    try:
        with tempfile.TemporaryDirectory(prefix="realsim_fall_") as folder:
            number = _build(engine, Path(folder), body, T_table_obj, twist, others)
            return _poses(engine, number, se3.invert(body.principal_frame()[0]), times_s)
    finally:
        engine.disconnect()


def _build(
    engine: Any,
    folder: Path,
    body: SlipBody,
    T_table_obj: Array,
    twist: Array,
    others: Sequence[Array],
) -> int:
    """Put everything into the engine and return the object's number."""
    engine.setPhysicsEngineParameter(
        fixedTimeStep=1.0 / RATE_HZ, numSolverIterations=ITERATIONS, numSubSteps=0,
        deterministicOverlappingPairs=1,
    )  # fmt: skip
    engine.setGravity(0.0, 0.0, -GRAVITY)
    half = TABLE_M / 2.0
    table = engine.createCollisionShape(engine.GEOM_BOX, halfExtents=[half, half, 0.25])
    statics = [engine.createMultiBody(0.0, table, -1, [0.0, 0.0, -0.25])]
    for k, corners in enumerate(others):
        shape, margin = drawn_in_shape(engine, folder / f"other{k}.obj", [corners], MARGIN_M)
        statics.append(engine.createMultiBody(0.0, shape))
        engine.changeDynamics(statics[-1], -1, collisionMargin=margin)
    T_obj_body, moments = body.principal_frame()
    parts = [se3.transform(se3.invert(T_obj_body), part) for part in body.parts]
    shape, margin = drawn_in_shape(engine, folder / "object.obj", parts, MARGIN_M)
    position, xyzw = interop.pybullet_from_T(T_table_obj @ T_obj_body)
    number: int = engine.createMultiBody(body.mass_kg, shape, -1, position, xyzw)
    # Damping never in one call with friction: PyBullet then drops the friction.
    engine.changeDynamics(number, -1, linearDamping=0.0, angularDamping=0.1)
    engine.changeDynamics(number, -1, localInertiaDiagonal=moments.tolist(), collisionMargin=margin)
    for each in (*statics, number):
        # Bullet multiplies the two.
        engine.changeDynamics(each, -1, lateralFriction=float(np.sqrt(FRICTION)))
    engine.resetBaseVelocity(number, twist[3:].tolist(), twist[:3].tolist())
    return number


def _poses(engine: Any, number: int, T_body_obj: Array, times_s: Array) -> Array:
    """Let time pass and return T_table_obj (S, 4, 4) at the times."""
    Ts = np.empty((len(times_s), 4, 4))
    done = 0
    for k, time_s in enumerate(times_s.tolist()):
        while done < round(time_s * RATE_HZ):
            engine.stepSimulation()
            done += 1
        position, xyzw = engine.getBasePositionAndOrientation(number)
        Ts[k] = interop.T_from_pybullet(position, xyzw) @ T_body_obj
    return Ts


CLOSE = PHASES.index("close")
"""Phase of the first stage; stage k of the slip test is phase CLOSE + k."""


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class AttemptMotion:
    """An attempt at S steps, one every 1 / rate."""

    time_s: Array
    """(S,) since the attempt's start [s]."""
    joints_rad: Array
    """(S, n) [rad]."""
    opening_m: Array
    """(S,) distance of the finger faces [m]: they stop where the object is."""
    command_m: Array
    """(S,) what the hand is told [m]: it closes to 0 at its speed, and then presses."""
    phase: Int64
    """(S,) number in PHASES."""
    held: Mask
    """(S,) whether both fingers hold the object."""
    Ts_base_ee: Array
    """(S, 4, 4) the grasp frame of the hand in the arm's base [m]."""
    Ts_table_obj: Array
    """(S, 4, 4) the object that is grasped, table frame [m]."""
    notes: tuple[str, ...]
    """What the arm cannot do of it."""

    def __len__(self) -> int:
        """Return the number of steps."""
        return len(self.time_s)


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Attempt:
    """What an attempt consists of, before it is put on one clock."""

    arm: GraspingArm
    trajectories: GraspTrajectories
    row: int
    """Row of the grasp set."""
    replay: SlipReplay
    body: SlipBody
    T_table_base: Array
    """(4, 4) [m]."""
    T_table_obj: Array
    """(4, 4) where the object stands at first [m]."""
    others: Sequence[Array]
    """Corners (V, 3) of the other objects, table frame [m]."""
    closing_speed: float
    """Speed of each finger [m/s]."""


@dataclass(frozen=True, eq=False, slots=True)
class _Clock:
    """When the stages begin, and when the attempt ends."""

    begins: tuple[float, ...]
    """Beginning of each stage that was executed [s]; NaN = the arm does not do it."""
    touch_s: float
    """When the fingers reach the object [s]."""
    lost_s: float
    """When the object is lost [s]; inf = never."""
    end_s: float


def attempt_motion(attempt: Attempt, rate_hz: float, fall_s: float) -> AttemptMotion:
    """Return an attempt at the steps of a rate.

    Args:
        attempt: trajectory and replay.
        rate_hz: steps per second.
        fall_s: how long a lost object is watched [s].
    """
    rows = attempt.trajectories.attempt(attempt.row)
    assert rows is not None, "only rows with a trajectory are attempts"
    times = attempt.trajectories.time_s[rows]
    phases = attempt.trajectories.phase[rows]
    opened = float(attempt.trajectories.opening_m[rows][0])
    clock, notes = _clock(attempt, times, phases, opened, fall_s)
    t = np.arange(int(np.floor(clock.end_s * rate_hz + 1e-9)) + 1) / rate_hz
    planned = attempt.trajectories.joints_rad[rows]
    joints = np.stack([np.interp(t, times, q) for q in planned.T], axis=1)
    at = np.clip(np.searchsorted(times, t + 1e-9, side="right") - 1, 0, len(times) - 1)
    Ts_base_ee = attempt.arm.forward(joints)
    closing = float(times[phases == CLOSE][0])
    opening, command = _fingers(attempt, clock, t, opened, closing)
    held = (t >= clock.touch_s) & (t < clock.lost_s)
    if attempt.replay.stages and np.isnan(attempt.replay.stages[0].touched_s):
        held[:] = False
    return AttemptMotion(
        time_s=t,
        joints_rad=joints,
        opening_m=opening,
        command_m=command,
        phase=phases[at],
        held=held,
        Ts_base_ee=Ts_base_ee,
        Ts_table_obj=_object(attempt, clock, t, planned, times),
        notes=tuple(notes),
    )


def _clock(
    attempt: Attempt, times: Array, phases: Int64, opened: float, fall_s: float
) -> tuple[_Clock, list[str]]:
    """Return the stages' beginnings on the arm's clock, and which of them the arm does not do."""
    stages, notes = attempt.replay.stages, list[str]()
    first = {int(p): float(times[phases == p][0]) for p in np.unique(phases)}
    begins = [first.get(CLOSE + k, np.nan) for k in range(len(stages))]
    missing = [PHASES[CLOSE + k] for k, begin in enumerate(begins) if np.isnan(begin)]
    if missing:
        notes.append(
            f"the arm cannot follow the stage {' and '.join(missing)} (joint limits or speed): "
            "the hand alone was tried in it, and the attempt does not show it."
        )
    speed = 2.0 * attempt.closing_speed
    close = stages[0]
    arrive = begins[0] + max(opened - close.opening_m, 0.0) / speed
    if np.isnan(close.touched_s):
        # No contact tells the clocks' difference: both begin where the test let the hand close.
        start = begins[0] + max(opened - attempt.replay.opening_m, 0.0) / speed
        arrive = start + close.duration_s
        begins[0] = start
    else:
        begins[0] = max(begins[0], arrive - close.touched_s)
    shown = [k for k, begin in enumerate(begins) if not np.isnan(begin)]
    last = shown[-1]
    lost, end = np.inf, float(times[-1])
    if attempt.replay.failure:
        end = begins[last] + stages[last].duration_s
        if not np.isnan(stages[last].lost_s):
            lost = begins[last] + stages[last].lost_s
            end = lost + fall_s
    return _Clock(tuple(begins), arrive, lost, end), notes


def _fingers(
    attempt: Attempt, clock: _Clock, t: Array, opened: float, closing_s: float
) -> tuple[Array, Array]:
    """Return where the fingers are (S,) and what they are told (S,) [m]."""
    speed, stages = 2.0 * attempt.closing_speed, attempt.replay.stages
    command = np.clip(opened - speed * (t - closing_s), 0.0, opened)
    # Between the stages' ends the object settles between the fingers.
    ends = np.array(
        [
            (b + stage.duration_s, stage.opening_m)
            for b, stage in zip(clock.begins, stages, strict=True)
            if not np.isnan(b) and np.isnan(stage.lost_s)
        ],
        dtype=np.float64,
    ).reshape(-1, 2)
    rest = np.interp(t, ends[:, 0], ends[:, 1]) if len(ends) else np.zeros(len(t))
    opening = np.maximum(command, np.minimum(rest, opened))
    free = np.maximum(opening - speed * np.maximum(t - clock.lost_s, 0.0), 0.0)
    return np.where(t > clock.lost_s, free, opening), command


# --- the object ---------------------------------------------------------------------------------


def _object(attempt: Attempt, clock: _Clock, t: Array, planned: Array, times: Array) -> Array:
    """Return where the object is (S, 4, 4), table frame [m]."""
    Ts = np.empty((len(t), 4, 4))
    in_hand = t <= clock.lost_s
    for k in np.nonzero(in_hand)[0].tolist():
        Ts[k] = _carried(attempt, clock, float(t[k]), planned, times)
    if in_hand.all():
        return Ts
    before, lost = (
        _carried(attempt, clock, clock.lost_s - d, planned, times) for d in (LOOK_S, 0.0)
    )
    center = attempt.body.center_of_mass
    step = se3.transform(lost, center) - se3.transform(before, center)
    twist = np.zeros(6)
    if clock.begins[0] < clock.lost_s and len(attempt.replay.stages) > 1:
        twist[:3] = se3.log_so3(lost[:3, :3] @ before[:3, :3].T) / LOOK_S
        twist[3:] = step / LOOK_S
    Ts[~in_hand] = fall(attempt.body, lost, twist, attempt.others, t[~in_hand] - clock.lost_s)
    return Ts


LOOK_S = 0.05
"""Time over which a lost object's velocity is measured [s]: between two looks of the slip test. It
was weightless while the fingers closed, so that what is lost then starts from rest."""


def _carried(attempt: Attempt, clock: _Clock, t: float, planned: Array, times: Array) -> Array:
    """Return T_table_obj (4, 4) of the object that stands, or is held."""
    if t <= clock.begins[0]:
        return attempt.T_table_obj
    stage, begin = 0, clock.begins[0]
    for k, b in enumerate(clock.begins):
        if b <= t:
            stage, begin = k, b
    T_grasp_obj = _between(attempt.replay.stages[stage], t - begin)
    joints = np.array([np.interp(t, times, q) for q in planned.T])
    return _on_table(attempt, attempt.T_table_base @ attempt.arm.forward(joints) @ T_grasp_obj)


def _on_table(attempt: Attempt, T_table_obj: Array) -> Array:
    """Return an object's pose, shifted up as far as it is in the table."""
    corners = np.concatenate(attempt.body.parts)
    # A registered object may stand a little in the table from the beginning.
    floor = min(float(se3.transform(attempt.T_table_obj, corners)[:, 2].min()), 0.0)
    deep = floor - float(se3.transform(T_table_obj, corners)[:, 2].min())
    return se3.from_translation([0.0, 0.0, max(deep, 0.0)]) @ T_table_obj


def _between(stage: HeldStage, t: float) -> Array:
    """Return T_grasp_obj (4, 4) at a time since the stage's beginning, between two looks."""
    times = stage.times_s
    k = int(np.clip(np.searchsorted(times, t, side="right") - 1, 0, max(len(times) - 2, 0)))
    if len(times) == 1:
        return stage.Ts_grasp_obj[0]
    share = float(np.clip((t - times[k]) / max(times[k + 1] - times[k], 1e-12), 0.0, 1.0))
    a, b = stage.Ts_grasp_obj[k], stage.Ts_grasp_obj[k + 1]
    R = se3.exp_so3(share * se3.log_so3(b[:3, :3] @ a[:3, :3].T)) @ a[:3, :3]
    return se3.from_rt(R, (1.0 - share) * a[:3, 3] + share * b[:3, 3])
