"""All objects together: each measured point belongs to the model it is nearest to."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from realsim.geometry import se3
from realsim.records import SupportPlane
from realsim.registration.body import Body
from realsim.registration.compare import Comparer
from realsim.registration.evidence import Cloud
from realsim.registration.solver import Fit, FreeSpace, SolverConfig, solve_pose

Array = NDArray[np.float64]


@dataclass(frozen=True, kw_only=True, slots=True)
class JointConfig:
    """How the joint fit alternates, and the sizes that depend on the object."""

    sweeps: int = 3
    """Alternations of assigning points and fitting; the third moves nothing by 0.01 mm."""
    table_m: float = 0.003
    """Points nearer to the table than this are the table's..."""
    table_share: float = 0.2
    """...but at most this share of the object's height: a flat object keeps its points."""
    coarse_share: float = 1 / 25
    """Coarse voxel as a share of the bounding box's diagonal, within `coarse_m`."""
    coarse_m: tuple[float, float] = (0.002, 0.005)
    """Least and greatest coarse voxel."""
    fine_share: float = 1 / 60
    """Fine voxel likewise."""
    fine_m: tuple[float, float] = (0.001, 0.0025)
    """Least and greatest fine voxel."""
    assign_m: float = 0.010
    """Points further than this from their nearest model belong to none."""
    keep_gain: float = 0.97
    """The joint pose is taken only if the rendered gain stays above this share of the search's:
    thin walls otherwise let a cup slide along its axis."""

    def coarse_voxel(self, body: Body) -> float:
        """Return the coarse voxel of an object [m]."""
        return float(np.clip(2 * body.radius_m * self.coarse_share, *self.coarse_m))

    def fine_voxel(self, body: Body) -> float:
        """Return the fine voxel of an object [m]."""
        return float(np.clip(2 * body.radius_m * self.fine_share, *self.fine_m))

    def drop_height(self, body: Body, plane: SupportPlane | None) -> float:
        """Return the height below which points are the table's [m]."""
        if plane is None:
            return self.table_m
        vertices = body.model.mesh.vertices
        T = se3.invert(plane.T_world_table) @ body.T_start
        z = se3.transform(T, vertices)[:, 2]
        return min(self.table_m, self.table_share * float(z.max() - z.min()))


def joint_fit(
    bodies: Sequence[Body],
    poses: Sequence[Array],
    clouds: Sequence[Cloud],
    views: tuple[Sequence[Comparer], Sequence[FreeSpace | None]],
    configs: tuple[JointConfig, SolverConfig],
) -> tuple[list[Fit], list[Cloud], list[dict[str, Any]]]:
    """Return every object's fit to the points that are its own.

    Every sweep assigns the points at the poses of the sweep before and then fits all objects, so
    the result does not depend on the objects' order.

    Args:
        bodies: the objects.
        poses: where they are now, T_world_obj (4, 4) each.
        clouds: the averaged points near each of them.
        views: per object the frames for rendering and for free space.
        configs: of the joint fit and of the solver.

    Returns:
        The fits, the points assigned to each object, and what each sweep moved.
    """
    config, solver = configs
    comparers, spaces = views
    before = list(poses)
    current = list(poses)
    fits: list[Fit] = []
    history: list[dict[str, Any]] = []
    for sweep in range(config.sweeps):
        own = assigned(bodies, current, clouds, config)
        fits = [
            solve_pose(b, c, T, solver.fine, solver, s)
            for b, c, T, s in zip(bodies, own, current, spaces, strict=True)
        ]
        moved = [
            float(1e3 * np.linalg.norm(b.center(f.T_world_obj) - b.center(T)))
            for b, f, T in zip(bodies, fits, current, strict=True)
        ]
        history.append({"sweep": sweep, "moved_mm": moved})
        current = [f.T_world_obj for f in fits]
    own = assigned(bodies, current, clouds, config)
    for i, body in enumerate(bodies):
        stride = comparers[i].stride_of(body, before[i])
        old = comparers[i].gain(body, before[i], stride)[0]
        new = comparers[i].gain(body, current[i], stride)[0]
        if new < config.keep_gain * old:
            # One step of no length: the information at the pose that is kept.
            still = tuple(s for s in solver.fine[-1:])
            kept = solve_pose(body, own[i], before[i], still, solver, spaces[i])
            fits[i] = kept.at(before[i])
            history.append({"kept_search_pose": body.start.instance, "gain": [old, new]})
    return fits, own, history


def assigned(
    bodies: Sequence[Body], poses: Sequence[Array], clouds: Sequence[Cloud], config: JointConfig
) -> list[Cloud]:
    """Return of each object's nearby points those that are nearest to it and not too far."""
    own: list[Cloud] = []
    for i, (body, cloud) in enumerate(zip(bodies, clouds, strict=True)):
        d = np.abs(body.field.distance(cloud.points, se3.invert(poses[i])))
        mine = d < config.assign_m
        for j, other in enumerate(bodies):
            gap = np.linalg.norm(body.center(poses[i]) - other.center(poses[j]))
            if j == i or gap > body.radius_m + other.radius_m + 2 * config.assign_m:
                continue
            mine &= d <= np.abs(other.field.distance(cloud.points, se3.invert(poses[j])))
        own.append(cloud.select(mine))
    return own
