"""The connection to a UR controller: probed, opened, watched, and every fault named."""

import contextlib
import threading
import time
from dataclasses import dataclass
from typing import Any, cast

import numpy as np

from realsim.errors import InputError
from realsim_capture_plans.devices import ur_link
from realsim_capture_plans.devices.interfaces import ArmStoppedError, DeviceError, Stop
from realsim_capture_plans.devices.ur_link import Glance, LinkError, UrLink, probe

READINGS = [
    "timestamp", "actual_q", "actual_qd", "actual_TCP_pose", "robot_mode", "safety_mode",
    "safety_status_bits", "runtime_state", "speed_scaling",
]  # fmt: skip
FREQUENCY_HZ = 125.0
"""Frequency of the readings: a CB3's own rate, and a quarter of an e-Series'."""
PAYLOAD_SINCE = {3: 11, 5: 6}
"""Minor version of PolyScope, per major, that tells its payload."""
TOOL_OFFSET_SINCE = (3, 6)
"""First PolyScope whose programs can read the tool offset; ur_rtde answers zeros before it."""
SCRIPT_STATES = (1, 2)
"""output_int_register_0 while ur_rtde's script is up."""


@dataclass(frozen=True, kw_only=True, slots=True)
class UrConfig:
    """When a move counts as done, and how long anything may take."""

    arrival_rad: float = 0.002
    """Greatest distance of a joint from its goal [rad]; 2 mm at the arm's full reach."""
    still_speed_rad_s: float = 0.01
    """Greatest measured joint speed of a standing arm [rad/s]; its noise at rest is below this."""
    still_spread_rad: float = 2e-4
    """Greatest change of a joint while the arm stands [rad]: 0.2 mm at the arm's full reach."""
    still_s: float = 0.15
    """How long the arm must stand before a move counts as done [s]: over two swings of the arm."""
    settle_limit_s: float = 5.0
    """Longest wait for an arm that has arrived to stand still [s]."""
    off_goal_s: float = 1.0
    """How long the arm must stand elsewhere, with the move over, before that is an error [s]; the
    controller may say so before it has begun."""
    stall_s: float = 3.0
    """How long a move may go on without any joint turning before it is given up [s]."""
    stall_rad: float = 1e-3
    """What counts as turning [rad]."""
    packet_s: float = 1.5
    """Longest wait for a reading [s]; they come every 8 ms. Then the connection counts as lost."""
    poll_s: float = 0.02
    """Between two looks at a moving arm [s]."""
    call_s: float = 4.0
    """Longest time for one command [s]."""
    connect_s: float = 12.0
    """Longest time for ur_rtde to connect and start its script [s]; usually below 1 s."""
    probe_s: float = 2.0
    """Longest wait for a port, and for the first answer on it [s]."""
    release_s: float = 1.0
    """How long the controller may take to free the control registers of a closed connection [s]."""
    speed_max_rad_s: float = 3.14
    """Greatest speed of a move [rad/s]: the datasheet's 180 deg/s, as ur_rtde rounds it."""
    acceleration_max_rad_s2: float = 4.0
    """Greatest acceleration of a move [rad/s^2]. Not published; three times moveJ's usual 1.4, and
    what a camera on a bracket should not be asked to bear more than."""
    stop_rad_s2: float = 4.0
    """Deceleration of `stop` [rad/s^2]."""
    model_gap_m: float = 0.02
    """Greatest distance of the controller's flange from the chain's [m]. A calibration moves it by
    up to 5 mm; between UR5 and UR5e there are never less than 27."""
    offset_change: float = 1e-6
    """Change of the tool offset [m, rad] beyond which it counts as another one."""


@dataclass(frozen=True, kw_only=True, slots=True)
class Identity:
    """Which robot it is, as its dashboard says."""

    polyscope: str
    """Version of the controller's software."""
    serial: str | None
    """Serial number; a CB3 does not tell it."""
    model: str | None
    """Model, told from the dashboard's name and the series; None where it says nothing."""
    payload_kg: float | None
    """Payload that is set at the pendant [kg]."""


class UrConnection:
    """One controller: its readings, its program, and the stop that ended it."""

    def __init__(self, host: str, config: UrConfig) -> None:
        """Begin unconnected."""
        self.host = host
        self.config = config
        self.identity: Identity | None = None
        self.offset: list[float] | None = None
        """Tool offset of the first reading [x y z rx ry rz]."""
        self._link: UrLink | None = None
        self._stopped: ArmStoppedError | None = None
        self._lock = threading.RLock()

    @property
    def alive(self) -> bool:
        """Whether there is something to ask."""
        return self._link is not None and self._link.alive

    def open(self) -> None:
        """Probe, listen, check that nothing stands against it, take control.

        Raises:
            ArmStoppedError: it cannot be reached, or is not ready; nothing was changed on it.
            DeviceError: it is another robot, or another tool offset, than before.
            InputError: its software is too old.
        """
        c = self.config
        glance = self._free()
        self._link, self._stopped = UrLink(), None
        major, minor = glance.version[:2]
        if (major, minor) < TOOL_OFFSET_SINCE:
            raise InputError(
                f"the controller at {self.host} has PolyScope {major}.{minor}, which cannot tell "
                f"its tool offset: flange poses would be wrong by it. {TOOL_OFFSET_SINCE[0]}."
                f"{TOOL_OFFSET_SINCE[1]} or later is needed; update it."
            )
        with_payload = minor >= PAYLOAD_SINCE.get(major, 0)
        variables = [*READINGS, "payload"] if with_payload else READINGS
        who = self.ask("identify", c.connect_s, host=self.host)
        self.ask("listen", c.connect_s, host=self.host, frequency=FREQUENCY_HZ, variables=variables)
        seen = self.look()
        self._identify(who, glance, seen)
        self.refuse_trouble(seen, program=False)
        if who["remote"] is False:
            raise self._trouble_error(ur_link.LOCAL)
        moving = float(np.abs(seen["speeds"]).max()) > c.still_speed_rad_s
        playing = seen["runtime_state"] == ur_link.RUNTIME_PLAYING
        if moving or (playing and glance.script_register not in SCRIPT_STATES):
            raise self.stop_error(
                "not ready",
                f"another program is running on it ({who['program']})"
                + (", and the arm moves" if moving else ""),
                "stop it at the pendant, or wait until it has ended",
            )
        self.ask("take_control", c.connect_s, host=self.host, frequency=FREQUENCY_HZ)
        self.check_offset()

    def close(self) -> None:
        """Brake, end our program on the controller, and disconnect."""
        link, self._link = self._link, None
        if link is None:
            return
        if self._stopped is not None and self._stopped.stop == "connection lost":
            link.kill()
            return
        if link.alive and self._stopped is None:
            with contextlib.suppress(LinkError):
                link.ask("last_word", self.config.call_s)
                link.ask("end", self.config.call_s)
        link.close()

    def look(self) -> dict[str, Any]:
        """Return the readings of one packet that came after this call.

        Raises:
            ArmStoppedError: "connection lost".
        """
        seen = self.ask("look", self.config.packet_s + 1.0, timeout_s=self.config.packet_s)
        if not seen["fresh"]:
            raise self._loss("its readings have stopped")
        return cast("dict[str, Any]", seen)

    def ask(self, do: str, deadline_s: float, **arguments: Any) -> Any:
        """Ask ur_rtde; other threads wait.

        Raises:
            ArmStoppedError: it failed or did not answer.
        """
        with self._lock:
            if self._link is None or not self._link.alive:
                raise self._loss("the connection was closed")
            try:
                return self._link.ask(do, deadline_s, **arguments)
            except LinkError as error:
                raise self._named(str(error)) from error

    def check_offset(self) -> None:
        """Read the tool offset where the script is up; refuse another one than before.

        Raises:
            DeviceError: it has changed.
        """
        now = cast("list[float] | None", self.ask("tool_offset", self.config.call_s))
        if now is None and self.offset is None:
            raise self.stop_error(
                "not ready", "it does not tell its tool offset (TCP)", "see the pendant, and go on"
            )
        if now is None:
            return  # stopped; it is read again when the program runs again
        if self.offset is None:
            self.offset = now
        elif float(np.abs(np.subtract(now, self.offset)).max()) > self.config.offset_change:
            raise DeviceError(
                f"the tool offset (TCP) of the controller was {_pose_text(self.offset)} and is "
                f"now {_pose_text(now)}. Poses before and after would not go together: set it back "
                "at the pendant (Installation > General > TCP), or begin a new session."
            )

    def end_motion(self, error: ArmStoppedError) -> None:
        """After a stop: end the program, so that nothing moves when the stop is cleared."""
        self._stopped = error
        if self._link is None:
            return
        if error.stop == "connection lost":
            self._link.kill()
            return
        with contextlib.suppress(LinkError):
            self._link.ask("halt", self.config.call_s, host=self.host)

    def stop_move(self) -> None:
        """Brake whatever move is under way."""
        if self.alive:
            with contextlib.suppress(ArmStoppedError):
                self.ask("stop_move", self.config.call_s, deceleration=self.config.stop_rad_s2)

    def refuse_trouble(self, seen: dict[str, Any], *, program: bool = True) -> None:
        """Raise what keeps the arm from moving.

        Raises:
            ArmStoppedError: it is stopped, off, or (`program`) does not run our program.
        """
        runtime = int(seen["runtime_state"]) if program else None
        found = ur_link.trouble(
            seen["robot_mode"], seen["safety_mode"], seen["safety_bits"], runtime
        )
        if found is not None:
            raise self._trouble_error(found)

    def stop_error(self, stop: Stop, found: str, remedy: str) -> ArmStoppedError:
        """Return the error of a stop: what was found, and what a person does about it."""
        model = (self.identity and self.identity.model) or "arm"
        return ArmStoppedError(
            f"{stop}: the {model} at {self.host} does not move: {found}. What to do: {remedy}.",
            stop,
        )

    def _free(self) -> Glance:
        """Return a glance at the controller, whose control registers nobody else holds.

        Raises:
            ArmStoppedError: it cannot be reached, or another program holds them.
        """
        end = time.monotonic() + self.config.release_s
        while True:
            glance = probe(self.host, self.config.probe_s)
            if glance.control_free:
                return glance
            if time.monotonic() > end:
                raise self._in_use()
            time.sleep(self.config.release_s / 10)

    def _identify(self, who: dict[str, Any], glance: Glance, seen: dict[str, Any]) -> None:
        """Keep which robot it is.

        Raises:
            DeviceError: it is not the robot of before.
        """
        before = self.identity
        now = Identity(
            polyscope=str(who["version"] or ".".join(map(str, glance.version))),
            serial=who["serial"],
            model=ur_link.detected_model(who["model"], glance.version[0]),
            payload_kg=seen["payload_kg"],
        )
        if before is not None and before.serial != now.serial:
            raise DeviceError(
                f"the robot at {self.host} has serial number {now.serial}, before it was "
                f"{before.serial}. Connect the robot that the session was begun with."
            )
        self.identity = now

    def _named(self, said: str) -> ArmStoppedError:
        """Return the error for what ur_rtde said."""
        if "remote control" in said:
            return self._trouble_error(ur_link.LOCAL)
        if "already in use" in said:
            return self._in_use()
        if "start control script" in said:
            return self.stop_error(
                "not ready",
                "it did not start ur_rtde's program",
                "see the message at the pendant, and go on",
            )
        return self._loss(said)

    def _in_use(self) -> ArmStoppedError:
        return self.stop_error(
            "not ready",
            "another program holds its control registers (RTDE)",
            "end the other capture or driver that is connected to it, and switch off EtherNet/IP, "
            "PROFINET and MODBUS there",
        )

    def _trouble_error(self, found: ur_link.Trouble) -> ArmStoppedError:
        return self.stop_error(found.stop, f"its controller reports {found.found}", found.remedy)

    def _loss(self, why: str) -> ArmStoppedError:
        self._stopped = ArmStoppedError(
            f"connection lost: the arm at {self.host} does not answer ({why}). It may still be on "
            "its way to its goal. Check the network cable and that the controller is on, then go "
            "on.",
            "connection lost",
        )
        return self._stopped


def _pose_text(pose: list[float]) -> str:
    mm = ", ".join(f"{1e3 * v:.2f}" for v in pose[:3])
    return f"[{mm}] mm, [{', '.join(f'{v:.4f}' for v in pose[3:])}] rad"
