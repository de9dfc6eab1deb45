"""What a capture expects of an arm and a camera: run it on a new driver before anything else.

    findings = check_arm(arm) + check_camera(camera)      # empty: the drivers keep the protocols

`check_arm` moves the arm: one joint, by `STEP_RAD`, there and back, if what it says of itself is
right. Keep a hand on the stop button.
"""

import json
import time

import numpy as np

from realsim import InputError
from realsim.robots.arm import known_chains
from realsim_capture_plans import Arm, DepthCamera

STEP_RAD = 0.05
"""A move of three degrees shows unit, sign and order of the joints, and hurts nobody."""
ARRIVED_RAD = 0.005
"""A capture takes the arm to be at its goal within this, per joint."""
OTHER_ARM_MM = 30.0
"""Flange poses farther than this from the named arm's chain are of another arm, tool or unit."""
DEPTH_M = (0.05, 5.0)
"""Where the middle of measured depth lies in front of a hand."""


def check_arm(arm: Arm, joint: int = 5) -> list[str]:
    """Return what an arm does otherwise than `Arm` says; moves one joint there and back."""
    found = _plain_json("the arm", arm.description)
    arm.recover()  # must do nothing where nothing is wrong
    first = arm.state()
    if not arm.limits.contains(first.joints):
        found.append(f"joints {first.joints.round(3).tolist()} are beyond the limits: degrees?")
    found += _flange(arm)
    if found:
        return found  # an arm that is wrong about where it stands is not moved
    goal = first.joints.copy()
    goal[joint] += STEP_RAD if goal[joint] + STEP_RAD < arm.limits.upper[joint] else -STEP_RAD
    arm.move(goal, speed=0.1, acceleration=0.3)
    there = arm.state()
    if (off := np.abs(there.joints - goal).max()) > ARRIVED_RAD:
        found.append(
            f"a move returns {np.degrees(off):.2f} deg before its goal: unit, or too early"
        )
    found += _flange(arm)
    arm.move(first.joints, speed=0.1, acceleration=0.3)
    if not arm.state().time_s > there.time_s > first.time_s:
        found.append("time stamps of the arm do not go on: read the controller's clock [s]")
    return found + _refuses(arm)


def check_camera(camera: DepthCamera, frames: int = 3) -> list[str]:
    """Return what a camera does otherwise than `DepthCamera` says."""
    found = _plain_json("the camera", camera.description)
    camera.recover()
    k, unit, last = camera.intrinsics, camera.depth_unit_m, -np.inf
    for _ in range(frames):
        frame = camera.grab()
        time.sleep(0.02)
        if frame.rgb.shape[:2] != (k.height, k.width):
            found.append(f"images are {frame.rgb.shape[:2]}, intrinsics {(k.height, k.width)}")
        seen = frame.depth_m[frame.depth_m > 0]
        if not len(seen):
            found.append("no pixel has depth: look at a table from 0.3 to 0.5 m")
        elif not DEPTH_M[0] < (middle := float(np.median(seen))) < DEPTH_M[1]:
            found.append(f"the middle of the depth is {middle:.4g} m: is it in metres?")
        counts = seen / np.float64(unit)
        if np.any(counts > 65535) or np.any(np.abs(counts - counts.round()) > 0.1):
            found.append(f"depth is not in whole counts of {unit:g} m: aligned by interpolation?")
        if not frame.time_s > last:
            found.append("a grab gave a frame of before: it must be exposed after the call")
        last = frame.time_s
    return sorted(set(found))


def _plain_json(what: str, description: object) -> list[str]:
    try:
        json.dumps(description, allow_nan=False)
    except (TypeError, ValueError) as error:
        return [f"{what}'s description is not plain JSON: {error}"]
    return []


def _flange(arm: Arm) -> list[str]:
    """Return whether the flange is where the named arm's chain puts it."""
    chain = known_chains().get(arm.name)
    if chain is None:
        return []  # nothing to compare with
    state = arm.state()
    gap = state.T_base_ee[:3, 3] - chain.forward(state.joints)[:3, 3]
    if (mm := 1e3 * float(np.linalg.norm(gap))) > OTHER_ARM_MM:
        return [f"the flange is {mm:.0f} mm from the {arm.name}'s chain: unit, order, or tool?"]
    return []


def _refuses(arm: Arm) -> list[str]:
    """Return which impossible goals are not refused."""
    before, found = arm.state().joints, list[str]()
    for what, goal in (
        ("no number", np.full(6, np.nan)),
        ("five joints", before[:5]),
        ("a goal beyond the limits", arm.limits.upper + 1.0),
    ):
        try:
            arm.move(goal)
            found.append(f"{what} is not refused")
        except InputError:
            if np.abs(arm.state().joints - before).max() > ARRIVED_RAD:
                found.append(f"{what} is refused, but the arm has moved")
    return found
