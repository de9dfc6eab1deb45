"""Where one browser looks from: at the whole scene, at an object, past an arm at work."""

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike

from realsim.arrays import Array
from realsim.geometry import se3

if TYPE_CHECKING:
    from realsim.review.window.window import Window

NEAR_MIDDLE_M = 0.02
"""An object nearer to the scene's middle than this has no outer side [m]."""
LOOK_DOWN_RAD = 0.7
"""Angle under which an object is looked at [rad]."""
LOOK_RADII, LOOK_M = 3.0, 0.1
"""Distance from which it is looked at: radii of its ball, and metres."""
BESIDE_RAD, BESIDE_DOWN_RAD = -0.7, 0.5
"""An arm at work is looked at from the far side of the object, and so much round and down."""
BEHIND_FIRST = 1.5
"""Distance of that look over the first look's: hand, object and forearm are seen."""


class Standpoint:
    """Moves one browser's camera."""

    def __init__(self, window: "Window") -> None:
        """Take whose camera it is."""
        self._window = window

    def eye(self) -> Array:
        """Return T_world_cam (4, 4) of the browser's camera, which looks along z with y down."""
        camera = self._window.client.camera
        return se3.from_rt(se3.from_quaternion_wxyz(camera.wxyz), camera.position)

    def first_look(self) -> None:
        """Look at the whole scene."""
        look = self._window.content.look
        self.look_from(look.position, look.look_at)

    def look_from(self, eye: ArrayLike, look_at: ArrayLike) -> None:
        """Stand at a place (3,) and look at another (3,), the table's normal up [m]."""
        camera = self._window.client.camera
        with self._window.client.atomic():
            camera.up_direction = self._window.content.look.up
            camera.position = np.asarray(eye, dtype=np.float64)
            camera.look_at = np.asarray(look_at, dtype=np.float64)

    def look_at_object(self) -> None:
        """Look at the selected object from outside of the scene, where no other stands before."""
        content, up = self._window.content, self._window.content.look.up
        center, radius_m = self._object()
        offset = center - content.region.center
        if np.linalg.norm(offset - up * (up @ offset)) < NEAR_MIDDLE_M:
            offset = content.look.position - content.region.center
        side = offset - up * (up @ offset)
        side = side / max(float(np.linalg.norm(side)), 1e-9)
        direction = np.cos(LOOK_DOWN_RAD) * side + np.sin(LOOK_DOWN_RAD) * up
        self.look_from(center + (LOOK_RADII * radius_m + LOOK_M) * direction, center)

    def look_past(self, base: Array) -> None:
        """Look at the selected object from afar, so that an arm on this base (3,) is beside it."""
        content, up = self._window.content, self._window.content.look.up
        center, _ = self._object()
        away = center - base
        away = away - up * (up @ away)
        away = away / max(float(np.linalg.norm(away)), 1e-9)
        side = se3.exp_so3(BESIDE_RAD * up) @ away
        direction = np.cos(BESIDE_DOWN_RAD) * side + np.sin(BESIDE_DOWN_RAD) * up
        distance = BEHIND_FIRST * float(np.linalg.norm(content.look.position - center))
        self.look_from(center + distance * direction, center)

    def _object(self) -> tuple[Array, float]:
        """Return the middle (3,) of the selected object in world, and the radius about it [m]."""
        placed = self._window.placed
        mesh = self._window.model_of(placed).mesh
        center = se3.transform(placed.T_world_obj, mesh.bounds.mean(0)[None])[0]
        return center, 0.5 * float(np.linalg.norm(mesh.extent))
