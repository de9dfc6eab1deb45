"""How a data set is upgraded: what the user asked for."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from realsim.errors import InputError

Kind = Literal["auto", "bop", "graspnet"]
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
    workers: int = 2
    """Processes in the Robot School where one scene is upgraded at a time."""
    scene_workers: int | None = None
    """Scenes upgraded at a time; None = one a core. More than one: each has one process."""

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
