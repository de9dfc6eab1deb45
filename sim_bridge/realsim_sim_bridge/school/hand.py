"""The Franka Hand: its boxes for collision checks, and its body for PyBullet.

Everything is in frame `grasp`: origin between the fingertips (Franka's tool centre point), z =
approach, y = closing axis. The hand's mounting face is at z = -0.1034 m.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


@dataclass(frozen=True, kw_only=True, slots=True)
class HandGeometry:
    """Sizes of the Franka Hand."""

    max_opening_m: float = 0.080
    """Distance of the finger faces when fully open [m]; the paper's and the datasheet's."""
    finger_length_m: float = 0.050
    """Length of a finger, up from its tip [m]; the paper's."""
    tip_beyond_tcp_m: float = 0.0088
    """How far the fingers reach past the tool centre point [m]: tips are 0.1122 m from the mounting
    face (franka_description), the tool centre point 0.1034 m."""
    finger_width_m: float = 0.020
    """Width of a finger across the closing axis [m] (franka_description: 17.5 to 22 mm)."""
    finger_thickness_m: float = 0.015
    """Thickness of a finger along the closing axis [m] (franka_description: 15.2 mm at the tip)."""
    mount_z_m: float = -0.1034
    """z of the mounting face [m]: minus the tool centre point's distance of Franka's own setup."""
    palm_face_z_m: float = -0.0376
    """z of the palm's outer face [m]: the hand's body is 65.8 mm high."""
    palm_width_m: float = 0.204
    """Extent of the palm along the closing axis [m]."""
    palm_depth_m: float = 0.063
    """Extent of the palm across the closing axis [m]."""

    def boxes(self, openings_m: NDArray[np.float64] | float) -> Array:
        """Return the hand's three boxes (N, 3, 2, 3) [m]: palm, finger at -y, finger at +y.

        Args:
            openings_m: (N,) distances of the finger faces [m].
        """
        half = np.atleast_1d(np.asarray(openings_m, dtype=np.float64)) / 2.0
        outer = half + self.finger_thickness_m
        return self._boxes(half, outer)

    def swept_boxes(self, widths_m: Array, openings_m: Array) -> Array:
        """Return the boxes (N, 3, 2, 3) [m] swept while the fingers close to `widths_m` (N,)."""
        return self._boxes(widths_m / 2.0, openings_m / 2.0 + self.finger_thickness_m)

    def _boxes(self, inner: Array, outer: Array) -> Array:
        """Return palm and fingers, the fingers between |y| = inner and outer (N,)."""
        x, tip = self.finger_width_m / 2.0, self.tip_beyond_tcp_m
        boxes = np.empty((len(inner), 3, 2, 3))
        boxes[:, 0, 0] = [-self.palm_depth_m / 2, -self.palm_width_m / 2, self.mount_z_m]
        boxes[:, 0, 1] = [self.palm_depth_m / 2, self.palm_width_m / 2, self.palm_face_z_m]
        boxes[:, 1:, 0, 0], boxes[:, 1:, 1, 0] = -x, x
        boxes[:, 1:, 0, 2], boxes[:, 1:, 1, 2] = tip - self.finger_length_m, tip
        boxes[:, 1, 0, 1], boxes[:, 1, 1, 1] = -outer, -inner
        boxes[:, 2, 0, 1], boxes[:, 2, 1, 1] = inner, outer
        return boxes


@dataclass(frozen=True, kw_only=True, slots=True)
class PadModel:
    """How the fingers touch: spheres with finite stiffness in front of a finger's box.

    Flat pads carry their load on one corner in Bullet's solver, so that they turn like a point;
    six spheres with finite stiffness share it evenly. Their mean distance from the centre, 7.66 mm,
    is that of an evenly loaded patch of 20 x 20 mm.
    """

    sphere_radius_m: float = 0.004
    """Radius of a pad's spheres [m]."""
    protrusion_m: float = 0.0015
    """How far the spheres stand out of the finger's box [m]; at 0.3 mm the box touches too."""
    x_m: tuple[float, ...] = (-0.006, 0.006)
    """x of the spheres' centres [m]."""
    z_m: tuple[float, ...] = (-0.006, 0.0, 0.006)
    """z of the spheres' centres [m]."""
    stiffness: float = 10000.0
    """Contact stiffness [N/m]: shares the load between spheres within the solver's iterations."""
    damping: float = 1.0
    """Contact damping [N s/m]; at 100 and more the sharing is lost."""
    finger_mass_kg: float = 0.1
    """Mass of a finger [kg]."""


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
                for x in pads.x_m
                for z in pads.z_m
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
