"""What a format is to `realsim export`: its name, its conventions, its writers."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal

from realsim.app.export.request import ExportRequest
from realsim.formats.export_folder import ExportFolder
from realsim.formats.labelled_scene import LabelledScene, WrittenScene
from realsim.records import ObjectModel

Progress = Callable[[], None]


@dataclass(frozen=True, kw_only=True, slots=True)
class ScenePlace:
    """Where a scene stands in the export."""

    number: int
    name: str
    """Name of the scene's folder, in formats where a scene has one of its own."""
    camera: str
    """Where several cameras saw this scene; else ''."""


@dataclass(frozen=True, kw_only=True, slots=True)
class SceneJob:
    """What a writer is told of one scene."""

    request: ExportRequest
    place: ScenePlace
    tick: Progress
    """Called once a frame."""


WriteScene = Callable[[LabelledScene, ExportFolder, SceneJob], WrittenScene]


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class RootJob:
    """What a writer is told of the whole data set, when all scenes are there."""

    request: ExportRequest
    models: Mapping[int, ObjectModel]
    """Models of all scenes, by object id."""
    infos: Mapping[int, Mapping[str, Any]]
    """BOP's own rows of models_info.json, where the sources have them."""
    scenes: Sequence[tuple[int, Callable[[], LabelledScene]]] = ()
    """Number of each scene in the export, and what opens it again."""


WriteRoot = Callable[[ExportFolder, RootJob], Sequence[str]]
"""Returns what a person should know."""
Conventions = Sequence[tuple[str, str]]


@dataclass(frozen=True, kw_only=True, slots=True)
class Target:
    """One format."""

    name: str
    """As people call it."""
    kind: Literal["dataset", "cameras", "scene", "grasps"]
    help: str
    conventions: Conventions
    loading: str
    """Python that opens it; {scene} is the folder of the first scene."""
    write_scene: WriteScene
    write_root: WriteRoot | None = None
    is_pinhole: bool = False
    """Whether its readers know no lens: images are undistorted unless they are to be kept."""
    no_place: tuple[str, ...] = ()
    """What the format has no place for, of TABLE and TRIED: it is told where a scene has it."""
    holds_grasps: bool = False
    """Whether grasps tried by physics go along."""
    holds_cameras: bool = False
    """Whether a scene may be there as several cameras saw it."""
    options: tuple[str, ...] = ()
    """Fields of the request that say something of this format; others are refused."""


IMAGES = ("labels", "camera", "undistort")
"""Options of every format that holds images."""
LABELLED = (*IMAGES, "models", "masks", "keep_distortion")
"""Options of every format that holds images with labels."""
METRES = ("units", "metres")
OPENCV = ("camera axes", "OpenCV: x right, y down, z forward")
PIXEL = ("pixels", "integer coordinates are pixel centres")
TABLE, TRIED = "the table's pose", "grasps tried by physics"
"""What a scene may have beside images, poses and models."""
