"""The figures of many sessions: the paper's two tables, and what the paper does not tell.

What one session holds: frames, objects with verdict, uncertainty, visibility, and grasps.
"""

import hashlib
import math
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

import numpy as np

from realsim.app.register.results import largest
from realsim.app.stages import judged_scene, open_session
from realsim.arrays import Array
from realsim.errors import InputError
from realsim.formats.bop.models import model_file
from realsim.formats.imported_labels import FOLDER as IMPORTED
from realsim.records import GraspSet, ObjectPose
from realsim.store import SessionStore, load_grasps
from realsim.store.results import GRASP_FOLDER
from realsim.store.session_store import rgb_path
from realsim_sim_bridge.school.summary import SchoolSummary, summarise

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


NOTHING = "-"
SEEN_FROM = 0.1
"""BOP counts an instance as a test target from a tenth of its silhouette on."""
VERDICTS = ("accepted", "doubtful", "rejected", "unchecked")
Row = tuple[str, str, str]
"""Property, here, in the paper."""


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Statistics:
    """What all sessions hold together."""

    sessions: tuple[SessionFacts, ...]
    school: SchoolSummary

    @property
    def objects(self) -> list[ObjectFacts]:
        """Return the things of all scenes."""
        return [o for s in self.sessions for o in s.objects]

    @property
    def visibility(self) -> Array:
        """Return the visible shares of all things in all their frames."""
        return np.concatenate([np.zeros(0), *(o.visibility for o in self.objects)])


def statistics_of(sessions: Iterable[SessionFacts]) -> Statistics:
    """Return the figures of sessions.

    Raises:
        InputError: there is none, or a set of grasps holds scores that cannot be.
    """
    taken = tuple(sessions)
    if not taken:
        raise InputError("there is no session to count.")
    by_scene = {str(s.folder.resolve()): s.sets for s in taken if s.sets}
    return Statistics(sessions=taken, school=summarise(by_scene))


def same_content(stats: Statistics) -> list[str]:
    """Return a note for every two or more sessions that are copies of one: they count each."""
    groups: dict[str, list[str]] = {}
    for s in stats.sessions:
        if s.content:
            groups.setdefault(s.content, []).append(str(s.folder))
    return [
        f"{', '.join(group)}: the same first photograph and registration; what they hold counts "
        f"{'twice' if len(group) == 2 else f'{len(group)} times'}."
        for group in groups.values()
        if len(group) > 1
    ]


def scene_rows(stats: Statistics) -> list[Row]:
    """Return the upper part of the paper's table of statistics: scenes, frames, objects."""
    by_kind = {k: [s for s in stats.sessions if s.kind == k] for k in ("simulated", "real")}
    frames = {k: sum(s.frames for s in v) for k, v in by_kind.items()}
    annotated = {k: sum(s.frames_annotated for s in v) for k, v in by_kind.items()}
    unique = {k: len({o.identity for s in v for o in s.objects}) for k, v in by_kind.items()}
    sizes = Counter(f"{s.width}x{s.height}" for s in stats.sessions)
    counts = np.array([len(s.objects) for s in stats.sessions if s.objects], dtype=np.float64)
    spread = NOTHING
    if len(counts):
        spread = (
            f"{counts.mean():.1f} ± {counts.std():.1f} (range {counts.min():.0f} to "
            f"{counts.max():.0f})"
        )
    both = "{simulated:,} simulated, {real:,} real"
    return [
        ("scenes", both.format(**{k: len(v) for k, v in by_kind.items()}), "1,035 sim, 100 real"),
        ("frames", both.format(**frames), NOTHING),
        ("annotated frames", both.format(**annotated), "290,560 sim, 25,600 real"),
        ("annotated frames in all", f"{sum(annotated.values()):,}", "316,160"),
        ("image resolution", ", ".join(f"{size} ({n})" for size, n in sizes.most_common()),
         "1920x1080 sim, 1280x720 real"),
        ("unique objects", both.format(**unique), "7,396 sim, 100 real"),
        ("objects per scene", spread, "13.9 ± 2.7 (range 8 to 19)"),
    ]  # fmt: skip


def grasp_rows(stats: Statistics) -> list[Row]:
    """Return the lower part: candidates, trajectories, stages, scores."""
    counted = ("scenes", "objects")
    return [row for row in stats.school.to_rows() if row[0] not in counted]


def trust_rows(stats: Statistics) -> list[Row]:
    """Return what the paper does not tell: verdicts, uncertainty, visibility."""
    objects = stats.objects
    verdicts = Counter(o.verdict for o in objects)
    rows: list[Row] = [
        (f"poses {name}", _share(verdicts.get(name, 0), len(objects)), NOTHING) for name in VERDICTS
    ]
    for name, unit in (("sigma_mm", "mm"), ("sigma_deg", "deg")):
        values = np.array([getattr(o, name) for o in objects], dtype=np.float64)
        values = values[np.isfinite(values)]
        text = NOTHING
        if len(values):
            p90 = np.percentile(values, 90)
            text = f"{np.median(values):.3f}, {p90:.3f}, {values.max():.3f} (n = {len(values)})"
        rows.append((f"pose uncertainty [{unit}], median, p90, most", text, NOTHING))
    seen = stats.visibility
    hidden = sum(bool(len(o.visibility)) and not np.any(o.visibility >= SEEN_FROM) for o in objects)
    return [
        *rows,
        ("visible share of an object in a frame, mean", _mean(seen), NOTHING),
        ("object-frames seen to 10 % or more", _share(int(np.sum(seen >= SEEN_FROM)), len(seen)),
         NOTHING),
        ("objects that no frame shows to 10 %", f"{hidden:,}", NOTHING),
    ]  # fmt: skip


def all_rows(stats: Statistics) -> list[Row]:
    """Return every property in the order of the paper's table."""
    return [*scene_rows(stats), *grasp_rows(stats), *trust_rows(stats)]


def _share(count: int, of: int) -> str:
    return f"{count:,} ({100 * count / of:.1f} %)" if of else NOTHING


def _mean(values: Array) -> str:
    return f"{values.mean():.3f} ± {values.std():.3f}" if len(values) else NOTHING


# --- one row a session, one row a thing -----------------------------------------------------------

SESSION_HEADER = (
    "session", "kind", "frames", "annotated", "objects", "candidates", "good", "bad", "score_mean",
    "with_trajectory", *VERDICTS, "sigma_mm_median", "visibility_mean", "width", "height",
)  # fmt: skip
OBJECT_HEADER = (
    "session", "instance", "name", "verdict", "sigma_mm", "sigma_deg", "candidates", "good", "bad",
    "score_mean", "with_trajectory", "frames", "visibility_mean", "visibility_most", "obj_id",
)  # fmt: skip
Cell = str | int | float


def session_table(stats: Statistics) -> Iterator[list[Cell]]:
    """Return one row a session, as in SESSION_HEADER."""
    for s in stats.sessions:
        verdicts = Counter(o.verdict for o in s.objects)
        sigma = np.array([o.sigma_mm for o in s.objects])
        seen = np.concatenate([np.zeros(0), *(o.visibility for o in s.objects)])
        yield [
            s.name, s.kind, s.frames, s.frames_annotated, len(s.objects),
            *_school_cells(summarise(s.sets)), *(verdicts.get(v, 0) for v in VERDICTS),
            _median(sigma), _average(seen), s.width, s.height,
        ]  # fmt: skip


def object_table(stats: Statistics) -> Iterator[list[Cell]]:
    """Return one row a thing of every session, as in OBJECT_HEADER."""
    for s in stats.sessions:
        sets = {g.instance: g for g in s.sets}
        for o in s.objects:
            tried = [sets[o.instance]] if o.instance in sets else []
            most = float(o.visibility.max()) if len(o.visibility) else math.nan
            yield [
                s.name, o.instance, o.name, o.verdict, o.sigma_mm, o.sigma_deg,
                *_school_cells(summarise(tried)), len(o.visibility), _average(o.visibility),
                most, o.obj_id,
            ]  # fmt: skip


def _school_cells(summary: SchoolSummary) -> Sequence[Cell]:
    return (
        summary.candidates, summary.good, summary.bad, summary.score.mean, summary.with_trajectory
    )  # fmt: skip


def _median(values: Array) -> float:
    known = values[np.isfinite(values)]
    return float(np.median(known)) if len(known) else math.nan


def _average(values: Array) -> float:
    return float(values.mean()) if len(values) else math.nan
