"""What one browser keeps and says: its address, the reviewer's name, corrections not yet saved."""

import contextlib
from typing import TYPE_CHECKING, Annotated

import msgspec

from realsim.review.window.place import PLACE_KEY, Place, point_of

if TYPE_CHECKING:
    from realsim.review.window.window import Window

NAME_KEY = "realsim reviewer"
"""Under which the browser keeps the reviewer's name."""
DRAFTS_KEY = "realsim corrections"
"""Under which it keeps the corrections that were not saved."""
NAME_WAIT_S = 60.0
"""How long a browser is waited for that does not tell the name it keeps [s]; nothing else waits."""
ANSWER_WAIT_S = 10.0
"""How long a browser is waited for that does not tell its address or what it keeps, or has not done
what was sent before [s]: one without a graphics card is still drawing then."""


class Draft(msgspec.Struct, frozen=True, kw_only=True):
    """A correction that is not saved: it outlives a reload and a lost connection."""

    scene: str
    """Folder of the session."""
    instance: int
    obj_id: int
    """What the object is said to be."""
    registered: int = -1
    """What it was by the registration; -1 = not known."""
    stood: str
    """`journal.subject_of` the object as it stood when the reviewer saw it last."""
    how: tuple[str, ...]
    pose: Annotated[tuple[float, ...], msgspec.Meta(min_length=16, max_length=16)]
    """T_world_obj, row by row [m]."""


class Browser:
    """The storage and the address of one browser."""

    def __init__(self, window: "Window") -> None:
        """Take whose browser it is; nothing is asked yet."""
        self._window = window
        self._told = ""
        self.drafts: dict[tuple[str, int], Draft] = {}
        """Corrections that are not saved, by folder of the session and instance."""

    def wait(self) -> None:
        """Wait until the browser has done what was sent before."""
        self._asked(PLACE_KEY, ANSWER_WAIT_S)

    def name(self) -> str:
        """Return the reviewer's name that it keeps; '' = none."""
        return self._asked(NAME_KEY, NAME_WAIT_S)

    def keep_name(self, name: str) -> None:
        """Keep the reviewer's name."""
        self._window.client.local_storage.set_item(NAME_KEY, name.strip())

    def keep_drafts(self, drafts: dict[tuple[str, int], Draft]) -> None:
        """Keep the corrections that are not saved, if they are others than before."""
        if drafts != self.drafts:
            gone = [d for key, d in self.drafts.items() if key not in drafts]
            new = [d for key, d in drafts.items() if self.drafts.get(key) != d]
            self.drafts = drafts
            text = msgspec.json.encode({"set": new, "gone": gone}).decode()
            self._window.client.local_storage.set_item(DRAFTS_KEY, text)

    def read_drafts(self) -> None:
        """Take the corrections that the browser keeps; none where they are not understood."""
        text = self._asked(DRAFTS_KEY, ANSWER_WAIT_S) or "[]"
        with contextlib.suppress(msgspec.DecodeError):
            found = msgspec.json.decode(text, type=list[Draft])
            self.drafts = {(d.scene, d.instance): d for d in found}

    def looks_at(self) -> str:
        """Return who looks at what here, in words for the others."""
        window = self._window
        name = window.reviewer.strip() or "somebody"
        if not window.is_open or window.selected is None:
            return f"{name} is here"
        does = "looks at" if window.correct.moved is None else "corrects"
        return f"{name} {does} {window.selected} {window.model_of(window.placed).name}"

    def go_to_place(self) -> bool:
        """Show what the address names; return whether it names a scene that is here."""
        window = self._window
        place = Place.of(self._asked(PLACE_KEY, ANSWER_WAIT_S))
        names = [s.name for s in window.server.sessions]
        if place.scene not in names:
            return False
        number = names.index(place.scene)
        known = {o.instance for o in window.server.sessions[number].registered.objects}
        window.go_to(number, place.instance if place.instance in known else None)
        if place.eye is not None and place.look_at is not None:
            window.stand.look_from(place.eye, place.look_at)
        return True

    def tell_place(self, scene: str) -> None:
        """Write into the address what is looked at."""
        window, camera = self._window, self._window.client.camera
        place = Place(
            scene=scene, instance=window.selected,
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
