"""Convex parts of a mesh: what a physics engine can collide.

A mesh that nearly fills its hull is its hull; others are decomposed by CoACD (Wei et al. 2022) with
bounded search. Results are kept in a folder by content, because the search takes seconds.
"""

import hashlib
import json
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from realsim.errors import InputError
from realsim.geometry.mesh import hull_vertices, mass_properties, welded_mesh
from realsim.records import Mesh
from realsim_sim_bridge.school.arrays_on_disk import is_whole, read_arrays, write_arrays

Array = NDArray[np.float64]
GOLDEN_ANGLE = np.pi * (3.0 - np.sqrt(5.0))


@dataclass(frozen=True, kw_only=True, slots=True)
class ConvexConfig:
    """How finely a mesh is cut."""

    hull_ratio: float = 1.03
    """A mesh whose hull is at most so much larger is taken for convex [-]."""
    thresholds: tuple[float, ...] = (0.05, 0.02)
    """CoACD's concavity thresholds [-], tried in turn until the parts are not too fat. Its own
    default is 0.05; a mug's wall needs 0.02."""
    fat_ratio: float = 1.10
    """Largest volume of the parts / volume of the mesh that is accepted before the last threshold:
    a cup whose wall is a third too thick pushes the fingers away while they close."""
    mcts_iterations: int = 20
    """Tree search iterations per cut; CoACD's default of 150 takes minutes on a mug."""
    mcts_nodes: int = 10
    """Candidate planes per axis; half of CoACD's default."""
    mcts_depth: int = 2
    """Cuts looked ahead; CoACD's default is 3."""
    preprocess_resolution: int = 30
    """Voxels per axis when a mesh that is not watertight is closed first."""
    max_vertices: int = 64
    """Vertices kept per part: those farthest out in so many evenly spread directions."""
    seed: int = 0
    """CoACD's own seed."""


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class ConvexParts:
    """Convex parts and how well they fill the mesh."""

    parts: tuple[Array, ...]
    """Vertices (V, 3) of each part [m]."""
    volume_ratio: float
    """Volume of the parts / volume of the mesh: 1.33 is a third too fat. Where the mesh is not
    closed its hull's volume stands below the line."""
    method: str
    """'hull' or 'coacd'."""


def convex_parts(mesh: Mesh, config: ConvexConfig, cache: Path | None = None) -> ConvexParts:
    """Return the convex parts of a mesh [m], from the cache folder if they are there."""
    mesh = welded_mesh(mesh)
    path = None if cache is None else cache / f"convex_{_content(mesh, config)}.npz"
    if path is not None and is_whole(path):
        return _read(path)
    solid = mass_properties(mesh, density=1.0)
    if solid.is_watertight and 1.0 / solid.hull_volume_fraction <= config.hull_ratio:
        method, pieces = "hull", [mesh.vertices]
    else:
        method, pieces = "coacd", []
        for threshold in config.thresholds:
            pieces = _decompose(mesh, solid.is_watertight, threshold, config)
            if sum(_hull_volume(p) for p in pieces) <= config.fat_ratio * solid.volume_m3:
                break
    parts = tuple(_outermost(hull_vertices(piece), config.max_vertices) for piece in pieces)
    volume = sum(_hull_volume(part) for part in parts)
    result = ConvexParts(parts=parts, volume_ratio=volume / solid.volume_m3, method=method)
    if path is not None:
        _write(path, result)
    return result


def _decompose(mesh: Mesh, watertight: bool, threshold: float, config: ConvexConfig) -> list[Array]:
    """Return the vertices of CoACD's parts [m]."""
    import coacd

    coacd.set_log_level("off")
    found: Any = coacd.run_coacd(
        coacd.Mesh(mesh.vertices.copy(), mesh.faces.copy()),
        threshold=threshold,
        # Re-meshing fattens a mesh that is already closed: +41 % on a mug, +0.4 % without it.
        preprocess_mode="off" if watertight else "on",
        preprocess_resolution=config.preprocess_resolution,
        mcts_iterations=config.mcts_iterations,
        mcts_nodes=config.mcts_nodes,
        mcts_max_depth=config.mcts_depth,
        seed=config.seed,
    )
    pieces = [np.asarray(vertices, dtype=np.float64) for vertices, _ in found]
    solid = [piece for piece in pieces if _hull_volume(piece) > 0]
    if not solid:
        raise InputError(
            f"the mesh ({len(mesh.vertices)} vertices, extent {mesh.extent.tolist()} m) has no "
            "convex part with a volume; a solid object is needed. Is it a folded sheet?"
        )
    return solid


def _outermost(vertices: Array, count: int) -> Array:
    """Return at most `count` of the vertices: the farthest out in evenly spread directions."""
    if len(vertices) <= count:
        return vertices
    i = np.arange(count) + 0.5
    polar, around = np.arccos(1.0 - 2.0 * i / count), GOLDEN_ANGLE * i
    directions = np.stack(
        [np.sin(polar) * np.cos(around), np.sin(polar) * np.sin(around), np.cos(polar)]
    )
    kept = vertices[np.unique(np.argmax(vertices @ directions, axis=0))]
    return kept if _hull_volume(kept) > 0 else vertices


def _hull_volume(vertices: Array) -> float:
    """Return the volume of the hull [m^3]; 0 where the points are flat."""
    from scipy.spatial import ConvexHull, QhullError

    try:
        return float(ConvexHull(vertices).volume)
    except QhullError:
        return 0.0


def _content(mesh: Mesh, config: ConvexConfig) -> str:
    """Return a key of everything the parts depend on."""
    digest = hashlib.sha256(mesh.vertices.tobytes() + mesh.faces.tobytes())
    digest.update(json.dumps(asdict(config), sort_keys=True).encode())
    return digest.hexdigest()[:24]


def _write(path: Path, result: ConvexParts) -> None:
    """Keep the parts on disk."""
    write_arrays(
        path,
        {
            "vertices": np.concatenate(result.parts),
            "counts": np.array([len(p) for p in result.parts]),
        },
        {"volume_ratio": result.volume_ratio, "method": result.method},
    )


def _read(path: Path) -> ConvexParts:
    """Return parts kept on disk."""
    arrays, notes = read_arrays(path)
    ends = np.cumsum(arrays["counts"])[:-1]
    return ConvexParts(
        parts=tuple(np.split(arrays["vertices"], ends)),
        volume_ratio=float(notes["volume_ratio"]),
        method=str(notes["method"]),
    )
