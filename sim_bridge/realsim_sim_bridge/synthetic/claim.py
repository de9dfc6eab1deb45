"""Who a folder of synthetic views belongs to: one scene, one camera, one seed, no mixing."""

import hashlib
import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np

from realsim.arrays import Array
from realsim.errors import InputError
from realsim.formats.bop.models import INFO_FILE, load_models, model_file, save_models
from realsim.models.library_reading import LibraryReader
from realsim.models.library_session import copy_models
from realsim.records import CameraIntrinsics, CaptureSession, ObjectModel
from realsim.store import SessionStore
from realsim.store.opening import finish_beginning
from realsim_sim_bridge.synthetic.config import SyntheticConfig
from realsim_sim_bridge.synthetic.scene import SyntheticScene

NOTE = "synthetic"
"""Key of a synthetic session's `extra`: what its views are made of."""
RESULTS_VERSION = 3
"""Raised whenever the same inputs give other pictures."""
SAME_M = 1e-6
"""Vertices of a model in the folder and of the one given differ by rounding only [m]."""


def inputs_of(
    synthetic: SyntheticScene, intrinsics: CameraIntrinsics, config: SyntheticConfig, seed: int
) -> dict[str, Any]:
    """Return what tells a folder's views apart from those of other inputs, part by part."""
    i = intrinsics
    lens = np.array([i.width, i.height, i.fx, i.fy, i.cx, i.cy, *i.distortion])
    asked = {k: v for k, v in asdict(config).items() if k != "maps"}
    settings = {k: json.dumps(v) for k, v in asked.items()}
    return {
        **synthetic.digests(),
        "camera": hashlib.sha256(lens.tobytes()).hexdigest(),
        **settings,
        "seed": int(seed),
        "version": RESULTS_VERSION,
    }


def require_claimable(folder: Path) -> None:
    """Raise where views cannot be written.

    Raises:
        InputError: there is a file, or a folder that holds something else than a session.
    """
    if folder.exists() and not folder.is_dir():
        raise InputError(f"'{folder}' is a file; a folder that may be made or filled is expected.")
    finish_beginning(folder)
    if folder.is_dir() and any(folder.iterdir()) and not (folder / "session.json").is_file():
        raise InputError(
            f"'{folder}' is not empty and holds no session. Choose another folder: nothing of "
            "yours is overwritten."
        )


def claimed_session(
    folder: Path,
    synthetic: SyntheticScene,
    intrinsics: CameraIntrinsics,
    config: SyntheticConfig,
    seed: int,
    Ts_world_cam: Sequence[Array],
) -> SessionStore:
    """Open the session that an earlier run of the same inputs began, or begin it.

    Raises:
        InputError: the folder holds views of another scene, camera, setting or seed, a session
            that is not synthetic, or something else.
    """
    inputs = inputs_of(synthetic, intrinsics, config, seed)
    require_claimable(folder)
    if (folder / "session.json").is_file():
        store = SessionStore.open(folder)
        _require_same(store, inputs)
        _require_same_cameras(store, Ts_world_cam)
        return store
    session = CaptureSession(name=synthetic.name, intrinsics=intrinsics, depth_unit_m=config.unit_m)
    note = {"inputs": inputs, "provenance": synthetic.provenance, "config": asdict(config)}
    about = {"camera": f"simulated {config.profile}", "gravity_up_world": _up(synthetic)}
    return SessionStore.create(folder, session, {**about, NOTE: note})


def _up(synthetic: SyntheticScene) -> list[float]:
    """Return the direction up in the world: away from the table."""
    plane = synthetic.scene.plane
    up: list[float] = [0.0, 0.0, 1.0] if plane is None else plane.T_world_table[:3, 2].tolist()
    return up


def _require_same(store: SessionStore, inputs: Mapping[str, Any]) -> None:
    """Raise if the folder's views were made of other inputs; say which."""
    note: Any = store.extra.get(NOTE)
    found: Any = note.get("inputs") if isinstance(note, dict) else None
    if not isinstance(found, dict):
        raise InputError(
            f"'{store.folder}' holds a session that is not synthetic. Choose another folder: "
            "nothing of yours is overwritten."
        )
    told = [
        _difference(name, found.get(name), inputs.get(name))
        for name in inputs
        if found.get(name) != inputs.get(name)
    ]
    if told:
        raise InputError(
            f"'{store.folder}' holds synthetic views of other inputs; what differs: "
            f"{'; '.join(told)}. Choose another folder, or delete this one to begin anew; the same "
            "inputs would go on where they stopped."
        )


def _difference(name: str, found: Any, wanted: Any) -> str:
    """Return in words how one input differs; digests say nothing to people."""
    readable = name in ("seed", "version") or not (isinstance(wanted, str) and len(wanted) == 64)
    return f"{name} ({found} there, {wanted} wanted)" if readable else name


def _require_same_cameras(store: SessionStore, Ts_world_cam: Sequence[Array]) -> None:
    """Raise if a view that is there stands elsewhere, or is none of those wanted."""
    for view in store.session.views:
        wanted = Ts_world_cam[view.index] if view.index < len(Ts_world_cam) else None
        if wanted is None:
            raise InputError(
                f"'{store.folder}' has view {view.index} already, but only {len(Ts_world_cam)} "
                "views are wanted. Ask for as many as are there or more, or choose another folder."
            )
        if not np.allclose(np.asarray(view.T_world_cam), wanted, rtol=0, atol=1e-9):
            raise InputError(
                f"'{store.folder}' holds synthetic views of other inputs; what differs: the camera "
                f"pose of view {view.index}. Choose another folder, or delete this one."
            )


def with_stored_models(
    synthetic: SyntheticScene, folder: Path, models_from: Path | None
) -> SyntheticScene:
    """Put the scene's models into the folder and return the scene with them as they are stored.

    A stored mesh is rounded (BOP keeps millimetres in float32). What is rendered must be what later
    commands read, or masks made again would differ in single pixels.

    Args:
        synthetic: the scene.
        folder: the models folder of the session.
        models_from: a models folder whose files are taken as they are, with the convex parts and
            the matter that are known there; None = written from the records.

    Raises:
        InputError: the folder has another mesh under the same number.
    """
    wanted = {o.obj_id: synthetic.models[o.obj_id] for o in synthetic.shown}
    if models_from is not None:
        copy_models(LibraryReader(models_from), list(wanted), folder)
    elif not all((folder / f).is_file() for f in (INFO_FILE, *map(model_file, wanted))):
        save_models(folder, wanted)
    stored = load_models(folder, list(wanted))
    for obj_id, model in stored.items():
        _require_same_mesh(model, wanted[obj_id], folder)
    return replace(synthetic, models=stored)


def _require_same_mesh(stored: ObjectModel, given: ObjectModel, folder: Path) -> None:
    """Raise if two meshes differ by more than rounding."""
    a, b = stored.mesh.vertices, given.mesh.vertices
    if a.shape != b.shape or not np.allclose(a, b, rtol=1e-6, atol=SAME_M):
        raise InputError(
            f"{folder / model_file(given.obj_id)} is another mesh than that of '{given.name}', "
            "which is to be rendered. Choose another folder, or delete this one to begin anew."
        )
