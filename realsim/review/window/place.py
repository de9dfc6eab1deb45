"""What a window looks at, as the fragment of its address: a link shows a colleague the same.

The page's script (`page.js`) hands the fragment over as an item of the browser's storage. Whoever
writes a link writes it, so that what is not understood is left out.
"""

import contextlib
import math
from dataclasses import dataclass
from urllib.parse import parse_qs, urlencode

import numpy as np
from numpy.typing import ArrayLike

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
