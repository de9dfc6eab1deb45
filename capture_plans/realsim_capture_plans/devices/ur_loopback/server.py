"""The loopback's three ports, as ur_rtde uses them: RTDE version 2, dashboard, program upload."""

import asyncio
import contextlib
import struct
import time
from collections.abc import Callable
from typing import Any

from realsim_capture_plans.devices.ur_link import DASHBOARD_PORT, RTDE_PORT, SCRIPT_PORT
from realsim_capture_plans.devices.ur_loopback.robot import PLAYING, Controller

TICK_S = 1 / 125
"""One packet of readings, and one round of the program, every 8 ms of the wall clock."""
PROGRAM_START_S = 0.03
"""From an uploaded program's last line to its start [s]."""
SCRIPT_NAME, SCRIPT_END = b"def rtde_control", b"\nend\n"
PROTOCOL, VERSION, TEXT, DATA = 86, 118, 77, 85
SETUP_OUTPUTS, SETUP_INPUTS, START, PAUSE = 79, 73, 83, 80
FORMATS = {
    "DOUBLE": "d", "INT32": "i", "UINT32": "I", "UINT64": "Q",
    "VECTOR3D": "3d", "VECTOR6D": "6d", "VECTOR6INT32": "6i",
}  # fmt: skip
MODES = {7: "RUNNING", 5: "IDLE", 3: "POWER_OFF"}
SAFETY = {1: "NORMAL", 3: "PROTECTIVE_STOP", 5: "SAFEGUARD_STOP", 7: "ROBOT_EMERGENCY_STOP"}

Reading = tuple[str, Callable[[Controller], Any]]
READINGS: dict[str, Reading] = {
    "timestamp": ("DOUBLE", lambda c: c.time_s),
    "target_q": ("VECTOR6D", lambda c: c.joints),
    "target_qd": ("VECTOR6D", lambda c: c.speeds),
    "actual_q": ("VECTOR6D", lambda c: c.actual_joints),
    "actual_qd": ("VECTOR6D", lambda c: c.actual_speeds),
    "actual_TCP_pose": ("VECTOR6D", lambda c: c.tcp_pose),
    "target_TCP_pose": ("VECTOR6D", lambda c: c.tcp_pose),
    "robot_mode": ("INT32", lambda c: c.robot_mode),
    "safety_mode": ("INT32", lambda c: c.safety_mode),
    "runtime_state": ("UINT32", lambda c: c.runtime),
    "robot_status_bits": ("UINT32", lambda c: c.status_bits),
    "safety_status_bits": ("UINT32", lambda c: c.safety_bits),
    "payload_cog": ("VECTOR3D", lambda c: (0.0, 0.0, 0.03)),
}
"""What the loopback knows about its arm."""
CONSTANTS: dict[tuple[str, float], tuple[str, ...]] = {
    ("VECTOR6D", 0.0): (
        "target_qdd", "target_current", "target_moment", "actual_current", "joint_control_output",
        "actual_TCP_speed", "actual_TCP_force", "target_TCP_speed", "ft_raw_wrench",
        "payload_inertia",
    ),
    ("VECTOR6D", 30.0): ("joint_temperatures",),
    ("VECTOR6D", 48.0): ("actual_joint_voltage",),
    ("VECTOR6INT32", 253): ("joint_mode",),
    ("VECTOR3D", 0.0): ("actual_tool_accelerometer",),
    ("DOUBLE", 0.0): (
        "actual_execution_time", "actual_momentum", "standard_analog_input0",
        "standard_analog_input1", "standard_analog_output0", "standard_analog_output1",
    ),
    ("DOUBLE", 0.35): ("payload",),
    ("DOUBLE", 0.5): ("actual_robot_current",),
    ("DOUBLE", 1.0): ("speed_scaling", "target_speed_fraction"),
    ("DOUBLE", 48.0): ("actual_main_voltage", "actual_robot_voltage"),
    ("UINT64", 0): ("actual_digital_input_bits", "actual_digital_output_bits"),
}  # fmt: skip
"""What ur_rtde reads by default and the loopback has no notion of, by its kind and its value."""


def _constant(kind: str, value: float) -> Reading:
    count = int(FORMATS[kind][0]) if FORMATS[kind][0].isdigit() else 1
    return kind, lambda c: (value,) * count if count > 1 else value


READINGS |= {name: _constant(*same) for same, names in CONSTANTS.items() for name in names}


def _reading(name: str) -> Reading | None:
    if name.startswith("output_int_register_"):
        k = int(name.rsplit("_", 1)[1])
        return "INT32", lambda c: c.output_ints[k]
    if name.startswith("output_double_register_"):
        k = int(name.rsplit("_", 1)[1])
        return "DOUBLE", lambda c: c.output_doubles[k]
    return READINGS.get(name)  # anything else is NOT_FOUND, as on a controller


class RtdeClient:
    """One connection to the RTDE port: what it wants to read and may write."""

    def __init__(self, writer: asyncio.StreamWriter) -> None:
        """Begin with nothing set up."""
        self.writer = writer
        self.started = False
        self.outputs: list[tuple[int, struct.Struct, list[Reading]]] = []
        self.inputs: dict[int, tuple[struct.Struct, list[str]]] = {}

    @property
    def owned(self) -> set[str]:
        """Input registers that this connection writes."""
        return {name for _, names in self.inputs.values() for name in names}

    def send(self, kind: int, payload: bytes) -> None:
        """Send one message."""
        if not self.writer.is_closing():
            self.writer.write(struct.pack(">HB", 3 + len(payload), kind) + payload)

    def send_readings(self, controller: Controller) -> None:
        """Send one packet of every set of readings that was asked for."""
        for number, layout, readings in self.outputs:
            values: list[Any] = []
            for kind, read in readings:
                value = read(controller)
                values.extend(value if FORMATS[kind][0].isdigit() else (value,))
            self.send(DATA, bytes([number]) + layout.pack(*values))


class LoopbackServer:
    """The ports of one controller on one address."""

    def __init__(self, controller: Controller, host: str) -> None:
        """Prepare; `run` opens the ports."""
        self.controller = controller
        self.host = host
        self.hanging = False
        self._listeners: list[asyncio.Server] = []
        self._writers: set[asyncio.StreamWriter] = set()
        self._clients: set[RtdeClient] = set()
        self._tasks: set[asyncio.Task[None]] = set()

    async def open(self) -> None:
        """Open the ports.

        Raises:
            OSError: one of them is taken.
        """
        for port, serve in (
            (RTDE_PORT, self._rtde),
            (SCRIPT_PORT, self._script),
            (DASHBOARD_PORT, self._dashboard),
        ):
            self._listeners.append(await asyncio.start_server(serve, self.host, port))

    async def run(self) -> None:
        """Let the controller's time pass until cancelled."""
        last = time.monotonic()
        while True:
            await asyncio.sleep(max(0.0, TICK_S - (time.monotonic() - last)))
            now = time.monotonic()
            self.controller.advance((now - last) * self.controller.setup.speedup)
            last = now
            for client in list(self._clients):
                if client.started and not self.hanging:
                    client.send_readings(self.controller)

    def drop(self) -> None:
        """Close the ports and every connection, as when the cable is pulled or power goes."""
        for listener in self._listeners:
            listener.close()
        self._listeners.clear()
        for writer in list(self._writers):
            writer.transport.abort()
        self.controller.stop_program()

    async def restore(self) -> None:
        """Answer again after `drop` or a hang."""
        self.hanging = False
        if not self._listeners:
            await self.open()

    async def _rtde(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        client = RtdeClient(writer)
        self._clients.add(client)
        with self._connection(writer):
            try:
                while True:
                    size, kind = struct.unpack(">HB", await reader.readexactly(3))
                    payload = await reader.readexactly(size - 3)
                    if not self.hanging:
                        self._answer(client, kind, payload)
            finally:
                self._clients.discard(client)

    def _answer(self, client: RtdeClient, kind: int, payload: bytes) -> None:
        if kind == DATA:
            layout, names = client.inputs[payload[0]]
            if len(payload) != 1 + layout.size:
                return  # ur_rtde sends 12 numbers in a set of 6 for a forward kinematics
            for name, value in zip(names, layout.unpack(payload[1:]), strict=True):
                number = int(name.rsplit("_", 1)[1])
                is_int = name.startswith("input_int")
                where = self.controller.input_ints if is_int else self.controller.input_doubles
                where[number] = value
            return
        if kind == VERSION:
            reply = struct.pack(">4I", *self.controller.setup.version)
        elif kind == SETUP_OUTPUTS:
            reply = self._set_outputs(client, payload[8:])
        elif kind == SETUP_INPUTS:
            reply = self._set_inputs(client, payload)
        else:
            client.started = kind == START or (client.started and kind != PAUSE)
            reply = b"\x01"
        client.send(kind, reply)

    def _set_outputs(self, client: RtdeClient, names: bytes) -> bytes:
        known = [_reading(name) for name in names.decode().split(",") if name]
        readings = [reading for reading in known if reading is not None]
        if len(readings) == len(known):
            layout = struct.Struct(">" + "".join(FORMATS[kind] for kind, _ in readings))
            client.outputs.append((len(client.outputs) + 1, layout, readings))
        kinds = ["NOT_FOUND" if reading is None else reading[0] for reading in known]
        return bytes([len(client.outputs)]) + ",".join(kinds).encode()

    def _set_inputs(self, client: RtdeClient, payload: bytes) -> bytes:
        names = [name for name in payload.decode().split(",") if name]
        taken = {n for other in self._clients if other is not client for n in other.owned}
        number = len(client.inputs) + 1
        kinds = ["INT32" if name.startswith("input_int") else "DOUBLE" for name in names]
        if taken & set(names):
            answer = ["IN_USE" if n in taken else k for n, k in zip(names, kinds, strict=True)]
            return b"\x00" + ",".join(answer).encode()
        layout = struct.Struct(">" + "".join(FORMATS[kind] for kind in kinds))
        client.inputs[number] = (layout, names)
        return bytes([number]) + ",".join(kinds).encode()

    async def _script(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        with self._connection(writer):
            text = b""
            while piece := await reader.read(65536):
                text += piece
                while SCRIPT_END in text:
                    program, text = text.split(SCRIPT_END, 1)
                    if SCRIPT_NAME in program and not self.hanging:
                        task = asyncio.create_task(self._start_program())
                        self._tasks.add(task)
                        task.add_done_callback(self._tasks.discard)

    async def _start_program(self) -> None:
        self.controller.stop_program()
        self.controller.input_ints[0] = 0
        await asyncio.sleep(PROGRAM_START_S)
        self.controller.start_program()

    async def _dashboard(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        with self._connection(writer):
            if not self.hanging:
                writer.write(b"Connected: Universal Robots Dashboard Server\n")
            while line := await reader.readline():
                if not self.hanging:
                    writer.write(self._dashboard_answer(line.decode().strip()).encode() + b"\n")

    def _dashboard_answer(self, command: str) -> str:
        c = self.controller
        e_series = c.setup.version[0] >= 5
        unknown = f"could not understand: '{command}'"
        playing = c.runtime == PLAYING
        answers: dict[str, Callable[[], str]] = {
            "PolyscopeVersion": lambda: f"URSoftware {'.'.join(map(str, c.setup.version))} (2022)",
            "get robot model": lambda: c.setup.model,
            "get serial number": lambda: c.setup.serial if e_series else unknown,
            "is in remote control": lambda: str(c.remote).lower() if e_series else unknown,
            "programState": lambda: "PLAYING rtde_control.urp" if playing else "STOPPED <unnamed>",
            "running": lambda: f"Program running: {str(playing).lower()}",
            "robotmode": lambda: f"Robotmode: {MODES[c.robot_mode]}",
            "safetystatus": lambda: f"Safetystatus: {SAFETY[c.safety_mode]}",
            "stop": self._stop_answer,
        }
        return answers.get(command, lambda: unknown)()

    def _stop_answer(self) -> str:
        """End the program; a controller with none, or in local control, says it failed."""
        if self.controller.runtime == 1 or not self.controller.remote:
            return "Failed to execute: stop"
        self.controller.stop_program()
        return "Stopped"

    @contextlib.contextmanager
    def _connection(self, writer: asyncio.StreamWriter) -> Any:
        """Keep a connection in the list; its end is no error."""
        self._writers.add(writer)
        try:
            yield
        except (asyncio.IncompleteReadError, ConnectionError):
            pass
        finally:
            self._writers.discard(writer)
            writer.close()
