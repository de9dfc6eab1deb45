"""From a rough start to the right valley: many starts, fitted coarsely, judged by rendering."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from realsim.geometry import se3
from realsim.registration.body import Body
from realsim.registration.compare import Comparer
from realsim.registration.evidence import Cloud
from realsim.registration.solver import Fit, FreeSpace, SolverConfig, solve_pose

Array = NDArray[np.float64]


@dataclass(frozen=True, kw_only=True, slots=True)
class SearchConfig:
    """How the neighbourhood of a start is searched."""

    offset_m: float = 0.012
    """Displacement of the additional starts; a fit's own basin is about as wide."""
    yaw_deg: float = 20.0
    """Turn about the table's normal: the direction an operator judges worst."""
    tilt_deg: float = 14.0
    """Turn about two axes in the table."""
    try_flips: bool = False
    """Whether to start also from half turns about the object's three axes (wrong way round)."""
    same_m: float = 0.002
    """Poses closer than this at every corner of the box are one hypothesis."""
    turn_share: float = 0.05
    """Share of the gain that a half turn from the start costs: 1 % for 36 deg, less than any real
    difference in fit, more than the facets of a round body make."""
    refined: int = 3
    """So many of the best hypotheses are refined on the fine cloud and compared again."""


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class BestHypothesis:
    """The best hypothesis of one object."""

    fit: Fit
    gain_px: float
    """Rendered gain over the bare table, in pixels."""
    gain_per_pixel: float
    report: dict[str, Any]
    """Starts tried, distinct results, gains of the best and the runner-up."""


def perturbed_starts(body: Body, up_world: Array | None, config: SearchConfig) -> Array:
    """Return the starts (K, 4, 4): the given one first, then its neighbours.

    The axes are the table's normal and two across it taken from the object itself, so that the set
    moves with the world; turns are about the centre of the object's box.

    Args:
        body: the object at its start.
        up_world: (3,) the table's normal, or None: the object's own z.
        config: see there.
    """
    T = body.T_start
    up = np.array([0.0, 0.0, 1.0]) if up_world is None else T[:3, :3].T @ up_world
    x = np.eye(3)[int(np.argmin(np.abs(up)))]
    x = x - (x @ up) * up
    axes = np.stack([x / np.linalg.norm(x), np.cross(up, x / np.linalg.norm(x)), up])
    yaw, tilt, step = np.radians(config.yaw_deg), np.radians(config.tilt_deg), config.offset_m
    # Rows: turn about x, y, up; shift along x, y, up.
    rows = [np.zeros(6)]
    rows += [np.eye(6)[i] * s for i in range(6) for s in (1.0, -1.0)]
    rows += [
        np.array([0, 0, c, a, b, 0], dtype=np.float64)
        for a in (1, -1) for b in (1, -1) for c in (1, -1)
    ]  # fmt: skip
    table = np.array(rows) * [tilt, tilt, yaw, step, step, step]
    moves = se3.from_rt(se3.exp_so3(table[:, :3] @ axes), table[:, 3:] @ axes)
    if config.try_flips:
        flips = se3.from_rt(se3.exp_so3(np.pi * np.eye(3)), np.zeros(3))
        moves = np.concatenate([moves, flips])
    C = se3.from_translation(body.center_obj)
    return T @ C @ moves @ se3.invert(C)


def search(
    body: Body,
    coarse: Cloud,
    fine: Cloud,
    comparer: Comparer,
    free_space: FreeSpace | None,
    configs: tuple[SearchConfig, SolverConfig],
) -> BestHypothesis:
    """Return the pose near the start that explains the images best.

    Args:
        body: the object at its start.
        coarse: its measured points on large voxels.
        fine: the same on small ones.
        comparer: the frames in which hypotheses are rendered.
        free_space: see `solve_pose`.
        configs: of the search and of the solver.
    """
    config, solver = configs
    up = None if comparer.plane is None else comparer.plane.T_world_table[:3, 2]
    starts = perturbed_starts(body, up, config)
    fits = [solve_pose(body, coarse, T, solver.coarse, solver, free_space) for T in starts]
    distinct = distinct_fits(body, fits, config.same_m)
    stride = comparer.stride_of(body, body.T_start)
    gains = [comparer.gain(body, f.T_world_obj, stride)[0] for f in distinct]
    order = np.argsort(
        [-_preference(body, f, g, config) for f, g in zip(distinct, gains, strict=True)],
        kind="stable",
    )
    refined = [
        solve_pose(body, fine, distinct[i].T_world_obj, solver.fine, solver, free_space)
        for i in order[: config.refined]
    ]
    refined = distinct_fits(body, refined, 0.25 * config.same_m)
    final = [comparer.gain(body, f.T_world_obj, stride) for f in refined]
    best = int(
        np.argmax([_preference(body, f, g[0], config) for f, g in zip(refined, final, strict=True)])
    )
    rivals = [g[0] for i, g in enumerate(final) if i != best]
    report = {
        "starts": len(starts),
        "distinct_results": len(distinct),
        "gain_px": final[best][0],
        "gain_px_runner_up": max(rivals) if rivals else None,
        "gain_px_coarse": sorted((float(g) for g in gains), reverse=True)[:5],
        "steps": sum(f.steps for f in fits) + sum(f.steps for f in refined),
    }
    gain_px, per_pixel = final[best]
    return BestHypothesis(fit=refined[best], gain_px=gain_px, gain_per_pixel=per_pixel, report=report)


def _preference(body: Body, fit: Fit, gain_px: float, config: SearchConfig) -> float:
    """Return the gain less a small share for the turn from the start.

    A can looks the same from all sides: of poses that explain the images alike, the one nearest to
    the start is meant.
    """
    turn = float(se3.angle(body.T_start[:3, :3].T @ fit.T_world_obj[:3, :3]))
    return gain_px - abs(gain_px) * config.turn_share * turn / np.pi


def distinct_fits(body: Body, fits: list[Fit], same_m: float) -> list[Fit]:
    """Return the fits that differ: of those within `same_m` at every box corner, the first."""
    low, high = body.model.mesh.bounds
    unit = np.array([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)])
    corners = low + unit * (high - low)
    kept: list[Fit] = []
    places: list[Array] = []
    for f in fits:
        place = se3.transform(f.T_world_obj, corners)
        if all(np.max(np.linalg.norm(place - p, axis=1)) > same_m for p in places):
            kept.append(f)
            places.append(place)
    return kept
