"""What one browser keeps and says: its address, the reviewer's name, corrections not yet saved.

What a window looks at, as the fragment of its address: a link shows a colleague the same.

The page's script (`page.js`) hands the fragment over as an item of the browser's storage. Whoever
writes a link writes it, so that what is not understood is left out.

Where one browser looks from: at the whole scene, at an object, past an arm at work.
"""

import contextlib
import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated
from urllib.parse import parse_qs, urlencode

import msgspec
import numpy as np
from numpy.typing import ArrayLike

from realsim.arrays import Array
from realsim.geometry import se3

if TYPE_CHECKING:
    from realsim.review.window.window import Window


PLACE_KEY = "realsim place"
"""Name of the item that the page's script answers with the address."""
FAR_M = 1e4
"""A camera farther out than this is none of a scene's [m]."""
Point = tuple[float, float, float]


@dataclass(frozen=True, kw_only=True, slots=True)
class Place:
    """What is looked at, and from where."""

    scene: str = ""
    """Name of the session; '' = none was said."""
    instance: int | None = None
    eye: Point | None = None
    """Where the browser's camera stands [m]."""
    look_at: Point | None = None
    """What it looks at [m]."""

    def text(self, name: str = "") -> str:
        """Return the fragment; `name` is the object's, for the window's title."""
        said: dict[str, str] = {"scene": self.scene}
        if self.instance is not None:
            said |= {"instance": str(self.instance), "object": name[:80]}
        for key, point in (("eye", self.eye), ("at", self.look_at)):
            if point is not None:
                said[key] = ",".join(f"{v:.4f}" for v in point)
        return urlencode(said)

    @staticmethod
    def of(text: str) -> "Place":
        """Return the place that a fragment names; what is not understood is left out."""
        said: dict[str, str] = {}
        with contextlib.suppress(ValueError):  # too many fields
            said = {k: v[-1] for k, v in parse_qs(text[:2000], max_num_fields=20).items()}
        eye, at = _point(said.get("eye", "")), _point(said.get("at", ""))
        if eye is None or at is None or math.dist(eye, at) < 1e-3:
            eye = at = None
        return Place(
            scene=said.get("scene", ""), instance=_number(said.get("instance", "")),
            eye=eye, look_at=at,
        )  # fmt: skip


def point_of(p: ArrayLike) -> Point:
    """Return a point (3,) as plain numbers."""
    x, y, z = np.asarray(p, dtype=np.float64).reshape(3).tolist()
    return x, y, z


def _number(text: str) -> int | None:
    return int(text) if text.isascii() and text.isdigit() and len(text) < 10 else None


def _point(text: str) -> Point | None:
    parts = text.split(",")
    if len(parts) != 3:
        return None
    try:
        x, y, z = (float(p) for p in parts)
    except ValueError:
        return None
    return (x, y, z) if all(abs(v) <= FAR_M for v in (x, y, z)) else None


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


NEAR_MIDDLE_M = 0.02
"""An object nearer to the scene's middle than this has no outer side [m]."""
LOOK_DOWN_RAD = 0.7
"""Angle under which an object is looked at [rad]."""
LOOK_RADII, LOOK_M = 3.0, 0.1
"""Distance from which it is looked at: radii of its ball, and metres."""
BESIDE_RAD, BESIDE_DOWN_RAD = -0.7, 0.5
"""An arm at work is looked at from the far side of the object, and so much round and down."""
BEHIND_FIRST = 1.5
"""Distance of that look over the first look's: hand, object and forearm are seen."""


class Standpoint:
    """Moves one browser's camera."""

    def __init__(self, window: "Window") -> None:
        """Take whose camera it is."""
        self._window = window

    def eye(self) -> Array:
        """Return T_world_cam (4, 4) of the browser's camera, which looks along z with y down."""
        camera = self._window.client.camera
        return se3.from_rt(se3.from_quaternion_wxyz(camera.wxyz), camera.position)

    def first_look(self) -> None:
        """Look at the whole scene."""
        look = self._window.content.look
        self.look_from(look.position, look.look_at)

    def look_from(self, eye: ArrayLike, look_at: ArrayLike) -> None:
        """Stand at a place (3,) and look at another (3,), the table's normal up [m]."""
        camera = self._window.client.camera
        with self._window.client.atomic():
            camera.up_direction = self._window.content.look.up
            camera.position = np.asarray(eye, dtype=np.float64)
            camera.look_at = np.asarray(look_at, dtype=np.float64)

    def look_at_object(self) -> None:
        """Look at the selected object from outside of the scene, where no other stands before."""
        content, up = self._window.content, self._window.content.look.up
        center, radius_m = self._object()
        offset = center - content.region.center
        if np.linalg.norm(offset - up * (up @ offset)) < NEAR_MIDDLE_M:
            offset = content.look.position - content.region.center
        side = offset - up * (up @ offset)
        side = side / max(float(np.linalg.norm(side)), 1e-9)
        direction = np.cos(LOOK_DOWN_RAD) * side + np.sin(LOOK_DOWN_RAD) * up
        self.look_from(center + (LOOK_RADII * radius_m + LOOK_M) * direction, center)

    def look_past(self, base: Array) -> None:
        """Look at the selected object from afar, so that an arm on this base (3,) is beside it."""
        content, up = self._window.content, self._window.content.look.up
        center, _ = self._object()
        away = center - base
        away = away - up * (up @ away)
        away = away / max(float(np.linalg.norm(away)), 1e-9)
        side = se3.exp_so3(BESIDE_RAD * up) @ away
        direction = np.cos(BESIDE_DOWN_RAD) * side + np.sin(BESIDE_DOWN_RAD) * up
        distance = BEHIND_FIRST * float(np.linalg.norm(content.look.position - center))
        self.look_from(center + distance * direction, center)

    def _object(self) -> tuple[Array, float]:
        """Return the middle (3,) of the selected object in world, and the radius about it [m]."""
        placed = self._window.placed
        mesh = self._window.model_of(placed).mesh
        center = se3.transform(placed.T_world_obj, mesh.bounds.mean(0)[None])[0]
        return center, 0.5 * float(np.linalg.norm(mesh.extent))
