"""The last touch: every measured point belongs to the object nearest to it, and only to that.

Where objects touch, the neighbour's points pull at a fit. Once all poses are about right each
point goes to the object whose surface is nearest, and every object is fitted to its own. A result
is taken only if it explains the images as well as before: a thin-walled cup may slide along its
axis without its points noticing.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from realsim.arrays import Array, Array32, Int32
from realsim.registration.evidence import Cloud
from realsim.registration.judging import ownership
from realsim.registration.search.candidates import (
    FINE,
    FINE_POINTS,
    Candidate,
    Sought,
    candidate,
    distinct,
    nearby,
    quick_fit,
)
from realsim.registration.search.scoring import (
    Canvas,
    Render,
    ScoreConfig,
    compose,
    first_frames,
    likelihoods,
    render,
    score,
)
from realsim.registration.solver import Stage

REACH_M = 0.005
"""A point further than this from every surface belongs to nobody [m]."""
ROUNDS = 2
"""Times that points are shared out and objects fitted."""
LEAST_POINTS = 60
"""Fewer own points leave an object where it is."""
KEPT_GAIN = 0.97
"""Share of the rendered gain that must remain."""


def owners(cloud: Cloud, soughts: Sequence[Sought], Ts: Sequence[Array], reach_m: float) -> Int32:
    """Return for every point (N,) the place of the object whose surface is nearest; -1 = none.

    Args:
        cloud: measured points.
        soughts: the objects' models.
        Ts: their poses (4, 4).
        reach_m: greatest distance [m].
    """
    claims = ownership.make_claims([s.body for s in soughts], Ts, None, reach_m)
    return ownership.owners(claims, cloud.points)


def polish_poses(
    canvas: Canvas, cloud: Cloud, placed: Sequence[tuple[Sought, Candidate]]
) -> list[Candidate]:
    """Return the placed objects fitted to their own points.

    Args:
        canvas: where poses are rendered.
        cloud: fine points above the table.
        placed: models and poses.
    """
    now = [c for _, c in placed]
    soughts = [s for s, _ in placed]
    for _ in range(ROUNDS):
        owner = owners(cloud, soughts, [c.T_world_obj for c in now], REACH_M)
        for n, sought in enumerate(soughts):
            own = np.flatnonzero(owner == n)
            if len(own) < LEAST_POINTS:
                continue
            if len(own) > FINE_POINTS:
                own = own[np.linspace(0, len(own) - 1, FINE_POINTS).astype(np.int64)]
            T = quick_fit(sought.body, cloud.select(own), now[n].T_world_obj, FINE)
            new = candidate(sought, canvas, T, now[n].source)
            buffer = compose(canvas.table, [c.rendered for k, c in enumerate(now) if k != n])
            before = score(canvas, now[n].rendered, buffer).gain
            if score(canvas, new.rendered, buffer).gain >= KEPT_GAIN * before:
                now[n] = new
    return now


LATTICE = ScoreConfig(columns=320, frames=16)
"""Denser than for the search: what differs may be a hole of 12 mm."""
FIRST_FRAMES = 6
"""Frames in which all rivals are compared first."""
FINALISTS = 4
"""Rivals that are compared in all frames."""
POINTS = 800
"""Points that fit a rival."""
MARGIN_M = 0.006
"""Points within this of a rival are fitted [m]."""
STAGES = (
    Stage(kernel=8.0, cap_m=0.005, steps=6, gated=True),
    Stage(kernel=4.0, cap_m=0.003, steps=6, gated=True),
)
"""Stages of that fit: the pose is right but for the near-symmetry."""
SAME_M = 0.003
"""Poses nearer than this, modulo symmetry, are no rivals [m]."""
SAME_SHARE = 0.04
"""The same as a share of the object's size: fits of one and the same pose that
ended a little apart make a right pose look undecided."""
DIFFER_M = 0.0005
"""Rendered depths that differ by more than this belong to differing pixels [m]."""
OFFSET = 20.0
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


def decide_rivals(
    sought: Sought, T_world_obj: Array, others: Array32, evidence: tuple[Canvas, Cloud, Array]
) -> Decision:
    """Return the best of a pose and its near-symmetric rivals.

    Args:
        sought: the model.
        T_world_obj: (4, 4) the pose before.
        others: buffer of the canvas with all other objects in place.
        evidence: canvas, measured points (of the object and around it), and the
            near-symmetries (N, 4, 4).
    """
    canvas, cloud, near = evidence
    Ts = [T_world_obj, *_rivals(sought, T_world_obj, cloud, near)]
    apart = max(SAME_M, SAME_SHARE * 2.0 * sought.body.radius_m)
    Ts = [Ts[n] for n in distinct(sought.sameness, Ts, apart)]
    if len(Ts) == 1:
        return Decision(T_world_obj=T_world_obj, contrast=None, T_rival=None, changed=False)
    few = first_frames(canvas, FIRST_FRAMES)
    gains = [_gain(few, render(few, sought.body, T), others[: len(few.table)]) for T in Ts]
    best = [n for n in np.argsort([-g for g in gains], kind="stable") if n != 0]
    finalists = [Ts[n] for n in (0, *best[:FINALISTS])]
    renders = [render(canvas, sought.body, T) for T in finalists]
    final = np.array([_gain(canvas, r, others) for r in renders])
    winner = int(np.argmax(final))
    contrasts = [
        np.inf if n == winner
        else (final[winner] - final[n])
        / (_differing(canvas, (renders[winner], renders[n]), others) + OFFSET)
        for n in range(len(finalists))
    ]  # fmt: skip
    rival = int(np.argmin(contrasts))
    return Decision(
        T_world_obj=finalists[winner],
        contrast=float(contrasts[rival]),
        T_rival=finalists[rival],
        changed=winner != 0,
    )


def _rivals(sought: Sought, T: Array, cloud: Cloud, near: Array) -> list[Array]:
    """Return the near-symmetric poses (4, 4), each fitted to the points."""
    rivals: list[Array] = []
    for start in T @ near:
        points = nearby(cloud, sought, start, MARGIN_M, POINTS)
        rivals.append(quick_fit(sought.body, points, start, STAGES))
    return rivals


def _gain(canvas: Canvas, rendered: Render, others: Array32) -> float:
    """Return the likelihood with the pose in place, less that without it."""
    visible = rendered.z < others[rendered.cells]
    cells = rendered.cells[visible]
    alone = compose(others, [rendered])
    return float(np.sum(likelihoods(canvas, alone, cells) - likelihoods(canvas, others, cells)))


def _differing(canvas: Canvas, pair: Sequence[Render], others: Array32) -> int:
    """Return in how many compared cells two poses look different."""
    a, b = (compose(others, [r]) for r in pair)
    cells = np.union1d(pair[0].cells, pair[1].cells)
    cells = cells[canvas.measured[cells] > 0]
    return int(np.count_nonzero(np.abs(a[cells] - b[cells]) > DIFFER_M))
