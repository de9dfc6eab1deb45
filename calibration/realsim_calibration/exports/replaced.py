"""Files that a calibration writes anew, and what a person has edited in them: it is kept."""

import hashlib
import itertools
from collections.abc import Mapping
from pathlib import Path

from realsim.formats.export_folder import SUMS_FILE
from realsim.store import atomic


def replace_files(folder: Path, contents: Mapping[str, bytes]) -> list[Path]:
    """Write files and the list of their checksums.

    Args:
        folder: where to; made where needed.
        contents: path in it -> bytes.

    Returns:
        Where files are now that were not as the list says: NAME.kept beside the new one.
    """
    sums = folder / SUMS_FILE
    listed = sums.read_text(errors="replace").splitlines() if sums.is_file() else []
    written = {name: digest for digest, _, name in (line.partition("  ") for line in listed)}
    kept: list[Path] = []
    for name, data in contents.items():
        path = folder / name
        there = path.read_bytes() if name in written and path.is_file() else data
        if there != data and _digest(there) != written[name]:
            kept.append(_free_name(path))
            path.rename(kept[-1])
        atomic.write_bytes(path, data)
    lines = (f"{_digest(data)}  {name}\n" for name, data in contents.items())
    atomic.write_text(sums, "".join(lines))
    return kept


def _free_name(path: Path) -> Path:
    """Return NAME.kept, or NAME.kept2 and so on where that is there."""
    names = (path.with_name(f"{path.name}.kept{k if k > 1 else ''}") for k in itertools.count(1))
    return next(name for name in names if not name.exists())


def _digest(data: bytes) -> str:
    return hashlib.sha256(data).hexdigest()
