"""The views: their photographs over the scene, and which the next registration leaves out."""

import html
import json
import zlib
from typing import TYPE_CHECKING, Any

import viser

from realsim.errors import InputError
from realsim.review.window import window_text

if TYPE_CHECKING:
    from realsim.review.window.window import Window

NONE = "-"
SOON_S = 0.5
"""After so long it is shown which views are compared with the objects so far [s]."""
OPEN = """<div data-realsim-photograph data-window="{client}" data-state="{state}"
data-scene="{scene}" data-instance="{instance}" data-name="{name}" data-turn="{turn}"
data-view="{view}">
<button data-realsim-key="p" class="realsim-step" title="Previous">\u25c0</button>
<button data-realsim-open class="realsim-open">Photographs at full size (G)</button>
<button data-realsim-key="n" class="realsim-step" title="Next">\u25b6</button></div>"""


class PhotographLink:
    """What the page's photographs are told and ask for: they are a script's, not viser's."""

    def __init__(self, window: "Window") -> None:
        """Tell nothing yet.

        Args:
            window: whose photographs.
        """
        self._window = window
        self._html = window.client.gui.add_html("")
        self._turn, self._view = 0, -1

    def open(self, view: int) -> None:
        """Show the photograph of a view over the scene."""
        self._turn, self._view = self._turn + 1, view
        self.tell()

    def tell(self) -> None:
        """Say which object is looked at, and that things stand otherwise."""
        window = self._window
        if not window.stands:
            return
        stands = [(o.instance, o.obj_id, o.verdict, o.T_world_obj.tobytes())
                  for o in window.shown_objects()]  # fmt: skip
        chosen = window.selected is not None
        state = repr((window.session.number, window.selected, stands))
        name = f"{window.selected} {window.model_of(window.placed).name}" if chosen else ""
        content = OPEN.format(
            client=window.client.client_id, state=f"{zlib.crc32(state.encode()):08x}",
            scene=window.session.number, instance=window.selected if chosen else "",
            name=html.escape(name), turn=self._turn, view=self._view,
        )  # fmt: skip
        if content != self._html.content:
            self._html.content = content

    def answer(self, what: str, numbers: list[float]) -> tuple[str, bytes]:
        """Return media type and content of what the script asks for.

        Args:
            what: strip, outlines, spot, thumb, or one of `photograph.KINDS`.
            numbers: the view, and the pixel of a spot.

        Raises:
            InputError: no scene is open, it has no photographs, or there is no such view or image.
            LookupError: it asks for something else.
        """
        from realsim.review.placing.photograph import KINDS

        window = self._window
        if not window.content.views:
            raise InputError(window_text.NO_PHOTOGRAPHS)
        found, objects = window.session.photographs(), window.shown_objects()
        selected = window.selected
        whose = f"{window.session.number}/{'' if selected is None else selected}"
        view = int(numbers[0]) if numbers else 0
        if what == "thumb":
            return "image/jpeg", window.content.thumbnails[view]
        if what in KINDS:
            return "image/jpeg", found.picture(view, what, objects)
        answers = {
            "strip": lambda: {"whose": whose} | found.strip(selected, objects, SOON_S),
            "outlines": lambda: found.outlines(view, objects),
            "spot": lambda: found.spot(view, (numbers[1], numbers[2]), objects),
        }
        return "application/json", json.dumps(answers[what]()).encode()


class ViewsPanel:
    """Chooses a view to look at, and which views the next registration leaves out."""

    def __init__(self, window: "Window") -> None:
        """Build it in the container that is open.

        Args:
            window: whose panel it is.
        """
        self._window = window
        gui = window.client.gui
        gui.add_markdown(
            "Click a camera in the scene, or choose one: its photograph opens over the scene, with "
            "the outlines of the models. In it, 1 to 4 are photograph, render, difference and "
            "depth, space blinks, S shows three views, the arrows walk through all views."
        )
        self._view: viser.GuiDropdownHandle[str] = gui.add_dropdown("View", [NONE])
        enter = gui.add_button("Show its photograph", icon=viser.Icon.CAMERA, hint="Key C.")
        with gui.add_folder("Leave this view out"):
            gui.add_markdown("The next `realsim register --from-review` does without it.")
            self._why = gui.add_text("Why", "")
            self._exclude = gui.add_button("Leave it out", icon=viser.Icon.EYE_OFF)
            self._excluded = gui.add_markdown("")
        self._numbers: dict[str, int] = {}
        self._view.on_update(window.guarded(lambda _: self._label_exclude()))
        enter.on_click(window.guarded(lambda _: self.show_chosen()))
        self._exclude.on_click(window.guarded(lambda _: self._toggle()))

    @property
    def chosen(self) -> int:
        """The view that is chosen in the list.

        Raises:
            InputError: no scene is open.
        """
        if self._view.value not in self._numbers:
            raise InputError("there is no view to choose: none has a photograph and a camera pose.")
        return self._numbers[self._view.value]

    def show_chosen(self) -> None:
        """Show the photograph of the chosen view."""
        self.show_photograph(self.chosen)

    def show_photograph(self, view: int) -> None:
        """Show the photograph of a view over the scene."""
        label = next((k for k, v in self._numbers.items() if v == view), None)
        if label is not None:
            self._view.value = label
        self._window.photographs.open(view)

    # --- the window's events ----------------------------------------------------------------------

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
        lines += [f"- {window_text.escaped(text)}" for text in window.content.remarks]
        self._excluded.content = "\n".join(lines) or "no view is left out"
        self._label_exclude()
        window.photographs.tell()

    # --- how --------------------------------------------------------------------------------------

    def _set_options(self, views: list[int], excluded: Any) -> None:
        here = self._numbers.get(self._view.value)
        names = {f"view {v}" + (" (left out)" if v in excluded else ""): v for v in views}
        if names != self._numbers:
            self._numbers = names
            self._view.options = tuple(names) or (NONE,)
            label = next((k for k, v in names.items() if v == here), None)
            if label is not None:
                self._view.value = label

    def _label_exclude(self) -> None:
        view = self._numbers.get(self._view.value, -1)
        is_out = view in self._window.standing.state.excluded_views()
        label = "Take it in again" if is_out else "Leave it out"
        self._exclude.label = f"{label} (view {view})" if view >= 0 else label

    def _toggle(self) -> None:
        window, view = self._window, self.chosen
        is_out = view in window.standing.state.excluded_views()
        entry = window.session.set_view(view, not is_out, window.reviewer, self._why.value)
        self._why.value = ""
        window.decided(entry, f"view {view} is {'taken in again' if is_out else 'left out'}")
