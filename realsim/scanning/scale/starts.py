"""Starts for the fit of scale and pose, from nothing but the mesh and the measured points."""

from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from realsim.errors import DegenerateError
from realsim.geometry import se3
from realsim.records import Mesh, SupportPlane
from realsim.registration.evidence import Cloud
from realsim.scanning.scale.height_maps import HeightMapConfig, height_map, table_points
from realsim.scanning.scale.result import Similarity
from realsim.scanning.scale.start_search import (
    Placement,
    SearchConfig,
    climbed,
    distinct,
    evidence_of,
    place_of,
    rule_of,
    scanned,
)
from realsim.scanning.scale.start_shape import Shape, ShapeConfig, point_grid, shape_of

Array = NDArray[np.float64]


@dataclass(frozen=True, kw_only=True, slots=True)
class StartsConfig:
    """How starts are found, and how many are given."""

    most: int = 24
    """Starts given at most."""
    same_share: float = 0.03
    """Two starts are one if 95 % of the surface of each lies within this share of the size of the
    other's: a fit brings both to the same end. Surfaces are compared, not poses, so that the turns
    of a symmetric body count once."""
    cloud_points: int = 500
    """Points of the cloud that are compared with the mesh."""
    shape: ShapeConfig = field(default_factory=ShapeConfig)
    """How the mesh is prepared (once)."""
    height_map: HeightMapConfig = field(default_factory=HeightMapConfig)
    """How the cloud is mapped."""
    search: SearchConfig = field(default_factory=SearchConfig)
    """How placements are tried."""
    near_scales: tuple[float, ...] = (0.87, 1.15)
    """`starts_near`: other scales, as factors; a fit reaches about half of it."""
    near_turn_deg: float = 20.0
    """`starts_near`: turns about the axes of the mesh's box [deg]: twice the reach of a fit, so
    that a start which is off by a little more than the reach is met from one side."""


def find_starts(
    mesh: Mesh, cloud: Cloud, plane: SupportPlane, config: StartsConfig, rng: np.random.Generator
) -> list[Similarity]:
    """Return distinct starts for the fit of scale and pose, the most promising first.

    Args:
        mesh: the object in any unit and attitude.
        cloud: measured points of this one object above the table, in world [m].
        plane: the table it stands on.
        config: see there.
        rng: which points of the cloud are compared.

    Raises:
        InputError: the mesh is flat.
        DegenerateError: the points are too few, or do not lie above the plane.
    """
    shape = shape_of(mesh, config.shape)
    points = table_points(cloud.points, plane.T_world_table)
    measured = height_map(points, config.height_map)
    low = measured.origin - measured.cell
    high = measured.origin + measured.cell * (np.array(measured.heights.shape) + 1)
    inside = np.all((points[:, :2] > low) & (points[:, :2] < high), axis=1) & (points[:, 2] > 0)
    points = points[inside & (points[:, 2] < measured.top + 4 * measured.cell)]
    few = points[rng.permutation(len(points))[: config.cloud_points]]
    cell = max(measured.cell, 0.02 * measured.size)
    margin = int(np.ceil(1.5 * config.search.near_share * measured.size / cell))
    evidence = evidence_of(measured, few, point_grid(points, cell, margin))
    over_map = rule_of(measured, config.search, (1.0, 0.0, 0.0))
    full = rule_of(measured, config.search, config.search.weights)
    found = scanned(measured, evidence, shape, config.search)[: config.search.climbers]
    found = climbed(found, evidence, shape, over_map, config.search)
    found = distinct(found, shape, config.same_share, config.search.finalists)
    found = climbed(found, evidence, shape, full, config.search)
    found = distinct(found, shape, config.same_share, config.most)
    if not found:
        raise DegenerateError("no placement of the mesh on the table resembles the points.")
    return [_similarity(p, shape, plane) for p in found]


def starts_near(
    given: Similarity, mesh: Mesh, config: StartsConfig, rng: np.random.Generator
) -> list[Similarity]:
    """Return a given start, then its alternatives: other scales, small turns, half turns.

    Scales and turns keep the middle of the mesh's box where it is; a start of another scale on a
    table is off by at most half its height times the change of scale, which a fit makes up for.

    Args:
        given: an operator's or another program's start.
        mesh: the object.
        config: see there.
        rng: direction of the small turns about the box axes, so that no attitude is preferred.
    """
    center = mesh.bounds.mean(0)
    found = [given]
    for factor in config.near_scales:
        found.append(_about(given, center, np.eye(3), factor, f"{given.source}, x{factor:g}"))
    angle = np.radians(config.near_turn_deg)
    frame = se3.random_rotation(rng)
    for k, axis in enumerate(frame.T):
        for sign in (1.0, -1.0):
            R = se3.exp_so3(sign * angle * axis)
            name = f"{given.source}, turned {sign * config.near_turn_deg:+.0f} deg ({k + 1})"
            found.append(_about(given, center, R, 1.0, name))
    for k, letter in enumerate("xyz"):
        R = se3.exp_so3(np.pi * np.eye(3)[k])
        found.append(_about(given, center, R, 1.0, f"{given.source}, half turn about {letter}"))
    return found


def _about(given: Similarity, center: Array, R: Array, factor: float, source: str) -> Similarity:
    """Return the start turned by R (object's axes) and scaled about a point of the mesh."""
    middle = se3.transform(given.T_world_obj, given.scale * center[None])[0]
    rotation = given.T_world_obj[:3, :3] @ R
    scale = given.scale * factor
    T = se3.from_rt(rotation, middle - rotation @ (scale * center))
    return replace(given, scale=scale, T_world_obj=T, score=float("nan"), source=source)


def _similarity(p: Placement, shape: Shape, plane: SupportPlane) -> Similarity:
    """Return a placement as the scale and pose of the mesh itself."""
    scale = p.scale / shape.radius
    T_table_obj = se3.from_rt(p.R, place_of(p, shape) - p.R @ (scale * shape.center))
    return Similarity(
        scale=scale,
        T_world_obj=plane.T_world_table @ T_table_obj,
        score=p.score,
        source=shape.templates[p.template].name,
    )
