"""The way to a UR controller: ports probed first, then ur_rtde in a process with deadlines.

What keeps a UR arm from moving, as its controller reports it, and what a person does about it.

Numbers of Universal Robots' Real-Time Data Exchange guide: robot_mode, safety_mode, runtime_state.
"""

import contextlib
import json
import os
import select
import socket
import struct
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Any, NamedTuple

from realsim_capture_plans.devices.interfaces import ArmStoppedError, Stop

RTDE_PORT, SCRIPT_PORT, DASHBOARD_PORT = 30004, 30003, 29999
"""Fixed in the controller and in ur_rtde."""
PORTS = {RTDE_PORT: "readings (RTDE)", SCRIPT_PORT: "programs", DASHBOARD_PORT: "dashboard"}
DEADLINE_SLACK_S = 1.0
"""Waited beyond a request's own deadline for the process to say so [s]."""
CLOSE_S = 3.0
"""Longest wait for the process to end by itself [s]."""
LAST_LINES = 4
"""Lines of ur_rtde's own output quoted when its process ended."""
_VERSION, _SETUP_OUTPUTS, _SETUP_INPUTS, _START, _PAUSE = 118, 79, 73, 83, 80
_DATA, _PROTOCOL = 85, 86
_COMMAND_REGISTER = b"input_int_register_0"
_SCRIPT_REGISTER = b"output_int_register_0"


class LinkError(Exception):
    """A request to ur_rtde failed, or ended its process."""


@dataclass(frozen=True, kw_only=True, slots=True)
class Glance:
    """What a controller says before anything is changed on it."""

    version: tuple[int, ...]
    """Controller software: major, minor, bugfix, build."""
    script_register: int
    """output_int_register_0: 1 or 2 while ur_rtde's script is up (ready, done)."""
    control_free: bool
    """Whether no other connection holds the register that ur_rtde commands with."""


class LineProcess:
    """A Python process that is told lines and answers each with a line."""

    def __init__(self, words: Sequence[str], said: IO[bytes] | None = None) -> None:
        """Start it with these words of a command line; what it prints as errors goes to `said`."""
        self.process = subprocess.Popen(
            [sys.executable, *words],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=said,
            start_new_session=True,  # Ctrl-C in the terminal is for the capture alone
        )
        self._unread = b""

    def tell(self, line: str) -> None:
        """Send a line."""
        assert self.process.stdin is not None
        self.process.stdin.write(line.encode() + b"\n")
        self.process.stdin.flush()

    def line(self, end: float) -> bytes:
        """Return the next line, or nothing if none came before `end` or the process ended."""
        assert self.process.stdout is not None
        number = self.process.stdout.fileno()
        while b"\n" not in self._unread:
            left = end - time.monotonic()
            if left <= 0 or not select.select([number], [], [], left)[0]:
                return b""
            piece = os.read(number, 65536)
            if not piece:
                return b""
            self._unread += piece
        line, self._unread = self._unread.split(b"\n", 1)
        return line

    def close(self, wait_s: float = CLOSE_S) -> None:
        """Close its stdin and let it end by itself within this time [s], else end it."""
        assert self.process.stdin is not None
        with contextlib.suppress(OSError):
            self.process.stdin.close()
        with contextlib.suppress(subprocess.TimeoutExpired):
            self.process.wait(wait_s)
        self.kill()

    def kill(self) -> None:
        """End it at once."""
        self.process.kill()
        self.process.wait()
        for stream in (self.process.stdin, self.process.stdout):
            if stream is not None:
                with contextlib.suppress(OSError):
                    stream.close()


class UrLink(LineProcess):
    """ur_rtde in a process of its own; every call has a deadline, after which it is ended.

    It ends with `close`, which brakes a move that is still under way, or with `kill`.
    """

    def __init__(self) -> None:
        """Start the process, without any connection."""
        self._said = tempfile.TemporaryFile()
        super().__init__(["-P", str(Path(__file__).with_name("ur_process.py"))], self._said)
        self._asked = 0

    @property
    def alive(self) -> bool:
        """Whether the process still runs."""
        return self.process.poll() is None

    def ask(self, do: str, deadline_s: float, **arguments: Any) -> Any:
        """Return the answer to one request.

        Raises:
            LinkError: it failed, or there was no answer within the deadline [s].
        """
        self._asked += 1
        request = {"do": do, "with": arguments, "deadline_s": deadline_s, "number": self._asked}
        try:
            self.tell(json.dumps(request))
        except (BrokenPipeError, ValueError) as error:
            raise LinkError(self._last_words(do, deadline_s)) from error
        end = time.monotonic() + deadline_s + DEADLINE_SLACK_S
        while line := self.line(end):
            answer = json.loads(line)
            if answer["number"] != self._asked:
                continue  # of a request that Ctrl-C cut short
            if "error" in answer:
                raise LinkError(str(answer["error"]))
            return answer["value"]
        message = self._last_words(do, deadline_s)
        self.kill()
        raise LinkError(message)

    def kill(self) -> None:
        """End the process at once."""
        super().kill()
        self._said.close()

    def _last_words(self, do: str, deadline_s: float) -> str:
        """Return why the process is gone, with what ur_rtde printed last."""
        with contextlib.suppress(OSError, ValueError):
            self._said.seek(0)
            lines = self._said.read().decode(errors="replace").strip().splitlines()
            if lines:
                return f"'{do}' failed; ur_rtde said: {' | '.join(lines[-LAST_LINES:])}"
        return f"'{do}' was not answered within {deadline_s:.1f} s"


def probe(host: str, timeout_s: float) -> Glance:
    """Return what a controller says of itself, after checking that it can be reached.

    Args:
        host: its address.
        timeout_s: longest wait for a port, and for an answer on it [s].

    Raises:
        ArmStoppedError: "connection lost"; the message tells apart a name that is unknown, a host
            that does not answer, a port that is closed and a port behind which is no controller.
    """
    for port in PORTS:
        _connect(host, port, timeout_s).close()
    _greeted(host, timeout_s)
    with contextlib.closing(_connect(host, RTDE_PORT, timeout_s)) as link:
        try:
            return _glance(link)
        except (OSError, struct.error) as error:
            raise ArmStoppedError(
                f"{host} answers on port {RTDE_PORT}, but not as a UR controller does "
                f"({error or 'no answer'}). Is it the robot's address? If it is, the controller "
                "hangs or is starting up: wait a minute, then switch it off and on.",
                "connection lost",
            ) from error


def _connect(host: str, port: int, timeout_s: float) -> socket.socket:
    """Return a connection.

    Raises:
        ArmStoppedError: there is none, and why.
    """
    what = f"the robot's port {port} for {PORTS[port]}"
    try:
        return socket.create_connection((host, port), timeout=timeout_s)
    except socket.gaierror as error:
        raise ArmStoppedError(
            f"there is no host '{host}' ({error}). Give the robot's IP address: at the pendant "
            "under Settings > System > Network (CB3: Setup Robot > Network).",
            "connection lost",
        ) from error
    except ConnectionRefusedError as error:
        raise ArmStoppedError(
            f"{host} refuses {what}. Is this the robot's address, and has its controller started "
            "up? On an e-Series, Settings > Security > Services must allow RTDE, the dashboard and "
            "the secondary and real-time clients.",
            "connection lost",
        ) from error
    except OSError as error:
        raise ArmStoppedError(
            f"{host} does not answer on {what} within {timeout_s:g} s ({error}). Check that the "
            "robot is switched on, the network cable, the IP address, and that no firewall blocks "
            f"ports {', '.join(map(str, PORTS))}.",
            "connection lost",
        ) from error


def _greeted(host: str, timeout_s: float) -> None:
    """Check that the dashboard says hello: ur_rtde waits for that.

    Raises:
        ArmStoppedError: it does not.
    """
    with contextlib.closing(_connect(host, DASHBOARD_PORT, timeout_s)) as link:
        try:
            hello = link.recv(256)
        except OSError:
            hello = b""
    if b"Dashboard" not in hello:
        raise ArmStoppedError(
            f"{host} accepts port {DASHBOARD_PORT} but the dashboard there says nothing. Is it the "
            "robot's address? If it is, the controller hangs: switch it off and on.",
            "connection lost",
        )


def _glance(link: socket.socket) -> Glance:
    _send(link, _PROTOCOL, struct.pack(">H", 2))
    _answer(link, _PROTOCOL)
    _send(link, _VERSION, b"")
    version = struct.unpack(">4I", _answer(link, _VERSION)[:16])
    _send(link, _SETUP_OUTPUTS, struct.pack(">d", 125.0) + _SCRIPT_REGISTER)
    _answer(link, _SETUP_OUTPUTS)
    _send(link, _START, b"")
    _answer(link, _START)
    (register,) = struct.unpack(">i", _answer(link, _DATA)[1:5])
    _send(link, _PAUSE, b"")
    _answer(link, _PAUSE)
    _send(link, _SETUP_INPUTS, _COMMAND_REGISTER)
    return Glance(
        version=version,
        script_register=register,
        control_free=b"IN_USE" not in _answer(link, _SETUP_INPUTS),
    )


def _send(link: socket.socket, kind: int, payload: bytes) -> None:
    link.sendall(struct.pack(">HB", 3 + len(payload), kind) + payload)


def _answer(link: socket.socket, kind: int) -> bytes:
    """Return the payload of the next RTDE message of this kind; text messages are passed over."""
    end = time.monotonic() + (link.gettimeout() or 0.0)
    while time.monotonic() < end:
        size, got = struct.unpack(">HB", _exactly(link, 3))
        payload = _exactly(link, size - 3)
        if got == kind:
            return payload
    raise TimeoutError("no RTDE answer")


def _exactly(link: socket.socket, size: int) -> bytes:
    data = b""
    while len(data) < size:
        piece = link.recv(size - len(data))
        if not piece:
            raise ConnectionError("the connection was closed")
        data += piece
    return data


ROBOT_RUNNING = 7
SAFETY_NORMAL, SAFETY_REDUCED = 1, 2
RUNTIME_PLAYING = 2
PROTECTIVE_BIT, EMERGENCY_BIT = 2, 7
"""Bits of safety_status_bits."""


class Trouble(NamedTuple):
    """One reason why the arm does not move."""

    stop: Stop
    found: str
    """What the controller reports."""
    remedy: str
    """What a person does at the robot."""


_PROTECTIVE = Trouble(
    "protective stop",
    "a protective stop: it touched something, or was asked for too much force",
    "free what it touched, then unlock the protective stop at the pendant (possible 5 s after it)",
)
_EMERGENCY = Trouble(
    "emergency stop",
    "an emergency stop",
    "check that the cell is clear, pull out the red button, then at the pendant switch the arm on "
    "and release its brakes (ON, START)",
)
_SAFEGUARD = Trouble(
    "not ready",
    "a safeguard stop: a door, light curtain or enabling switch",
    "close the safeguard and reset it",
)
_FAULT = Trouble(
    "not ready",
    "a safety fault of the controller",
    "read the pendant's log, then restart the safety system there; the arm must be switched on "
    "again",
)

SAFETY_MODES: dict[int, Trouble] = {
    3: _PROTECTIVE,
    4: Trouble(
        "not ready",
        "recovery mode: it stands outside a safety limit",
        "move it back inside by freedrive at the pendant",
    ),
    5: _SAFEGUARD,
    6: _EMERGENCY,
    7: _EMERGENCY,
    8: _FAULT,
    9: _FAULT,
    12: _SAFEGUARD,
    13: _SAFEGUARD,
}
"""Every safety_mode in which the arm does not move."""

_POWER = "switch the arm on at the pendant and release its brakes (ON, START)"
ROBOT_MODES: dict[int, tuple[str, str]] = {
    -1: ("no controller", "wait until the controller has started up"),
    0: ("disconnected from its controller", "check the cable between arm and control box"),
    1: ("waiting for the safety settings", "confirm the safety configuration at the pendant"),
    2: ("booting", "wait until it has started up"),
    3: ("switched off", _POWER),
    4: ("being switched on", "wait, then release the brakes at the pendant (START)"),
    5: ("on, but its brakes are closed", "release the brakes at the pendant (START)"),
    6: ("in freedrive", "let go of the freedrive button"),
    8: ("updating its firmware", "wait until it has finished"),
}
"""Every robot_mode but RUNNING: what the arm is, what to do."""

LOCAL = Trouble(
    "not ready",
    "local control: the controller takes no program from the network",
    "switch the pendant to Remote Control (top right; it is allowed under Settings > System > "
    "Remote Control)",
)
PROGRAM_STOPPED = Trouble(
    "not ready",
    "that its program was stopped, at the pendant or by an error in it",
    "check that nobody works at the pendant, and go on",
)
PROGRAM_PAUSED = Trouble(
    "not ready",
    "that its program is paused at the pendant",
    "press stop at the pendant (not play), and go on",
)


def trouble(
    robot_mode: int, safety_mode: int, safety_bits: int, runtime_state: int | None
) -> Trouble | None:
    """Return what keeps the arm from moving, or None.

    Args:
        robot_mode: of RTDE.
        safety_mode: of RTDE.
        safety_bits: safety_status_bits of RTDE, which tell a stop one packet earlier.
        runtime_state: of RTDE; None where no program is expected to run.
    """
    if safety_bits >> EMERGENCY_BIT & 1:
        return _EMERGENCY
    if safety_bits >> PROTECTIVE_BIT & 1:
        return _PROTECTIVE
    if safety_mode not in (SAFETY_NORMAL, SAFETY_REDUCED):
        unknown = Trouble("not ready", f"safety mode {safety_mode}", "see the pendant")
        return SAFETY_MODES.get(safety_mode, unknown)
    if robot_mode != ROBOT_RUNNING:
        is_, do = ROBOT_MODES.get(robot_mode, (f"in robot mode {robot_mode}", "see the pendant"))
        return Trouble("not ready", f"that it is {is_}", do)
    if runtime_state is None or runtime_state == RUNTIME_PLAYING:
        return None
    return PROGRAM_PAUSED if runtime_state in (3, 4) else PROGRAM_STOPPED


def detected_model(dashboard_model: str | None, major_version: int) -> str | None:
    """Return the model name that a controller means, or None.

    The dashboard of an e-Series says "UR5" for a UR5e: PolyScope 3 is CB3, 5 and later e-Series.
    """
    name = (dashboard_model or "").strip()
    if not name.upper().startswith("UR") or not name[2:].rstrip("eE").isdigit():
        return None
    number = name[2:].rstrip("eE")
    # UR15, UR20 and UR30 carry no e: they never existed as CB3.
    with_e = major_version >= 5 and number in ("3", "5", "7", "10", "12", "16")
    return f"UR{number}{'e' if with_e else ''}"
