"""What `realsim plan` and `plan-convert` are asked for: arm, mount, surroundings, views."""

from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any, Literal

import numpy as np

from realsim.errors import InputError, UnitError
from realsim.robots.arm import find_arm
from realsim.robots.kinematics import DhChain
from realsim.robots.shapes import Box, Mount
from realsim_capture_plans.planning.record import PlanConfig

DEFAULT_VIEWS = {"hemisphere": 256, "calibration": 24}
DEFAULT_CENTER_M = (0.40, 0.0, 0.05)
"""Scene centre: 0.30-0.40 m in front of the base most views are reachable; z is above the table."""
LONGEST_M = 3.0
"""Lengths on the command line beyond this are not metres."""


@dataclass(frozen=True, kw_only=True, slots=True)
class Place:
    """Arm, mount and surroundings, as the command line gives them."""

    arm: str | None = None
    """Name or folder of the arm; None = what a path's own poses prove."""
    arm_calibration: Path | None = None
    """The controller's calibration.conf, or the YAML of ROS's ur_calibration."""
    mount: Path | None = None
    """Mount file; None is a D405 on the usual bracket."""
    center: str = ""
    """'x,y,z' of the scene's centre in base [m]."""
    table_height: float | None = None
    """z of the table's top in base [m]."""
    keep_out: str = ""
    """'x,y,z' size of the box that only the objects may fill [m]."""
    obstacles: Path | None = None
    """File of named boxes, see `collision.cell_files`."""

    def chain(self) -> DhChain | None:
        """Return the arm, calibrated if a file was given; None where none was named."""
        from realsim.robots.controller_file import read_controller_calibration

        if self.arm is None:
            if self.arm_calibration is not None:
                raise InputError(
                    f"--arm-calibration {self.arm_calibration} needs --arm: the file does not name "
                    "its model."
                )
            return None
        nominal = find_arm(self.arm).chain
        if self.arm_calibration is None:
            return nominal
        return read_controller_calibration(self.arm_calibration, nominal)

    def camera_mount(self) -> Mount:
        """Return the mount of the file, or the usual one."""
        from realsim_capture_plans.collision.cell_files import read_mount
        from realsim_capture_plans.collision.mount import d405_mount

        return d405_mount() if self.mount is None else read_mount(self.mount)

    def boxes(self) -> tuple[tuple[str, Box], ...]:
        """Return the named obstacles."""
        from realsim_capture_plans.collision.cell_files import read_work_cell_obstacles

        return () if self.obstacles is None else read_work_cell_obstacles(self.obstacles)

    def given_center(self) -> list[float]:
        """Return the scene's centre of the command line [m]."""
        return numbers(self.center, 3, "--center", "x,y,z in base [m]")

    def config(self, **changes: Any) -> PlanConfig:
        """Return the planner's numbers with what the command line changed."""
        if self.table_height is not None:
            if abs(self.table_height) > LONGEST_M:
                raise UnitError(
                    f"--table-height {self.table_height:g} m: is that in millimetres? It is the z "
                    "of the table's top in the robot's base, in metres."
                )
            changes["table_height_m"] = self.table_height
        if self.keep_out:
            x, y, z = numbers(self.keep_out, 3, "--keep-out", "sizes x,y,z [m]")
            changes["keep_out_m"] = changes["board_keep_out_m"] = (x, y, z)
        return PlanConfig(**changes)


def numbers(text: str, count: int, option: str, what: str) -> list[float]:
    """Return the lengths or angles of an option.

    Raises:
        InputError: not that many finite numbers.
        UnitError: lengths beyond any arm's reach.
    """
    try:
        found = [float(part) for part in text.split(",")]
    except ValueError:
        found = []
    if len(found) != count or not np.all(np.isfinite(found)):
        raise InputError(f"{option} '{text}': {count} numbers are needed, {what}.")
    if "[m]" in what and max(abs(v) for v in found) > LONGEST_M:
        metres = ",".join(f"{v / 1000:g}" for v in found)
        raise UnitError(f"{option} '{text}' is far out of reach in metres. Is it '{metres}'?")
    return found


@dataclass(frozen=True, kw_only=True, slots=True)
class PlanRequest:
    """A plan, as the command line asks for it."""

    place: Place
    """Arm, mount and surroundings."""
    views: int | None = None
    """Number of views; None is 256, or 24 of a board."""
    board: bool = False
    """Views of a board to calibrate with, instead of a scene."""
    radius: str = ""
    """'least,greatest' distance from camera to centre [m]."""
    elevation: str = ""
    """'least,greatest' elevation of the camera [deg]."""
    seed: int = 0
    """Draws the turn of the spiral and the via points."""
    out: Path = Path("plan.json")
    """The plan file."""
    overwrite: bool = False
    """Whether a plan of the same name is replaced."""
    no_pictures: bool = False
    """Whether the plan file is written alone."""

    @classmethod
    def of(cls, options: dict[str, Any]) -> "PlanRequest":
        """Return the request of the command line's options."""
        about = {f.name for f in fields(Place)}
        place = Place(**{k: v for k, v in options.items() if k in about})
        return cls(place=place, **{k: v for k, v in options.items() if k not in about})

    @property
    def kind(self) -> Literal["hemisphere", "calibration"]:
        """The plan's kind."""
        return "calibration" if self.board else "hemisphere"

    @property
    def count(self) -> int:
        """The number of views."""
        n = DEFAULT_VIEWS[self.kind] if self.views is None else self.views
        if n < 1:
            raise InputError(f"--views {n}: at least 1 view is needed.")
        return n

    def config(self) -> PlanConfig:
        """Return the planner's numbers with what the command line changed."""
        changes: dict[str, Any] = {}
        if self.radius:
            name = "board_distance_m" if self.board else "radius_m"
            changes[name] = tuple(
                numbers(self.radius.replace("-", ","), 2, "--radius", "least-greatest [m]")
            )
        if self.elevation:
            if self.board:
                raise InputError("--elevation is for views of a scene; a board's follow its tilt.")
            what = "least,greatest [degrees]"
            changes["elevation_deg"] = tuple(numbers(self.elevation, 2, "--elevation", what))
        return self.place.config(**changes)

    def center(self, config: PlanConfig) -> list[float]:
        """Return the scene's centre; that of a board lies on the table."""
        if self.place.center:
            return self.place.given_center()
        x, y, z = DEFAULT_CENTER_M
        return [x, y, config.table_height_m + (0.0 if self.board else z)]
