"""Near-symmetric poses compared again, now that the cameras are right.

In the search, cameras are off by a millimetre, and a pipe whose ends differ by half a millimetre
stays undecided. Refined, the averaged points lie within a tenth of a millimetre of the surface; so
the pose and its rival are fitted to the same points, and the squares of their residuals compared
cell by cell over the surface (a paired t-test over cells of `CELL_M`, each an independent piece).

A box turned by half is the same to depth; its print is not. Where the mesh has colours, the frames
photographs, and depth hardly decides, the print does.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from realsim.arrays import Array
from realsim.geometry import se3
from realsim.geometry.metrics import mssd_symmetric
from realsim.registration.body import Body
from realsim.registration.compare import make_comparer
from realsim.registration.evidence import Cloud, read_frame
from realsim.registration.judging.verdict import CONTRAST_DECIDED
from realsim.registration.photo import Picture, paint_of, print_errors
from realsim.registration.search.near_symmetry import near_symmetries
from realsim.registration.solver import FINE, solve_pose

if TYPE_CHECKING:
    from realsim.registration.config import RegistrationConfig
    from realsim.registration.intake import Intake


CELL_M = 0.005
"""Cells of the surface whose residuals count as independent [m]."""
FLOOR_M = 1e-4
"""What residuals are compared with at least [m]: no mesh and no camera is better."""
CAP_M = 0.003
"""Larger residuals count as this [m]: points of a neighbour."""
STANDARD_ERRORS = 4.0
"""Standard errors by which the rival must be worse."""
WORSE_SHARE = 0.25
"""Share of the mean square by which it must be worse, too."""
SAME_M = 0.001
"""Fitted poses nearer than this are one [m]."""
LEAST_CELLS = 12
"""Fewer cells decide nothing."""
PRINT_SPREAD = 12.0
"""A mesh whose colours vary by less has no print [of 255]."""
PRINT_GAP = 0.1
"""By so much the correlation with the photograph must differ."""
PRINT_RIVALS = 12
"""Near symmetries that the print is asked about, those that fit best."""
BESIDE_SHARE = 0.7
"""Poses nearer than this are one to the print [share of half the box's diagonal]."""
PRINT_VIEWS = 4
"""Photographs that are asked, of many, spread around the objects."""
LEAST_PRINT = 0.25
"""A print that correlates by less at both poses is not the object's, or not seen."""
PRINT_LOSS = 0.5
"""A rival that loses more of the rendered gain, not fitted yet, is none to the print."""
PRINT_FROM = 4.0 * CONTRAST_DECIDED
"""Depth that decides by more than this contrast is not asked again by the print."""


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Duel:
    """What came of a pose and its rival."""

    contrast: float | None
    """On the scale of the search's: `CONTRAST_DECIDED` and more is decided; negative = the rival is
    better; None = the rival turned out to be the same pose."""
    T_rival: Array
    """(4, 4) the rival, fitted."""


def duel(body: Body, T: Array, T_rival: Array, cloud: Cloud, misfit_m: float) -> Duel | None:
    """Return how clearly a pose is better than its rival; None = too few points to say.

    Args:
        body: the object.
        T: (4, 4) its pose.
        T_rival: (4, 4) the other, near enough to be fitted.
        cloud: the object's averaged points, cameras refined.
        misfit_m: by how much the object's mesh is off everywhere [m].
    """
    fitted = [solve_pose(body, cloud, X, FINE).T_world_obj for X in (T, T_rival)]
    if mssd_symmetric(fitted[0], fitted[1], body.model) < SAME_M:
        # On better points the two are one: the rival was no more than an unfinished fit.
        return Duel(contrast=None, T_rival=fitted[1])
    squares = [_squares(body, X, cloud, misfit_m) for X in fitted]
    cells = np.floor(se3.transform(se3.invert(T), cloud.points) / CELL_M).astype(np.int64)
    _, of = np.unique(cells, axis=0, return_inverse=True)
    of = of.reshape(-1)
    count = np.bincount(of)
    if len(count) < LEAST_CELLS:
        return None
    means = [np.bincount(of, weights=s) / count for s in squares]
    worse = means[1] - means[0]
    error = float(np.std(worse, ddof=1) / np.sqrt(len(worse)))
    t = float(worse.mean()) / max(error, 1e-12)
    ratio = float(worse.mean() / min(means[0].mean(), means[1].mean()))
    size = min(abs(t) / STANDARD_ERRORS, abs(ratio) / WORSE_SHARE)
    return Duel(contrast=float(np.sign(t)) * CONTRAST_DECIDED * size, T_rival=fitted[1])


def duels_by_print(
    bodies: Sequence[Body],
    rivals: Sequence[Array | None],
    contrasts: Sequence[float | None],
    intake: "Intake",
    config: "RegistrationConfig",
) -> tuple[list[float | None], list[Duel | None]]:
    """Return the contrasts, those among them settled by the print, and the duels that say so.

    Args:
        bodies: the objects where they were found.
        rivals: of each, by depth; None = none.
        contrasts: to these.
        intake: the frames.
        config: settings.
    """
    poses = [b.T_start for b in bodies]
    out, fought = list(contrasts), list[Duel | None]([None] * len(poses))
    asked = [
        n for n, (c, R) in enumerate(zip(contrasts, rivals, strict=True))
        if R is not None and c is not None and c < PRINT_FROM
        and paint_of(bodies[n].model.mesh) is not None
    ]  # fmt: skip
    pictures = [
        Picture(intrinsics=intake.intrinsics, depth_m=f.depth_m, T_world_cam=f.T_world_cam,
                rgb=f.read_rgb())
        for f in (intake.frames if asked else ()) if f.read_rgb is not None
    ]  # fmt: skip
    if not pictures:
        return out, fought
    comparer = make_comparer(
        intake.intrinsics, [read_frame(f) for f in intake.frames], intake.noise, intake.plane,
    )  # fmt: skip
    for n in asked:
        near = near_symmetries(bodies[n].model, config.find.near, config.field_folder)
        others = [poses[n] @ S for S in near[:PRINT_RIVALS]]
        others += [R for R in (rivals[n],) if R is not None]
        stride = comparer.stride_of(bodies[n], poses[n])
        least = (1.0 - PRINT_LOSS) * comparer.gain(bodies[n], poses[n], stride)[0]
        others = [R for R in others if comparer.gain(bodies[n], R, stride)[0] >= least]
        said = print_duel(bodies, poses, n, others, pictures) if others else None
        if said is None or said.contrast is None:
            continue
        # A print that does not decide can raise a doubt, and settles none.
        if abs(said.contrast) >= CONTRAST_DECIDED:
            out[n], fought[n] = abs(said.contrast), said
        elif said.contrast < 0:
            out[n] = min(abs(said.contrast), abs(out[n] or 0.0))
    return out, fought


def print_duel(
    bodies: Sequence[Body],
    poses: Sequence[Array],
    number: int,
    rivals: Sequence[Array],
    pictures: Sequence[Picture],
) -> Duel | None:
    """Return how clearly the print of an object in the photographs is that of its pose.

    Args:
        bodies: all objects.
        poses: (4, 4) each.
        number: which of them has rivals.
        rivals: (4, 4) each.
        pictures: the photographs.

    Returns:
        The duel with the best rival; contrast 0 = two rivals are alike. None = the object has no
        print, or it is found at no pose.
    """
    paint = paint_of(bodies[number].model.mesh)
    if paint is None or float(paint.colors.std(0).max()) < PRINT_SPREAD:
        return None
    sets: list[list[tuple[float, Array]]] = [[] for _ in range(1 + len(rivals))]
    for picture in pictures:
        rest = [
            picture.depth_of(b.model.mesh, T)
            for k, (b, T) in enumerate(zip(bodies, poses, strict=True)) if k != number
        ]  # fmt: skip
        for found, T in zip(sets, (poses[number], *rivals), strict=True):
            own = picture.depth_of(bodies[number].model.mesh, T)
            others = np.min([*rest, np.full_like(own, np.inf)], axis=0)
            found.append(print_errors(picture, paint, T, own, others))
    values = np.nan_to_num([np.mean([r for r, _ in found]) for found in sets])
    best = int(np.argmax(values))
    if values[best] < LEAST_PRINT:
        return None
    Ts, body = [poses[number], *rivals], bodies[number]
    # Those that lie beside the best are no other side of the object: fits bring them together.
    beside = BESIDE_SHARE * body.radius_m
    clear = min(
        (
            min(_print_gap(found, sets[best]), float(values[best] - value))
            for T, found, value in zip(Ts, sets, values, strict=True)
            if mssd_symmetric(Ts[best], T, body.model) > beside
        ),
        default=PRINT_GAP,
    )
    if best == 0:
        return Duel(contrast=CONTRAST_DECIDED * clear / PRINT_GAP, T_rival=rivals[0])
    return Duel(contrast=-CONTRAST_DECIDED * clear / PRINT_GAP, T_rival=rivals[best - 1])


def _print_gap(
    worse: Sequence[tuple[float, Array]], better: Sequence[tuple[float, Array]]
) -> float:
    """Return how clearly one print fits better, block by block; `PRINT_GAP` = clearly."""
    gaps = np.concatenate([(w - b).ravel() for (_, w), (_, b) in zip(worse, better, strict=True)])
    gaps = gaps[np.isfinite(gaps)]
    if len(gaps) < LEAST_CELLS:
        return 0.0
    t = gaps.mean() / max(float(np.std(gaps, ddof=1)) / np.sqrt(len(gaps)), 1e-9)
    return float(max(t, 0.0)) / STANDARD_ERRORS * PRINT_GAP


def _squares(body: Body, T: Array, cloud: Cloud, misfit_m: float) -> Array:
    """Return (N,) squares of the residuals, in units of what they should be."""
    d = np.minimum(np.abs(body.field.distance(cloud.points, se3.invert(T))), CAP_M)
    return np.square(d) / (np.square(cloud.sigmas) + max(misfit_m, FLOOR_M) ** 2)
