"""The process that runs CoACD: `python -m realsim.models.convex_worker JOB FOLDER`.

CoACD cannot be told how long it may take, nor be stopped. Here it runs alone: the system ends the
process when its CPU time is used up, and the process ends itself when whoever started it is gone.
What each threshold gives is written at once, so that nothing finished is lost.

How finely a mesh is cut into convex parts, and how long that may take.
"""

import math
import os
import signal
import sys
import threading
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from realsim.arrays import Array, Int32
from realsim.errors import InputError
from realsim.geometry.mesh_shape import hull_vertices
from realsim.models.convex_hulls import fewest, hull_volume, outermost
from realsim.store.arrays_on_disk import read_arrays, write_arrays


@dataclass(frozen=True, kw_only=True, slots=True)
class ConvexConfig:
    """How finely a mesh is cut."""

    hull_ratio: float = 1.03
    """A mesh whose hull is at most so much larger is taken for convex [-]."""
    thresholds: tuple[float, ...] = (0.1, 0.05, 0.02)
    """CoACD's concavity thresholds [-], tried in turn until the parts are as large as the mesh.
    Its own default is 0.05; a mug's wall needs 0.02. The coarse one is cheap: it is what is left
    when the time is over."""
    coarse_ratio: float = 1.03
    """What `fat_ratio` is for the first of several thresholds [-]. A stepped shaft in one part is
    only 7 % too large, but has no step left to grasp; within 3 % a finer cut changes nothing."""
    fat_ratio: float = 1.10
    """Largest volume of the parts / volume of the mesh that is accepted before the last threshold:
    a cup whose wall is a third too thick pushes the fingers away while they close."""
    thin_ratio: float = 0.90
    """The least such ratio: fingers close on air where a part of the object is missing."""
    mcts_iterations: int = 20
    """Tree search iterations per cut; CoACD's default of 150 takes minutes on a mug."""
    mcts_nodes: int = 10
    """Candidate planes per axis; half of CoACD's default."""
    mcts_depth: int = 2
    """Cuts looked ahead; CoACD's default is 3."""
    preprocess_resolution: int = 30
    """Voxels per axis when a mesh that is not watertight is closed first."""
    max_faces: int = 6000
    """Triangles given to CoACD, whose time grows with them; meshes of more are thinned first."""
    max_parts: int = 128
    """Convex parts at most; a mug takes 60. The engines' time grows with them."""
    max_vertices: int = 64
    """Vertices kept per part: those farthest out in so many evenly spread directions."""
    most_vertices: int = 256
    """Vertices at most where the parts would be smaller than the mesh by `vertex_loss`."""
    vertex_loss: float = 0.03
    """Share of the volume that leaving vertices out may cost [-]: 0.5 mm of a 6 cm can's radius.
    64 vertices of a capsule lose 8 %."""
    time_limit_s: float = 180.0
    """CPU time for all thresholds together [s]; then the best parts found so far are taken.
    A flange with seven bores takes 70 on a busy machine, and its parts must not hang on that."""
    seed: int = 0
    """CoACD's own seed."""

    def __post_init__(self) -> None:
        """Check what bounds the time and the number of parts."""
        if not self.time_limit_s > 0:
            raise InputError(f"the time limit is {self.time_limit_s} s; a positive one is needed.")
        if self.most_vertices < self.max_vertices or not 0 <= self.vertex_loss < 1:
            raise InputError(
                f"{self.max_vertices} vertices per part, at most {self.most_vertices} where a "
                f"share of {self.vertex_loss:g} of the volume is lost, contradict each other; "
                "max_vertices <= most_vertices and 0 <= vertex_loss < 1 are needed (64, 256, 0.03)."
            )
        if self.max_parts < 1 or self.max_vertices < 4 or self.max_faces < 4:
            raise InputError(
                f"at most {self.max_parts} parts of {self.max_vertices} vertices, from "
                f"{self.max_faces} faces, hold no solid; at least 1, 4 and 4 are needed."
            )
        if not self.thresholds or not all(0.01 <= t <= 1 for t in self.thresholds):
            raise InputError(
                f"the concavity thresholds are {self.thresholds}; CoACD takes one or more from "
                "0.01 to 1 (0.05)."
            )


def step_path(folder: Path, step: int) -> Path:
    """Return where the parts of a threshold are written."""
    return folder / f"step_{step}.npz"


def passes(ratio: float, config: ConvexConfig, closed: bool, step: int) -> bool:
    """Return whether parts of this volume / the mesh's volume are good enough.

    The volume of an open mesh is its hull's: parts that keep its hollows are smaller.

    Args:
        ratio: volume of the parts / volume of the mesh.
        config: what is accepted.
        closed: whether the mesh is.
        step: which of the thresholds gave the parts.
    """
    if not closed:
        return ratio <= config.fat_ratio
    if step == 0 and len(config.thresholds) > 1:
        return 2.0 - config.coarse_ratio <= ratio <= config.coarse_ratio
    return config.thin_ratio <= ratio <= config.fat_ratio


def decompose(job: Path, folder: Path) -> None:
    """Write the convex parts of a job's mesh per threshold, until they are good enough."""
    arrays, notes = read_arrays(job)
    settings: dict[str, Any] = notes["config"]
    thresholds = tuple(float(t) for t in settings.pop("thresholds"))
    config = ConvexConfig(thresholds=thresholds, **settings)
    for step, threshold in enumerate(config.thresholds):
        pieces = _coacd(arrays["vertices"], arrays["faces"], notes["is_closed"], threshold, config)
        parts = light([hull_vertices(piece) for piece in pieces], notes["volume_m3"], config)
        parts = [part for part in parts if hull_volume(part) > 0]
        ratio = sum(hull_volume(part) for part in parts) / notes["volume_m3"]
        counts = np.array([len(part) for part in parts], dtype=np.int64)
        vertices = np.concatenate([np.zeros((0, 3)), *parts])
        write_arrays(
            step_path(folder, step),
            {"vertices": vertices, "counts": counts},
            {"ratio": ratio, "threshold": threshold, "step": step},
        )
        if passes(ratio, config, notes["is_closed"], step):
            break


def light(hulls: list[Array], volume_m3: float, config: ConvexConfig) -> list[Array]:
    """Return the corners that are kept of parts: few, unless the parts as a whole get too thin.

    Args:
        hulls: corners of each part.
        volume_m3: of the mesh; parts that are larger may lose what they have too much.
        config: how many corners, and what may be lost.
    """
    few = [outermost(hull, config.max_vertices) for hull in hulls]
    full = sum(hull_volume(hull) for hull in hulls)
    if sum(hull_volume(part) for part in few) >= (1.0 - config.vertex_loss) * min(full, volume_m3):
        return few
    counts = (config.max_vertices, config.most_vertices)
    return [fewest(hull, *counts, config.vertex_loss) for hull in hulls]


def _coacd(
    vertices: Array, faces: Int32, closed: bool, threshold: float, config: ConvexConfig
) -> list[Array]:
    """Return the vertices of CoACD's parts [m]."""
    import coacd

    coacd.set_log_level("off")
    found: Any = coacd.run_coacd(
        coacd.Mesh(vertices.copy(), faces.copy()),
        threshold=threshold,
        max_convex_hull=config.max_parts,
        # Re-meshing fattens a mesh that is already closed: +41 % on a mug, +0.4 % without it.
        preprocess_mode="off" if closed else "on",
        preprocess_resolution=config.preprocess_resolution,
        mcts_iterations=config.mcts_iterations,
        mcts_nodes=config.mcts_nodes,
        mcts_max_depth=config.mcts_depth,
        seed=config.seed,
    )
    return [np.asarray(piece, dtype=np.float64) for piece, _ in found]


def _end_with_parent() -> None:
    """End this process when its standard input is closed: its parent holds the other end."""

    def wait() -> None:
        while os.read(0, 1):
            pass
        os._exit(1)

    threading.Thread(target=wait, daemon=True).start()


def _main(job: Path, folder: Path) -> int:
    # Ctrl-C reaches every process of the terminal; the parent alone answers it.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    _end_with_parent()
    _, notes = read_arrays(job)
    try:
        import resource
    except ImportError:  # Windows: the parent's clock is the only limit
        pass
    else:
        limit = math.ceil(float(notes["config"]["time_limit_s"]))
        resource.setrlimit(resource.RLIMIT_CPU, (limit, limit + 1))
    try:
        decompose(job, folder)
    except InputError as error:
        print(error, file=sys.stderr)
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(_main(Path(sys.argv[1]), Path(sys.argv[2])))
