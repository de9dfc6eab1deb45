"""What a result was made of: one record that every stage leaves beside its result.

    SESSION/stages/STAGE.json        what decides the result: made of the same, it is the same
    SESSION/stages/STAGE.run.json    the run: command line, times, machine, where given paths led
    OUT/provenance.json, OUT/provenance.run.json    the same of a folder that is no session

The first file holds nothing that differs from run to run, so that results compare equal byte by
byte, and no path beyond its last name, so that it can be published. The second can be left away.
"""

import dataclasses
import hashlib
import json
import platform
import socket
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from realsim.store import atomic
from realsim.store.header import versions_of
from realsim.store.manifest import Manifest
from realsim.store.session_store import SessionStore
from realsim.untrusted.own_json import noted, read_own, to_json

LIBRARIES = (
    "realsim", "numpy", "scipy", "numba", "opencv-python-headless", "open3d-cpu", "trimesh",
    "gtsam", "kiss-icp", "pycolmap", "coacd", "eaik", "coal", "pin", "ompl", "toppra", "pybullet",
    "mujoco", "mitsuba", "h5py", "pyarrow",
)  # fmt: skip
"""What results are computed and written with."""
ABSENT = "(nothing)"
"""The hash of an input that is not there, and the value of a field that one of two has not."""
GIVEN = "request."
"""Begins the names of inputs that a request gives by a path."""
UNSAID = ("workers", "address", "where", "restart")
"""Fields of requests that change no result."""
FOLDER_FILE = "provenance.json"
BESIDE = (
    "reports/", "review/thumbnails/", "registration/cache/", "registration/pictures/",
    "grasps/cache/", "stages/",
)  # fmt: skip
"""What a session has for people to look at, to be quicker, or to say how it was made."""
MADE_AGAIN = ("manifest.jsonl", ".run.json", ".part")
"""Ends of files that say how a folder was made, and nothing of what is in it."""


@dataclass(frozen=True, kw_only=True, slots=True)
class Provenance:
    """What decides a result."""

    stage: str
    request: dict[str, Any]
    """What was asked for; of paths the last name."""
    config: dict[str, Any] = field(default_factory=dict[str, Any])
    """Every setting in force."""
    inputs: dict[str, str] = field(default_factory=dict[str, str])
    """Path in the session, or `request.NAME` -> sha256; "(nothing)" = it was not there."""
    versions: dict[str, str] = field(default_factory=dict[str, str])
    key: str = ""
    """Hash by which the stage knows that nothing has changed; empty = it always runs."""


@dataclass(frozen=True, kw_only=True, slots=True)
class Run:
    """What differs from run to run."""

    command: tuple[str, ...] = ()
    """The command line after `realsim`; empty = called from Python."""
    ended: str = ""
    """ISO 8601, UTC."""
    machine: str = ""
    places: dict[str, str] = field(default_factory=dict[str, str])
    """Field of the request -> the path that was given."""
    times: list[dict[str, Any]] = field(default_factory=list[dict[str, Any]])
    """CPU and clock seconds of the parts of the run."""


def versions(names: Iterable[str] = LIBRARIES) -> dict[str, str]:
    """Return the versions of distributions, of Python, and the platform; for every result alike."""
    machine = f"{platform.system()} {platform.machine()}"
    return versions_of(names) | {"python": platform.python_version(), "platform": machine}


def plain_request(request: Any) -> tuple[dict[str, Any], dict[str, str]]:
    """Return a request as plain JSON values, and the paths in it by their fields.

    Args:
        request: a dataclass or a dictionary; what changes no result is left out.
    """
    places: dict[str, str] = {}

    def plain(value: Any, name: str) -> Any:
        if isinstance(value, Path):
            places[name] = str(value.absolute())
            return value.name
        if isinstance(value, list | tuple):
            parts: Sequence[Any] = value
            return [plain(part, f"{name}.{k}") for k, part in enumerate(parts)]
        return to_json(value)

    fields: Mapping[str, Any]
    if isinstance(request, Mapping):
        fields = {str(k): v for k, v in request.items()}  # pyright: ignore[reportUnknownVariableType, reportUnknownArgumentType]
    else:
        fields = {f.name: getattr(request, f.name) for f in dataclasses.fields(request)}
    said = {name: plain(v, name) for name, v in fields.items() if name not in UNSAID}
    return said, places


# --- hashes of inputs -------------------------------------------------------------------------


def sha256_of(path: Path) -> str:
    """Return the sha256 of a file, or of the names and hashes of all files of a folder."""
    if path.is_dir():
        digest = hashlib.sha256()
        for file in sorted(p for p in path.rglob("*") if p.is_file()):
            name = file.relative_to(path).as_posix()
            beside = any(f"/{part}" in f"/{name}" for part in BESIDE)
            if not beside and not name.endswith(MADE_AGAIN):
                digest.update(f"{sha256_of(file)}  {name}\n".encode())
        return digest.hexdigest()
    if not path.is_file():
        return ABSENT
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def inputs_of(
    store: SessionStore, patterns: Iterable[str], places: Mapping[str, str] | None = None
) -> dict[str, str]:
    """Return the hashes of a session's files, and of what a request gives by a path.

    Photographs and depth images have theirs from the session's list, which is held against them
    whenever a stage begins.

    Args:
        store: the session.
        patterns: files, `models/*` and the like; a name without a star may be of no file.
        places: field of the request -> path.
    """
    listed = Manifest(store.folder).entries
    found: dict[str, str] = {}
    for pattern in patterns:
        if "*" not in pattern:
            found[pattern] = sha256_of(store.folder / pattern)
            continue
        for path in sorted(p for p in store.folder.glob(pattern) if p.is_file()):
            name = path.relative_to(store.folder).as_posix()
            known = listed.get(name) if name.startswith(("rgb/", "depth/")) else None
            found[name] = sha256_of(path) if known is None else known.sha256
    return found | {GIVEN + name: sha256_of(Path(p)) for name, p in (places or {}).items()}


def changed_inputs(folder: Path, record: Provenance, run: Run) -> list[str]:
    """Return the inputs that do not have the recorded hash any more, each with what it is now."""
    changed: list[str] = []
    for name, was in record.inputs.items():
        if name.startswith(GIVEN):
            place = run.places.get(name.removeprefix(GIVEN))
            now, said = ABSENT if place is None else sha256_of(Path(place)), f"{name} ({place})"
        else:
            now, said = sha256_of(folder / name), name
        if now != was:
            changed.append(f"{said}: {was[:12]} -> {now[:12]}")
    return changed


# --- on disk ----------------------------------------------------------------------------------


def file_of(stage: str) -> str:
    """Return where in a session the record of a stage lies."""
    return f"stages/{stage}.json"


def write(place: SessionStore | Path, record: Provenance, run: Run) -> None:
    """Write the record of a result, that of its run first: where the record is, both are.

    Args:
        place: the session, or the folder of a result that is no session.
        record: what decided the result.
        run: what differs from run to run.
    """
    run = dataclasses.replace(
        run, ended=datetime.now(UTC).isoformat(timespec="seconds"), machine=socket.gethostname()
    )
    if isinstance(place, SessionStore):
        name = file_of(record.stage)
        place.write_json(name.replace(".json", ".run.json"), to_json(run))
        place.write_json(name, to_json(record))
    else:
        atomic.write_json(place / FOLDER_FILE.replace(".json", ".run.json"), to_json(run))
        atomic.write_bytes(place / FOLDER_FILE, record_bytes(record))


def record_bytes(record: Provenance) -> bytes:
    """Return the file of a record."""
    return atomic.json_bytes(to_json(record))


def read(folder: Path, stage: str = "") -> tuple[Provenance, Run]:
    """Return the record of a stage of a session, or of a folder that is no session.

    Raises:
        InputError: there is none, or it is damaged.
    """
    path = folder / (file_of(stage) if stage else FOLDER_FILE)
    record = read_own(path, Provenance)
    beside = path.with_name(path.stem + ".run.json")
    return record, read_own(beside, Run) if beside.is_file() else Run()


def is_current(store: SessionStore, stage: str, key: str) -> bool:
    """Return whether this stage has already been done with these inputs."""
    return noted(store.folder / file_of(stage)).get("key") == key


# --- what differs -----------------------------------------------------------------------------


def differences(old: Any, new: Any, name: str = "") -> Iterator[tuple[str, Any, Any]]:
    """Yield (field, old value, new value) of all that differs between two JSON values."""
    was, now = _children(old), _children(new)
    if was is None or now is None:
        if old != new:
            yield name, old, new
        return
    for key in [*was, *(k for k in now if k not in was)]:
        inner = f"{name}.{key}" if name else key
        if key not in was:
            yield inner, ABSENT, now[key]
        elif key not in now:
            yield inner, was[key], ABSENT
        else:
            yield from differences(was[key], now[key], inner)


def _children(value: Any) -> dict[str, Any] | None:
    """Return what a JSON value is made of by name, or None if it is one value."""
    if isinstance(value, dict):
        return {str(key): child for key, child in value.items()}  # pyright: ignore[reportUnknownArgumentType, reportUnknownVariableType]
    if isinstance(value, list):
        return {str(key): child for key, child in enumerate(value)}  # pyright: ignore[reportUnknownArgumentType, reportUnknownVariableType]
    return None


def in_short(value: Any) -> str:
    """Return a JSON value in at most a line."""
    text = ABSENT if value == ABSENT else json.dumps(value)
    return text if len(text) <= 60 else text[:57] + "..."
