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
"""

import hashlib
import re
from pathlib import Path
from typing import Any

from realsim.errors import InputError
from realsim.formats.bop.models import INFO_FILE, model_file
from realsim.models.library_records import PROPERTIES_FORMAT, ModelProperties
from realsim.store import atomic
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
