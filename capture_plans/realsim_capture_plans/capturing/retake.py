"""Take a stored view again: the earlier images are moved aside, never overwritten."""

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from realsim.records import View
from realsim.store.session_store import depth_path, rgb_path

if TYPE_CHECKING:
    from realsim.store import SessionStore

FOLDER = "retaken"
"""Where in a session the earlier images of a view lie: `retaken/000017_1_rgb.png` and so on."""


def replace_view(
    store: "SessionStore", view: View, rgb: NDArray[np.uint8], depth_m: NDArray[np.float32]
) -> str:
    """Store a view that is there already; return where the earlier one went.

    The earlier images and the robot's state are on the disk under their new names before the old
    names go: a kill in between leaves the earlier view aside and this one to be captured again.

    Args:
        store: the session.
        view: number, robot state and time of the new one.
        rgb: (H, W, 3) uint8.
        depth_m: (H, W) depth along z [m].
    """
    k = view.index
    stem = _free_stem(store, k)
    earlier = store.session.view(k)
    images = {"rgb": rgb_path(k)} | ({"depth": depth_path(k)} if store.has_depth(k) else {})
    for kind, path in images.items():
        store.write_bytes(f"{stem}_{kind}.png", store.path(path).read_bytes())
    store.write_json(
        f"{stem}.json",
        {
            "index": k,
            "T_base_ee": None if earlier.T_base_ee is None else earlier.T_base_ee.tolist(),
            "joints": None if earlier.joints is None else earlier.joints.tolist(),
            "time_s": earlier.time_s,
        },
    )
    for path in images.values():
        store.remove(path)
    store.add_view(view, rgb, depth_m)
    return stem


def _free_stem(store: "SessionStore", k: int) -> str:
    """Return the first name for view k that is not taken."""
    count = 1
    while store.has(f"{FOLDER}/{k:06d}_{count}.json"):
        count += 1
    return f"{FOLDER}/{k:06d}_{count}"
