"""What one session holds: frames, objects with verdict, uncertainty, visibility, and grasps."""

import hashlib
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

import numpy as np

from realsim.app.register.uncertainty import largest
from realsim.app.stages import judged_scene, open_session
from realsim.arrays import Array
from realsim.errors import InputError
from realsim.formats.bop.models import model_file
from realsim.formats.imported_labels import FOLDER as IMPORTED
from realsim.records import GraspSet, ObjectPose
from realsim.store import SessionStore, load_grasps
from realsim.store.results import GRASP_FOLDER
from realsim.store.session_store import rgb_path

Kind = Literal["real", "simulated"]
SIMULATED = "synthetic"
"""Key of a session's `extra` that only rendered ones have; the simulated lab's camera says it."""


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class ObjectFacts:
    """One thing in one scene."""

    instance: int
    obj_id: int
    name: str
    identity: str
    """The same for the same mesh, in whatever session and under whatever id."""
    verdict: str
    sigma_mm: float
    """1 sigma of the position along its worst axis [mm]; NaN = not known."""
    sigma_deg: float
    """1 sigma of the rotation about its worst axis, one of revolution set aside [deg]; NaN = not
    known."""
    visibility: Array
    """(frames,) visible share of its silhouette in every annotated frame."""


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class SessionFacts:
    """What one session holds."""

    name: str
    folder: Path
    kind: Kind
    width: int
    height: int
    frames: int
    frames_annotated: int
    content: str
    """Digest of the first photograph and of the registered scene: sessions that have the same are
    copies of one; '' = there is no photograph."""
    objects: tuple[ObjectFacts, ...]
    sets: tuple[GraspSet, ...]
    """Tried grasps, without their poses, which no figure needs."""
    has: frozenset[str] = field(default_factory=frozenset[str])
    """What there is of mask, mask_visib, labels, grasps, trajectories, objects, depth, models."""


def session_facts(folder: Path) -> SessionFacts:
    """Return what a session holds.

    Raises:
        InputError: it is no session, or damaged.
    """
    store = open_session(folder)
    session = store.session
    infos, instances = _visibility_rows(store)
    placed = judged_scene(store).objects if store.has("registration/scene.json") else ()
    known = _infos(store)

    def facts(o: ObjectPose) -> ObjectFacts:
        info = known.get(o.obj_id, {})
        axes = [s["axis"] for s in info.get("symmetries_continuous", ())]
        mm, deg = largest(o.covariance, axes)
        return ObjectFacts(
            instance=o.instance, obj_id=o.obj_id, name=str(info.get("name", f"object {o.obj_id}")),
            identity=_identity(store, o.obj_id), verdict=o.verdict, sigma_mm=mm, sigma_deg=deg,
            visibility=_visibility(infos, instances.get(o.instance)),
        )  # fmt: skip

    return SessionFacts(
        name=folder.resolve().name,
        folder=folder,
        kind=_kind(store),
        width=session.intrinsics.width,
        height=session.intrinsics.height,
        frames=len(session.views),
        frames_annotated=len(infos),
        content=_content(store),
        objects=tuple(facts(o) for o in placed),
        sets=tuple(_without_poses(s) for s in load_grasps(store)),
        has=_present(store),
    )


def _kind(store: SessionStore) -> Kind:
    camera = str(store.extra.get("camera", ""))
    return "simulated" if SIMULATED in store.extra or camera.startswith("simulated") else "real"


def _content(store: SessionStore) -> str:
    """Return the digest of what no two captures have in common; '' without a photograph."""
    if not store.session.views:
        return ""
    photograph = store.folder / rgb_path(store.session.views[0].index)
    if not photograph.is_file():
        return ""
    scene = store.folder / "registration/scene.json"
    digest = hashlib.sha256(photograph.read_bytes())
    digest.update(scene.read_bytes() if scene.is_file() else b"")
    return digest.hexdigest()


def _infos(store: SessionStore) -> dict[int, Mapping[str, Any]]:
    path = "models/models_info.json"
    info: Any = store.read_json(path) if store.has(path) else {}
    return {int(k): v for k, v in info.items() if str(k).isdecimal()}


def _identity(store: SessionStore, obj_id: int) -> str:
    """Return a digest of the object's mesh; its id where there is no mesh."""
    path = store.folder / "models" / model_file(obj_id)
    return hashlib.sha256(path.read_bytes()).hexdigest() if path.is_file() else f"id {obj_id}"


def _visibility_rows(store: SessionStore) -> tuple[dict[str, Any], dict[int, int]]:
    """Return scene_gt_info.json, and in which row of a frame each instance stands."""
    annotated = store.has("scene_gt_info.json") and (store.folder / "annotations").is_dir()
    if not annotated:
        return {}, {}
    infos: dict[str, Any] = store.read_json("scene_gt_info.json")
    for view in infos:
        path = f"annotations/{int(view):06d}.json"
        if store.has(path):
            rows: list[Any] = store.read_json(path)["objects"]
            return infos, {int(row["instance"]): k for k, row in enumerate(rows)}
    return infos, {}


def _visibility(infos: Mapping[str, Any], row: int | None) -> Array:
    if row is None:
        return np.zeros(0)
    try:
        return np.array([float(rows[row]["visib_fract"]) for rows in infos.values()])
    except (IndexError, KeyError, TypeError, ValueError) as error:
        raise InputError(
            f"scene_gt_info.json does not fit the annotations ({error!r}); run `realsim annotate` "
            "again."
        ) from error


def _without_poses(s: GraspSet) -> GraspSet:
    """Return a set whose poses are all the identity, kept once: sixteen numbers a grasp less."""
    light = object.__new__(GraspSet)
    for name in s.__slots__:
        object.__setattr__(light, name, getattr(s, name))
    same = np.broadcast_to(np.eye(4), (len(s), 4, 4))
    object.__setattr__(light, "Ts_obj_grasp", same)
    return light


def _present(store: SessionStore) -> frozenset[str]:
    folder = store.folder
    places = {
        "mask": ("mask", f"{IMPORTED}/mask"),
        "mask_visib": ("mask_visib", f"{IMPORTED}/mask_visib"),
        "labels": ("labels",),
        "trajectories": (f"{GRASP_FOLDER}/trajectories",),
        "models": ("models",),
        "depth": ("depth",),
    }
    found = {
        name
        for name, paths in places.items()
        if any((folder / p).is_dir() and any((folder / p).iterdir()) for p in paths)
    }
    if store.has("annotations/objects.json"):
        found.add("objects")
    if any((folder / GRASP_FOLDER).glob("*.npz")):
        found.add("grasps")
    return frozenset(found)
