"""What keeps a Franka arm from moving, as libfranka reports it, and what a person does about it."""

from collections.abc import Sequence

from realsim.errors import InputError, RealsimError
from realsim_capture_plans.devices.interfaces import ArmStoppedError, Stop

TROUBLES: dict[str, tuple[Stop, str, str]] = {
    "Reflex": ("protective stop", "a reflex",
               "read the errors, free what it touched, and go on: that clears it"),
    "UserStopped": ("not ready", "a user stop: the external activation device is pressed",
                    "check that the cell is clear and release it; the lights turn blue"),
    "Other": ("emergency stop", "locked joints, or an emergency stop",
              "check that the cell is clear, release the emergency stop, unlock the joints in "
              "Desk"),
    "Guiding": ("not ready", "that it is guided by hand",
                "let go of the buttons at its wrist, and switch Desk to Execution"),
    "AutomaticErrorRecovery": ("not ready", "that it recovers from an error", "wait, and go on"),
    "Move": ("not ready", "a motion that is not ours", "end the program that moves it"),
}  # fmt: skip
"""libfranka's RobotMode, but Idle: kind of stop, what is reported, what a person does."""
REMEDIES = {
    "communication_constraints_violation": "it missed set-points: give this computer a real-time "
    "kernel, a cable straight to the controller and no other work, and go on: that clears it",
    "joint_position_limits_violation": "guide it by hand back inside its limits, and go on",
}
"""What a person does about one of libfranka's Errors, where a reflex's remedy does not help."""


def trouble(mode: str, errors: Sequence[str]) -> tuple[Stop, str, str] | None:
    """Return what keeps the arm from moving (kind, what is found, what to do), or None.

    Args:
        mode: libfranka's RobotMode.
        errors: the names of libfranka's Errors that stand.
    """
    if mode not in TROUBLES:
        return None
    stop, found, remedy = TROUBLES[mode]
    remedy = next((REMEDIES[error] for error in errors if error in REMEDIES), remedy)
    return stop, found + (f" ({', '.join(errors)})" if errors else ""), remedy


def named(who: str, kind: str, said: str) -> RealsimError:
    """Return the error for what franky said.

    Args:
        who: model and address.
        kind: the class of franky's exception.
        said: its text.
    """
    if kind == "IncompatibleVersionException":
        return InputError(
            f"the {who} does not speak the installed franky's protocol: {said} A Panda needs a "
            "franky for robot server version 5 or lower, an FR3 one for its own software; franky's "
            "FAQ says where they are."
        )
    if kind == "NetworkException" and "refused" in said:
        remedy = "unlock the joints and activate FCI in Desk"
        return stopped(who, "not ready", "that its control interface (FCI) is off", remedy)
    if kind == "RealtimeException":
        return stopped(who, "not ready", said, "allow this user real-time priorities")
    if kind in ("NetworkException", "TimeoutError") or "Net Exception" in said:
        return lost(who, said)
    if kind in ("ControlException", "CommandException"):
        return stopped(who, "protective stop", said, TROUBLES["Reflex"][2])
    return stopped(who, "not ready", said or kind, "see what it says, and go on")


def stopped(who: str, stop: Stop, found: str, remedy: str) -> ArmStoppedError:
    """Return the error of a stop: what was found, and what a person does about it."""
    text = f"{stop}: the {who} does not move: it reports {found}. What to do: {remedy}."
    return ArmStoppedError(text, stop)


def off_goal(who: str, why: str) -> ArmStoppedError:
    """Return the error of an arm that is not where it was sent."""
    return ArmStoppedError(
        f"off goal: the {who}: {why}. What to do: see that nothing holds it, that the end "
        "effector's mass in Desk is right, and that this computer is not busy with other work; "
        "then go on.",
        "off goal",
    )


def lost(who: str, why: str) -> ArmStoppedError:
    """Return the error of an arm that does not answer."""
    return ArmStoppedError(
        f"connection lost: the {who} does not answer ({why}); it stops by itself. What to do: "
        "check the cable and the address, that the controller is on and FCI active, and that no "
        "other program is connected to it; then go on.",
        "connection lost",
    )
