"""An arm's own factory calibration, from the controller's file or from ROS.

`calibration.conf` lies in the controller's `.urcontrol` folder. Its section `[mounting]` holds four
lists that are ADDED to the nominal Denavit-Hartenberg numbers. Joints 2, 3 and 4 turn about nearly
parallel axes, whose common normal may lie anywhere along them: offsets of tens of metres that
cancel to a millimetre are normal there, so nothing is ever clipped. What counts is the flange.

ROS's `ur_calibration` writes the same calibration as six fixed transforms, one before each joint.
Every pair of neighbouring axes has a common normal, which gives back DH numbers:

    O = Tz(b) Rz(phi) Tx(a) Rx(alpha) Rz(psi) Tz(c)

The screws about z at both ends commute with the joints' own turns and join theirs.
"""

import math
import re
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from realsim.arrays import Array
from realsim.errors import InputError
from realsim.geometry import se3
from realsim.geometry.dh import DhArm
from realsim.robots.arm import ur_chains
from realsim.robots.kinematics import DhChain, Screws, normals, screws
from realsim.untrusted.files import checked_text

LISTS = ("theta", "a", "d", "alpha")
"""What the controller's file holds as delta_theta, delta_a, ..."""
LINKS = ("shoulder", "upper_arm", "forearm", "wrist_1", "wrist_2", "wrist_3")
"""The transforms of a ROS kinematics file, from the base outwards."""
PLACES = ("x", "y", "z", "roll", "pitch", "yaw")
MODEL_GAP_M = 0.015
"""A calibrated flange farther than this from the nominal one is another robot's [m]: calibrations
of real arms move it by 1 to 5 mm, the numbers of another model by 64 mm and more."""
SPREAD = 96
"""Joint configurations that calibrated and nominal flange are compared at."""
JOINTS = 6
"""Number of joints of a UR."""
BASE_TILT = 1e-6
"""Most that the first joint's axis may differ from the base's z [rad, m]."""
LARGEST_BYTES = 1_000_000
"""A calibration has 2 kB; a larger file is something else."""


def _ur(name: str, a: tuple[float, float], d: tuple[float, float, float, float]) -> DhArm:
    return DhArm(
        name=name,
        a=np.array([0.0, a[0], a[1], 0.0, 0.0, 0.0]),
        d=np.array([d[0], 0.0, 0.0, d[1], d[2], d[3]]),
        alpha=np.array([1.0, 0.0, 0.0, 1.0, -1.0, 0.0]) * (np.pi / 2),
    )


OTHER_URS = (
    _ur("UR3", (-0.24365, -0.21325), (0.1519, 0.11235, 0.08535, 0.0819)),
    _ur("UR10", (-0.612, -0.5723), (0.1273, 0.163941, 0.1157, 0.0922)),
    _ur("UR16e", (-0.4784, -0.36), (0.1807, 0.17415, 0.11985, 0.11655)),
    _ur("UR20", (-0.8620, -0.7287), (0.2363, 0.2010, 0.1593, 0.1543)),
    _ur("UR30", (-0.6370, -0.5037), (0.2363, 0.2010, 0.1593, 0.1543)),
)
"""Nominal numbers of models that a file may have come from beside the arms that ship (Universal
Robots: DH parameters for calculations), to say which one it was."""


def ur_arms() -> dict[str, DhArm]:
    """Return the UR arms that ship and `OTHER_URS` by name."""
    return {arm.name: arm for arm in (*ur_chains().values(), *OTHER_URS)}


def read_controller_calibration(path: Path | str, chain: DhChain) -> DhChain:
    """Return the chain with the calibration of a file in its deltas.

    Args:
        path: `calibration.conf` of the controller, or the YAML of ROS's ur_calibration.
        chain: the nominal arm; deltas that it has are replaced.

    Raises:
        InputError: no such file, not a calibration, incomplete, or of another robot model. A
            `calibration.conf` cannot tell a UR5 from a UR5e (their arms' lengths are the same).
    """
    path = Path(path)
    text = checked_text(path, LARGEST_BYTES)
    if re.search(r"^\s*delta_(theta|a|d|alpha)\s*=", text, re.MULTILINE):
        lists = _controller_lists(path, text)
        return _checked(path, chain, lambda arm: _with_deltas(arm, lists))
    if re.search(r"^\s*shoulder\s*:", text, re.MULTILINE):
        links = _ros_links(path, text)
        return _checked(path, chain, lambda arm: _with_links(path, arm, links))
    raise InputError(
        f"{path} is no calibration of a UR arm: neither the lists delta_theta, delta_a, delta_d, "
        "delta_alpha of the controller's calibration.conf nor the transforms shoulder, upper_arm, "
        "... of a ROS kinematics file are in it. Copy .urcontrol/calibration.conf from the "
        "controller, or run ROS's ur_calibration."
    )


def flange_gap_m(arm: DhArm, other: DhArm) -> float:
    """Return the median distance between two arms' flanges over a spread of joints [m]."""
    q = np.random.default_rng(0).uniform(-np.pi, np.pi, (SPREAD, JOINTS))
    gap = arm.forward(q)[:, :3, 3] - other.forward(q)[:, :3, 3]
    return float(np.median(np.linalg.norm(gap, axis=-1)))


def dh_of_links(links: Array, near: DhArm) -> dict[str, Array]:
    """Return theta, a, d, alpha (6,) of an arm `links[0] Rz(q1) links[1] Rz(q2) ...`.

    Args:
        links: (6, 4, 4) the transform before each joint [m].
        near: the arm whose signs are taken where a common normal may point either way.

    Raises:
        InputError: the first axis is not the base's z, which DH numbers cannot express.
    """
    first = links[0]
    tilt = max(float(np.abs(first[:3, 2] - [0, 0, 1]).max()), float(np.abs(first[:2, 3]).max()))
    if tilt > BASE_TILT:
        raise InputError(
            f"the first joint's axis is off the base's z axis by {tilt:.3g} (rad or m); a UR "
            "calibration has it in the base's z. Was the base link's own transform mixed in?"
        )
    numbers = {name: np.zeros(JOINTS) for name in LISTS}
    psi, c = math.atan2(first[1, 0], first[0, 0]), float(first[2, 3])
    for i in range(JOINTS - 1):
        b, phi, a, alpha, psi_next, c_next = _screws(
            links[i + 1], float(near.a[i]), float(near.alpha[i]), float(near.d[i]) - c
        )
        numbers["theta"][i], numbers["d"][i] = phi + psi, b + c
        numbers["a"][i], numbers["alpha"][i] = a, alpha
        psi, c = psi_next, c_next
    numbers["theta"][-1], numbers["d"][-1] = psi, c
    return numbers


def _screws(T: Array, near_a: float, near_alpha: float, near_b: float) -> Screws:
    """Return the screws of a transform whose normal points as in the nominal arm."""
    normal, parallel = normals(T)

    def off(s: Screws) -> float:
        return abs(s.a - near_a) + abs(s.alpha - near_alpha)

    return min((screws(T, n, parallel, near_b) for n in (normal, -normal)), key=off)


def _with_deltas(arm: DhArm, lists: dict[str, Array]) -> DhArm:
    return replace(arm, **{f"delta_{name}": values for name, values in lists.items()})


def _with_links(path: Path, arm: DhArm, links: Array) -> DhArm:
    try:
        numbers = dh_of_links(links, arm)
    except InputError as error:
        raise InputError(f"{path}: {error}") from error
    deltas = {name: numbers[name] - getattr(arm, name) for name in LISTS}
    for name in ("theta", "alpha"):
        deltas[name] = np.pi - np.mod(np.pi - deltas[name], 2 * np.pi)
    return _with_deltas(arm, deltas)


def _checked(path: Path, chain: DhChain, calibrate: Callable[[DhArm], DhArm]) -> DhChain:
    """Return the calibrated chain, if its flange is where this model's is."""
    nominal = chain.nominal()
    calibrated = calibrate(nominal)
    gap = flange_gap_m(calibrated, nominal)
    if gap <= MODEL_GAP_M:
        return DhChain.of(calibrated, chain.limits)
    others = {name: flange_gap_m(calibrate(arm), arm) for name, arm in ur_arms().items()}
    others.pop(chain.name, None)
    best = min(others, key=lambda name: others[name])
    if others[best] <= MODEL_GAP_M:
        alike = [n for n, g in others.items() if g <= min(MODEL_GAP_M, 2 * others[best])]
        remedy = (
            f"On a {' or '.join(alike)} it moves the flange by {1e3 * others[best]:.1f} mm: the "
            f"file belongs to a {' or '.join(alike)}. Give that robot's model, or the file of "
            f"this {chain.name}."
        )
    else:
        remedy = (
            f"No other known model fits ({', '.join(ur_arms())}); numbers of the file were changed "
            "or lost. Copy it from the controller again."
        )
    raise InputError(
        f"{path} moves the flange of a {chain.name} by {1e3 * gap:.0f} mm; a calibration moves it "
        f"by 1 to 5 mm. {remedy}"
    )


def _controller_lists(path: Path, text: str) -> dict[str, Array]:
    """Return the four lists of a calibration.conf."""
    lists: dict[str, Array] = {}
    status = 2
    for number, raw in enumerate(text.splitlines(), 1):
        line = raw.split("#", 1)[0].strip()
        key, equals, value = (part.strip() for part in line.partition("="))
        if key == "calibration_status" and value.isdecimal():
            status = int(value)
        name = key.removeprefix("delta_")
        if not equals or name == key or name not in LISTS:
            continue
        if name in lists:
            raise InputError(f"{path}, line {number}: {key} stands there twice; one is needed.")
        found = [part.strip() for part in value.strip("[] ").split(",")]
        try:
            row = np.array([float(part) for part in found])
        except ValueError:
            row = np.full(1, np.nan)
        if row.shape != (JOINTS,) or not np.all(np.isfinite(row)):
            raise InputError(
                f"{path}, line {number}: {key} is {value[:80]!r}; {JOINTS} finite numbers in "
                "brackets are needed, one per joint."
            )
        lists[name] = row
    if missing := [f"delta_{name}" for name in LISTS if name not in lists]:
        raise InputError(
            f"{path} lacks {', '.join(missing)}; the section [mounting] of a whole "
            "calibration.conf has four lists. Without one of them the others are worth nothing: "
            "they cancel each other."
        )
    if status == 0:
        raise InputError(
            f"{path} says calibration_status = 0: this controller holds no calibration of its "
            "arm. Restore the arm's own file, or plan with the nominal arm (no calibration)."
        )
    return lists


def _ros_links(path: Path, text: str) -> Array:
    """Return the (6, 4, 4) transforms of a ROS kinematics file."""
    from ruamel.yaml import YAML
    from ruamel.yaml.error import YAMLError

    loader: Any = YAML(typ="safe", pure=True)
    try:
        tree: Any = loader.load(text)
    except (YAMLError, RecursionError, ValueError) as error:
        first = str(error).splitlines()[0]
        raise InputError(f"{path} is not YAML that can be read ({first}).") from error
    if isinstance(tree, dict) and "kinematics" in tree:
        tree = tree["kinematics"]
    links = np.tile(np.eye(4), (JOINTS, 1, 1))
    for i, link in enumerate(LINKS):
        part: Any = tree.get(link) if isinstance(tree, dict) else None
        try:
            x, y, z, roll, pitch, yaw = (float(part[name]) for name in PLACES)
        except (TypeError, KeyError, ValueError):
            raise InputError(
                f"{path}: '{link}' is {str(part)[:80]}; the numbers {', '.join(PLACES)} are needed "
                f"[m, rad] for each of {', '.join(LINKS)}."
            ) from None
        if not all(math.isfinite(v) for v in (x, y, z, roll, pitch, yaw)):
            raise InputError(f"{path}: '{link}' holds numbers that are not finite.")
        turns = ([0.0, 0.0, yaw], [0.0, pitch, 0.0], [roll, 0.0, 0.0])
        R = se3.exp_so3(turns[0]) @ se3.exp_so3(turns[1]) @ se3.exp_so3(turns[2])
        links[i] = se3.from_rt(R, [x, y, z])
    return links
