"""Everything that is known of a mesh's surface: topology, winding, bodies, thickness."""

from dataclasses import dataclass

import numpy as np

from realsim.arrays import Array, Int32, Mask
from realsim.models.mesh_orientation import Orientation, orientation
from realsim.models.mesh_topology import Topology, bodies, face_areas_and_volumes, topology
from realsim.records import Mesh

FLAT_SHARE = 1e-4
"""A mesh thinner than this share of its size in some direction is flat: 10 um at 10 cm, less than
any scanner resolves."""


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Survey:
    """Everything that is known of a mesh's surface; the report is made from it."""

    mesh: Mesh
    topology: Topology
    orientation: Orientation
    areas: Array
    """(F,) [m^2]."""
    volumes: Array
    """(F,) signed volumes of the cones to one point, as the faces wind [m^3]."""
    body_count: int
    body: Int32
    """(F,) the connected piece of every face, -1 where the face is not a proper one."""
    body_areas: Array
    """(B,) [m^2]."""
    body_sizes: Array
    """(B,) twice the greatest distance of a corner from the body's mean corner [m]."""
    thickness: Array
    """(3,) extents along the principal axes, greatest first [m]."""

    def specks(self, size_share: float, area_share: float) -> Mask:
        """Return which bodies (B,) are stray specks: small, not the largest, and little in all."""
        areas, sizes = self.body_areas, self.body_sizes
        small = sizes < size_share * self.topology.size
        if self.body_count:
            small[int(np.argmax(areas))] = False
        if areas[small].sum() > area_share * areas.sum():
            small[:] = False
        return small

    @property
    def is_flat(self) -> bool:
        """Whether the mesh has no extent in some direction."""
        return bool(self.thickness[2] <= FLAT_SHARE * self.topology.size)


def survey(mesh: Mesh) -> Survey:
    """Return everything that is known of the mesh's surface."""
    topo = topology(mesh)
    areas, volumes = face_areas_and_volumes(topo)
    count, body = bodies(topo)
    proper = np.flatnonzero(topo.proper)
    label = body[proper]
    corners = np.bincount(label, minlength=count) * 3.0
    # Body by body, corners are weighted by how many faces they have: it need not be more exact.
    sums = np.stack(
        [
            sum(
                np.bincount(label, topo.positions[topo.faces[proper, i], k], count)
                for i in range(3)
            )
            for k in range(3)
        ],
        axis=-1,
    ).reshape(count, 3)
    center = sums / np.maximum(corners, 1.0)[:, None]
    sizes = np.zeros(count)
    for i in range(3):
        offset = topo.positions[topo.faces[proper, i]] - center[label]
        np.maximum.at(sizes, label, 2.0 * np.sqrt(np.einsum("ij,ij->i", offset, offset)))
    return Survey(
        mesh=mesh,
        topology=topo,
        orientation=orientation(topo, areas, volumes),
        areas=areas,
        volumes=volumes,
        body_count=count,
        body=body,
        body_areas=np.bincount(label, areas[proper], count).astype(np.float64),
        body_sizes=sizes,
        thickness=_thickness(topo.positions),
    )


def _thickness(positions: Array) -> Array:
    """Return the extents (3,) along the principal axes of the positions, greatest first."""
    centered = positions - positions.mean(axis=0)
    _, axes = np.linalg.eigh(centered.T @ centered)
    return np.sort(np.ptp(centered @ axes, axis=0))[::-1]
