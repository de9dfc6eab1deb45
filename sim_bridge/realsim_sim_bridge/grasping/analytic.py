"""GraspNet-style labels of an object: the friction at which each of many grasps closes.

At points spread over the surface the gripper approaches along 300 views, turned by 12 angles, with
its fingertips 4 depths beyond the point (Fang et al. 2020, section 3.3). Its fingers come in from
the open gripper along the line between the tips; what each meets first is its contact. The label is
the smallest friction level whose cone holds that line at both contacts (Nguyen 1988), the opening
what the fingers need to pass the contacts, the collision whether GraspNet's gripper, so open,
reaches into the object. Nothing else is asked: tipping, weight and the table are the School's.

A few of an object's many analytic grasps, far apart and of every friction level.
"""

import math
from dataclasses import dataclass

import numpy as np

from realsim.arrays import Array, Int64, Mask, Rows
from realsim.errors import InputError
from realsim.formats.graspnet import gripper_frame
from realsim.formats.graspnet.grasp_labels import GraspLabels
from realsim.geometry.mesh import sample_surface
from realsim.records import Mesh
from realsim_sim_bridge.grasping.antipodal import RaySurface
from realsim_sim_bridge.grasping.surroundings import hands_free, surface_tree

# --- Rows far apart from one another -------------------------------------------------------------


def farthest_rows(features: Array, count: int, first: int = 0, least: float = 0.0) -> Int64:
    """Return rows (N,) of features (M, D), each the farthest from those before.

    Args:
        features: (M, D), at least one row.
        count: rows at most.
        first: where to begin.
        least: end when all others are nearer than this to one that was chosen.
    """
    chosen = [first]
    nearest = np.full(len(features), np.inf)
    while len(chosen) < min(count, len(features)):
        step = np.sum((features - features[chosen[-1]]) ** 2, axis=1)
        # Equal rows are chosen once each.
        nearest = np.minimum(nearest, step)
        nearest[chosen[-1]] = -1.0
        farthest = int(np.argmax(nearest))
        if nearest[farthest] < least**2:
            break
        chosen.append(farthest)
    return np.array(chosen, dtype=np.int64)


SPREAD_M = 0.03
"""Distance [m] that counts as much as opposite approach directions, as of generated candidates."""
MOST_COMPARED = 4000
"""Grasps of a level that are looked at; a level of a large object has 100,000."""


def select_rows(labels: GraspLabels, count: int, rng: np.random.Generator) -> Rows:
    """Return increasing rows (N,) of at most `count` analytic labels for the School to try.

    Grasps whose gripper is in the object are left out.

    Raises:
        InputError: the count is negative.
    """
    if count < 0:
        raise InputError(f"analytic grasps: {count} are asked for; a number from 0 is expected.")
    free = np.flatnonzero(~labels.collision)
    levels = [free[labels.friction[free] == f] for f in np.unique(labels.friction[free])]
    shares = _shares([len(rows) for rows in levels], count)
    chosen = [np.zeros(0, dtype=np.int64)]
    for level, share in zip(levels, shares, strict=True):
        few = len(level) <= MOST_COMPARED
        rows = level if few else np.sort(rng.choice(level, MOST_COMPARED, replace=False))
        if share > 0:
            features = grasp_features(labels.rows(rows).Ts_obj_grasp(), SPREAD_M)
            chosen.append(rows[farthest_rows(features, share, int(rng.integers(len(rows))))])
    return np.sort(np.concatenate(chosen))


def _shares(available: list[int], count: int) -> list[int]:
    """Return how many each level gives: as even as they allow, the lower levels first."""
    shares = [0] * len(available)
    left = min(count, sum(available), sum(min(a, MOST_COMPARED) for a in available))
    while left > 0:
        open_levels = [k for k, a in enumerate(available) if shares[k] < min(a, MOST_COMPARED)]
        each = max(left // len(open_levels), 1)
        for k in open_levels[:left]:
            more = min(each, min(available[k], MOST_COMPARED) - shares[k])
            shares[k] += more
            left -= more
    return shares


def grasp_features(Ts: Array, spread_m: float) -> Array:
    """Return numbers (N, 15) whose distances say how different grasps (N, 4, 4) are.

    A grasp and its half turn about the approach are one: the closing axis enters as y y'.

    Args:
        Ts: grasps.
        spread_m: distance that counts as much as opposite approach directions [m].
    """
    y = Ts[:, :3, 1]
    axis = (y[:, :, None] * y[:, None, :]).reshape(-1, 9)
    return np.concatenate([2.0 / spread_m * Ts[:, :3, 3], Ts[:, :3, 2], axis], axis=1)


# --- How GraspNet-style labels of an object are computed -----------------------------------------


@dataclass(frozen=True, kw_only=True, slots=True)
class AnalyticConfig:
    """Which candidates are looked at, and when one closes."""

    points: int = 200
    """Surface points at most, spread over the object; GraspNet has some 500 an object."""
    voxel_m: float = 0.005
    """Least distance of the points [m]: GraspNet's; a small object has fewer points."""
    view_step: int = 1
    """Every so many of the 300 views is looked from: 1 = all, 4 = a quarter of the time."""
    levels: tuple[float, ...] = (0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9, 1.0)
    """Frictions of the labels (Fang et al. 2020, section 3.3: from 1 down to 0.1 by 0.1). The
    evaluation of graspnetAPI has others, 0.2 to 1.2, those of `ClosureConfig`."""
    max_opening_m: float = 0.08
    """How far the gripper opens [m]: the Panda's; GraspNet's gripper opens 0.1 m."""
    clearance_m: float = 0.002
    """Gap on the tighter side between finger and object before closing [m]."""
    least_width_m: float = 0.001
    """Closer contacts are the thickness of a scan's double surface [m]."""

    def __post_init__(self) -> None:
        """Name a value that cannot be.

        Raises:
            InputError: a count below 1, a length or a friction that is not positive.
        """
        for name in ("points", "view_step"):
            if getattr(self, name) < 1:
                raise InputError(f"analytic grasps: {name} is {getattr(self, name)}; 1 or more.")
        for name in ("voxel_m", "max_opening_m", "clearance_m", "least_width_m"):
            value = getattr(self, name)
            if not (math.isfinite(value) and value > 0):
                raise InputError(
                    f"analytic grasps: {name} is {value} m; a length above 0 is needed."
                )
        if not self.levels or not all(math.isfinite(f) and 0 < f <= 2 for f in self.levels):
            raise InputError(
                f"analytic grasps: the friction levels are {self.levels}; numbers above 0, at most "
                "2, are needed."
            )


ROUNDING = 1e-6
"""A friction so little above a level still counts as the level: rays have single precision."""
SAMPLES_PER_POINT = 50
"""Samples of the surface from which points are chosen to be far apart."""
BLOCK = 8
"""Points whose lines are cast at a time: 115,000 rays, 20 MB."""


def analytic_labels(
    mesh: Mesh, rng: np.random.Generator, config: AnalyticConfig | None = None
) -> GraspLabels:
    """Return the candidates of an object that close at some friction level.

    Args:
        mesh: the object [m].
        rng: of the surface points; the only source of chance.
        config: which candidates.

    Raises:
        InputError: the mesh has no area.
    """
    config = config or AnalyticConfig()
    points = spread_points(mesh, rng, config.points, config.voxel_m)
    view_numbers = np.arange(0, gripper_frame.VIEWS, config.view_step)
    tried = np.zeros(gripper_frame.VIEWS, dtype=np.bool_)
    tried[view_numbers] = True
    R = gripper_frame.rotations(
        -gripper_frame.views()[view_numbers, None], gripper_frame.angles_rad()
    )  # (V, 12, 3, 3)

    surface = RaySurface(mesh)
    found = [
        _closing(surface, points[first : first + BLOCK], R, first, config)
        for first in range(0, len(points), BLOCK)
    ]
    index = np.concatenate([f[0] for f in found])
    friction: Array = np.concatenate([f[1] for f in found])
    openings: Array = np.concatenate([f[2] for f in found])
    collision = _in_object(mesh, points[index[:, 0]], R[index[:, 1], index[:, 2]],
                           np.array(gripper_frame.DEPTHS_M)[index[:, 3]], openings)  # fmt: skip
    index[:, 1] = view_numbers[index[:, 1]]
    return GraspLabels(
        points=points,
        index=index.astype(np.int32),
        angles_rad=gripper_frame.angles_rad()[index[:, 2]].astype(np.float32),
        depths_m=np.array(gripper_frame.DEPTHS_M, dtype=np.float32)[index[:, 3]],
        openings_m=openings.astype(np.float32),
        friction=friction.astype(np.float32),
        collision=collision,
        view_tried=tried,
    )


def spread_points(mesh: Mesh, rng: np.random.Generator, count: int, apart_m: float) -> Array:
    """Return at most `count` surface points (N, 3) [m], each the farthest from those before.

    Args:
        mesh: the surface [m].
        rng: of the samples.
        count: at most; where the surface is too small for that many, fewer.
        apart_m: least distance of two points [m].

    Raises:
        InputError: the mesh has no area.
    """
    samples, _ = sample_surface(mesh, SAMPLES_PER_POINT * count, rng)
    if len(samples) == 0:
        raise InputError("the mesh has no surface on which grasps could be looked for.")
    chosen = farthest_rows(samples, count, least=apart_m)
    # In single precision as the label file has them, so that labels and file are the same.
    return samples[chosen].astype(np.float32).astype(np.float64)


def _closing(
    surface: RaySurface, points: Array, R: Array, first: int, config: AnalyticConfig
) -> tuple[Rows, Array, Array]:
    """Return index (M, 4), friction (M,) and opening (M,) [m] of the candidates that close.

    The view in the index is the row of `R` (V, 12, 3, 3).
    """
    shape = (len(points), len(R), gripper_frame.ANGLES, gripper_frame.DEPTHS)
    x, y = R[:, :, None, :, 0], R[:, :, None, :, 1]
    middles = points[:, None, None, None] + np.array(gripper_frame.DEPTHS_M)[:, None] * x
    middles = np.broadcast_to(middles, (*shape, 3)).reshape(-1, 3)
    closing = np.broadcast_to(y, (*shape, 3)).reshape(-1, 3)
    limit = max(config.levels) + ROUNDING

    rows, at_plus, needed = _contacts(surface, middles, closing, limit, config.max_opening_m)
    again, at_minus, other = _contacts(
        surface, middles[rows], -closing[rows], limit, config.max_opening_m
    )
    rows, at_plus = rows[again], at_plus[again]
    needed = np.maximum(needed[again], other)
    # Along +y the contacts are at at_plus and -at_minus.
    openings = 2.0 * np.maximum(at_plus, at_minus) + 2.0 * config.clearance_m
    good = (at_plus + at_minus >= config.least_width_m) & (openings <= config.max_opening_m)
    levels = np.array(sorted(config.levels))
    friction = levels[np.searchsorted(levels, needed[good] - ROUNDING)]
    index = np.stack(np.unravel_index(rows[good], shape), axis=1).astype(np.int64)
    index[:, 0] += first
    return index, friction, openings[good]


def _contacts(
    surface: RaySurface, middles: Array, outward: Array, limit: float, opening_m: float
) -> tuple[Rows, Array, Array]:
    """Return the contacts of one finger that comes in against `outward`, where a cone holds it.

    Returns:
        rows (M,), the contact's distance from the middle along outward (M,) [m] and the friction
        that the closing line needs there (M,).
    """
    starts = middles + 0.5 * opening_m * outward
    t, face = surface.first_hits(starts, -outward)
    rows = np.flatnonzero(t <= opening_m)
    cos = np.sum(surface.face_normals[face[rows]] * outward[rows], axis=1)
    if not surface.is_closed:
        # A finger comes from outside, whatever way an open mesh's triangles face.
        cos = np.abs(cos)
    # A line that leaves a closed surface first began inside it: the object is too wide.
    close = cos > 1.0 / np.sqrt(1.0 + limit**2) - 1e-12
    rows, cos = rows[close], np.minimum(cos[close], 1.0)
    return rows, 0.5 * opening_m - t[rows], np.sqrt(1.0 - cos**2) / cos


def _in_object(mesh: Mesh, points: Array, R: Array, depths_m: Array, openings_m: Array) -> Mask:
    """Return whether GraspNet's gripper reaches into the object (N,)."""
    Ts = np.zeros((len(points), 4, 4))
    Ts[:, :3, :3], Ts[:, :3, 3], Ts[:, 3, 3] = R, points, 1.0
    tree = surface_tree(mesh.vertices[mesh.faces])
    return ~hands_free(gripper_boxes(depths_m, openings_m), Ts, tree, 0.0)


def gripper_boxes(depths_m: Array, openings_m: Array) -> Array:
    """Return the boxes (N, 3, 2, 3) [m] of GraspNet's gripper in its own frame: palm, fingers.

    Source: graspnetAPI, eval_utils.collision_detection.
    """
    boxes = np.empty((len(depths_m), 3, 2, 3))
    inner = 0.5 * openings_m
    outer = inner + gripper_frame.FINGER_M
    boxes[..., 0, 2], boxes[..., 1, 2] = -0.5 * gripper_frame.HEIGHT_M, 0.5 * gripper_frame.HEIGHT_M
    boxes[:, 0, 0, 0], boxes[:, 0, 1, 0] = (
        -(gripper_frame.BASE_M + gripper_frame.FINGER_M),
        -gripper_frame.BASE_M,
    )
    boxes[:, 1:, 0, 0], boxes[:, 1:, 1, 0] = -gripper_frame.BASE_M, depths_m[:, None]
    boxes[:, 0, 0, 1], boxes[:, 0, 1, 1] = -outer, outer
    boxes[:, 1, 0, 1], boxes[:, 1, 1, 1] = -outer, -inner
    boxes[:, 2, 0, 1], boxes[:, 2, 1, 1] = inner, outer
    return boxes
