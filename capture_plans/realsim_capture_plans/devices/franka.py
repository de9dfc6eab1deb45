"""A Franka arm (Panda, Franka Research 3) as an `Arm`, on franky, which stands on libfranka.

The controller's pose is that of its end effector, whose offset is taken out and recorded. A move is
straight in joint space: a joint's speed, acceleration and jerk are its share of the leading one's.
franky streams set-points from a thread of its own, and a robot that hears none stops by itself, so
that it needs no process. But it waits without a limit for a controller that takes a connection and
says nothing: every call has a deadline here, after which it is let go with what it still brings.

Frames: `T_base_ee` is the flange (panda_link8, fr3_link8) in the robot's base (link0).

What keeps a Franka arm from moving, as libfranka reports it, and what a person does about it.
"""

import logging
import queue
import re
import threading
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from importlib import metadata
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from numpy.typing import ArrayLike

from realsim.arrays import Array
from realsim.errors import InputError, RealsimError
from realsim.geometry import se3
from realsim.interop import import_extra
from realsim.robots.kinematics import DhChain
from realsim_capture_plans.devices.interfaces import ArmState, ArmStoppedError, Stop, checked_goal

TROUBLES: dict[str, tuple[Stop, str, str]] = {
    "Reflex": ("protective stop", "a reflex",
               "read the errors, free what it touched, and go on: that clears it"),
    "UserStopped": ("not ready", "a user stop: the external activation device is pressed",
                    "check that the cell is clear and release it; the lights turn blue"),
    "Other": ("emergency stop", "locked joints, or an emergency stop",
              "check that the cell is clear, release the emergency stop, unlock the joints in "
              "Desk"),
    "Guiding": ("not ready", "that it is guided by hand",
                "let go of the buttons at its wrist, and switch Desk to Execution"),
    "AutomaticErrorRecovery": ("not ready", "that it recovers from an error", "wait, and go on"),
    "Move": ("not ready", "a motion that is not ours", "end the program that moves it"),
}  # fmt: skip
"""libfranka's RobotMode, but Idle: kind of stop, what is reported, what a person does."""
REMEDIES = {
    "communication_constraints_violation": "it missed set-points: give this computer a real-time "
    "kernel, a cable straight to the controller and no other work, and go on: that clears it",
    "joint_position_limits_violation": "guide it by hand back inside its limits, and go on",
}
"""What a person does about one of libfranka's Errors, where a reflex's remedy does not help."""


def trouble(mode: str, errors: Sequence[str]) -> tuple[Stop, str, str] | None:
    """Return what keeps the arm from moving (kind, what is found, what to do), or None.

    Args:
        mode: libfranka's RobotMode.
        errors: the names of libfranka's Errors that stand.
    """
    if mode not in TROUBLES:
        return None
    stop, found, remedy = TROUBLES[mode]
    remedy = next((REMEDIES[error] for error in errors if error in REMEDIES), remedy)
    return stop, found + (f" ({', '.join(errors)})" if errors else ""), remedy


def named(who: str, kind: str, said: str) -> RealsimError:
    """Return the error for what franky said.

    Args:
        who: model and address.
        kind: the class of franky's exception.
        said: its text.
    """
    if kind == "IncompatibleVersionException":
        return InputError(
            f"the {who} does not speak the installed franky's protocol: {said} A Panda needs a "
            "franky for robot server version 5 or lower, an FR3 one for its own software; franky's "
            "FAQ says where they are."
        )
    if kind == "NetworkException" and "refused" in said:
        remedy = "unlock the joints and activate FCI in Desk"
        return stopped(who, "not ready", "that its control interface (FCI) is off", remedy)
    if kind == "RealtimeException":
        return stopped(who, "not ready", said, "allow this user real-time priorities")
    if kind in ("NetworkException", "TimeoutError") or "Net Exception" in said:
        return lost(who, said)
    if kind in ("ControlException", "CommandException"):
        return stopped(who, "protective stop", said, TROUBLES["Reflex"][2])
    return stopped(who, "not ready", said or kind, "see what it says, and go on")


def stopped(who: str, stop: Stop, found: str, remedy: str) -> ArmStoppedError:
    """Return the error of a stop: what was found, and what a person does about it."""
    text = f"{stop}: the {who} does not move: it reports {found}. What to do: {remedy}."
    return ArmStoppedError(text, stop)


def off_goal(who: str, why: str) -> ArmStoppedError:
    """Return the error of an arm that is not where it was sent."""
    return ArmStoppedError(
        f"off goal: the {who}: {why}. What to do: see that nothing holds it, that the end "
        "effector's mass in Desk is right, and that this computer is not busy with other work; "
        "then go on.",
        "off goal",
    )


def lost(who: str, why: str) -> ArmStoppedError:
    """Return the error of an arm that does not answer."""
    return ArmStoppedError(
        f"connection lost: the {who} does not answer ({why}); it stops by itself. What to do: "
        "check the cable and the address, that the controller is on and FCI active, and that no "
        "other program is connected to it; then go on.",
        "connection lost",
    )


log = logging.getLogger(__name__)
Answer = TypeVar("Answer")
REALTIME_KERNEL = Path("/sys/kernel/realtime")
"""Is there where the kernel is a real-time one; libfranka looks for it, too."""
MODELS = ("panda", "fr3")
"""How the names of the arms begin, those of their chains and those in the robots' own URDF."""
LEAST_SHARE = 0.01
"""Least share of the leading joint's speed: a joint that hardly moves must still be able to make up
for a set-point that came late."""


@dataclass(frozen=True, kw_only=True, slots=True)
class FrankaConfig:
    """When a move counts as done, and how long anything may take."""

    arrival_rad: float = 0.005
    """Greatest distance of a joint from its goal [rad]: the robot holds its joints by springs, and
    friction leaves them a few mrad off."""
    still_rad_s: float = 0.01
    """Greatest speed of a joint of a standing arm, measured and commanded [rad/s]."""
    still_s: float = 0.15
    """How long the arm must stand before a move counts as done [s]."""
    settle_limit_s: float = 5.0
    """Longest wait for an arm that has arrived to stand still at its goal [s]."""
    late_s: float = 5.0
    """A move may take twice its planned time and this [s]."""
    rise_s: float = 0.1
    """In what time a move's acceleration is built up [s]; over its jerk a bracket rings less."""
    poll_s: float = 0.02
    """Between two looks at the arm [s]."""
    call_s: float = 4.0
    """Longest time for a call [s]; franky itself gives a robot that fell silent up after 1 s."""
    connect_s: float = 6.0
    """Longest time to connect [s]; usually below 0.1 s."""
    acceleration_max_rad_s2: float = 4.0
    """Greatest acceleration of a move [rad/s^2]: what a camera on a bracket should bear at most."""
    pose_gap: tuple[float, float] = (0.003, 0.01)
    """Greatest distance [m] and turn [rad] of the controller's flange from the chain's: Franka's
    poses are those of its nominal chain, in single precision."""


class FrankaArm:
    """A connected Franka arm, until `close`; also a context manager."""

    def __init__(self, host: str, chain: DhChain, config: FrankaConfig | None = None) -> None:
        """Connect, and see that it is the arm that is expected; nothing moves.

        A stopped robot can be connected: `move` says what is to be done, then `recover` goes on.

        Args:
            host: IP address or name of the controller.
            chain: of the arm that is expected, `find_arm("FR3").chain`.
            config: tolerances and time limits.

        Raises:
            MissingLibraryError: franky is not installed.
            InputError: it is another robot, or the installed franky is not for its software.
            ArmStoppedError: it cannot be reached; the message says what to do.
        """
        self._franky = import_extra("franky", "franka", "a Franka arm")
        self._host, self._chain, self._who = host, chain, f"{chain.name} at {host}"
        self.name, self.limits = chain.name, chain.limits
        self._config = FrankaConfig() if config is None else config
        # franky's robot: whatever else keeps it keeps the connection.
        self._held: list[Any] = []
        self._connect()

    @property
    def description(self) -> dict[str, Any]:
        """What is kept with the session."""
        driver = f"franky {metadata.version('franky-control')}"
        return {"model": self.name, "host": self._host, **self._told, "driver": driver}

    def move(self, joints: ArrayLike, speed: float = 1.05, acceleration: float = 1.4) -> None:
        """Go to joints (7,) [rad] as `Arm.move` says; return when the arm stands there.

        Raises:
            InputError: the goal is outside the limits, or the speed; the arm has not moved.
            ArmStoppedError: the arm stopped on its way, or does not move.
        """
        goal, c = checked_goal(joints, self.limits), self._config
        way = np.abs(goal - np.array(self._standing(None).q_d))
        share = np.maximum(way / max(float(way.max()), 1e-9), LEAST_SHARE)
        self._check_rates(share, speed, acceleration)
        planned_s = float(way.max()) / speed + speed / acceleration + c.rise_s
        end = time.monotonic() + 2 * planned_s + c.late_s

        def start(robot: Any) -> None:
            robot.joint_velocity_limit.set(share * speed)
            robot.joint_acceleration_limit.set(share * acceleration)
            robot.joint_jerk_limit.set(share * acceleration / c.rise_s)
            robot.move(self._franky.JointMotion(goal), asynchronous=True)

        try:
            self._ask(start)
            while not self._ask(lambda robot: robot.join_motion(c.poll_s)):
                if time.monotonic() > end:
                    why = f"its move of {planned_s:.1f} s is not over after twice that time"
                    raise off_goal(self._who, why)
            self._standing(goal)
        except BaseException:
            self._brake()  # Ctrl-C, too: nobody watches any more
            raise

    def state(self) -> ArmState:
        """Return where the arm is now.

        Raises:
            ArmStoppedError: the arm does not answer.
        """
        seen = self._look()
        T_ee_tcp = np.array(seen.F_T_EE.matrix)
        return ArmState(
            joints=np.array(seen.q),
            T_base_ee=np.array(seen.O_T_EE.matrix) @ se3.invert(T_ee_tcp),
            time_s=float(seen.time.to_sec()),
            T_ee_tcp=T_ee_tcp,
        )

    def recover(self) -> None:
        """Make ready after a person has cleared a stop: connect anew, or clear a reflex.

        Raises:
            ArmStoppedError: the stop is still there; the message says what to do at the robot.
            InputError: it is another robot than before.
        """
        try:
            seen = self._look()
        except ArmStoppedError:
            self._connect()
            seen = self._look()
        if seen.robot_mode.name == "Reflex":
            self._ask(lambda robot: robot.recover_from_errors())
            seen = self._look()
        self._refuse_trouble(seen)

    def close(self) -> None:
        """Brake, and disconnect."""
        self._brake()
        self._drop()

    def __enter__(self) -> "FrankaArm":
        """Return itself."""
        return self

    def __exit__(self, *_: object) -> None:
        """Disconnect."""
        self.close()

    def _check_rates(self, share: Array, speed: float, acceleration: float) -> None:
        """Refuse a speed or an acceleration that a joint cannot have; nothing has moved."""
        held, limits = self._held, self.limits
        fastest = np.minimum(limits.speed, held[0].joint_velocity_limit.max) / share
        hardest = np.minimum(limits.acceleration, held[0].joint_acceleration_limit.max) / share
        most = self._config.acceleration_max_rad_s2
        for what, value, limit, unit in (
            ("speed", speed, float(fastest.min()), "rad/s"),
            ("acceleration", acceleration, min(float(hardest.min()), most), "rad/s^2"),
        ):
            if not 0 < value <= limit:
                raise InputError(
                    f"the {what} of the move is {value:g} {unit}; above 0 and at most {limit:.3g} "
                    "is accepted on this way. The arm stays."
                )

    def _standing(self, goal: Array | None) -> Any:
        """Return libfranka's state once the arm stands: at its goal for a while, or anywhere."""
        c = self._config
        began = since = time.monotonic()
        while True:
            seen = self._look()
            moving = seen.robot_mode.name == "Move"  # a packet may still say so after a move's end
            if not moving:
                self._refuse_trouble(seen)
            now, quick = time.monotonic(), float(np.abs([seen.dq, seen.dq_d]).max())
            off = 0.0 if goal is None else float(np.abs(np.array(seen.q) - goal).max())
            if moving or quick > c.still_rad_s or off > c.arrival_rad:
                since = now
            elif goal is None or now - since >= c.still_s:
                return seen
            if now - began > c.settle_limit_s:
                self._refuse_trouble(seen)
                raise off_goal(
                    self._who,
                    f"after {c.settle_limit_s:g} s it is {off:.4f} rad off its goal and turns with "
                    f"{quick:.3f} rad/s ({c.arrival_rad:g} and {c.still_rad_s:g} are accepted)",
                )
            time.sleep(c.poll_s)

    def _brake(self) -> None:
        """End whatever move is under way; a robot that does not hear this brakes by itself."""
        held, limit_s = self._held, self._config.call_s
        if held and held[0].is_in_control:
            try:
                _within(held[0].stop, limit_s)
            except Exception as error:
                log.warning("%s did not hear the stop (%s): it brakes by itself", self._who, error)
            try:
                _within(lambda: held[0].join_motion(limit_s), limit_s)
            except Exception as error:  # the end of a move that was stopped is told as one, too
                log.info("%s ended its move: %s", self._who, error)

    def _connect(self) -> None:
        """Connect anew, and see that it is the arm that is expected."""
        self._drop()
        config, make, host = self._franky.RealtimeConfig, self._franky.Robot, self._host
        kernel = config.Enforce if REALTIME_KERNEL.exists() else config.Ignore
        try:
            limit_s = self._config.connect_s
            self._held = [_within(lambda: make(host, realtime_config=kernel), limit_s)]
        except Exception as error:
            raise self._named(error) from error
        try:
            self._told = self._checked_model()
        except BaseException:
            self._drop()
            raise

    def _drop(self) -> None:
        """Let the connection go."""
        try:
            _within(self._held.clear, self._config.call_s)
        except TimeoutError:
            self._held = []

    def _checked_model(self) -> dict[str, Any]:
        """Return what the robot says of itself; raise InputError if it is not what is expected."""
        seen, state, chain = self._look(), self.state(), self._chain
        found = re.search(r'<robot[^>]*\bname="([^"]+)"', getattr(self._held[0], "model_urdf", ""))
        model = found[1] if found else ""
        expected = next((m for m in MODELS if chain.name.lower().startswith(m)), "")
        gap = se3.invert(chain.forward(state.joints)) @ state.T_base_ee
        off = float(np.linalg.norm(gap[:3, 3])), float(se3.angle(gap[:3, :3]))
        (most_m, most_rad), deg = self._config.pose_gap, np.degrees
        if (model and not model.startswith(expected)) or off[0] > most_m or off[1] > most_rad:
            says = f"says that it is: {model}" if model else "does not say what it is"
            raise InputError(
                f"a {chain.name} is expected. The one at {self._host} {says}, and its "
                f"flange is {1e3 * off[0]:.1f} mm and {deg(off[1]):.2f} deg from where that "
                f"chain has it at the present joints ({1e3 * most_m:g} mm and {deg(most_rad):.2f} "
                "deg are accepted). Use the plan of this robot, or connect the right one."
            )
        return {
            "robot_model": model,
            "tool_offset": state.T_ee_tcp.tolist(),
            "end_effector_kg": float(seen.m_ee),
            "payload_kg": float(seen.m_load),
            "controller_gap_mm": round(1e3 * off[0], 3),
        }

    def _look(self) -> Any:
        """Return libfranka's state, of a packet that is a few milliseconds old at most."""
        return self._ask(lambda robot: robot.state)

    def _ask(self, call: Callable[[Any], Answer]) -> Answer:
        """Return what franky answers; raise ArmStoppedError if it fails or is late."""
        held = self._held
        if not held:
            raise lost(self._who, "the connection was closed")
        try:
            return _within(lambda: call(held[0]), self._config.call_s)
        except Exception as error:
            raise self._named(error) from error

    def _refuse_trouble(self, seen: Any, said: str = "") -> None:
        """Raise what keeps the arm from moving, by its mode and its errors."""
        errors = sorted(set(re.findall(r'"(\w+)"', str(seen.current_errors) + said)))
        if (found := trouble(seen.robot_mode.name, errors)) is not None:
            raise stopped(self._who, *found)

    def _named(self, error: Exception) -> RealsimError:
        """Return the error for what franky said; the robot's mode says more than a motion's end."""
        if type(error).__name__ in ("ControlException", "CommandException"):
            try:
                self._refuse_trouble(self._look(), str(error))
            except ArmStoppedError as found:
                return found
        return named(self._who, type(error).__name__, str(error))


def _within(call: Callable[[], Answer], seconds: float) -> Answer:
    """Return what a call returns; one that is too late is let go, with what it returns then."""
    answers: queue.SimpleQueue[tuple[Answer | None, BaseException | None]] = queue.SimpleQueue()

    def run() -> None:
        try:
            answers.put((call(), None))
        except BaseException as error:
            answers.put((None, error.with_traceback(None)))  # it would keep franky's robot

    threading.Thread(target=run, daemon=True).start()
    try:
        value, error = answers.get(timeout=seconds)
    except queue.Empty:
        raise TimeoutError(f"no answer within {seconds:g} s") from None
    if error is not None:
        raise error
    return value  # pyright: ignore[reportReturnType]
