"""The cloud in a browser: the coarse level at once, finer pieces one by one behind it."""

import threading
import time
from collections.abc import Callable
from typing import Any

import numpy as np
import viser

from realsim.arrays import Rgb
from realsim.errors import InputError
from realsim.review.content.clouds import LeveledCloud
from realsim.review.content.config import SceneConfig

POINT_SHARE = 1.0
"""Size of a point over the distance of neighbours: a surface looks closed."""
PAUSE_S = 0.02
"""Between two pieces [s], and between two looks whether the last one has left: clicks come first.
"""


class CloudNodes:
    """The pieces of one cloud in one scene."""

    def __init__(self, api: viser.SceneApi, cloud: LeveledCloud, config: SceneConfig) -> None:
        """Send nothing yet."""
        self._api, self._cloud, self._config = api, cloud, config
        self._root: viser.FrameHandle | None = None
        self._pieces: list[slice] = []
        """All pieces of the whole cloud, in order."""
        self._handles: list[viser.PointCloudHandle] = []
        self._colors: Rgb | None = None
        self._wanted = 0
        self._sender: threading.Thread | None = None
        self._lock = threading.RLock()

    def build(self) -> None:
        """Send the coarse level."""
        with self._lock:
            self._root = self._api.add_frame("/cloud", show_axes=False)
            self._pieces = self._cloud.pieces(len(self._cloud), self._config.piece_points)
            if self._pieces:
                self._send(0)

    def refine(self, points: int | None = None, after: Callable[[], None] = lambda: None) -> None:
        """Send pieces in the background until there are about so many points.

        Args:
            points: how many; None = all.
            after: returns when the first of them may leave; called in the background.
        """
        with self._lock:
            most = len(self._cloud) if points is None else points
            self._wanted = max(self._wanted, sum(p.start < most for p in self._pieces))
            if self._sender is None and len(self._handles) < self._wanted:
                self._sender = threading.Thread(target=self._send_rest, args=(after,), daemon=True)
                self._sender.start()

    def wait(self, timeout_s: float | None = None) -> bool:
        """Wait until all that was asked for is sent; return whether it is."""
        sender = self._sender
        if sender is not None:
            sender.join(timeout_s)
        return self._sender is None

    def show(self, visible: bool) -> None:
        """Show or hide the points."""
        if self._root is not None:
            self._root.visible = visible

    def color(self, colors: Rgb | None) -> None:
        """Colour all points (N, 3), those to come too; None = as photographed.

        Raises:
            InputError: another number of colours.
        """
        if colors is not None and np.shape(colors) != self._cloud.points.shape:
            raise InputError(
                f"colours of shape {np.shape(colors)} for the cloud's {len(self._cloud)} points; "
                f"{self._cloud.points.shape} is needed."
            )
        with self._lock:
            self._colors = None if colors is None else np.asarray(colors, dtype=np.uint8)
            shown = self._cloud.colors if self._colors is None else self._colors
            for piece, handle in zip(self._pieces, self._handles, strict=False):
                handle.colors = shown[piece]

    def clear(self) -> None:
        """Take the points away, and stop sending."""
        with self._lock:
            self._wanted, self._handles, self._pieces = 0, [], []
            if self._root is not None:
                self._root.remove()
                self._root = None

    def _send_rest(self, after: Callable[[], None]) -> None:
        """Send one piece after the other while more are wanted."""
        after()
        while True:
            with self._lock:
                enough = len(self._handles) >= self._wanted
                if self._root is None or enough or self._buffer().done:
                    self._sender = None
                    return
                self._send(len(self._handles))
            time.sleep(PAUSE_S)
            while self._is_waiting():
                time.sleep(PAUSE_S)

    def _is_waiting(self) -> bool:
        """Return whether the browser has yet to be sent what was queued for it.

        A server's own scene is kept for browsers to come and is never empty: it is not asked.
        """
        buffer = self._buffer()
        return not (buffer.persistent_messages or buffer.done) and bool(buffer.message_from_id)

    def _buffer(self) -> Any:
        """Return viser's queue of messages; it is done when the browser is gone."""
        return self._api._websock_interface.get_message_buffer()  # pyright: ignore[reportPrivateUsage]

    def _send(self, k: int) -> None:
        piece = self._pieces[k]
        shown = self._cloud.colors if self._colors is None else self._colors
        # The more points there are, the smaller each is.
        size = POINT_SHARE * self._cloud.spacing_m(piece.stop)
        for handle in self._handles:
            handle.point_size = size
        # In float32: viser's float16 has steps of 1 mm a metre away.
        handle = self._api.add_point_cloud(
            f"/cloud/{k}", self._cloud.points[piece], shown[piece],
            point_size=size, point_shape="circle", point_shading="flat", precision="float32",
        )  # fmt: skip
        # All windows share the places: what a handle keeps would be a copy for each of them.
        handle._impl.props.points = self._cloud.points[piece]  # pyright: ignore
        self._handles.append(handle)
