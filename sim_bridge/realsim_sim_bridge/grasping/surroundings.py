"""What else stands on the table: surfaces that the hand and the arm must keep clear of."""

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from realsim.geometry import se3
from realsim.geometry.mesh import sample_surface
from realsim.records import Mesh
from realsim_sim_bridge.grasping.surface_tree import SurfaceTree, surface_tree

Array = NDArray[np.float64]
Numbers = NDArray[np.int64]


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Surroundings:
    """Surfaces in the table's frame, as points and, where the meshes are at hand, as triangles.

    Points can miss what is thinner than their distance; triangles miss nothing.
    """

    points: Array = field(default_factory=lambda: np.zeros((0, 3)))
    """(P, 3) on the surfaces [m]."""
    instances: Numbers = field(default_factory=lambda: np.zeros(0, dtype=np.int64))
    """(P,) instance number of each point."""
    triangles: Array = field(default_factory=lambda: np.zeros((0, 3, 3)))
    """(T, 3, 3) [m]; of instances that have some, all."""
    triangle_instances: Numbers = field(default_factory=lambda: np.zeros(0, dtype=np.int64))
    """(T,) instance number of each triangle."""

    def tree(self) -> tuple[SurfaceTree | None, Numbers]:
        """Return the tree of all surfaces, and the instance (T,) of each of its numbers.

        Points are in it where their instance has no triangles.
        """
        bare = ~np.isin(self.instances, self.triangle_instances)
        points = np.repeat(self.points[bare][:, None], 3, axis=1)
        triangles = np.concatenate([self.triangles, points])
        instances = np.concatenate([self.triangle_instances, self.instances[bare]])
        return surface_tree(triangles), instances

    def near(self, center: Array, radius_m: float) -> "Surroundings":
        """Return what may lie within a sphere about `center` (3,) [m]."""
        point = np.linalg.norm(self.points - center, axis=1) <= radius_m
        low, high = self.triangles.min(axis=1), self.triangles.max(axis=1)
        gap = np.maximum(np.maximum(low - center, center - high), 0.0)
        triangle = np.linalg.norm(gap, axis=1) <= radius_m
        return Surroundings(
            points=self.points[point],
            instances=self.instances[point],
            triangles=self.triangles[triangle],
            triangle_instances=self.triangle_instances[triangle],
        )


def standing_object(mesh: Mesh, T_table_obj: Array, instance: int, count: int) -> Surroundings:
    """Return the surface of an object where it stands.

    Args:
        mesh: the object [m].
        T_table_obj: (4, 4).
        instance: its number; also the seed of its points.
        count: points spread over its surface; its vertices (at most as many) come on top.
    """
    points = sample_surface(mesh, count, np.random.default_rng(instance))[0]
    points = np.concatenate([points, mesh.vertices[:count]])
    triangles = se3.transform(T_table_obj, mesh.vertices)[mesh.faces]
    return Surroundings(
        points=se3.transform(T_table_obj, points),
        instances=np.full(len(points), instance, dtype=np.int64),
        triangles=triangles,
        triangle_instances=np.full(len(triangles), instance, dtype=np.int64),
    )


def together(surfaces: Sequence[Surroundings]) -> Surroundings:
    """Return all surfaces as one."""
    all_of = [Surroundings(), *surfaces]
    return Surroundings(
        points=np.concatenate([s.points for s in all_of]),
        instances=np.concatenate([s.instances for s in all_of]),
        triangles=np.concatenate([s.triangles for s in all_of]),
        triangle_instances=np.concatenate([s.triangle_instances for s in all_of]),
    )
