"""Convex parts of a mesh: what a physics engine can collide.

A mesh that nearly fills its hull is its hull; others are decomposed by CoACD (Wei et al. 2022) in a
process of its own, whose time is bounded. The coarsest parts whose volume is the mesh's are taken,
else the best found in time, else the hull; `method` and `notes` say which. Results are kept by
content, in a folder of the caller's and for all runs of the user: the search takes seconds.
"""

import hashlib
import json
import math
import os
import signal
import subprocess
import sys
import tempfile
import time
from contextlib import suppress
from dataclasses import asdict, replace
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from realsim.arrays import Array, Int32
from realsim.errors import InputError
from realsim.geometry.mesh import decimated, hull_vertices, mass_properties, welded_mesh
from realsim.models.convex_hulls import collision_obj, hull_volume, parts_from_collision_obj
from realsim.models.convex_worker import ConvexConfig, decompose, light, passes, step_path
from realsim.models.model_records import ConvexParts
from realsim.records import Mesh
from realsim.store.arrays_on_disk import is_whole, read_arrays, write_arrays
from realsim.user_cache import user_cache

__all__ = ["ConvexConfig", "collision_obj", "convex_parts", "parts_from_collision_obj"]

RESULTS_VERSION = 3
"""Raised whenever the same mesh gives other parts, so that old cache files are not used."""
SAME_VOLUME = 0.02
"""A thinned mesh whose volume differs by more is not used [share of the volume]."""
WALL_FACTOR = 20.0
"""Time by the clock that the process may take per second of its CPU limit: only one that hangs
takes so long, and what else the machine does must not change the parts."""
POLL_S = 0.05
ONE_THREAD = {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1", "MKL_NUM_THREADS": "1"}
"""The threads' CPU time counts together, and several objects are cut at a time."""


def convex_parts(mesh: Mesh, config: ConvexConfig, cache: Path | None = None) -> ConvexParts:
    """Return the convex parts of a mesh [m], from the cache folder if they are there.

    Args:
        mesh: need not be closed; then it is voxelised first and its volume is its hull's.
        config: how finely, and how long.
        cache: a folder for results; None = none are kept, nor taken from earlier runs.

    Raises:
        InputError: the mesh is flat.
    """
    mesh = welded_mesh(mesh)
    if cache is None:
        return _found(mesh, config)
    own = cache / f"convex_{_content(mesh, config)}.npz"
    if is_whole(own):
        return _read(own)
    shared = user_cache("convex") / own.name
    with suppress(OSError):
        if is_whole(shared):
            return _kept(own, _read(shared))
    result = _kept(own, _found(mesh, config))
    # What a busy machine had no time for is not every run's.
    if not any(note.startswith("CoACD") for note in result.notes):
        with suppress(OSError):
            _kept(shared, result)
    return result


def _found(mesh: Mesh, config: ConvexConfig) -> ConvexParts:
    """Return the convex parts of a welded mesh."""
    solid = mass_properties(mesh, density=1.0)
    if solid.is_watertight and 1.0 / solid.hull_volume_fraction <= config.hull_ratio:
        return _hull(mesh, solid.volume_m3, config, "hull")
    return _decomposed(mesh, solid.is_watertight, solid.volume_m3, config)


def _hull(mesh: Mesh, volume_m3: float, config: ConvexConfig, method: str) -> ConvexParts:
    """Return the hull as the only part."""
    part = light([hull_vertices(mesh.vertices)], volume_m3, config)[0]
    ratio = hull_volume(part) / volume_m3
    return ConvexParts(parts=(part,), volume_ratio=ratio, method=method)


def _decomposed(mesh: Mesh, closed: bool, volume_m3: float, config: ConvexConfig) -> ConvexParts:
    """Return CoACD's parts, or the hull where it has none to offer in time."""
    notes: list[str] = []
    thin = decimated(mesh, config.max_faces)
    thin = thin if len(thin.faces) else mesh
    volume = mass_properties(thin, density=1.0)
    if closed and not (
        volume.is_watertight and abs(volume.volume_m3 / volume_m3 - 1) < SAME_VOLUME
    ):
        notes.append(
            f"the {len(mesh.faces)} faces could not be thinned to {config.max_faces} without "
            "opening the mesh; all of them are decomposed, which takes longer."
        )
        thin = mesh
    if not closed:
        notes.append(
            "the mesh is not closed: it was voxelised before it was cut, and its volume is taken "
            "to be its hull's; repair it for parts that can be judged."
        )
    job = {"is_closed": closed, "volume_m3": volume_m3, "config": asdict(config)}
    with tempfile.TemporaryDirectory(prefix="realsim_convex_") as name:
        folder = Path(name)
        arrays = {"vertices": thin.vertices, "faces": _outward(thin, closed)}
        write_arrays(folder / "job.npz", arrays, job)
        ended, seconds = _run(folder, config)
        steps = [step_path(folder, k) for k in range(len(config.thresholds))]
        found = [read_arrays(step) for step in steps if is_whole(step)]
    found = [(arrays, notes) for arrays, notes in found if len(arrays["counts"])]
    if ended:
        notes.append(ended)
    if not found:
        method = "hull (out of time)" if "time" in ended else "hull"
        hull = _hull(mesh, volume_m3, config, method)
        notes.append(
            f"the hull stands for the mesh: {hull.volume_ratio:.2f} times its volume, no hollow."
        )
        return replace(hull, seconds=seconds, notes=tuple(notes))
    chosen, said = _chosen(found, config, closed)
    ratio = float(said["ratio"])
    if closed and not passes(ratio, config, closed, int(said["step"])):
        notes.append(
            f"the parts are {ratio:.3f} times the mesh's volume at best (threshold "
            f"{said['threshold']:g}); {config.thin_ratio:g} to {config.fat_ratio:g} was wanted."
        )
    return ConvexParts(
        parts=_split(chosen),
        volume_ratio=ratio,
        method="coacd",
        seconds=seconds,
        notes=tuple(notes),
    )


def _chosen(
    found: list[tuple[dict[str, NDArray[Any]], dict[str, Any]]], config: ConvexConfig, closed: bool
) -> tuple[dict[str, NDArray[Any]], dict[str, Any]]:
    """Return the coarsest result that passes the gate, else the one nearest to the volume."""
    for result in found:
        if passes(result[1]["ratio"], config, closed, int(result[1]["step"])):
            return result
    return min(found, key=lambda result: abs(math.log(max(result[1]["ratio"], 1e-9))))


def _outward(mesh: Mesh, closed: bool) -> Int32:
    """Return the faces with their normals out of the solid; CoACD takes no others."""
    a, b, c = np.moveaxis(mesh.vertices[mesh.faces] - mesh.vertices.mean(axis=0), 1, 0)
    inward = closed and float(np.einsum("ij,ij->", a, np.cross(b, c))) < 0
    return mesh.faces[:, ::-1] if inward else mesh.faces


# --- the process ------------------------------------------------------------------------------


def _run(folder: Path, config: ConvexConfig) -> tuple[str, float]:
    """Run the worker on `job.npz`; return why it ended early ('' = it did not) and its time [s]."""
    start = time.process_time()
    if getattr(sys, "frozen", False):
        # A frozen program has no interpreter to start; the search is bounded, the time is not.
        try:
            decompose(folder / "job.npz", folder)
        except InputError as error:
            return str(error), time.process_time() - start
        return "", time.process_time() - start
    before = _children_s()
    environment = {**os.environ, **ONE_THREAD, "PYTHONPATH": os.pathsep.join(sys.path)}
    command = [sys.executable, "-m", "realsim.models.convex_worker"]
    with (folder / "said.txt").open("wb") as said:
        process = subprocess.Popen(
            [*command, str(folder / "job.npz"), str(folder)],
            stdin=subprocess.PIPE,
            stdout=said,
            stderr=said,
            env=environment,
        )
        try:
            code = _waited(process, config.time_limit_s * WALL_FACTOR)
        finally:
            # Whatever happens here (Ctrl-C, say), the process does not go on.
            process.kill()
            process.wait()
            if process.stdin is not None:
                process.stdin.close()
    text = (folder / "said.txt").read_text(errors="replace").strip()
    return _why(code, text, config), _children_s() - before


def _waited(process: "subprocess.Popen[bytes]", seconds: float) -> int | None:
    """Return the exit code, or None after so long by the clock."""
    end = time.monotonic() + seconds
    while process.poll() is None and time.monotonic() < end:
        time.sleep(POLL_S)
    return process.poll()


def _why(code: int | None, text: str, config: ConvexConfig) -> str:
    """Return why the process ended early, '' if it did not."""
    if code == 0:
        return ""
    ends = [getattr(signal, name, None) for name in ("SIGXCPU", "SIGKILL")]  # Windows has neither
    if code is None or -code in ends:
        return f"CoACD was stopped: its time of {config.time_limit_s:g} CPU-s was over."
    return f"CoACD failed (exit code {code}): {text[-300:] or 'it said nothing'}."


def _children_s() -> float:
    """Return the CPU time of the processes that this one started and that have ended [s]."""
    spent = os.times()
    return spent.children_user + spent.children_system


# --- on disk ----------------------------------------------------------------------------------


def _split(arrays: dict[str, NDArray[Any]]) -> tuple[Array, ...]:
    return tuple(np.split(arrays["vertices"], np.cumsum(arrays["counts"])[:-1]))


def _content(mesh: Mesh, config: ConvexConfig) -> str:
    """Return a key of everything the parts depend on."""
    digest = hashlib.sha256(mesh.vertices.tobytes() + mesh.faces.tobytes())
    digest.update(json.dumps(asdict(config), sort_keys=True).encode())
    digest.update(f"{RESULTS_VERSION} {version('coacd')}".encode())
    return digest.hexdigest()[:24]


def _kept(path: Path, result: ConvexParts) -> ConvexParts:
    """Return the parts after keeping them on disk."""
    write_arrays(
        path,
        {
            "vertices": np.concatenate(result.parts),
            "counts": np.array([len(p) for p in result.parts]),
        },
        {name: getattr(result, name) for name in ("volume_ratio", "method", "seconds", "notes")},
    )
    return result


def _read(path: Path) -> ConvexParts:
    """Return parts kept on disk."""
    arrays, notes = read_arrays(path)
    notes["notes"] = tuple(notes["notes"])
    return ConvexParts(parts=_split(arrays), **notes)
