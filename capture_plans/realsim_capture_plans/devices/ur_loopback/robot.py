"""moveJ's motion: all joints on one straight line, the leading joint on a trapezoid of speed."""

import math
from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

from realsim.arrays import Array
from realsim.errors import InputError
from realsim.interop import T_from_rotation_vector_pose, rotation_vector_pose_from_T
from realsim.robots.kinematics import DhChain


class Motion:
    """A straight line in joint space, from standing to standing, that may be braked on its way."""

    def __init__(self, start: Array, goal: Array, speed: float, acceleration: float) -> None:
        """Plan from start to goal (6,) [rad] at the leading joint's limits [rad/s, rad/s^2]."""
        self._start = start
        self.length = float(np.abs(goal - start).max())
        self._direction = (goal - start) / self.length if self.length > 0 else np.zeros(6)
        self._acceleration = acceleration
        # A short way never reaches the speed.
        self._peak = min(speed, math.sqrt(acceleration * self.length))
        self._t = 0.0
        self._s = 0.0
        self._v = 0.0
        self._brake: float | None = None

    @property
    def joints(self) -> Array:
        """(6,) where the arm is [rad]."""
        return self._start + self._s * self._direction

    @property
    def speeds(self) -> Array:
        """(6,) how fast its joints turn [rad/s]."""
        return self._v * self._direction

    @property
    def progress(self) -> float:
        """Share of the way that is done."""
        return 1.0 if self.length == 0 else self._s / self.length

    @property
    def ended(self) -> bool:
        """Whether the arm stands."""
        if self._brake is not None:
            return self._v == 0
        return self._t >= self._duration

    def brake(self, deceleration: float) -> None:
        """Come to a stand on the line with this deceleration of the leading joint [rad/s^2]."""
        self._brake = deceleration

    def advance(self, seconds: float) -> None:
        """Let time pass [s]."""
        if self._brake is not None:
            step = min(seconds, self._v / self._brake)
            self._s += self._v * step - 0.5 * self._brake * step**2
            self._v = 0.0 if step < seconds else self._v - self._brake * step
            return
        self._t += seconds
        self._s, self._v = self._at(self._t)

    @property
    def _duration(self) -> float:
        if self.length == 0:
            return 0.0
        return self.length / self._peak + self._peak / self._acceleration

    def _at(self, t: float) -> tuple[float, float]:
        """Return the way [rad] and the speed [rad/s] after t seconds."""
        a, v, end = self._acceleration, self._peak, self._duration
        if t >= end:
            return self.length, 0.0
        ramp = v / a
        if t < ramp:
            return 0.5 * a * t**2, a * t
        if t <= end - ramp:
            return v * (t - 0.5 * ramp), v
        return self.length - 0.5 * a * (end - t) ** 2, a * (end - t)


HOME = np.radians([0.0, -90.0, 90.0, -90.0, -90.0, 0.0])
"""(6,) where the arm stands when it is switched on [rad]."""
RUNNING, IDLE, POWER_OFF = 7, 5, 3
NORMAL, PROTECTIVE, SAFEGUARD, EMERGENCY = 1, 3, 5, 7
STOPPED, PLAYING, PAUSED = 1, 2, 4
STOP_RAD_S2 = 12.0
"""Deceleration of a safety stop [rad/s^2]."""
SWING_HZ, SWING_DECAY_S = 8.0, 0.15
"""Frequency and decay of the arm's swing after a move."""
READY, DONE = 1, 2
"""What ur_rtde's script writes into output_int_register_0."""
ASYNC_RUNNING = 0x8000
SCRIPT_MOVEJ, SCRIPT_STOPJ, SCRIPT_SET_TCP, SCRIPT_TCP_OFFSET = 1, 34, 29, 40
SCRIPT_PROTECTIVE_STOP, SCRIPT_JOINTS_SAFE, SCRIPT_STEADY, SCRIPT_FLANGE = 31, 37, 47, 58
SCRIPT_FORWARD, SCRIPT_FORWARD_OF, SCRIPT_END = 43, 44, 255
"""Commands of ur_rtde's script that are understood, as they stand in input_int_register_0."""


@dataclass(kw_only=True, slots=True)
class ControllerSetup:
    """What the loopback pretends to be."""

    chain: DhChain
    """Kinematics, with the deltas of a calibration if wanted."""
    model: str = "UR5"
    """What the dashboard answers; an e-Series says UR5 too."""
    version: tuple[int, int, int, int] = (5, 12, 2, 1101534)
    """Controller software; 3.x is a CB3."""
    serial: str = "20215500001"
    """Serial number on the dashboard."""
    tcp: list[float] = field(default_factory=lambda: [0.0] * 6)
    """Configured tool offset [x y z rx ry rz] [m, rad]."""
    speedup: float = 1.0
    """How many times faster than the wall clock the controller's clock goes."""
    swing_rad: float = 0.0
    """Amplitude of the swing of wrist 1 after a move [rad]."""
    joints: Array = field(default_factory=HOME.copy)
    """(6,) where the arm stands at first [rad]."""


class Controller:
    """A robot controller in one thread: `advance` lets its time pass and runs its program."""

    def __init__(self, setup: ControllerSetup) -> None:
        """Switch on: arm running, no program, remote control."""
        self.setup = setup
        self.time_s = 100.0
        self.joints = np.array(setup.joints, dtype=np.float64)
        self.speeds = np.zeros(6)
        self.robot_mode, self.safety_mode, self.runtime = RUNNING, NORMAL, STOPPED
        self.remote = True
        self.stalled = False
        self.foreign = False
        """Whether the program that runs is somebody else's, which answers no command."""
        self.input_ints = [0] * 48
        self.input_doubles = [0.0] * 48
        self.output_ints = [0] * 48
        self.output_doubles = [0.0] * 48
        self._motion: Motion | None = None
        self._asynchronous = False
        self._executing = False
        self._stood_s = 0.0
        self._operation = self._writes = 0
        self._at_progress: tuple[float, str] | None = None
        self._commands: dict[int, Callable[[], None]] = {
            SCRIPT_MOVEJ: self._move,
            SCRIPT_STOPJ: self._stop,
            SCRIPT_SET_TCP: self._set_tcp,
            SCRIPT_TCP_OFFSET: lambda: self._answer(self.setup.tcp),
            SCRIPT_PROTECTIVE_STOP: lambda: self.inject("protective_stop"),
            SCRIPT_JOINTS_SAFE: self._joints_safe,
            SCRIPT_STEADY: lambda: self._say_int(int(self._motion is None)),
            SCRIPT_FLANGE: lambda: self._answer(self._pose(np.eye(4))),
            SCRIPT_FORWARD: lambda: self._answer(self.tcp_pose),
            SCRIPT_FORWARD_OF: self._forward_of,
        }

    @property
    def tcp_pose(self) -> list[float]:
        """The tool's pose in the base [x y z rx ry rz] [m, rad], by the arm's true kinematics."""
        return self._pose(T_from_rotation_vector_pose(self.setup.tcp))

    @property
    def actual_joints(self) -> Array:
        """(6,) measured joints [rad]: the planned ones, and the swing after a move."""
        joints = self.joints.copy()
        joints[3] += self._swing(0)
        return joints

    @property
    def actual_speeds(self) -> Array:
        """(6,) measured joint speeds [rad/s]."""
        speeds = self.speeds.copy()
        speeds[3] += self._swing(1)
        return speeds

    @property
    def safety_bits(self) -> int:
        """safety_status_bits of RTDE."""
        bits = {NORMAL: 0b1, PROTECTIVE: 1 << 2, SAFEGUARD: 1 << 4, EMERGENCY: 0b11 << 6}
        stopped = self.safety_mode in (PROTECTIVE, SAFEGUARD, EMERGENCY)
        return bits[self.safety_mode] | (stopped << 10)

    @property
    def status_bits(self) -> int:
        """robot_status_bits of RTDE: power on, program running."""
        return int(self.robot_mode == RUNNING) | (int(self.runtime == PLAYING) << 1)

    def advance(self, seconds: float) -> None:
        """Let the controller's clock go on [s] and its program do what it is told."""
        self.time_s += seconds
        if self._motion is not None and not self.stalled:
            self._motion.advance(seconds)
            self.joints, self.speeds = self._motion.joints, self._motion.speeds
            if self._at_progress is not None and self._motion.progress >= self._at_progress[0]:
                what = self._at_progress[1]
                self._at_progress = None
                self.inject(what)
            if self._motion.ended:
                self._motion = None
                self.speeds = np.zeros(6)
                self._stood_s = self.time_s
                self._motion_over()
        if self.runtime == PLAYING and not self.foreign:
            self._script_cycle()

    def start_program(self) -> bool:
        """Start ur_rtde's script, if the controller takes it; return whether it did."""
        local = not self.remote and self.setup.version[0] >= 5
        if local or self.robot_mode != RUNNING or self.safety_mode != NORMAL:
            return False
        self.runtime, self._executing, self.foreign = PLAYING, False, False
        self._progress(-1)
        self.output_ints[0] = READY
        return True

    def stop_program(self) -> None:
        """End the program; a motion is braked."""
        self.runtime = STOPPED
        if self._motion is not None:
            self._motion.brake(STOP_RAD_S2)

    def inject(self, what: str) -> None:
        """Let something happen to the robot.

        Raises:
            InputError: nothing is known by that name.
        """
        events: dict[str, Callable[[], None]] = {
            "protective_stop": lambda: self._safety(PROTECTIVE, PAUSED),
            "safeguard_stop": lambda: self._safety(SAFEGUARD, PAUSED),
            "emergency_stop": lambda: self._safety(EMERGENCY, STOPPED, POWER_OFF),
            "power_off": lambda: self._safety(NORMAL, STOPPED, POWER_OFF),
            "brakes": lambda: self._safety(NORMAL, STOPPED, IDLE),
            "program_stop": self.stop_program,
            "pause": lambda: self._safety(NORMAL, PAUSED),
            "local": self._to_local,
            "stall": lambda: setattr(self, "stalled", True),
            "foreign_program": self._run_foreign,
        }
        if what not in events:
            raise InputError(f"'{what}' cannot be injected; known: {', '.join(events)}.")
        events[what]()

    def inject_at(self, what: str, progress: float) -> None:
        """Let something happen when the next (or present) move has done this share of its way."""
        self._at_progress = (progress, what)

    def clear(self) -> None:
        """Do what a person does at the pendant: no stop any more, arm on, no program."""
        self.robot_mode, self.safety_mode, self.runtime = RUNNING, NORMAL, STOPPED
        self.remote, self.stalled, self.foreign = True, False, False
        self._motion = self._at_progress = None
        self.speeds = np.zeros(6)
        self.output_ints[0] = 0

    def _safety(self, mode: int, runtime: int, robot_mode: int | None = None) -> None:
        self.safety_mode = mode
        self.runtime = runtime if self.runtime != STOPPED else STOPPED
        self.robot_mode = self.robot_mode if robot_mode is None else robot_mode
        if self._motion is not None:
            self._motion.brake(STOP_RAD_S2)

    def _to_local(self) -> None:
        self.remote = False
        self.stop_program()

    def _run_foreign(self) -> None:
        self.runtime, self.foreign = PLAYING, True
        self.output_ints[0] = 0

    def _pose(self, T_ee_tcp: Array) -> list[float]:
        T = self.setup.chain.forward(self.actual_joints) @ T_ee_tcp
        return [float(v) for v in rotation_vector_pose_from_T(T)]

    def _swing(self, derivative: int) -> float:
        """Return the swing after a move [rad], or its derivative [rad/s]."""
        if self._motion is not None or self.setup.swing_rad == 0 or self._stood_s == 0:
            return 0.0
        t, w = self.time_s - self._stood_s, 2 * math.pi * SWING_HZ
        fade = self.setup.swing_rad * math.exp(-t / SWING_DECAY_S)
        if derivative == 0:
            return fade * math.sin(w * t)
        return fade * (w * math.cos(w * t) - math.sin(w * t) / SWING_DECAY_S)

    # --- ur_rtde's script -----------------------------------------------------------------------

    def _script_cycle(self) -> None:
        """Do one round of the script's main loop: a command is done once, then waits for 0."""
        command = self.input_ints[0]
        if command == 0:
            self._executing = False
            self.output_ints[0] = READY
        elif not self._executing:
            self._executing = True
            if command == SCRIPT_END:
                self.stop_program()
            elif command in self._commands:
                self._commands[command]()
                if command == SCRIPT_FLANGE:
                    self.output_ints[0] = READY
                elif self._motion is None or self._asynchronous:
                    self.output_ints[0] = DONE
            else:
                self.stop_program()  # as a script does in which something fails

    def _move(self) -> None:
        goal = np.array(self.input_doubles[:6])
        self._asynchronous = self.input_ints[1] == 1
        self._motion = Motion(
            self.joints.copy(), goal, self.input_doubles[6], self.input_doubles[7]
        )
        if self._asynchronous:
            self._progress(0)

    def _stop(self) -> None:
        self._asynchronous = self.input_ints[1] == 1
        if self._motion is not None:
            self._motion.brake(self.input_doubles[0])

    def _motion_over(self) -> None:
        if self.runtime != PLAYING:
            return
        self._progress(-1)
        if not self._asynchronous:
            self.output_ints[0] = DONE

    def _set_tcp(self) -> None:
        self.setup.tcp = list(self.input_doubles[:6])

    def _joints_safe(self) -> None:
        self._say_int(int(self.setup.chain.limits.contains(np.array(self.input_doubles[:6]))))

    def _forward_of(self) -> None:
        T = self.setup.chain.forward(np.array(self.input_doubles[:6]))
        T = T @ T_from_rotation_vector_pose(self.input_doubles[6:12])
        self._answer([float(v) for v in rotation_vector_pose_from_T(T)])

    def _answer(self, values: list[float]) -> None:
        self.output_doubles[: len(values)] = values

    def _say_int(self, value: int) -> None:
        self.output_ints[1] = value

    def _progress(self, value: int) -> None:
        """Write the progress of an asynchronous operation; -1 = it has ended."""
        self._writes = (self._writes + 1) % 128
        if value == 0:
            self._operation = (self._operation + 1) % 128
        word = self._writes << 16 | self._operation << 24
        self.output_ints[2] = word | (ASYNC_RUNNING | value if value >= 0 else 0)
