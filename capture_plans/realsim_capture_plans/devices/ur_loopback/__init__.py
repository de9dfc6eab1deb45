"""A UR controller without an arm: enough of one that ur_rtde itself cannot tell.

It runs in a process of its own, because ur_rtde's constructors hold the interpreter.
"""

from realsim_capture_plans.devices.ur_loopback.client import LoopbackController

__all__ = ["LoopbackController"]
