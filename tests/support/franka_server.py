"""A Franka arm of software: franky-sim's server and its MuJoCo arm, whose robot can be disturbed.

Run as a program with an address, it serves the robot's own protocol there until its standard input
ends. A line on standard input is answered by one on standard output: `reflex ERROR`, `user_stop`,
`locked`, `clear` (what a person does), `tool X Y Z` [m], `joints` (where they really are).
franky-sim knows no errors and no stops: what the robot's protocol says of them is added here.
"""

import contextlib
import queue
import random
import subprocess
import sys
import threading
from typing import Any

import numpy as np

ERRORS = {"joint_reflex": 6, "communication_constraints_violation": 25}
"""Numbers of some of libfranka's Errors in the packets of the state."""
WRIST_KV = 60.0
"""Damping of the wrist's joints [Nms/rad]: with franky-sim's own 200 they chatter for ever."""
READY = "ready"


class FrankaServer:
    """A running server at `host`; it ends with `close`, `kill` or with this process."""

    def __init__(self) -> None:
        """Start it at a loopback address that hardly anybody else has, and wait for it."""
        numbers = (random.randint(1, 254), random.randint(0, 255), random.randint(2, 254))
        self.host = "127.{}.{}.{}".format(*numbers)
        self._process: subprocess.Popen[str] = subprocess.Popen(
            [sys.executable, __file__, self.host],
            stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True,
        )  # fmt: skip
        assert self._line() == READY

    def tell(self, words: str) -> str:
        """Give a command; return the answer."""
        assert self._process.stdin is not None
        self._process.stdin.write(words + "\n")
        self._process.stdin.flush()
        return self._line()

    def joints(self) -> np.ndarray:
        """Return where the joints (7,) really are [rad]."""
        return np.array([float(word) for word in self.tell("joints").split()])

    def signal(self, number: int) -> None:
        """Send a signal: SIGSTOP is a controller that fell silent."""
        self._process.send_signal(number)

    def kill(self) -> None:
        """End it without a word, as a power cut does."""
        self._process.kill()
        self._process.wait()

    def close(self) -> None:
        """End it."""
        self.kill()
        for stream in (self._process.stdin, self._process.stdout):
            if stream is not None:
                with contextlib.suppress(OSError):
                    stream.close()

    def _line(self) -> str:
        assert self._process.stdout is not None
        return self._process.stdout.readline().strip()


def _server(words: queue.Queue[list[str]]) -> type:
    """Return franky-sim's server of a robot, which obeys words, too."""
    from franky_sim.franka_robot_protocol import BaseCommand, MoveStatus, RobotCommand, RobotMode
    from franky_sim.franka_robot_server import FrankaRobotServer

    class Server(FrankaRobotServer):
        mode: RobotMode | None = None
        error: int | None = None
        answer = ""

        @property
        def robot_state(self) -> Any:
            state = super().robot_state
            # Of franky-sim, O_T_EE and O_T_EE_d are one array: both are where it should be.
            T = self.robot.kinematics(np.array(state.q))
            state = state.replace(O_T_EE=self.robot.to_franka_pose(T))
            if not self.current_motion_id:  # a robot that holds commands no speed
                state = state.replace(dq_d=(0.0,) * 7, ddq_d=(0.0,) * 7)
            if self.mode is not None:
                errors = tuple(i == self.error for i in range(41))
                state = state.replace(robot_mode=self.mode, errors=errors)
            return state

        def process_commands(self) -> None:
            # Before its first step the arm has no state (ValueError): a word waits until then.
            with contextlib.suppress(queue.Empty, ValueError):
                _ = self.robot.state
                word, *rest = words.get_nowait()
                self.answer = self.obey(word, rest)
            super().process_commands()

        def send_state(self) -> None:
            super().send_state()
            if self.answer:  # told only when it can be seen in the robot's state
                print(self.answer, flush=True)
                self.answer = ""

        def obey(self, word: str, rest: list[str]) -> str:
            if word == "reflex":
                self.stop(RobotMode.kReflex, MoveStatus.kReflexAborted)
                self.error = ERRORS[rest[0]]
            elif word == "user_stop":
                self.stop(RobotMode.kUserStopped, MoveStatus.kEmergencyAborted)
            elif word == "locked":
                self.stop(RobotMode.kOther, MoveStatus.kEmergencyAborted)
            elif word == "clear":
                self.mode = self.error = None
            elif word == "tool":
                offset = np.eye(4)
                offset[:3, 3] = [float(value) for value in rest]
                self.robot.set_NE_T_EE(tuple(offset.flatten(order="F").tolist()))
            return " ".join(repr(float(value)) for value in self.robot.state.q)

        def stop(self, mode: RobotMode, status: MoveStatus) -> None:
            self.mode = mode
            if self.current_motion_id:
                self.stop_motion(send_preemption_signal=False)
                move, motion = RobotCommand.kMove, self.current_motion_id
                BaseCommand.send_response(self._tcp_socket, move, motion, status)
                self.reset_current_motion_id()

    return Server


def _recovery() -> type:
    """Return the command that ends a reflex, and no other stop."""
    from franky_sim import franka_robot_protocol as protocol

    class Recovery(protocol.AutomaticErrorRecoveryCommand):
        def handle(self, server: Any) -> None:
            status = protocol.AutomaticErrorRecoveryStatus
            if server.mode in (None, protocol.RobotMode.kReflex):
                server.mode = server.error = None
                self.reply(status.kSuccess)
            else:
                self.reply(status.kCommandNotPossibleRejected)

    return Recovery


def serve(host: str) -> None:
    """Serve the robot at an address until standard input ends."""
    from franky_sim import SimulationServer, franka_robot_server, simulation_server
    from franky_sim.mujoco_simulator import MUJOCO_DEFAULT_KV, MujocoSimulator

    words: queue.Queue[list[str]] = queue.Queue()

    def read() -> None:
        for line in sys.stdin:
            words.put(line.split())
        running.running = False

    franka_robot_server.AutomaticErrorRecoveryCommand = _recovery()
    simulation_server.FrankaRobotServer = _server(words)
    with MujocoSimulator() as sim:
        sim.add_robot(kv=(*MUJOCO_DEFAULT_KV[:4], WRIST_KV, WRIST_KV, WRIST_KV))
        with SimulationServer(sim, hostname_candidates=[host]) as running:
            threading.Thread(target=read, daemon=True).start()
            print(READY, flush=True)
            running.run_forever()


if __name__ == "__main__":
    serve(sys.argv[1])
