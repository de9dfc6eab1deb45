"""Joining by time: which frame belongs to which, and whether two clocks can be compared at all."""

import numpy as np
from numpy.typing import NDArray

from realsim.arrays import Int64
from realsim.errors import InputError
from realsim.formats.bags.wire import NS_PER_S

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
