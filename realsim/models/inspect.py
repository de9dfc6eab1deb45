"""The condition of a mesh: what is wrong with it, and what that means for the work.

Everything is about positions, not about the mesh's vertices (which a texture repeats along its
seams), and all of it is linear or n log n in the faces. Whether faces cut through each other is
NOT checked: two overlapping closed bodies count the common volume twice, and nothing here says so.
"""

from collections.abc import Iterator, Sequence

import numpy as np

from realsim.models.mesh_survey import Survey, survey
from realsim.models.mesh_topology import rims
from realsim.models.model_records import MeshReport, Problem
from realsim.records import Mesh

GIGANTIC_FACES = 1_000_000
"""Above this, distance fields and decompositions take minutes and show nothing more."""
SHEET_SHARE = 1e-3
"""Mean thickness (2 volume / area) of a closed surface, as a share of its size, below which it is
a folded sheet: 0.1 mm at 10 cm, thinner than any wall that can be grasped."""
SPECK_SIZE_SHARE = 0.03
"""A loose piece smaller than this share of the mesh's size is a stray speck: 3 mm at 10 cm."""
SPECK_AREA_SHARE = 0.01
"""All specks together have at most this share of the surface; if they have more, the mesh consists
of small pieces and none of them is stray."""
NEEDLE_AREA_SHARE = 1e-14
"""A face of less area than this share of the size squared has no normal worth the name."""
NAMED_BODIES = 4
"""Number of bodies that are listed with their shares; the rest is summed up."""


def _percent(share: float) -> str:
    return f"{100.0 * share:.2g} %" if share < 0.995 else f"{100.0 * share:.0f} %"


def counted(n: int, singular: str, plural: str = "") -> str:
    """Return a number with its noun: '1 face', '2 faces'."""
    return f"{n} {singular if n == 1 else plural or singular + 's'}"


def problems_of(s: Survey) -> tuple[Problem, ...]:
    """Return everything that is wrong with a mesh."""
    return (
        *_surface_problems(s),
        *_winding_problems(s),
        *_body_problems(s),
        *_volume_problems(s),
        *_row_problems(s),
    )


def _problem(kind: str, count: int, text: str) -> Problem:
    return Problem(kind=kind, count=count, text=f"{kind}: {text}")


def _surface_problems(s: Survey) -> Iterator[Problem]:
    """Yield what keeps the surface from being closed."""
    topo = s.topology
    holes, _, sizes = rims(topo)
    if holes:
        edges = int(np.count_nonzero(topo.edge_uses == 1))
        largest = _percent(float(sizes.max()) / topo.size)
        where = f"{counted(holes, 'hole')}, the largest {largest} of the extent"
        yield _problem(
            "open",
            edges,
            f"{counted(edges, 'boundary edge')} in {where}: volume and inertia are "
            "not defined by the mesh and come from its convex parts or its hull; what is "
            "inside is unknown near the holes.",
        )
    crossed = int(np.count_nonzero(topo.edge_uses > 2))
    if crossed:
        solid = np.all(topo.edge_net == 0) and not holes
        volume = (
            "all faces pair up, so that the volume is defined all the same"
            if solid
            else "inside and outside, and with them volume and inertia, are not certain"
        )
        yield _problem(
            "non-manifold",
            crossed,
            f"{counted(crossed, 'edge')} with more than two faces (walls "
            f"inside, or parts that touch along an edge): {volume}.",
        )


def _winding_problems(s: Survey) -> Iterator[Problem]:
    """Yield what is wrong with the directions in which the faces look."""
    o, topo = s.orientation, s.topology
    # A double-sided face looks both ways, so it cannot look the wrong way.
    against = int(np.count_nonzero(o.against & ~topo.two_sided))
    if against:
        yield _problem(
            "inconsistent winding",
            against,
            f"{counted(against, 'face')} wind against their "
            "neighbours: their normals are turned, the volume comes out too small, and grasp "
            "approaches there start from the wrong side. Repair turns them.",
        )
    inward = o.inward & ~topo.two_sided
    if np.any(inward):
        n, share = int(inward.sum()), float(s.areas[inward].sum() / s.areas.sum())
        all_of_it = n == np.count_nonzero(topo.proper)
        which = (
            "the whole mesh"
            if all_of_it
            else f"{counted(n, 'face')} ({_percent(share)} of the area)"
        )
        yield _problem(
            "inside-out",
            n,
            f"the normals of {which} point into the solid: the volume is "
            "negative there, depth and normals of rendered views are of the far side. Repair "
            "turns the faces.",
        )
    twisted = int(np.count_nonzero(o.is_one_sided))
    if twisted:
        yield _problem(
            "one-sided",
            twisted,
            f"{counted(twisted, 'piece')} of surface cannot be wound "
            "consistently (as a Moebius band): it has no outside and bounds no volume. It is "
            "left as it is; model it again.",
        )


def _body_problems(s: Survey) -> Iterator[Problem]:
    """Yield that there are several bodies: separate ones, shells within shells, stray specks."""
    specks = s.specks(SPECK_SIZE_SHARE, SPECK_AREA_SHARE)
    nested = np.zeros(s.body_count, dtype=bool)
    deep = np.r_[s.orientation.depth % 2 == 1, False][s.orientation.patch]
    nested[np.unique(s.body[deep & s.topology.proper])] = True
    nested &= ~specks
    shares = s.body_areas / max(float(s.body_areas.sum()), np.finfo(np.float64).tiny)
    if np.any(specks):
        n, size = int(specks.sum()), s.body_sizes[specks].max() / s.topology.size
        yield _problem(
            "stray specks",
            n,
            f"{counted(n, 'loose piece')} of at most "
            f"{_percent(float(size))} of the extent, "
            f"{_percent(float(shares[specks].sum()))} of the area in all: they widen the hull "
            "and the extent. Repair drops them.",
        )
    if np.any(nested):
        n = int(nested.sum())
        yield _problem(
            "nested shells",
            n,
            f"{counted(n, 'closed shell')} inside another "
            f"({_percent(float(shares[nested].sum()))} of the area): taken for the walls of "
            "cavities, whose volume and mass are subtracted. No camera sees them; remove them "
            "if the object is solid.",
        )
    others = ~specks & ~nested
    if others.sum() > 1:
        listed = np.sort(shares[others])[::-1]
        parts = ", ".join(_percent(float(x)) for x in listed[:NAMED_BODIES])
        more = f" and {len(listed) - NAMED_BODIES} smaller" if len(listed) > NAMED_BODIES else ""
        yield _problem(
            "several bodies",
            len(listed),
            f"{len(listed)} separate pieces of surface with {parts}{more} "
            "of the area: they move as one rigid object here. Where pieces reach into each "
            "other their common volume counts twice (not checked).",
        )


def _volume_problems(s: Survey) -> Iterator[Problem]:
    """Yield that the mesh bounds no volume worth the name."""
    topo = s.topology
    if s.is_flat:
        size = ", ".join(_percent(float(t) / max(topo.size, 1e-300)) for t in s.thickness)
        yield _problem(
            "flat",
            1,
            f"the extents along the principal axes are {size} of the size: a sheet "
            "or a line has no volume and no mass. It cannot be an object model.",
        )
        return
    area = float(s.areas.sum())
    sheets = float(s.areas[topo.two_sided].sum())
    signed = float(np.where(s.orientation.flip, -s.volumes, s.volumes)[topo.proper].sum())
    is_closed = bool(np.all(s.orientation.is_closed)) and s.body_count > 0
    thickness = 2.0 * abs(signed) / area if area > 0 else 0.0
    if sheets > 0.5 * area or (is_closed and thickness < SHEET_SHARE * topo.size):
        yield _problem(
            "thin sheet",
            max(int(np.count_nonzero(topo.two_sided & topo.proper)), 1),
            "the surface lies back on itself with nearly no volume between: "
            "mass and inertia from it are meaningless. Give the walls their thickness, or let "
            "mass and inertia come from the convex parts.",
        )


def _row_problems(s: Survey) -> Iterator[Problem]:
    """Yield what is wrong with the rows of the mesh rather than with its shape."""
    topo, mesh = s.topology, s.mesh
    needles = topo.proper & (s.areas <= NEEDLE_AREA_SHARE * topo.size**2)
    unused = len(mesh.vertices) - int(np.count_nonzero(topo.index >= 0))
    rows: Sequence[tuple[str, int, str, str]] = (
        (
            "degenerate faces",
            int(np.count_nonzero(topo.collapsed)),
            "face",
            "whose corners coincide: no area and no normal. Repair drops them; nothing is lost.",
        ),
        (
            "needle faces",
            int(np.count_nonzero(needles)),
            "face",
            "without area between three distinct corners: their normals are noise. They stay, "
            "since the surface would tear without them.",
        ),
        (
            "duplicate faces",
            int(np.count_nonzero(topo.repeated)),
            "face",
            "on the corners of another one (double-sided or exported twice): volume, area and "
            "surface samples count them twice. Repair keeps one of each.",
        ),
        (
            "folded faces",
            int(np.count_nonzero(topo.folded)),
            "face",
            "back to back with another one (what decimation leaves of a crevice): fins without "
            "volume. Repair drops both, and the surface is closed there.",
        ),
        (
            "unreferenced vertices",
            unused,
            "vertex",
            "that no face uses: they widen the extent and the hull where they stray. Repair drops "
            "them.",
        ),
        (
            "gigantic",
            len(topo.faces) if len(topo.faces) > GIGANTIC_FACES else 0,
            "face",
            f"where at most {GIGANTIC_FACES} are of use: every later step is slow and needs "
            "gigabytes. Repair simplifies the mesh and measures what that changes.",
        ),
    )
    plural = {"vertex": "vertices"}
    for kind, n, what, meaning in rows:
        if n:
            yield _problem(kind, n, f"{counted(n, what, plural.get(what, ''))} {meaning}")


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
