"""A Universal Robots arm (UR5, UR5e) as an `Arm`, on ur_rtde.

What is handled here so that nobody else has to: the controller's TCP pose contains the configured
tool offset, which is taken out and recorded; a move counts as done when the joints stand still at
their goal, not when the controller says so; every stop is named with what to do about it, and what
was under way is ended, so that nothing starts moving when a stop is cleared; ur_rtde waits without
limits and reconnects by itself, so it runs in a process of its own (`ur_process`).

Frames: `T_base_ee` is the bare flange in the controller's `base`. ROS's `base_link` is turned by
180 deg about z against it.
"""

import time
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from realsim.arrays import Array
from realsim.errors import InputError
from realsim.geometry import se3
from realsim.interop import T_from_rotation_vector_pose
from realsim.robots.arm import ur_chains
from realsim.robots.kinematics import DhChain
from realsim_capture_plans.devices.interfaces import ArmState, ArmStoppedError, checked_goal
from realsim_capture_plans.devices.ur_connection import Identity, UrConfig, UrConnection


class UrArm:
    """A connected UR arm, until `close`; also a context manager."""

    def __init__(
        self,
        host: str,
        *,
        model: str | None = None,
        chain: DhChain | None = None,
        config: UrConfig | None = None,
    ) -> None:
        """Connect, learn what arm it is, and start ur_rtde's script on the controller.

        The arm does not move. A program of somebody else that runs on the controller is not
        stopped: it is an error.

        Args:
            host: IP address or name of the controller.
            model: the model that is expected, a key of `kinematics.CHAINS`; by default `chain`'s.
            chain: the arm's chain, with its factory calibration; by default the nominal one.
            config: tolerances and time limits.

        Raises:
            InputError: the robot is not the model that is expected, or its software is too old.
            ArmStoppedError: it cannot be reached, or is not ready; the message says what to do.
        """
        self._config = UrConfig() if config is None else config
        self._expected = _expected_name(model, chain)
        self._connection = UrConnection(host, self._config)
        self._stop_asked = False
        try:
            self._connection.open()
            self.name, self._chain, self._gap_m = self._checked_model(chain)
            self.limits = self._chain.limits
        except BaseException:
            self.close()
            raise

    @property
    def description(self) -> dict[str, Any]:
        """What is kept with the session."""
        return {
            "model": self.name,
            "host": self._connection.host,
            "serial_number": self._identity.serial,
            "polyscope": self._identity.polyscope,
            "payload_kg": self._identity.payload_kg,
            "tool_offset_xyz_rotvec": self._connection.offset,
            "controller_gap_mm": round(1e3 * self._gap_m, 3),
            "driver": "ur_rtde",
        }

    def move(self, joints: ArrayLike, speed: float = 1.05, acceleration: float = 1.4) -> None:
        """Go to joints (6,) [rad] by moveJ; return when the arm stands still at its goal.

        Args:
            joints: the goal.
            speed: of the leading joint [rad/s].
            acceleration: of the leading joint [rad/s^2].

        Raises:
            InputError: the goal is outside the limits, or the speed; the arm has not moved.
            ArmStoppedError: the arm stopped on its way, or does not move.
        """
        self._stop_asked = False
        goal = self._checked_goal(joints, speed, acceleration)
        connection = self._connection
        connection.refuse_trouble(connection.look())
        try:
            started = connection.ask(
                "start_move", self._config.call_s,
                joints=goal.tolist(), speed=speed, acceleration=acceleration,
            )  # fmt: skip
            if not started:
                connection.refuse_trouble(connection.look())
                raise connection.stop_error(
                    "not ready", "it did not take the command", "see the pendant, and go on"
                )
            self._watch(goal)
        except ArmStoppedError as error:
            connection.end_motion(error)
            raise
        except BaseException:
            connection.stop_move()  # Ctrl-C: nobody watches any more
            raise

    def state(self) -> ArmState:
        """Return where the arm is now, from one packet of readings sent after this call.

        Raises:
            ArmStoppedError: the arm does not answer.
            DeviceError: the tool offset in the controller is not what it was.
        """
        self._connection.check_offset()
        seen = self._connection.look()
        T_ee_tcp = T_from_rotation_vector_pose(self._connection.offset or [0.0] * 6)
        return ArmState(
            joints=np.array(seen["joints"]),
            T_base_ee=T_from_rotation_vector_pose(seen["tcp"]) @ se3.invert(T_ee_tcp),
            time_s=float(seen["time_s"]),
            T_ee_tcp=T_ee_tcp,
        )

    def recover(self) -> None:
        """Connect anew and start the script again, after a person has cleared a stop.

        Nothing is unlocked and nothing moves.

        Raises:
            ArmStoppedError: the stop is still there; the message says what to do at the robot.
            DeviceError: it is another robot, or another tool offset, than before.
        """
        self._connection.close()
        self._connection.open()

    def stop(self) -> None:
        """Brake whatever move is under way, from any thread; return when the arm stands.

        The move that is under way raises an ArmStoppedError ("off goal").
        """
        self._stop_asked = True
        self._connection.stop_move()

    def close(self) -> None:
        """Brake, end our program on the controller, and disconnect."""
        self._connection.close()

    def __enter__(self) -> "UrArm":
        """Return itself."""
        return self

    def __exit__(self, *_: object) -> None:
        """Disconnect."""
        self.close()

    @property
    def _identity(self) -> Identity:
        assert self._connection.identity is not None
        return self._connection.identity

    def _checked_model(self, chain: DhChain | None) -> tuple[str, DhChain, float]:
        """Return the model's name, its chain, and how far the controller's flange is from it [m].

        Raises:
            InputError: the robot is not what was expected.
        """
        state = self.state()
        chains = dict(ur_chains()) if chain is None else {**ur_chains(), chain.name: chain}
        gaps = {name: _gap_m(state, known) for name, known in chains.items()}
        found = self._identity.model
        name = self._expected or found or min(gaps, key=lambda name: gaps[name])
        measured = ", ".join(f"{1e3 * gap:.1f} mm from a {key}'s" for key, gap in gaps.items())
        where = f"at {self._connection.host} (PolyScope {self._identity.polyscope})"
        if name not in chains:
            raise InputError(
                f"the robot {where} is a {name}; known are {', '.join(ur_chains())}. For another "
                "model give its chain."
            )
        limit = self._config.model_gap_m
        if (found is not None and found != name) or gaps[name] > limit:
            says = f"says that it is a {found}" if found else "does not say what it is"
            raise InputError(
                f"a {name} is expected, but the controller {where} {says}, and its own flange "
                f"pose is {measured} at the present joints (at most {1e3 * limit:g} mm is "
                "accepted). Use the plan and the calibration of this robot, or connect the right "
                "one."
            )
        return name, chains[name], gaps[name]

    def _checked_goal(self, joints: ArrayLike, speed: float, acceleration: float) -> Array:
        """Return the goal (6,) [rad].

        Raises:
            InputError: it, the speed or the acceleration cannot be used.
        """
        goal = checked_goal(joints, self.limits)
        for what, value, most, unit in (
            ("speed", speed, self._config.speed_max_rad_s, "rad/s"),
            ("acceleration", acceleration, self._config.acceleration_max_rad_s2, "rad/s^2"),
        ):
            if not 0 < value <= most:
                raise InputError(
                    f"the {what} of the move is {value:g} {unit}; above 0 and at most {most:g} "
                    "is accepted. The arm stays."
                )
        return goal

    def _watch(self, goal: Array) -> None:
        """Wait until the arm stands at its goal.

        Raises:
            ArmStoppedError: something stopped it, or it stands elsewhere.
        """
        c = self._config
        turned_at = over_at = still_at = time.monotonic()
        turned = still = np.full(self._chain.joints, np.inf)
        while True:
            seen = self._connection.look()
            self._connection.refuse_trouble(seen)
            now, joints = time.monotonic(), np.array(seen["joints"])
            off = float(np.abs(joints - goal).max())
            if np.abs(joints - turned).max() > c.stall_rad:
                turned, turned_at = joints, now
            quick = float(np.abs(seen["speeds"]).max()) > c.still_speed_rad_s
            if quick or np.abs(joints - still).max() > c.still_spread_rad:
                still, still_at = joints, now
            if seen["under_way"]:
                over_at = now
                if now - turned_at > c.stall_s:
                    percent = 100 * seen["speed_scaling"]
                    raise self._off_goal(
                        off,
                        f"no joint turned for {c.stall_s:g} s, with the speed at {percent:.0f} %",
                    )
            elif off <= c.arrival_rad and now - still_at >= c.still_s:
                return
            elif off > c.arrival_rad and min(now - still_at, now - over_at) >= c.off_goal_s:
                asked = "stop() was called" if self._stop_asked else "its controller says so"
                raise self._off_goal(off, f"the move is over ({asked})")
            elif now - over_at > c.settle_limit_s:
                raise self._off_goal(off, f"it has not come to rest within {c.settle_limit_s:g} s")
            time.sleep(c.poll_s)

    def _off_goal(self, off_rad: float, why: str) -> ArmStoppedError:
        return self._connection.stop_error(
            "off goal",
            f"it is {off_rad:.4f} rad off its goal ({self._config.arrival_rad:g} is accepted) and "
            f"{why}",
            "see that nothing holds it, that the speed slider is up, and that the load set at the "
            "pendant is right",
        )


def _gap_m(state: ArmState, chain: DhChain) -> float:
    return float(np.linalg.norm((state.T_base_ee - chain.forward(state.joints))[:3, 3]))


def _expected_name(model: str | None, chain: DhChain | None) -> str | None:
    """Return the model that is expected, if any.

    Raises:
        InputError: it is not known, or not the chain's.
    """
    if model is None:
        return None if chain is None else chain.name
    if chain is not None and chain.name != model:
        raise InputError(f"the model is {model}, but the chain is a {chain.name}'s; give one.")
    if chain is None and model not in ur_chains():
        raise InputError(
            f"the model {model} is not known; known are {', '.join(ur_chains())}. For another "
            "model give its chain."
        )
    return model
