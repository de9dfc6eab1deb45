"""Run a loopback controller: `python -m realsim_capture_plans.devices.ur_loopback --help`."""

import argparse
import asyncio
import json
import os
import signal
import sys
from dataclasses import replace

import numpy as np

from realsim.errors import RealsimError
from realsim.robots.arm import ur_chains
from realsim_capture_plans.devices.ur_loopback.robot import Controller, ControllerSetup
from realsim_capture_plans.devices.ur_loopback.server import LoopbackServer

VERSIONS = {"UR5": (3, 15, 7, 106331), "UR5e": (5, 12, 2, 1101534)}
"""Controller software that each arm runs on."""


def _numbers(text: str) -> list[float]:
    values = [float(part) for part in text.split(",")]
    if len(values) != 6:
        raise argparse.ArgumentTypeError(f"'{text}' has {len(values)} numbers; 6 are needed")
    return values


def _version(text: str) -> tuple[int, int, int, int]:
    major, minor, bugfix, build = (int(part) for part in text.split("."))
    return major, minor, bugfix, build


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="python -m realsim_capture_plans.devices.ur_loopback",
        description="A UR controller without an arm, for trying a capture. The ports 30003, 30004 "
        "and 29999 are fixed: give each controller an address of its own. Commands on stdin: "
        "protective_stop, emergency_stop, clear, ... ; 'protective_stop at 0.5' waits for the "
        "middle of the next move.",
    )
    parser.add_argument("--host", default="127.0.0.2", help="loopback address (127.0.0.2)")
    parser.add_argument("--robot", choices=sorted(ur_chains()), default="UR5e")
    parser.add_argument("--tcp", type=_numbers, default=[0.0] * 6, help="x,y,z,rx,ry,rz [m, rad]")
    parser.add_argument("--joints", type=_numbers, help="where the arm stands [rad]")
    parser.add_argument("--delta-a", type=_numbers, help="calibration of the DH a's [m]")
    parser.add_argument("--delta-theta", type=_numbers, help="calibration of the joints [rad]")
    parser.add_argument("--speedup", type=float, default=1.0, help="of the clock (1)")
    parser.add_argument("--swing", type=float, default=0.0, help="after each move [rad] (0)")
    parser.add_argument("--polyscope", help="software version, such as 5.12.2.1101534")
    parser.add_argument("--local", action="store_true", help="start in local control")
    parser.add_argument("--piped", action="store_true", help="answer as JSON; end with stdin")
    return parser


def _controller(options: argparse.Namespace) -> Controller:
    chain = ur_chains()[options.robot]
    for name in ("delta_a", "delta_theta"):
        if getattr(options, name) is not None:
            chain = replace(chain, **{name: np.array(getattr(options, name))})
    setup = ControllerSetup(
        chain=chain,
        model=options.robot.rstrip("e"),
        version=_version(options.polyscope) if options.polyscope else VERSIONS[options.robot],
        tcp=options.tcp,
        speedup=options.speedup,
        swing_rad=options.swing,
    )
    if options.joints is not None:
        setup.joints = np.array(options.joints)
    controller = Controller(setup)
    controller.remote = not options.local
    return controller


async def _command(line: str, server: LoopbackServer) -> object:
    """Do one command; return what it answers."""
    controller = server.controller
    word, _, rest = line.partition(" ")
    if word == "clear":
        controller.clear()
        await server.restore()
    elif word == "drop":
        server.drop()
    elif word == "hang":
        server.hanging = True
    elif word == "tcp":
        controller.setup.tcp = _numbers(rest)
    elif word == "place":
        controller.joints = np.array(_numbers(rest))
    elif word == "joints":
        return controller.actual_joints.tolist()
    elif rest.startswith("at "):
        controller.inject_at(word, float(rest[3:]))
    else:
        controller.inject(word)
    return True


def _failed(task: "asyncio.Task[None]") -> None:
    """End at once where the controller's time stands still because of an error in it."""
    if not task.cancelled() and task.exception() is not None:
        print(f"the loopback controller failed: {task.exception()!r}", file=sys.stderr, flush=True)
        os._exit(1)


async def _serve(options: argparse.Namespace) -> None:
    server = LoopbackServer(_controller(options), options.host)
    try:
        await server.open()
    except OSError as error:
        print(json.dumps({"error": str(error)}), flush=True)
        return
    running = asyncio.create_task(server.run())
    running.add_done_callback(_failed)
    text = f"{options.robot} at {options.host}; Ctrl-C ends it"
    print(json.dumps({"value": text}) if options.piped else text, flush=True)
    # The thread that reads stdin cannot be ended in another way.
    asyncio.get_running_loop().add_signal_handler(signal.SIGINT, os._exit, 0)
    while line := await asyncio.to_thread(sys.stdin.readline):
        if not line.strip():
            continue
        try:
            answer: dict[str, object] = {"value": await _command(line.strip(), server)}
        except (RealsimError, ValueError, argparse.ArgumentTypeError, OSError) as error:
            answer = {"error": str(error)}
        print(json.dumps(answer), flush=True)
    if options.piped:
        os._exit(0)  # asyncio would report every connection that it cancels
    else:
        await running  # stdin may be empty from the start; Ctrl-C ends it


def main() -> None:
    """Run until stdin closes (--piped) or Ctrl-C."""
    asyncio.run(_serve(_parser().parse_args()))


if __name__ == "__main__":
    main()
