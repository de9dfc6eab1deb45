"""One session under review: read once, shared by all windows; decisions go to its journal.

The server only ever appends to review/journal.jsonl; it changes no other file of the session.
"""

import os
import threading
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from realsim.arrays import Array32
from realsim.errors import InputError, RealsimError
from realsim.formats.bop.models import model_file
from realsim.records import ObjectModel, ObjectPose, Scene
from realsim.review import corrections, journal, scene_list
from realsim.review.content.config import SceneConfig
from realsim.review.journal import JOURNAL_FILE, Entry, Journal, ReviewState
from realsim.review.refusals import SessionGone, disk_words
from realsim.store import SessionStore, load_scene

if TYPE_CHECKING:
    from realsim.review.content.content import SceneContent
    from realsim.review.placing.depth_residuals import CloudResiduals
    from realsim.review.placing.photograph import Photographs
    from realsim.review.placing.snapping import Snapper

WATCHED = (scene_list.SCENE_FILE, "session.json", "grasps")
"""What is shown anew when it changes on disk: poses, cameras, grasps."""
Progress = Callable[[int, int], None]
"""Called with (done, total)."""


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Standing:
    """What the journal makes of the registered scene at one moment."""

    state: ReviewState
    scene: Scene
    """Objects where the reviewers left them, with their verdicts."""
    rows: list[scene_list.ObjectRow]
    """The objects as the list shows them."""


class ReviewedSession:
    """A registered session and its journal; everything here may be called from any thread."""

    def __init__(
        self,
        store: SessionStore,
        number: int = 0,
        config: SceneConfig | None = None,
        before: "ReviewedSession | None" = None,
    ) -> None:
        """Read the registered scene; pictures and depth are read when somebody opens it.

        Args:
            store: a registered session.
            number: its number in the list of sessions.
            config: how much of it is shown.
            before: the same session as it was registered before: no line that was read may be lost.

        Raises:
            InputError: the session is not registered, or a model of an object is missing.
        """
        self.store = store
        self.place = str(store.folder.resolve())
        self.name = store.folder.resolve().name if before is None else before.name
        """Name of the session; scenes of a data set are told apart by their folders."""
        self.journal_path = store.path(JOURNAL_FILE)
        """Where the decisions stand."""
        self.number = number
        self.config = config or SceneConfig()
        """How much is shown."""
        self._read = self._seen = self._stamps()
        self.registered: Scene = load_scene(store)
        self.names = _names(store)
        missing = sorted({o.obj_id for o in self.registered.objects} - set(self.names))
        if missing:
            raise InputError(
                f"the scene of '{store.folder}' holds objects {missing}, but "
                f"{store.folder / 'models'} has no model of them; copy the models there."
            )
        self._lock = threading.RLock()
        self._journal = Journal(self.journal_path) if before is None else before._journal
        self._standing: Standing | None = None
        self._loading = threading.Lock()
        self._content: SceneContent | None = None
        self._photographs: Photographs | None = None
        self._snapper: tuple[tuple[int, ...], Snapper] | None = None
        self._measuring = threading.Lock()
        self._residuals: CloudResiduals | None = None

    def has_changed(self) -> bool:
        """Return whether poses, cameras or grasps were written anew since they were read.

        Only what is the same as at the last call counts: a stage at work is waited for.
        """
        was, self._seen = self._seen, self._stamps()
        return was == self._seen != self._read

    def _stamps(self) -> list[tuple[int, int, int]]:
        return [journal.stamp_of(self.store.path(name)) for name in WATCHED]

    @property
    def has_pending(self) -> bool:
        """Whether the next `realsim register --from-review` has something to do."""
        return bool(corrections.pending(self.registered, self.latest.state))

    # --- what stands in the journal ---------------------------------------------------------------

    @property
    def standing(self) -> Standing:
        """What the journal adds up to as it is on disk now; read again only when it changed.

        Raises:
            SessionGone: lines that were read are gone.
            InputError: the journal cannot be read.
        """
        try:
            state = self._journal.read()
        except OSError as error:
            raise InputError(f"the journal cannot be read: {disk_words(error)}.") from error
        return self._made_of(state)

    def _made_of(self, state: ReviewState) -> Standing:
        """Return what this state makes of the registered scene; made once."""
        with self._lock:
            if self._standing is None or self._standing.state is not state:
                scene = corrections.reviewed_scene(self.registered, state)
                self._standing = Standing(state=state, scene=scene, rows=self._rows(state, scene))
            return self._standing

    @property
    def latest(self) -> Standing:
        """What the journal added up to when it could be read last; for a summary at the end."""
        try:
            return self.standing
        except RealsimError:
            return self._made_of(self._journal.state)

    def trouble(self) -> str:
        """Return what keeps the journal from being read; '' = nothing."""
        try:
            self.check_folder()
            _ = self.standing
        except RealsimError as error:
            return str(error)
        return ""

    def entries_seen(self) -> list[Entry]:
        """Return all lines that were read or written, also those whose file is gone since."""
        return list(self.latest.state.entries)

    def check_folder(self) -> None:
        """Check that the session is where it was.

        Raises:
            SessionGone: it is not.
        """
        if not self.store.folder.is_dir():
            raise SessionGone(
                f"the folder of the session is gone: {self.store.folder}. Nothing is recorded "
                "meanwhile. Put it back, or end `realsim review` and start it again where it is."
            )

    def rows(self) -> list[scene_list.ObjectRow]:
        """Return the objects as the list shows them, as the journal is on disk now."""
        return self.standing.rows

    def _rows(self, state: ReviewState, scene: Scene) -> list[scene_list.ObjectRow]:
        corrected = corrections.corrected_scene(self.registered, state)
        rows: list[scene_list.ObjectRow] = []
        all_of = (self.registered.objects, scene.objects, corrected.objects)
        for registered, placed, computed in zip(*all_of, strict=True):
            rows.append(
                scene_list.ObjectRow(
                    session=self.number,
                    instance=placed.instance,
                    name=self.names.get(placed.obj_id, f"object {placed.obj_id} (no model)"),
                    verdict=placed.verdict,
                    agree=placed.checks.get("agree", float("nan")),
                    is_decided=corrections.decision_on(computed, state) is not None,
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
        return self._record(entry, check)

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

        return self._record(entry, still_last)

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

        return self._record(entry, differs)

    def mark_symmetric(self, obj_id: int, symmetry: str, reviewer: str) -> Entry:
        """Append: all objects of this model are symmetric like this.

        Raises:
            InputError: unsigned, or the text is not understood.
        """
        from realsim.review.corrections import symmetry_of

        symmetry_of(symmetry, self.model(obj_id).mesh)
        entry = journal.new_entry("symmetric", None, reviewer, obj_id=obj_id, symmetry=symmetry)
        return self._record(entry)

    def _record(self, entry: Entry, check: Callable[[ReviewState], None] | None = None) -> Entry:
        """Append a line to the journal that was read, and to no other.

        Raises:
            SessionGone: folder or journal are not what was read.
            InputError: the check refuses the line, or the disk does.
        """
        self.check_folder()
        _ = self.standing  # A journal that is gone is not begun anew.
        check = check or (lambda _: None)
        try:
            journal.append(self.journal_path, entry, check=check, journal=self._journal)
        except OSError as error:
            raise InputError(f"Not recorded: {disk_words(error)}.") from error
        _ = self.standing  # The line is remembered, whatever becomes of the file.
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
            raise InputError(
                f"there is no model of object {obj_id}; there are: {known}. "
                f"{self.model_wanted(obj_id)}"
            )
        return models[obj_id]

    def has_model(self, obj_id: int) -> bool:
        """Return whether there is a model: a swap may name an object that has none here."""
        return obj_id in self.content().models

    def model_wanted(self, obj_id: int) -> str:
        """Return what is to be done about a model that is missing."""
        path = self.store.folder / "models" / model_file(obj_id)
        return f"Copy it to {path} and start `realsim review` again, or undo the swap."

    def shown_model(self, placed: ObjectPose) -> ObjectModel:
        """Return what is shown of an object: its model, or that which it was registered as.

        The second where its own is missing; the name says so.
        """
        models = self.models()
        if placed.obj_id in models:
            return models[placed.obj_id]
        registered = models[self.registered.object(placed.instance).obj_id]
        name = f"object {placed.obj_id} (its model is missing)"
        return ObjectModel(obj_id=placed.obj_id, name=name, mesh=registered.mesh)

    def with_models(self, objects: Sequence[ObjectPose]) -> tuple[ObjectPose, ...]:
        """Return the objects whose models are there: no other can be drawn or measured."""
        return tuple(o for o in objects if self.has_model(o.obj_id))

    def models(self) -> Mapping[int, ObjectModel]:
        """Return all models, symmetric as the reviewers marked them."""
        from realsim.review.corrections import marked_models

        return marked_models(self.content().models, self.standing.state)

    def photographs(self) -> "Photographs":
        """Return who compares the photographs with the objects; made once."""
        from realsim.review.placing.photograph import Photographs

        content = self.content()
        with self._loading:
            if self._photographs is None:
                self._photographs = Photographs(content)
            return self._photographs

    def snapper(self) -> "Snapper":
        """Return who snaps objects onto the measured depth; made once for the same views."""
        from realsim.review.placing.snapping import Snapper

        content, standing = self.content(), self.standing
        excluded = tuple({*standing.state.excluded_views(), *content.damaged})
        scene = replace(standing.scene, objects=self.with_models(standing.scene.objects))
        with self._loading:
            if self._snapper is None or self._snapper[0] != excluded:
                made = Snapper(self.store, self.registered, content.models, excluded_views=excluded)
                self._snapper = (excluded, made)
            self._snapper[1].scene = scene
            return self._snapper[1]

    def residuals_m(self, objects: Sequence[ObjectPose]) -> Array32:
        """Return the signed distances (N,) of the measured points from the models [m].

        Args:
            objects: where they stand.
        """
        from realsim.review.placing.depth_residuals import CloudResiduals

        content = self.content()
        with self._measuring:
            if self._residuals is None:
                cache = self.store.folder / "registration" / "cache"
                folder = cache if cache.is_dir() and os.access(cache, os.W_OK) else None
                plane = self.registered.plane
                self._residuals = CloudResiduals(
                    content.cloud.points, folder=folder,
                    T_world_table=None if plane is None else plane.T_world_table,
                )  # fmt: skip
            objects = self.with_models(objects)
            Ts = np.array([o.T_world_obj for o in objects]).reshape(-1, 4, 4)
            meshes = [content.models[o.obj_id].mesh for o in objects]
            return self._residuals.against(Ts, meshes)


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
