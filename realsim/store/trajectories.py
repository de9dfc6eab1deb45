"""What the arm did in the attempts at a grasp set: one npz file in trajectories/ beside the set.

The file names the very grasps it belongs to, so that attempts of an earlier run are never taken for
those of a later one.
"""

import hashlib
from pathlib import Path
from typing import Any

import numpy as np

from realsim.errors import InputError
from realsim.records import GraspSet
from realsim.records.grasps import PHASES, GraspTrajectories
from realsim.store import atomic
from realsim.store.results import grasp_folder, grasp_stem, write_beside_grasps
from realsim.store.session_store import SessionStore
from realsim.untrusted.arrays import read_npz

TRAJECTORY_FOLDER = "trajectories"
ARRAYS = ("rows", "starts", "time_s", "joints_rad", "opening_m", "phase")
FORMAT_VERSION = 1


def save_trajectories(
    store_or_folder: SessionStore | Path | str, grasps: GraspSet, attempts: GraspTrajectories
) -> Path:
    """Write the attempts at a grasp set, and return the npz file's path.

    Args:
        store_or_folder: a session, whose folder grasps/ is used, or the folder of the grasp sets.
        grasps: the set that was attempted.
        attempts: what the arm did.

    Raises:
        InputError: the attempts belong to rows that the set does not have.
    """
    if len(attempts) and not 0 <= attempts.rows.min() <= attempts.rows.max() < len(grasps):
        raise InputError(
            f"the trajectories belong to rows {attempts.rows.min()} to {attempts.rows.max()} of a "
            f"set of {len(grasps)} grasps; give the set that they were planned for."
        )
    arrays: dict[str, Any] = {name: getattr(attempts, name) for name in ARRAYS}
    data = atomic.npz_bytes(
        format_version=np.array(FORMAT_VERSION),
        grasps=np.array(_identity(grasps)),
        phases=np.array(PHASES),
        **arrays,
    )
    return write_beside_grasps(store_or_folder, _file_of(grasps), data)


def load_trajectories(
    store_or_folder: SessionStore | Path | str, grasps: GraspSet
) -> GraspTrajectories | None:
    """Return the attempts at a grasp set, None where none were kept.

    Raises:
        InputError: the file is broken, of a newer format, or belongs to other grasps.
    """
    path = grasp_folder(store_or_folder) / _file_of(grasps)
    if not path.is_file():
        return None
    try:
        npz = read_npz(path, ("format_version", "grasps", "phases", *ARRAYS), texts=True)
        version, identity = int(npz["format_version"]), str(npz["grasps"])
        arrays = {name: npz[name] for name in ARRAYS}
        phases = tuple(str(p) for p in npz["phases"].tolist())
    except (InputError, TypeError, ValueError) as error:
        raise InputError(
            f"{path} is not a complete file of trajectories ({error}). Delete it, and run the "
            "school again for this object."
        ) from error
    if version != FORMAT_VERSION or phases != PHASES:
        raise InputError(
            f"{path} has the format version {version} with the phases {', '.join(phases)}; this "
            f"realsim reads {FORMAT_VERSION} with {', '.join(PHASES)}."
        )
    if identity != _identity(grasps):
        raise InputError(
            f"{path} belongs to other grasps than those of instance {grasps.instance}: one of the "
            "two was written by another run. Delete it, or run the school again for this object."
        )
    try:
        return GraspTrajectories(**arrays)
    except InputError as error:
        raise InputError(
            f"{path}: {error} Delete it, and run the school again for this object."
        ) from error


def _file_of(grasps: GraspSet) -> str:
    return f"{TRAJECTORY_FOLDER}/{grasp_stem(grasps)}.npz"


def _identity(grasps: GraspSet) -> str:
    """Return a digest of which grasps these are: object, instance and poses."""
    digest = hashlib.sha256(f"{grasps.obj_id} {grasps.instance} {len(grasps)}".encode())
    digest.update(np.ascontiguousarray(grasps.Ts_obj_grasp).tobytes())
    return digest.hexdigest()
