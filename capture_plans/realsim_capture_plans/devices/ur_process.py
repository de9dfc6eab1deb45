"""The process in which ur_rtde runs: one JSON request a line on stdin, one answer a line back.

ur_rtde stays out of the capture's own process for three reasons: its constructors wait without a
limit and hold the interpreter while they do; its threads can end the process when a connection
goes; and after a lost connection it reconnects, uploads its script and SENDS THE LAST COMMAND
AGAIN by itself. Here every request has a deadline, at which the process is ended by its own alarm,
and the other side simply starts a new one.

Run as a file, with the standard library and ur_rtde only, so that it starts at once.
"""

import json
import os
import re
import signal
import sys
import time
from collections.abc import Callable
from importlib import import_module
from typing import Any

PLAYING = 2
"""RTDE's runtime_state of a running program."""
PACKET_POLL_S = 0.001
"""How often a new packet is looked for [s]; packets come every 8 ms."""
STOP_WAIT_S = 2.0
"""Longest wait for the controller to end a program that it was told to stop [s]."""
LAST_WORD_S = 3.0
"""Longest a stop may take that is sent because the other side is gone [s]."""


class UrProcess:
    """The three connections of ur_rtde, and what can be asked of them."""

    def __init__(self) -> None:
        """Begin without any connection."""
        self._receive: Any = None
        self._control: Any = None
        self._with_payload = False

    def identify(self, host: str) -> dict[str, Any]:
        """Return what the dashboard says of the robot; None for what it does not know."""
        dashboard = self._dashboard(host)
        try:
            known: dict[str, Any] = {}
            questions: dict[str, Callable[[], Any]] = {
                "version": dashboard.polyscopeVersion,
                "model": dashboard.getRobotModel,
                "serial": dashboard.getSerialNumber,
                "program": dashboard.programState,
            }
            for key, ask in questions.items():
                try:
                    known[key] = ask()
                except RuntimeError:
                    known[key] = None  # CB3 has no serial number on the dashboard
            found = re.match(r"(\d+)\.(\d+)", str(known["version"]))
            # Remote control exists on an e-Series from PolyScope 5.6 on.
            has_remote = found is not None and found[1] == "5" and int(found[2]) > 5
            known["remote"] = dashboard.isInRemoteControl() if has_remote else None
            return known
        finally:
            dashboard.disconnect()

    def listen(self, host: str, frequency: float, variables: list[str]) -> None:
        """Open the stream of readings."""
        module = import_module("rtde_receive")
        self._with_payload = "payload" in variables
        self._receive = module.RTDEReceiveInterface(host, frequency, variables)

    def take_control(self, host: str, frequency: float) -> None:
        """Stop whatever program runs and upload ur_rtde's own; it waits for commands."""
        self.halt(host)
        control = import_module("rtde_control").RTDEControlInterface
        # No external force sensor: its register may belong to another program, we never use it.
        flags = int(control.FLAG_UPLOAD_SCRIPT) | int(control.FLAG_NO_EXT_FT)
        self._control = control(host, frequency, flags)

    def look(self, timeout_s: float) -> dict[str, Any]:
        """Return the readings of one packet that came after this call; `fresh` says if one did."""
        receive = self._receive
        before = receive.getTimestamp()
        end = time.monotonic() + timeout_s
        while receive.getTimestamp() == before and time.monotonic() < end:
            if not receive.isConnected():
                return {"fresh": False}
            time.sleep(PACKET_POLL_S)
        while True:
            stamp = receive.getTimestamp()
            seen = {
                "joints": receive.getActualQ(),
                "speeds": receive.getActualQd(),
                "tcp": receive.getActualTCPPose(),
                "robot_mode": receive.getRobotMode(),
                "safety_mode": receive.getSafetyMode(),
                "safety_bits": receive.getSafetyStatusBits(),
                "runtime_state": receive.getRuntimeState(),
                "speed_scaling": receive.getSpeedScaling(),
                "payload_kg": receive.getPayload() if self._with_payload else None,
            }
            if receive.getTimestamp() == stamp:
                break
        seen["time_s"] = stamp
        seen["fresh"] = stamp != before
        seen["under_way"] = self._under_way()
        return seen

    def tool_offset(self) -> list[float] | None:
        """Return the controller's TCP offset [x y z rx ry rz]; None where the script is not up."""
        if self._control is None:
            return None
        try:
            return list(self._control.getTCPOffset())
        except RuntimeError:
            return None

    def start_move(self, joints: list[float], speed: float, acceleration: float) -> bool:
        """Start a moveJ and return at once whether the controller took it."""
        return bool(self._control.moveJ(joints, speed, acceleration, True))

    def stop_move(self, deceleration: float) -> None:
        """Brake in joint space; return when the arm stands."""
        if self._control is not None:
            self._control.stopJ(deceleration, False)

    def halt(self, host: str) -> None:
        """End the controller's program, so that nothing goes on when a stop is cleared."""
        dashboard = self._dashboard(host)
        try:
            dashboard.stop()
        except RuntimeError:
            pass  # nothing ran, or the pendant has the control: the readings tell which
        finally:
            dashboard.disconnect()
        end = time.monotonic() + STOP_WAIT_S
        while self._playing() and time.monotonic() < end:
            time.sleep(0.01)

    def last_word(self) -> None:
        """Brake, if a move is under way: nobody watches it any more."""
        if self._control is not None and self._under_way():
            self._control.stopJ(2.0, False)

    def end(self) -> None:
        """End our own program on the controller."""
        if self._control is not None:
            self._control.stopScript()

    def _dashboard(self, host: str) -> Any:
        dashboard = import_module("dashboard_client").DashboardClient(host)
        dashboard.connect(2000)
        return dashboard

    def _playing(self) -> bool:
        return self._receive is not None and self._receive.getRuntimeState() == PLAYING

    def _under_way(self) -> bool:
        if self._control is None or not self._control.isConnected():
            return False
        return bool(self._control.getAsyncOperationProgressEx().isAsyncOperationRunning())


def main() -> None:
    """Answer requests until stdin closes; then brake and leave."""
    # What ur_rtde prints goes to stderr, where the other side keeps it; answers have their own way.
    answers = os.fdopen(os.dup(1), "w", encoding="utf-8")
    os.dup2(2, 1)
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.signal(signal.SIGALRM, signal.SIG_DFL)
    process = UrProcess()
    for line in sys.stdin:
        request = json.loads(line)
        signal.setitimer(signal.ITIMER_REAL, float(request["deadline_s"]))
        try:
            value = getattr(process, request["do"])(**request["with"])
            answer: dict[str, Any] = {"value": value}
        except Exception as error:
            answer = {"error": f"{error}" or type(error).__name__}
        signal.setitimer(signal.ITIMER_REAL, 0.0)
        answer["number"] = request["number"]
        try:
            answers.write(json.dumps(answer) + "\n")
            answers.flush()
        except BrokenPipeError:
            break
    signal.setitimer(signal.ITIMER_REAL, LAST_WORD_S)
    try:
        process.last_word()
    finally:
        os._exit(0)  # ur_rtde's destructors sleep for seconds


if __name__ == "__main__":
    main()
