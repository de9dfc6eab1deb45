"""What keeps a UR arm from moving, as its controller reports it, and what a person does about it.

Numbers of Universal Robots' Real-Time Data Exchange guide: robot_mode, safety_mode, runtime_state.
"""

from typing import NamedTuple

from realsim_capture_plans.devices.interfaces import Stop

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
