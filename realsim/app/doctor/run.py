"""`realsim doctor`: all findings, as tables and as JSON."""

from collections.abc import Sequence
from pathlib import Path

from realsim.app.console import Console
from realsim.app.doctor.devices import camera_findings, robot_findings
from realsim.app.doctor.finding import Finding
from realsim.app.doctor.isolation import isolated
from realsim.app.doctor.machine import machine_findings
from realsim.app.doctor.software import software_findings, software_probes
from realsim.errors import InputError

NUMBA, CAMERAS = "numba-cache", "realsense"
HEADER = ("", "", "found", "what to do")


def examine(
    session: Path | None, robot_host: str, console: Console, settings: Sequence[Finding] = ()
) -> list[Finding]:
    """Look at everything.

    Args:
        session: whose disk is looked at; None = the current folder's.
        robot_host: address of the robot's controller; empty = it is not asked.
        console: progress goes there.
        settings: findings about the file of settings.

    Raises:
        InputError: `session` is no folder.
    """
    if session is not None and not session.is_dir():
        raise InputError(f"'{session}' is no folder; give the folder of a session, or nothing.")
    with console.stage("doctor", "libraries and devices") as tick:
        outcomes = isolated([*software_probes(), NUMBA, CAMERAS], tick)
    robot = robot_findings(robot_host) if robot_host else []
    return [
        *software_findings(outcomes),
        *settings,
        *machine_findings(session, outcomes[NUMBA]),
        *camera_findings(outcomes[CAMERAS]),
        *robot,
    ]


def show(findings: Sequence[Finding], console: Console) -> bool:
    """Print the findings; return whether there is no problem."""
    for group in dict.fromkeys(f.group for f in findings):
        rows = [[f.name, f.kind, f.found, f.todo] for f in findings if f.group == group]
        told = any(row[3] for row in rows)
        width = 4 if told else 3
        console.table(group, HEADER[:width], [row[:width] for row in rows])
    problems = [f for f in findings if f.kind == "problem"]
    notes = sum(f.kind == "note" for f in findings)
    if problems:
        names = ", ".join(p.name for p in problems)
        console.say(f"{len(problems)} problems, {notes} notes: {names}")
    else:
        console.say(f"everything that realsim needs is there ({notes} notes).")
    console.result({"ok": not problems, "findings": list(findings)})
    return not problems
