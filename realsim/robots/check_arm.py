"""What can be proven of an arm's description without the arm."""

from dataclasses import dataclass

import numpy as np

from realsim.arrays import Array
from realsim.geometry import se3
from realsim.interop import import_pinocchio
from realsim.robots.arm import ArmFile, RobotArm, find_arm
from realsim.robots.coal_geometry import Body, Geometry
from realsim.robots.inverse import NO_CLOSED_FORM, held_joint
from realsim.robots.robot_files import robot_file

SAMPLES = 400
"""Random joints at which the chains are compared and the inverse is asked."""
SAME_M, SAME_RAD = 2e-5, 2e-5
"""Two readings of one chain agree to this: files write right angles with five digits."""
FOUND_SHARE = 0.995
SLOW_RAD_S, FAST_RAD_S = 0.2, 15.0
"""Speeds of arms' joints lie between these [rad/s]; degrees and turns per minute do not."""
SOFT_RAD_S2, HARD_RAD_S2 = 0.5, 60.0
MASS_GAP = 0.25
"""Share by which the URDF's masses may differ from the data sheet's."""
NEAREST_M, FARTHEST_M = 0.2, 4.0
"""Arms reach as far as this [m]; others are in another unit."""


@dataclass(frozen=True, kw_only=True, slots=True)
class Finding:
    """One thing that was looked at."""

    what: str
    found: str
    is_right: bool = True
    advice: str = ""
    """What to do about it."""


def check_arm(name: str) -> tuple[RobotArm, list[Finding]]:
    """Return an arm and what was found of it.

    Args:
        name: of a robot, or its folder.

    Raises:
        InputError: its files do not make an arm.
        MissingLibraryError: a package that it names is not installed.
    """
    arm = find_arm(name)
    file, _ = robot_file(str(arm.folder.path), ArmFile)
    rng = np.random.default_rng(0)
    limits = arm.chain.limits
    low, high = np.maximum(limits.lower, -np.pi), np.minimum(limits.upper, np.pi)
    q = rng.uniform(low, high, (SAMPLES, arm.joints))
    return arm, [
        *_frames(arm, file, q),
        _reach(arm),
        *_speeds(arm),
        *_bodies(arm, q),
        _inverse(arm, q),
        *_mass(arm, file),
    ]


def _frames(arm: RobotArm, file: ArmFile, q: Array) -> list[Finding]:
    """Compare the chain with pinocchio's own reading of the URDF."""
    if file.urdf is None:
        return []
    pin = import_pinocchio()

    path = arm.folder.file(file.urdf.file, "the URDF")
    # pinocchio complains of what it does not need (materials, transmissions) on stderr.
    model = pin.buildModelFromUrdf(str(path))
    data = model.createData()
    base, flange = (model.getFrameId(n) for n in (file.urdf.base, file.urdf.flange))
    columns = [model.joints[model.getJointId(n)].idx_q for n in arm.joint_names]
    sizes = [model.joints[model.getJointId(n)].nq for n in arm.joint_names]
    Ts: list[Array] = []
    for row in q:
        full = pin.neutral(model)
        for at, size, angle in zip(columns, sizes, row, strict=True):
            full[at : at + size] = angle if size == 1 else (np.cos(angle), np.sin(angle))
        pin.framesForwardKinematics(model, data, full)
        Ts.append((data.oMf[base].inverse() * data.oMf[flange]).homogeneous)
    out = se3.from_translation([0.0, 0.0, file.urdf.flange_out_m])
    apart = se3.log(se3.invert(np.stack(Ts) @ out) @ arm.chain.forward(q))
    turn, shift = (float(np.linalg.norm(apart[:, s], axis=1).max()) for s in (np.s_[:3], np.s_[3:]))
    return [
        Finding(
            what="flange: our chain and pinocchio's of the URDF",
            found=f"{1e3 * shift:.4f} mm, {np.degrees(turn):.5f} deg apart at the worst",
            is_right=shift < SAME_M and turn < SAME_RAD,
            advice="Right angles in the URDF need seven digits: 1.5707963.",
        )
    ]


def _reach(arm: RobotArm) -> Finding:
    reach = arm.reach_m
    return Finding(
        what="reach of the flange",
        found=f"{reach:.2f} m from the base",
        is_right=NEAREST_M < reach < FARTHEST_M,
        advice=f"{NEAREST_M:g} to {FARTHEST_M:g} m are expected. Are lengths in millimetres?",
    )


def _speeds(arm: RobotArm) -> list[Finding]:
    limits, found = arm.chain.limits, list[Finding]()
    for what, row, low, high, unit in (
        ("joint speeds", limits.speed, SLOW_RAD_S, FAST_RAD_S, "rad/s"),
        ("joint accelerations", limits.acceleration, SOFT_RAD_S2, HARD_RAD_S2, "rad/s^2"),
    ):
        found.append(
            Finding(
                what=what,
                found=f"{row.min():.3g} to {row.max():.3g} {unit}",
                is_right=bool(low <= row.min() and row.max() <= high),
                advice=f"{low:g} to {high:g} {unit} are expected. Are these degrees?",
            )
        )
    return found


def _bodies(arm: RobotArm, q: Array) -> list[Finding]:
    """Look at the shapes: whether every link has one, and whether the arm is free at home."""
    bare = [name for i, name in enumerate(arm.link_names) if i not in {s.frame for s in arm.shapes}]
    found = [
        Finding(
            what="bodies of the links",
            found=f"{len(arm.shapes)} shapes" + (f"; none of {', '.join(bare)}" if bare else ""),
            is_right=not bare,
            advice="Give the link a <collision> in the URDF, or a rod or block in robot.toml: "
            "what has no body is never kept away from anything.",
        )
    ]
    bodies = tuple(Body(shape, "link") for shape in arm.shapes)
    pairs = [
        (i, j)
        for i, a in enumerate(bodies)
        for j, b in enumerate(bodies[i + 1 :], i + 1)
        if abs(a.frame - b.frame) > 1
        and (min(a.frame, b.frame), max(a.frame, b.frame)) not in arm.kept_apart
    ]
    if not pairs:
        return found
    still = np.tile(np.eye(4), (arm.joints + 1, 1, 1))
    distances = Geometry(arm.chain, still, bodies).with_pairs(pairs)
    at_home = distances(arm.home[None])[0]
    k = int(np.argmin(at_home))
    names = " and ".join(bodies[x].part for x in pairs[k])
    found.append(
        Finding(
            what="self-collision at home",
            found=f"nearest: {names}, {1e3 * at_home[k]:.1f} mm",
            is_right=bool(at_home[k] > 0),
            advice="Correct home_rad or the shapes. Links whose bodies meet by design in every "
            f"pose belong into kept_apart: [{bodies[pairs[k][0]].frame}, "
            f"{bodies[pairs[k][1]].frame}].",
        )
    )
    deepest = distances(q).max(axis=0)
    always = [pairs[k] for k in np.nonzero(deepest <= 0)[0]]
    if always:
        names = "; ".join(" and ".join(bodies[x].part for x in pair) for pair in always[:4])
        found.append(
            Finding(
                what="bodies that meet in every pose",
                found=names,
                is_right=False,
                advice="They are too fat for one another, or belong into kept_apart.",
            )
        )
    return found


def _inverse(arm: RobotArm, q: Array) -> Finding:
    held = held_joint(arm.chain)
    way = (
        "in closed form"
        if held is None
        else "from a table of Newton seeds"
        if held == NO_CLOSED_FORM
        else f"in closed form with joint {held + 1} held"
    )
    Ts = arm.chain.forward(q)
    solutions, of = arm.chain.inverse_branches(Ts)
    share = len(np.unique(of)) / len(Ts)
    return Finding(
        what="inverse kinematics",
        found=f"{way}; {100 * share:.1f} % of {len(Ts)} reachable poses, "
        f"{len(solutions) / len(Ts):.1f} branches each",
        is_right=share >= FOUND_SHARE,
        advice=f"{100 * FOUND_SHARE:g} % are expected; limits that leave little room?",
    )


def _mass(arm: RobotArm, file: ArmFile) -> list[Finding]:
    found = [
        Finding(
            what="payload",
            found=f"{arm.payload_kg:g} kg",
            is_right=0.0 < arm.payload_kg <= 100.0,
            advice="Kilograms of the data sheet are needed.",
        )
    ]
    given = arm.urdf_mass_kg
    if given > 0 and file.mass_kg > 0:
        found.append(
            Finding(
                what="mass",
                found=f"{given:.1f} kg in the URDF, {file.mass_kg:g} kg in robot.toml",
                is_right=abs(given / file.mass_kg - 1.0) <= MASS_GAP,
                advice="The School's loads come from the object; a wrong mass of the arm only "
                "matters to programs that read the URDF. Correct one of them.",
            )
        )
    return found
