"""Repair of a mesh that leaves its shape, its colours and its texture alone.

Welding is for the topology: a texture seam stays two vertices at one position. What changes the
shape at all is named with its size: specks that are dropped, holes that are closed, and the
simplification of a mesh of millions of faces.
"""

from dataclasses import dataclass, replace

import numpy as np

from realsim.arrays import Array, Int32, Mask
from realsim.errors import DegenerateError
from realsim.models.inspect import (
    GIGANTIC_FACES,
    SPECK_AREA_SHARE,
    SPECK_SIZE_SHARE,
    counted,
    report,
)
from realsim.models.mesh_survey import FLAT_SHARE, Survey, survey
from realsim.models.mesh_topology import Topology, equal_rows, rims
from realsim.models.model_records import Repair
from realsim.models.simplify import deviation, simplified
from realsim.records import Mesh


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Fillers:
    """The triangles that close the small holes of a mesh."""

    rim: Int32
    """(N, 2) vertices of the mesh: each rim edge as its triangle runs along it."""
    hole: Int32
    """(N,) the filled hole, 0 .. len(centers) - 1, of each rim edge."""
    centers: Array
    """(H, 3) tips of the fans [m]."""
    sizes: Array
    """(H,) sizes of the filled holes [m]."""
    left: tuple[str, ...]
    """Why the small holes that stay open do."""


def find_fillers(
    topo: Topology, faces: Int32, turned: Mask, largest: Array, unevenness: float
) -> Fillers:
    """Return fans that close the holes up to a size.

    A hole is closed when its rim is one simple loop, lies near a plane, and is seen whole from the
    middle of the rim: then the fan from there neither folds nor leaves the rim's plane.

    Args:
        topo: the mesh's topology.
        faces: (F, 3) the mesh's own faces, whose vertices the fans use.
        turned: (F,) faces to be read in the opposite winding.
        largest: (F,) greatest size of a hole that is closed at this face [m].
        unevenness: greatest distance of a rim's corners from its plane, as a share of its size.
    """
    count, label, sizes = rims(topo)
    if count == 0:
        none = np.zeros((0, 2), dtype=np.int32)
        return Fillers(
            rim=none, hole=none[:, 0], centers=np.zeros((0, 3)), sizes=np.zeros(0), left=()
        )
    half = np.flatnonzero(topo.edge_uses[topo.half_edge] == 1)
    half = half[np.argsort(topo.half_edge[half])]  # the order of `label`
    face = topo.half_face[half]
    corner = half // np.count_nonzero(topo.proper)
    start, end = faces[face, corner], faces[face, (corner + 1) % 3]
    # A neighbour runs along an edge the other way; so does the triangle that closes the hole.
    rim = np.where(turned[face][:, None], np.stack([start, end], -1), np.stack([end, start], -1))
    a, b = topo.index[rim[:, 0]], topo.index[rim[:, 1]]

    small = np.ones(count, dtype=bool)
    small[label[sizes[label] > largest[face]]] = False
    degree_out = np.bincount(a, minlength=len(topo.positions))
    degree_in = np.bincount(b, minlength=len(topo.positions))
    simple = np.ones(count, dtype=bool)
    simple[label[(degree_out[a] != 1) | (degree_in[a] != 1)]] = False
    simple[label[(degree_out[b] != 1) | (degree_in[b] != 1)]] = False

    edges = np.bincount(label, minlength=count)
    p = topo.positions[a]
    center = np.stack([np.bincount(label, p[:, k], count) for k in range(3)], -1) / edges[:, None]
    doubled = np.cross(p - center[label], topo.positions[b] - center[label])
    normal = np.stack([np.bincount(label, doubled[:, k], count) for k in range(3)], -1)
    length = np.linalg.norm(normal, axis=1, keepdims=True)
    normal /= np.where(length > 0, length, 1.0)
    off_plane = np.zeros(count)
    np.maximum.at(off_plane, label, np.abs(np.einsum("ij,ij->i", p - center[label], normal[label])))
    even = off_plane <= unevenness * sizes
    star = np.ones(count, dtype=bool)
    star[label[np.einsum("ij,ij->i", doubled, normal[label]) <= 0]] = False

    fill = small & simple & even & star
    number = np.cumsum(fill) - 1
    chosen = fill[label]
    reasons = (
        (small & ~simple, "their rims touch or are wound both ways"),
        (small & simple & ~even, "their rims are not plane"),
        (small & simple & even & ~star, "their rims fold back"),
    )
    return Fillers(
        rim=rim[chosen],
        hole=number[label[chosen]].astype(np.int32),
        centers=center[fill],
        sizes=sizes[fill],
        left=tuple(f"{int(np.sum(which))}: {why}" for which, why in reasons if np.any(which)),
    )


@dataclass(frozen=True, kw_only=True, slots=True)
class RepairConfig:
    """What a repair may do."""

    speck_size_share: float = SPECK_SIZE_SHARE
    """Loose pieces smaller than this share of the mesh's size are dropped [-]. Default 3 %: 3 mm
    at 10 cm; no part of an object that matters to a grasp is loose and so small."""
    speck_area_share: float = SPECK_AREA_SHARE
    """All dropped pieces have at most this share of the surface [-]. Default 1 %; beyond it the
    mesh consists of small pieces, and nothing is dropped."""
    fill_size_share: float = 0.05
    """Holes up to this share of the mesh's size are closed [-]. Default 5 %: 5 mm at 10 cm; larger
    ones may be openings of the object."""
    fill_body_share: float = 0.5
    """Holes up to this share of the size of the piece of surface they are in are closed [-].
    Default 0.5: the rim of a loose patch is its outline, not a hole in it."""
    fill_unevenness: float = 0.2
    """Greatest distance of a rim's corners from its plane, as a share of the hole's size [-].
    Default 0.2: a fan over such a rim is off by a fifth of a small hole."""
    max_faces: int = GIGANTIC_FACES
    """Meshes with more faces are simplified to it. Default 1 000 000: at 10 cm the faces are then
    0.2 mm wide, finer than any depth camera resolves."""


def repaired(mesh: Mesh, config: RepairConfig | None = None) -> Repair:
    """Return the mesh made sound as far as that is possible without changing its shape.

    In this order: rims welded, collapsed and duplicate faces and stray specks dropped, winding
    made consistent, small holes closed, winding turned outward (walls of cavities: into the
    cavity), unused and equal vertices merged, gigantic meshes simplified. Repairing the result
    again changes nothing.

    Args:
        mesh: any mesh; its colours or its texture are kept.
        config: what the repair may do; by default RepairConfig().

    Raises:
        DegenerateError: the mesh has no area or is flat: it cannot be an object.
    """
    config = config or RepairConfig()
    before = survey(mesh)
    _require_solid(before)
    actions: list[str] = []
    cleaned = _filled(_without_specks(before, config, actions), config, actions)
    found = before if cleaned is before.mesh else survey(cleaned)
    turned = _outward(found, actions)
    result = _merged_rows(turned, actions)
    after = found if result is found.mesh else survey(result)
    if len(result.faces) > config.max_faces:
        result = _reduced(result, config.max_faces, actions)
        after = survey(result)
    return Repair(mesh=result, before=report(before), after=report(after), actions=tuple(actions))


def _require_solid(s: Survey) -> None:
    """Raise unless the mesh has area and extent in all directions."""
    faces, size = len(s.topology.faces), s.topology.size
    if not float(s.areas.sum()) > 0.0:
        raise DegenerateError(
            f"the mesh has {faces} faces and no area: all are lines or points. A closed surface "
            "is needed; export the mesh again."
        )
    if s.is_flat:
        extents = " x ".join(f"{x:.4g}" for x in s.thickness)
        raise DegenerateError(
            f"the mesh is flat: {extents} along its principal axes, where the least must be more "
            f"than {FLAT_SHARE:g} of the size {size:.4g}. A sheet has no volume and "
            "cannot be an object; give it its thickness."
        )


def _without_specks(s: Survey, config: RepairConfig, actions: list[str]) -> Survey | Mesh:
    """Drop specks, collapsed and repeated faces; put welded rims on one position."""
    topo, mesh = s.topology, s.mesh
    specks = s.specks(config.speck_size_share, config.speck_area_share)
    stray = np.r_[specks, False][s.body] & topo.proper
    vertices = mesh.vertices.copy()
    used = topo.index >= 0
    vertices[used] = topo.positions[topo.index[used]]
    moved = int(np.count_nonzero(np.any(vertices != mesh.vertices, axis=1)))
    if moved:
        actions.append(
            f"welded {counted(moved, 'vertex', 'vertices')} of rims that met within rounding."
        )
    if np.any(topo.collapsed):
        actions.append(f"dropped {counted(int(topo.collapsed.sum()), 'degenerate face')}.")
    if np.any(topo.repeated):
        n, backs = int(topo.repeated.sum()), int((topo.repeated & topo.two_sided).sum())
        note = f" ({backs} of them backs of double-sided faces)" if backs else ""
        actions.append(f"dropped {counted(n, 'duplicate face')}{note}.")
    if np.any(topo.folded):
        share = 100.0 * float(s.areas[topo.folded].sum() / s.areas.sum())
        actions.append(
            f"dropped {counted(int(topo.folded.sum()), 'face')} folded back to back "
            f"({share:.2g} % of the area)."
        )
    if np.any(stray):
        largest = 100.0 * float(s.body_sizes[specks].max()) / topo.size
        actions.append(
            f"dropped {counted(int(specks.sum()), 'stray speck')}, the largest {largest:.2g} % of "
            "the extent."
        )
    keep = topo.proper & ~stray
    if moved == 0 and np.all(keep):
        return s
    return replace(mesh, vertices=vertices, faces=mesh.faces[keep])


def _filled(given: Survey | Mesh, config: RepairConfig, actions: list[str]) -> Mesh:
    """Make the winding consistent within every patch and close small holes."""
    s = given if isinstance(given, Survey) else survey(given)
    mesh, against = s.mesh, s.orientation.against
    # The rim of a loose piece is its outline: to close it would double the piece, not mend it.
    own = config.fill_body_share * np.r_[s.body_sizes, 0.0][s.body]
    fillers = find_fillers(
        s.topology,
        mesh.faces,
        against,
        np.minimum(own, config.fill_size_share * s.topology.size),
        config.fill_unevenness,
    )
    if np.any(against):
        actions.append(
            f"turned {counted(int(against.sum()), 'face')} that wound against their neighbours."
        )
        faces = mesh.faces.copy()
        faces[against] = faces[against][:, ::-1]
        mesh = replace(mesh, faces=faces)
    if len(fillers.centers) == 0:
        return mesh
    largest = float(fillers.sizes.max()) / s.topology.size
    left = f" Small holes left open: {'; '.join(fillers.left)}." if fillers.left else ""
    actions.append(
        f"closed {counted(len(fillers.centers), 'small hole')}, the largest "
        f"{100 * largest:.2g} % of the extent.{left}"
    )
    return _with_fans(mesh, fillers)


def _with_fans(mesh: Mesh, fillers: Fillers) -> Mesh:
    """Return the mesh with the fans added.

    With a texture every triangle has a tip of its own, whose texture coordinates are the middle
    of its rim edge: the colours of the rim run inwards, and no triangle crosses a chart.
    """
    rim, hole, n = fillers.rim, fillers.hole, len(mesh.vertices)
    if mesh.uv is not None:
        tips = np.arange(len(rim))
        centers, uv = fillers.centers[hole], mesh.uv[rim].mean(axis=1)
        colors = None if mesh.colors is None else mesh.colors[rim].mean(axis=1)
    else:
        tips, centers, uv = hole, fillers.centers, None
        count = np.bincount(hole)[:, None]
        colors = None
        if mesh.colors is not None:
            colors = np.stack(
                [np.bincount(hole, mesh.colors[rim[:, 0], k]) for k in range(3)], axis=-1
            )
            colors = colors / count
    fans = np.column_stack([rim, n + tips]).astype(np.int32)
    return replace(
        mesh,
        vertices=np.concatenate([mesh.vertices, centers]),
        faces=np.concatenate([mesh.faces, fans]),
        uv=None if mesh.uv is None or uv is None else np.concatenate([mesh.uv, uv]),
        colors=None
        if mesh.colors is None or colors is None
        else np.concatenate([mesh.colors, np.rint(colors).astype(np.uint8)]),
    )


def _outward(s: Survey, actions: list[str]) -> Mesh:
    """Turn the faces of patches that point inwards."""
    flip = s.orientation.flip
    if not np.any(flip):
        return s.mesh
    share = float(s.areas[flip].sum() / s.areas.sum())
    actions.append(
        f"turned {counted(int(flip.sum()), 'face')} outward ({100 * share:.3g} % of the area)."
    )
    faces = s.mesh.faces.copy()
    faces[flip] = faces[flip][:, ::-1]
    return replace(s.mesh, faces=faces)


def _merged_rows(mesh: Mesh, actions: list[str]) -> Mesh:
    """Drop vertices without a face and merge those equal in position, colour and texture."""
    used = np.zeros(len(mesh.vertices), dtype=bool)
    used[mesh.faces.ravel()] = True
    unused = len(used) - int(used.sum())
    numbers = np.flatnonzero(used)
    _, kind = equal_rows(mesh.vertices[numbers])
    columns = [kind]
    if mesh.uv is not None:
        columns.append(equal_rows(mesh.uv[numbers])[1])
    if mesh.colors is not None:
        columns += [mesh.colors[numbers, k].astype(np.int64) for k in range(3)]
    first, kind = equal_rows(np.stack(columns, axis=-1))
    equal = len(numbers) - len(first)
    if unused:
        actions.append(f"dropped {counted(unused, 'vertex', 'vertices')} that no face used.")
    if equal:
        actions.append(
            f"merged {counted(equal, 'vertex', 'vertices')} equal in position, colour and texture."
        )
    if not unused and not equal:
        return mesh
    rows = numbers[first]
    index = np.full(len(used), -1, dtype=np.int32)
    index[numbers] = kind
    return replace(
        mesh,
        vertices=mesh.vertices[rows],
        faces=index[mesh.faces],
        uv=None if mesh.uv is None else mesh.uv[rows],
        colors=None if mesh.colors is None else mesh.colors[rows],
    )


def _reduced(mesh: Mesh, max_faces: int, actions: list[str]) -> Mesh:
    """Simplify a gigantic mesh and say what that changed."""
    result = simplified(mesh, max_faces)
    size = float(np.ptp(mesh.vertices, axis=0).max())
    off = 100.0 * deviation(mesh, result) / size
    colors = " The texture became colours of the vertices." if mesh.texture is not None else ""
    actions.append(
        f"simplified from {len(mesh.faces)} to {len(result.faces)} faces; the surfaces differ by "
        f"at most {off:.2g} % of the extent.{colors}"
    )
    return result
