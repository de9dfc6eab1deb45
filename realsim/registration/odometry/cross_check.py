"""Whether the depth images agree with the robot about where the camera was.

Pairs of neighbouring views are aligned by KISS-ICP and by the table, and compared with what forward
kinematics say. It names what is grossly wrong: a view taken while moving, a mount that slipped,
images that belong to other poses. It cannot verify a good robot: a pair is measured to about 0.5 mm
and 0.1 degrees, which is what a hand-eye calibration leaves.
"""

import time
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from realsim.arrays import Array
from realsim.errors import InputError
from realsim.geometry import se3
from realsim.json_values import json_value
from realsim.records import SupportPlane
from realsim.registration.odometry.faults import (
    LEAST_DEG,
    LEAST_MM,
    PoseFault,
    differences,
    find_faults,
    noise_of,
)
from realsim.registration.odometry.mismatch import Mismatch, find_mismatches, has_failed
from realsim.registration.odometry.pairs import (
    LEAST_POINTS,
    Edge,
    FitConfig,
    PairMeter,
    ViewCloud,
    further_pairs,
    neighbour_pairs,
    relative,
    view_angles,
    view_cloud,
)
from realsim.registration.views import ViewPoints

AXES = ("x (to the image's right)", "y (down in the image)", "z (along the line of sight)")


def fault_words(fault: PoseFault, numbers: Sequence[int]) -> str:
    """Return a sentence about a wrong view, or about what changed from a view on."""
    size = f"{fault.mm:.1f} mm / {fault.deg:.1f} deg"
    view = numbers[fault.place]
    if fault.kind == "view":
        return (
            f"view {view}: its depth disagrees with its robot pose by {size}; its neighbours "
            "agree: it was taken while moving, or image and pose are not of the same view."
        )
    either = " (it may as well be " if fault.alternative else ""
    if fault.kind == "mount":
        axis = AXES[int(np.argmax(np.abs(fault.twist[:3])))]
        other = f"{either}the table or the robot's base that was moved)" if either else ""
        return (
            f"from view {view} on: the camera's mount slipped by about {size}, mostly about its "
            f"axis {axis}{other}; fix it, and calibrate again from view {view} on."
        )
    other = f"{either}the camera's mount that slipped)" if either else ""
    return (
        f"from view {view} on: the table, the robot's base or all objects were moved by about "
        f"{size}{other}; treat the views from {view} on as another scene."
    )


def mismatch_words(mismatch: Mismatch, numbers: Sequence[int]) -> str:
    """Return a sentence about images at wrong poses."""
    view = numbers[mismatch.place]
    if mismatch.kind == "swapped":
        return f"the images (or poses) of views {view} and {numbers[mismatch.other]} are swapped."
    if mismatch.kind == "other":
        return (
            f"view {view}: its image fits the pose of view {numbers[mismatch.other]}; image and "
            "pose are not of the same view."
        )
    by = abs(mismatch.other)
    ahead = mismatch.other > 0
    lost = "an image was skipped" if ahead else "a pose was skipped, or an image came twice"
    return (
        f"from view {view} on: every image fits the pose {by} {'later' if ahead else 'earlier'} in "
        f"the list; {lost} there."
    )


def unmatched_words(view: int) -> str:
    """Return a sentence about a view that could be aligned with none."""
    return (
        f"view {view}: its depth fits nothing that the views around it see; it is of another "
        "scene, something was moved, or its pose is off by more than 3 cm."
    )


FURTHER = 2
"""More pairs for a view that a pair makes suspect."""
FURTHER_SHARE = 0.35
"""Unless more than this share of the views is suspect: then there are pairs enough."""
SEED = 0
"""Seed of the random search for a table that is not where it should be."""


@dataclass(frozen=True, kw_only=True, slots=True)
class ViewDifference:
    """How far one view's depth is from its robot pose."""

    index: int
    """Number of the view."""
    mm: float
    """Shift of the camera [mm]; of a view after a change, the change included; NaN = unknown."""
    deg: float
    """Turn of the camera [deg]; after a change it includes the change; NaN = unknown."""
    pairs: int
    """Pairs it was measured from."""
    overlap: float
    """Median overlap of those."""


@dataclass(frozen=True, kw_only=True, slots=True)
class Fault:
    """Something grossly wrong, by view number."""

    kind: str
    """view, mount, world, swapped, other, shifted, unmatched."""
    view: int
    """The view, or the first one after the change."""
    other: int | None
    """The view whose pose it fits; of a shift, how many poses ahead."""
    mm: float
    """Size [mm]; NaN where images and poses are mixed up."""
    deg: float
    """Size [deg]; NaN where images and poses are mixed up."""
    words: str
    """A sentence."""


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class KinematicsCheck:
    """What the depth images say about the robot's poses."""

    views: tuple[ViewDifference, ...]
    faults: tuple[Fault, ...]
    noise_mm: float
    """Median difference of a pair [mm], faults left aside."""
    noise_deg: float
    """Median turn of a pair [deg], faults left aside."""
    pairs: int
    """Pairs that were aligned."""
    unchecked: tuple[tuple[int, str], ...]
    """Views that could not be checked, and why."""
    cpu_s: float
    """CPU time [s]."""

    @property
    def good(self) -> bool:
        """Whether nothing grossly wrong was found."""
        return not self.faults

    def words(self) -> tuple[str, ...]:
        """Return sentences for a person."""
        checked = len(self.views) - len(self.unchecked)
        said = [
            f"depth agrees with the robot's poses within {self.noise_mm:.1f} mm and "
            f"{self.noise_deg:.2f} deg from view to view ({checked} of {len(self.views)} views, "
            f"{self.pairs} pairs); smaller errors cannot be seen this way."
        ]
        said += [f.words for f in self.faults]
        said += [f"view {k} could not be checked: {why}" for k, why in self.unchecked]
        return tuple(said)

    def as_json(self) -> dict[str, Any]:
        """Return everything as numbers, strings and lists; NaN becomes None."""
        return {
            "good": self.good,
            "noise_mm": self.noise_mm,
            "noise_deg": self.noise_deg,
            "pairs": self.pairs,
            "cpu_s": self.cpu_s,
            "views": json_value(self.views),
            "faults": json_value(self.faults),
            "unchecked": [{"index": k, "reason": why} for k, why in self.unchecked],
            "words": list(self.words()),
        }


def check_kinematics(views: Sequence[ViewPoints], plane: SupportPlane | None) -> KinematicsCheck:
    """Return how far the depth images are from the robot's poses, and what is grossly wrong.

    Args:
        views: in the order in which they were captured, at the poses that forward kinematics claim.
        plane: the table in world; None = the largest plane of each view.

    Raises:
        InputError: fewer than two views hold anything above the table.
    """
    began = time.process_time()
    rng = np.random.default_rng(SEED)
    clouds = [view_cloud(v, plane, rng) for v in views]
    use = [k for k, c in enumerate(clouds) if len(c.source) >= LEAST_POINTS]
    if len(use) < 2:
        raise InputError(
            f"{len(use)} of {len(views)} views hold at least {LEAST_POINTS} averaged "
            "points above the table; the robot's poses can be checked from two on. Is anything on "
            "the table, and is the table's height right?"
        )
    empty = set(range(len(views))) - set(use)
    claimed = np.stack([views[k].T_world_cam for k in use])
    found = _examine([clouds[k] for k in use], claimed)
    numbers = [views[k].index for k in use]
    faults = [
        Fault(kind=m.kind, view=numbers[m.place],
              other=m.other if m.kind == "shifted" else numbers[m.other], mm=np.nan, deg=np.nan,
              words=mismatch_words(m, numbers))
        for m in found.mismatches
    ]  # fmt: skip
    faults += [
        Fault(kind=f.kind, view=numbers[f.place], other=None, mm=f.mm, deg=f.deg,
              words=fault_words(f, numbers))
        for f in found.faults
    ]  # fmt: skip
    faults += [
        Fault(kind="unmatched", view=numbers[k], other=None, mm=np.nan, deg=np.nan,
              words=unmatched_words(numbers[k]))
        for k in found.unmatched
    ]  # fmt: skip
    twists = dict(zip(use, found.twists, strict=True))
    return KinematicsCheck(
        views=tuple(_difference(v.index, twists.get(k, ())) for k, v in enumerate(views)),
        faults=tuple(faults),
        noise_mm=found.noise_mm,
        noise_deg=found.noise_deg,
        pairs=found.pairs,
        unchecked=tuple(
            (views[k].index, f"only {len(clouds[k].source)} averaged points above the table")
            for k in sorted(empty)
        ) + tuple((numbers[k], "no pose is left for its image") for k in found.poseless),
        cpu_s=time.process_time() - began,
    )  # fmt: skip


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class _Found:
    """What was found, in places of the usable views."""

    mismatches: tuple[Mismatch, ...]
    faults: tuple[PoseFault, ...]
    unmatched: tuple[int, ...]
    poseless: tuple[int, ...]
    twists: list[list[tuple[Array, float]]]
    """What the pairs of each view say about its pose (6,), and their overlaps."""
    noise_mm: float
    noise_deg: float
    pairs: int


def _examine(clouds: Sequence[ViewCloud], claimed: Array) -> _Found:
    """Return mismatches first, then the faults of the poses that the images do belong to."""
    meter = PairMeter(clouds, FitConfig())
    aim = _middle(clouds, claimed)
    angles = view_angles(claimed, aim)
    everyone = list(range(len(claimed)))
    edges = _measure_pairs(meter, claimed, angles, everyone)
    mismatches, poses = find_mismatches(meter, claimed, edges, angles)
    Ts = claimed[np.maximum(poses, 0)]
    kept = [k for k in everyone if poses[k] >= 0]
    if mismatches:
        angles = view_angles(Ts, aim)
        edges = _measure_pairs(meter, Ts, angles, kept)
    trusted = [e for e in edges if not has_failed(e)]
    faults, mended = find_faults(Ts, trusted, aim)
    noise = noise_of(differences(mended, trusted))
    paired = {k for e in trusted for k in (e.first, e.second)}
    unmatched = [k for k in kept if k not in paired]
    # Where a pose was skipped, the image before the shift has none; it is not a fault of its own.
    # Which of two neighbours it is cannot be told where it fits neither pose.
    back = [m for m in mismatches if m.kind == "shifted" and m.other < 0]
    skipped = {m.place - n for m in back for n in range(1 - m.other)}
    odd = {f.place for f in faults if f.kind == "view"} | set(unmatched)
    poseless = sorted({k for k in everyone if poses[k] < 0} | (skipped & odd))
    faults = tuple(f for f in faults if f.kind != "view" or f.place not in skipped)
    return _Found(
        mismatches=mismatches,
        faults=faults,
        unmatched=tuple(k for k in unmatched if k not in skipped),
        poseless=tuple(poseless),
        twists=[_twists(k, Ts, mended, trusted) for k in everyone],
        noise_mm=noise.mm,
        noise_deg=noise.deg,
        pairs=len(edges),
    )


def _measure_pairs(meter: PairMeter, Ts: Array, angles: Array, kept: Sequence[int]) -> list[Edge]:
    """Return the pairs of neighbours, and more of those that a pair makes suspect."""
    inner = angles[np.ix_(kept, kept)]
    pairs = [(kept[i], kept[j]) for i, j in neighbour_pairs(inner)]
    edges = [meter.measure(i, j, relative(Ts, i, j)) for i, j in pairs]
    r = differences(Ts, edges)
    large = (1e3 * np.linalg.norm(r[:, 3:], axis=1) > LEAST_MM) | (
        np.degrees(np.linalg.norm(r[:, :3], axis=1)) > LEAST_DEG
    )
    odd = [e for e, big in zip(edges, large, strict=True) if big or has_failed(e)]
    doubted = sorted({k for e in odd for k in (e.first, e.second)})
    if len(doubted) > FURTHER_SHARE * len(kept):
        return edges
    outside = np.full(angles.shape, np.inf)
    outside[np.ix_(kept, kept)] = inner
    more = further_pairs(outside, pairs, doubted, FURTHER)
    return edges + [meter.measure(i, j, relative(Ts, i, j)) for i, j in more]


def _middle(clouds: Sequence[ViewCloud], Ts: Array) -> Array:
    """Return the middle (3,) of what stands on the table, by the claimed poses [m]."""
    centers = [se3.transform(T, c.source).mean(0) for T, c in zip(Ts, clouds, strict=True)]
    return np.median(centers, axis=0)


def _twists(k: int, Ts: Array, mended: Array, edges: Sequence[Edge]) -> list[tuple[Array, float]]:
    """Return what view k's pairs say about its pose (6,), its neighbours' faults taken out.

    Each with the pair's overlap.
    """
    found: list[tuple[Array, float]] = []
    for e in edges:
        if k not in (e.first, e.second):
            continue
        other, Z = (e.first, e.T_first_second) if e.second == k else (
            e.second, se3.invert(e.T_first_second)
        )  # fmt: skip
        found.append((se3.log(se3.invert(Ts[k]) @ mended[other] @ Z), e.overlap))
    return found


def _difference(index: int, twists: Sequence[tuple[Array, float]]) -> ViewDifference:
    """Return how far the depth of view number `index` is from its pose, by its pairs."""
    if not twists:
        return ViewDifference(index=index, mm=np.nan, deg=np.nan, pairs=0, overlap=0.0)
    x = np.median([twist for twist, _ in twists], axis=0)
    return ViewDifference(
        index=index,
        mm=float(1e3 * np.linalg.norm(x[3:])),
        deg=float(np.degrees(np.linalg.norm(x[:3]))),
        pairs=len(twists),
        overlap=float(np.median([overlap for _, overlap in twists])),
    )
