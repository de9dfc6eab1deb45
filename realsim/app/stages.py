"""What every command knows of a session: opening it, what is current in it, its models and scene.

A stage takes its input from the session's folder and leaves its result there, so that the stages
can be run one by one, by the demo, or again after an interruption. Commands import this file; it
imports none of them.
"""

import hashlib
import json
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, fields, replace
from pathlib import Path
from typing import Any

import click
import numpy as np

from realsim.app.command import COMMAND_KEY
from realsim.app.console import Console
from realsim.errors import InputError
from realsim.records import HandEye, ObjectModel, ObjectPose, Scene
from realsim.store import SessionStore, provenance
from realsim.store.cameras import session_of_camera
from realsim.store.opening import require_header
from realsim.untrusted.own_json import to_json

BOARD_VIEWS = "calibration/capture"
"""Where in a session the views of the tag board lie: a session of their own."""


def arm_sigma_mm(hand_eye: HandEye) -> float | None:
    """Return the error of the arm's positions along each axis [mm]; None = it was not found.

    The check's figure is the length of the error.
    """
    robot = next((k for k in hand_eye.checks if k.name == "robot poses" and k.unit == "mm"), None)
    if robot is None or not np.isfinite(robot.value):
        return None
    return float(robot.value / np.sqrt(3))


def hint_of(folder: Path) -> str:
    """Return which sessions lie in a folder that is none, as the end of a message."""
    inner = sorted(p.parent for p in folder.glob("*/session.json"))
    return f" Did you mean {', '.join(map(str, inner))}?" if inner else ""


def open_session(folder: Path) -> SessionStore:
    """Open a session, or say what is missing.

    Raises:
        InputError: the folder is not a session.
    """
    if not folder.is_dir():
        raise InputError(
            f"'{folder}' is not a folder; a session folder (one that holds session.json) is "
            "expected. `realsim demo` makes one in demo/session."
        )
    require_header(folder)
    if (session := session_of_camera(folder)) is not None:
        raise InputError(
            f"'{folder}' is a further camera of the session '{session}', not a session of its own: "
            f"give '{session}', which takes all of its cameras along."
        )
    if not (folder / "session.json").is_file():
        raise InputError(
            f"'{folder}' holds no session.json, so it is not a session.{hint_of(folder)} Give a "
            "folder that `realsim demo`, `capture`, `import`, `generate` or `upgrade` has filled."
        )
    return SessionStore.open(folder)


def require_sound(store: SessionStore) -> list[str]:
    """Raise if what was captured is not what is on disk: a run refused is better than a view lost.

    Returns:
        Paths of files that are missing or changed and can be made again from what was captured.

    Raises:
        InputError: a photograph, a depth image or the list of views is missing or changed.
    """
    captured = ("rgb/", "depth/", "robot.jsonl")
    found = store.verify()
    faults = [f for f in found if f.path.startswith(captured)]
    if faults:
        named = "; ".join(f"{f.path} is {f.kind} ({f.found})" for f in faults[:3])
        more = f" and {len(faults) - 3} more" if len(faults) > 3 else ""
        raise InputError(
            f"session '{store.folder}' is not as it was captured: {named}{more}. Restore the files "
            "from a copy, or capture the views again; nothing was computed from what is left. "
            f"`realsim check {store.folder} --repair` takes damaged views out and keeps the rest."
        )
    return [f.path for f in found]


def changed_fields(request: Any, plain: Any) -> dict[str, Any]:
    """Return what a request says otherwise than one in which nothing is said, by its fields."""
    said = {f.name: getattr(request, f.name) for f in fields(request)}
    return {name: value for name, value in said.items() if value != getattr(plain, name)}


def content_key(*parts: Any) -> str:
    """Return a hash of files (paths) and plain values: what a stage's result depends on."""
    digest = hashlib.sha256()
    for part in parts:
        if isinstance(part, Path):
            digest.update(part.name.encode() + (part.read_bytes() if part.is_file() else b"-"))
        else:
            digest.update(json.dumps(part, sort_keys=True, default=str).encode())
    return digest.hexdigest()


def note(
    place: SessionStore | Path,
    stage: str,
    console: Console,
    *,
    request: Any,
    config: Any = None,
    inputs: Iterable[str] | Mapping[str, str] = (),
    key: str = "",
    more_times: Sequence[Mapping[str, Any]] = (),
) -> None:
    """Leave the record of what a stage's result was made of; see `realsim.store.provenance`.

    Args:
        place: the session, or the folder of a result that is no session.
        stage: the stage's name.
        console: knows what the parts of the run cost.
        request: what was asked for, a dataclass or a dictionary.
        config: every setting in force, likewise.
        inputs: the session's files that were read, as patterns; or hashes by name.
        key: hash by which the stage knows that nothing has changed.
        more_times: costs that the console does not know.
    """
    record, run = made_of(stage, console, place, request=request, config=config, inputs=inputs)
    times = [*run.times, *(dict(t) for t in more_times)]
    provenance.write(place, replace(record, key=key), replace(run, times=times))


def made_of(
    stage: str,
    console: Console,
    place: SessionStore | Path | None = None,
    *,
    request: Any,
    config: Any = None,
    inputs: Iterable[str] | Mapping[str, str] = (),
) -> tuple[provenance.Provenance, provenance.Run]:
    """Return the record of a result and that of its run, as `note` writes them."""
    said, places = provenance.plain_request(request)
    hashes = dict(inputs) if isinstance(inputs, Mapping) else {}
    if isinstance(place, SessionStore) and not isinstance(inputs, Mapping):
        hashes = provenance.inputs_of(place, inputs, places)
    context = click.get_current_context(silent=True)
    record = provenance.Provenance(
        stage=stage, request=said, config=to_json(config or {}), inputs=hashes,
        versions=provenance.versions(),
    )  # fmt: skip
    return record, provenance.Run(
        command=() if context is None else tuple(context.meta.get(COMMAND_KEY, ())),
        places=places, times=[asdict(t) for t in console.times],
    )  # fmt: skip


def save_starts(store: SessionStore, starts: Sequence[ObjectPose], source: str) -> None:
    """Write the rough poses that registration starts from."""
    rows = [
        {"obj_id": s.obj_id, "instance": s.instance, "T_world_obj": s.T_world_obj.tolist()}
        for s in starts
    ]
    store.write_json("registration/starts.json", {"source": source, "starts": rows})


_told: set[str] = set()
"""Notes on models that this process has told: the stages of a run read the same models."""


def session_models(store: SessionStore, console: Console | None = None) -> dict[int, ObjectModel]:
    """Read the object models of a session, symmetric as its reviewers marked them.

    What is missing of their looks is told once.

    Args:
        store: the session.
        console: where that is told; None = the terminal's standard error.
    """
    from realsim.app.reviewed import review_of
    from realsim.formats.bop.models import load_models
    from realsim.review.corrections import marked_models

    notes: list[str] = []
    models = marked_models(load_models(store.folder / "models", notes=notes), review_of(store))
    for note in notes:
        if note not in _told:
            _told.add(note)
            (console or Console(quiet=True)).warn(note)
    return models


def take_models(store: SessionStore, library: Path, obj_ids: Sequence[int]) -> tuple[int, ...]:
    """Copy the models that a session needs and has not out of a library; return which.

    The session then has everything it needs in its own folder, whatever becomes of the library.

    Raises:
        InputError: no library there, or it has not all of them.
    """
    from realsim.models.library_reading import LibraryReader
    from realsim.models.library_session import copy_models

    return copy_models(LibraryReader.open(library), obj_ids, store.folder / "models")


def judged_scene(store: SessionStore) -> Scene:
    """Return the registered scene as its reviewers left it: their poses, their verdicts.

    A registration that was killed while it was put in place is put in place first.

    Raises:
        InputError: the session has not been registered.
    """
    from realsim.app.register.files import finish_interrupted
    from realsim.app.reviewed import review_of
    from realsim.review import reviewed_scene
    from realsim.store import load_scene

    finish_interrupted(store)
    if not store.has("registration/scene.json"):
        raise InputError(
            f"session '{store.folder}' is not registered yet: run "
            f"`realsim register {store.folder}` first."
        )
    return reviewed_scene(load_scene(store), review_of(store))


def registered_views(store: SessionStore) -> list[int]:
    """Return the views in which the objects are known.

    Those that took part in the registration and are still there, but for what a reviewer excluded
    since; all of them where no registration says which took part.
    """
    from realsim.app.register.results import load_cameras
    from realsim.app.reviewed import review_of

    record = load_cameras(store)
    excluded = review_of(store).excluded_views()
    views = [v.index for v in store.session.views if v.index not in excluded]
    return [k for k in views if record is None or not record.refined or k in record.refined]
