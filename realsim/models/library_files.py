"""Where everything of a model library lies, and how one file of it is read.

    LIBRARY/                     is a BOP models folder: any BOP reader and every stage reads it
      models_info.json           diameters, boxes [mm], symmetries; realsim adds name and density
      obj_000001.ply  .png       mesh [mm] and its texture
      collision/obj_000001.obj   one `o` per convex part [m]
      properties/obj_000001.json everything else that is known, with checksums of the files above
      pictures/NAME.png          a sheet to look at
      unscaled/NAME/             mesh.ply (.png) without metric scale, in its own units; report.json
                                 and picture.png

models_info.json is written last: a model counts when it is listed there.

Several files of a folder that change together: a kill leaves all of them old, or all new.

New files are first written whole to a folder of their own, `.adding`, then listed in a note there.
From the note on the change counts: it is finished by moving the files into place, in the order of
the note, and whoever opens the folder after a kill does just that. Without the note nothing has
happened, and `.adding` is thrown away by the next writer.
"""

import hashlib
import os
import re
import shutil
import time
from collections.abc import Generator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from realsim.errors import InputError
from realsim.formats.bop.models import INFO_FILE, model_file
from realsim.models.model_records import PROPERTIES_FORMAT, ModelProperties
from realsim.store import atomic
from realsim.store.atomic import only_run_in, storing, sync_folder
from realsim.untrusted.own_json import from_json, read_object, to_json

NAME = re.compile(r"(?!\d+$)[A-Za-z0-9_][A-Za-z0-9_.+-]{0,79}")
"""Names become file names, and a number alone would be taken for an id."""
UNSCALED = "unscaled"
UNSCALED_MESH = "mesh.ply"
UNSCALED_TEXTURE = "mesh.png"
UNSCALED_PICTURE = "picture.png"
UNSCALED_REPORT = "report.json"


def collision_file(obj_id: int) -> str:
    """Return the path of a model's convex parts in the library."""
    return f"collision/obj_{obj_id:06d}.obj"


def properties_file(obj_id: int) -> str:
    """Return the path of a model's properties in the library."""
    return f"properties/obj_{obj_id:06d}.json"


def picture_file(name: str) -> str:
    """Return the path of a model's picture in the library."""
    return f"pictures/{name}.png"


def texture_file(obj_id: int) -> str:
    """Return the path of a model's texture in the library."""
    return str(Path(model_file(obj_id)).with_suffix(".png"))


def require_name(name: str) -> str:
    """Return the name if it can be one.

    Raises:
        InputError: it cannot.
    """
    if NAME.fullmatch(name) is None or name.endswith("."):
        raise InputError(
            f"'{name}' cannot be the name of a model: letters, digits, '_', '-', '+' and '.' are "
            "accepted, up to 80 of them, not digits alone (those are ids). Say another with --name."
        )
    return name


def sha256(data: bytes) -> str:
    """Return the checksum of a file's content."""
    return hashlib.sha256(data).hexdigest()


def properties_bytes(properties: ModelProperties) -> bytes:
    """Return the content of a properties file."""
    return atomic.json_bytes({"format": PROPERTIES_FORMAT, **to_json(properties)})


def read_properties(path: Path) -> ModelProperties:
    """Return what a properties file says.

    Raises:
        InputError: it is missing, damaged, or of a newer realsim.
    """
    values = read_object(path)
    found = values.pop("format", None)
    if found != PROPERTIES_FORMAT:
        raise InputError(
            f"{path} has the format {found}; {PROPERTIES_FORMAT} is known. Was it written by a "
            "newer realsim? Otherwise restore it, or import the model again with --overwrite."
        )
    try:
        return from_json(values, ModelProperties, str(path))
    except InputError as error:
        remedy = "Restore the file, or import the model again with --overwrite."
        raise InputError(f"{error} {remedy}") from error


def read_info(folder: Path) -> dict[int, dict[str, Any]]:
    """Return models_info.json of a library by object id.

    Raises:
        InputError: it is missing or damaged.
    """
    path, entries = folder / INFO_FILE, dict[int, dict[str, Any]]()
    for key, entry in read_object(path).items():
        if not (key.isdecimal() and int(key) > 0 and isinstance(entry, dict)):
            raise InputError(
                f"{path} has an entry '{key}' that is no object; ids from 1 with an object each "
                "are expected. Restore the file."
            )
        entries[int(key)] = entry
    return entries


ADDING = ".adding"
NOTE = "commit.json"
WAIT_S = 30.0
"""How long a writer waits for another [s]: a model is written in far less than a second, the work
before it is done outside the lock."""
PAUSE_S = 0.05


@contextmanager
def only_writer_of(folder: Path) -> Generator[None]:
    """Keep other writers out of a folder; wait for one that is there.

    Raises:
        InputError: another is writing there all the time.
    """
    deadline = time.monotonic() + WAIT_S
    while True:
        lock = only_run_in(folder)
        try:
            lock.__enter__()
            break
        except InputError:
            if time.monotonic() > deadline:
                raise
            time.sleep(PAUSE_S)
    try:
        yield
    finally:
        lock.__exit__(None, None, None)


def is_unfinished(folder: Path) -> bool:
    """Whether a kill came between the note of a change and its end."""
    return (folder / ADDING / NOTE).is_file()


def finish_interrupted(folder: Path) -> bool:
    """Finish a change that a kill interrupted; return whether there was one.

    Nothing is changed where a writer is at work: it finishes by itself, and is waited for.
    """
    if not is_unfinished(folder):
        return False
    with only_writer_of(folder):
        if not is_unfinished(folder):
            return False
        with storing(folder, "what an interrupted run left undone"):
            _move_into_place(folder)
    return True


def commit(folder: Path, files: Mapping[str, bytes], gone: Sequence[str] = ()) -> None:
    """Write files in this order and delete others, all or nothing; the caller is the only writer.

    Args:
        folder: where they are.
        files: path in the folder -> content.
        gone: paths that are deleted, before the files are put in place.

    Raises:
        StorageError: the disk is full or refuses; everything is as it was.
    """
    staging = folder / ADDING
    with storing(folder, f"{len(files)} files"):
        if is_unfinished(folder):
            _move_into_place(folder)
        shutil.rmtree(staging, ignore_errors=True)
        try:
            for name, data in files.items():
                atomic.write_bytes(staging / name, data)
            atomic.write_json(staging / NOTE, {"files": list(files), "gone": list(gone)})
        except OSError:
            shutil.rmtree(staging, ignore_errors=True)
            raise
        _move_into_place(folder)


def _move_into_place(folder: Path) -> None:
    """Do what the note says; a part that was done before the kill is not done again."""
    staging = folder / ADDING
    note = read_object(staging / NOTE)
    for name in note["gone"]:
        (folder / name).unlink(missing_ok=True)
    for name in note["files"]:
        place = folder / name
        place.parent.mkdir(parents=True, exist_ok=True)
        if (staging / name).is_file():
            os.replace(staging / name, place)
            sync_folder(place.parent)
    (staging / NOTE).unlink()
    sync_folder(staging)
    shutil.rmtree(staging, ignore_errors=True)
