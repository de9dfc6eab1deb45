"""Where to put the scene: how much of the hemisphere the arm reaches, from place to place.

The arm's first joint turns it to any side alike, so a place is a distance from the base's axis and
a height of the table; obstacles and the table's outline are left to the plan itself.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike

from realsim.errors import InputError
from realsim.robots.kinematics import DhChain
from realsim.robots.shapes import Mount
from realsim_capture_plans.collision.model import CollisionModel
from realsim_capture_plans.planning.elbow import bend
from realsim_capture_plans.planning.record import PlanConfig
from realsim_capture_plans.planning.view_quality import hole_deg
from realsim_capture_plans.planning.viewpoints import (
    better_elbow,
    cap_rim,
    golden_cap,
    hemisphere_poses,
    reachable,
    thin_directions,
)

DISTANCES_M = (0.25, 0.30, 0.35, 0.40, 0.45, 0.50, 0.55, 0.60)
"""Distances of the scene's centre from the base's axis that are tried."""
LIFTS_M = (-0.20, 0.0, 0.20)
"""Heights of the table that are tried, from the one that is planned for."""
NO_PLAN_DEG = 180.0
"""The hole where there are fewer reachable directions than views."""
BASE_RADIUS_M = 0.12
"""A table that is higher than the base begins this far in front of its axis [m]."""
DIRECTIONS = 400
"""Directions tried per place: shares to 1 %, holes to 1 degree."""
POSES = 16
"""Camera poses tried per direction."""


@dataclass(frozen=True, kw_only=True, slots=True)
class Placement:
    """One place for the scene, and what can be seen of it."""

    center: tuple[float, float, float]
    """The scene's centre in base [m], straight in front of the base."""
    table_height_m: float
    """Top of the table in base [m]."""
    reachable_share: float
    """Of the directions of the cap."""
    hole_deg: float
    """Greatest hole in the cap that n views leave [deg]; 180 where fewer than n are reachable."""
    one_elbow_hole_deg: float
    """The same without a change of the elbow's side, which takes seconds and much room."""


def advise(
    chain: DhChain,
    mount: Mount,
    config: PlanConfig,
    n: int,
    aim_height_m: float,
    *,
    distances_m: Sequence[float] = DISTANCES_M,
    lifts_m: Sequence[float] = LIFTS_M,
    tick: Callable[[int, int], None] | None = None,
) -> list[Placement]:
    """Return places for the scene, the best first: the smallest hole with one side of the elbow.

    Args:
        chain: the arm.
        mount: the camera on the flange.
        config: radii, elevations, clearances, and the table's height now.
        n: number of views planned.
        aim_height_m: of the scene's centre above the table [m].
        distances_m: from the base's axis to the scene's centre.
        lifts_m: added to the table's height.
        tick: called with (places tried, places).

    Raises:
        InputError: n is not positive.
    """
    if n < 1:
        raise InputError(f"places for {n} views were asked for; at least 1 view is needed.")
    places = [(x, config.table_height_m + lift) for lift in lifts_m for x in distances_m]
    found: list[Placement] = []
    for k, (x, height) in enumerate(places):
        found.append(_placement(chain, mount, config, n, (x, 0.0, height + aim_height_m), height))
        if tick is not None:
            tick(k + 1, len(places))
    return sorted(found, key=lambda p: (round(p.one_elbow_hole_deg), p.hole_deg))


def _placement(
    chain: DhChain,
    mount: Mount,
    config: PlanConfig,
    n: int,
    center: tuple[float, float, float],
    table_height_m: float,
) -> Placement:
    """Return what can be seen of a scene at one place."""
    x0, *rest = config.table_rectangle_m
    if table_height_m > 0:
        # The base stands beside a table that is higher than it.
        x0 = max(x0, BASE_RADIUS_M)
    here = replace(
        config, table_height_m=table_height_m, table_rectangle_m=(x0, rest[0], rest[1], rest[2])
    )
    model = CollisionModel(chain, mount, here.work_cell(center, "hemisphere"), here.clearance_m)
    count = max(DIRECTIONS, n)
    directions = np.concatenate(
        [golden_cap(count, here.elevation_deg), cap_rim(count, here.elevation_deg)]
    )
    poses, item = hemisphere_poses(center, directions, here.radius_m, POSES, 0.0)
    found = reachable(poses, item, mount.T_ee_cam, model, here.sigma_min)
    one_side = found.where(bend(chain, found.joints) * better_elbow(found, chain) > 0)
    holes: list[float] = []
    for ok in (np.unique(found.item), np.unique(one_side.item)):
        few = len(ok) < n
        chosen = (
            directions[ok]
            if few
            else directions[ok][thin_directions(directions[ok], n, directions)]
        )
        holes.append(NO_PLAN_DEG if few else hole_deg(chosen, here.elevation_deg))
    return Placement(
        center=center,
        table_height_m=table_height_m,
        reachable_share=len(np.unique(found.item)) / len(directions),
        hole_deg=holes[0],
        one_elbow_hole_deg=holes[1],
    )


def advice(placements: Sequence[Placement], center: ArrayLike, table_height_m: float) -> str:
    """Return one sentence that compares the best place with where the scene stands now.

    Args:
        placements: as `advise` returns them.
        center: (3,) where the scene's centre is now, in base [m].
        table_height_m: where the table's top is now.
    """
    best = placements[0]
    x, y, _ = np.asarray(center, dtype=np.float64).tolist()
    now = float(np.hypot(x, y))
    same_height = [p for p in placements if abs(p.table_height_m - table_height_m) < 1e-9]
    here = min(same_height, key=lambda p: abs(p.center[0] - now), default=best)
    level = min(same_height, key=placements.index, default=best)
    text = (
        f"Put the scene's centre {level.center[0]:.2f} m from the base's axis: "
        f"{100 * level.reachable_share:.0f} % of the cap is reachable and the largest hole is "
        f"{level.one_elbow_hole_deg:.0f} deg; where it is now ({now:.2f} m) it is "
        f"{100 * here.reachable_share:.0f} % and {here.one_elbow_hole_deg:.0f} deg (both without a "
        "change of the elbow's side)."
    )
    if round(best.one_elbow_hole_deg) < round(level.one_elbow_hole_deg):
        lift = best.table_height_m - table_height_m
        text += (
            f" A table {abs(lift):.2f} m {'higher' if lift > 0 else 'lower'}, with the centre at "
            f"{best.center[0]:.2f} m, would leave {best.one_elbow_hole_deg:.0f} deg."
        )
    return text
