"""The symmetries of a scanned shape, judged by the distance of the moved surface.

Axes are sought in all directions and refined by least squares; from them the point groups are
built, the largest that the surface bears is the shape's. Its elements are one group turned and
shifted as a whole, so it is closed to the last digit however rough the mesh is.

It is BOP's convention: a list of discrete motions and a list of axes of continuous symmetry, each
motion to be followed by every step about every axis (`realsim.geometry.mesh.symmetry_transforms`).
A can is one axis with the identity and one half turn about a line across it. A sphere has three
axes at right angles: BOP knows no other form, and the union of the turns about them, which its
tools form, is not every rotation of a sphere.

What misses by less than a sensor sees is symmetric, and so is what only a small part of the
surface breaks (`outliers`): a bowl with a hole of 8 mm through its foot keeps its axis, a mug with
its handle has none. BOP's own rule is wider, max(15 mm, 10 % of the diameter); a grasp a handle's
width off is no grasp.

The group is that of the SHAPE. In BOP the symmetries of a textured model are those of its
appearance: `texture_breaks` tells where the two differ, and who cares for appearance drops them.
"""

import math
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from realsim.arrays import Array
from realsim.errors import InputError
from realsim.geometry import se3
from realsim.models.model_records import Symmetries
from realsim.models.symmetry_config import SymmetryConfig
from realsim.models.symmetry_search import (
    COARSE_SCALES,
    FINE_SCALES,
    POLYHEDRA,
    Axis,
    IsometryFit,
    best_mirror,
    fits_of,
    found_axes,
    frame_about,
    frame_on,
    group,
    moved_about,
    turn,
)
from realsim.models.symmetry_surface import Surface, refinement, surface_of, texture_breaks
from realsim.records import Mesh

__all__ = ["SymmetryConfig", "find_symmetries"]

FIT_ELEMENTS = 12
"""Elements of a group by which its axes are fitted; the others follow."""
OFF_RAD = math.radians(6.0)
"""How far two axes may be from the angle that a polyhedron's axes have."""
FLIP_PHASES = 24
"""Half-turn axes across a main axis that are tried, over the angle after which they repeat."""
FLIP_WORTH_A_TRY = 0.06
"""RMS distance [share of the diameter] beyond which half turns across an axis are not fitted."""
STANDS_OUT = 0.5
"""An order of an axis that all orders nearly fit is one if it misses by less than this share of
what they usually miss by: the teeth of a fine gear do, a distorted bottle's turns do not."""
FEW = 4
"""Orders of a refused axis that are listed one by one."""
SAME_MOTION = 0.08
"""Motions that differ by less are one in the report [share of the diameter]."""


@dataclass(frozen=True, eq=False, kw_only=True)
class _Trial:
    """A group that the surface may have."""

    rotations: Array
    """(K, 3, 3) discrete elements in the group's own axes."""
    frame: Array
    """(4, 4) of those axes in the normalised frame."""
    continuous: tuple[int, ...] = ()
    """Columns of the frame about which every turn is a symmetry."""

    def elements(self, step_deg: float, up_to_deg: float = 180.0) -> Array:
        """Return its isometries (M, 4, 4); half of the turns say all, the others are inverse."""
        rotations = self.rotations
        if self.continuous:
            angles = np.radians(np.arange(0.0, up_to_deg + step_deg / 2, step_deg))
            turns = np.concatenate([se3.exp_so3(angles[:, None] * np.eye(3)[k])
                                    for k in self.continuous])  # fmt: skip
            rotations = (turns[:, None] @ rotations).reshape(-1, 3, 3)
        return moved_about(rotations, self.frame)


def find_symmetries(mesh: Mesh, config: SymmetryConfig | None = None) -> Symmetries:
    """Return the discrete and continuous symmetries of a mesh's shape.

    Args:
        mesh: a scan or a CAD mesh in any unit; it need not be closed.
        config: tolerances, as shares of the diameter.

    Raises:
        InputError: the mesh has no area.
    """
    config = config or SymmetryConfig()
    if not np.linalg.norm(mesh.extent) > 0:
        raise InputError("the mesh is a single point; a surface is needed to find its symmetries.")
    surface = surface_of(mesh, config.judging_points, np.random.default_rng(config.seed))
    axes = found_axes(surface, config)
    mirror = best_mirror(surface, config, axes)
    # Of each axis the largest turn: a small one misses by little whatever the shape.
    best = min([mirror.worst, *(a.fits[a.orders[0]].worst for a in axes if a.orders)])
    tolerance = min(max(config.tolerance, config.noise_factor * best), config.greatest_tolerance)

    def passes(fits: list[IsometryFit]) -> bool:
        return all(f.worst <= tolerance and f.rms <= config.rms_tolerance for f in fits)

    chosen, fits = (
        _Trial(rotations=np.eye(3)[None], frame=np.eye(4)),
        [IsometryFit(worst=0, rms=0, share=1)],
    )
    for trial in _trials(surface, axes, config):
        fitted, fitted_fits = _fitted(surface, trial, config)
        if passes(fitted_fits):
            chosen, fits = fitted, fitted_fits
            break
    discrete = surface.to_metres(moved_about(chosen.rotations, chosen.frame))
    discrete[0] = np.eye(4)  # without the last digit that turning it there and back costs
    return Symmetries(
        discrete=discrete,
        axes=_axes_m(surface, chosen),
        worst_m=surface.diameter_m * max(f.worst for f in fits),
        near=_near(surface, axes, chosen, config),
        texture_breaks=texture_breaks(mesh, surface, chosen.elements(30.0)[1:], config),
        is_mirror_symmetric=passes([mirror]),
    )


def _fitted(
    surface: Surface, trial: _Trial, config: SymmetryConfig
) -> tuple[_Trial, list[IsometryFit]]:
    """Return a trial with its axes fitted to the surface as one, and how well it fits."""
    all_of = trial.elements(config.continuous_step_deg)[1:]
    some = all_of[:: math.ceil(len(all_of) / FIT_ELEMENTS)]
    E = refinement(surface, some, config.fitting_points, (COARSE_SCALES[-1], *FINE_SCALES))
    fitted = _Trial(rotations=trial.rotations, frame=E @ trial.frame, continuous=trial.continuous)
    Ts = fitted.elements(config.continuous_step_deg)[1:]
    # Most trials that fail do so by far: a few points tell.
    quick = fits_of(surface, Ts, config, config.screening_points)
    if max(f.rms for f in quick) > 2 * config.rms_tolerance:
        return fitted, quick
    return fitted, fits_of(surface, Ts, config, config.judging_points)


def _trials(surface: Surface, axes: list[Axis], config: SymmetryConfig) -> Iterator[_Trial]:
    """Yield the groups that the axes allow, the larger first."""
    turned = [a for a in axes if len(a.orders) == config.orders - 1]
    identity = np.eye(3)[None]
    if len(turned) > 1:
        yield _Trial(rotations=identity, frame=_frame(turned[0]), continuous=(0, 1, 2))
    for axis in turned:
        yield _Trial(rotations=group("dihedral", 1), frame=_frame(axis), continuous=(2,))
        yield _Trial(rotations=identity, frame=_frame(axis), continuous=(2,))
    pairs = [(a, n) for a in axes for n in a.orders if a not in turned or _stands_out(a, n)]
    finite = [
        *_polyhedral(axes),
        *(_Trial(rotations=group("cyclic", n), frame=_frame(a)) for a, n in pairs),
        *(trial for a, n in pairs for trial in _dihedral(surface, a, n, config)),
    ]
    yield from sorted(finite, key=lambda t: -len(t.rotations))


def _stands_out(axis: Axis, order: int) -> bool:
    """Return whether an order fits much better than others do: else the axis is a bent lathe's."""
    usual = float(np.median([fit.worst for fit in axis.fits.values()]))
    return axis.fits[order].worst <= STANDS_OUT * usual


def _frame(axis: Axis) -> Array:
    """Return a frame (4, 4) with its z along an axis."""
    return se3.from_rt(frame_about(axis.direction), axis.point)


def _polyhedral(axes: list[Axis]) -> Iterator[_Trial]:
    """Yield the polyhedra whose axes lie as two of those found."""
    for name, (fold, _, _) in POLYHEDRA.items():
        having = [a for a in axes if fold in a.orders]
        for i, first in enumerate(having):
            for second in having[i + 1 :]:
                R = frame_on(name, first.direction, second.direction, OFF_RAD)
                if R is not None:
                    center = (first.point + second.point) / 2
                    yield _Trial(rotations=group(name), frame=se3.from_rt(R, center))
                    break
            else:
                continue
            break


def _dihedral(surface: Surface, axis: Axis, order: int, config: SymmetryConfig) -> Iterator[_Trial]:
    """Yield the group of a main axis and the half turns across it that fit best, if any do."""
    frame = _frame(axis)
    phases = np.arange(FLIP_PHASES) * (math.pi / order / FLIP_PHASES)
    turned = [frame @ se3.from_rt(turn((0, 0, 1), phase), np.zeros(3)) for phase in phases]
    flip = turn((1, 0, 0), math.pi)[None]
    Ts = np.concatenate([moved_about(flip, F) for F in turned])
    rms = np.sqrt(np.mean(np.square(surface.near(Ts, config.screening_points)), axis=1))
    best = int(np.argmin(rms))
    if rms[best] <= FLIP_WORTH_A_TRY:
        yield _Trial(rotations=group("dihedral", order), frame=turned[best])


def _axes_m(
    surface: Surface, trial: _Trial
) -> tuple[tuple[tuple[float, float, float], tuple[float, float, float]], ...]:
    """Return the continuous axes as (unit direction, point [m]), the largest part positive."""
    point = surface.center + surface.diameter_m * trial.frame[:3, 3]
    found: list[tuple[tuple[float, float, float], tuple[float, float, float]]] = []
    for column in trial.continuous:
        a = trial.frame[:3, column]
        a = a * np.sign(a[np.argmax(np.abs(a))])
        found.append(
            ((float(a[0]), float(a[1]), float(a[2])),
             (float(point[0]), float(point[1]), float(point[2])))
        )  # fmt: skip
    return tuple(found)


def _near(
    surface: Surface, axes: list[Axis], chosen: _Trial, config: SymmetryConfig
) -> tuple[str, ...]:
    """Return the motions that nearly fit but are not in the group, one text per axis."""
    points = surface.points[:20]
    members = se3.transform(chosen.elements(config.continuous_step_deg, 360.0), points)
    rows: list[tuple[float, str]] = []
    for axis in axes:
        refused: list[int] = []
        for n, fit in axis.fits.items():
            if fit.share < config.near_share:
                continue
            T = moved_about(
                turn(axis.direction, 2 * math.pi / n)[None], se3.from_translation(axis.point)
            )
            gaps = np.linalg.norm(members - se3.transform(T, points), axis=2).max(axis=1)
            back = np.linalg.norm(members - se3.transform(se3.invert(T), points), axis=2)
            if min(gaps.min(), back.max(axis=1).min()) > SAME_MOTION:
                refused.append(n)
        if refused:
            rows.append(_near_text(surface, axis, refused, config))
    return tuple(text for _, text in sorted(rows, reverse=True)[: config.near_reported])


def _near_text(
    surface: Surface, axis: Axis, orders: list[int], config: SymmetryConfig
) -> tuple[float, str]:
    """Return the best share of the refused turns about an axis, and a text."""
    n = max(orders, key=lambda order: axis.fits[order].share)
    fit = axis.fits[n]
    d = axis.direction * np.sign(axis.direction[np.argmax(np.abs(axis.direction))])
    rest = [f"1/{k}" for k in orders if k != n]
    others = " and most others" if len(rest) > FEW else "".join(f", {r}" for r in rest)
    return fit.share, (
        f"turn by 1/{n}{others} about the axis ({d[0]:.3f}, {d[1]:.3f}, {d[2]:.3f}): "
        f"{100 * fit.share:.0f} % of the surface within {100 * config.near_distance:.1f} % of the "
        f"diameter ({1e3 * config.near_distance * surface.diameter_m:.2g} mm), the worst off by "
        f"{100 * fit.worst:.1f} % ({1e3 * fit.worst * surface.diameter_m:.2g} mm)"
    )
