"""One session under review: read once, shared by all windows; decisions go to its journal.

The server only ever appends to review/journal.jsonl; it changes no other file of the session.
"""

import os
import threading
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from realsim.errors import InputError
from realsim.records import ObjectModel, ObjectPose, Scene
from realsim.review import corrections, journal, scene_list
from realsim.review.content.config import SceneConfig
from realsim.review.journal import JOURNAL_FILE, Entry, ReviewState
from realsim.store import SessionStore, load_scene

if TYPE_CHECKING:
    from realsim.review.content.content import SceneContent
    from realsim.review.placing.camera_view import CameraViews
    from realsim.review.placing.depth_residuals import CloudResiduals
    from realsim.review.placing.snapping import Snapper

Array = NDArray[np.float64]
Progress = Callable[[int, int], None]
"""Called with (done, total)."""


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Standing:
    """What the journal makes of the registered scene at one moment."""

    state: ReviewState
    scene: Scene
    """Objects where the reviewers left them, with their verdicts."""
    damaged: tuple[int, ...]
    """Numbers of journal lines that are not whole."""


class ReviewedSession:
    """A registered session and its journal; everything here may be called from any thread."""

    def __init__(self, store: SessionStore, number: int = 0, config: SceneConfig | None = None):
        """Read the registered scene; pictures and depth are read when somebody opens it.

        Args:
            store: a registered session.
            number: its number in the list of sessions.
            config: how much of it is shown.

        Raises:
            InputError: the session is not registered, or a model of an object is missing.
        """
        self.store = store
        self.number = number
        self.config = config or SceneConfig()
        """How much is shown."""
        self._scene_stamp = _stamp(store.path(scene_list.SCENE_FILE))
        self.registered: Scene = load_scene(store)
        self.names = _names(store)
        missing = sorted({o.obj_id for o in self.registered.objects} - set(self.names))
        if missing:
            raise InputError(
                f"the scene of '{store.folder}' holds objects {missing}, but "
                f"{store.folder / 'models'} has no model of them; copy the models there."
            )
        self._lock = threading.RLock()
        self._stamp: tuple[int, int] | None = None
        self._standing: Standing | None = None
        self._loading = threading.Lock()
        self._content: SceneContent | None = None
        self._views: CameraViews | None = None
        self._snapper: tuple[tuple[int, ...], Snapper] | None = None
        self._measuring = threading.Lock()
        self._residuals: CloudResiduals | None = None

    @property
    def name(self) -> str:
        """Name of the session; scenes of a data set are told apart by their folders."""
        return self.store.folder.resolve().name

    @property
    def journal_path(self) -> Path:
        """Where the decisions stand."""
        return self.store.path(JOURNAL_FILE)

    @property
    def is_stale(self) -> bool:
        """Whether the session was registered anew since it was read."""
        return _stamp(self.store.path(scene_list.SCENE_FILE)) != self._scene_stamp

    @property
    def has_pending(self) -> bool:
        """Whether the next `realsim register --from-review` has something to do."""
        return bool(corrections.pending(self.registered, self.standing.state))

    # --- what stands in the journal ---------------------------------------------------------------

    @property
    def standing(self) -> Standing:
        """What the journal adds up to as it is on disk now; read again only when it changed."""
        with self._lock:
            stamp = _stamp(self.journal_path)
            if self._standing is None or stamp != self._stamp:
                found = journal.read(self.journal_path)
                state = journal.replay(found.entries)
                scene = corrections.reviewed_scene(self.registered, state)
                self._stamp = stamp
                self._standing = Standing(state=state, scene=scene, damaged=found.damaged)
            return self._standing

    def rows(self) -> list[scene_list.ObjectRow]:
        """Return the objects as the list shows them."""
        standing = self.standing
        corrected = corrections.corrected_scene(self.registered, standing.state)
        rows: list[scene_list.ObjectRow] = []
        for placed, computed in zip(standing.scene.objects, corrected.objects, strict=True):
            registered = self.registered.object(placed.instance)
            rows.append(
                scene_list.ObjectRow(
                    session=self.number,
                    instance=placed.instance,
                    name=self.names[placed.obj_id],
                    computed=computed.verdict,
                    verdict=placed.verdict,
                    agree=placed.checks.get("agree", float("nan")),
                    is_decided=corrections.decision_on(computed, standing.state) is not None,
                    is_changed=journal.subject_of(registered) != journal.subject_of(placed),
                )
            )
        return rows

    # --- decisions --------------------------------------------------------------------------------

    def decide(
        self, action: journal.Action, placed: ObjectPose, reviewer: str, **said: Any
    ) -> Entry:
        """Append a decision about an object as the reviewer sees it.

        Args:
            action: accept, reject, comment, move or swap.
            placed: the object as the reviewer sees it.
            reviewer: who decides.
            said: what else `journal.new_entry` takes.

        Raises:
            InputError: unsigned, or another reviewer has moved the object meanwhile.
        """
        entry = journal.new_entry(action, placed, reviewer, **said)
        check = None
        if action != "comment":
            check = corrections.check_is_current(self.registered, placed)
        journal.append(self.journal_path, entry, check=check)
        return entry

    def undo(self, placed: ObjectPose, last: Entry | None, reviewer: str) -> Entry:
        """Take back the last standing line on an object, if it still is the last one.

        Args:
            placed: the object as the reviewer sees it.
            last: the line that the reviewer sees as the last one.
            reviewer: who takes it back.

        Raises:
            InputError: there is none, or somebody has written another one meanwhile.
        """
        if last is None:
            raise InputError("nothing is decided about this object; there is nothing to undo.")
        entry = journal.new_entry("undo", placed, reviewer, undoes=last.id)

        def still_last(state: ReviewState) -> None:
            lines = state.of(placed.instance)
            if not lines or lines[-1].id != last.id:
                who = lines[-1].reviewer if lines else "somebody"
                raise InputError(
                    f"{who} was faster: what you wanted to undo is no longer the last line on "
                    "this object. Look at it as it stands, then decide."
                )

        journal.append(self.journal_path, entry, check=still_last)
        return entry

    def set_view(self, view: int, is_excluded: bool, reviewer: str, comment: str = "") -> Entry:
        """Append: the next registration leaves this view out, or takes it in again.

        Raises:
            InputError: unsigned, or the view is so already.
        """
        entry = journal.new_entry(
            "exclude" if is_excluded else "include", None, reviewer, view=view, comment=comment
        )

        def differs(state: ReviewState) -> None:
            by = state.excluded_views().get(view)
            if (by is not None) == is_excluded:
                word = f"left out already, by {by.reviewer}" if by is not None else "in already"
                raise InputError(f"view {view} is {word}.")

        journal.append(self.journal_path, entry, check=differs)
        return entry

    def mark_symmetric(self, obj_id: int, symmetry: str, reviewer: str) -> Entry:
        """Append: all objects of this model are symmetric like this.

        Raises:
            InputError: unsigned, or the text is not understood.
        """
        from realsim.review.symmetric import symmetry_of

        symmetry_of(symmetry, self.model(obj_id).mesh)
        entry = journal.new_entry("symmetric", None, reviewer, obj_id=obj_id, symmetry=symmetry)
        journal.append(self.journal_path, entry)
        return entry

    # --- what is shown ----------------------------------------------------------------------------

    def content(self, progress: Progress | None = None) -> "SceneContent":
        """Return what is shown, loaded once; a second window waits for the first one's loading."""
        from realsim.review.content.content import SceneContent

        with self._loading:
            if self._content is None:
                self._content = SceneContent.load(self.store, self.config, progress)
            return self._content

    def model(self, obj_id: int) -> ObjectModel:
        """Return a model, symmetric as the reviewers marked it.

        Raises:
            InputError: there is none of this id.
        """
        models = self.models()
        if obj_id not in models:
            known = ", ".join(str(i) for i in sorted(models))
            raise InputError(f"there is no model of object {obj_id}; there are: {known}.")
        return models[obj_id]

    def models(self) -> Mapping[int, ObjectModel]:
        """Return all models, symmetric as the reviewers marked them."""
        from realsim.review.symmetric import marked_models

        return marked_models(self.content().models, self.standing.state)

    def camera_views(self) -> "CameraViews":
        """Return who draws outlines over the photographs; made once."""
        from realsim.review.placing.camera_view import CameraViews

        content = self.content()
        with self._loading:
            if self._views is None:
                self._views = CameraViews(self.store, content.models)
            return self._views

    def snapper(self) -> "Snapper":
        """Return who snaps objects onto the measured depth; made once for the same views."""
        from realsim.review.placing.snapping import Snapper

        content, standing = self.content(), self.standing
        excluded = tuple(standing.state.excluded_views())
        with self._loading:
            if self._snapper is None or self._snapper[0] != excluded:
                made = Snapper(self.store, self.registered, content.models, excluded_views=excluded)
                self._snapper = (excluded, made)
            self._snapper[1].scene = standing.scene
            return self._snapper[1]

    def residual_rgb(self, objects: Sequence[ObjectPose]) -> NDArray[np.uint8]:
        """Return the colours (N, 3) of the measured points by their distance from the models.

        Args:
            objects: where they stand.
        """
        from realsim.review.placing.depth_residuals import CloudResiduals, residual_rgb

        content = self.content()
        with self._measuring:
            if self._residuals is None:
                cache = self.store.folder / "registration" / "cache"
                folder = cache if cache.is_dir() and os.access(cache, os.W_OK) else None
                self._residuals = CloudResiduals(content.cloud.points, folder=folder)
            Ts = np.array([o.T_world_obj for o in objects]).reshape(-1, 4, 4)
            meshes = [content.models[o.obj_id].mesh for o in objects]
            return residual_rgb(self._residuals.against(Ts, meshes))


def _names(store: SessionStore) -> dict[int, str]:
    """Return the names of the models of a session, without reading their meshes."""
    path = "models/models_info.json"
    if not store.has(path):
        return {}
    info: Any = store.read_json(path)
    rows: dict[int, str] = {}
    for key, value in info.items() if isinstance(info, dict) else ():
        if str(key).isdecimal():
            named = value.get("name") if isinstance(value, dict) else None
            rows[int(key)] = str(named or f"object {key}")
    return rows


def _stamp(path: Path) -> tuple[int, int]:
    """Return size and time of change of a file; zeros where there is none."""
    try:
        found = path.stat()
    except FileNotFoundError:
        return 0, 0
    return found.st_size, found.st_mtime_ns
