"""The first look at a file that somebody else made: is it one, and is it small enough to read."""

from pathlib import Path

from realsim.errors import InputError, UnreadableError


def require_permission(path: Path) -> None:
    """Raise where the permissions of a file, or of a folder above it, keep this user out.

    Raises:
        UnreadableError: they do.
    """
    try:
        if path.is_file():
            path.open("rb").close()
    except PermissionError as error:
        raise UnreadableError(
            f"you may not read {path}: its permissions forbid it (`chmod u+r` allows its owner)."
        ) from error


def file_bytes(path: Path, most_bytes: float) -> int:
    """Return the size of a file [bytes].

    Raises:
        InputError: there is no file (but nothing, or a folder), it has more than `most_bytes`, or
            this user may not read it.
    """
    try:
        is_file = path.is_file()
        size = path.stat().st_size if is_file else 0
    except (OSError, ValueError) as error:
        raise InputError(f"{str(path)!r:.300} cannot be opened ({error}).") from error
    if not is_file:
        found = "is a folder" if path.is_dir() else "does not exist"
        raise InputError(f"{path} {found}; a file is expected there.")
    if size > most_bytes:
        raise InputError(
            f"{path} has {size / 1e6:.1f} MB; at most {most_bytes / 1e6:g} MB are read. Is it the "
            "file that was meant? Split it if it is."
        )
    require_permission(path)
    return size


def checked_bytes(path: Path, most_bytes: float) -> bytes:
    """Return what a file holds.

    Raises:
        InputError: as `file_bytes`, or it cannot be read.
    """
    file_bytes(path, most_bytes)
    try:
        with path.open("rb") as file:
            data = file.read(int(most_bytes) + 1)
    except OSError as error:
        raise InputError(f"{path} cannot be read ({error.strerror or error}).") from error
    if len(data) > most_bytes:
        raise InputError(f"{path} grew while it was read; at most {most_bytes / 1e6:g} MB are.")
    return data


def checked_text(path: Path, most_bytes: float) -> str:
    """Return what a UTF-8 file holds, without the mark that some editors put in front.

    Raises:
        InputError: as `checked_bytes`, or it is not UTF-8.
    """
    data = checked_bytes(path, most_bytes)
    try:
        return data.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise InputError(
            f"{path} is not UTF-8 text (byte {error.start}: {data[error.start]:#04x}). Is it a "
            "binary file, or text in another encoding? Save it as UTF-8."
        ) from error
