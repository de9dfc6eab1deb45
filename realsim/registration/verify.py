"""Is a pose right? Checks without ground truth, and a verdict whose reasons hold the numbers."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from realsim.arrays import Array, Mask
from realsim.geometry import se3
from realsim.geometry.camera import ray_table
from realsim.records import SupportPlane, Verdict
from realsim.registration.body import Body, footprint
from realsim.registration.compare import TAU_SIGMAS, Comparer
from realsim.registration.evidence import Cloud, DepthFrame
from realsim.registration.table_planes import lowest_height, support_checks

FAR_M = 1e3
"""Depth of what is nowhere [m]."""


FRAMES = 12
"""Frames rendered, spread in direction."""
RAYS = 4000
"""Rays per object and frame aimed at; sets the stride."""
AGREE = (0.90, 0.70)
"""Share of visible pixels whose depth agrees within tau = 3 mm + 1.5 sigma_z; at least."""
GAIN = (0.50, 0.15)
"""Mean likelihood (1 .. -1) of visible pixels; at least. Graded where `AGREE` is not."""
COVER = (0.80, 0.50)
"""Share of visible surface with a measured point within `COVER_M` plus 1.5 sigma_z."""
COVER_M = 0.002
"""See `COVER`."""
VIOLATION = (0.06, 0.25)
"""Share of visible pixels where the camera looked through the model; at most."""
PLANE_GAP_MM = (4.0, 20.0)
"""How far the lowest point may float over or sink into the table, beyond twice the slack."""
PENETRATION_MM = (4.0, 12.0)
"""Greatest depth of one object inside another."""
RESIDUAL_MM = (1.5, 4.0)
"""Median distance of the object's points from its surface, beyond the slack: half a sigma_z
plus the depth bias at the object's distance (0.5 mm at 30 cm, 3 mm at 1 m)."""
OCCLUDER_M = 0.025
"""A measurement this far in front belongs to something unmodelled that hides the object;
nearer in front it speaks against the pose."""
LEAST_PIXELS = 60
"""Fewer visible pixels (at the stride used) do not prove anything."""
HIDDEN = 0.7
"""Share of the object hidden by something unmodelled beyond which the pose is doubtful."""


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Checked:
    """What the checks say of one object."""

    checks: dict[str, float]
    verdict: Verdict
    reasons: tuple[str, ...]


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class _Seen:
    """The pixels of one object that are in front of every other model in one frame."""

    measured: Array
    rendered: Array
    behind: Array
    """(N,) what is next behind it of the other models and the table [m]; inf = nothing known."""
    points_world: Array


def verify_objects(
    bodies: Sequence[Body], poses: Sequence[Array], clouds: Sequence[Cloud], comparer: Comparer
) -> list[Checked]:
    """Return the checks of every object at its pose, all objects rendered together.

    Args:
        bodies: the objects.
        poses: their T_world_obj (4, 4).
        clouds: their measured points (those assigned to each).
        comparer: frames, noise and table.
    """
    stride = max(
        1, min((comparer.stride_of(b, T) for b, T in zip(bodies, poses, strict=True)), default=1)
    )
    seen: list[list[_Seen]] = [[] for _ in bodies]
    for frame, edges in zip(comparer.frames, comparer.edges, strict=True):
        for into, part in zip(
            seen, _seen_in(frame, edges, bodies, poses, comparer, stride), strict=True
        ):
            into.append(part)
    supports = support_checks(bodies, poses, comparer.plane)
    results: list[Checked] = []
    for i, body in enumerate(bodies):
        checks = _image_checks(seen[i], clouds[i], comparer)
        checks["n_pixels"] *= stride**2
        z = np.concatenate([s.measured for s in seen[i]])
        typical = np.array([np.median(z)]) if len(z) else np.zeros(1)
        slack = 1e3 * float((0.5 * comparer.noise.sigma(typical) + comparer.bias(typical))[0])
        d = np.abs(body.field.distance(clouds[i].points, se3.invert(poses[i])))
        checks["residual_median_mm"] = float(1e3 * np.median(d)) if len(d) else float("nan")
        if comparer.plane is not None:
            height = lowest_height(comparer.plane, body.model.mesh.vertices, poses[i])
            # What leans on a neighbour does not float.
            floats = supports[i].get("floating_mm", 0.0)
            checks["plane_gap_mm"] = floats if height > 0 else 1e3 * height
        checks["penetration_mm"] = _penetration_mm(i, bodies, poses)
        results.append(_verdict_on(checks, stride, slack))
    return _without_doubles(results, bodies, poses)


def _without_doubles(
    results: list[Checked], bodies: Sequence[Body], poses: Sequence[Array]
) -> list[Checked]:
    """Return the checks with every object rejected that stands where its own double stands.

    Two solid bodies of one kind cannot have their middles nearer than half their least extent; one
    thing that is named twice explains the depth as well as one.
    """
    for j, body in enumerate(bodies):
        for i in range(j):
            if bodies[i].start.obj_id != body.start.obj_id:
                continue
            apart = float(np.linalg.norm(bodies[i].center(poses[i]) - body.center(poses[j])))
            if apart < 0.5 * float(body.model.mesh.extent.min()):
                reason = (
                    f"stands where instance {bodies[i].start.instance} of the same object stands "
                    f"({1e3 * apart:.1f} mm apart): one thing named twice"
                )
                results[j] = replace(
                    results[j], verdict="rejected", reasons=(*results[j].reasons, reason)
                )
    return results


def _seen_in(
    frame: DepthFrame,
    edges: Mask,
    bodies: Sequence[Body],
    poses: Sequence[Array],
    comparer: Comparer,
    stride: int,
) -> list[_Seen]:
    """Return per object its compared pixels in one frame, hidden ones left out."""
    height, width = frame.depth_m.shape
    nearest = np.full((-(-height // stride), -(-width // stride)), np.inf)
    second = nearest.copy()
    T_cam_world = se3.invert(frame.T_world_cam)
    prints = [
        footprint(b, comparer.intrinsics, T_cam_world @ T, stride)
        for b, T in zip(bodies, poses, strict=True)
    ]
    for p in prints:
        v, u = p.rows // stride, p.columns // stride
        second[v, u] = np.minimum(second[v, u], np.maximum(nearest[v, u], p.z))
        nearest[v, u] = np.minimum(nearest[v, u], p.z)
    seen: list[_Seen] = []
    for p in prints:
        measured = frame.depth_m[p.rows, p.columns].astype(np.float64)
        table = comparer.table(frame, p.rows, p.columns)
        front = p.z <= nearest[p.rows // stride, p.columns // stride]
        front &= p.z <= table + comparer.tau(p.z)
        front &= (measured > 0) & ~edges[p.rows, p.columns]
        rays = ray_table(comparer.intrinsics)[p.rows[front], p.columns[front]]
        points = se3.transform(frame.T_world_cam, rays * p.z[front, None])
        behind = np.minimum(table, second[p.rows // stride, p.columns // stride])
        seen.append(
            _Seen(measured=measured[front], rendered=p.z[front], behind=behind[front],
                  points_world=points)
        )  # fmt: skip
    return seen


def _image_checks(seen: Sequence[_Seen], cloud: Cloud, comparer: Comparer) -> dict[str, float]:
    """Return the shares that come from comparing rendered with measured depth."""
    measured = np.concatenate([s.measured for s in seen])
    rendered = np.concatenate([s.rendered for s in seen])
    behind = np.concatenate([s.behind for s in seen])
    points = np.concatenate([s.points_world for s in seen])
    tau = comparer.tau(measured)
    d = measured - rendered
    hidden = d < -np.maximum(tau, OCCLUDER_M)
    n = int(np.count_nonzero(~hidden))
    checks = {"n_pixels": float(n), "hidden": float(np.mean(hidden)) if len(d) else 1.0}
    if n == 0:
        nothing = {"agree": 0.0, "gain": -1.0, "margin": 0.0, "cover": 0.0}
        return checks | nothing | {"free_space_violation": 0.0}
    d, tau = d[~hidden], tau[~hidden]
    checks["agree"] = float(np.mean(np.abs(d) <= tau))
    likelihood = comparer.likelihood(measured[~hidden], rendered[~hidden])
    checks["gain"] = float(np.mean(likelihood))
    # Where nothing is known behind it, nothing explains the depth instead.
    instead = comparer.likelihood(measured[~hidden], np.minimum(behind[~hidden], FAR_M))
    checks["margin"] = float(np.mean(likelihood - instead))
    checks["free_space_violation"] = float(np.mean(d > tau))
    checks["cover"] = _cover(points[~hidden], measured[~hidden], cloud, comparer)
    return checks


def _cover(points: Array, depths: Array, cloud: Cloud, comparer: Comparer) -> float:
    """Return the share of visible surface points (N, 3) with a measured point close by."""
    from scipy.spatial import KDTree

    if len(cloud.points) == 0:
        return 0.0
    every = max(1, len(points) // 3000)
    reach = COVER_M + TAU_SIGMAS * comparer.noise.sigma(depths[::every])
    distance, _ = KDTree(cloud.points).query(points[::every], distance_upper_bound=reach.max())
    return float(np.mean(distance <= reach))


def _penetration_mm(i: int, bodies: Sequence[Body], poses: Sequence[Array]) -> float:
    """Return how deep object i reaches into any other, or another into it [mm]."""
    deepest = 0.0
    for j, other in enumerate(bodies):
        gap = np.linalg.norm(bodies[i].center(poses[i]) - other.center(poses[j]))
        if j == i or gap > bodies[i].radius_m + other.radius_m:
            continue
        T_other_i = se3.invert(poses[j]) @ poses[i]
        inside = other.field.distance(bodies[i].samples, T_other_i)
        around = bodies[i].field.distance(other.samples, se3.invert(T_other_i))
        deepest = max(deepest, -float(inside.min()), -float(around.min()))
    return 1e3 * deepest


def _verdict_on(checks: dict[str, float], stride: int, slack_mm: float) -> Checked:
    """Return the checks with a verdict and the reasons for it.

    Args:
        checks: by name.
        stride: every how many pixels one was rendered.
        slack_mm: half a sigma_z plus the depth bias at the object's distance: what lengths may be
            off by for the camera's sake; the plane and the object each once.
    """
    tests: list[tuple[str, float, tuple[float, float], bool]] = [
        ("of the visible pixels agree with the depth", checks["agree"], AGREE, True),
        ("mean likelihood of the visible pixels", checks["gain"], GAIN, True),
        ("of the visible surface has a measured point", checks["cover"], COVER, True),
        (
            "of the visible pixels were looked through",
            checks["free_space_violation"],
            VIOLATION,
            False,
        ),
        ("mm inside another object", checks["penetration_mm"], PENETRATION_MM, False),
        ("mm median residual", checks["residual_median_mm"] - slack_mm, RESIDUAL_MM, False),
    ]
    if "plane_gap_mm" in checks:
        gap = checks["plane_gap_mm"]
        words = "mm over the table" if gap > 0 else "mm sunk into the table"
        tests.append((words, abs(gap) - 2 * slack_mm, PLANE_GAP_MM, False))
    reasons: list[str] = []
    worst = 0
    for words, value, (doubtful, bad), at_least in tests:
        sign = 1.0 if at_least else -1.0
        level = 2 if sign * value < sign * bad else 1 if sign * value < sign * doubtful else 0
        if level or not np.isfinite(value):
            bound = "at least" if at_least else "at most"
            reasons.append(f"{value:.2f} {words} ({bound} {doubtful:g} is good)")
        worst = max(worst, level if np.isfinite(value) else 1)
    if checks["n_pixels"] < LEAST_PIXELS * stride**2:
        reasons.append(f"only {checks['n_pixels']:.0f} pixels of it are seen")
        worst = max(worst, 1)
    if checks["hidden"] > HIDDEN:
        reasons.append(f"{checks['hidden']:.2f} of it is hidden by something that is no model")
        worst = max(worst, 1)
    verdict: Verdict = ("accepted", "doubtful", "rejected")[worst]
    return Checked(checks=checks, verdict=verdict, reasons=tuple(reasons))


OFFSET_OBJECTS = 3
"""Two objects may agree by chance."""
LEAST_OFFSET_MM = 5.0
"""A smaller offset is within what annotations are off by."""
SPREAD_SHARE = 0.5
"""The median deviation from the common offset must stay below this share of its length."""
STANDARD_ERRORS = 4.0
"""The offset must be so many times its standard error: the starts of a few objects, each off by
10 mm on its own, may point the same way by chance."""


def common_offset(
    bodies: Sequence[Body], poses: Sequence[Array], use: Sequence[bool]
) -> dict[str, object]:
    """Return whether all objects moved alike from their starts: the starts belong elsewhere.

    If a camera pose (or the whole annotation) is that of another frame, every object's centre moves
    by about the same vector. Symmetric turns do not matter because centres are compared.

    Args:
        bodies: the objects at their starts.
        poses: where they were found.
        use: which of them were found well enough to count.
    """
    moves = np.array(
        [
            1e3 * (b.center(T) - b.center(b.T_start))
            for b, T, u in zip(bodies, poses, use, strict=True)
            if u
        ]
    ).reshape(-1, 3)
    if len(moves) == 0:
        return {"offset_mm": None, "spread_mm": None, "objects": 0, "consistent": False}
    middle = np.median(moves, axis=0)
    spread = float(np.median(np.linalg.norm(moves - middle, axis=1)))
    length = float(np.linalg.norm(middle))
    consistent = (
        len(moves) >= OFFSET_OBJECTS
        and length >= LEAST_OFFSET_MM
        and spread <= SPREAD_SHARE * length
        and length >= STANDARD_ERRORS * spread / np.sqrt(len(moves))
    )
    return {
        "offset_mm": [float(v) for v in middle],
        "spread_mm": spread,
        "objects": len(moves),
        "consistent": bool(consistent),
    }


SINKING_OBJECTS = 3
"""Two objects may agree by chance."""
LEAST_SINKING = 0.02
"""A smaller share of the height is within what meshes and planes are off by (3 mm of 15 cm)."""
SINKING_REST = 0.5
"""What the common share leaves of the gaps (RMS) must stay below this part of them."""


def common_sinking(
    bodies: Sequence[Body], poses: Sequence[Array], use: Sequence[bool], plane: SupportPlane | None
) -> dict[str, object]:
    """Return whether all objects sink into (or float over) the plane by one share of their height.

    Depth that reads short by a share makes the whole measured world smaller, so models that are
    fitted to it are too tall by that share: gap_i = share * height_i, found by least squares. The
    depth alone cannot tell short depth from models that are too large.

    Args:
        bodies: the objects.
        poses: where they were found.
        use: which of them were found well enough to count.
        plane: what they stand on; None = nothing to compare with.
    """
    if plane is None or not any(use):
        return {"share_of_height": None, "rest_mm": None, "objects": 0, "consistent": False}
    T_table_world = se3.invert(plane.T_world_table)
    rows: list[tuple[float, float]] = []
    for body, T, counts in zip(bodies, poses, use, strict=True):
        if counts:
            z = 1e3 * se3.transform(T_table_world @ T, body.model.mesh.vertices)[:, 2]
            rows.append((float(z.max() - z.min()), float(z.min())))
    heights, gaps = np.array(rows).T
    share = float(heights @ gaps / (heights @ heights))
    rest = float(np.sqrt(np.mean(np.square(gaps - share * heights))))
    consistent = (
        len(rows) >= SINKING_OBJECTS
        and abs(share) >= LEAST_SINKING
        and rest <= SINKING_REST * float(np.sqrt(np.mean(np.square(gaps))))
    )
    return {
        "share_of_height": share,
        "rest_mm": rest,
        "objects": len(rows),
        "consistent": bool(consistent),
    }
