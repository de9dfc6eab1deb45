"""The panel of the object that is looked at: what was computed of it, and what a person decides."""

from typing import TYPE_CHECKING

import viser

from realsim.review import corrections
from realsim.review.journal import Action, Entry
from realsim.review.window import window_text

if TYPE_CHECKING:
    from realsim.review.window.window import Window


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
