"""Standing in a camera: the browser looks from where the camera was, before the real photograph."""

from collections.abc import Callable
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike

from realsim.arrays import Array
from realsim.geometry import se3
from realsim.interop import viser_wxyz_position
from realsim.review.window.latest import LatestOnly

if TYPE_CHECKING:
    from realsim.review.placing.camera_view import CameraPicture
    from realsim.review.window.window import Window

JPEG_QUALITY = 85
"""Quality of the photograph in the browser [%]: no block is seen at this, at 150 kB for
1280x720."""
WIDTH_PX = (320, 1280)
"""Least and greatest width of the picture [px]: more than the cameras' own shows nothing new."""
SAME_M, SAME_RAD = 1e-3, 3e-3
"""Within which the browser's camera stands where it was put: it reports with fewer digits, and its
orbit controls turn a hair's breadth."""
NEAR_MIDDLE_M = 0.02
"""An object nearer to the scene's middle than this has no outer side [m]."""
LOOK_DOWN_RAD = 0.7
"""Angle under which an object is looked at [rad]."""
LOOK_RADII, LOOK_M = 3.0, 0.1
"""Distance from which it is looked at: radii of its ball, and metres."""
BESIDE_RAD, BESIDE_DOWN_RAD = -0.7, 0.5
"""An arm at work is looked at from the far side of the object, and so much round and down."""
BEHIND_CAMERAS = 1.25
"""Distance of that look over the cameras' own: hand, object and forearm are seen."""
OUTSIDE = "Click a camera in the scene, or choose one: you stand in it, before its photograph."


class StandIn:
    """Puts one browser's camera into a view's camera, and its photograph behind the scene."""

    def __init__(self, window: "Window", told: Callable[[int | None, str], None]) -> None:
        """Stand in none yet.

        Args:
            window: whose camera.
            told: the view that is stood in, or None, and words for the panel.
        """
        self._window, self._told = window, told
        self.view: int | None = None
        """The view in whose camera the reviewer stands; None = in none."""
        self._free: dict[str, Any] | None = None
        """Where the reviewer looked from before."""
        self._put: CameraPicture | None = None
        """What was put behind the scene."""
        self._has_arrived = False
        """Whether the browser has reported that it stands there."""
        self._is_closed = False
        self._latest = LatestOnly(self._draw)
        window.client.camera.on_update(self._looked)

    def enter(self, view: int) -> None:
        """Stand in the camera of a view."""
        window = self._window
        with window.lock:
            camera = window.client.camera
            if self.view is None:
                self._free = {
                    "position": camera.position.copy(), "look_at": camera.look_at.copy(),
                    "up_direction": camera.up_direction.copy(), "fov": float(camera.fov),
                }  # fmt: skip
            self.view, self._has_arrived, self._put = view, False, None
            self._told(
                view,
                f"You stand in the camera of **view {view}**. Outlines: the models, as they stand "
                "here. Turning the view leaves the photograph.",
            )
        self._latest.ask()

    def leave(self, *, stay: bool = False) -> None:
        """Go back to where the reviewer looked from before; or stay, if the view was turned."""
        window = self._window
        with window.lock:
            if self.view is None:
                return
            self.view, self._put = None, None
            free, self._free = self._free, None
            window.client.scene.set_background_image(None)
            camera = window.client.camera
            if free is not None:
                with window.client.atomic():
                    camera.fov = free.pop("fov")
                    if not stay:
                        for name, value in free.items():
                            setattr(camera, name, value)
            self._told(None, OUTSIDE)

    def redraw(self) -> None:
        """Draw the outlines anew."""
        if self.view is not None:
            self._latest.ask()

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

    def look_at(self, center: Array, radius_m: float) -> None:
        """Look at an object from outside of the scene, where no other stands before it.

        Args:
            center: (3,) its middle in world [m].
            radius_m: of the ball about it.
        """
        if self.view is not None:
            return
        content = self._window.content
        up = content.look.up
        offset = center - content.region.center
        if np.linalg.norm(offset - up * (up @ offset)) < NEAR_MIDDLE_M:
            offset = content.look.position - content.region.center
        side = offset - up * (up @ offset)
        side = side / max(float(np.linalg.norm(side)), 1e-9)
        direction = np.cos(LOOK_DOWN_RAD) * side + np.sin(LOOK_DOWN_RAD) * up
        self.look_from(center + (LOOK_RADII * radius_m + LOOK_M) * direction, center)

    def look_past(self, center: Array, before: Array) -> None:
        """Look at a place from afar, so that what stands at another one is beside it.

        Args:
            center: (3,) what is looked at, in world [m].
            before: (3,) what must not stand in the way, such as an arm's base [m].
        """
        if self.view is not None:
            return
        content = self._window.content
        up = content.look.up
        away = center - before
        away = away - up * (up @ away)
        away = away / max(float(np.linalg.norm(away)), 1e-9)
        side = se3.exp_so3(BESIDE_RAD * up) @ away
        direction = np.cos(BESIDE_DOWN_RAD) * side + np.sin(BESIDE_DOWN_RAD) * up
        eyes = np.array([v.T_world_cam for v in content.views])[:, :3, 3]
        distance = BEHIND_CAMERAS * float(np.median(np.linalg.norm(eyes - center, axis=1)))
        self.look_from(center + distance * direction, center)

    def close(self) -> None:
        """Draw no more: the browser is gone."""
        self._is_closed, self.view = True, None

    # --- how --------------------------------------------------------------------------------------

    def _draw(self) -> None:
        """Make the picture of the view, and put it behind the scene."""
        view, window = self.view, self._window
        if view is None or self._is_closed:
            return
        try:
            objects = list(window.standing.scene.objects)
            moved = window.correct.moved
            if moved is not None:
                now = [moved if o.instance == moved.instance else o for o in objects]
                objects = [replace(o, reasons=()) for o in now]
            camera = window.client.camera
            picture = window.session.camera_views().picture(
                view, window.session.with_models(objects), aspect=camera.aspect,
                highlight=window.selected,
                width_px=int(np.clip(camera.image_width, *WIDTH_PX)),
            )  # fmt: skip
        except Exception as error:
            window.fail(error)
            return
        with window.lock:
            if self.view == view and not self._is_closed:
                self._show(picture)

    def _show(self, picture: "CameraPicture") -> None:
        client = self._window.client
        with client.atomic():
            client.scene.set_background_image(picture.rgb, format="jpeg", jpeg_quality=JPEG_QUALITY)
            if self._put is None or not self._is_there(picture):
                wxyz, position = viser_wxyz_position(picture.T_world_cam)
                client.camera.position = position
                client.camera.wxyz = wxyz
                client.camera.fov = picture.fov_rad
        self._put = picture

    def _is_there(self, picture: "CameraPicture") -> bool:
        step = se3.invert(picture.T_world_cam) @ self.eye()
        near = float(np.linalg.norm(step[:3, 3])) < SAME_M
        return near and float(se3.angle(step[:3, :3])) < SAME_RAD

    def _looked(self, camera: Any) -> None:
        """Take note of where the browser's camera is: turned away, it leaves the photograph."""
        put = self._put
        if put is None or self.view is None or self._is_closed:
            return
        if not self._is_there(put):
            # What was sent before it got there is old.
            if self._has_arrived:
                self.leave(stay=True)
            return
        self._has_arrived = True
        if abs(float(camera.aspect) - put.aspect) > 1e-3:
            self._latest.ask()
