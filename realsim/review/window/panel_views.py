"""The panel of the views: stand in a camera before the real photograph, leave views out."""

from typing import TYPE_CHECKING, Any

import numpy as np
import viser
from numpy.typing import ArrayLike

from realsim.arrays import Array
from realsim.errors import InputError
from realsim.geometry import se3
from realsim.review.window import window_text
from realsim.review.window.camera_stand import StandIn

if TYPE_CHECKING:
    from realsim.review.window.window import Window

NONE = "-"


class ViewsPanel:
    """Chooses a camera to stand in, and which views the next registration leaves out."""

    def __init__(self, window: "Window") -> None:
        """Build it in the container that is open.

        Args:
            window: whose panel it is.
        """
        self._window = window
        self._stand = StandIn(window, self._told)
        gui = window.client.gui
        self._text = gui.add_markdown(
            "Click a camera in the scene, or choose one: you stand in it, before its photograph, "
            "with the outlines of the models over it."
        )
        self._view: viser.GuiDropdownHandle[str] = gui.add_dropdown("View", [NONE])
        step = gui.add_button_group("Camera", ("\u25c0 before", "next \u25b6"))
        enter = gui.add_button("Stand in this camera", icon=viser.Icon.CAMERA, hint="Key C.")
        self._leave = gui.add_button(
            "Leave the camera", icon=viser.Icon.DOOR_EXIT, color=(134, 142, 150), disabled=True,
            hint="Key Escape.",
        )  # fmt: skip
        with gui.add_folder("Leave this view out"):
            gui.add_markdown("The next `realsim register --from-review` does without it.")
            self._why = gui.add_text("Why", "")
            self._exclude = gui.add_button("Leave it out", icon=viser.Icon.EYE_OFF)
            self._excluded = gui.add_markdown("")
        self._numbers: dict[str, int] = {}
        self._view.on_update(window.guarded(lambda _: self._chosen()))
        step.on_click(window.guarded(lambda _: self._stepped(1 if "next" in step.value else -1)))
        enter.on_click(window.guarded(lambda _: self.stand_in(self._index())))
        self._leave.on_click(window.guarded(lambda _: self.leave()))
        self._exclude.on_click(window.guarded(lambda _: self._toggle()))

    # --- standing in a camera ---------------------------------------------------------------------

    @property
    def current(self) -> int | None:
        """The view in whose camera the reviewer stands; None = in none."""
        return self._stand.view

    @property
    def chosen(self) -> int:
        """The view that is chosen in the list.

        Raises:
            InputError: no scene is open.
        """
        return self._index()

    def stand_in(self, view: int) -> None:
        """Stand in the camera of a view."""
        self._stand.enter(view)
        label = next((k for k, v in self._numbers.items() if v == view), None)
        if label is not None:
            self._view.value = label

    def toggle(self) -> None:
        """Stand in the chosen camera, or leave it."""
        if self._stand.view is None:
            self.stand_in(self._index())
        else:
            self.leave()

    def leave(self) -> None:
        """Go back to where the reviewer looked from before."""
        self._stand.leave()

    def moved(self) -> None:
        """Draw the outlines anew: an object is being moved."""
        self._stand.redraw()

    def eye(self) -> Any:
        """Return T_world_cam (4, 4) of the browser's camera."""
        return self._stand.eye()

    def first_look(self) -> None:
        """Look at the whole scene."""
        self._stand.first_look()

    def look_at_object(self) -> None:
        """Look at the selected object."""
        window = self._window
        placed, mesh = window.placed, window.model_of(window.placed).mesh
        center = se3.transform(placed.T_world_obj, mesh.bounds.mean(0)[None])[0]
        self._stand.look_at(center, 0.5 * float(np.linalg.norm(mesh.extent)))

    def look_from(self, eye: ArrayLike, look_at: ArrayLike) -> None:
        """Stand at a place (3,) and look at another (3,), in world [m]."""
        self._stand.look_from(eye, look_at)

    def look_past(self, base: Array) -> None:
        """Look at the selected object so that an arm on this base (3,) is not in the way [m]."""
        window = self._window
        mesh = window.model_of(window.placed).mesh
        center = se3.transform(window.placed.T_world_obj, mesh.bounds.mean(0)[None])[0]
        self._stand.look_past(center, base)

    def close(self) -> None:
        """Stop drawing: the browser is gone."""
        self._stand.close()

    # --- the window's events ----------------------------------------------------------------------

    def opened(self) -> None:
        """Offer the views of another scene."""
        views = [v.index for v in self._window.content.views]
        excluded = self._window.session.standing.state.excluded_views()
        self._set_options(views, excluded)

    def refresh(self) -> None:
        """Show which views are left out."""
        window = self._window
        excluded = window.standing.state.excluded_views()
        self._set_options([v.index for v in window.content.views], excluded)
        lines = [
            f"- view {view}: {window_text.signed(entry)}"
            + (f": {window_text.escaped(entry.comment)}" if entry.comment else "")
            for view, entry in excluded.items()
        ]
        self._excluded.content = "\n".join(lines) or "no view is left out"
        self._label_exclude()
        self._stand.redraw()

    # --- how --------------------------------------------------------------------------------------

    def _set_options(self, views: list[int], excluded: Any) -> None:
        here = self._numbers.get(self._view.value)
        names = {f"view {v}" + (" (left out)" if v in excluded else ""): v for v in views}
        if names != self._numbers:
            self._numbers = names
            self._view.options = tuple(names)
            label = next((k for k, v in names.items() if v == here), None)
            if label is not None:
                self._view.value = label

    def _index(self) -> int:
        if self._view.value not in self._numbers:
            raise InputError("no scene is open yet.")
        return self._numbers[self._view.value]

    def _chosen(self) -> None:
        self._label_exclude()
        if self._stand.view is not None:
            self._stand.enter(self._index())

    def _stepped(self, step: int) -> None:
        names = list(self._numbers)
        at = (names.index(self._view.value) + step) % len(names)
        self._view.value = names[at]
        self.stand_in(self._numbers[names[at]])

    def _label_exclude(self) -> None:
        excluded = self._window.standing.state.excluded_views()
        is_out = self._numbers.get(self._view.value, -1) in excluded
        self._exclude.label = "Take it in again" if is_out else "Leave it out"

    def _toggle(self) -> None:
        window, view = self._window, self._index()
        is_out = view in window.standing.state.excluded_views()
        entry = window.session.set_view(view, not is_out, window.reviewer, self._why.value)
        self._why.value = ""
        window.decided(entry, f"view {view} is {'taken in again' if is_out else 'left out'}")

    def _told(self, view: int | None, words: str) -> None:
        self._leave.disabled = view is None
        self._text.content = words
        self._window.show.in_camera(view is not None)
        self._window.correct.in_camera()
        self._window.grasps.stood_in(view)
