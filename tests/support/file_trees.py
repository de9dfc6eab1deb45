"""What a folder holds, to be compared."""

from pathlib import Path


def bytes_of(folder: Path, *patterns: str) -> dict[str, bytes]:
    """Return the content of every file, or of those of some patterns, by its path in the folder."""
    return {
        p.relative_to(folder).as_posix(): p.read_bytes()
        for pattern in patterns or ("**/*",)
        for p in sorted(folder.glob(pattern)) if p.is_file()
    }  # fmt: skip


def annotation_of(folder: Path) -> dict[str, bytes]:
    """Return what the annotation of a session writes."""
    maps, rows = ("mask*/*", "labels/*/*"), ("annotations/*", "annotations/*/*", "scene_gt*")
    return bytes_of(folder, *maps, *rows, "grasps/views/*")
