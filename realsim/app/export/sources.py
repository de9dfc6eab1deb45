"""What an export can be made of: sessions, folders of them, BOP and GraspNet data sets."""

import hashlib
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from realsim.app.export.card import SceneTrust
from realsim.app.export.target import ExportRequest
from realsim.app.register.fixed import CALIBRATED
from realsim.app.stages import BOARD_VIEWS
from realsim.errors import InputError
from realsim.formats.labelled_scene import LabelledScene
from realsim.records import Scene
from realsim.store import SessionStore
from realsim.store.cameras import CAMERAS, camera_folders, session_of_camera
from realsim.store.opening import require_header
from realsim.store.provenance import BESIDE
from realsim.store.session_store import SESSION_FILE

ACCEPTED = (
    "accepted are a session (session.json), a folder of sessions, a BOP data set "
    "(SPLIT/000001/scene_camera.json), a GraspNet data set (scenes/scene_0000/kinect)"
)
HAND = "wrist"
"""Camera in the hand of a session whose calibration does not name it."""
LICENCE_NAMES = ("LICENSE", "LICENCE", "COPYING")


@dataclass(frozen=True, kw_only=True, slots=True)
class SourceScene:
    """One scene to be exported; opened when its turn comes."""

    name: str
    source: Path
    """What was given."""
    folder: Path
    """Its own folder."""
    kind: str
    """'session', 'bop' or 'graspnet'."""
    number: int
    """Number of the scene in its source."""
    camera: str
    """'' = the source has one."""
    is_further: bool = False
    """Whether it is a further camera of a session: what is said of the scene is said there."""
    open: Callable[[], LabelledScene]


def source_scenes(request: ExportRequest, *, all_cameras: bool = False) -> list[SourceScene]:
    """Return the scenes of all sources, in their order.

    Args:
        request: what was asked for.
        all_cameras: whether further cameras of a session are scenes as well.

    Raises:
        InputError: a source that is none, has no scene, or not the scenes that were asked for.
    """
    found = [s for source in request.sources for s in _scenes_of(source, request, all_cameras)]
    if not found:
        given = ", ".join(f"'{s}'" for s in request.sources)
        raise InputError(f"there is no scene in {given}; {ACCEPTED}.")
    return found


def _scenes_of(source: Path, request: ExportRequest, all_cameras: bool) -> list[SourceScene]:
    if not source.is_dir():
        what = "a file" if source.is_file() else "not there"
        raise InputError(f"'{source}' is {what}; {ACCEPTED}.")
    sessions = session_folders(source)
    if sessions:
        return _sessions(source, sessions, request, all_cameras)
    if any(any(source.glob(f"{up}annotations/*.xml")) for up in ("", "*/", "*/*/", "*/*/*/")):
        return list(_graspnet(source, request))
    if any(any(source.glob(f"{up}scene_camera*.json")) for up in ("", "*/", "*/*/")):
        return list(_bop(source, request))
    held = ", ".join(sorted(p.name for p in source.iterdir())[:8]) or "nothing"
    raise InputError(f"'{source}' is no source of an export (it holds {held}); {ACCEPTED}.")


def session_folders(source: Path) -> list[Path]:
    """Return a folder that is a session, or the sessions up to two levels below it.

    Raises:
        InputError: one of them has lost its header; what else is there would be taken for a scene.
    """
    require_header(source)
    if (session := session_of_camera(source)) is not None:
        raise InputError(f"'{source}' is a further camera of the session '{session}': give that.")
    if (source / SESSION_FILE).is_file():
        return [source]
    for below in ("*", "*/*"):
        folders = sorted(p for p in source.glob(below) if not p.name.startswith("."))
        for folder in folders:
            require_header(folder)
        found = [p for p in folders if (p / SESSION_FILE).is_file() and not _is_inner(p)]
        if found:
            return found
    if left := camera_folders(source):
        raise InputError(
            f"'{source}' holds further cameras of a session ({', '.join(left)}), and the session's "
            "own files are lost. Restore them from a copy; nothing was taken from the cameras."
        )
    return []


def _is_inner(folder: Path) -> bool:
    """Return whether a folder holds views of a board, or is a further camera."""
    return folder.match(BOARD_VIEWS) or folder.parent.name == CAMERAS


def _sessions(
    source: Path, folders: list[Path], request: ExportRequest, all_cameras: bool
) -> list[SourceScene]:
    from realsim.app.stages import judged_scene, open_session
    from realsim.formats.session_scene import open_session_scene

    def opener(folder: Path, camera: str, further: Path | None) -> Callable[[], LabelledScene]:
        def opened() -> LabelledScene:
            store = open_session(folder)
            scene = judged_scene(store) if store.has("registration/scene.json") else None
            return open_session_scene(
                store, scene, labels=request.labels, split=request.split, camera=camera,
                seen_by=None if further is None else SessionStore.open(further),
            )  # fmt: skip

        return opened

    scenes: list[SourceScene] = []
    for folder in folders:
        number, camera = _place_of(folder)
        cameras: dict[str, Path | None] = {camera: None}
        further = camera_folders(folder) if all_cameras else {}
        if further:
            cameras = {_hand_name(folder): None, **further}
            if request.camera and request.camera not in cameras:
                raise InputError(
                    f"'{folder}' has no camera '{request.camera}'; it has {', '.join(cameras)}."
                )
        for name, path in cameras.items():
            if further and request.camera not in ("", name):
                continue
            own = folder.resolve().name
            scenes.append(
                SourceScene(
                    name=own if path is None else f"{own}-{name}", source=source, folder=folder,
                    kind="session", number=number, camera=name, is_further=path is not None,
                    open=opener(folder, name if further else "", path),
                )
            )  # fmt: skip
    _require_scenes(source, request, [s.number for s in scenes])
    return [s for s in scenes if not request.scenes or s.number in request.scenes]


def _hand_name(session: Path) -> str:
    """Return what the camera in the hand is called beside others: as it was calibrated."""
    from realsim_calibration.cameras.files import read_cameras

    path = session / CALIBRATED
    entries = read_cameras(path).cameras if path.is_file() else ()
    return next((c.name for c in entries if c.mount == "hand"), HAND)


def _place_of(folder: Path) -> tuple[int, str]:
    """Return number and camera of a session: those of the data set that it was imported from."""
    from realsim.formats.imported_labels import SCENE
    from realsim.untrusted.own_json import read_object

    if (folder / SCENE).is_file():
        head = read_object(folder / SCENE)
        if isinstance(head.get("number"), int):
            return head["number"], str(head.get("camera", ""))
    digits = folder.resolve().name.rpartition("_")[2]
    return (int(digits) if digits.isdecimal() else 0), ""


def _bop(source: Path, request: ExportRequest) -> Iterator[SourceScene]:
    from realsim.formats.bop.opening import open_labelled_scene
    from realsim.formats.bop.scene import find_scenes

    refs = find_scenes(source)
    _require_scenes(source, request, [r.scene_id for r in refs])
    cameras = sorted({r.camera for r in refs})
    if request.camera and request.camera not in cameras:
        raise InputError(
            f"'{source}' has no camera '{request.camera}'; it has "
            f"{', '.join(c for c in cameras if c) or 'one without a name'}."
        )
    for ref in refs:
        if request.scenes and ref.scene_id not in request.scenes:
            continue
        if request.camera in ("", ref.camera):
            yield SourceScene(
                name=ref.name, source=source, folder=ref.folder, kind="bop",
                number=ref.scene_id, camera=ref.camera,
                open=lambda ref=ref: open_labelled_scene(ref, models=request.models),
            )  # fmt: skip


def _require_scenes(source: Path, request: ExportRequest, there: list[int]) -> None:
    missing = sorted(set(request.scenes) - set(there))
    if missing:
        listed = ", ".join(str(n) for n in sorted(set(there))[:20])
        raise InputError(f"scene {missing[0]} is not in '{source}'; it has {listed}.")


def _graspnet(source: Path, request: ExportRequest) -> Iterator[SourceScene]:
    from realsim.formats.graspnet.opening import open_scene
    from realsim.formats.graspnet.scene import open_graspnet

    tree = open_graspnet(
        source,
        scenes=request.scenes or None,
        cameras=(request.camera,) if request.camera else None,
        models=request.models,
    )
    for ref in tree.scenes:
        yield SourceScene(
            name=ref.name, source=source, folder=ref.folder, kind="graspnet", number=ref.number,
            camera=ref.camera, open=lambda ref=ref: open_scene(ref),
        )  # fmt: skip


def content_of(scenes: Sequence[SourceScene]) -> str:
    """Return a digest of names, sizes and times of all files of scenes: what they are made of.

    An export that is gone on with must find its sources as they were.
    """
    digest = hashlib.sha256()
    for scene in scenes:
        for path in sorted(p for p in scene.folder.rglob("*") if p.is_file()):
            state = path.stat()
            name = path.relative_to(scene.folder).as_posix()
            if scene.kind == "session" and name.startswith(BESIDE):
                continue
            digest.update(f"{name} {state.st_size} {state.st_mtime_ns}\n".encode())
    return digest.hexdigest()


def trust_in(scene: SourceScene) -> SceneTrust:
    """Return what registration and review say of a scene; nothing of a data set."""
    if scene.kind != "session" or scene.is_further:
        return SceneTrust()
    from realsim.app.stages import judged_scene, open_session

    store = open_session(scene.folder)
    if not store.has("registration/scene.json"):
        return SceneTrust()
    judged: Scene = judged_scene(store)
    sigmas = [
        1e3 * float(np.sqrt(np.linalg.eigvalsh(o.covariance[3:, 3:])[-1]))
        for o in judged.objects
        if o.covariance is not None
    ]
    return SceneTrust(
        verdicts=Counter(o.verdict for o in judged.objects),
        pose_sigma_mm=float(np.median(sigmas)) if sigmas else None,
        findings=tuple(_findings(store, {o.instance for o in judged.objects})),
        instances=len(judged.objects),
    )


def _findings(store: SessionStore, labelled: set[int]) -> list[str]:
    """Return what registration found out, and what has no label in a scene of these instances."""
    from realsim.app.upgrade.scene import registration_notes

    if not store.has("registration/report.json"):
        return []
    missing: Any = store.read_json("registration/report.json").get("not_placed", ())
    return [*registration_notes(store)] + [
        f"object {n['obj_id']} (instance {n['instance']}) is not placed and has no label, though "
        f"the images may show it: {n['reason']}"
        for n in missing
        if n["instance"] not in labelled
    ]


def licence_files(sources: tuple[Path, ...]) -> dict[str, Path]:
    """Return the licences that lie beside the sources, by the name they are copied under."""
    found: dict[str, Path] = {}
    for source in sources:
        for path in sorted(source.iterdir()):
            if path.is_file() and path.name.upper().startswith(LICENCE_NAMES):
                name = f"licences/{source.resolve().name}-{path.name}"
                found[name] = path
    return found
