"""What a format is to `realsim export`: its name, its conventions, its writers."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Literal

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
    """Of its folder, in formats where a scene has one of its own."""
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
Models = Mapping[int, ObjectModel]
WriteRoot = Callable[[Sequence[WrittenScene], Models, ExportFolder, ExportRequest], None]
"""What belongs to the whole data set: (scenes, models of all scenes, folder, request)."""
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
    options: tuple[str, ...] = ()
    """Fields of the request that say something of this format; others are refused."""


IMAGES = ("labels", "camera", "undistort")
"""Options of every format that holds images."""
METRES = ("units", "metres")
OPENCV = ("camera axes", "OpenCV: x right, y down, z forward")
PIXEL = ("pixels", "integer coordinates are pixel centres")
