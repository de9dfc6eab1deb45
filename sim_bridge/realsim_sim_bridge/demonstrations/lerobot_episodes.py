"""Demonstrations as the episodes of a LeRobot data set, and which column says what.

Columns whose names begin with `observation` are what a policy may see, `action` what it must do;
LeRobot's training takes the others for nothing, so that what only a simulation knows stands there.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from realsim import interop
from realsim.arrays import Array, Array32, Rgb
from realsim.formats.lerobot.episodes import LeRobotCamera, LeRobotEpisode, LeRobotFeature
from realsim.geometry import se3
from realsim_sim_bridge.demonstrations.records import ALL_PHASES
from realsim_sim_bridge.demonstrations.source import Demonstration, DemonstrationSource

STATE, ACTION, GOAL = "observation.state", "action", "observation.goal.grasp_pose"
EE, OBJECT, DELTA = "ee_pose", "object_pose", "delta_ee"
IMAGES, EXTRINSICS, DEPTH = "observation.images.", "observation.extrinsics.", "_depth"
POSE_NAMES = ("x", "y", "z", "qx", "qy", "qz", "qw")
FEATURES = {
    STATE: LeRobotFeature(dtype="float32"),
    GOAL: LeRobotFeature(dtype="float32", names=POSE_NAMES),
    ACTION: LeRobotFeature(dtype="float32"),
    DELTA: LeRobotFeature(dtype="float32", names=("rx", "ry", "rz", "x", "y", "z")),
    EE: LeRobotFeature(dtype="float32", names=POSE_NAMES),
    OBJECT: LeRobotFeature(dtype="float32", names=POSE_NAMES),
    "phase": LeRobotFeature(dtype="int64"),
    "held": LeRobotFeature(dtype="bool"),
    "next.reward": LeRobotFeature(dtype="float32"),
    "next.done": LeRobotFeature(dtype="bool"),
    "next.success": LeRobotFeature(dtype="bool"),
}
CONVENTIONS = (
    (STATE, "the joints [rad] and the distance of the finger faces [m]"),
    (GOAL, "the grasp to be taken, in the arm's base: position [m], quaternion x y z w; the frame "
           "is between the fingertips, z = approach, y = closing axis"),
    (ACTION, "absolute joint targets: the joints of the next step [rad]; commanded distance of the "
             "finger faces [m], 0 = close and press"),
    (DELTA, "the hand's motion to the next step, in its own frame: rotation vector [rad], shift "
            "[m]"),
    (EE, "the hand's grasp frame in the arm's base, as the goal"),
    (OBJECT, "the object that is to be grasped, in the arm's base, likewise: what a camera does "
             "not tell"),
    (EXTRINSICS + "NAME", "the camera in the arm's base, as the goal; x right, y down, z forward"),
    ("phase", ", ".join(f"{k} {name}" for k, name in enumerate(ALL_PHASES))),
    ("held", "whether both fingers hold the object"),
    ("next.reward", "1 at the last step of an attempt that passed all stages, else 0"),
    ("next.done", "true at the last step"),
    ("next.success", "true at the last step of an attempt that passed all stages"),
)  # fmt: skip
"""(column, meaning) for the card."""


class LeRobotDemonstrations:
    """Chosen attempts of a source; a `LeRobotSource`."""

    def __init__(
        self, source: DemonstrationSource, name: str, chosen: Sequence[int], *, depth: bool = False
    ) -> None:
        """Choose attempts.

        Args:
            source: all attempts.
            name: what messages call them.
            chosen: numbers of those that are written, in this order.
            depth: whether depth is written beside the colours.
        """
        self.name, self._source, self._chosen = name, source, tuple(chosen)
        self._depth = depth
        self.robot_type = source.arm.arm.folder.name
        """The arm's name."""
        self.fps = source.config.rate_hz
        """Steps per second."""
        self.tasks = sorted({source.goal(k).language for k in self._chosen})

    @property
    def features(self) -> Mapping[str, LeRobotFeature]:
        """The columns."""
        names = self._source.arm.arm.joint_names
        extrinsics = LeRobotFeature(dtype="float32", names=POSE_NAMES)
        return FEATURES | {
            STATE: replace(FEATURES[STATE], names=(*names, "opening")),
            ACTION: replace(FEATURES[ACTION], names=(*names, "opening_command")),
            **{EXTRINSICS + name: extrinsics for name in self._source.scenery.cameras},
        }

    @property
    def cameras(self) -> Mapping[str, LeRobotCamera]:
        """The cameras by LeRobot's key, with what they measure by."""
        out: dict[str, LeRobotCamera] = {}
        for name, camera in self._source.scenery.cameras.items():
            i = camera.intrinsics
            info = {
                "camera.intrinsics": {
                    "fx": i.fx, "fy": i.fy, "cx": i.cx, "cy": i.cy,
                    "distortion_model": "opencv", "distortion": i.distortion.tolist(),
                },
                "camera.extrinsics": EXTRINSICS + name,
            }  # fmt: skip
            size = i.height, i.width
            out[IMAGES + name] = LeRobotCamera(size=size, info=info)
            if self._depth:
                key = IMAGES + name + DEPTH
                out[key] = LeRobotCamera(size=size, is_depth=True, info=info)
        return out

    def __len__(self) -> int:
        """Return the number of episodes."""
        return len(self._chosen)

    def episode(self, k: int) -> LeRobotEpisode:
        """Return an episode, its pictures rendered as they are taken."""
        demonstration = self._source[self._chosen[k]]
        return LeRobotEpisode(
            task=demonstration.goal.language,
            columns=episode_columns(demonstration),
            frames=_frames(demonstration, self._depth),
            notes=_notes(demonstration),
            metadata=_metadata(demonstration),
        )


def episode_columns(demonstration: Demonstration) -> dict[str, NDArray[Any]]:
    """Return the columns of a demonstration, (S,) or (S, width)."""
    motion = demonstration.motion
    steps = len(motion)
    after = np.minimum(np.arange(steps) + 1, steps - 1)
    T_base_table = se3.invert(demonstration.scenery.T_table_base)
    last = np.arange(steps) == steps - 1
    succeeded = last & demonstration.outcome.success
    return {
        STATE: np.column_stack([motion.joints_rad, motion.opening_m]),
        GOAL: np.repeat(poses(demonstration.goal.T_base_grasp[None]), steps, axis=0),
        ACTION: np.column_stack([motion.joints_rad[after], motion.command_m[after]]),
        DELTA: _deltas(motion.Ts_base_ee, motion.Ts_base_ee[after]),
        EE: poses(motion.Ts_base_ee),
        OBJECT: poses(T_base_table @ motion.Ts_table_obj),
        "phase": motion.phase,
        "held": motion.held,
        "next.reward": succeeded.astype(np.float32),
        "next.done": last,
        "next.success": succeeded,
        **{
            EXTRINSICS + name: poses(
                T_base_table
                @ np.array([demonstration.pictures.T_table_cam(k, name) for k in range(steps)])
            )
            for name in demonstration.scenery.cameras
        },
    }


def poses(Ts: Array) -> Array:
    """Return positions and quaternions x y z w (S, 7) of poses (S, 4, 4).

    A quaternion and its negative are the same rotation: from one step to the next the nearer of the
    two is taken, so that nothing jumps.
    """
    xyzw = interop.quaternion_xyzw_from_R(Ts[:, :3, :3])
    apart = np.sum(xyzw[1:] * xyzw[:-1], axis=1) < 0
    signs = np.cumprod(np.concatenate([[1.0], np.where(apart, -1.0, 1.0)]))
    return np.concatenate([Ts[:, :3, 3], xyzw * signs[:, None]], axis=1)


def _deltas(Ts: Array, after: Array) -> Array:
    """Return rotation vectors and shifts (S, 6) from each pose to the next, in its own frame."""
    moved = se3.invert(Ts) @ after
    turns = [se3.log_so3(R) for R in moved[:, :3, :3]]
    return np.concatenate([np.array(turns).reshape(-1, 3), moved[:, :3, 3]], axis=1)


def _frames(demonstration: Demonstration, depth: bool) -> Iterator[Mapping[str, Rgb | Array32]]:
    """Yield the pictures of every camera, step by step."""
    for step in demonstration:
        seen = {name: step.picture(name) for name in demonstration.scenery.cameras}
        out: dict[str, Rgb | Array32] = {IMAGES + name: p.rgb for name, p in seen.items()}
        if depth:
            out |= {IMAGES + name + DEPTH: p.depth_m for name, p in seen.items()}
        yield out


def _metadata(demonstration: Demonstration) -> dict[str, bool | int | float | str]:
    """Return what a row of meta/episodes says; NaN where p_hold was not measured."""
    outcome = demonstration.outcome
    p_hold = outcome.labels.get("p_hold")
    return {
        "success": outcome.success,
        "p_hold": float("nan") if p_hold is None else float(p_hold),
        "failure": outcome.failure,
        "object": demonstration.goal.name,
    }


def _notes(demonstration: Demonstration) -> dict[str, Any]:
    """Return what LeRobot has no place for, as plain JSON values."""
    goal, outcome = demonstration.goal, demonstration.outcome
    return {
        "object": goal.name,
        "obj_id": goal.obj_id,
        "instance": goal.instance,
        "grasp": goal.grasp,
        "T_base_grasp": goal.T_base_grasp.tolist(),
        "success": outcome.success,
        "stages_passed": outcome.stages_passed,
        "score": outcome.score,
        **outcome.labels,
        "failure": outcome.failure,
        "replay_agrees": outcome.agrees,
        "notes": list(demonstration.notes),
        "place": None if goal.place is None else asdict(goal.place),
        "Ts_base_obj": {str(i): T.tolist() for i, T in demonstration.step(0).Ts_base_obj.items()},
    }
