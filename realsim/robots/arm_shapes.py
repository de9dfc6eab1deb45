"""The arms' own bodies: cylinders, capsules and boxes fixed in the frames of the nominal links.

UR5 (CB3). Every joint is a round housing about its axis: 120 mm across in the shoulder and the
elbow, 75 mm in the wrists; the tubes are 101 mm and 75 mm across, the foot 149 mm (Universal
Robots: UR5 technical drawing and user manual). Upper arm and forearm stand 135.85 mm and 16.15 mm
along the shoulder's axis (ur_description: shoulder_offset, elbow_offset). Each number is rounded
up by 0.2 to 2 mm, and a test proves that the published collision meshes lie inside the shapes.

UR5e. No meshes stand behind these shapes: they come from the published DH numbers, offsets
(138 mm, 7 mm) and radii (ur_description's physical parameters: shoulder and elbow 60 mm, upper arm
54 mm, forearm 40 mm; published capsule models: wrists 40 mm), rounded up by 3 mm or more, and from
the UR5's proportions along the axes: drawn, not proven.

`link_placements` says where the links are on a chain with its controller's calibration. Two joint
axes that are parallel but for a milliradian have their common normal tens of metres away, and the
calibrated DH frames 2 and 3 sit there, turned by as much as they like, while the links themselves
are where they always were. So the links are placed from the nominal chain: link i's nominal frame
is moved rigidly with the calibrated frame i, from where both agree best.
"""

from typing import Literal

import numpy as np
from numpy.typing import NDArray

from realsim.errors import InputError
from realsim.geometry import se3
from realsim.robots.kinematics import CHAINS, JOINTS, DhChain
from realsim.robots.shapes import Box, Shape

Array = NDArray[np.float64]
Axis = Literal["x", "y", "z"]
Rod = tuple[
    str, int, Literal["cylinder", "capsule"], Axis, float, float, float, tuple[float, float]
]
"""Part, DH frame, kind, axis, from and to along the axis, radius, the two other coordinates in
the order of the axes [mm]."""
Block = tuple[str, int, tuple[float, float, float], tuple[float, float, float]]
"""Part, DH frame, least and greatest corner [mm]."""
LINK_NAMES = ("base", "shoulder", "upper arm", "forearm", "wrist 1", "wrist 2", "wrist 3")
"""Parts by the DH frame that they move with."""
PLACEMENT_SAMPLES = 64
"""Joint vectors over which nominal and calibrated link frames are brought together."""
CALIBRATION_LIMIT_M = 0.020
"""A controller's calibration moves a link by 1-5 mm; another arm's calibration by 100 mm."""

UR5_RODS: tuple[Rod, ...] = (
    ("base", 0, "cylinder", "z", -3.2, 15.4, 74.5, (0.0, 0.0)),
    ("base", 0, "cylinder", "z", 10.0, 30.0, 60.2, (0.0, 0.0)),
    ("shoulder", 1, "cylinder", "y", -65.5, 69.0, 60.2, (0.0, 0.0)),
    ("shoulder", 1, "cylinder", "z", 0.0, 70.8, 60.2, (0.0, 0.0)),
    ("upper arm", 2, "cylinder", "z", 70.5, 204.8, 60.2, (425.0, 0.0)),
    ("upper arm", 2, "cylinder", "x", 335.0, 420.0, 60.5, (0.0, 135.85)),
    ("upper arm", 2, "capsule", "x", 50.0, 370.0, 51.5, (0.0, 135.85)),
    ("upper arm", 2, "cylinder", "x", 5.0, 85.0, 60.5, (0.0, 135.85)),
    ("upper arm", 2, "cylinder", "z", 70.5, 204.8, 60.2, (0.0, 0.0)),
    ("forearm", 3, "cylinder", "z", -24.5, 70.9, 60.0, (392.25, 0.0)),
    ("forearm", 3, "cylinder", "x", 306.0, 380.0, 46.2, (0.0, 16.15)),
    ("forearm", 3, "capsule", "x", 10.0, 330.0, 38.4, (0.0, 16.15)),
    ("forearm", 3, "cylinder", "z", -41.2, 63.8, 39.5, (0.0, 0.0)),
    ("wrist 1", 4, "cylinder", "y", -45.7, 39.7, 39.5, (0.0, 0.0)),
    ("wrist 1", 4, "cylinder", "z", -57.4, 47.7, 39.5, (0.0, 0.0)),
    ("wrist 2", 5, "cylinder", "y", -39.7, 45.7, 39.5, (0.0, 0.0)),
    ("wrist 2", 5, "cylinder", "z", -57.4, 47.7, 39.5, (0.0, 0.0)),
    ("wrist 3", 6, "cylinder", "z", -35.2, 0.0, 38.0, (0.0, 0.0)),
)
UR5_BLOCKS: tuple[Block, ...] = (
    ("base", 0, (-7.0, 60.0, -0.5), (7.0, 110.5, 12.5)),  # the cable
    ("wrist 3", 6, (-18.5, -43.3, -24.5), (18.5, -30.0, -14.0)),  # the tool plug
)
UR5E_RODS: tuple[Rod, ...] = (
    ("base", 0, "cylinder", "z", -3.2, 45.0, 78.0, (0.0, 0.0)),
    ("base", 0, "cylinder", "z", 30.0, 102.0, 65.0, (0.0, 0.0)),
    ("shoulder", 1, "cylinder", "y", -66.0, 73.0, 64.0, (0.0, 0.0)),
    ("shoulder", 1, "cylinder", "z", 0.0, 74.0, 64.0, (0.0, 0.0)),
    ("upper arm", 2, "cylinder", "z", 66.0, 212.0, 64.0, (425.0, 0.0)),
    ("upper arm", 2, "capsule", "x", 15.0, 410.0, 60.0, (0.0, 138.0)),
    ("upper arm", 2, "cylinder", "z", 66.0, 212.0, 64.0, (0.0, 0.0)),
    ("forearm", 3, "cylinder", "z", -40.0, 74.0, 64.0, (392.2, 0.0)),
    ("forearm", 3, "capsule", "x", 0.0, 380.0, 44.0, (0.0, 7.0)),
    ("forearm", 3, "cylinder", "z", -56.0, 70.0, 43.0, (0.0, 0.0)),
    ("wrist 1", 4, "cylinder", "y", -68.0, 48.0, 43.0, (0.0, 0.0)),
    ("wrist 1", 4, "cylinder", "z", -64.0, 52.0, 43.0, (0.0, 0.0)),
    ("wrist 2", 5, "cylinder", "y", -48.0, 52.0, 43.0, (0.0, 0.0)),
    ("wrist 2", 5, "cylinder", "z", -64.0, 56.0, 43.0, (0.0, 0.0)),
    ("wrist 3", 6, "cylinder", "z", -54.0, 0.0, 43.0, (0.0, 0.0)),
)
UR5E_BLOCKS: tuple[Block, ...] = (
    ("base", 0, (-35.0, 55.0, -0.5), (35.0, 118.0, 40.0)),  # the cable's socket
)
ARM_BODIES = {"UR5": (UR5_RODS, UR5_BLOCKS), "UR5e": (UR5E_RODS, UR5E_BLOCKS)}


def arm_shapes(chain: DhChain) -> tuple[Shape, ...]:
    """Return the arm's bodies, in the frames of its nominal links.

    Raises:
        InputError: there are no shapes for this arm.
    """
    if chain.name not in ARM_BODIES:
        raise InputError(
            f"no collision shapes for the arm '{chain.name}'; there are shapes for "
            f"{', '.join(ARM_BODIES)}."
        )
    rods, blocks = ARM_BODIES[chain.name]
    return (*map(_rod, rods), *map(_block, blocks))


def _rod(rod: Rod) -> Shape:
    part, frame, kind, axis, start, end, radius, across = rod
    k = "xyz".index(axis)
    center = np.insert(np.array(across, dtype=np.float64), k, (start + end) / 2)
    axes = np.roll(np.eye(3), k + 1, axis=0)  # its third column is the rod's axis
    return Shape(
        part=part,
        frame=frame,
        kind=kind,
        size_m=(radius / 1e3, (end - start) / 1e3),
        T_frame_shape=se3.from_rt(axes, center / 1e3),
    )


def _block(block: Block) -> Shape:
    part, frame, low, high = block
    lower, upper = np.array(low) / 1e3, np.array(high) / 1e3
    x, y, z = (upper - lower).tolist()
    return Shape(
        part=part,
        frame=frame,
        kind="box",
        size_m=(x, y, z),
        T_frame_shape=se3.from_translation((lower + upper) / 2),
    )


def link_placements(chain: DhChain) -> Array:
    """Return (7, 4, 4): where link i's nominal frame is in the calibrated DH frame i [m].

    The identity for base and flange: what is fixed to the flange is placed by the calibrated
    chain exactly. In between the mean of `C_i(q)^-1 N_i(q)` over joint vectors q, which is the
    same for all q but for the calibration's millimetres.

    Raises:
        InputError: the arm's numbers are not those that its shapes were drawn for, or the
            calibration moves a link farther than any calibration does.
    """
    nominal = chain.nominal()
    drawn = CHAINS.get(chain.name)
    for name in ("a", "d", "alpha", "theta"):
        if drawn is not None and not np.allclose(getattr(drawn, name), getattr(nominal, name)):
            raise InputError(
                f"the chain is called '{chain.name}' but its nominal {name} is "
                f"{getattr(nominal, name).tolist()}, not {getattr(drawn, name).tolist()}. Give a "
                f"calibration as delta_{name}, and another arm under its own name."
            )
    placements = np.tile(np.eye(4), (JOINTS + 1, 1, 1))
    if np.array_equal(chain.link_frames(np.ones(JOINTS)), nominal.link_frames(np.ones(JOINTS))):
        return placements
    q = np.random.default_rng(0).uniform(-np.pi, np.pi, (PLACEMENT_SAMPLES, JOINTS))
    is_at, should = chain.link_frames(q), nominal.link_frames(q)
    for i in range(1, JOINTS + 1):
        between = se3.invert(is_at[:, i]) @ should[:, i]
        if i < JOINTS:
            R = se3.mean_rotation(between[:, :3, :3])
            # The rotations' scatter swings the far-away origin; the mean keeps what is common.
            at = np.mean(is_at[:, i, :3, :3].swapaxes(-1, -2) @ _offset(should, is_at, i), axis=0)
            placements[i] = se3.from_rt(R, at[:, 0])
        moved = is_at[:, i] @ placements[i]
        shift = float(np.linalg.norm(moved[:, :3, 3] - should[:, i, :3, 3], axis=-1).max())
        if shift > CALIBRATION_LIMIT_M:
            raise InputError(
                f"the calibration moves the {LINK_NAMES[i]} of a nominal {chain.name} by up to "
                f"{shift * 1e3:.0f} mm; an arm's own calibration moves it by 1 to 5 mm. Is the "
                "calibration file another arm's, or the model another?"
            )
    return placements


def _offset(should: Array, is_at: Array, i: int) -> Array:
    return (should[:, i, :3, 3] - is_at[:, i, :3, 3])[..., None]


def finite_box(name: str, box: Box, reach_m: float) -> Shape:
    """Return a box as a shape in base; bounds beyond `reach_m` end there [m]."""
    lower, upper = np.clip(box.lower, -reach_m, reach_m), np.clip(box.upper, -reach_m, reach_m)
    if np.any(upper <= lower):
        raise InputError(
            f"'{name}' from {box.lower} to {box.upper} m lies beyond {reach_m} m of the arm's "
            "base. Boxes are in metres in the controller's base; were millimetres given?"
        )
    x, y, z = (upper - lower).tolist()
    return Shape(
        part=name,
        frame=0,
        kind="box",
        size_m=(x, y, z),
        T_frame_shape=se3.from_translation((lower + upper) / 2),
    )
