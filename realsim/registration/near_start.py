"""From rough starts to poses, cameras taken at their word: each object alone, then all together.

Many starts around the given one are fitted coarsely and judged by rendering. Then every measured
point belongs to the model it is nearest to, and all objects are fitted to their own.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from realsim.arrays import Array
from realsim.geometry import se3
from realsim.geometry.mesh import box_corners
from realsim.records import SupportPlane
from realsim.registration.body import Body
from realsim.registration.compare import Comparer
from realsim.registration.evidence import Cloud
from realsim.registration.solver import COARSE, FINE, FreeSpace, PoseFit, solve_pose

OFFSET_M = 0.012
"""Displacement of the additional starts; a fit's own basin is about as wide."""
YAW_DEG = 20.0
"""Turn about the table's normal: the direction an operator judges worst."""
TILT_DEG = 14.0
"""Turn about two axes in the table."""
SAME_M = 0.002
"""Poses closer than this at every corner of the box are one hypothesis."""
TURN_SHARE = 0.05
"""Share of the gain that a half turn from the start costs: 1 % for 36 deg, less than any real
difference in fit, more than the facets of a round body make."""
REFINED = 3
"""Number of best hypotheses that are refined on the fine cloud and compared again."""


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class BestStart:
    """The best hypothesis of one object."""

    fit: PoseFit
    gain_px: float
    """Rendered gain over the bare table, in pixels."""
    gain_per_pixel: float
    report: dict[str, Any]
    """Starts tried, distinct results, gains of the best and the runner-up."""


def perturbed_starts(body: Body, up_world: Array | None) -> Array:
    """Return the starts (K, 4, 4): the given one first, then its neighbours.

    The axes are the table's normal and two across it taken from the object itself, so that the set
    moves with the world; turns are about the centre of the object's box.

    Args:
        body: the object at its start.
        up_world: (3,) the table's normal, or None: the object's own z.
    """
    T = body.T_start
    up = np.array([0.0, 0.0, 1.0]) if up_world is None else T[:3, :3].T @ up_world
    x = np.eye(3)[int(np.argmin(np.abs(up)))]
    x = x - (x @ up) * up
    axes = np.stack([x / np.linalg.norm(x), np.cross(up, x / np.linalg.norm(x)), up])
    yaw, tilt, step = np.radians(YAW_DEG), np.radians(TILT_DEG), OFFSET_M
    # Rows: turn about x, y, up; shift along x, y, up.
    rows = [np.zeros(6)]
    rows += [np.eye(6)[i] * s for i in range(6) for s in (1.0, -1.0)]
    rows += [
        np.array([0, 0, c, a, b, 0], dtype=np.float64)
        for a in (1, -1) for b in (1, -1) for c in (1, -1)
    ]  # fmt: skip
    table = np.array(rows) * [tilt, tilt, yaw, step, step, step]
    moves = se3.from_rt(se3.exp_so3(table[:, :3] @ axes), table[:, 3:] @ axes)
    C = se3.from_translation(body.center_obj)
    return T @ C @ moves @ se3.invert(C)


def free_space_of(comparer: Comparer) -> FreeSpace:
    """Return the images that models may not stand in front of: few views leave much unseen."""
    i, noise = comparer.intrinsics, comparer.noise
    return FreeSpace(
        depths=np.stack([f.depth_m for f in comparer.frames]).astype(np.float32),
        Ts_cam_world=np.stack([se3.invert(f.T_world_cam) for f in comparer.frames]),
        camera=np.concatenate([[i.fx, i.fy, i.cx, i.cy], i.distortion]),
        noise=(noise.per_m, noise.floor_m),
    )


def search(
    body: Body, coarse: Cloud, fine: Cloud, comparer: Comparer, free_space: FreeSpace | None
) -> BestStart:
    """Return the pose near the start that explains the images best.

    Args:
        body: the object at its start.
        coarse: its measured points on large voxels.
        fine: the same on small ones.
        comparer: the frames in which hypotheses are rendered.
        free_space: see `solve_pose`.
    """
    up = None if comparer.plane is None else comparer.plane.T_world_table[:3, 2]
    starts = perturbed_starts(body, up)
    fits = [solve_pose(body, coarse, T, COARSE, free_space) for T in starts]
    distinct = distinct_fits(body, fits, SAME_M)
    stride = comparer.stride_of(body, body.T_start)
    gains = [comparer.gain(body, f.T_world_obj, stride)[0] for f in distinct]
    order = np.argsort(
        [-_preference(body, f, g) for f, g in zip(distinct, gains, strict=True)], kind="stable"
    )
    refined = [
        solve_pose(body, fine, distinct[i].T_world_obj, FINE, free_space) for i in order[:REFINED]
    ]
    refined = distinct_fits(body, refined, 0.25 * SAME_M)
    final = [comparer.gain(body, f.T_world_obj, stride) for f in refined]
    best = int(np.argmax([_preference(body, f, g[0]) for f, g in zip(refined, final, strict=True)]))
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
    return BestStart(fit=refined[best], gain_px=gain_px, gain_per_pixel=per_pixel, report=report)


def _preference(body: Body, fit: PoseFit, gain_px: float) -> float:
    """Return the gain less a small share for the turn from the start.

    A can looks the same from all sides: of poses that explain the images alike, the one nearest to
    the start is meant.
    """
    turn = float(se3.angle(body.T_start[:3, :3].T @ fit.T_world_obj[:3, :3]))
    return gain_px - abs(gain_px) * TURN_SHARE * turn / np.pi


def distinct_fits(body: Body, fits: list[PoseFit], same_m: float) -> list[PoseFit]:
    """Return the fits that differ: of those within `same_m` at every box corner, the first."""
    corners = box_corners(*body.model.mesh.bounds)
    kept: list[PoseFit] = []
    places: list[Array] = []
    for f in fits:
        place = se3.transform(f.T_world_obj, corners)
        if all(np.max(np.linalg.norm(place - p, axis=1)) > same_m for p in places):
            kept.append(f)
            places.append(place)
    return kept


SWEEPS = 3
"""Alternations of assigning points and fitting; the third moves nothing by 0.01 mm."""
TABLE_M = 0.003
"""Points nearer to the table than this are the table's."""
TABLE_SHARE = 0.2
"""At most this share of the object's height is: a flat object keeps its points."""
COARSE_SHARE = 1 / 25
"""Coarse voxel as a share of the bounding box's diagonal, within `COARSE_M`."""
COARSE_M = (0.002, 0.005)
"""Least and greatest coarse voxel."""
FINE_SHARE = 1 / 60
"""Fine voxel as a share of the bounding box's diagonal, within `FINE_M`."""
FINE_M = (0.001, 0.0025)
"""Least and greatest fine voxel."""
ASSIGN_M = 0.010
"""Points further than this from their nearest model belong to none."""
KEEP_GAIN = 0.97
"""The joint pose is taken only if the rendered gain stays above this share of the search's:
thin walls otherwise let a cup slide along its axis."""


def coarse_voxel(body: Body) -> float:
    """Return the coarse voxel of an object [m]."""
    return float(np.clip(2 * body.radius_m * COARSE_SHARE, *COARSE_M))


def fine_voxel(body: Body) -> float:
    """Return the fine voxel of an object [m]."""
    return float(np.clip(2 * body.radius_m * FINE_SHARE, *FINE_M))


def drop_height(body: Body, plane: SupportPlane | None) -> float:
    """Return the height below which points are the table's [m]."""
    if plane is None:
        return TABLE_M
    vertices = body.model.mesh.vertices
    T = se3.invert(plane.T_world_table) @ body.T_start
    z = se3.transform(T, vertices)[:, 2]
    return min(TABLE_M, TABLE_SHARE * float(z.max() - z.min()))


def joint_fit(
    bodies: Sequence[Body],
    poses: Sequence[Array],
    clouds: Sequence[Cloud],
    views: tuple[Sequence[Comparer], Sequence[FreeSpace | None]],
) -> tuple[list[PoseFit], list[Cloud], list[dict[str, Any]]]:
    """Return every object's fit to the points that are its own.

    Every sweep assigns the points at the poses of the sweep before and then fits all objects, so
    the result does not depend on the objects' order.

    Args:
        bodies: the objects.
        poses: where they are now, T_world_obj (4, 4) each.
        clouds: the averaged points near each of them.
        views: per object the frames for rendering and for free space.

    Returns:
        The fits, the points assigned to each object, and what each sweep moved.
    """
    comparers, spaces = views
    before = list(poses)
    current = list(poses)
    fits: list[PoseFit] = []
    history: list[dict[str, Any]] = []
    for sweep in range(SWEEPS):
        own = assign_points(bodies, current, clouds)
        fits = [
            solve_pose(b, c, T, FINE, s)
            for b, c, T, s in zip(bodies, own, current, spaces, strict=True)
        ]
        moved = [
            float(1e3 * np.linalg.norm(b.center(f.T_world_obj) - b.center(T)))
            for b, f, T in zip(bodies, fits, current, strict=True)
        ]
        history.append({"sweep": sweep, "moved_mm": moved})
        current = [f.T_world_obj for f in fits]
    own = assign_points(bodies, current, clouds)
    for i, body in enumerate(bodies):
        stride = comparers[i].stride_of(body, before[i])
        old = comparers[i].gain(body, before[i], stride)[0]
        new = comparers[i].gain(body, current[i], stride)[0]
        if new < KEEP_GAIN * old:
            # One step of no length: the information at the pose that is kept.
            kept = solve_pose(body, own[i], before[i], FINE[-1:], spaces[i])
            fits[i] = kept.at(before[i])
            history.append({"kept_search_pose": body.start.instance, "gain": [old, new]})
    return fits, own, history


def assign_points(
    bodies: Sequence[Body], poses: Sequence[Array], clouds: Sequence[Cloud]
) -> list[Cloud]:
    """Return of each object's nearby points those that are nearest to it and not too far."""
    own: list[Cloud] = []
    for i, (body, cloud) in enumerate(zip(bodies, clouds, strict=True)):
        d = np.abs(body.field.distance(cloud.points, se3.invert(poses[i])))
        mine = d < ASSIGN_M
        for j, other in enumerate(bodies):
            gap = np.linalg.norm(body.center(poses[i]) - other.center(poses[j]))
            if j == i or gap > body.radius_m + other.radius_m + 2 * ASSIGN_M:
                continue
            mine &= d <= np.abs(other.field.distance(cloud.points, se3.invert(poses[j])))
        own.append(cloud.select(mine))
    return own
