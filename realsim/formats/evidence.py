"""Which convention camera poses have: direction, axes and unit, decided by agreement of views.

A file of camera poses does not prove its convention, but a static scene does: only with the right
one do different views put the same things in the same place. Four readings are compared, each up
to a turn of the world, which no agreement can tell:

    as stated                T_world_cam = T
    inverted                 T_world_cam = T^-1             (w2c taken for c2w, or the reverse)
    other axes               T_world_cam = T G              (OpenGL's axes taken for OpenCV's, ...)
    inverted, other axes     T_world_cam = T^-1 G           (G = diag(1, -1, -1, 1))

What is compared is either the poses of labelled objects (`objects_evidence`) or measured depth
(`depth_evidence`). Where the camera hardly moves, or only along x, readings agree equally well;
then nothing is decided, and that is said.

Depth that is in metres also tells the metres per unit of the poses (`scale_evidence`): it fixes how
far a surface moves in the image when the camera moves by so many units. A pair of views needs
translation for that, and scenes of any scale are tried.
"""

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from realsim.arrays import Array, Mask
from realsim.errors import InputError
from realsim.formats.depth_agreement import DepthOf, disagreement_mm, near_pairs, sampled_views
from realsim.geometry import se3
from realsim.geometry.camera import project
from realsim.interop import T_CAM_GL
from realsim.records import CameraIntrinsics

Direction = Literal["as stated", "inverted", "other axes", "inverted, other axes"]
STATED: Direction = "as stated"
WORSE_BY = 3.0
"""A reading is wrong if its spread is this many times the best one's: noise of the views and of the
labels is in both alike, and a wrong reading of a camera that moves is worse tens of times."""
WORSE_MM = 5.0
"""It is larger by this, too [mm]: public labels disagree between views by 3 to 6 mm at the
truth."""
AGREES_MM = 50.0
"""A best spread beyond this [mm] is no agreement: the scene moves, or the unit is another."""
MOST_VIEWS = 200
"""Views used of a long scene, evenly; more say no more."""
SPREAD_PERCENTILE = 75.0
"""Percentile of the distances from the middle: a camera that stands still in half of the views
hides nothing, and a quarter of wrong labels does not spoil it."""
DECADES = 4
"""Scales from 1e-4 to 1e4 metres per unit are tried: millimetres, kilometres, and NeRF's boxes."""
STEP = 1.12
"""Between the scales that are tried: with the motion of a pair, a quarter of the distance, one step
off moves points by 3 % of their distance, which is still seen as agreeing."""
FINE = 15
"""Steps of the finer search between two of them: to 1.5 %."""
TELLING = 1.5
"""Factor by which a wrong scale must show, or the camera moves too little to tell."""


def limit_mm(least_mm: float) -> float:
    """Return the spread [mm] up to which a reading is as good as the one with the least."""
    return max(WORSE_BY * least_mm, least_mm + WORSE_MM)


@dataclass(frozen=True, kw_only=True, slots=True)
class Spread:
    """How far the views are from agreeing under one reading."""

    mm: float
    """Spread of object positions in world, or of reprojected depth [mm]; NaN = nothing to
    compare."""
    deg: float | None = None
    """Spread of object orientations in world [deg]; None for depth. Symmetric objects, labelled by
    any of their equal poses, make it large, so it is told and not used."""


@dataclass(frozen=True, kw_only=True, slots=True)
class DirectionEvidence:
    """What the views say of the four readings."""

    spreads: Mapping[Direction, Spread]
    compared: str
    """What was compared, for messages: '5 objects in 20 views'; '' = nothing could be."""

    @property
    def best(self) -> Direction:
        """The reading with the smallest spread; the stated one where it is as good."""
        agreeing = self.agreeing
        return STATED if STATED in agreeing or not agreeing else agreeing[0]

    @property
    def agreeing(self) -> tuple[Direction, ...]:
        """Readings under which the views agree, best first; () = under none, or not compared."""
        known: list[Direction] = [n for n, s in self.spreads.items() if np.isfinite(s.mm)]
        known.sort(key=lambda name: self.spreads[name].mm)
        least = self.spreads[known[0]].mm if known else float("inf")
        if least > AGREES_MM:
            return ()
        return tuple(name for name in known if self.spreads[name].mm <= limit_mm(least))

    @property
    def decisive(self) -> bool:
        """Whether one reading alone agrees."""
        return len(self.agreeing) == 1

    @property
    def contradicts(self) -> bool:
        """Whether the views agree under another reading and not under the stated one."""
        return bool(self.agreeing) and STATED not in self.agreeing

    @property
    def numbers(self) -> str:
        """The spreads in words."""
        parts = [
            f"{name}: {s.mm:.1f} mm" + ("" if s.deg is None else f" and {s.deg:.2f} deg")
            for name, s in self.spreads.items()
        ]
        return "; ".join(parts)


def readings(Ts: ArrayLike) -> dict[Direction, Array]:
    """Return T_world_cam (N, 4, 4) under each reading of stated ones (N, 4, 4)."""
    Ts = np.asarray(Ts, dtype=np.float64)
    inverted = se3.invert(Ts)
    return {
        "as stated": Ts,
        "inverted": inverted,
        "other axes": Ts @ T_CAM_GL,
        "inverted, other axes": inverted @ T_CAM_GL,
    }


# --- by objects -------------------------------------------------------------------------------


def objects_evidence(
    Ts_world_cam: ArrayLike, things: Iterable[Sequence[tuple[int, ArrayLike]]]
) -> DirectionEvidence:
    """Return what the poses of static objects, labelled view by view, say.

    Args:
        Ts_world_cam: (N, 4, 4) camera poses as stated [m].
        things: of each thing its (view, T_cam_obj) pairs, the view as a place in `Ts_world_cam`
            and the pose (4, 4) [m]. Labels that were made out of the camera poses
            (one pose, brought into all views) agree by construction under the reading they were
            made with, which is the question.
    """
    Ts = np.asarray(Ts_world_cam, dtype=np.float64).reshape(-1, 4, 4)
    seen = [list(t)[:: max(1, -(-len(t) // MOST_VIEWS))] for t in things if len(t) > 1]
    stacked = [
        (np.array([k for k, _ in t]), np.stack([np.asarray(T, np.float64) for _, T in t]))
        for t in seen
    ]
    spreads: dict[Direction, Spread] = {}
    for name, candidate in readings(Ts).items():
        rows = [_spread_of(candidate[k] @ T_cam_obj) for k, T_cam_obj in stacked]
        mm, deg = np.median(rows, axis=0) if rows else (np.nan, np.nan)
        spreads[name] = Spread(mm=float(mm), deg=float(deg))
    views = len({k for t in seen for k, _ in t})
    compared = f"{len(seen)} objects in {views} views" if seen else ""
    return DirectionEvidence(spreads=spreads, compared=compared)


def _spread_of(Ts_world_obj: Array) -> tuple[float, float]:
    """Return by how much poses (V, 4, 4) of one thing differ [mm, deg]."""
    positions = Ts_world_obj[:, :3, 3]
    off = np.linalg.norm(positions - np.median(positions, axis=0), axis=1)
    R = Ts_world_obj[:, :3, :3]
    # The pose nearest to the middle stands for the orientation: a mean of far turns is none.
    nearest = R[int(np.argmin(off))]
    angles = np.atleast_1d(se3.angle(np.swapaxes(R, 1, 2) @ nearest))
    return (
        1e3 * float(np.percentile(off, SPREAD_PERCENTILE)),
        float(np.rad2deg(np.percentile(angles, SPREAD_PERCENTILE))),
    )


# --- by depth ---------------------------------------------------------------------------------


def depth_evidence(Ts_world_cam: ArrayLike, depth_of: DepthOf) -> DirectionEvidence:
    """Return what measured depth says: each view's points must lie on what its neighbour measured.

    Args:
        Ts_world_cam: (N, 4, 4) camera poses as stated [m].
        depth_of: of a place in `Ts_world_cam`: the depth (H, W) [m], 0 = none, and its camera.
    """
    Ts = np.asarray(Ts_world_cam, dtype=np.float64).reshape(-1, 4, 4)
    views = sampled_views(Ts, depth_of)
    # Which views are near depends on the reading: each one is judged where it says they are.
    spreads: dict[Direction, Spread] = {
        name: Spread(mm=disagreement_mm(candidate, views, near_pairs(candidate, views)))
        for name, candidate in readings(Ts).items()
    }
    compared = f"the depth of near views, out of {len(views)}" if len(views) > 1 else ""
    return DirectionEvidence(spreads=spreads, compared=compared)


# --- verdict ----------------------------------------------------------------------------------


def require_direction(evidence: DirectionEvidence, where: str, *, remedy: str = "") -> str:
    """Return a note on the stated reading if the evidence does not contradict it.

    Args:
        evidence: of the views.
        where: the file or scene, for messages.
        remedy: what a person can do, for the message.

    Returns:
        That the poses agree, that the evidence cannot tell, or that nothing agrees.

    Raises:
        InputError: the views agree under another reading and not under the stated one.
    """
    if evidence.contradicts:
        raise InputError(
            f"{where}: the camera poses are not what they are said to be: {_meaning(evidence.best)}"
            f". Spread of {evidence.compared}, by how the poses are read: {evidence.numbers}. "
            f"{remedy or 'Convert the poses, or name the convention that they have.'}"
        )
    if not evidence.compared:
        return (
            f"{where}: the direction of the camera poses could not be checked: no two views show "
            "the same thing."
        )
    if not evidence.agreeing:
        return (
            f"{where}: the views do not agree under any reading of the camera poses "
            f"({evidence.compared}; {evidence.numbers}): the scene moved, or a unit is wrong."
        )
    if not evidence.decisive:
        return (
            f"{where}: the direction of the camera poses could not be checked, the camera moves "
            f"too little ({evidence.compared}; {evidence.numbers})."
        )
    return f"checked: camera poses agree by {evidence.compared}: {evidence.numbers}."


def _meaning(direction: Direction) -> str:
    """Return in words what a reading says of the stated one."""
    parts = [
        text
        for word, text in (
            ("inverted", "camera to world is taken for world to camera, or the reverse"),
            ("axes", "OpenGL's camera axes are taken for OpenCV's, or the reverse"),
        )
        if word in direction
    ]
    return "; and ".join(parts)


# --- unit ---------------------------------------------------------------------------------------


@dataclass(frozen=True, kw_only=True, slots=True)
class ScaleEvidence:
    """What depth says of the unit of camera poses."""

    stated_mm: float
    """Disagreement of the views if the poses are in metres as stated [mm]; NaN = no pairs."""
    best: float
    """Metres per stated metre at which they agree best."""
    best_mm: float
    """Disagreement there [mm]."""
    beside_mm: float
    """The smaller disagreement at scales TELLING times larger and smaller than the best one."""

    @property
    def decisive(self) -> bool:
        """Whether the views agree at the best scale and not beside it."""
        return self.best_mm <= AGREES_MM and self.beside_mm > limit_mm(self.best_mm)

    @property
    def contradicts(self) -> bool:
        """Whether another scale than the stated one is right."""
        return self.decisive and self.stated_mm > limit_mm(self.best_mm)


def scale_evidence(Ts_world_cam: ArrayLike, depth_of: DepthOf) -> ScaleEvidence:
    """Return at which scale of the translations the depth images agree.

    Args:
        Ts_world_cam: (N, 4, 4) camera poses as stated [m].
        depth_of: of a place in `Ts_world_cam`: the depth (H, W) [m], 0 = none, and its camera.
    """
    Ts = np.asarray(Ts_world_cam, dtype=np.float64).reshape(-1, 4, 4)
    views = sampled_views(Ts, depth_of)
    if len(views) < 2:
        nan = float("nan")
        return ScaleEvidence(stated_mm=nan, best=1.0, best_mm=nan, beside_mm=nan)

    def at(scale: float) -> float:
        scaled = Ts.copy()
        scaled[:, :3, 3] *= scale
        # Which views are near depends on the scale: each is judged where it says they are.
        return disagreement_mm(scaled, views, near_pairs(scaled, views))

    steps = round(DECADES * np.log(10) / np.log(STEP))
    coarse = STEP ** np.arange(-steps, steps + 1.0)
    best = _least(coarse, at)
    best = _least(best * np.geomspace(1 / STEP, STEP, FINE), at)
    best_mm, stated_mm = at(best), at(1.0)
    if stated_mm <= best_mm:
        best, best_mm = 1.0, stated_mm
    return ScaleEvidence(
        stated_mm=stated_mm, best=best, best_mm=best_mm,
        beside_mm=min(at(best * TELLING), at(best / TELLING)),
    )  # fmt: skip


def _least(scales: Array, at: Callable[[float], float]) -> float:
    """Return the scale of least disagreement; of equal ones the nearest to 1."""
    ordered = sorted((float(s) for s in scales), key=lambda s: abs(np.log(s)))
    return min(ordered, key=at)


def require_scale(evidence: ScaleEvidence, where: str, *, stated: float = 1.0) -> str:
    """Return a note on the scale if depth does not contradict it.

    Args:
        evidence: of the poses, stated scale applied.
        where: for messages.
        stated: metres per unit of the file that were applied.

    Raises:
        InputError: the depth agrees at another scale only.
    """
    if evidence.contradicts:
        raise InputError(
            f"{where}: with {stated:g} metres per unit of the camera poses, the depth of near "
            f"views disagrees by {evidence.stated_mm:.1f} mm; with {stated * evidence.best:.4g} it "
            f"agrees ({evidence.best_mm:.1f} mm). If the depth unit is right, give --scale "
            f"{stated * evidence.best:.4g}; if the poses are in metres, the depth unit is wrong."
        )
    if evidence.decisive:
        return (
            f"scale checked: with {stated:g} metres per unit the depth of near views agrees to "
            f"{evidence.stated_mm:.1f} mm."
        )
    return (
        f"the scale of the camera poses ({stated:g} metres per unit) could not be checked by "
        f"depth: near views disagree by {evidence.stated_mm:.1f} mm, at the best scale "
        f"{stated * evidence.best:.4g} by {evidence.best_mm:.1f} mm, and "
        f"{TELLING:g} times beside it by {evidence.beside_mm:.1f} mm."
    )


def poses_checked_by_depth(
    Ts_world_cam: Array, depth_of: DepthOf, where: str, metres_per_unit: float | None, remedy: str
) -> list[str]:
    """Return notes on what depth says of camera poses: their direction, axes and unit.

    Raises:
        InputError: it contradicts them.
    """
    direction = depth_evidence(Ts_world_cam, depth_of)
    note = require_direction(direction, where, remedy=remedy)
    # A wrong unit makes every reading disagree, so it is looked for in any case.
    scale = scale_evidence(Ts_world_cam, depth_of)
    return [note, require_scale(scale, where, stated=metres_per_unit or 1.0)]


# --- depth at labelled objects ------------------------------------------------------------------


def depth_ratio(
    depth_m: NDArray[Any],
    mask: Mask | None,
    intrinsics: CameraIntrinsics,
    T_cam_obj: Array,
    *,
    window_px: int = 2,
    least: tuple[int, int] = (20, 1),
) -> float | None:
    """Return median depth where an object is seen / distance of its origin; None = not measured.

    Args:
        depth_m: (H, W) [m], 0 = none.
        mask: (H, W) its visible part; None = look around the pixel of its origin.
        intrinsics: the image's camera.
        T_cam_obj: (4, 4) [m].
        window_px: without a mask depth is looked at this far on each side of the origin's pixel.
        least: measured pixels with and without a mask from which their median is one.
    """
    z = float(T_cam_obj[2, 3])
    if z <= 0:
        return None
    if mask is not None:
        values = depth_m[mask]
    else:
        with np.errstate(invalid="ignore", over="ignore"):
            at = project(intrinsics, T_cam_obj[:3, 3])
        if not (0 <= at[0] < intrinsics.width and 0 <= at[1] < intrinsics.height):
            return None
        u, v = (int(x) for x in at)
        values = depth_m[max(v - window_px, 0) : v + window_px + 1,
                         max(u - window_px, 0) : u + window_px + 1].ravel()  # fmt: skip
    values = values[values > 0]
    return float(np.median(values)) / z if len(values) >= least[mask is None] else None
