"""What stands around the objects, kept in the session, so that labels can be made again exactly."""

import io
import zipfile
import zlib

import numpy as np
from numpy.typing import NDArray

from realsim.errors import InputError
from realsim.records import Mesh
from realsim.rendering.rays import BACKGROUND, PlacedMesh
from realsim.store import SessionStore

SURROUNDINGS_FILE = "synthetic/surroundings.npz"


def save_surroundings(store: SessionStore, placed: tuple[PlacedMesh, ...]) -> None:
    """Write the shapes and places of what hides things without carrying a label."""
    arrays: dict[str, NDArray[np.generic]] = {"count": np.array(len(placed))}
    for k, p in enumerate(placed):
        arrays[f"vertices_{k}"] = p.mesh.vertices
        arrays[f"faces_{k}"] = p.mesh.faces
        arrays[f"T_world_obj_{k}"] = p.T_world_obj
    store.write_npz(SURROUNDINGS_FILE, **arrays)


def load_surroundings(store: SessionStore) -> tuple[PlacedMesh, ...] | None:
    """Return what hides things in a synthetic session; None = the session is not synthetic.

    Raises:
        InputError: the file is broken.
    """
    if not store.has(SURROUNDINGS_FILE):
        return None
    try:
        data = io.BytesIO(store.path(SURROUNDINGS_FILE).read_bytes())
        with np.load(data, allow_pickle=False) as npz:
            return tuple(
                PlacedMesh(
                    BACKGROUND,
                    Mesh(vertices=npz[f"vertices_{k}"], faces=npz[f"faces_{k}"]),
                    npz[f"T_world_obj_{k}"],
                )
                for k in range(int(npz["count"]))
            )
    except (OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile, zlib.error) as error:
        raise InputError(
            f"{SURROUNDINGS_FILE} of '{store.folder}' is broken ({error}). Run the command that "
            "rendered the session again: it writes this file anew."
        ) from error
