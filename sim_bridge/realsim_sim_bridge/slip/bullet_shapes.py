"""The hand and convex parts as PyBullet takes them, and whether it took what it was given."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from realsim.arrays import Array
from realsim.errors import RealsimError
from realsim.models.convex import collision_obj
from realsim.robots.hand import Hand
from realsim_sim_bridge.slip.world import PadModel

# --- A hand as a URDF for PyBullet: a fixed palm and two fingers that slide along y --------------
# Those of an arc hang on a link that slides along z, which is put where the arc has it.


def hand_urdf(geometry: Hand, pads: PadModel | None) -> str:
    """Return the URDF of the hand: a fixed palm and two fingers that slide along y.

    The positions of the joints `left_slide` and `right_slide` are the distances [m] of the finger
    faces from the middle; `left_lift` and `right_lift`, of an arc only, are the fingers' z [m].

    Args:
        geometry: sizes of the hand.
        pads: the sphere pads, or None for bare boxes.
    """
    mass = pads.finger_mass_kg if pads else PadModel().finger_mass_kg
    fingers = ""
    for name, side in (("left", 1.0), ("right", -1.0)):
        parts, parent = "", "palm"
        for low, high in np.array(geometry.finger_boxes):
            if pads:
                low[1] = max(low[1], pads.protrusion_m)
            parts += _box(low, high, side)
        if pads:
            parts += "".join(
                f'<collision><origin xyz="{x} {side * pads.sphere_radius_m} {z}"/>'
                f'<geometry><sphere radius="{pads.sphere_radius_m}"/></geometry></collision>'
                for x, z in pads.centers_xz().tolist()
            )
        if geometry.arc_radius_m:
            parent = f"{name}_carrier"
            fingers += (
                f'<link name="{parent}"><inertial><mass value="{CARRIER_KG}"/>{_FINGER_INERTIA}'
                f'</inertial></link><joint name="{name}_lift" type="prismatic">'
                f'<parent link="palm"/><child link="{parent}"/><axis xyz="0 0 1"/>'
                '<limit lower="-1" upper="1" effort="1e6" velocity="10"/></joint>'
            )
        fingers += (
            f'<link name="{name}"><inertial><mass value="{mass}"/>{_FINGER_INERTIA}</inertial>'
            f"{parts}</link>"
            f'<joint name="{name}_slide" type="prismatic"><parent link="{parent}"/>'
            f'<child link="{name}"/><axis xyz="0 {side:g} 0"/>'
            f'<limit lower="0" upper="{geometry.max_opening_m / 2}" effort="1000" velocity="1"/>'
            "</joint>"
        )
    palm = "".join(_box(low, high, 1.0) for low, high in np.array(geometry.palm_boxes))
    return (
        '<robot name="hand"><link name="palm"><inertial><mass value="0.7"/>'
        f"{_PALM_INERTIA}</inertial>{palm}</link>{fingers}</robot>"
    )


CARRIER_KG = 1.0
"""Mass of what carries a finger along z [kg]; it is driven where the arc has it. With 50 g the
solver does not converge: pads that turn carry 10 to 20 % too little."""
_FINGER_INERTIA = '<inertia ixx="3e-5" iyy="3e-5" izz="3e-5" ixy="0" ixz="0" iyz="0"/>'
_PALM_INERTIA = '<inertia ixx="2e-3" iyy="1e-3" izz="2e-3" ixy="0" ixz="0" iyz="0"/>'


def _box(low: Array, high: Array, side: float) -> str:
    """Return the collision element of the box from `low` to `high`, mirrored in y if side < 0."""
    center, size = (low + high) / 2.0, high - low
    return (
        f'<collision><origin xyz="{center[0]} {side * center[1]} {center[2]}"/><geometry>'
        f'<box size="{size[0]} {size[1]} {size[2]}"/></geometry></collision>'
    )


# --- Convex parts drawn in by Bullet's collision margin, which is laid around them again ---------
# Bullet finds contact normals reliably only between hulls that do not overlap: their margins do.
# With a margin of 0, faces that lie on each other get normals that are off by tens of degrees (a
# flat box of mu 0.3 then sticks to a slope of 22 degrees); with the margin around the true hull,
# everything stands 1 mm off the table. So the planes of each hull are moved inwards by the margin
# first.


LEAST_CORE = 0.5
"""A part is drawn in by at most this share of its inner radius: a core has to be left."""
LEAST_MARGIN_M = 1e-4
"""The margin is not made smaller for thin parts [m], which are up to so much too fat then: at
0.1 mm normals are still right."""


def drawn_in(parts: list[Array], margin_m: float) -> tuple[list[Array], float]:
    """Return the parts' cores and the margin that makes them the parts again.

    Corners and edges become round by the margin.

    Args:
        parts: vertices (V, 3) of each convex part [m].
        margin_m: wished for [m]; less is used where a part is too thin for it.
    """
    hulls = [_planes(part) for part in parts]
    inner = [_inner_ball(planes, part) for planes, part in zip(hulls, parts, strict=True)]
    thinnest = min(LEAST_CORE * radius for _, radius in inner)
    margin = min(margin_m, max(LEAST_MARGIN_M, thinnest))
    cores = [
        _core(part, planes, middle, min(margin, LEAST_CORE * radius))
        for part, planes, (middle, radius) in zip(parts, hulls, inner, strict=True)
    ]
    return cores, margin


def _planes(part: Array) -> Array:
    """Return the hull's planes (F, 4): n . x + d <= 0 inside, |n| = 1; each once."""
    from scipy.spatial import ConvexHull

    hull: Any = ConvexHull(part)
    return np.unique(np.round(hull.equations, 12), axis=0)


def _inner_ball(planes: Array, part: Array) -> tuple[Array, float]:
    """Return centre (3,) and radius [m] of the largest ball inside (a linear program).

    A sliver's planes may leave nothing inside, or nothing that the solver finds: the radius is 0.
    """
    from scipy.optimize import linprog

    A = np.hstack([planes[:, :3], np.ones((len(planes), 1))])
    found: Any = linprog(
        [0.0, 0.0, 0.0, -1.0], A_ub=A, b_ub=-planes[:, 3], bounds=[(None, None)] * 4
    )
    if found.x is None:
        return part.mean(axis=0), 0.0
    return np.asarray(found.x[:3], dtype=np.float64), max(float(found.x[3]), 0.0)


def _core(part: Array, planes: Array, inside: Array, margin_m: float) -> Array:
    """Return the corners of the hull whose planes lie deeper by the margin."""
    from scipy.spatial import HalfspaceIntersection, QhullError

    if margin_m <= 0.0:
        return part
    deeper = planes + np.array([0.0, 0.0, 0.0, margin_m])
    try:
        found: Any = HalfspaceIntersection(deeper, inside)
    except QhullError:  # numerically flat: left as it is, larger by the margin
        return part
    corners = np.asarray(found.intersections, dtype=np.float64)
    corners = corners[np.all(np.isfinite(corners), axis=1)]
    return np.unique(np.round(corners, 9), axis=0)


def wavefront(parts: list[Array]) -> str:
    """Return an OBJ with one group per part (V, 3); the engine takes the convex hull of each.

    The faces only name the vertices: a hull is made of points.
    """
    lines: list[str] = []
    first = 1
    for i, part in enumerate(parts):
        lines.append(f"o part{i}")
        lines += [f"v {x:.9g} {y:.9g} {z:.9g}" for x, y, z in part.tolist()]
        lines += [f"f {first} {first + j} {first + j + 1}" for j in range(1, len(part) - 1)]
        first += len(part)
    return "\n".join(lines) + "\n"


def shape_in(engine: Any, path: Path, parts: int) -> int:
    """Return the collision shape of the convex parts in a file.

    Bullet keeps what it has read by the file's name: no two shapes may have the same.

    Raises:
        RealsimError: PyBullet does not take it.
    """
    shape: int = engine.createCollisionShape(
        engine.GEOM_MESH, fileName=str(path), meshScale=[1.0, 1.0, 1.0]
    )
    if shape < 0:
        raise RealsimError(f"PyBullet refused the collision shape of {parts} convex parts.")
    return shape


def drawn_in_shape(
    engine: Any, path: Path, parts: Sequence[Array], margin_m: float
) -> tuple[int, float]:
    """Return a collision shape of convex parts, through a file, and its margin (`drawn_in`)."""
    cores, margin = drawn_in(list(parts), margin_m)
    path.write_bytes(collision_obj(cores))
    return shape_in(engine, path, len(cores)), margin


def massless_link(shape: int, fixed: int) -> dict[str, list[Any]]:
    """Return what `createMultiBody` takes for a link of a shape in the base's frame.

    Args:
        shape: PyBullet's number of it.
        fixed: PyBullet's number of joints that do not move.
    """
    still, upright = [0.0, 0.0, 0.0], [0.0, 0.0, 0.0, 1.0]
    return {
        "linkMasses": [0.0],
        "linkCollisionShapeIndices": [shape],
        "linkVisualShapeIndices": [-1],
        "linkPositions": [still],
        "linkOrientations": [upright],
        "linkInertialFramePositions": [still],
        "linkInertialFrameOrientations": [upright],
        "linkParentIndices": [0],
        "linkJointTypes": [fixed],
        "linkJointAxis": [[0.0, 0.0, 1.0]],
    }


_INFO = {
    "mass": 0,
    "lateralFriction": 1,
    "restitution": 5,
    "rollingFriction": 6,
    "spinningFriction": 7,
    "contactDamping": 8,
    "contactStiffness": 9,
    "collisionMargin": 11,
}
"""Where getDynamicsInfo has each setting; the inertia, a list, is at 2."""


def settings_in(engine: Any, body: int, link: int = -1) -> dict[str, float]:
    """Return what the engine holds for a link of a body, -1 = its base."""
    info = engine.getDynamicsInfo(body, link)
    return {name: float(info[at]) for name, at in _INFO.items()}


def require_taken(found: Mapping[str, float], wanted: Mapping[str, float], of: str) -> None:
    """Raise if the engine holds other values than it was given.

    Raises:
        RealsimError: it does; the message names the first.
    """
    for name, value in wanted.items():
        if abs(found[name] - value) > 1e-9 * max(1.0, abs(value)):
            raise RealsimError(
                f"PyBullet holds {name} = {found[name]:g} for {of} instead of {value:g}; its "
                "results would be wrong. Was changeDynamics called with damping on a link?"
            )
