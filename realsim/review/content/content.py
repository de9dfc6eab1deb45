"""What the review shows of a session, made once and shared by all browsers.

Nothing here knows of the browser.

Small photographs of the views, kept beside the session so that it opens quickly again.

SESSION/review/thumbnails/000012.jpg is an ordinary JPEG with a line after its end that says of
which photograph it was made, how, and its own checksum. One that is damaged, or of a photograph,
size or quality that is not asked for, is made anew. The folder can be deleted at any time.
"""

import hashlib
import json
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from realsim.arrays import Array, UInt8, evenly
from realsim.errors import InputError
from realsim.formats.bop.models import load_models, model_file, require_meshes
from realsim.formats.session_scene import notes_on_grasps
from realsim.images import resized
from realsim.interop import give_back_memory
from realsim.pages.pictures import jpeg_bytes
from realsim.records import CameraIntrinsics, GraspSet, ObjectModel, Scene, View
from realsim.review.content import clouds, quick_png
from realsim.review.content.clouds import LeveledCloud
from realsim.review.content.config import SceneConfig
from realsim.review.content.meshes import DisplayMesh, display_mesh
from realsim.review.content.views import FirstLook, Region, first_look, region_of
from realsim.store import SessionStore, atomic, load_grasps, load_scene
from realsim.store.manifest import Manifest
from realsim.store.results import grasps_on
from realsim.store.session_store import rgb_path

FOLDER = "review/thumbnails"
"""Where in a session they lie."""
WAY = 1
"""Version of the way they are made: others are made anew."""
MARK = b"\nrealsim "
"""Begins the line after the JPEG."""
JPEG_END = b"\xff\xd9"


class Thumbnails:
    """The small photographs of one session: kept ones where they are sound, else new ones."""

    def __init__(self, store: SessionStore, width_px: int, quality: int) -> None:
        """Look at what is kept lazily; nothing is read yet.

        Args:
            store: the session.
            width_px: their width [px].
            quality: JPEG quality [%].
        """
        self._folder = store.path(FOLDER)
        self._photographs = {v.index: store.path(rgb_path(v.index)) for v in store.session.views}
        listed = Manifest(store.folder).entries
        self._sums = {
            i: listed[rgb_path(i)].sha256 for i in self._photographs if rgb_path(i) in listed
        }
        self._width_px, self._quality = width_px, quality
        self._made: dict[int, bytes] = {}

    def take(self, index: int, rgb: UInt8) -> None:
        """Make that of a view whose photograph (H, W, 3) is decoded anyway, if none is kept."""
        if self.kept(index) is None:
            self._make(index, rgb)

    def kept(self, index: int) -> bytes | None:
        """Return the JPEG of a view that is made or kept already; None = there is none."""
        if index in self._made:
            return self._made[index]
        found = _read(self._file(index), self._origin(index))
        if found is not None:
            self._made[index] = found
        return found

    def of(
        self,
        indices: Sequence[int],
        damaged: dict[int, str],
        progress: Callable[[int, int], None] | None = None,
    ) -> Mapping[int, bytes]:
        """Return the JPEGs of views; those that are not kept are made, and kept.

        Args:
            indices: numbers of the views.
            damaged: is given view -> why for photographs that are missing or damaged; those of
                views that stand in it already are not read.
            progress: called with how many are done, of how many.
        """
        found: dict[int, bytes] = {}
        for done, index in enumerate(indices, 1):
            try:
                jpeg = self.kept(index)
                if jpeg is None and index not in damaged:
                    jpeg = self._make(index, quick_png.read_rgb(self._photographs[index]))
                if jpeg is not None:
                    found[index] = jpeg
            except InputError as error:
                damaged[index] = str(error)
            if progress is not None:
                progress(done, len(indices))
        return found

    def _make(self, index: int, rgb: UInt8) -> bytes:
        jpeg = thumbnail(rgb, self._width_px, self._quality)
        self._made[index] = jpeg
        # A session that may not be written is shown all the same.
        with suppress(OSError):
            data = jpeg + _line(jpeg, self._origin(index))
            atomic.write_bytes(self._file(index), data, flush=False)
        return jpeg

    def _file(self, index: int) -> Path:
        return self._folder / f"{index:06d}.jpg"

    def _origin(self, index: int) -> str:
        """Return what a thumbnail depends on; a photograph that is not listed is told by itself."""
        if index not in self._sums:
            path = self._photographs[index]
            if not path.is_file():
                raise InputError(
                    f"{path} does not exist; a photograph was expected there. `realsim check` "
                    "names what else is missing."
                )
            self._sums[index] = hashlib.sha256(path.read_bytes()).hexdigest()
        return f"{self._sums[index]} {self._width_px} {self._quality} {WAY}"


def thumbnail(rgb: UInt8, width_px: int, quality: int) -> bytes:
    """Return a photograph (H, W, 3) as a small JPEG.

    Args:
        rgb: the photograph.
        width_px: width of the JPEG [px].
        quality: of the JPEG [%].
    """
    return jpeg_bytes(resized(rgb, width_px), quality)


def _line(jpeg: bytes, origin: str) -> bytes:
    """Return what stands after the JPEG."""
    said = {"of": origin, "sha256": hashlib.sha256(jpeg).hexdigest()}
    return MARK + json.dumps(said).encode() + b"\n"


def _read(path: Path, origin: str) -> bytes | None:
    """Return a kept JPEG; None = there is none, or it is not what it should be."""
    try:
        data = path.read_bytes()
    except OSError:
        return None
    end = data.rfind(MARK)
    if end < 0 or not data[:end].endswith(JPEG_END):
        return None
    jpeg = data[:end]
    return jpeg if data[end:] == _line(jpeg, origin) else None


Progress = Callable[[int, int], None]
MISSING = "an image of it is missing; `realsim check` names the file."


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class SceneContent:
    """One registered session, ready to be shown."""

    store: SessionStore
    scene: Scene
    """As it was registered."""
    models: Mapping[int, ObjectModel]
    """By obj_id: all of the folder `models`, so that an object can be swapped for any."""
    meshes: "DisplayMeshes"
    """The models as the browser takes them, each made when it is first asked for."""
    views: tuple[View, ...]
    """Views with a camera pose."""
    shown_views: tuple[View, ...]
    """Those of them that are drawn: at most `SceneConfig.most_cameras`."""
    intrinsics: CameraIntrinsics
    region: Region
    """Where the objects are."""
    look: FirstLook
    """Where a new browser's camera stands."""
    cloud: LeveledCloud
    """The measured depth."""
    thumbnails: Mapping[int, bytes]
    """The photographs of the shown views as small JPEGs, by number of the view."""
    damaged: Mapping[int, str]
    """View -> why its images cannot be read; nothing is measured by it. One whose image is missing
    is not among the views."""
    grasp_sets: tuple[GraspSet, ...]
    """Grasp sets of the objects of the scene."""
    grasp_notes: tuple[str, ...]
    """What a person should know of grasps that were tried in another scene."""

    @staticmethod
    def load(
        store: SessionStore, config: SceneConfig, progress: Progress | None = None
    ) -> "SceneContent":
        """Return the content of a registered session.

        Args:
            store: the session.
            config: how much is shown.
            progress: called with how many photographs are ready, of how many.

        Raises:
            InputError: the session is not registered, it has neither objects nor views with a
                camera pose, or a model of its objects is missing.
        """
        scene = load_scene(store)
        views = tuple(v for v in store.session.views if v.T_world_cam is not None)
        if not views and not scene.objects:
            raise InputError(
                f"session '{store.session.name}' has no object and no view with a camera pose; "
                "calibrate and register it first."
            )
        models = SessionModels(store.folder / "models", {o.obj_id for o in scene.objects})
        region = region_of(scene.objects, views, config.margin_m)
        # World is a camera where a data set has no robot: up is the table's normal, not z.
        up = np.array([0.0, 0.0, 1.0])
        if scene.plane is not None:
            up = scene.plane.T_world_table[:3, 2].copy()
        shown = tuple(evenly(views, config.most_cameras))
        thumbnails = Thumbnails(store, config.thumbnail_px, config.thumbnail_quality)
        with_depth = [v for v in views if store.has_depth(v.index)]
        numbers = {v.index for v in shown}
        damaged = dict.fromkeys(store.incomplete, MISSING)

        def take(index: int, rgb: UInt8) -> None:
            if index in numbers:
                thumbnails.take(index, rgb)

        cloud = clouds.fused_cloud(
            store, evenly(with_depth, config.most_fused_views), region,
            voxel_m=config.voxel_m, most=config.most_points, coarse=config.coarse_points,
            damaged=damaged, on_photograph=take,
        )  # fmt: skip
        give_back_memory()
        return SceneContent(
            store=store, scene=scene, models=models, meshes=DisplayMeshes(models, config),
            views=views, shown_views=shown, intrinsics=store.session.intrinsics, region=region,
            look=first_look(region, views, up), cloud=cloud,
            thumbnails=thumbnails.of([v.index for v in shown], damaged, progress),
            damaged=damaged,
            grasp_sets=tuple(grasps_on(scene, load_grasps(store))),
            grasp_notes=tuple(notes_on_grasps(store, scene)),
        )  # fmt: skip

    def pose_of(self, view: int) -> Array:
        """Return T_world_cam (4, 4) of a view.

        Raises:
            InputError: there is no such view with a camera pose.
        """
        for v in self.views:
            if v.index == view and v.T_world_cam is not None:
                return v.T_world_cam
        raise InputError(
            f"view {view} has no camera pose; those with one are {_listed(self.views)}."
        )

    @property
    def remarks(self) -> list[str]:
        """Which views are left out because their images cannot be read, and notes on grasps."""
        left_out = [f"View {k} is left out: {why}" for k, why in sorted(self.damaged.items())]
        return [*left_out, *self.grasp_notes]

    def grasps_of(self, instance: int) -> GraspSet | None:
        """Return the grasps of an object; None = it has none."""
        return next((g for g in self.grasp_sets if g.instance == instance), None)


class SessionModels(Mapping[int, ObjectModel]):
    """The models of a BOP models folder by obj_id, each read once.

    A data set has tens of models and a scene a few of them; reading all would be most of the time
    that opening a scene takes. Which there are is known from the start.
    """

    def __init__(self, folder: Path, wanted: set[int]) -> None:
        """Read the models that are wanted for certain.

        Args:
            folder: of the models.
            wanted: obj_ids of the scene's objects.

        Raises:
            InputError: one of them has no mesh, or a file is damaged.
        """
        self._folder = folder
        files = {int(p.stem[4:]): p for p in folder.glob("obj_*.ply") if p.stem[4:].isdecimal()}
        self._ids = sorted(i for i, p in files.items() if p.name == model_file(i))
        missing = sorted(wanted - set(self._ids))
        if missing:
            raise InputError(
                f"the scene holds objects {', '.join(map(str, missing))}, but {folder} has no "
                f"model of them; it has {', '.join(map(str, self._ids)) or 'none'}. Copy their "
                "meshes there, or register the session again."
            )
        self._read = load_models(folder, wanted) if wanted else {}

    def __getitem__(self, obj_id: int) -> ObjectModel:
        """Return a model, reading it if it was not asked for before."""
        if obj_id not in self._read:
            if obj_id not in self._ids:
                raise KeyError(obj_id)
            # Two browsers may read it at once; they read the same, and one is kept.
            self._read.setdefault(obj_id, load_models(self._folder, [obj_id])[obj_id])
        return self._read[obj_id]

    def __contains__(self, obj_id: object) -> bool:
        """Return whether there is such a model, without reading it."""
        return obj_id in self._ids

    def __iter__(self) -> Iterator[int]:
        """Return the obj_ids in ascending order."""
        return iter(self._ids)

    def __len__(self) -> int:
        """Return how many models there are."""
        return len(self._ids)


class DisplayMeshes:
    """The models as they are sent; each is made once, when it is first asked for."""

    def __init__(self, models: Mapping[int, ObjectModel], config: SceneConfig) -> None:
        """Make nothing yet."""
        self._models, self._config = models, config
        self._made: dict[int, DisplayMesh] = {}

    def __getitem__(self, obj_id: int) -> DisplayMesh:
        """Return that of a model.

        Raises:
            InputError: there is no such model.
        """
        if obj_id not in self._models:
            require_meshes([obj_id], self._models, "the folder 'models' of the session")
        if obj_id not in self._made:
            # Two browsers may make it at once; they make the same, and one is kept.
            self._made.setdefault(obj_id, display_mesh(self._models[obj_id].mesh, self._config))
        return self._made[obj_id]


def _listed(views: Sequence[View]) -> str:
    numbers = [str(v.index) for v in views]
    return ", ".join(numbers if len(numbers) <= 12 else [*numbers[:6], "...", *numbers[-3:]])
