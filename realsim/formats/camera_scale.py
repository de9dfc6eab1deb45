"""Metres per unit of camera poses, judged by depth that is in metres.

Depth fixes how far a surface moves in the image when the camera moves by so many units: with the
right scale what one view measured lies on what its neighbour measured. A pair of views needs
translation for that, and scenes of any scale are tried.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from realsim.errors import InputError
from realsim.formats.camera_direction import (
    AGREES_MM,
    WORSE_BY,
    WORSE_MM,
    Array,
    depth_evidence,
    require_direction,
)
from realsim.formats.depth_agreement import DepthOf, disagreement_mm, near_pairs, sampled_views

DECADES = 4
"""Scales from 1e-4 to 1e4 metres per unit are tried: millimetres, kilometres, and NeRF's boxes."""
STEP = 1.12
"""Between the scales that are tried: with the motion of a pair, a quarter of the distance, one step
off moves points by 3 % of their distance, which is still seen as agreeing."""
FINE = 15
"""Steps of the finer search between two of them: to 1.5 %."""
TELLING = 1.5
"""Factor by which a wrong scale must show, or the camera moves too little to tell."""


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
        return self.best_mm <= AGREES_MM and self.beside_mm > self._limit

    @property
    def contradicts(self) -> bool:
        """Whether another scale than the stated one is right."""
        return self.decisive and self.stated_mm > self._limit

    @property
    def _limit(self) -> float:
        return max(WORSE_BY * self.best_mm, self.best_mm + WORSE_MM)


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
    Ts_world_cam: Array,
    depth_of: DepthOf,
    where: str,
    metres_per_unit: float | None,
    remedy: str,
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
