"""A data set in a zip or tar archive: unpacked for the time of its import."""

import contextlib
import shutil
import tempfile
from collections.abc import Generator
from pathlib import Path

from realsim.app.console import Console

ARCHIVES = (".zip", ".tar", ".tar.gz", ".tgz")


@contextlib.contextmanager
def unpacked(source: Path, out: Path, console: Console) -> Generator[Path]:
    """Yield what is imported; of an archive, what was in it for the time being."""
    from realsim.untrusted.archives import extract

    if not is_archive(source):
        yield source
        return
    out.parent.mkdir(parents=True, exist_ok=True)
    room = shutil.disk_usage(out.parent).free / 2
    # Beside the session: there is room for the images, a system's /tmp may be small.
    with tempfile.TemporaryDirectory(prefix=f".{out.name}.", dir=out.parent) as place:
        console.say(f"{source} is an archive: unpacking it beside {out}.")
        extract(source, Path(place) / "content", most_bytes=room)
        yield content_of(Path(place) / "content")


def is_archive(path: Path) -> bool:
    """Return whether a file is a zip or tar archive, by its name."""
    return path.is_file() and path.name.lower().endswith(ARCHIVES)


def content_of(folder: Path) -> Path:
    """Return what an archive holds: its only folder, or all of it."""
    inside = [p for p in folder.iterdir() if not p.name.startswith((".", "__MACOSX"))]
    return content_of(inside[0]) if len(inside) == 1 and inside[0].is_dir() else folder
