"""Placing an object by clicks: a point on the model, the same point among the measured points."""

from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import numpy as np

from realsim.arrays import Array
from realsim.errors import InputError
from realsim.geometry import se3
from realsim.records import Mesh
from realsim.review.placing import picking, placing

if TYPE_CHECKING:
    from realsim.review.window.window import Window

PAIRS = 3
"""Three points hold an object."""
NODE = "/picked"
MARK_M = 0.003
"""Radius of the mark of a click [m]: larger than the cloud's points, smaller than an object."""
MODEL_RGB, SCENE_RGB = (25, 113, 194), (232, 89, 12)
"""Blue on the model, as the model is; orange among the measured points."""
WHICH = ("first", "second", "third")


class PointPlacer:
    """The clicks of one placing; begun, it takes every click in the scene until it is done."""

    def __init__(
        self,
        window: "Window",
        placed: Callable[[placing.PointFit], None],
        ask: Callable[[str, bool], None],
    ) -> None:
        """Wait to be begun.

        Args:
            window: whose clicks are taken.
            placed: told the pose when the points are there.
            ask: told what to click next, and whether the model should be in sight for it.
        """
        self._window, self._placed, self._ask = window, placed, ask
        self._mesh: Mesh | None = None
        self._T = np.eye(4)
        self._on_model: list[Array] = []
        self._in_scene: list[Array] = []
        self._marks: list[Any] = []
        self._take = window.guarded(self._clicked)

    @property
    def is_on(self) -> bool:
        """Whether clicks are taken."""
        return self._mesh is not None

    def begin(self, mesh: Mesh, T_world_obj: Array) -> None:
        """Take clicks on this model, drawn there."""
        self.end()
        self._mesh, self._T = mesh, np.array(T_world_obj)
        self._window.client.scene.on_click()(self._take)
        self._say()

    def end(self) -> None:
        """Take no more clicks; forget those made."""
        if self._mesh is not None:
            self._window.client.scene.remove_click_callback(self._take)
        self._mesh = None
        self._on_model, self._in_scene = [], []
        for mark in self._marks:
            mark.remove()
        self._marks = []

    def back(self) -> None:
        """Forget the last click."""
        if not self._on_model:
            raise InputError("there is no click to take back.")
        (self._in_scene if len(self._in_scene) == len(self._on_model) else self._on_model).pop()
        self._marks.pop().remove()
        self._say()

    def shift(self) -> None:
        """Use one pair: the object is shifted and not turned.

        Raises:
            InputError: there is no whole pair, or there are two.
        """
        pairs = len(self._in_scene)
        if pairs != 1 or self._mesh is None:
            raise InputError(
                f"{pairs} whole pairs are clicked. One pair shifts the object without turning it; "
                "three place it. With two, the turn about their line would be anybody's guess."
            )
        offset = self._in_scene[0] - se3.transform(self._T, self._on_model[0][None])[0]
        T = se3.from_rt(self._T[:3, :3], self._T[:3, 3] + offset)
        mm = 1e3 * float(np.linalg.norm(offset))
        words = f"shifted by one point: {mm:.1f} mm, not turned"
        self._placed(placing.PointFit(T_world_obj=T, rms_m=0.0, words=words))

    def _clicked(self, event: Any) -> None:
        if self._mesh is None:
            return
        if len(self._on_model) == len(self._in_scene):
            point = picking.ray_on_mesh(event.ray_origin, event.ray_direction, self._mesh, self._T)
            if point is None:
                raise InputError("the click missed the blue model; click on it.")
            self._on_model.append(point)
            self._mark(se3.transform(self._T, point[None])[0], MODEL_RGB)
        else:
            cloud = self._window.content.cloud.points
            point = picking.ray_on_cloud(event.ray_origin, event.ray_direction, cloud)
            if point is None:
                raise InputError("there is no measured point where you clicked; go nearer.")
            self._in_scene.append(point)
            self._mark(point, SCENE_RGB)
        if len(self._in_scene) < PAIRS:
            self._say()
            return
        try:
            fit = placing.from_points(self._on_model, self._in_scene)
        except InputError as error:
            self.back()
            raise InputError(f"{error} The last click is taken back.") from error
        self._placed(fit)

    def _mark(self, point_world: Array, rgb: tuple[int, int, int]) -> None:
        mark = self._window.client.scene.add_icosphere(
            f"{NODE}/{len(self._marks)}", radius=MARK_M, color=rgb, position=point_world,
            cast_shadow=False, receive_shadow=False,
        )  # fmt: skip
        self._marks.append(mark)

    def _say(self) -> None:
        pair = len(self._in_scene)
        if len(self._on_model) == pair:
            text = f"Click the **{WHICH[pair]}** point **on the blue model**: a corner, an edge."
            self._ask(text, True)
        else:
            text = f"Click the same point **among the measured points** (pair {pair + 1})."
            self._ask(text, False)
