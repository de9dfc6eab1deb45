"""Models out of the library into a session, which stays complete in itself.

A session's models folder is a small library: mesh, texture, convex parts and properties are copied
byte for byte, so that their checksums still hold and the Robot School takes the convex parts and
the matter that the library knows instead of computing them again.
"""

from collections.abc import Collection
from pathlib import Path
from typing import Any

from realsim.errors import InputError
from realsim.formats.bop.models import INFO_FILE, model_file
from realsim.models import library_files as files
from realsim.models.library_files import commit, only_writer_of, read_info
from realsim.models.library_reading import LibraryReader
from realsim.models.model_records import KnownSolid
from realsim.store import atomic


def copy_models(library: LibraryReader, obj_ids: Collection[int], folder: Path) -> tuple[int, ...]:
    """Copy those models that the folder has not, all or none; return which.

    Models that are there already stay as they are: results were computed with them.

    Args:
        library: where they come from.
        obj_ids: which are needed.
        folder: the models folder of a session; made if it does not exist.

    Raises:
        InputError: the library has not all of them; the message names those that are missing.
    """
    there = read_info(folder) if (folder / INFO_FILE).is_file() else {}
    # The library's own mesh without a row in the table is of a copy that was ended.
    wanted = sorted(
        i for i in set(obj_ids)
        if not (folder / model_file(i)).is_file()
        or (i not in there and _is_same(folder / model_file(i), library.folder / model_file(i)))
    )  # fmt: skip
    info = read_info(library.folder)
    missing = [i for i in wanted if i not in info or not (library.folder / model_file(i)).is_file()]
    if missing:
        listed = ", ".join(f"{e.name} ({e.obj_id})" for e in library.entries() if e.obj_id)
        raise InputError(
            f"object {', '.join(map(str, missing))} is not in the library {library.folder}; there "
            f"are: {listed or 'none'}. Import it with `realsim scan import MESH --id {missing[0]} "
            f"--library {library.folder}`, or name another object in registration/starts.json."
        )
    if not wanted:
        return ()
    new: dict[str, bytes] = {}
    for i in wanted:
        for name in (
            files.collision_file(i), files.properties_file(i), files.texture_file(i), model_file(i)
        ):  # fmt: skip
            if (library.folder / name).is_file():
                new[name] = (library.folder / name).read_bytes()
    entries: dict[str, Any] = {str(i): info.get(i) or there[i] for i in sorted({*there, *wanted})}
    entries |= {str(i): entry for i, entry in there.items()}
    folder.mkdir(parents=True, exist_ok=True)
    with only_writer_of(folder):
        commit(folder, {**new, INFO_FILE: atomic.json_bytes(entries)})
    return tuple(wanted)


def _is_same(path: Path, other: Path) -> bool:
    return other.is_file() and path.read_bytes() == other.read_bytes()


def known_solids(
    folder: Path, obj_ids: Collection[int]
) -> tuple[dict[int, KnownSolid], dict[int, str]]:
    """Return what is known of models in a session, and why of others nothing is.

    Parts and matter count only while the mesh is the one they were computed of. Of models without
    properties (a BOP dataset, the simulated lab) nothing is known, and nothing is said.
    """
    library, solids, reasons = LibraryReader(folder), dict[int, KnownSolid](), dict[int, str]()
    for obj_id in sorted(set(obj_ids)):
        if not (folder / files.properties_file(obj_id)).is_file():
            continue
        solid, why = library.solid(obj_id)
        if solid is None:
            reasons[obj_id] = why
        else:
            solids[obj_id] = solid
    return solids, reasons
