"""A session as a labelled scene: with the labels that were computed, or those it was imported with.

    SESSION/annotations/000000.json, mask/, mask_visib/   what `realsim annotate` wrote
    SESSION/imported/                                      what a data set said (`imported_labels`)

Frames keep the numbers that they had in the data set they were imported from.
"""

import re
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, Literal

import numpy as np

from realsim import images
from realsim.arrays import Array, Mask
from realsim.errors import InputError
from realsim.formats.bop.labels import mask_path
from realsim.formats.grasps.scene_grasps import SceneGrasps
from realsim.formats.imported_labels import ImportedLabels, load_imported
from realsim.formats.labelled_scene import LabelledFrame, LabelledObject
from realsim.geometry import se3
from realsim.records import GraspSet, ObjectModel, Scene
from realsim.records import bop_units as units
from realsim.store import SessionStore, load_grasps, load_scene
from realsim.store.results import grasps_on
from realsim.store.session_store import depth_path, rgb_path
from realsim.store.trajectories import load_trajectories

Labels = Literal["auto", "annotated", "imported", "none"]
SPLIT = re.compile(r"(train|val|test)(_\w+)?")
GT_INFO_KEYS = (
    "bbox_obj", "bbox_visib", "px_count_all", "px_count_valid", "px_count_visib", "visib_fract"
)  # fmt: skip


MOVED_M = 0.001
"""Objects that were moved by more than this since their grasps were tried are told of [m]."""


class SessionScene:
    """A `LabelledScene`; made by `open_session_scene`."""

    def __init__(
        self,
        session: tuple[SessionStore, Scene | None],
        *,
        number: int,
        split: str,
        imported: ImportedLabels | None,
        views: Mapping[int, int],
        notes: tuple[str, ...],
        is_annotated: bool,
        seen_by: tuple[str, SessionStore],
    ) -> None:
        """Take over a session; see `open_session_scene`."""
        self.store, self._scene = session
        self._camera, self._images = seen_by
        self._imported, self._views = imported, dict(views)
        self.number = number
        """The scene's number in its data set."""
        self.split = split
        """BOP's split."""
        self.camera = self._camera or ("" if imported is None else imported.camera)
        """The camera's name, here or in the data set it was imported from; '' = none."""
        self.indices = tuple(sorted(views))
        """Numbers of the images."""
        self.notes = notes
        """Which views and labels are taken."""
        self._is_annotated = is_annotated
        self._models: dict[int, ObjectModel] | None = None

    @property
    def name(self) -> str:
        """The session's folder, and the camera where it is a further one."""
        own = self.store.folder.resolve().name
        return own if self._images is self.store else f"{own}-{self._camera}"

    @property
    def T_world_table(self) -> Array | None:
        """(4, 4) supporting plane in world, z up [m]; None = not known."""
        if self._scene is not None and self._scene.plane is not None:
            return self._scene.plane.T_world_table
        return None if self._imported is None else self._imported.T_world_table

    @property
    def labels(self) -> Labels:
        """Where the poses of the objects come from."""
        if self._is_annotated:
            return "annotated"
        return "none" if self._imported is None else "imported"

    def _view(self, index: int) -> int:
        if index not in self._views:
            raise InputError(
                f"image {index} is not in {self._images.folder}; it has "
                f"{', '.join(map(str, self.indices[:12]))}."
            )
        return self._views[index]

    def frame(self, index: int) -> LabelledFrame:
        """Return one frame.

        Raises:
            InputError: there is no such image, or its labels are damaged.
        """
        number = self._view(index)
        session = self._images.session
        view = session.view(number)
        unit_m = session.depth_unit_m if self._images.has_depth(number) else None
        entry: Mapping[str, Any] | None = None
        objects: tuple[LabelledObject, ...] = ()
        if self._is_annotated:
            objects = self._annotated(number)
        elif self._imported is not None:
            objects = self._imported.objects(index)
            entry = self._imported.camera_entry(index)
        T = view.T_world_cam
        is_bop = entry is not None and "cam_K" in entry
        if is_bop and not self.store.has("registration/scene.json"):
            # The data set's own word, where it said nothing as well: what the import made up for it
            # is a place to begin from, not a label.
            T = units.T_world_cam_of(dict(entry or {}), f"image {index} of {self.name}")
        elif entry is not None and T is not None and not _says(entry, T):
            entry = None  # the camera was refined since
        return LabelledFrame(
            index=index, intrinsics=session.intrinsics, depth_unit_m=unit_m, objects=objects,
            T_world_cam=T, entry=entry,
        )  # fmt: skip

    def _annotated(self, view: int) -> tuple[LabelledObject, ...]:
        part = self._images.read_json(f"annotations/{view:06d}.json")
        try:
            return tuple(
                LabelledObject(
                    obj_id=int(e["obj_id"]), instance=int(e["instance"]),
                    T_cam_obj=np.asarray(e["T_cam_obj"], dtype=np.float64),
                    visible_fraction=float(e["visib_fract"]),
                    gt_info={key: e[key] for key in GT_INFO_KEYS},
                )
                for e in part["objects"]
            )  # fmt: skip
        except (KeyError, TypeError, ValueError) as error:
            raise InputError(
                f"annotations/{view:06d}.json of {self._images.folder} is damaged ({error!r}); run "
                "`realsim annotate` again."
            ) from error

    def colour_file(self, index: int) -> Path:
        """Return the file of the colour image."""
        return self._images.folder / rgb_path(self._view(index))

    def depth_file(self, index: int) -> Path | None:
        """Return the file of the 16-bit depth image; None = there is none."""
        view = self._view(index)
        return self._images.folder / depth_path(view) if self._images.has_depth(view) else None

    def mask(self, index: int, k: int, *, visible: bool) -> Mask | None:
        """Return the mask (H, W) of a frame's k-th object; None = there is none."""
        if self._is_annotated:
            path = self._images.folder / mask_path(self._view(index), k, visible=visible)
        elif self._imported is not None:
            path = self._imported.mask_file(index, k, visible=visible)
        else:
            return None
        return images.read_grey(path) > 0 if path.is_file() else None

    def models(self) -> Mapping[int, ObjectModel]:
        """Return the models of the session, by object id."""
        if self._models is None:
            from realsim.formats.bop.models import load_models

            folder, lacking = self.store.folder / "models", list[str]()
            has_any = folder.is_dir() and any(folder.glob("obj_*.ply"))
            self._models = load_models(folder, notes=lacking) if has_any else {}
        return self._models

    def grasps(self) -> SceneGrasps | None:
        """Return the grasps that were tried by physics on objects that are there; None = none."""
        scene = self._scene
        sets = [] if scene is None else grasps_on(scene, load_grasps(self.store))
        if scene is None or not sets:
            return None
        wanted = {s.instance for s in sets}
        attempts = {s.instance: load_trajectories(self.store, s) for s in sets}
        return SceneGrasps(
            sets=tuple(sets),
            name=scene.name,
            names={i: m.name for i, m in self.models().items()},
            trajectories={i: a for i, a in attempts.items() if a is not None},
            Ts_world_obj={o.instance: o.T_world_obj for o in scene.objects if o.instance in wanted},
            T_world_table=None if scene.plane is None else scene.plane.T_world_table,
        )


def notes_on_grasps(store: SessionStore, scene: Scene) -> Iterator[str]:
    """Yield what a person should know of grasps that were tried in another scene than this.

    Raises:
        InputError: a file of grasps is broken, or of a newer format.
    """
    tried = load_grasps(store)
    kept = grasps_on(scene, tried)
    again = f"run `realsim school {store.folder.name} --restart` and annotate again."
    if moved := _moved_since_tried(scene, kept):
        yield (
            f"the grasps of {len(moved)} object{'s' if len(moved) > 1 else ''} were tried where "
            f"they no longer stand (moved by up to {1e3 * max(moved):.1f} mm): {again}"
        )
    if gone := len(tried) - len(kept):
        yield (
            f"the grasps of {gone} object{'s' if gone > 1 else ''} stay out: they were tried on an "
            f"object that is another now, or no more there: {again}"
        )


def _moved_since_tried(scene: Scene, sets: Sequence[GraspSet]) -> list[float]:
    """Return how far objects have been moved on the table since their grasps were tried [m]."""
    if scene.plane is None:
        return []
    T_table_world = se3.invert(scene.plane.T_world_table)
    stands = {o.instance: T_table_world @ o.T_world_obj for o in scene.objects}
    moved: list[float] = []
    for tried in sets:
        then = np.array((tried.parameters.get("inputs") or {}).get("T_table_obj", np.nan))
        now = stands[tried.instance]
        if then.shape == (4, 4):
            corners = 0.05 * np.vstack([np.zeros(3), np.eye(3)])
            apart = se3.transform(now, corners) - se3.transform(then, corners)
            moved.append(float(np.linalg.norm(apart, axis=1).max()))
    return [d for d in moved if d > MOVED_M]


def open_session_scene(
    store: SessionStore,
    scene: Scene | None = None,
    *,
    labels: Labels = "auto",
    split: str = "",
    camera: str = "",
    seen_by: SessionStore | None = None,
) -> SessionScene:
    """Return a session as a labelled scene, as one of its cameras saw it.

    Args:
        store: the session.
        scene: its objects as reviewers left them; None = as they were registered, if they were.
        labels: 'annotated' = what `realsim annotate` wrote; 'imported' = what the data set said
            that the session was imported from; 'auto' = the former where it is there, else the
            latter; 'none' = images and cameras only.
        split: of the scene; '' = that of its data set, or 'train'.
        camera: what the camera is called; '' = the session has one.
        seen_by: a further camera (`store.cameras`) whose images are taken; None = the session's
            own.

    Raises:
        InputError: the labels that were asked for are not there, or are damaged.
    """
    images_of = seen_by or store
    views = [v.index for v in images_of.session.views]
    imported = load_imported(store) if seen_by is None else None
    annotated = [i for i in views if images_of.has(f"annotations/{i:06d}.json")]
    chosen = labels
    if labels == "auto":
        chosen = "annotated" if annotated else "imported" if imported is not None else "none"
    if chosen == "annotated" and not annotated:
        raise InputError(
            f"session '{store.folder}' is not annotated yet: run `realsim annotate {store.folder}`."
        )
    if chosen == "imported" and imported is None:
        raise InputError(
            f"session '{store.folder}' was not imported with labels; use --labels annotated after "
            "`realsim annotate`, or --labels none."
        )
    notes: list[str] = []
    taken = annotated if chosen == "annotated" else views
    if len(taken) < len(views):
        notes.append(
            f"{len(views) - len(taken)} of {len(views)} views have no labels and stay out: they "
            "were not registered, or a reviewer left them out."
        )
    if chosen == "imported" and imported is not None:
        notes.append("the labels are those it was imported with: realsim has not checked them.")
        notes += imported.notes
    if chosen == "none" and labels != "none":
        notes.append("it has no labels: images and cameras only.")
    if scene is None and store.has("registration/scene.json"):
        scene = load_scene(store)
    if scene is not None:
        notes += notes_on_grasps(store, scene)
    numbers = {i: i for i in views} if imported is None else imported.number_of_view
    return SessionScene(
        (store, scene),
        number=_number(store, imported),
        split=split or (imported.split if imported is not None else _split_of(store)),
        imported=imported if chosen != "none" else None,
        views={numbers.get(i, i): i for i in taken},
        notes=tuple(notes),
        is_annotated=chosen == "annotated",
        seen_by=(camera, images_of),
    )


def _number(store: SessionStore, imported: ImportedLabels | None) -> int:
    if imported is not None:
        return imported.number
    digits = store.folder.resolve().name.rpartition("_")[2]
    return int(digits) if digits.isdecimal() else 0


def _split_of(store: SessionStore) -> str:
    """Return the split that a session lies in, as `realsim upgrade` writes them; else 'train'."""
    above = store.folder.resolve().parent.name
    return above if SPLIT.fullmatch(above) else "train"


def _says(entry: Mapping[str, Any], T_world_cam: Array) -> bool:
    """Return whether a row of scene_camera.json says this pose."""
    T = units.T_world_cam_of(dict(entry), "camera")
    return T is not None and bool(np.abs(T - T_world_cam).max() < 1e-9)
