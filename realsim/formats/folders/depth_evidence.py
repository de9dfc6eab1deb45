"""What 16-bit depth images say of their own unit and coding, where nobody else does.

A count may be a millimetre or a tenth of one, and nothing in the file says which: the distances
that each would give are shown, and the person chooses. A coding that rotates the bits leaves traces
that no plain depth has, so it is recognised.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np

from realsim import images
from realsim.arrays import Counts, evenly
from realsim.errors import InputError, UnitError

DepthCoding = Literal["plain", "apc"]
ROTATION_BITS = 3
"""The apc coding turns the 16 bits by three: d = (v >> 3) | (v << 13)."""
LOW_BITS_ZERO_SHARE = 0.9
"""Share of the pixels whose low three bits are zero from which the counts may be no plain depth:
of a sensor's counts one in eight is; the highest three bits of a table's depth are zero mostly."""
WRAP_COUNTS = 8192
"""A step between neighbours that no surface has: the turned bits overflow by 65536."""
WRAPS_GONE = 0.1
"""Turning the bits back must leave at most this share of such steps."""
SAMPLES = 5
"""Images looked at; they stand for all, since one program wrote them."""
KNOWN_UNITS: tuple[tuple[float, str], ...] = (
    (0.001, "D415, D435, Kinect, BOP with depth_scale 1"),
    (0.0001, "D405, SR300, BOP with depth_scale 0.1"),
    (0.00025, "L515"),
    (0.0002, "TUM RGB-D"),
)
"""Metres per count of the usual cameras and data sets."""
NEAREST_M, FARTHEST_M = 0.03, 30.0
"""No depth camera measures a median nearer or farther."""


@dataclass(frozen=True, kw_only=True, slots=True)
class DepthEvidence:
    """What sampled depth images show."""

    median_plain: float
    """Median count as stored; NaN where all are empty."""
    median_apc: float
    """Median count with the bits turned back."""
    low_bits_zero: float
    """Share of the counts whose low three bits are zero."""
    wraps_plain: int
    """Steps beyond WRAP_COUNTS between neighbours, as stored."""
    wraps_apc: int
    """The same with the bits turned back."""
    filled: float
    """Share of pixels with depth."""

    @property
    def looks_rotated(self) -> bool:
        """Whether the bits are turned beyond doubt: overflows that go away.

        Of plain depth turning makes overflows everywhere, unless all counts are multiples of
        eight, and then there is doubt.
        """
        return (
            self.low_bits_zero < 1.0
            and self.wraps_plain > 0
            and self.wraps_apc <= WRAPS_GONE * self.wraps_plain
        )

    @property
    def may_be_rotated(self) -> bool:
        """Whether all counts are multiples of eight: coarse depth, or turned bits."""
        return self.low_bits_zero >= LOW_BITS_ZERO_SHARE

    def median(self, coding: DepthCoding) -> float:
        """Return the median count under a coding."""
        return self.median_apc if coding == "apc" else self.median_plain


def decoded(counts: Counts, coding: DepthCoding) -> Counts:
    """Return depth counts with the bits turned back where the coding turns them."""
    if coding == "plain":
        return counts
    # uint16 << 13 keeps the 16 bits: what overflows is what the shift to the right has kept.
    back = (counts >> ROTATION_BITS) | (counts << (16 - ROTATION_BITS))
    return back.astype(np.uint16, copy=False)


def depth_evidence(paths: Sequence[Path]) -> DepthEvidence:
    """Return what some of these depth images, spread over all, show."""
    sampled = [images.read_counts(p) for p in evenly(paths, SAMPLES)]
    values = np.concatenate([c[c > 0] for c in sampled])
    total = sum(c.size for c in sampled)
    if not len(values):
        nan = float("nan")
        return DepthEvidence(
            median_plain=nan, median_apc=nan, low_bits_zero=0.0, wraps_plain=0, wraps_apc=0,
            filled=0.0,
        )  # fmt: skip
    low = (1 << ROTATION_BITS) - 1
    return DepthEvidence(
        median_plain=float(np.median(values)),
        median_apc=float(np.median(decoded(values, "apc"))),
        low_bits_zero=float(np.mean((values & low) == 0)),
        wraps_plain=sum(_wraps(c) for c in sampled),
        wraps_apc=sum(_wraps(decoded(c, "apc")) for c in sampled),
        filled=len(values) / total,
    )


def _wraps(counts: Counts) -> int:
    a, b = counts[:, 1:].astype(np.int64), counts[:, :-1].astype(np.int64)
    return int(np.sum((np.abs(a - b) > WRAP_COUNTS) & (a > 0) & (b > 0)))


def coding_of(evidence: DepthEvidence, said: str, where: str) -> tuple[DepthCoding, str]:
    """Return the coding of the depth and, where it is not the plain one, why.

    Args:
        evidence: what the images show.
        said: "plain", "apc", or "auto".
        where: the folder, for messages.

    Raises:
        InputError: not known, or the images leave two codings open that differ eightfold.
    """
    low = f"the low three bits are zero in {100 * evidence.low_bits_zero:.1f} % of the pixels"
    if said == "apc":
        return "apc", f"depth bits turned back (d = v >> 3 | v << 13) as asked; {low}."
    if said == "plain":
        return "plain", ""
    if said != "auto":
        raise InputError(f"the depth coding '{said}' is not known; auto, plain and apc are.")
    if evidence.looks_rotated:
        return "apc", (
            "the depth is stored with its bits turned by three (apc-vision-toolbox) and was "
            f"turned back, d = v >> 3 | v << 13: {low} (12.5 % in plain depth), and "
            f"{evidence.wraps_plain} steps of more than {WRAP_COUNTS} counts between neighbours "
            f"become {evidence.wraps_apc}."
        )
    if evidence.may_be_rotated:
        raise InputError(
            f"{where}: {low}. Either the depth has steps of eight counts, or its bits are turned "
            f"by three (apc-vision-toolbox), which is eight times less: a median of "
            f"{evidence.median_plain:.0f} or of {evidence.median_apc:.0f} counts. Say "
            "--depth-coding plain or --depth-coding apc."
        )
    return "plain", ""


def unit_choices(evidence: DepthEvidence, coding: DepthCoding) -> str:
    """Return in words what distance each usual unit would give."""
    median = evidence.median(coding)
    said = [f"{median * unit:.3g} m with {unit:g} ({name})" for unit, name in KNOWN_UNITS]
    return f"the median depth of {median:.0f} counts would be {', '.join(said)}"


def require_unit(
    unit_m: float | None, evidence: DepthEvidence, coding: DepthCoding, where: str
) -> float:
    """Return the depth unit [m] if it is given and possible.

    Raises:
        InputError: it is not given; the message lists what each usual unit would mean.
        UnitError: with it the scene is nearer or farther than a depth camera measures.
    """
    if unit_m is None:
        raise InputError(
            f"{where}: depth images of 16 bit do not say what a count is, and nothing else in the "
            f"folder does: {unit_choices(evidence, coding)}. How far was the scene? Give "
            "--depth-unit in metres per count, or --no-depth."
        )
    median_m = evidence.median(coding) * unit_m
    if median_m < NEAREST_M or median_m > FARTHEST_M:  # NaN (no depth at all) passes
        raise UnitError(
            f"{where}: with {unit_m:g} m per count the median depth is {median_m:.3g} m, which no "
            f"depth camera measures ({NEAREST_M:g} to {FARTHEST_M:g} m); "
            f"{unit_choices(evidence, coding)}."
        )
    return unit_m
