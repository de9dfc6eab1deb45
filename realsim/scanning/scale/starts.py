"""Starts for the fit of scale and pose, from nothing but the mesh and the measured points.

Every direction down, scale, yaw and place of the mesh is laid over the map of heights; the best
that differ are starts. `starts_near` gives the alternatives of a start that somebody typed.
"""

from dataclasses import replace

import numpy as np

from realsim.arrays import Array
from realsim.errors import DegenerateError
from realsim.geometry import se3
from realsim.models.resting import resting_orientations, turned_down
from realsim.records import SupportPlane
from realsim.registration.evidence import Cloud
from realsim.scanning.scale.height_maps import (
    HeightMap,
    Template,
    height_map,
    make_templates,
    scan_map,
)
from realsim.scanning.scale.result import Similarity
from realsim.scanning.scale.shape import INNER_EXTENT, ScanShape

GOLDEN_ANGLE = np.pi * (3 - np.sqrt(5))
COMPARED_POINTS = 150
"""Points of the surface by which two starts are told apart."""
NEARLY_ALL = 0.95
"""Share of two surfaces that must be near each other to be one: the rest may be a handle's edge."""
MOST = 32
"""Starts given at most."""
SAME_SHARE = 0.06
"""Two starts are one if 95 % of the surface of each lies within this share of the size of the
other's: a fit brings both to the same end. Surfaces are compared, not poses, so that the turns
of a symmetric body count once."""
DIRECTIONS = 200
"""Directions down besides the resting ones: 16 deg apart, so that none is farther than about 9
deg from a pose that no resting pose explains (a leaning object, a hull that is wrong)."""
GENERAL_PENALTY = 0.06
"""What a direction that is no resting pose loses of its score, which is at most 1."""
RARE_PENALTY = 0.02
"""What a resting pose of probability 1 % loses; one of 10 % loses half of it."""
SHAPE_ERROR = 0.025
"""Error of the mesh's outline as a share of its size, 1-sigma: generated meshes have 2 % RMS.
It says how well height, area and widths must agree on one scale."""
MAP_ERROR_M = 0.0015
"""Error of a measured height or width [m], 1-sigma: half a cell and the depth noise."""
DIRECTIONS_KEPT = 90
"""Directions whose height, area and widths agree best on one scale; the other two thirds are
not scanned, which halves the time."""
SCALE_STEPS = (-0.14, -0.07, 0.0, 0.07, 0.14)
"""Logarithms of scale tried about the value that height, area and widths agree on."""
YAWS = 36
"""Yaws tried: 10 deg apart, within the reach of the fit."""
SHIFT_SHARE = 0.04
"""Shifts tried along the table's axes, as a share of the size: centroids are about so good."""
POINTS = 110
"""Points of a template that are compared."""
TOLERANCE_SHARE = 0.03
"""Heights agree within this share of the size: 2 % of shape error, some tilt."""
TOLERANCE_M = 0.003
"""Least value of that tolerance [m]: two cells of a slope."""
LOW_COST = 0.5
"""What a model that is lower than the measurement costs; one that is higher costs 1. Lower may
be a hole of the mesh that the cameras could not look into."""
UNCOVERED_COST = 0.7
"""What measured area costs that the model leaves uncovered."""
HIDDEN_M = 0.006
"""What lies so low over the table is not told from it [m]: the floor of an open vessel."""
PEAKS = 4
"""Yaws of each direction that are looked at on."""
LOOKED_AT = 160
"""Best places among which different ones are sought."""
NEAR_SCALES = (0.87, 1.15)
"""`starts_near`: other scales, as factors; a fit reaches about half of it."""
NEAR_TURN_DEG = 20.0
"""`starts_near`: turns about the axes of the mesh's box [deg]: twice the reach of a fit, so
that a start which is off by a little more than the reach is met from one side."""


def find_starts(shape: ScanShape, cloud: Cloud, plane: SupportPlane) -> list[Similarity]:
    """Return distinct starts of the inner mesh for the fit, the most promising first.

    Args:
        shape: the object in any attitude.
        cloud: measured points of this one object above the table, in world [m].
        plane: the table it stands on.

    Raises:
        DegenerateError: the points are too few, or do not lie above the plane.
    """
    points = se3.transform(se3.invert(plane.T_world_table), cloud.points)
    measured = height_map(points)
    found = _scanned(measured, _templates(shape), shape)
    if not found:
        raise DegenerateError("no placement of the mesh on the table resembles the points.")
    kept: list[Similarity] = []
    for s in found[:LOOKED_AT]:
        if not any(_same(s, other, shape) for other in kept):
            kept.append(s)
        if len(kept) == MOST:
            break
    return [replace(s, T_world_obj=plane.T_world_table @ s.T_world_obj) for s in kept]


def starts_near(given: Similarity, rng: np.random.Generator) -> list[Similarity]:
    """Return a given start of the inner mesh, then its alternatives: scales, turns, half turns.

    Scales and turns keep the middle of the mesh's box where it is; a start of another scale on a
    table is off by at most half its height times the change of scale, which a fit makes up for.

    Args:
        given: an operator's or another program's start.
        rng: direction of the small turns about the box axes, so that no attitude is preferred.
    """

    def other(source: str, R: Array, factor: float = 1.0) -> Similarity:
        T = given.T_world_obj @ se3.from_rt(R, np.zeros(3))
        return Similarity(
            scale=given.scale * factor, T_world_obj=T, source=f"{given.source}, {source}"
        )

    degrees = NEAR_TURN_DEG
    turns = [
        (k, axis, sign) for k, axis in enumerate(se3.random_rotation(rng).T) for sign in (1, -1)
    ]
    return [
        given,
        *(other(f"x{factor:g}", np.eye(3), factor) for factor in NEAR_SCALES),
        *(
            other(f"turned {sign * degrees:+.0f} deg ({k + 1})",
                  se3.exp_so3(sign * np.radians(degrees) * axis))
            for k, axis, sign in turns
        ),
        *(
            other(f"half turn about {letter}", se3.exp_so3(np.pi * axis))
            for letter, axis in zip("xyz", np.eye(3), strict=True)
        ),
    ]  # fmt: skip


def _templates(shape: ScanShape) -> list[Template]:
    """Return the templates of the resting poses, most probable first, and of all directions."""
    resting = resting_orientations(shape.mesh)
    general = [turned_down(d) for d in _spread_directions(DIRECTIONS)]
    basin = np.array([r.basin for r in resting])
    # A body that rolls is as likely to lie as all its representatives together.
    together = np.bincount(basin, [r.probability for r in resting])[basin]
    rare = 0.5 * RARE_PENALTY * np.log10(np.clip(together, 1e-3, 1.0))
    priors = np.concatenate([rare, np.full(len(general), -GENERAL_PENALTY)])
    names = [f"resting pose {k + 1}" for k in range(len(resting))]
    names += [f"direction {k + 1}" for k in range(len(general))]
    return make_templates(shape, np.stack([*(r.R for r in resting), *general]), priors, names)


def _spread_directions(n: int) -> Array:
    """Return n unit vectors (n, 3) spread evenly over the sphere (Fibonacci's lattice)."""
    k = np.arange(n) + 0.5
    z = 1 - 2 * k / n
    out = np.sqrt(1 - z * z)
    return np.stack([out * np.cos(GOLDEN_ANGLE * k), out * np.sin(GOLDEN_ANGLE * k), z], -1)


def _common_scale(measured: HeightMap, template: Template) -> tuple[float, float]:
    """Return the log scale on which height, area and widths agree best, and their disagreement.

    Each gives a scale of its own, with an error of a fixed length: of a flat object the height says
    little, of a thin one the width. The disagreement is chi-square per figure.
    """
    lengths = np.array([measured.top, np.sqrt(measured.area), *(3.5 * measured.spread)])
    z = template.points @ template.R[2]
    hidden = HIDDEN_M * template.height / measured.top
    area = template.area * np.mean(z > z.min() + hidden)
    units = np.array([template.height, np.sqrt(area), *(3.5 * template.spread)])
    logs = np.log(np.maximum(lengths, 1e-6) / np.maximum(units, 1e-9))
    error = np.hypot(SHAPE_ERROR * measured.size, MAP_ERROR_M)
    relative = np.hypot(error / lengths, SHAPE_ERROR)
    weights = 1 / np.square(relative)
    middle = float(weights @ logs / weights.sum())
    return middle, float(np.mean(np.square((logs - middle) / relative)))


def _scanned(measured: HeightMap, templates: list[Template], shape: ScanShape) -> list[Similarity]:
    """Return the best places over all directions, scales, yaws and shifts, in the table's frame."""
    agreed = [_common_scale(measured, t) for t in templates]
    order = np.argsort([chi for _, chi in agreed], kind="stable")[:DIRECTIONS_KEPT]
    angles = 2 * np.pi * np.arange(YAWS) / YAWS
    turns = np.stack([np.cos(angles), np.sin(angles)], -1)
    step = SHIFT_SHARE * measured.size
    shifts = step * np.array([[0, 0], [1, 0], [-1, 0], [0, 1], [0, -1]], dtype=np.float64)
    tolerance = max(TOLERANCE_M, TOLERANCE_SHARE * measured.size)
    rule = (tolerance, LOW_COST, UNCOVERED_COST, HIDDEN_M)
    found: list[Similarity] = []
    for k in order:
        t = templates[k]
        lowest = float((shape.hull @ t.R[2]).min())
        points = t.points[:POINTS] @ t.R.T - [*t.center, lowest]
        scales = np.exp(agreed[k][0] + np.array(SCALE_STEPS))
        table = scan_map(measured, points, t.area, scales, turns, measured.center + shifts, rule)
        best = table.max(axis=(0, 2))
        peak = (best >= np.roll(best, 1)) & (best > np.roll(best, -1))
        for y in sorted(np.flatnonzero(peak), key=lambda y: -best[y])[:PEAKS]:
            s, h = np.unravel_index(int(np.argmax(table[:, y])), table[:, y].shape)
            yaw = se3.exp_so3([0.0, 0.0, angles[y]])
            foot = np.array([*(measured.center + shifts[h]), 0.0])
            place = foot - scales[s] * yaw @ [*t.center, lowest]
            found.append(
                Similarity(
                    scale=float(scales[s]), T_world_obj=se3.from_rt(yaw @ t.R, place),
                    score=float(best[y]) + t.prior, source=t.name,
                )
            )  # fmt: skip
    return sorted(found, key=lambda p: -p.score)


def _same(a: Similarity, b: Similarity, shape: ScanShape) -> bool:
    """Return whether 95 % of each placed surface lie near the other."""
    some = shape.samples[:: max(1, len(shape.samples) // COMPARED_POINTS)]
    for p, q in ((a, b), (b, a)):
        T = se3.invert(q.T_world_obj) @ p.T_world_obj
        points = se3.transform(T, p.scale * some) / q.scale
        if np.mean(np.abs(shape.field.distance(points)) < SAME_SHARE * INNER_EXTENT) < NEARLY_ALL:
            return False
    return True
