"""Joint readings of an arm, by name and never by order, at any moment of a recording.

Joining by time: which frame belongs to which, and whether two clocks can be compared at all.
"""

from array import array
from collections.abc import Iterable, Sequence

import numpy as np
from numpy.typing import NDArray

from realsim.arrays import Array, Int64
from realsim.errors import InputError
from realsim.formats.bags.wire import NS_PER_S, JointMessage

UR_JOINTS = (
    "shoulder_pan_joint",
    "shoulder_lift_joint",
    "elbow_joint",
    "wrist_1_joint",
    "wrist_2_joint",
    "wrist_3_joint",
)
"""In the order of `DhArm`: base, shoulder, elbow, wrist 1, 2, 3."""
SPEED_WINDOW_NS = NS_PER_S // 20
"""Where no velocity was recorded, the speed is the difference over this much before and after:
neighbours 2 ms apart would only show the encoders' noise."""


def prefixes(names: Iterable[str], joints: Sequence[str] = UR_JOINTS) -> list[str]:
    """Return what stands before the joints' names, for every arm whose joints are all there."""
    names = set(names)
    first = joints[0]
    starts = sorted(n[: len(n) - len(first)] for n in names if n.endswith(first))
    return [s for s in starts if all(s + joint in names for joint in joints)]


class JointTrack:
    """The readings of one arm over time; grown by `add`, asked by `at`."""

    def __init__(self, prefix: str, joints: Sequence[str] = UR_JOINTS) -> None:
        """Start empty; `prefix` stands before the joints' names."""
        self._names = [prefix + joint for joint in joints]
        self._columns: dict[tuple[str, ...], list[int] | None] = {}
        self._times = array("q")
        self._q = array("d")
        self._dq = array("d")
        self._has_velocity = True
        self.times_ns: Int64 = np.zeros(0, dtype=np.int64)
        self.q: Array = np.zeros((0, len(self._names)))
        self.dq: Array | None = None

    def add(self, message: JointMessage, time_ns: int) -> bool:
        """Take over a reading; return False if it is not one of this arm (a gripper's, say)."""
        if message.names not in self._columns:
            there = all(name in message.names for name in self._names)
            columns = [message.names.index(name) for name in self._names] if there else None
            self._columns[message.names] = columns
        columns = self._columns[message.names]
        if columns is None or len(message.position) != len(message.names):
            return False
        q = message.position[columns]
        if not np.all(np.isfinite(q)):
            return False
        self._times.append(time_ns)
        self._q.frombytes(q.tobytes())
        if self._has_velocity and len(message.velocity) == len(message.names):
            self._dq.frombytes(message.velocity[columns].tobytes())
        else:
            self._has_velocity = False
        return True

    def finish(self) -> None:
        """Sort what was added; of readings with one time stamp the first counts."""
        times, order = np.unique(np.frombuffer(self._times, np.int64), return_index=True)
        self.times_ns = times
        self.q = np.frombuffer(self._q, np.float64).reshape(-1, len(self._names))[order]
        if self._has_velocity and len(self._dq):
            dq = np.frombuffer(self._dq, np.float64).reshape(self.q.shape[0], -1)[order]
            # Some publishers fill the field with zeros: that is no evidence of standing still.
            self.dq = dq if np.any(dq != 0) else None

    def check_radians(self, topic: str) -> None:
        """Check that the angles can be radians.

        Raises:
            InputError: they are beyond two turns.
        """
        worst = float(np.abs(self.q).max()) if len(self.q) else 0.0
        if worst > 4 * np.pi:
            raise InputError(
                f"{topic}: a joint angle is {worst:.1f}; radians within two turns (12.6) are "
                "expected. If they are degrees, convert the topic."
            )

    def at(self, time_ns: int, max_gap_s: float) -> tuple[Array, float] | None:
        """Return joints (n,) [rad] and the leading joint's speed [rad/s], or None in a gap."""
        weight = between(self.times_ns, time_ns, max_gap_s)
        if weight is None:
            return None
        i, j, s = weight
        q = (1 - s) * self.q[i] + s * self.q[j]
        return q, self._speed(time_ns, i, j)

    def _speed(self, time_ns: int, i: int, j: int) -> float:
        if self.dq is not None:
            return float(np.abs(self.dq[[i, j]]).max())
        low = max(0, int(np.searchsorted(self.times_ns, time_ns - SPEED_WINDOW_NS, "right")) - 1)
        high = int(np.searchsorted(self.times_ns, time_ns + SPEED_WINDOW_NS, "left"))
        low, high = min(low, i), max(min(high, len(self.times_ns) - 1), j)
        if low == high:
            return float("nan")
        seconds = (self.times_ns[high] - self.times_ns[low]) / NS_PER_S
        return float(np.abs(self.q[high] - self.q[low]).max() / seconds)


def between(times_ns: Int64, time_ns: int, max_gap_s: float) -> tuple[int, int, float] | None:
    """Return the neighbours i, j of a time and how far it is from i to j, or None in a gap.

    A time beyond the ends takes the end itself, up to half the gap.
    """
    n = len(times_ns)
    if n == 0:
        return None
    gap = max_gap_s * NS_PER_S
    j = int(np.searchsorted(times_ns, time_ns))
    if j < n and times_ns[j] == time_ns:
        return j, j, 0.0
    if j in (0, n):
        end = min(j, n - 1)
        return (end, end, 0.0) if abs(int(times_ns[end]) - time_ns) <= gap / 2 else None
    step = int(times_ns[j]) - int(times_ns[j - 1])
    if step > gap:
        return None
    return j - 1, j, (time_ns - int(times_ns[j - 1])) / step


MAX_PAIR_GAP_S = 0.1
"""Colour and depth farther apart than this are not one frame, however slow the camera runs."""
DEFAULT_PERIOD_S = 1 / 30
"""Period of a stream with a single frame, whose period nothing tells."""
CLOCK_GAP_S = 2.0
"""Recordings of one moment start and end within this; farther apart they have different clocks."""


def period_s(times_ns: Int64) -> float:
    """Return the usual time between two frames [s]: the median, so that gaps do not count."""
    steps = np.diff(np.unique(times_ns))
    return float(np.median(steps)) / NS_PER_S if len(steps) else DEFAULT_PERIOD_S


def nearest(sorted_ns: Int64, times_ns: Int64) -> NDArray[np.intp]:
    """Return the number of the nearest entry of `sorted_ns` (N >= 1) to every time."""
    right = np.clip(np.searchsorted(sorted_ns, times_ns), 1, max(1, len(sorted_ns) - 1))
    right = np.minimum(right, len(sorted_ns) - 1)
    left = np.maximum(right - 1, 0)
    is_left = times_ns - sorted_ns[left] <= sorted_ns[right] - times_ns
    return np.where(is_left, left, right).astype(np.intp)


def pairs(a_ns: Int64, b_ns: Int64, max_gap_s: float) -> NDArray[np.intp]:
    """Return (M, 2) numbers of entries of a and b that are each other's nearest in time.

    Both are sorted; mutual nearest neighbours make the join one to one whatever is missing.
    """
    if not len(a_ns) or not len(b_ns):
        return np.zeros((0, 2), dtype=np.intp)
    to_b, to_a = nearest(b_ns, a_ns), nearest(a_ns, b_ns)
    a = np.arange(len(a_ns))
    mutual = to_a[to_b] == a
    close = np.abs(b_ns[to_b] - a_ns) <= max_gap_s * NS_PER_S
    keep = mutual & close
    return np.stack([a[keep], to_b[keep]], -1).astype(np.intp)


def span(times_ns: Int64) -> str:
    """Return a range of time for a message to a person."""
    return f"{times_ns.min() / NS_PER_S:.3f} .. {times_ns.max() / NS_PER_S:.3f} s"


def check_overlap(a_name: str, a_ns: Int64, b_name: str, b_ns: Int64, clock: str) -> None:
    """Check that two topics can have been stamped by one clock.

    Raises:
        InputError: their ranges lie apart; the message has both and the offset.
    """
    gap = max(int(a_ns.min()) - int(b_ns.max()), int(b_ns.min()) - int(a_ns.max())) / NS_PER_S
    if gap <= CLOCK_GAP_S:
        return
    offset = (float(np.median(b_ns)) - float(np.median(a_ns))) / NS_PER_S
    remedy = (
        "If both were recorded together, join them by the recorder's clock (clock=receive)."
        if clock == "header"
        else "They were not recorded at the same time: leave one of the topics out."
    )
    raise InputError(
        f"the clocks of {a_name} ({span(a_ns)}) and {b_name} ({span(b_ns)}) do not overlap: they "
        f"are {gap:.1f} s apart, the second is {offset:+.3f} s off the first in the middle. "
        f"{remedy}"
    )
