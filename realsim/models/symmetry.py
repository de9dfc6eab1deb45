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

import hashlib
import math
from collections.abc import Iterator
from dataclasses import astuple, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from realsim.arrays import Array
from realsim.errors import InputError
from realsim.geometry import se3
from realsim.geometry.mesh import diameter
from realsim.models.model_records import Symmetries
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
from realsim.models.symmetry_surface import (
    Surface,
    SymmetryConfig,
    refinement,
    surface_of,
    texture_breaks,
)
from realsim.records import Mesh, ObjectModel
from realsim.store.arrays_on_disk import rebuilt, write_arrays

__all__ = ["SymmetryConfig", "find_symmetries", "with_found_symmetries"]

EXACT_M, EXACT_SHARE = 0.0003, 0.005
"""A model that declares no symmetry has those of its shape that miss by at most this [m], or by
this share of its diameter if that is more: 0.65 mm of 13 cm, half of what `SymmetryConfig` allows
a scan. No depth camera sees less."""
NO_MIRROR = IsometryFit(worst=math.inf, rms=math.inf, share=0.0)
"""What a mirror image that was not tried fits by."""
REMEMBERED = 64
"""Models whose symmetries are kept in memory."""
_memory: dict[str, Symmetries] = {}

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
ALONG = 0.998
"""Cosine from which on an axis is named x, y or z (3.6 deg)."""
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


def find_symmetries(
    mesh: Mesh, config: SymmetryConfig | None = None, *, with_mirror: bool = True
) -> Symmetries:
    """Return the discrete and continuous symmetries of a mesh's shape.

    Args:
        mesh: a scan or a CAD mesh in any unit; it need not be closed.
        config: tolerances, as shares of the diameter.
        with_mirror: whether mirror images are tried; if not, the shape counts as having none.

    Raises:
        InputError: the mesh has no area.
    """
    config = config or SymmetryConfig()
    if not np.linalg.norm(mesh.extent) > 0:
        raise InputError("the mesh is a single point; a surface is needed to find its symmetries.")
    surface = surface_of(mesh, config.judging_points, np.random.default_rng(config.seed))
    axes = found_axes(surface, config)
    mirror = best_mirror(surface, config, axes) if with_mirror else NO_MIRROR
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


def with_found_symmetries(model: ObjectModel, folder: Path | None) -> tuple[ObjectModel, str]:
    """Return a model with the symmetries of its shape, and words on them; "" = it has none.

    What a model declares is left as it is. Where colours differ under a symmetry of the shape the
    model gets none: a photograph tells these poses apart.

    Args:
        model: any.
        folder: where what is found is kept between runs; None = in memory.
    """
    if len(model.symmetries) > 1 or model.symmetry_axes or not np.any(model.mesh.extent > 0):
        return model, ""
    found = _exact_symmetries(model.mesh, folder)
    order = len(found.discrete)
    kinds = [f"looks the same in {order} ways"] if order > 1 else []
    kinds += ["is a body of revolution"] if found.axes else []
    near = f"nearly symmetric: {found.near[0]}" if found.near else ""
    if not kinds:
        return model, near
    words = f"it declares no symmetry, but its shape {' and '.join(kinds)} within "
    words += f"{max(1e3 * found.worst_m, 0.01):.2f} mm: "
    if found.texture_breaks:
        words += "not taken for the same, since its colours differ and a photograph can tell"
    else:
        words += "poses that differ by them are taken for the same"
        model = replace(model, symmetries=found.discrete, symmetry_axes=found.axes)
    return model, f"{words}; {near}" if near else words


def _exact_symmetries(mesh: Mesh, folder: Path | None) -> Symmetries:
    """Return the symmetries of a shape within `EXACT_M`, from memory or `folder` if known."""
    bound = max(EXACT_SHARE, EXACT_M / diameter(mesh))
    bound = min(bound, SymmetryConfig().tolerance)
    config = SymmetryConfig(tolerance=bound, greatest_tolerance=bound)
    digest = hashlib.blake2b(repr(astuple(config)).encode(), digest_size=16)
    for part in (mesh.vertices, mesh.faces, mesh.colors, mesh.uv, mesh.texture):
        digest.update(b"-" if part is None else part.tobytes())
    key = digest.hexdigest()
    path = None if folder is None else folder / f"symmetries_{key}.npz"
    known = _memory.get(key) or (None if path is None else rebuilt(path, _of_file))
    if known is None:
        known = find_symmetries(mesh, config, with_mirror=False)
        if path is not None:
            notes = {"worst_m": known.worst_m, "near": known.near, "breaks": known.texture_breaks}
            axes = np.array(known.axes, dtype=np.float64).reshape(-1, 2, 3)
            write_arrays(path, {"discrete": known.discrete, "axes": axes}, notes)
    while len(_memory) >= REMEMBERED:
        _memory.pop(next(iter(_memory)))
    _memory[key] = known
    return known


def _of_file(arrays: dict[str, Array], notes: dict[str, Any]) -> Symmetries:
    """Return the symmetries of a file."""
    return Symmetries(
        discrete=arrays["discrete"],
        axes=tuple((tuple(a), tuple(p)) for a, p in arrays["axes"].tolist()),
        worst_m=notes["worst_m"], near=tuple(notes["near"]), texture_breaks=notes["breaks"],
    )  # fmt: skip


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
    axis_name = f"the axis ({d[0]:.3f}, {d[1]:.3f}, {d[2]:.3f})"
    if d.max() > ALONG:
        axis_name = "xyz"[int(np.argmax(d))]
    return fit.share, (
        f"a {'half turn' if n == 2 else f'turn by 1/{n}'}{others} about {axis_name} differs by "
        f"{1e3 * fit.worst * surface.diameter_m:.2g} mm at most; {100 * fit.share:.0f} % of the "
        f"surface by less than {1e3 * config.near_distance * surface.diameter_m:.2g} mm"
    )
