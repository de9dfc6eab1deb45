"""A mesh file with what is known of its unit and its axes, in metres with z up.

What a file can and cannot tell:

- Unit. USD states it. glTF prescribes metres, but generators write meshes of any size in it, so
  that it states nothing. All other formats hold bare numbers.
- Up axis. glTF prescribes y, USD states it. All other formats hold bare axes, which are kept.
- Handedness. A node that is mirrored by its transform shows in the transform; its faces are turned
  so that the outside stays outside, and a note says so. USD also states a left-handed winding,
  which is turned likewise. But a mesh whose coordinates were written in left-handed axes is just a
  mirror image of the object: nothing in the file tells it from a genuine one, unless its winding
  was left as it was, when it is inside-out (`inspect_mesh`). Only a look at the object (or a fit to
  depth images) shows it, and for mirror-symmetric objects it does not matter.
"""

from dataclasses import replace
from pathlib import Path

import numpy as np

from realsim.arrays import Array
from realsim.errors import InputError, UnitError
from realsim.models.mesh_atlas import FileContent, Piece, one_mesh
from realsim.models.mesh_loading import TRIMESH_FORMATS, load_pieces
from realsim.models.mesh_topology import equal_rows
from realsim.models.model_records import METRES, ReadScan, ScanUnit, UpAxis
from realsim.models.usd_reading import USD_FORMATS, load_usd
from realsim.records import Mesh
from realsim.store.provenance import sha256_of

SCAN_FORMATS = (*TRIMESH_FORMATS, *USD_FORMATS)
SMALLEST_M, LARGEST_M = 0.004, 1.7
"""Largest extents outside of this are no object on a table: the unit is wrong [m]. A library's
files take diameters up to 3 m, which a cube of 1.73 m has."""
USUAL_M = 0.8
"""A larger object is seldom grasped: its size is told in all units [m]."""
ROTATIONS: dict[UpAxis, tuple[tuple[int, int, int], ...]] = {
    "z": ((1, 0, 0), (0, 1, 0), (0, 0, 1)),
    "-z": ((1, 0, 0), (0, -1, 0), (0, 0, -1)),
    "y": ((1, 0, 0), (0, 0, -1), (0, 1, 0)),
    "-y": ((1, 0, 0), (0, 0, 1), (0, -1, 0)),
    "x": ((0, 0, -1), (0, 1, 0), (1, 0, 0)),
    "-x": ((0, 0, 1), (0, 1, 0), (-1, 0, 0)),
}
"""The turn that brings each axis up: about x for y and z, about y for x."""


def read_scan(path: Path | str, unit: ScanUnit | None, up: UpAxis | None = None) -> ReadScan:
    """Read a GLB, GLTF, OBJ, PLY, STL, OFF or USD file as one mesh in metres, z up.

    All parts are merged, each placed by its transform. Colours and textures are kept; several
    textures are laid into one. STL repeats every corner, so its equal vertices are merged;
    elsewhere vertices stay as they are in the file.

    Args:
        path: the file. USD needs the extra `realsim[usd]`.
        unit: what one unit of the file is; 'none' for a mesh without metric scale (a generated
            one), which keeps its numbers; None to take what the file states.
        up: the axis of the file that points up; None to take what the file states, or else to
            keep the axes.

    Raises:
        InputError: no such file, a broken or empty file, a cloud of points, coordinates that are
            not numbers, no extent, a file that reads outside its folder; or the unit is not known.
        UnitError: the size is impossible in that unit, or the file states another unit.
        MissingLibraryError: a USD file, and the extra is not installed.
    """
    path = Path(path)
    content = _content(path)
    for piece in content.pieces:
        _check_piece(path, piece)
    used = np.concatenate([_used_bounds(p) for p in content.pieces])
    extent = float(np.ptp(used, axis=0).max())
    if not extent > 0.0:
        raise InputError(
            f"{path} has no extent: all vertices of its faces are one point. Export it again."
        )
    notes = list(content.notes)
    unit, factor = _scale(path, content, unit, extent, notes)
    axis = _up_axis(content, up, notes)
    R_up = np.array(ROTATIONS[axis], dtype=np.float64)
    mesh, made = one_mesh(content.pieces)
    if path.suffix.lower() == ".stl":
        mesh = _welded(mesh)
    vertices = mesh.vertices if axis == "z" else mesh.vertices @ R_up.T
    return ReadScan(
        mesh=replace(mesh, vertices=factor * vertices),
        unit=unit,
        factor=factor,
        R_up=R_up,
        sha256=sha256_of(path),
        declared=content.declared,
        notes=(*notes, *made),
    )


def _content(path: Path) -> FileContent:
    """Return the pieces of the file.

    Raises:
        InputError: there is nothing to read.
    """
    kind = path.suffix.lower()
    if kind not in SCAN_FORMATS:
        raise InputError(f"{path}: '{kind}' is not a mesh format; {', '.join(SCAN_FORMATS)} are.")
    if not path.is_file():
        raise InputError(f"{path} does not exist; a mesh file was expected there.")
    if path.stat().st_size == 0:
        raise InputError(f"{path} is empty (0 bytes); export the mesh again.")
    content = load_usd(path) if kind in USD_FORMATS else load_pieces(path)
    if not content.pieces:
        raise InputError(
            f"{path} has no triangles; a surface mesh is needed, not an empty scene or a cloud of "
            "points. Is the file whole? If so, mesh the points first, or export the surface."
        )
    return content


def _check_piece(path: Path, piece: Piece) -> None:
    """Raise if a piece has faces without vertices or coordinates that are not numbers."""
    low, high, n = int(piece.faces.min()), int(piece.faces.max()), len(piece.vertices)
    if low < 0 or high >= n:
        raise InputError(
            f"{path}: a face of '{piece.name}' names vertex {low if low < 0 else high} of {n}. The "
            "file is broken; export it again."
        )
    finite = np.isfinite(piece.vertices).all(axis=1)
    if not finite.all():
        raise InputError(
            f"{path}: {int((~finite).sum())} of {n} vertices of '{piece.name}' have coordinates "
            "that are not finite numbers. Repair the mesh in the program that wrote it."
        )
    if piece.uv is not None and not np.isfinite(piece.uv).all():
        raise InputError(
            f"{path}: texture coordinates of '{piece.name}' are not finite numbers. Export the "
            "mesh again."
        )


def _used_bounds(piece: Piece) -> Array:
    """Return the box (2, 3) of the vertices that faces use: strays must not decide on the unit."""
    used = np.zeros(len(piece.vertices), dtype=bool)
    used[piece.faces.ravel()] = True
    points = piece.vertices[used]
    return np.stack([points.min(axis=0), points.max(axis=0)])


def _length(metres: float) -> str:
    """Return a length for people: millimetres below a metre."""
    return f"{metres * 1e3:.3g} mm" if metres < 1.0 else f"{metres:.4g} m"


def _readings(extent: float) -> str:
    """Return what the largest extent is in every unit."""
    sizes = ", ".join(f"{_length(extent * m)} as {u}" for u, m in METRES.items())
    return f"its largest extent is {extent:.4g}: {sizes}"


def _scale(
    path: Path, content: FileContent, unit: ScanUnit | None, extent: float, notes: list[str]
) -> tuple[ScanUnit, float]:
    """Return the unit and what the file's numbers are multiplied by.

    Raises:
        InputError: neither the user nor the file states the unit.
        UnitError: they state different ones, or the size is impossible.
    """
    if unit is not None and unit not in (*METRES, "none"):
        raise UnitError(f"the unit '{unit}' is not known; {', '.join(METRES)} and none are.")
    stated = content.unit
    if unit == "none":
        if stated or content.format_unit:
            notes.append(
                f"the file's unit ({stated or content.format_unit}) is set aside: no metric scale."
            )
        return "none", 1.0
    if stated is not None and unit is not None and unit != stated:
        raise UnitError(
            f"{path} states its unit as {stated}, but --unit {unit} is given; {_readings(extent)}. "
            f"Leave --unit away or give --unit {stated}; --unit none if it has no metric scale."
        )
    chosen = unit or stated
    if chosen is None and content.format_unit is not None:
        raise InputError(
            f"{path}: {content.declared['format']} prescribes metres, but generators write meshes "
            f"without scale in it; {_readings(extent)}. Give --unit {' or '.join(METRES)}; a "
            "generated mesh has no scale: --unit none."
        )
    if chosen is None:
        raise InputError(
            f"{path} does not state its unit; {_readings(extent)}. Give --unit "
            f"{' or '.join(METRES)}; a generated mesh has no scale: --unit none."
        )
    if content.format_unit not in (None, chosen):
        notes.append(
            f"--unit {chosen} is taken, although the format prescribes {content.format_unit}."
        )
    size = extent * METRES[chosen]
    if not SMALLEST_M <= size <= LARGEST_M:
        raise UnitError(
            f"{path} in {chosen} would be {_length(size)} large, and {_length(SMALLEST_M)} to "
            f"{_length(LARGEST_M)} is accepted; {_readings(extent)}. Give the unit that makes "
            "sense; a generated mesh has no scale: --unit none."
        )
    if size > USUAL_M:
        notes.append(f"in {chosen} it is {_length(size)} large. Is that so? {_readings(extent)}.")
    return chosen, METRES[chosen]


def _up_axis(content: FileContent, up: UpAxis | None, notes: list[str]) -> UpAxis:
    """Return the file's axis that points up, and note where it comes from.

    Raises:
        InputError: no such axis.
    """
    if up is not None and up not in ROTATIONS:
        raise InputError(f"the up axis '{up}' is not known; {', '.join(ROTATIONS)} are.")
    if up is not None and content.up not in (None, up):
        notes.append(f"--up {up} is taken, although the file or its format says {content.up}.")
    axis = up or content.up
    if axis is None:
        notes.append("the file does not say which axis points up: its axes are kept.")
        return "z"
    if axis != "z":
        notes.append(f"turned so that the file's {axis} axis points up (z).")
    return axis


def _welded(mesh: Mesh) -> Mesh:
    """Merge equal positions, in the order of their first use."""
    first, kind = equal_rows(mesh.vertices)
    return Mesh(vertices=mesh.vertices[first], faces=kind[mesh.faces].astype(np.int32))
