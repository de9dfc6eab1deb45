"""What a folder holds, to be compared."""

from pathlib import Path


def bytes_of(folder: Path) -> dict[str, bytes]:
    """Return the content of every file by its path in the folder."""
    return {
        p.relative_to(folder).as_posix(): p.read_bytes()
        for p in sorted(folder.rglob("*")) if p.is_file()
    }  # fmt: skip
