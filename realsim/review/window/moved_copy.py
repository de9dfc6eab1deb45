"""The translucent copy of an object that is being corrected, with arrows and rings to drag."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from realsim.arrays import Array
from realsim.geometry import se3
from realsim.interop import viser_wxyz_position
from realsim.records import ObjectModel, ObjectPose
from realsim.review.placing import placing

if TYPE_CHECKING:
    from realsim.review.window.window import Window

NODE = "/correction"
COPY_RGB = (51, 154, 240)
OPACITY = 0.55
"""So that the measured points inside of it are seen, and the copy too."""
GIZMO_SHARE = 1.1
"""Length of the arrows over the object's longest half axis."""


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Correction:
    """An object on its way to another place."""

    start: ObjectPose
    """As the reviewer found it."""
    T_world_obj: Array
    """(4, 4) where it is now [m]."""
    obj_id: int
    """What it is said to be."""
    how: tuple[str, ...] = ()
    """By what it was moved, each once."""
    checks: tuple[tuple[str, float], ...] = ()
    """What was measured of it where it is now."""


class MovedCopy:
    """Copy and gizmo in one client's scene; the copy hangs on the gizmo, so that it follows."""

    def __init__(self, window: "Window", dragged: Callable[[Array, bool], None]) -> None:
        """Draw nothing yet.

        Args:
            window: in whose scene.
            dragged: told the pose T_world_obj (4, 4) while it is dragged, and whether it is let go.
        """
        self._window, self._dragged = window, dragged
        self._gizmo: Any = None
        self._mesh: Any = None
        self._instance = 0
        self._middle = np.zeros(3)
        """(3,) of the object, in its frame [m]: arrows and rings stand there."""
        self._T_gizmo_obj = np.eye(4)

    def show(self, model: ObjectModel, placed: ObjectPose, axes: Array) -> None:
        """Draw a copy of a model, with the gizmo in its middle; the object itself is hidden.

        Args:
            model: of which.
            placed: where it stands.
            axes: (3, 3) along which it is dragged, one a column, in world.
        """
        self.hide()
        scene = self._window.client.scene
        self._middle = placing.middle_of(model.mesh)
        half = 0.5 * float(np.max(model.mesh.extent))
        self._gizmo = scene.add_transform_controls(
            NODE, scale=GIZMO_SHARE * half + 0.03, depth_test=False, opacity=0.9
        )
        drawn = self._window.content.meshes[model.obj_id]
        self._mesh = scene.add_mesh_simple(
            f"{NODE}/copy", drawn.vertices, drawn.faces, color=COPY_RGB, opacity=OPACITY,
            side="double", cast_shadow=False, receive_shadow=False,
        )  # fmt: skip
        self._gizmo.on_update(self._window.guarded(self._moved))
        self._instance = placed.instance
        self._window.hide_object(placed.instance, True)
        self.place(placed.T_world_obj, axes)

    def place(self, T_world_obj: Array, axes: Array) -> None:
        """Put the copy there, and the gizmo in its middle along these axes (3, 3)."""
        if self._gizmo is None:
            return
        R, t = T_world_obj[:3, :3], T_world_obj[:3, 3]
        T_world_gizmo = se3.from_rt(axes, R @ self._middle + t)
        self._T_gizmo_obj = se3.invert(T_world_gizmo) @ T_world_obj
        with self._window.client.atomic():
            self._mesh.wxyz, self._mesh.position = viser_wxyz_position(self._T_gizmo_obj)
            self._gizmo.wxyz, self._gizmo.position = viser_wxyz_position(T_world_gizmo)

    def see(self, is_seen: bool, is_dragged: bool) -> None:
        """Show the copy, or not while a click among the measured points is waited for.

        Args:
            is_seen: whether it is shown.
            is_dragged: whether its gizmo is there; it would catch clicks.
        """
        if self._gizmo is not None:
            self._mesh.visible = is_seen
            for part in ("disable_axes", "disable_sliders", "disable_rotations"):
                setattr(self._gizmo, part, not is_dragged)

    def hide(self) -> None:
        """Take copy and gizmo away; the object is seen again."""
        if self._gizmo is not None:
            self._mesh.remove()
            self._gizmo.remove()
            self._gizmo = self._mesh = None
            self._window.hide_object(self._instance, False)

    def _moved(self, event: Any) -> None:
        gizmo = self._gizmo
        if gizmo is None:
            return
        T = se3.from_rt(se3.from_quaternion_wxyz(gizmo.wxyz), gizmo.position)
        self._dragged(T @ self._T_gizmo_obj, event.phase == "end")
