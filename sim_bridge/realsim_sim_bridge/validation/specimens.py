"""The suite's objects, made of a few points each, and grasps of them on the edge of holding."""

from functools import lru_cache
from itertools import product

import numpy as np

from realsim.arrays import Array
from realsim.errors import InputError
from realsim.geometry import se3
from realsim.geometry.mesh import Mesh, mass_properties
from realsim.robots.arm import find_arm
from realsim.robots.hand import Hand, find_hand
from realsim_sim_bridge.arm.grasping_arm import GraspingArm
from realsim_sim_bridge.slip.slip_test import SlipTrial
from realsim_sim_bridge.slip.world import SlipBody

SIDE_M = 0.05
"""Side of the cube."""
OPENING_M = SIDE_M + 0.008
"""Opening of the hand before it closes on the cube."""
DOWN = np.diag([1.0, -1.0, -1.0])
"""Rotation of a grasp from above."""
READY = np.array([0.0, -np.pi / 4, 0.0, -3 * np.pi / 4, 0.0, np.pi / 2, np.pi / 4])
"""Franka's ready pose (7,) [rad]: its joint 5 swings in the suite."""
CLEARANCE_M = 0.003
"""Between object and palm, and between object and open fingers [m]."""
MOST_DRAWS = 20_000
"""Places tried for one grasp of a shape."""


@lru_cache(maxsize=1)
def panda() -> GraspingArm:
    """Return the arm of the suite, with its own hand."""
    return GraspingArm(find_arm("panda"), find_hand())


def cube(mass_kg: float) -> SlipBody:
    """Return the 5 cm cube with its centre in the origin."""
    half = SIDE_M / 2
    return _body((_box((-half, -half, -half), (half, half, half)),), mass_kg)


def frustum(mass_kg: float, half_angle_deg: float) -> SlipBody:
    """Return a cone of 5 cm at its middle, cut off 1 cm above and below; it widens towards z."""
    change = 0.01 * np.tan(np.radians(half_angle_deg))
    half = SIDE_M / 2
    return _body((_turned((half - change, -0.01), (half + change, 0.01), sides=32),), mass_kg)


def specimen(shape: str, mass_kg: float) -> SlipBody:
    """Return one of the shapes with a mass; closing along its y meets it within the opening.

    Raises:
        InputError: there is no such shape.
    """
    if shape not in _SHAPES:
        raise InputError(f"there is no specimen '{shape}'; there are: {', '.join(_SHAPES)}.")
    return _body(_SHAPES[shape], mass_kg)


def fits(shape: str, hand: Hand) -> bool:
    """Return whether the open hand takes a shape between its fingers."""
    across = np.abs(np.concatenate(specimen(shape, 1.0).parts)[:, 1]).max()
    return bool(across < hand.max_opening_m / 2 - CLEARANCE_M)


def ready_trial(
    body: SlipBody, Ts_obj_grasp: Array, Ts_table_grasp: Array, opening_m: float
) -> SlipTrial:
    """Return grasps (N, 4, 4) carried by an arm in its ready pose."""
    n = len(Ts_obj_grasp)
    arm, j = panda(), panda().swing_joint
    axis, point, _ = arm.swing_in_grasp(READY)
    return SlipTrial(
        body=body,
        Ts_obj_grasp=Ts_obj_grasp,
        Ts_table_grasp=Ts_table_grasp,
        openings_m=np.full(n, opening_m),
        swing_axes=np.tile(axis, (n, 1)),
        swing_points=np.tile(point, (n, 1)),
        swing_ranges=np.tile([arm.limits.lower[j], arm.limits.upper[j]], (n, 1)),
    )


def cube_trial(mass_kg: float, rotations: Array, hand: Hand) -> SlipTrial:
    """Return grasps of the cube in its centre, with the hand at rotations (N, 3, 3)."""
    n = len(rotations)
    Ts = hand.grasps_of_pads(np.tile(np.eye(4), (n, 1, 1)), SIDE_M)
    return ready_trial(cube(mass_kg), Ts, se3.from_rt(rotations, np.zeros(3)), OPENING_M)


def edge_trial(
    shape: str,
    mass_kg: float,
    grasps: int,
    seed: int,
    hand: Hand,
    *,
    shift_m: float = 0.0,
    lean_deg: float = 90.0,
) -> SlipTrial:
    """Return grasps of a shape that close beside its centre, in all positions to gravity.

    The closing axis is the shape's y; where the fingers meet it, the turn about y and the hand's
    tilt are drawn. The same seed gives the same grasps at every mass.

    Args:
        shape: name of the specimen.
        mass_kg: its mass [kg].
        grasps: number of grasps.
        seed: of the draw.
        hand: what grasps it.
        shift_m: moves every grasp along a drawn direction [m].
        lean_deg: how far the surfaces that the fingers meet may lean over [deg]; what leans by more
            than the angle of friction is squeezed out.

    Raises:
        InputError: no such grasp was found; the shape is too large for the hand.
    """
    from scipy.spatial import ConvexHull

    body = specimen(shape, mass_kg)
    hulls = [ConvexHull(part).equations for part in body.parts]
    corners = np.concatenate(body.parts)
    low, high = corners.min(axis=0), corners.max(axis=0)
    z_pad = hand.z_pad(high[1] - low[1])
    rng = np.random.default_rng([seed, sorted(_SHAPES).index(shape)])
    found: list[tuple[Array, Array]] = []
    tries = MOST_DRAWS * grasps if fits(shape, hand) else 0
    while len(found) < grasps:
        if tries == 0:
            raise InputError(
                f"no grasp of the validation suite's {shape}, {1e3 * (high[1] - low[1]):.0f} mm "
                f"wide, was found for the hand '{hand.name}', which opens "
                f"{1e3 * hand.max_opening_m:.0f} mm and has fingers of "
                f"{-1e3 * hand.palm_face_z_m:.0f} mm; it takes a larger hand."
            )
        tries -= 1
        at = rng.uniform(low, high) * [1.0, 0.0, 1.0]
        turn = se3.exp_so3([0.0, rng.uniform(-np.pi, np.pi), 0.0])
        tilt, shift = rng.uniform(-0.5, 0.5, 3), rng.normal(size=3)
        T_obj_grasp = se3.from_rt(turn, at + shift_m * shift / np.linalg.norm(shift))
        T_obj_grasp[:3, 3] -= z_pad * T_obj_grasp[:3, 2]
        in_hand = se3.transform(se3.invert(T_obj_grasp), corners)
        clear = in_hand[:, 2].min() > hand.palm_face_z_m + CLEARANCE_M
        if clear and _lean_deg(hulls, at) <= lean_deg:
            R = se3.exp_so3(tilt) @ DOWN @ turn
            found.append((T_obj_grasp, se3.from_rt(R, np.zeros(3))))
    return ready_trial(
        body, np.stack([T for T, _ in found]), np.stack([T for _, T in found]), hand.max_opening_m
    )


def _lean_deg(hulls: list[Array], at: Array) -> float:
    """Return the greatest angle to y of the two outermost faces that the line along y meets [deg].

    Args:
        hulls: outward planes (n, 4) of the parts that it may meet.
        at: (3,) a point on the line.

    Returns:
        infinity if it does not meet the body.
    """
    first, last = (np.inf, 0.0), (-np.inf, 0.0)
    for planes in hulls:
        across, beside = planes[:, 1], planes[:, [0, 2]] @ at[[0, 2]] + planes[:, 3]
        if np.any((across == 0.0) & (beside > 0.0)):
            continue
        with np.errstate(divide="ignore", invalid="ignore"):
            y = -beside / across
        inwards, outwards = np.where(across < 0.0, y, -np.inf), np.where(across > 0.0, y, np.inf)
        enter, leave = int(np.argmax(inwards)), int(np.argmin(outwards))
        if inwards[enter] < outwards[leave]:
            first = min(first, (float(inwards[enter]), float(across[enter])))
            last = max(last, (float(outwards[leave]), float(across[leave])))
    return float(np.degrees(np.arccos(min(-first[1], last[1])))) if first[1] else np.inf


def _body(parts: tuple[Array, ...], mass_kg: float) -> SlipBody:
    """Return a body of one density: the parts' moments add up about the common centre."""
    # A mesh of one face is not closed; its convex hull is what counts.
    solids = [
        mass_properties(Mesh(vertices=part, faces=np.array([[0, 1, 2]])), 1.0) for part in parts
    ]
    volumes = np.array([s.volume_m3 for s in solids])
    center = volumes @ np.stack([s.center_of_mass for s in solids]) / volumes.sum()
    inertia = np.zeros((3, 3))
    for solid in solids:
        d = solid.center_of_mass - center
        inertia += solid.inertia + solid.volume_m3 * (d @ d * np.eye(3) - np.outer(d, d))
    density = mass_kg / volumes.sum()
    return SlipBody(parts=parts, mass_kg=mass_kg, center_of_mass=center, inertia=density * inertia)


def _box(low: tuple[float, float, float], high: tuple[float, float, float]) -> Array:
    """Return the corners (8, 3) of a box [m]."""
    return np.array(list(product(*zip(low, high, strict=True))))


def _turned(*rings: tuple[float, float], sides: int = 24) -> Array:
    """Return the corners (R * sides, 3) of rings about z, given by radius and z [m]."""
    angle = 2 * np.pi * np.arange(sides) / sides
    circle = np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    return np.concatenate([np.insert(r * circle, 2, z, axis=1) for r, z in rings])


def _ball() -> Array:
    """Return 400 points (400, 3) of a sphere of 50 mm, along a spiral: facets sink in by 0.1 mm."""
    z = np.linspace(-1.0, 1.0, 400)
    angle = np.pi * (1 + 5**0.5) * np.arange(400)
    r = np.sqrt(1.0 - z**2)
    return 0.025 * np.stack([r * np.cos(angle), r * np.sin(angle), z], axis=-1)


@lru_cache(maxsize=1)
def _wedge() -> Array:
    """Return the corners (6, 3) of a wedge: its faces along y lean by 8 deg together [m]."""
    lean = 0.03 * np.tan(np.radians(8.0))
    points = _box((-0.02, -0.02, -0.03), (0.02, 0.02, 0.03))
    points[:, 1] += np.sign(points[:, 1]) * np.sign(-points[:, 2]) * lean
    return points


_SHAPES = {
    "box": (_box((-0.03, -0.02, -0.045), (0.03, 0.02, 0.045)),),
    "l_shape": (
        _box((-0.01, -0.02, -0.04), (0.01, 0.02, 0.04)),
        _box((0.01, -0.02, -0.04), (0.06, 0.02, -0.02)),
    ),
    "cylinder": (_turned((0.025, -0.03), (0.025, 0.03)),),
    "wedge": (_wedge(),),
    "disc": (_turned((0.03, -0.02), (0.03, 0.02))[:, [0, 2, 1]],),
    "cone": (_turned((0.032, -0.03), (0.032 - 0.06 * np.tan(np.radians(10.0)), 0.03), sides=32),),
    "ball": (_ball(),),
    "bottle": (
        _turned((0.03, -0.06), (0.03, 0.01)),
        _turned((0.03, 0.01), (0.014, 0.035)),
        _turned((0.014, 0.035), (0.014, 0.06)),
    ),
}
"""Convex parts (V, 3) of each shape, about its middle [m]; y is where the hand closes."""
