"""What is to be upgraded: what the user asked for, the scenes of a data set, how they open."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from realsim.errors import InputError
from realsim.formats.bop.scene import BopSceneRef, find_scenes
from realsim.formats.graspnet.labelled import FIRST_TEST_SCENE, GraspnetSceneRef
from realsim.formats.graspnet.opening import is_graspnet_frame, open_graspnet_frame
from realsim.formats.graspnet.scene import CAMERAS, cameras_of
from realsim.formats.labelled_scene import LabelledScene
from realsim.many import Workers
from realsim.store.header import SESSION_FILE

Kind = Literal["auto", "bop", "graspnet"]
GRASPNET = (
    "scenes/scene_0000/{kinect,realsense}/camera_poses.npy is expected, or one image as color.png, "
    "depth.png and meta.mat."
)
GT = "gt"
"""Start poses: the data set's own annotations."""


@dataclass(frozen=True, kw_only=True, slots=True)
class UpgradeConfig:
    """How a data set is upgraded."""

    kind: Kind = "auto"
    """What the data set is; auto = found out from its files."""
    camera: str = ""
    """Which camera of a GraspNet scene: 'kinect' or 'realsense'; '' = all that are there."""
    start: str = GT
    """'gt' = the data set's own annotations, else a folder name under keyframe_poses/ (YCB-V)."""
    scenes: tuple[int, ...] = ()
    """Scene numbers; none = all."""
    models: Path | None = None
    """Folder of the models, when it is not DATASET/models."""
    views: int | None = None
    """At most so many images of each scene, spread evenly; None = all. GraspNet has 256, of which
    a registration needs a tenth."""
    grasps_per_object: int = 60
    """Grasp candidates tried on each object, at most."""
    analytic: int = 0
    """Analytic grasps tried on each object beside these, at most; 0 = none."""
    seed: int = 0
    """Seed of everything random."""
    where: Workers = None
    """Who upgrades scenes; of several each has one process, of one the grasps are divided."""

    def __post_init__(self) -> None:
        """Check what would be silently wrong.

        Raises:
            InputError: two requests that exclude each other.
        """
        if self.start != GT and self.kind == "graspnet":
            raise InputError(
                f"--start {self.start} reads keyframe_poses/, which GraspNet does not have; leave "
                "it away to start from the annotations."
            )

    def result_key(self) -> list[Any]:
        """Return the part of the request that a scene's result depends on."""
        return [
            self.start, self.views, self.grasps_per_object, self.analytic, self.seed,
        ]  # fmt: skip


@dataclass(frozen=True, kw_only=True, slots=True)
class SceneRef:
    """One scene seen by one camera, not opened yet."""

    kind: Literal["bop", "graspnet"]
    root: Path
    """Folder of the data set."""
    folder: Path
    """Folder of the scene; GraspNet: of its camera."""
    number: int
    camera: str
    """Which of several; '' = the scene has one."""
    place: str
    """SPLIT/SCENE, where the upgraded scene goes under OUT."""
    models: Path
    """Folder of the models."""


@dataclass(frozen=True, kw_only=True, slots=True)
class SceneJob:
    """One scene to be upgraded; goes to another process as it is."""

    ref: SceneRef
    config: UpgradeConfig
    out: Path
    """Folder of the whole upgrade."""
    workers: Workers
    """Who tries its grasps."""
    key: str
    """A hash of everything that the result depends on."""
    labels: tuple[str, ...]
    """Files of grasp labels in the data set."""
    at: SceneRef | None = None
    """Where the data set's files are on another machine; None = where `ref` says."""

    @property
    def given(self) -> SceneRef:
        """Where the data set's files are."""
        return self.at or self.ref

    @property
    def folder(self) -> Path:
        """Where the upgraded scene goes."""
        return self.out / self.ref.place


def scenes_of(dataset: Path, config: UpgradeConfig) -> list[SceneRef]:
    """Return the scenes that are asked for.

    Args:
        dataset: BOP root, split or scene; GraspNet root, scenes folder, scene or camera.
        config: kind, camera, scene numbers and models folder.

    Raises:
        InputError: there are none, or not those asked for.
    """
    kind = _kind_of(dataset, config.kind)
    refs = list(_graspnet(dataset, config)) if kind == "graspnet" else _bop(dataset, config)
    missing = sorted(set(config.scenes) - {r.number for r in refs})
    if missing:
        there = ", ".join(map(str, sorted({r.number for r in refs})))
        raise InputError(
            f"scene {', '.join(map(str, missing))} is not in '{dataset}'; it has {there}."
        )
    chosen = [r for r in refs if not config.scenes or r.number in config.scenes]
    _require_places(chosen)
    return chosen


def _kind_of(dataset: Path, asked: Kind) -> Kind:
    """Return what a data set is; BOP where nothing says GraspNet (BOP's reader says what lacks)."""
    if asked != "auto":
        return asked
    return "graspnet" if is_graspnet_frame(dataset) or _graspnet_cameras(dataset) else "bop"


def _require_places(refs: Sequence[SceneRef]) -> None:
    """Raise if two scenes would be written to one folder."""
    seen: dict[str, Path] = {}
    for ref in refs:
        if ref.place in seen:
            raise InputError(
                f"{seen[ref.place]} and {ref.folder} would both go to {ref.place}; upgrade them "
                "one by one into two folders."
            )
        seen[ref.place] = ref.folder


def _bop(dataset: Path, config: UpgradeConfig) -> list[SceneRef]:
    try:
        refs = find_scenes(dataset)
    except InputError as error:
        more = f" A GraspNet scene is not there either: {GRASPNET}" * (config.kind == "auto")
        raise InputError(f"{error}{more}") from error
    for r in refs:
        has_models = (config.models or _root(r) / "models").is_dir()
        if not has_models and (r.folder / SESSION_FILE).is_file():
            raise InputError(
                f"'{dataset}' is no data set: {r.folder} is a session of realsim, whose poses "
                f"`realsim register {r.folder}` finds. A BOP data set has SPLIT/000001/"
                "scene_camera.json and models/; `realsim export SESSION --to bop` makes one."
            )
    if config.camera:
        there = sorted({r.camera for r in refs if r.camera})
        refs = [r for r in refs if r.camera == config.camera]
        if not refs:
            raise InputError(
                f"'{dataset}' holds no BOP scene of the camera '{config.camera}'"
                + (f"; it has {', '.join(there)}." if there else ": its scenes name no camera. ")
                + ("" if there else "Leave --camera-name out.")
            )
    return [
        SceneRef(
            kind="bop", root=_root(r), folder=r.folder, number=r.scene_id,
            camera=r.camera, place=f"{r.split}{'_' * bool(r.camera)}{r.camera}/{r.folder.name}",
            models=config.models or _root(r) / "models",
        )
        for r in refs
    ]  # fmt: skip


def _root(ref: BopSceneRef) -> Path:
    """Return the folder that holds the splits (and usually the models)."""
    return ref.folder.parent.parent


def _graspnet_cameras(dataset: Path) -> list[Path]:
    """Return the camera folders of a GraspNet root, scenes folder, scene or camera folder."""
    if not dataset.is_dir():
        return []
    if dataset.name in CAMERAS and dataset.name in cameras_of(dataset.resolve().parent):
        return [dataset.resolve()]
    homes = [dataset, *sorted(dataset.glob("scene_*")), *sorted(dataset.glob("scenes/scene_*"))]
    return [(home / camera).resolve() for home in homes for camera in cameras_of(home)]


def _graspnet(dataset: Path, config: UpgradeConfig) -> Iterator[SceneRef]:
    """Return the scenes of a GraspNet tree; each camera's images are a scene of their own."""
    if is_graspnet_frame(dataset):
        models = config.models or dataset / "models"
        yield SceneRef(
            kind="graspnet", root=dataset, folder=dataset, number=0, camera="",
            place="train/000000", models=models,
        )  # fmt: skip
        return
    folders = _graspnet_cameras(dataset)
    if config.camera:
        folders = [f for f in folders if f.name == config.camera]
    if not folders:
        raise InputError(
            f"'{dataset}' holds no GraspNet scene"
            + (f" of the camera {config.camera}" if config.camera else "")
            + f": {GRASPNET}"
        )
    for folder in folders:
        scene = folder.parent
        digits = scene.name.removeprefix("scene_")
        if not digits.isdecimal():
            raise InputError(f"{scene} is not named scene_NUMBER, as GraspNet's scenes are.")
        root = scene.parent.parent
        split = "train" if int(digits) < FIRST_TEST_SCENE else "test"
        yield SceneRef(
            kind="graspnet", root=root, folder=folder, number=int(digits), camera=folder.name,
            place=f"{split}_{folder.name}/{int(digits):06d}",
            models=config.models or root / "models",
        )  # fmt: skip


def open_scene(ref: SceneRef) -> LabelledScene:
    """Open a scene; its images and models are read when they are asked for.

    Raises:
        InputError: something of it is missing or broken.
    """
    if is_graspnet_frame(ref.folder):
        return open_graspnet_frame(ref.folder, models=ref.models)
    if ref.kind == "graspnet":
        from realsim.formats.graspnet.opening import open_scene as open_graspnet

        models = ref.models if ref.models.is_dir() else None
        return open_graspnet(
            GraspnetSceneRef(number=ref.number, camera=ref.camera, folder=ref.folder, models=models)
        )
    from realsim.formats.bop.opening import open_labelled_scene

    wanted = [r for r in find_scenes(ref.folder) if r.camera == ref.camera]
    return open_labelled_scene(wanted[0], models=ref.models)
