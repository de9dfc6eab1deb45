"""What is searched, where it may be, and what was found."""

from dataclasses import dataclass, field
from typing import Any

from realsim.arrays import Array


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Region:
    """Where an object may be, and how it may be turned."""

    center_world: Array
    """(3,) about where the centre of its box is [m]."""
    radius_m: float
    """How far the centre may be from there [m]."""
    R_world_obj: Array | None = None
    """(3, 3) about how it is turned; None = unknown."""
    turn_deg: float = 180.0
    """How far it may be turned from there [deg]."""


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Wanted:
    """One object instance that is to be found."""

    obj_id: int
    instance: int
    """Unique in the scene."""
    region: Region | None = None
    """None = anywhere on the table."""
    T_start: Array | None = None
    """(4, 4) T_world_obj that someone claims; it is tried besides everything else."""


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Hypothesis:
    """A pose that an object may have."""

    T_world_obj: Array
    """(4, 4)."""
    score: float
    """Score of whatever made it; only comparable with others of the same maker."""
    source: str
    """For the report: 'resting 2, yaw 30', 'start', 'residual 1'."""


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Placed:
    """An object that was found."""

    obj_id: int
    instance: int
    T_world_obj: Array
    """(4, 4)."""
    gain_px: float
    """By how many pixels (stride 1) the images are explained better with the object than without,
    all other objects in place."""
    gain_per_pixel: float
    """The same per rendered pixel that nothing else hides; 1 is the most."""
    agree: float
    """Share of these pixels whose depth agrees."""
    pixels: float
    """How many there are (stride 1, all frames)."""
    contrast: float | None = None
    """Difference of the likelihood to the best near-symmetric rival, per pixel that differs; None =
    there is no rival. Small = undecided."""
    T_rival: Array | None = None
    """(4, 4) that rival."""
    source: str = ""


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class NotPlaced:
    """An object that was not found, and why."""

    obj_id: int
    instance: int
    reason: str


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class SearchResult:
    """What a search found."""

    placed: tuple[Placed, ...]
    not_placed: tuple[NotPlaced, ...]
    report: dict[str, Any] = field(default_factory=dict[str, Any])
    """Plain JSON values: numbers of hypotheses, CPU seconds of each part."""
