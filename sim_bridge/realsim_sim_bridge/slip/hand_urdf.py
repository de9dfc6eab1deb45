"""The Franka Hand as a URDF for PyBullet: a fixed palm and two fingers that slide along y."""

import numpy as np
from numpy.typing import NDArray

from realsim_sim_bridge.grasping.hand import HandGeometry
from realsim_sim_bridge.slip.pads import PadModel

Array = NDArray[np.float64]


def hand_urdf(geometry: HandGeometry, pads: PadModel | None) -> str:
    """Return the URDF of the hand: a fixed palm and two fingers that slide along y.

    The joint positions are the distances [m] of the finger faces from the middle.

    Args:
        geometry: sizes of the hand.
        pads: the sphere pads, or None for bare boxes.
    """
    palm, _, finger = geometry.boxes(0.0)[0]
    mass = pads.finger_mass_kg if pads else PadModel().finger_mass_kg
    fingers = ""
    for name, side in (("left", 1.0), ("right", -1.0)):
        low, high = finger.copy()
        if pads:
            low[1] += pads.protrusion_m
        parts = _box(low, high, side)
        if pads:
            parts += "".join(
                f'<collision><origin xyz="{x} {side * pads.sphere_radius_m} {z}"/>'
                f'<geometry><sphere radius="{pads.sphere_radius_m}"/></geometry></collision>'
                for x, z in pads.centers_xz().tolist()
            )
        fingers += (
            f'<link name="{name}"><inertial><mass value="{mass}"/>{_FINGER_INERTIA}</inertial>'
            f"{parts}</link>"
            f'<joint name="{name}_slide" type="prismatic"><parent link="palm"/>'
            f'<child link="{name}"/><axis xyz="0 {side:g} 0"/>'
            f'<limit lower="0" upper="{geometry.max_opening_m / 2}" effort="1000" velocity="1"/>'
            "</joint>"
        )
    return (
        '<robot name="hand"><link name="palm"><inertial><mass value="0.7"/>'
        f"{_PALM_INERTIA}</inertial>{_box(palm[0], palm[1], 1.0)}</link>{fingers}</robot>"
    )


_FINGER_INERTIA = '<inertia ixx="3e-5" iyy="3e-5" izz="3e-5" ixy="0" ixz="0" iyz="0"/>'
_PALM_INERTIA = '<inertia ixx="2e-3" iyy="1e-3" izz="2e-3" ixy="0" ixz="0" iyz="0"/>'


def _box(low: Array, high: Array, side: float) -> str:
    """Return the collision element of the box from `low` to `high`, mirrored in y if side < 0."""
    center, size = (low + high) / 2.0, high - low
    return (
        f'<collision><origin xyz="{center[0]} {side * center[1]} {center[2]}"/><geometry>'
        f'<box size="{size[0]} {size[1]} {size[2]}"/></geometry></collision>'
    )
