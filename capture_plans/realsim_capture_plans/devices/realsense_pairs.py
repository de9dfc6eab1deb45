"""Depth and colour frames that belong together, from the SDK's threads to the one that grabs.

The SDK's own framesets may join depth with the colour of another frame, so pairs are made here:
streams of one sensor count their frames together and pair by frame number; sensors of their own
count on their own and pair by time stamp, within half a frame.
"""

import threading
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Literal

DEPTH, COLOR = 0, 1
LIVE_PAIRS = 4
"""Pairs kept while nobody grabs; older ones give way, a live frame is worth nothing later."""
RECORDED_PAIRS = 8
"""Pairs kept of a recording before its reader has to wait: 37 MB at 1280x720."""
UNPAIRED = 32
"""Frames kept per stream that wait for their partner: about a second."""
CLOCKS_TOLD = 2
"""Domains named in the message when depth and colour are stamped by different clocks."""


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Pair:
    """A depth frame and the colour frame of the same exposure (pyrealsense2 frames)."""

    depth: Any
    color: Any


class PairBuffer:
    """Collects frames of two streams, hands out pairs in the order in which they came."""

    def __init__(
        self, by: Literal["number", "time"], *, half_frame_ms: float, lossless: bool
    ) -> None:
        """Prepare an empty buffer.

        Args:
            by: what pairs are made by.
            half_frame_ms: greatest difference of time stamps of a pair [ms]; used by "time".
            lossless: True makes the SDK wait when the buffer is full (recordings), False lets
                the oldest pair go (live cameras).
        """
        self._by = by
        self._half_frame_ms = half_frame_ms
        self._lossless = lossless
        self._pairs: deque[Pair] = deque(maxlen=None if lossless else LIVE_PAIRS)
        self._waiting: tuple[deque[Any], deque[Any]] = (deque(), deque())
        self._last_number: list[int | None] = [None, None]
        self._changed = threading.Condition()
        self._closed = self._ended = False
        self.received = [0, 0]
        """Frames that came, depth and colour."""

    def taker(self, kind: int) -> Callable[[Any], None]:
        """Return the function that takes the frames of one stream, DEPTH or COLOR."""

        def take(frame: Any) -> None:
            frame.keep()  # the SDK's pool is small; kept frames do not count
            self._put(kind, frame)

        return take

    def _put(self, kind: int, frame: Any) -> None:
        with self._changed:
            number = int(frame.get_frame_number())
            if self._closed or number == self._last_number[kind]:
                return  # recordings may hold a frame twice
            self._last_number[kind] = number
            self.received[kind] += 1
            partner = self._partner(kind, frame)
            if partner is None:
                own = self._waiting[kind]
                own.append(frame)
                if len(own) > UNPAIRED:
                    own.popleft()
                return
            depth, color = (frame, partner) if kind == DEPTH else (partner, frame)
            self._pairs.append(Pair(depth=depth, color=color))
            self._changed.notify_all()
            while self._lossless and len(self._pairs) > RECORDED_PAIRS and not self._closed:
                self._changed.wait()

    def _partner(self, kind: int, frame: Any) -> Any:
        """Take the partner of a frame out of the other stream's; None where it is not there."""
        others = self._waiting[1 - kind]
        if self._by == "number":
            found = [f for f in others if f.get_frame_number() == frame.get_frame_number()]
        else:
            domain = frame.get_frame_timestamp_domain()
            near = sorted(
                (abs(f.get_timestamp() - frame.get_timestamp()), k)
                for k, f in enumerate(others)
                if f.get_frame_timestamp_domain() == domain
            )
            found = [others[k] for dt, k in near[:1] if dt <= self._half_frame_ms]
        if not found:
            return None
        while others:  # what is older than the partner of a newer frame stays alone
            other = others.popleft()
            if other is found[0]:
                break
        return found[0]

    def next(self, timeout_s: float) -> Pair | None:
        """Return the next pair; None if none came in time [s] or the recording has ended."""
        with self._changed:
            self._changed.wait_for(
                lambda: bool(self._pairs) or self._ended or self._closed, timeout_s
            )
            pair = self._pairs.popleft() if self._pairs else None
            self._changed.notify_all()
            return pair

    def clear(self) -> None:
        """Forget the pairs that are there; frames that wait for a partner stay."""
        with self._changed:
            self._pairs.clear()
            self.received = [0, 0]
            self._changed.notify_all()

    def end(self) -> None:
        """Note that no more frames will come: the recording is over."""
        with self._changed:
            self._ended = True
            self._changed.notify_all()

    def close(self) -> None:
        """Let go of every frame and of everybody who waits."""
        with self._changed:
            self._closed = True
            self._pairs.clear()
            for waiting in self._waiting:
                waiting.clear()
            self._changed.notify_all()

    @property
    def ended(self) -> bool:
        """Whether the recording is over."""
        return self._ended

    def why_none(self) -> str:
        """Return what came instead of a pair, for a message."""
        with self._changed:
            depth, color = self.received
            if depth == color == 0:
                return "neither depth nor colour came"
            if depth == 0 or color == 0:
                return f"only {'colour' if depth == 0 else 'depth'} came"
            lasts = [w[-1] for w in self._waiting if w]
            clocks = {str(f.get_frame_timestamp_domain()).rsplit(".", 1)[-1] for f in lasts}
            if len(clocks) == CLOCKS_TOLD and self._by == "time":
                return f"depth and colour are stamped by different clocks ({', '.join(clocks)})"
            said = " and ".join(
                f"{name} frame {w[-1].get_frame_number()} at {w[-1].get_timestamp():.1f} ms"
                for name, w in zip(("depth", "colour"), self._waiting, strict=True)
                if w
            )
            by = "frame number" if self._by == "number" else "time stamp"
            return f"depth and colour never had the same {by}" + (
                f" (last: {said})" if said else ""
            )
