"""Arms as data: what a folder's `robot.toml` says of one, and everything that follows from it.

The kinematics are Denavit-Hartenberg numbers, written there or taken from a URDF; so are the shapes
of the links. Planning, capture, the School, replays, exports and pictures read the same `RobotArm`.
"""

from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import cache
from typing import Literal

import numpy as np

from realsim.arrays import Array
from realsim.errors import InputError, RealsimError
from realsim.geometry import se3
from realsim.geometry.dh import DhArm
from realsim.robots.kinematics import DhChain, dh_of_chain
from realsim.robots.limits import JointLimits
from realsim.robots.mjcf import read_mjcf_chain
from realsim.robots.robot_files import FILE, RobotFile, RobotFolder, names_of, robot_file, same_name
from realsim.robots.shapes import Block, Rod, Shape, block_shape, link_shape, rod_shape
from realsim.robots.urdf import UrdfChain, UrdfShape, read_chain
from realsim.untrusted.own_json import OwnFile

Row = tuple[float, ...]
WRIST_JOINTS = 3
"""The last joints of most arms are the wrist."""
DH_GAP_M = 1e-4
"""Numbers in DH and a URDF's own chain may differ by this [m]; right angles are made right ones."""
CONTINUOUS_RAD = 2 * np.pi
"""A joint that a file lets turn for ever turns one turn each way: what is carried has a cable."""
DEGREES_RAD = 4 * np.pi
"""A joint that turns farther than two turns each way has its limits in degrees."""


class LimitsTable(OwnFile, frozen=True, kw_only=True):
    """[limits] of `robot.toml`; what a URDF gives may be left out."""

    lower_rad: Row = ()
    upper_rad: Row = ()
    speed_rad_s: Row = ()
    acceleration_rad_s2: Row
    torque_nm: Row = ()
    source: str = ""


class DhTable(OwnFile, frozen=True, kw_only=True):
    """[dh] of `robot.toml`: standard Denavit-Hartenberg numbers."""

    a_m: Row
    d_m: Row
    alpha_rad: Row
    theta_rad: Row = ()


class UrdfTable(OwnFile, frozen=True, kw_only=True):
    """[urdf] or [mjcf] of `robot.toml`."""

    file: str
    base: str
    flange: str
    flange_out_m: float = 0.0
    """How far the flange's face lies out along z of that link's frame [m]."""


class ArmFile(RobotFile, frozen=True, kw_only=True):
    """`robot.toml` of an arm."""

    kind: Literal["arm"] = "arm"
    limits: LimitsTable
    home_rad: Row
    payload_kg: float
    wrist_joints: tuple[int, ...] = ()
    """Numbers of the wrist's joints, counted from 1; the first swings the hand. None = the last
    three."""
    dh: DhTable | None = None
    urdf: UrdfTable | None = None
    mjcf: UrdfTable | None = None
    links: tuple[str, ...] = ()
    """What messages call the base and the moving links."""
    joint_names: tuple[str, ...] = ()
    """What recordings and exports call the joints; else the URDF's names, or joint1, joint2 ..."""
    rods: tuple[Rod, ...] = ()
    """The links' bodies in DH frames: round ones."""
    blocks: tuple[Block, ...] = ()
    """The links' bodies that are boxes."""
    kept_apart: tuple[tuple[int, int], ...] = ()
    """Links, numbered from the base (0), that can never meet beside the neighbours."""
    mass_kg: float = 0.0


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class RobotArm:
    """An arm."""

    folder: RobotFolder
    title: str
    chain: DhChain
    """Kinematics both ways, and the joints' limits."""
    home: Array
    """(n,) where it waits [rad]."""
    torque: Array
    """(n,) greatest torques [N m]; NaN = not known."""
    payload_kg: float
    wrist: tuple[int, ...]
    """Numbers of the wrist's joints, counted from 0; the first swings the hand in the School."""
    link_names: tuple[str, ...]
    """(n + 1) the base and the links."""
    shapes_of: Callable[[], tuple[Shape, ...]]
    """Makes `shapes`; meshes are read when they are asked for."""
    looks: tuple[tuple[int, UrdfShape], ...]
    """Visual meshes of a URDF: link, and the shape with its pose in that link's DH frame."""
    kept_apart: frozenset[tuple[int, int]]
    joint_names: tuple[str, ...]
    urdf_mass_kg: float
    """Mass of the URDF's base and links; 0 = not known."""

    @property
    def name(self) -> str:
        """As people write it: 'UR5e'."""
        return self.chain.name

    @property
    def shapes(self) -> tuple[Shape, ...]:
        """Convex bodies of the links, in the frames of the nominal chain."""
        return self.shapes_of()

    @property
    def reach_m(self) -> float:
        """How far the flange gets from the base's origin, over random joints [m]."""
        limits = self.chain.limits
        q = np.random.default_rng(0).uniform(limits.lower, limits.upper, (4000, self.joints))
        return float(np.linalg.norm(self.chain.forward(q)[:, :3, 3], axis=1).max())

    @property
    def joints(self) -> int:
        """How many joints it has."""
        return self.chain.joints


_found: dict[str, tuple[str, RobotArm]] = {}
"""Arms by name, with the digest they were read at: one that was given by its folder is then found
by its name as well."""


def find_arm(name: str) -> RobotArm:
    """Return an arm.

    Args:
        name: of one that ships or lies in a folder of `REALSIM_ROBOTS`, or its folder.

    Raises:
        InputError: there is none, or its files do not make an arm; the message says what is wrong.
        MissingLibraryError: its URDF belongs to a package that is not installed.
    """
    for key, (_, arm) in _found.items():
        if same_name(key, name):
            return arm
    file, folder = robot_file(name, ArmFile)
    arm = _arm_of(file, folder)
    for key in {file.name, folder.name}:
        _found[key] = (folder.digest, arm)
    return arm


def known_chains(joints: int | None = None) -> dict[str, DhChain]:
    """Return the chains of all arms that are found by name, with so many joints, by `name`.

    One of the user's that cannot be used is left out: it is told where it is asked for.
    """
    found: list[DhChain] = []
    for name in names_of("arm"):
        with suppress(RealsimError):
            found.append(find_arm(name).chain)
    return {c.name: c for c in found if joints in (None, c.joints)}


def ur_chains() -> dict[str, DhChain]:
    """Return the chains of Universal Robots' arms that are found by name, by `name`."""
    return {name: chain for name, chain in known_chains(6).items() if name.startswith("UR")}


def arm_of(chain: DhChain) -> RobotArm:
    """Return the arm of a chain's name, with the chain in it.

    Raises:
        InputError: there is none, or the chain's nominal numbers are not that arm's.
    """
    arm = find_arm(chain.name)
    for name in ("a", "d", "alpha", "theta", "T_base_0", "T_n_ee"):
        drawn, given = getattr(arm.chain, name), getattr(chain, name)
        if drawn.shape != given.shape or not np.allclose(drawn, given):
            raise InputError(
                f"the chain is called '{chain.name}' but its nominal {name} is {given.tolist()}, "
                f"not {drawn.tolist()}. Give a calibration as delta_{name}, and another arm under "
                "its own name."
            )
    return replace(arm, chain=chain)


def _arm_of(file: ArmFile, folder: RobotFolder) -> RobotArm:
    where = folder.path / FILE
    ways = [f"[{name}]" for name in ("dh", "urdf", "mjcf") if getattr(file, name) is not None]
    if len(ways) != 1:
        raise InputError(
            f"{where} has {' and '.join(ways) or 'no kinematics'}; exactly one of [dh], [urdf] and "
            "[mjcf] is needed."
        )
    urdf, table = None, file.urdf or file.mjcf
    if table is not None:
        read = read_mjcf_chain if file.urdf is None else read_chain
        urdf = read(folder, table.file, table.base, table.flange)
        arm = _dh_of_urdf(file.name, table, urdf)
    else:
        assert file.dh is not None  # one of them is there
        alpha, a, d = file.dh.alpha_rad, file.dh.a_m, file.dh.d_m
        arm = DhArm(
            name=file.name, a=np.array(a), d=np.array(d), alpha=np.array(alpha),
            theta=np.array(file.dh.theta_rad),
        )  # fmt: skip
    limits, torque = _limits(file, urdf, arm.joints, str(where))
    chain = DhChain.of(arm, limits)
    home = np.array(file.home_rad, dtype=np.float64)
    if home.shape != (arm.joints,) or not limits.contains(home):
        raise InputError(
            f"{where}: home_rad is {home.tolist()}; {arm.joints} angles within the limits are "
            f"needed [rad]: {limits.lower.round(4).tolist()} to {limits.upper.round(4).tolist()}."
        )
    if not 0.0 < file.payload_kg < np.inf:
        raise InputError(f"{where}: payload_kg is {file.payload_kg}; kilograms above 0 are needed.")
    wrist = tuple(i - 1 for i in file.wrist_joints) or tuple(range(arm.joints))[-WRIST_JOINTS:]
    if not all(0 <= i < arm.joints for i in wrist):
        raise InputError(
            f"{where}: wrist_joints is {file.wrist_joints}; numbers of joints from 1 to "
            f"{arm.joints} are needed."
        )
    names = file.links or tuple(["base", *(f"link {i + 1}" for i in range(arm.joints))])
    if len(names) != arm.joints + 1:
        raise InputError(
            f"{where}: links names {len(names)} links; the base and {arm.joints} links are "
            f"{arm.joints + 1}."
        )
    return RobotArm(
        folder=folder,
        title=file.title or file.name,
        chain=chain,
        home=home,
        torque=torque,
        payload_kg=file.payload_kg,
        wrist=wrist,
        link_names=names,
        shapes_of=cache(lambda: _shapes(file, urdf, arm, names)),
        looks=_looks(urdf, arm),
        kept_apart=frozenset(file.kept_apart),
        joint_names=_joint_names(file, urdf, arm.joints, str(where)),
        urdf_mass_kg=urdf.mass_kg if urdf else 0.0,
    )


def _dh_of_urdf(name: str, table: UrdfTable, urdf: UrdfChain) -> DhArm:
    steps = np.array(urdf.steps)
    steps[-1] = steps[-1] @ se3.from_translation([0.0, 0.0, table.flange_out_m])
    arm = dh_of_chain(name, steps)
    q = np.random.default_rng(0).uniform(-np.pi, np.pi, (32, arm.joints))
    gap = np.linalg.norm(arm.forward(q)[:, :3, 3] - _forward(steps, q)[:, :3, 3], axis=1).max()
    if gap > DH_GAP_M:
        raise InputError(
            f"{table.file}: the flange of the file's chain and of its Denavit-Hartenberg "
            f"numbers are {1e3 * gap:.2f} mm apart: axes that are nearly parallel or nearly at "
            "right angles, as of a calibrated arm. Give the nominal file, and the calibration "
            "apart."
        )
    return arm


def _forward(steps: Array, q: Array) -> Array:
    T = np.broadcast_to(steps[0], (len(q), 4, 4))
    for i in range(q.shape[1]):
        turn = np.zeros((len(q), 3))
        turn[:, 2] = q[:, i]
        T = T @ se3.from_rt(se3.exp_so3(turn), np.zeros((len(q), 3))) @ steps[i + 1]
    return T


def _joint_names(file: ArmFile, urdf: UrdfChain | None, joints: int, where: str) -> tuple[str, ...]:
    names = file.joint_names or (urdf.joint_names if urdf else ())
    names = names or tuple(f"joint{i + 1}" for i in range(joints))
    if len(set(names)) != joints:
        raise InputError(f"{where}: joint_names is {names}; {joints} different names are needed.")
    return names


def _limits(
    file: ArmFile, urdf: UrdfChain | None, joints: int, where: str
) -> tuple[JointLimits, Array]:
    """Return the joints' limits and torques: the toml's, or else the URDF's."""
    given = file.limits
    rows: dict[str, Array] = {}
    for key, own, other in (
        ("lower_rad", given.lower_rad, urdf.lower if urdf else None),
        ("upper_rad", given.upper_rad, urdf.upper if urdf else None),
        ("speed_rad_s", given.speed_rad_s, urdf.speed if urdf else None),
        ("acceleration_rad_s2", given.acceleration_rad_s2, None),
    ):
        row = np.array(own, dtype=np.float64) if own else other
        if row is not None and not own and key in ("lower_rad", "upper_rad"):
            row = np.clip(row, -CONTINUOUS_RAD, CONTINUOUS_RAD)
        if row is None or row.shape != (joints,) or not np.all(np.isfinite(row)):
            raise InputError(
                f"{where}: [limits] {key} is {None if row is None else row.tolist()}; one finite "
                f"number for each of the {joints} joints is needed."
            )
        rows[key] = row
    if max(np.abs(rows["lower_rad"]).max(), np.abs(rows["upper_rad"]).max()) > DEGREES_RAD:
        raise InputError(
            f"{where}: [limits] reach from {rows['lower_rad'].min():g} to "
            f"{rows['upper_rad'].max():g} rad. Are these degrees? Radians are needed."
        )
    torque = np.array(given.torque_nm) if given.torque_nm else urdf.torque if urdf else np.zeros(0)
    torque = torque if torque.shape == (joints,) else np.full(joints, np.nan)
    try:
        limits = JointLimits(
            lower=rows["lower_rad"],
            upper=rows["upper_rad"],
            speed=rows["speed_rad_s"],
            acceleration=rows["acceleration_rad_s2"],
        )
    except InputError as error:
        told = "; ".join(f"{key} {row.tolist()}" for key, row in rows.items())
        raise InputError(f"{where}: {error} Found: {told}.") from error
    return limits, torque


def _shapes(
    file: ArmFile, urdf: UrdfChain | None, arm: DhArm, names: tuple[str, ...]
) -> tuple[Shape, ...]:
    if file.rods or file.blocks or urdf is None:
        return (*(rod_shape(rod) for rod in file.rods), *(block_shape(b) for b in file.blocks))
    T_frame_joint = _joints_in_frames(urdf, arm)
    return tuple(
        link_shape(shape, names[link], link, T_frame_joint[link])
        for link, shapes in enumerate(urdf.collision)
        for shape in (shapes or urdf.visual[link])
    )


def _looks(urdf: UrdfChain | None, arm: DhArm) -> tuple[tuple[int, UrdfShape], ...]:
    if urdf is None:
        return ()
    T_frame_joint = _joints_in_frames(urdf, arm)
    return tuple(
        (link, shape._replace(T_link_shape=T_frame_joint[link] @ shape.T_link_shape))
        for link, shapes in enumerate(urdf.visual)
        for shape in shapes
    )


def _joints_in_frames(urdf: UrdfChain, arm: DhArm) -> Array:
    """Return (n + 1, 4, 4): the joint frames of a URDF's links in the links' DH frames [m]."""
    zero = arm.link_frames(np.zeros(arm.joints))
    found = np.tile(np.eye(4), (arm.joints + 1, 1, 1))
    T = np.eye(4)
    for i in range(arm.joints):
        T = T @ urdf.steps[i]
        found[i + 1] = se3.invert(zero[i + 1]) @ T
    return found


def __getattr__(name: str) -> DhChain:
    """Return the chain of an arm that scripts name most often: `UR5`, `UR5E`, `PANDA`."""
    known = {"UR5": "ur5", "UR5E": "ur5e", "PANDA": "panda"}
    if name in known:
        return find_arm(known[name]).chain
    raise AttributeError(f"module {__name__} has no attribute {name}")
