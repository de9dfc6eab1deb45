"""The panel of the grasps: which are drawn, what is known of a clicked one, and its replay."""

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import viser

from realsim.errors import InputError
from realsim.records import GraspSet
from realsim.records.grasps import label_words
from realsim.rendering.overlay import score_rgb
from realsim.review.drawing.grasp_drawing import GraspFilter, failure_choices, visible_grasps
from realsim.review.replaying.grasp_replay import GraspMotion, ReplayPlayer
from realsim.review.replaying.grasp_words import grasp_words
from realsim.review.window import window_text

if TYPE_CHECKING:
    from realsim.review.window.window import Window

STAGES = {"any": 0, "closed": 1, "closed and lifted": 2, "and shaken": 3, "and swung: all four": 4}
"""What a grasp has passed at least."""
THIS, EVERY = "this object", "all objects"
ANY = "any, or none"


class GraspsPanel:
    """Filters, words and replay; the filters are this reviewer's own."""

    def __init__(self, window: "Window") -> None:
        """Build it in the container that is open.

        Args:
            window: whose panel it is.
        """
        self._window = window
        self._is_closed = False
        gui = window.client.gui
        self._show = gui.add_checkbox("Show grasps", False)
        self._of = gui.add_dropdown("Of", (THIS, EVERY))
        self._stage = gui.add_dropdown("Passed", tuple(STAGES))
        self._least = gui.add_slider("Least score", 0.0, 1.0, 0.05, 0.0)
        self._reachable = gui.add_checkbox("The arm reaches it", False)
        self._seen = gui.add_checkbox(
            "The chosen view sees it", False, hint="The view that is chosen under Views."
        )
        self._failure: viser.GuiDropdownHandle[str] = gui.add_dropdown("Failed by", [ANY])
        self._reasons = {ANY: ""}
        self._drawn = gui.add_markdown("")
        self._step = gui.add_button_group(
            "Grasp", ("\u25c0 Prev", "Next \u25b6"), hint="Through those that are drawn."
        )
        self._step.on_click(window.guarded(lambda _: self._stepped()))
        self._at: tuple[int, int] | None = None
        """Instance and row of the grasp that is looked at."""
        self._legend = gui.add_html("")
        self._words = gui.add_markdown("")
        self._player = ReplayPlayer(
            window.client.scene, gui, self, atomic=window.client.atomic,
            connected=lambda: not self._is_closed, on_carried=window.hide_object,
        )  # fmt: skip
        self._player.on_closed(self._replay_closed)
        self._show.on_update(window.guarded(lambda _: self.draw()))
        for control in (self._of, self._stage, self._least, self._reachable, self._seen,
                        self._failure):  # fmt: skip
            control.on_update(window.guarded(lambda _: self._filtered()))

    # --- where the player has its motions from ----------------------------------------------------

    def motion(self, instance: int, row: int) -> GraspMotion | None:
        """Return what is replayed of a grasp; None = nothing is known."""
        motions = self._window.server.motions_of(self._window.session)
        return None if motions is None else motions.motion(instance, row)

    # --- what is drawn ----------------------------------------------------------------------------

    def draw(self) -> int:
        """Draw the grasps that pass; return how many."""
        window = self._window
        sets = window.content.grasp_sets
        every = sum(len(s) for s in sets)
        if every == 0:
            self._drawn.content = "This scene has no grasps; `realsim school` tries them."
            return 0
        poses = {o.instance: o.T_world_obj for o in window.standing.scene.objects}
        count = window.nodes.draw_grasps(self._filter(sets), poses)
        how = " Click one to see how it went." if count else ""
        self._drawn.content = f"**{count}** of {every} grasps drawn.{how}"
        return count

    def clicked(self, instance: int, row: int) -> None:
        """Tell what is known of a grasp, and replay it."""
        window = self._window
        if instance != window.selected:
            window.select(instance)
        self._at = instance, row
        grasps = window.content.grasps_of(instance)
        if grasps is None:
            raise InputError(f"instance {instance} has no grasps.")
        name = window.model_of(window.placed).name
        self._words.content = grasp_words(grasps, row, name)
        with window.working("Preparing the replay", f"grasp {row} of {name}"):
            motion = self._player.show(instance, row)
        if motion is not None and len(motion.link_meshes):
            window.show.hide_cameras()
            window.stand.look_past(motion.Ts_world_link[0, 0, :3, 3])
        if motion is None:
            self._words.content += "\n\nThere is no motion to replay."

    # --- the window's events ----------------------------------------------------------------------

    def opened(self) -> None:
        """Offer the filters of another scene."""
        sets = self._window.content.grasp_sets
        self._reasons = {ANY: ""} | failure_choices(sets)
        self._failure.options = tuple(self._reasons)
        self._least.label = f"Least {label_words(sets)}"
        self._legend.content = legend_html(sets)
        self._words.content = ""

    def closed(self) -> None:
        """The scene is left."""
        self._player.clear()

    def selected(self) -> None:
        """Another object is looked at."""
        motion = self._player.motion
        if motion is not None and motion.instance != self._window.selected:
            self._player.clear()
            self._words.content = ""
        if self._window.is_open and self._of.value == THIS:
            self.draw()

    def refresh(self) -> None:
        """Objects may stand elsewhere."""
        if self._show.value:
            self.draw()

    def close(self) -> None:
        """Play no more: the browser is gone."""
        self._is_closed = True
        self._player.pause()

    # --- how --------------------------------------------------------------------------------------

    def _replay_closed(self) -> None:
        """What was put out of the replay's way comes back."""
        if self._window.is_open and not self._is_closed:
            self._window.show.bring_back_cameras()

    def _stepped(self) -> None:
        """Go to the next drawn grasp, or the one before, round the list."""
        drawn = self._window.nodes.grasps.drawn
        if not self._show.value or not drawn:
            raise InputError("no grasps are drawn; tick Show grasps or set other filters.")
        step = 1 if "Next" in self._step.value else -1
        at = drawn.index(self._at) if self._at in drawn else min(-step, 0)
        self.clicked(*drawn[(at + step) % len(drawn)])

    def _filtered(self) -> None:
        """Whoever sets a filter wants to see what passes it."""
        self._show.value = True
        self.draw()

    def _filter(self, sets: tuple[GraspSet, ...]) -> GraspFilter:
        return GraspFilter(
            stage=STAGES[self._stage.value], min_label=float(self._least.value),
            reachable_only=self._reachable.value, visible=self._rows(sets),
            instance=self._window.selected if self._of.value == THIS else None,
            failure=self._reasons.get(self._failure.value, ""), show=self._show.value,
        )  # fmt: skip

    def _rows(self, sets: tuple[GraspSet, ...]) -> Mapping[int, frozenset[int]] | None:
        """Return the rows that may be drawn: of objects that are what they were, and that are seen.

        None = all.
        """
        window = self._window
        objects = {o.instance: o for o in window.standing.scene.objects}
        swapped = {s.instance for s in sets if objects[s.instance].obj_id != s.obj_id}
        seen: Mapping[int, frozenset[int]] | None = None
        if self._seen.value and self._show.value:
            poses = {k: o.T_world_obj for k, o in objects.items()}
            seen = visible_grasps(window.content, window.views.chosen, poses)
        if seen is None and not swapped:
            return None
        every = {s.instance: frozenset(range(len(s))) for s in sets}
        return {k: v for k, v in (every if seen is None else seen).items() if k not in swapped}


def legend_html(sets: Sequence[GraspSet]) -> str:
    """Return the legend of the grasps' colours: what they say, and that pale ones are not sure."""
    scores = (0.0, 0.25, 0.5, 0.75, 1.0, float("nan"))
    words = ("0", "0.25", "0.5", "0.75", "1", "unknown")
    cells = zip(words, score_rgb(scores).tolist(), strict=True)
    pale = "; pale: few draws" * any(s.unsure.any() for s in sets)
    return window_text.legend_html(cells, label_words(sets) + pale)
