"""The panel of what is shown: colours of the points, looks of the objects, how sure a pose is.

The panel of the object that is looked at: what was computed of it, and what a person decides.

The list of all scenes and objects, worst first.
"""

import threading
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING

import viser

from realsim.review import corrections, scene_list
from realsim.review.drawing.scene_nodes import Look
from realsim.review.journal import Action, Entry
from realsim.review.placing import depth_residuals
from realsim.review.placing.ellipsoid import ellipsoid_of
from realsim.review.reviewed_session import Standing
from realsim.review.scene_list import ObjectRow
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


class ObjectPanel:
    """Verdict, checks, certainty and history of the selected object, and the buttons to judge."""

    def __init__(self, window: "Window") -> None:
        """Build it in the container that is open.

        Args:
            window: whose panel it is.
        """
        self._window = window
        self._last: Entry | None = None
        """The line that Undo takes back, as the reviewer sees it."""
        self._whose: tuple[int, int | None] = -1, None
        self._comments: dict[tuple[int, int | None], str] = {}
        """Scene and instance shown, and what was written of others and is not recorded yet."""
        gui = window.client.gui
        self._text = gui.add_markdown("Click an object in the scene or in the list.")
        self._comment = gui.add_text("Comment", "", multiline=True, hint="Goes with the decision.")
        green, red = window_text.verdict_rgb("accepted"), window_text.verdict_rgb("rejected")
        accept = gui.add_button("Accept", color=green, icon=viser.Icon.CHECK, hint="Key Y.")
        reject = gui.add_button("Reject", color=red, icon=viser.Icon.X, hint="Key X.")
        comment = gui.add_button("Comment only", color=(73, 80, 87), icon=viser.Icon.MESSAGE)
        self._undo = gui.add_button("Undo", color=window_text.GREY, icon=viser.Icon.ARROW_BACK_UP)
        self._certainty = gui.add_markdown("")
        self._checks = gui.add_markdown("")
        with gui.add_folder("All checks", expand_by_default=False):
            self._rest = gui.add_markdown("")
        with gui.add_folder("Journal of this object"):
            self._history = gui.add_markdown("")
        self._deciding = (accept, reject, comment)
        """Not to be pressed before an object is looked at: the list is there first."""
        for button in (*self._deciding, self._undo):
            button.disabled = True
        accept.on_click(window.guarded(lambda _: self.decide("accept")))
        reject.on_click(window.guarded(lambda _: self.decide("reject")))
        comment.on_click(window.guarded(lambda _: self.decide("comment")))
        self._undo.on_click(window.guarded(lambda _: self.undo()))

    def decide(self, action: Action) -> None:
        """Append a decision about the object as it stands here."""
        window = self._window
        window.correct.require_saved()
        placed = window.placed
        comment = self._comment.value
        entry = window.session.decide(action, placed, window.reviewer, comment=comment)
        self._comment.value = ""
        word = window_text.ACTION_WORDS[action]
        window.decided(entry, f"{window.model_of(placed).name} {word}")

    def undo(self) -> None:
        """Take back the last line on this object."""
        window = self._window
        entry = window.session.undo(window.placed, self._last, window.reviewer)
        last = self._last
        what = "" if last is None else window_text.undo_label(last).removeprefix("Undo: ")
        window.decided(entry, f"taken back on {window.model_of(window.placed).name}: {what}")

    def selected(self) -> None:
        """Begin with another object; a comment that was not recorded waits for its object."""
        self._comments[self._whose] = self._comment.value
        self._whose = self._window.session.number, self._window.selected
        self._comment.value = self._comments.pop(self._whose, "")

    def refresh(self) -> None:
        """Show the object as the journal has it."""
        window = self._window
        for button in self._deciding:
            button.disabled = window.selected is None
        if window.selected is None:
            return
        standing, placed = window.standing, window.placed
        corrected = corrections.corrected_scene(window.session.registered, standing.state).object(
            placed.instance
        )
        model = window.model_of(placed)
        decision = corrections.decision_on(corrected, standing.state)
        lines = standing.state.of(placed.instance)
        self._last = lines[-1] if lines else None
        missing = ""
        if not window.session.has_model(placed.obj_id):
            missing = window.session.model_wanted(placed.obj_id)
        self._text.content = window_text.object_text(placed, corrected, model, decision, missing)
        self._certainty.content = window_text.certainty_text(placed, model)
        self._checks.content = window_text.checks_table(placed, main=True)
        self._rest.content = window_text.checks_table(placed, main=False) or "no others"
        self._history.content = window_text.history_text(lines)
        self._undo.label = window_text.undo_label(self._last)
        self._undo.disabled = self._last is None


LIST_PX, LIST_HEIGHT_PX, EDGE_PX = 230, 310, 8
"""Width and height of the list, and how far from the window's corner it floats [px]."""
ROWS = 16
"""Objects on one page of the list: as many as stand one above the other on a laptop's screen."""
ROW_STYLE = """
:is({ids}) {{ height: auto !important; min-height: 2.9em; padding: 3px 8px !important; }}
:is({ids}) .mantine-Button-inner {{ justify-content: flex-start; }}
:is({ids}) .mantine-Button-label {{ white-space: pre-line; text-align: left; line-height: 1.3;
  overflow-wrap: anywhere; height: auto; }}
"""
"""Two lines that begin at one place and are never cut off."""
HEAD_PX, CHOICE_PX, ROW_PX = 187, 54, 66
"""What stands above the rows, the choice of a scene, and a row of two lines, in the panel [px]."""
PANEL_STYLE = """
@media (min-width: 901px) {{
  .mantine-Paper-root:has(:is({ids})) {{ min-height: min(50vh, {px}px); }}
}}
"""
"""As high as its rows, and at most half of the window; on a phone the page decides."""
ALL_SCENES = "all scenes"
SHOWN: dict[str, scene_list.Which] = {
    "all objects": "all",
    "waiting for a person": "undecided",
    "judged": "decided",
}


class ListPanel:
    """The left panel: a button an object, and how far the review has come."""

    def __init__(self, window: "Window") -> None:
        """Build it.

        Args:
            window: whose list it is.
        """
        self._window = window
        gui = window.client.gui
        panel = gui.add_panel()
        panel.float(x=EDGE_PX, y=EDGE_PX, width=LIST_PX, height=LIST_HEIGHT_PX)
        self._page = 0
        self._rows: list[ObjectRow] = []
        names = [s.name for s in window.server.sessions]
        self._numbers = {n: k for k, n in enumerate(names)}
        with panel.add_tab("Scenes and objects"):
            self._head = gui.add_html("")
            self._scene = gui.add_dropdown(
                "Scene", (ALL_SCENES, *self._numbers), visible=len(names) > 1
            )
            self._which = gui.add_dropdown("Show", tuple(SHOWN))
            self._step = gui.add_button_group(
                "Undecided", ("\u25c0 Prev", "Next \u25b6"), hint="Keys P and N."
            )
            self._buttons = [gui.add_button("-", visible=False) for _ in range(ROWS)]
            self._pages = gui.add_button_group("Page", ("\u2191 worse", "\u2193 better"))
            self._remarks = gui.add_markdown("")
        self._ids = ", ".join(f"button[id='{_uuid(b)}']" for b in self._buttons)
        self._style = gui.add_html("")
        for k, button in enumerate(self._buttons):
            button.on_click(window.guarded(lambda _, k=k: self._open(k)))
        self._scene.on_update(window.guarded(lambda _: self._filtered()))
        self._which.on_update(window.guarded(lambda _: self._filtered()))
        self._step.on_click(window.guarded(lambda _: self._stepped()))
        self._pages.on_click(window.guarded(lambda _: self._turned()))

    def refresh(self, others: Sequence[str]) -> None:
        """Show the list as the journals have it, and what the other reviewers look at."""
        window, every = self._window, self._window.rows()
        scenes = len(window.server.sessions)
        self._head.content = window_text.progress_html(*scene_list.counts(every), scenes, others)
        chosen = every
        if self._scene.value in self._numbers:
            number = self._numbers[self._scene.value]
            chosen = [r for r in every if r.session == number]
        self._rows = scene_list.worst_first(scene_list.of_kind(chosen, SHOWN[self._which.value]))
        pages = max(1, -(-len(self._rows) // ROWS))
        self._page = min(self._page, pages - 1)
        self._pages.visible = pages > 1
        styles = [self._show(b, self._page * ROWS + k) for k, b in enumerate(self._buttons)]
        shown = sum(button.visible for button in self._buttons)
        height = HEAD_PX + CHOICE_PX * self._scene.visible + ROW_PX * shown
        panel = PANEL_STYLE.format(ids=self._ids, px=height)
        style = f"<style>{ROW_STYLE.format(ids=self._ids)}{panel}{''.join(styles)}</style>"
        if style != self._style.content:
            self._style.content = style
        told = [*window.server.remarks, *filter(None, [window.trouble])]
        lines = [f"- {window_text.escaped(str(text))}" for text in told]
        if pages > 1:
            lines.insert(0, f"page {self._page + 1} of {pages}")
        self._remarks.content = "\n".join(lines)

    def _show(self, button: viser.GuiButtonHandle, at: int) -> str:
        """Show a row of the list, or none; return its style."""
        if at >= len(self._rows):
            button.visible = False
            return ""
        row, window = self._rows[at], self._window
        scene = window.server.sessions[row.session].name
        label = window_text.list_label(row, scene, with_scene=len(self._numbers) > 1)
        is_here = window.is_open and row.key == (window.session.number, window.selected)
        if (window.server.sessions[row.session].place, row.instance) in window.browser.drafts:
            label += "\nyour correction is not saved"
        button.label = f"\u25b6 {label}" if is_here else label
        button.visible = True
        return window_text.row_style(_uuid(button), row, is_here=is_here)

    def _open(self, k: int) -> None:
        at = self._page * ROWS + k
        if at < len(self._rows):
            self._window.go_to(*self._rows[at].key)

    def _filtered(self) -> None:
        self._page = 0
        self._window.refresh(force=True)

    def _stepped(self) -> None:
        step = 1 if "Next" in self._step.value else -1
        self._window.next_undecided(step)

    def _turned(self) -> None:
        self._page = max(0, self._page + (1 if "better" in self._pages.value else -1))
        self._window.refresh(force=True)


def _uuid(button: viser.GuiButtonHandle) -> str:
    """Return the id of a button's element in the page."""
    return button._impl.uuid  # pyright: ignore[reportPrivateUsage]
