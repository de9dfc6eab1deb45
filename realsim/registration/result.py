"""What a registration returns."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from realsim.records import Scene
from realsim.registration.refinement.uncertainty import SeenPose
from realsim.registration.search.records import NotPlaced

Array = NDArray[np.float64]


class Finding(Protocol):
    """Something that is wrong with a view, or with the scene as a whole."""

    @property
    def kind(self) -> str:
        """What it is, in a word or two."""
        ...

    @property
    def words(self) -> str:
        """One or two sentences for a person."""
        ...


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Registration:
    """A registered scene, its baseline, and how it came about."""

    scene: Scene
    """Poses with covariance, checks, verdict, reasons; and the support plane."""
    single_view: Scene
    """The baseline: robust ICP in one reference frame, checked in the same way."""
    cameras: dict[int, Array]
    """View number -> (4, 4) T_world_cam; refined if the views allow it. Views that were left out
    are not in it."""
    seen: dict[int, dict[int, SeenPose]]
    """View number -> instance -> its pose in that view, with covariance and pixel uncertainty.
    Empty if cameras were not refined."""
    not_placed: tuple[NotPlaced, ...]
    """Objects that were wanted and not found, and why."""
    findings: tuple[Finding, ...]
    """What is wrong with views or with the scene."""
    report: Mapping[str, Any]
    """Plain JSON values: per object the search, the residuals, what was rejected; the cameras."""
