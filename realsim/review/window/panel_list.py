"""The list of all scenes and objects, worst first."""

from collections.abc import Sequence
from typing import TYPE_CHECKING

import viser

from realsim.review import scene_list
from realsim.review.scene_list import ObjectRow
from realsim.review.window import window_text

if TYPE_CHECKING:
    from realsim.review.window.window import Window

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
