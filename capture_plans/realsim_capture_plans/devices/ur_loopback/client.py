"""A loopback controller in a process of its own: for tests, and for a plan without a robot."""

import json
import random
import time
from typing import Any

from realsim_capture_plans.devices.interfaces import DeviceError
from realsim_capture_plans.devices.ur_link import LineProcess

MODULE = "realsim_capture_plans.devices.ur_loopback"
READY_S = 60.0
"""Longest wait for the process to open its ports [s]; it imports numpy first."""
ANSWER_S = 20.0
"""Longest wait for an answer to a command [s]."""
ADDRESSES_TRIED = 20
"""Addresses 127.0.0.x tried for free ports: several controllers may run at once."""


class LoopbackController:
    """A running loopback controller at `host`; it ends with `close` or with this process."""

    def __init__(self, host: str, process: LineProcess, options: list[str]) -> None:
        """Take over a process that is ready; use `start`."""
        self.host = host
        self._process = process
        self._options = options

    @classmethod
    def start(cls, host: str | None = None, **options: Any) -> "LoopbackController":
        """Start one and wait until its ports are open.

        Args:
            host: a loopback address; by default a free one of 127.0.0.2 to 127.0.0.254.
            options: the command line's options, such as `robot="UR5e"`, `speedup=10`,
                `tcp="0,0,0.1,0,0,0"`.

        Raises:
            DeviceError: it does not start.
        """
        words = [f"--{key.replace('_', '-')}={value}" for key, value in options.items()]
        reason = ""
        for _ in range(1 if host else ADDRESSES_TRIED):
            # Not 127.0.0.1: ur_rtde does not ask there whether remote control is on.
            address = host or f"127.0.0.{random.randint(2, 254)}"
            process, reason = _spawn(address, words)
            if process is not None:
                return cls(address, process, words)
        raise DeviceError(f"no loopback controller could be started: {reason}")

    def inject(self, what: str, *, at_progress: float | None = None) -> None:
        """Let something happen: now, or when the next move has done this share of its way.

        Args:
            what: protective_stop, safeguard_stop, emergency_stop, power_off, brakes, program_stop,
                pause, local, stall, foreign_program; drop (connections), hang (no answers).
            at_progress: share of the move in [0, 1].
        """
        self._tell(f"{what}" if at_progress is None else f"{what} at {at_progress}")

    def clear(self) -> None:
        """Do what a person does at the pendant: clear every stop, switch on, answer again."""
        self._tell("clear")

    def set_tcp(self, pose: list[float]) -> None:
        """Change the configured tool offset [x y z rx ry rz] [m, rad]."""
        self._tell("tcp " + ",".join(map(repr, pose)))

    def place(self, joints: list[float]) -> None:
        """Put the arm at joints (6,) [rad] at once."""
        self._tell("place " + ",".join(map(repr, joints)))

    def joints(self) -> list[float]:
        """Return where the arm really is [rad]."""
        return [float(value) for value in self._tell("joints")]

    def kill(self) -> None:
        """End the process without a word, as a power cut does."""
        self._process.kill()

    def restart(self) -> None:
        """Start it anew at the same address."""
        process, reason = _spawn(self.host, self._options)
        if process is None:
            raise DeviceError(f"the loopback controller did not start again: {reason}")
        self._process = process

    def close(self) -> None:
        """End it."""
        self._process.close(5.0)

    def __enter__(self) -> "LoopbackController":
        """Return itself."""
        return self

    def __exit__(self, *_: object) -> None:
        """End it."""
        self.close()

    def _tell(self, line: str) -> Any:
        """Send one command and return its answer."""
        self._process.tell(line)
        answer = _answer(self._process, ANSWER_S, "no answer")
        if "error" in answer:
            raise DeviceError(f"the loopback controller on '{line}': {answer['error']}")
        return answer["value"]


def _spawn(host: str, options: list[str]) -> tuple[LineProcess | None, str]:
    """Return a process whose ports are open; or None and why not."""
    process = LineProcess(["-m", MODULE, f"--host={host}", "--piped", *options])
    answer = _answer(process, READY_S, "it ended or did not get ready")
    if "error" not in answer:
        return process, ""
    process.kill()
    return None, str(answer["error"])


def _answer(process: LineProcess, timeout_s: float, without: str) -> dict[str, Any]:
    """Return what a process answers; the error `without` where it does not."""
    line = process.line(time.monotonic() + timeout_s)
    return json.loads(line) if line else {"error": without}
