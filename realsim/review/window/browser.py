"""What one browser keeps and says: its address, and the reviewer's name."""

from typing import TYPE_CHECKING

from realsim.review.window.place import PLACE_KEY, Place, point_of

if TYPE_CHECKING:
    from realsim.review.window.window import Window

NAME_KEY = "realsim reviewer"
"""Under which the browser keeps the reviewer's name."""
NAME_WAIT_S = 60.0
"""How long a browser is waited for that does not tell the name it keeps [s]; nothing else waits."""
PLACE_WAIT_S = 1.5
"""How long a browser is waited for that does not tell its address [s]."""
TURNED_WAIT_S = 10.0
"""How long it may take a browser to do what was sent before [s]: one without a graphics card is
still drawing then."""


class Browser:
    """The storage and the address of one browser."""

    def __init__(self, window: "Window") -> None:
        """Take whose browser it is; nothing is asked yet."""
        self._window = window
        self._told = ""

    def wait(self) -> None:
        """Wait until the browser has done what was sent before."""
        self._window.client.flush()
        self._asked(PLACE_KEY, TURNED_WAIT_S)

    def name(self) -> str:
        """Return the reviewer's name that it keeps; '' = none."""
        return self._asked(NAME_KEY, NAME_WAIT_S)

    def keep_name(self, name: str) -> None:
        """Keep the reviewer's name."""
        self._window.client.local_storage.set_item(NAME_KEY, name.strip())

    def go_to_place(self) -> bool:
        """Show what the address names; return whether it names a scene that is here."""
        window = self._window
        place = Place.of(self._asked(PLACE_KEY, PLACE_WAIT_S))
        names = [s.name for s in window.server.sessions]
        if place.scene not in names:
            return False
        number = names.index(place.scene)
        known = {o.instance for o in window.server.sessions[number].registered.objects}
        window.go_to(number, place.instance if place.instance in known else None)
        if place.view is not None and place.view in {v.index for v in window.content.views}:
            window.views.stand_in(place.view)
        elif place.eye is not None and place.look_at is not None:
            window.views.look_from(place.eye, place.look_at)
        return True

    def tell_place(self, scene: str) -> None:
        """Write into the address what is looked at."""
        window, camera = self._window, self._window.client.camera
        place = Place(
            scene=scene, instance=window.selected, view=window.views.current,
            eye=point_of(camera.position), look_at=point_of(camera.look_at),
        )  # fmt: skip
        name = "" if window.selected is None else window.model_of(window.placed).name
        text = place.text(name)
        if text != self._told:
            self._told = text
            window.client.local_storage.set_item(PLACE_KEY, text)

    def _asked(self, key: str, timeout_s: float) -> str:
        """Return what is kept under a key; '' of a browser that keeps or says nothing."""
        try:
            return self._window.client.local_storage.get_item(key, timeout=timeout_s) or ""
        except (RuntimeError, TimeoutError):
            return ""
