"""The Franka Hand: its sizes, and its boxes for collision checks and pictures.

The one truth that grasps, arm, physics, foreign hand frames and replays read. Everything is in
frame `grasp`: origin between the fingertips (Franka's tool centre point), z = approach, y = closing
axis. The hand's mounting face is at z = -0.1034 m.
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


HAND = HandGeometry()
"""The hand as Franka makes it."""
