"""Where to put the scene: how much of the hemisphere the arm reaches, from place to place.

The arm's first joint turns it to any side alike, so a place is a distance from the base's axis and
a height of the table; obstacles and the table's outline are left to the plan itself.
"""

from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike

from realsim.errors import InputError
from realsim.robots.kinematics import DhChain
from realsim.robots.shapes import Mount
from realsim_capture_plans.collision.model import CollisionModel
from realsim_capture_plans.planning import viewpoints
from realsim_capture_plans.planning.elbow import bend, reach_m
from realsim_capture_plans.planning.record import PlanConfig
from realsim_capture_plans.planning.view_quality import hole_deg

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
LONG_ARM_M = 0.65
"""Before an arm that reaches less from shoulder to wrist [m] nearer places are tried."""
QUICK_DIRECTIONS, QUICK_POSES = 60, 6
"""The same of a quick look at where else the scene might be."""
QUICK_DISTANCES_M = (0.32, 0.40, 0.50)
RADIUS_SHARES = (1.0, 0.8, 0.65)
"""Shares of the radii that a quick look tries: the greatest that suffices is proposed."""
SUFFICES = 0.9
"""Share of the best place's directions with which greater radii are as good."""


@dataclass(frozen=True, kw_only=True, slots=True)
class Placement:
    """One place for the scene, and what can be seen of it."""

    center: tuple[float, float, float]
    """The scene's centre in base [m], straight in front of the base."""
    table_height_m: float
    """Top of the table in base [m]."""
    reachable_share: float
    """Share of the directions of the cap."""
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
    distances_m: Sequence[float] | None = None,
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
        distances_m: from the base's axis to the scene's centre; None are `DISTANCES_M`, nearer
            before a short arm.
        lifts_m: added to the table's height.
        tick: called with (places tried, places).

    Raises:
        InputError: n is not positive, or the arm cannot stand before the scene anywhere.
    """
    if n < 1:
        raise InputError(f"places for {n} views were asked for; at least 1 view is needed.")
    tried = _within_reach(DISTANCES_M, chain) if distances_m is None else distances_m
    places = [(x, config.table_height_m + lift) for lift in lifts_m for x in tried]
    found: list[Placement] = []
    trouble: InputError | None = None
    for k, (x, height) in enumerate(places):
        try:
            center = (x, 0.0, height + aim_height_m)
            found.append(_placement(chain, mount, config, n, center, height))
        except InputError as error:  # the keep-out box would reach into the arm
            trouble = error
        if tick is not None:
            tick(k + 1, len(places))
    if trouble is not None and not found:
        raise trouble
    return sorted(found, key=lambda p: (round(p.one_elbow_hole_deg), p.hole_deg))


def _within_reach(distances_m: Sequence[float], chain: DhChain) -> list[float]:
    share = min(1.0, reach_m(chain) / LONG_ARM_M)
    return [round(share * x, 3) for x in distances_m]


def better_place(chain: DhChain, mount: Mount, config: PlanConfig, aim_height_m: float) -> str:
    """Return in a sentence where more views of a scene are reachable, by a quick look.

    Args:
        chain: the arm.
        mount: the camera on the flange.
        config: radii, elevations, clearances, the table's height.
        aim_height_m: of the scene's centre above the table [m].
    """
    found: list[tuple[Placement, PlanConfig]] = []
    for share in RADIUS_SHARES:
        near, far = config.radius_m
        smaller = replace(config, radius_m=(round(share * near, 3), round(share * far, 3)))
        for x in _within_reach(QUICK_DISTANCES_M, chain):
            center = (x, 0.0, config.table_height_m + aim_height_m)
            with suppress(InputError):  # the keep-out box would reach into the arm
                here = _placement(
                    chain, mount, smaller, 1, center, config.table_height_m, QUICK_DIRECTIONS,
                    QUICK_POSES,
                )  # fmt: skip
                found.append((here, smaller))
    most = max((place.reachable_share for place, _ in found), default=0.0)
    if most == 0.0:
        return (
            f"With the mount '{mount.name}' a {chain.name} reaches no view of a scene in front of "
            f"it on a table at z = {config.table_height_m:g} m: check --table-height and --mount."
        )
    good = [one for one in found if one[0].reachable_share >= SUFFICES * most]
    place, smaller = max(good, key=lambda one: (one[1].radius_m, one[0].reachable_share))
    x, _, z = place.center
    radius = (
        ""
        if smaller.radius_m == config.radius_m
        else f" with --radius {smaller.radius_m[0]:g},{smaller.radius_m[1]:g}"
    )
    return (
        f"A {chain.name} reaches about {100 * place.reachable_share:.0f} % of the directions at "
        f"--center {x:g},0,{z:g}{radius}; `realsim plan --advise` looks more closely."
    )


def _placement(
    chain: DhChain,
    mount: Mount,
    config: PlanConfig,
    n: int,
    center: tuple[float, float, float],
    table_height_m: float,
    least_directions: int = DIRECTIONS,
    poses_each: int = POSES,
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
    count = max(least_directions, n)
    directions = viewpoints.cap_with_rim(count, here.elevation_deg)
    poses, item = viewpoints.hemisphere_poses(center, directions, here.radius_m, poses_each, 0.0)
    found = viewpoints.reachable(poses, item, mount.T_ee_cam, model, here.sigma_min)
    one_side = found.where(bend(chain, found.joints) * viewpoints.better_elbow(found, chain) > 0)
    holes: list[float] = []
    for ok in (np.unique(found.item), np.unique(one_side.item)):
        hole = NO_PLAN_DEG
        if len(ok) >= n:
            chosen = directions[ok][viewpoints.thin_directions(directions[ok], n, directions)]
            hole = hole_deg(chosen, here.elevation_deg)
        holes.append(hole)
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
