"""Benchmark of capture plans: 256 views with a UR5 and a D405, from nothing.

    uv run python benchmarks/planning.py [--quick] [--json FILE] [--seed N]

Figures (keys of the JSON's "figures"), the worst of the seeds:
  views_valid         views that are reached to 1e-6, inside the limits, free, not singular, of 256
  hole_reachable_deg  from any reachable direction to the nearest view
  hole_cap_deg        the same over the whole cap, elevation >= 15 deg, at the best placement
  tour_over_bound     tour time over half the sum of the two nearest clusters (a lower bound)
  tour_over_held_karp the same over the Held-Karp bound, which is higher
  tour_over_greedy    tour time over ring by ring with the nearest free branch, roll and turn, same
                      views and distances
  tour_over_greedy_free   the same with as many distances and rolls to choose from as the plan had
  colliding_edges     moves that meet the arm's own meshes, the table or the scene, every 0.02 rad
  plan_cpu_s          of one whole plan, metrics included, compiled code warm
  unsafe_share, overcautious_share   of our shapes against the meshes, random configurations
The meshes are those of the example-robot-data wheel; without it the last three keys are left out.
"""

import argparse
import time

import blas_threads  # noqa: F401
import numpy as np
from figures import Figure, Found, Goal, run

from realsim.errors import MissingLibraryError
from realsim.robots.arm import UR5
from realsim_capture_plans import PlanConfig, d405_mount
from realsim_capture_plans.collision.model import interpolate
from realsim_capture_plans.planning.advise import DISTANCES_M, advise
from realsim_capture_plans.planning.make import hemisphere_plan
from realsim_capture_plans.planning.ordering import move_seconds
from realsim_capture_plans.planning.record import CapturePlan
from realsim_capture_plans.planning.viewpoints import (
    hemisphere_poses,
    look_at_poses,
    reachable,
    with_turns,
)

VIEWS, QUICK_VIEWS, SEEDS = 256, 48, 3
AIM_HEIGHT_M = 0.05
RING_DEG = 10.0
"""Width of the rings of the greedy order: its best of 5, 7.5, 10 and 15 degrees."""
ROLLS = 16
"""Rolls per view that the greedy order chooses from."""
POSES = 60
"""Camera poses per view that it chooses from with free distances: as many as the plan's search."""
REACHED_M = 1e-6
MESH_STEP_RAD = 0.02


def valid_views(plan: CapturePlan) -> int:
    """Count the views that are what they claim to be, asked anew."""
    chain = plan.chain
    model = plan.collision_model()
    looks = plan.center_world - plan.Ts_base_cam[:, :3, 3]
    distance = np.linalg.norm(looks, axis=-1)
    axis = plan.Ts_base_cam[:, :3, 2]
    aimed = np.linalg.norm(np.cross(looks, axis), axis=-1) < REACHED_M
    low, high = plan.config.radius_m
    ok = aimed & (distance > low - REACHED_M) & (distance < high + REACHED_M)
    ok &= chain.limits.contains(plan.joints) & model.free(plan.joints)
    ok &= chain.sigma_min(plan.joints) >= plan.config.sigma_min - 1e-9
    return int(ok.sum())


def greedy_ring_seconds(plan: CapturePlan, *, free_radius: bool) -> float:
    """Return the time of the usual order: rings from the top down, always the nearest candidate.

    The rings are gone round in turns to and fro; collisions on the way are not even looked at.

    Args:
        plan: its directions are used, and its distances unless they are free.
        free_radius: whether the nearest is chosen among as many distances and rolls as the plan's
            own search has, or among rolls alone.
    """
    directions = plan.directions()
    elevation = np.degrees(np.arcsin(np.clip(directions[:, 2], -1, 1)))
    ring = np.floor((90.0 - elevation) / RING_DEG).astype(int)
    azimuth = np.arctan2(directions[:, 1], directions[:, 0])
    order = np.lexsort([np.where(ring % 2 == 0, azimuth, -azimuth), ring])
    if free_radius:
        poses, item = hemisphere_poses(
            plan.center_world, directions, plan.config.radius_m, POSES, 0.0
        )
    else:
        item = np.repeat(np.arange(len(directions)), ROLLS)
        rolls = np.tile(np.arange(ROLLS) * (2 * np.pi / ROLLS), len(directions))
        poses = look_at_poses(plan.Ts_base_cam[item, :3, 3], plan.center_world, rolls)
    found = reachable(
        poses, item, plan.mount.T_ee_cam, plan.collision_model(), plan.config.sigma_min
    )
    here, total = plan.home, 0.0
    for view in order:
        near = with_turns(found.joints[found.item == view], plan.home, plan.chain, plan.config)
        if len(near) == 0:  # none of these rolls is free: what the plan found
            near = plan.joints[view][None]
        gaps = np.abs(near - here).max(-1)
        total += float(move_seconds(gaps.min(), plan.config.speed, plan.config.acceleration))
        here = near[int(np.argmin(gaps))]
    return total


def mesh_figures(plan: CapturePlan, configurations: int) -> dict[str, float]:
    """Return what the arm's own meshes say of the plan and of our shapes; nothing without them."""
    from realsim_capture_plans.collision.ur5_meshes import MeshModel, compare_with_meshes

    try:
        meshes = MeshModel(plan.mount, plan.cell)
    except MissingLibraryError:
        return {}
    corners = np.concatenate([plan.home[None], *(plan.move(k)[1:] for k in range(len(plan)))])
    samples, owner = interpolate(corners[:-1], corners[1:], MESH_STEP_RAD)
    hits = np.unique(owner[meshes.touches(samples)])
    shares = compare_with_meshes(plan.mount, plan.cell, configurations, 0)
    return {"colliding_edges": float(len(hits))} | shares


def planned(seed: int, center: tuple[float, float, float], quick: bool) -> dict[str, float]:
    """Make one plan and return its figures."""
    config, views = PlanConfig(), QUICK_VIEWS if quick else VIEWS
    began = time.process_time()
    plan = hemisphere_plan(views, center, d405_mount(), config, np.random.default_rng(seed))
    cpu_s = time.process_time() - began
    seconds = plan.metrics["seconds"]
    return {
        "views_valid": float(valid_views(plan)),
        "hole_reachable_deg": plan.metrics["hole_reachable_deg"],
        "hole_cap_deg": plan.metrics["hole_cap_deg"],
        "tour_s": seconds,
        "tour_over_bound": seconds / plan.metrics["tour_bound_two_nearest_s"],
        "tour_over_held_karp": plan.metrics["tour_over_bound"],
        "tour_over_greedy": seconds / greedy_ring_seconds(plan, free_radius=False),
        "tour_over_greedy_free": seconds / greedy_ring_seconds(plan, free_radius=True),
        "plan_cpu_s": cpu_s,
        **mesh_figures(plan, 1000 if quick else 20000),
    }


def plans(arguments: argparse.Namespace) -> Found:
    """Return the worst of some plans at the best placement."""
    # Compiles what numba compiles.
    hemisphere_plan(8, (0.35, 0.0, 0.05), d405_mount(), PlanConfig(), np.random.default_rng(0))
    began = time.process_time()
    distances = (0.35, 0.40) if arguments.quick else DISTANCES_M
    center = advise(
        UR5, d405_mount(), PlanConfig(), VIEWS, AIM_HEIGHT_M, distances_m=distances, lifts_m=(0.0,)
    )[0].center
    advice = {"advice_cpu_s": time.process_time() - began, "center_x_m": center[0]}
    seeds = range(arguments.seed, arguments.seed + (1 if arguments.quick else SEEDS))
    runs = [planned(seed, center, arguments.quick) for seed in seeds]
    worst = {key: (min if key == "views_valid" else max)(r[key] for r in runs) for key in runs[0]}
    return Found(figures=worst | advice, cases={"runs": runs})


FIGURES = {
    "views_valid": Figure(unit="", goal=Goal(low=VIEWS)),
    "hole_reachable_deg": Figure(unit="deg", goal=Goal(high=6)),
    "hole_cap_deg": Figure(unit="deg", goal=Goal(high=8)),
    "tour_s": Figure(unit="s"),
    "tour_over_bound": Figure(unit=""),
    "tour_over_held_karp": Figure(unit="", goal=Goal(high=1.22)),
    "tour_over_greedy": Figure(unit=""),
    "tour_over_greedy_free": Figure(unit=""),
    "plan_cpu_s": Figure(unit="s"),
    "colliding_edges": Figure(unit="", goal=Goal(low=0, high=0)),
    "unsafe_share": Figure(unit="", goal=Goal(low=0, high=0)),
    "overcautious_share": Figure(unit=""),
    "mesh_colliding_share": Figure(unit=""),
    "advice_cpu_s": Figure(unit="s"),
    "center_x_m": Figure(unit="m"),
}

if __name__ == "__main__":
    packages = ("numpy", "eaik", "coal", "pin", "ompl")
    run("planning", __doc__, packages, FIGURES, {"plans": plans})
