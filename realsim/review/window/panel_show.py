"""The panel of what is shown: colours of the points, looks of the objects, how sure a pose is."""

import threading
from collections.abc import Callable
from typing import TYPE_CHECKING

import viser

from realsim.review.drawing.scene_nodes import Look
from realsim.review.placing import depth_residuals
from realsim.review.placing.ellipsoid import ellipsoid_of
from realsim.review.reviewed_session import Standing
from realsim.review.window import window_text

if TYPE_CHECKING:
    from realsim.review.window.window import Window

LOOKS: dict[str, Look] = {
    "as they look": "appearance",
    "in the colour of the verdict": "verdict",
    "hidden": "hidden",
}
PHOTO, RESIDUAL = "as photographed", "distance from the models"
FACTORS = ("1", "10", "100", "1000")
SIGMAS = 2.0
"""Half axes of the ellipsoids, in standard deviations."""


class ShowPanel:
    """Switches; they are this reviewer's own."""

    def __init__(self, window: "Window") -> None:
        """Build it in the container that is open.

        Args:
            window: whose panel it is.
        """
        self._window = window
        self._has_hidden_cameras = False
        """Whether the cameras are off because a replay began, and not by the reviewer's hand."""
        self._colored: object = None
        self._painter = LatestOnly(self._paint)
        gui = window.client.gui
        self._look = gui.add_dropdown("Objects", tuple(LOOKS))
        self._cloud = gui.add_checkbox("Measured points", True)
        self._colors = gui.add_dropdown("Points", (PHOTO, RESIDUAL))
        self._legend = gui.add_html("", visible=False)
        every = gui.add_button(
            "Load all points", icon=viser.Icon.DOTS, hint="More detail, slower to turn."
        )
        self._cameras = gui.add_checkbox("Cameras", True)
        self._table = gui.add_checkbox("Table", True)
        with gui.add_folder("How sure the positions are"):
            self._sure = gui.add_checkbox("Show ellipsoids", False)
            self._factor = gui.add_dropdown("Times", FACTORS, initial_value="100")
            self._said = gui.add_markdown("")
        for switch in (self._look, self._cloud, self._cameras, self._table):
            switch.on_update(window.guarded(lambda _: self._switch()))
        self._colors.on_update(window.guarded(lambda _: self._color()))
        for control in (self._sure, self._factor):
            control.on_update(window.guarded(lambda _: self._draw_ellipsoids()))
        every.on_click(window.guarded(lambda _: window.nodes.cloud.refine()))

    def opened(self) -> None:
        """Show another scene as the switches say."""
        self._colored = None
        self._switch()

    def refresh(self) -> None:
        """Objects may stand elsewhere: colours and ellipsoids follow."""
        self._color()
        self._draw_ellipsoids()

    def hide_cameras(self) -> None:
        """Switch the cameras off, as the reviewer could: an arm is to be seen among them."""
        self._has_hidden_cameras = self._has_hidden_cameras or self._cameras.value
        self._cameras.value = False
        self._switch()

    def bring_back_cameras(self) -> None:
        """Switch the cameras on again, if it was `hide_cameras` that switched them off."""
        if self._has_hidden_cameras:
            self._has_hidden_cameras = False
            self._cameras.value = True
            self._switch()

    def _switch(self) -> None:
        nodes, look = self._window.nodes, LOOKS[self._look.value]
        if look == "appearance" and self._colors.value == RESIDUAL:
            look = "faded"  # points inside a model are the ones that matter
        with self._window.client.atomic():
            nodes.show_objects(look)
            nodes.cloud.show(self._cloud.value)
            nodes.show_cameras(self._cameras.value)
            nodes.show_table(self._table.value)

    def _color(self) -> None:
        """Colour the points, if what their colours depend on has changed; returns at once."""
        is_residual = self._colors.value == RESIDUAL
        self._legend.visible = is_residual
        wanted = self._window.standing if is_residual else None
        if wanted is not self._colored:
            if (wanted is None) != (self._colored is None):
                self._switch()
            self._colored = wanted
            self._painter.ask()

    def _paint(self) -> None:
        window, wanted = self._window, self._colored
        if not window.is_open:
            return

        def paint() -> None:
            colors = None
            if isinstance(wanted, Standing):
                r = window.session.residuals_m(wanted.scene.objects)
                noise_m = depth_residuals.noise_of(r)
                colors = depth_residuals.residual_rgb(r, noise_m=noise_m)
                said = depth_residuals.legend(noise_m=noise_m)
                marks = [f"{mm:+.2g}" for mm in said.values_mm]
                cells = zip(marks, said.rgb.tolist(), strict=True)
                self._legend.content = window_text.legend_html(cells, f"mm. {said.words}")
            if self._colored is wanted:
                window.nodes.cloud.color(colors)

        window.attempt(paint)

    def _draw_ellipsoids(self) -> None:
        window = self._window
        objects = window.standing.scene.objects if self._sure.value else ()
        factor = float(self._factor.value)
        shapes = {o.instance: ellipsoid_of(o, SIGMAS, factor, window.model_of(o)) for o in objects}
        window.nodes.ellipsoids(shapes)
        times = "" if factor == 1 else f", drawn {self._factor.value} times as large to be seen"
        text = f"{SIGMAS:g} sigma of the position of an object's middle{times}."
        unknown = [str(i) for i, shape in shapes.items() if shape is None]
        if unknown:
            text += f" Not known of instance {', '.join(unknown)}."
        self._said.content = text


class LatestOnly:
    """Does a piece of work in a thread of its own; what is asked meanwhile is done once after."""

    def __init__(self, work: Callable[[], None]) -> None:
        """Wait to be asked.

        Args:
            work: looks itself what is to be done; it must not raise.
        """
        self._work = work
        self._lock = threading.Lock()
        self._is_wanted = self._is_running = False

    def ask(self) -> None:
        """Have it done soon; returns at once."""
        with self._lock:
            self._is_wanted = True
            if self._is_running:
                return
            self._is_running = True
        threading.Thread(target=self._run, name="review-latest", daemon=True).start()

    def _run(self) -> None:
        while True:
            with self._lock:
                if not self._is_wanted:
                    self._is_running = False
                    return
                self._is_wanted = False
            self._work()
