"""Near-symmetric poses told apart: a gear turned by half a tooth, a pipe end for end.

Such poses explain nearly all pixels alike; no threshold on how well one fits can tell them apart.
What can is the difference between the two, over the pixels that differ:
    contrast = (LL_best - LL_rival) / (differing pixels + 20),
LL the likelihood of the images with all other objects in place. The 20 keeps a handful of noisy
pixels from looking decisive. The pose that was there before is a rival like the others.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from realsim.registration.evidence import Cloud
from realsim.registration.search.refine import CandidateConfig, Sought, nearby
from realsim.registration.search.sameness import distinct
from realsim.registration.search.scoring import (
    Array32,
    Canvas,
    Render,
    ScoreConfig,
    compose,
    first_frames,
    likelihoods,
    render,
)
from realsim.registration.solver import Stage

Array = NDArray[np.float64]


@dataclass(frozen=True, kw_only=True, slots=True)
class ContrastConfig:
    """How rivals are compared."""

    lattice: ScoreConfig = field(default_factory=lambda: ScoreConfig(columns=320, frames=16))
    """Denser than for the search: what differs may be a hole of 12 mm."""
    first_frames: int = 6
    """Frames in which all rivals are compared first."""
    finalists: int = 4
    """Rivals that are compared in all frames."""
    points: int = 800
    """Points that fit a rival."""
    margin_m: float = 0.006
    """Points within this of a rival are fitted [m]."""
    stages: tuple[Stage, ...] = (
        Stage(kernel=8.0, cap_m=0.005, steps=6, gated=True),
        Stage(kernel=4.0, cap_m=0.003, steps=6, gated=True),
    )
    """Of that fit: the pose is right but for the near-symmetry."""
    same_m: float = 0.003
    """Poses nearer than this, modulo symmetry, are no rivals [m]..."""
    same_share: float = 0.04
    """...nor those nearer than this share of the object's size: fits of one and the same pose that
    ended a little apart make a right pose look undecided."""
    differ_m: float = 0.0005
    """Rendered depths that differ by more than this belong to differing pixels [m]."""
    offset: float = 20.0
    """Pixels added to those that differ."""


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Decision:
    """Which of the near-symmetric poses it is."""

    T_world_obj: Array
    """(4, 4) the best."""
    contrast: float | None
    """To the nearest rival; None = there is none."""
    T_rival: Array | None
    """(4, 4) that rival."""
    changed: bool
    """Whether the best is not the pose that was there before."""


def decided(
    sought: Sought,
    T_world_obj: Array,
    others: Array32,
    evidence: tuple[Canvas, Cloud, Array],
    config: ContrastConfig,
    refine: CandidateConfig,
) -> Decision:
    """Return the best of a pose and its near-symmetric rivals.

    Args:
        sought: the model.
        T_world_obj: (4, 4) the pose before.
        others: buffer of the canvas with all other objects in place.
        evidence: canvas, measured points (of the object and around it), and the
            near-symmetries (N, 4, 4).
        config: see there.
        refine: constants of the fit.
    """
    canvas, cloud, near = evidence
    Ts = [T_world_obj, *_rivals(sought, T_world_obj, cloud, near, config, refine)]
    apart = max(config.same_m, config.same_share * 2.0 * sought.body.radius_m)
    Ts = [Ts[n] for n in distinct(sought.sameness, Ts, apart)]
    if len(Ts) == 1:
        return Decision(T_world_obj=T_world_obj, contrast=None, T_rival=None, changed=False)
    few = first_frames(canvas, config.first_frames)
    gains = [_gain(few, render(few, sought.body, T), others[: len(few.table)]) for T in Ts]
    best = [n for n in np.argsort([-g for g in gains], kind="stable") if n != 0]
    finalists = [Ts[n] for n in (0, *best[: config.finalists])]
    renders = [render(canvas, sought.body, T) for T in finalists]
    final = np.array([_gain(canvas, r, others) for r in renders])
    winner = int(np.argmax(final))
    contrasts = [
        np.inf if n == winner
        else (final[winner] - final[n])
        / (_differing(canvas, (renders[winner], renders[n]), others, config) + config.offset)
        for n in range(len(finalists))
    ]  # fmt: skip
    rival = int(np.argmin(contrasts))
    return Decision(
        T_world_obj=finalists[winner],
        contrast=float(contrasts[rival]),
        T_rival=finalists[rival],
        changed=winner != 0,
    )


def _rivals(
    sought: Sought,
    T: Array,
    cloud: Cloud,
    near: Array,
    config: ContrastConfig,
    refine: CandidateConfig,
) -> list[Array]:
    """Return the near-symmetric poses (4, 4), each fitted to the points."""
    rivals: list[Array] = []
    for start in T @ near:
        points = nearby(cloud, sought, start, config.margin_m, config.points)
        rivals.append(refine.fit(sought, points, start, config.stages))
    return rivals


def _gain(canvas: Canvas, rendered: Render, others: Array32) -> float:
    """Return the likelihood with the pose in place, less that without it."""
    visible = rendered.z < others[rendered.cells]
    cells = rendered.cells[visible]
    alone = compose(others, [rendered])
    return float(np.sum(likelihoods(canvas, alone, cells) - likelihoods(canvas, others, cells)))


def _differing(
    canvas: Canvas, pair: Sequence[Render], others: Array32, config: ContrastConfig
) -> int:
    """Return in how many compared cells two poses look different."""
    a, b = (compose(others, [r]) for r in pair)
    cells = np.union1d(pair[0].cells, pair[1].cells)
    cells = cells[canvas.measured[cells] > 0]
    return int(np.count_nonzero(np.abs(a[cells] - b[cells]) > config.differ_m))
