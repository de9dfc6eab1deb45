"""A grasp of the Robot School tried again, with the object's motion in the hand.

The slip test is run with the settings of then (`slip.slip_test`), for one grasp, by an engine that
writes poses down (`recorded_worlds`). What comes out is compared with what is stored: a replay
that ends otherwise says so.
"""

from dataclasses import dataclass, replace

import numpy as np

from realsim.arrays import Array
from realsim.errors import InputError
from realsim.geometry import se3
from realsim.records import STAGES, GraspSet
from realsim_sim_bridge.arm.reach_config import grasping_arm
from realsim_sim_bridge.school.config import SchoolConfig
from realsim_sim_bridge.slip.score import score_stages
from realsim_sim_bridge.slip.slip_test import NOT_SIMULATED, SlipTrial, run_slip_test
from realsim_sim_bridge.slip.stand import Stand
from realsim_sim_bridge.slip.world import Engine, Grips, HandWorld, Meeting, Motion, SlipBody

# --- An engine of the slip test that writes down where the objects were --------------------------
# It stands between the slip test and a real engine and passes everything on unchanged, so that a
# grasp that is tried again with it ends as it did; what the test itself does not keep, the poses at
# each look, is kept here.


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class StageRecord:
    """One stage of one pair, as an engine played it."""

    motion: Motion
    """What was seen."""
    fingers_m: Array
    """(2,) distance of each finger's face from the middle at the end [m]; NaN = not known."""
    speed: int
    """How many times as fast as they were the loads were played."""


class RecordedEngine(Engine):
    """An `Engine` for one grasp at a time."""

    def __init__(self, engine: Engine) -> None:
        """Stand in front of an engine."""
        self._engine, self.name, self.settings = engine, engine.name, engine.settings
        self.stages: list[StageRecord] = []
        """What was played of the last grasp, stage by stage."""
        self._worlds = 0

    def begin(self) -> None:
        """Forget the grasp before."""
        self.stages = []
        self._worlds = 0

    def world(self, met: Meeting, grips: Grips) -> HandWorld:
        """Return the engine's world, whose plays are written down.

        The slip test's first world goes through the stages; a later one plays its latest stage
        again, at true speed.
        """
        self._worlds += 1
        again = self._worlds > 1
        world = self._engine.world(met, grips)
        close, play = world.close, world.play

        def noted(motion: Motion, speed: int) -> Motion:
            fingers = world.states().fingers_m[0]
            self.stages.append(StageRecord(motion=motion, fingers_m=fingers, speed=speed))
            return motion

        def played(wrenches: Array, sample: int, lost_m: float) -> Motion:
            motion = play(wrenches, sample, lost_m)
            if again:
                self.stages.pop()
            return noted(motion, 1 if again else self.replay.speed)

        world.close = lambda closing: noted(close(closing), 1)
        world.play = played
        return world


SAME = 1e-9
"""Largest difference of a slip [m, rad] and score that is rounding: a replay that agrees this well
is the attempt itself."""
ALIKE_M, ALIKE_RAD = 1e-3, np.radians(1.0)
"""Differences of a slip that nobody sees in the pictures [m, rad]; stage and score being the same,
nothing is said of them."""


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class HeldStage:
    """What the object did in the hand during one stage."""

    times_s: Array
    """(S,) since the stage began [s]; the first is 0."""
    Ts_grasp_obj: Array
    """(S, 4, 4) object in the grasp frame [m]."""
    touched_s: float
    """When both fingers first pressed on the object [s]; NaN = never."""
    lost_s: float
    """When the object was lost [s]; NaN = it was not."""
    duration_s: float
    """Until the stage ended or the object was lost [s]."""
    opening_m: float
    """Distance of the finger faces at its end [m]."""


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class SlipReplay:
    """One grasp, tried again."""

    stages: tuple[HeldStage, ...]
    """Those that were executed, from `close` on."""
    opening_m: float
    """Distance of the finger faces from which the test let them close [m]."""
    score: float
    failure: str
    """Where and why it stopped; '' = it passed all."""
    agrees: bool
    """Whether it ended as it is stored: in the same stage and, where the school simulated that
    stage, with the same score. What was not simulated counts as lost there."""
    disagreement: str
    """How it differs from what is stored; '' = it does not."""


def replay_grasp(
    grasps: GraspSet,
    row: int,
    joints_lifted: Array,
    T_table_obj: Array,
    body: SlipBody,
    config: SchoolConfig,
    engine: RecordedEngine,
    stand: Stand | None = None,
) -> SlipReplay:
    """Return a grasp tried again.

    Args:
        grasps: the set.
        row: which of its grasps.
        joints_lifted: (n,) the arm after the lift [rad]: the axis of the swing depends on it.
        T_table_obj: (4, 4) where the object stands [m].
        body: its convex parts and matter.
        config: what the set was made with.
        engine: made of the same settings.
        stand: what it stands on while the fingers close.

    Raises:
        InputError: the set does not hold the openings of its grasps.
    """
    trial = replace(_trial(grasps, row, joints_lifted, T_table_obj, body, config), stand=stand)
    engine.begin()
    # Stages that were sure are wanted to be seen, too.
    every = replace(config.slip, sure=None)
    slips = run_slip_test(trial, every, config.score, config.hand, engine)
    base, score = score_stages(
        slips.slip_m, slips.slip_rad, np.ones(1, dtype=np.bool_), config.score
    )
    T_table_grasp = trial.Ts_table_grasp[0]
    T_grasp_world = se3.from_rt(T_table_grasp[:3, :3].T, np.zeros(3))
    T_body_obj = se3.invert(body.principal_frame()[0])
    stages: list[HeldStage] = []
    before = se3.invert(trial.Ts_obj_grasp[0])
    for number, played in enumerate(engine.stages):
        stage = _held(played, T_grasp_world, T_body_obj, before, number == 0, config)
        stages.append(stage)
        before = stage.Ts_grasp_obj[-1]
    if np.isinf(slips.slip_m[0, len(stages) - 1]) and np.isnan(stages[-1].lost_s):
        # It is between the fingers, but they do not both touch it: nothing holds it.
        stages[-1] = replace(stages[-1], lost_s=stages[-1].duration_s)
    apart = _disagreement(grasps, row, slips.slip_m[0], slips.slip_rad[0], base[0], score[0])
    return SlipReplay(
        stages=tuple(stages),
        opening_m=float(trial.grips(config.slip.headroom_m).openings_m[0]),
        score=float(score[0]),
        failure=slips.failures[0],
        agrees=bool(
            base[0] == grasps.base_scores[row]
            and (_decided(grasps, row) or abs(score[0] - grasps.scores[row]) <= SAME)
        ),
        disagreement=apart,
    )


def _trial(
    grasps: GraspSet,
    row: int,
    joints_lifted: Array,
    T_table_obj: Array,
    body: SlipBody,
    config: SchoolConfig,
) -> SlipTrial:
    """Return one grasp, ready for the slip test; as `school.object_slips.trial_of`."""
    openings = grasps.parameters.get("openings_m")
    if not isinstance(openings, list) or len(openings) != len(grasps):  # pyright: ignore[reportUnknownArgumentType]
        raise InputError(
            f"the grasps of instance {grasps.instance} do not say how far the hand was open "
            "(parameters.openings_m), so that none can be replayed; run `realsim school` again."
        )
    arm = grasping_arm(config.reach, config.hand)
    axes, points, ranges = arm.swing_in_grasp(joints_lifted[None])
    Ts = grasps.Ts_obj_grasp[[row]]
    return SlipTrial(
        body=body,
        Ts_obj_grasp=Ts,
        Ts_table_grasp=T_table_obj @ Ts,
        openings_m=np.array([openings[row]], dtype=np.float64),
        swing_axes=axes,
        swing_points=points,
        swing_ranges=ranges,
    )


def _held(
    played: StageRecord,
    T_grasp_world: Array,
    T_body_obj: Array,
    before: Array,
    closing: bool,
    config: SchoolConfig,
) -> HeldStage:
    """Return a stage in the grasp frame, from where the stage before left the object."""
    Ts_world_body, forces = played.motion.Ts_world_body[0], played.motion.finger_n[0]
    times = played.speed * played.motion.times_s
    seen = ~np.isnan(Ts_world_body[:, 0, 0])
    Ts = T_grasp_world @ Ts_world_body[seen] @ T_body_obj
    times, forces = times[seen], np.nan_to_num(forces[seen])
    # The rules of the slip test: too far from where the stage began, or between no fingers.
    centers = Ts @ se3.invert(T_body_obj)[:, 3]
    far = np.linalg.norm((centers - before @ se3.invert(T_body_obj)[:, 3])[:, :3], axis=1)
    gone = far > config.slip.lost_m
    if not closing:
        gone |= forces.sum(axis=1) <= 0
    both = np.all(forces > config.slip.physics.contact_n, axis=1)
    lost = float(times[np.argmax(gone)]) if gone.any() else np.nan
    if gone.any():
        Ts, times = Ts[: np.argmax(gone) + 1], times[: np.argmax(gone) + 1]
    return HeldStage(
        times_s=np.concatenate([[0.0], times]),
        Ts_grasp_obj=np.concatenate([before[None], Ts]),
        touched_s=float(played.motion.times_s[seen][np.argmax(both)]) if both.any() else np.nan,
        lost_s=lost,
        duration_s=float(times[-1]) if len(times) else 0.0,
        opening_m=max(float(np.nan_to_num(played.fingers_m).sum()), 0.0),
    )


def _disagreement(
    grasps: GraspSet, row: int, slip_m: Array, slip_rad: Array, base: float, score: float
) -> str:
    """Return in words how a replay differs from what is stored; '' = in nothing that is seen."""
    if base != grasps.base_scores[row]:
        passed = round(len(STAGES) * float(base)), round(len(STAGES) * grasps.base_scores[row])
        return (
            f"the replay ends otherwise than the school's attempt: it passes {passed[0]} of "
            f"{len(STAGES)} stages, the attempt passed {passed[1]}"
        )
    if _decided(grasps, row):
        return ""
    if abs(score - grasps.scores[row]) > SAME:
        return (
            "the replay passes as many stages as the school's attempt, but is scored "
            f"{score:.4f}, the attempt {grasps.scores[row]:.4f}"
        )
    slipped, far = _largest_difference(slip_m, grasps.slip_m[row])
    turned, wide = _largest_difference(slip_rad, grasps.slip_rad[row])
    if far or wide:
        return "the object is lost in only one of the replay and the school's attempt"
    if slipped <= ALIKE_M and turned <= ALIKE_RAD:
        return ""
    return (
        "stage and score are those of the school's attempt, but the object's slip differs by up to "
        f"{1e3 * slipped:.1f} mm and {np.degrees(turned):.1f} deg"
    )


def _decided(grasps: GraspSet, row: int) -> bool:
    """Return whether the stage that ended a grasp was not simulated; its slip is then not known."""
    return grasps.failures[row].endswith(NOT_SIMULATED)


def _largest_difference(found: Array, stored: Array) -> tuple[float, bool]:
    """Return by how much slips (4,) differ at most, and whether one has another without end."""
    both = np.isfinite(stored) & np.isfinite(found)
    largest = float(np.abs(found[both] - stored[both]).max()) if both.any() else 0.0
    return largest, not np.array_equal(found[~both], stored[~both], equal_nan=True)
