"""What is calibrated together: cameras, boards, instants, and which camera saw which board when.

    hand camera, board on the table    T_cam_board = X^-1 D_i^-1 A_i^-1 Z
    fixed camera, board in the hand    T_cam_board = X^-1 A_i D_i Z
    the two others                     T_cam_board = X^-1 Z           the arm does not matter
    a board moved by hand              as on the table, with a Z of every instant

X is the camera in the tool or in the base, Z the board in the base or in the tool, A_i the
controller's pose at an instant and D_i its error, which all cameras of the instant share.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from realsim.arrays import Array
from realsim.errors import InputError
from realsim.geometry import se3
from realsim.records import CameraIntrinsics, Target
from realsim_calibration.views import TargetDetection

Mount = Literal["hand", "fixed"]
Place = Literal["table", "hand", "free"]
PLACES = {"table": "on the table", "hand": "in the hand", "free": "moved by hand"}
MOUNTS = {"hand": "in the hand", "fixed": "standing still"}


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class RigCamera:
    """A camera and where it is mounted."""

    name: str
    mount: Mount
    intrinsics0: CameraIntrinsics | None = None
    """The camera as known before; None = calibrated from the same views."""


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class RigBoard:
    """A board and where it is."""

    name: str
    target: Target
    place: Place = "table"


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Instant:
    """A moment at which all that moves stands still; cameras see it at the same time."""

    name: str
    T_base_ee: Array | None = None
    """(4, 4) the controller's pose [m]; None = it is not known."""
    joints: Array | None = None
    """(n,) joint angles [rad]; None where they are not known."""

    def __post_init__(self) -> None:
        """Check the pose."""
        if self.T_base_ee is not None:
            T = se3.check_rigid(self.T_base_ee, f"T_base_ee of {self.name}")
            object.__setattr__(self, "T_base_ee", np.ascontiguousarray(T))


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Sighting:
    """One camera's image of one board at one instant."""

    camera: int
    board: int
    instant: int
    detection: TargetDetection
    name: str = ""
    """File name of the image."""


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Rig:
    """Everything that is seen together."""

    cameras: tuple[RigCamera, ...]
    boards: tuple[RigBoard, ...]
    instants: tuple[Instant, ...]
    sightings: tuple[Sighting, ...]

    def __post_init__(self) -> None:
        """Check names and numbers.

        Raises:
            InputError: no camera or board, a name twice, a number that is none, an image twice.
        """
        for what, parts in (("camera", self.cameras), ("board", self.boards)):
            names = [p.name for p in parts]
            if not names:
                raise InputError(f"cameras: no {what} was given; at least one is needed.")
            if len(set(names)) < len(names):
                raise InputError(f"cameras: two {what}s are called '{max(names, key=names.count)}'")
        seen: set[tuple[int, int, int]] = set()
        for s in self.sightings:
            key = (s.camera, s.board, s.instant)
            sizes = (len(self.cameras), len(self.boards), len(self.instants))
            if not all(0 <= k < n for k, n in zip(key, sizes, strict=True)):
                raise InputError(f"cameras: a sighting speaks of {key}, there are only {sizes}.")
            if key in seen:
                raise InputError(
                    f"cameras: camera '{self.cameras[s.camera].name}' sees board "
                    f"'{self.boards[s.board].name}' twice at {self.instants[s.instant].name}."
                )
            seen.add(key)

    def moves(self, camera: int, board: int) -> bool:
        """Return whether the arm moves a camera against a board that it does not carry itself."""
        in_hand = (self.cameras[camera].mount == "hand", self.boards[board].place == "hand")
        return in_hand[0] != in_hand[1]

    def only(self, sightings: Sequence[Sighting]) -> "Rig":
        """Return the rig with these sightings."""
        return replace(self, sightings=tuple(sightings))

    def of_camera(self, camera: int) -> list[Sighting]:
        """Return what a camera saw."""
        return [s for s in self.sightings if s.camera == camera]
