"""The condition of a mesh: what is wrong with it, and what that means for the work.

Everything is about positions, not about the mesh's vertices (which a texture repeats along its
seams), and all of it is linear or n log n in the faces. Whether faces cut through each other is
NOT checked: two overlapping closed bodies count the common volume twice, and nothing here says so.
"""

import numpy as np

from realsim.models.mesh_problems import problems_of
from realsim.models.mesh_survey import Survey, survey
from realsim.models.model_records import MeshReport
from realsim.records import Mesh


def inspect_mesh(mesh: Mesh) -> MeshReport:
    """Return the condition of the mesh: counts, and every problem with what it means.

    It is the same however the mesh is turned, moved, scaled or its rows are ordered. Not checked:
    whether faces cut through each other; whether the mesh is a mirror image of the object (that
    cannot be seen from it).
    """
    return report(survey(mesh))


def report(s: Survey) -> MeshReport:
    """Return the report of a survey."""
    topo = s.topology
    return MeshReport(
        vertices=len(topo.positions),
        faces=len(topo.faces),
        bodies=s.body_count,
        is_watertight=topo.is_watertight and not np.any(topo.repeated | topo.folded),
        is_outward=not np.any(s.orientation.flip & ~topo.two_sided),
        boundary_edges=int(np.count_nonzero(topo.edge_uses == 1)),
        problems=problems_of(s),
    )


def solved(before: MeshReport, after: MeshReport) -> tuple[str, ...]:
    """Return the kinds of problems that the first report has and the second has not."""
    left = {p.kind for p in after.problems}
    return tuple(p.kind for p in before.problems if p.kind not in left)
