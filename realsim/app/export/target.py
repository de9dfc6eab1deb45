"""What a format is to `realsim export`: its name, its conventions, its writers.

What `realsim export` was asked for.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any, Literal

from realsim.errors import InputError
from realsim.formats.export_folder import ExportFolder
from realsim.formats.labelled_scene import LabelledScene, WrittenScene
from realsim.records import ObjectModel

Colour = Literal["copy", "png", "jpeg"]


@dataclass(frozen=True, kw_only=True, slots=True)
class ExportRequest:
    """Everything that an export depends on."""

    sources: tuple[Path, ...]
    """Sessions, folders of sessions, BOP or GraspNet data sets."""
    target: str
    """Format to write; see `realsim.app.export.run.TARGETS`."""
    labels: Literal["auto", "annotated", "imported", "none"] = "auto"
    """Which labels of sessions are taken."""
    scenes: tuple[int, ...] = ()
    """Numbers of scenes; none = all."""
    split: str = ""
    """BOP's split to write; '' = the source's own."""
    camera: str = ""
    """Camera of a source with several cameras, and the GraspNet folder to write."""
    models: Path | None = None
    """Models of a data set that has none beside it."""
    colour: Colour = "copy"
    """Colour images: copied as they are where the format allows it, or written anew."""
    jpeg_quality: int = 95
    """[%]: mean error of one grey level on real frames, a fifth of PNG's bytes."""
    masks: bool = True
    """Whether masks are written."""
    shards: bool = False
    """Whether a BOP export is written once more as tar shards."""
    undistort: bool = False
    """Write images as an ideal camera would have seen them; BOP and GraspNet are always so."""
    keep_distortion: bool = False
    """Write images of a distorted lens into a format whose readers know no distortion."""
    table_is_world: bool = False
    """Where no table is known: z = 0 of the world is the table."""
    points: int = 100_000
    """Coloured points in a COLMAP model, for programs that start from them; 0 = none."""
    least_score: float = 0.0
    """Least score of the grasps that an isaac file takes."""
    name: str = ""
    """Name of the data set, on its card; '' = of the folder."""
    licence: str = ""
    """Licence of the images and labels as it is to stand on the card."""
    models_licence: str = ""
    """Licence of the object models, likewise."""
    attribution: str = ""
    """Whom to name, or where it came from, likewise."""

    def __post_init__(self) -> None:
        """Check what a single value can tell.

        Raises:
            InputError: a source given twice, or a quality out of range.
        """
        seen: set[Path] = set()
        for source in self.sources:
            if source.resolve() in seen:
                raise InputError(f"'{source}' is given twice; its scenes would be there twice.")
            seen.add(source.resolve())
        if not 1 <= self.jpeg_quality <= 100:
            raise InputError(f"--jpeg-quality {self.jpeg_quality} cannot be; 1 to 100 is accepted.")
        if self.undistort and self.keep_distortion:
            raise InputError("--undistort and --keep-distortion contradict each other.")
        if self.points < 0:
            raise InputError(f"--colmap-points {self.points} cannot be; 0 or more is accepted.")

    def asked(self) -> dict[str, Any]:
        """Return the request as plain JSON values: what an interrupted export is recognised by."""
        values: dict[str, Any] = {f.name: getattr(self, f.name) for f in fields(self)}
        return values | {
            "sources": [str(s.resolve()) for s in self.sources],
            "scenes": list(self.scenes),
            "models": None if self.models is None else str(self.models.resolve()),
        }


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
