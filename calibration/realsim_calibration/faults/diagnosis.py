"""Records of the convention test: what was tried, what fits, what is wrong and how to mend it."""

from dataclasses import dataclass
from typing import Literal

from realsim.arrays import Array, Int64
from realsim_calibration.results import Mode

Fault = Literal[
    "none", "unknown", "untestable",
    "duplicated_views", "frozen_pose", "repeated_image",
    "mispaired_image", "swapped_images", "shifted_pairing",
    "board_flips", "board_size", "board_unit", "board_moved",
    "robot_inverted", "camera_inverted", "rotation_reading",
    "degrees_as_radians", "radians_as_degrees", "robot_unit",
    "tool_offset", "tool_change", "camera_moved", "base_turned", "mirrored_axis",
]  # fmt: skip


SURE_SCORE = 1.0
"""Below this nothing else is tried: 0.5 deg and 1 % of the distance, RMS of the views."""
ACCEPT_SCORE = 5.0
"""A reading fits up to this score: real sets measure 1 to 2.5, wrong readings 10 to 20."""
GAIN = 2.0
"""Another reading must fit this many times better than the poses as given."""
GAIN_FEW = 3.0
"""The same with few views, where chance helps."""
GROSS_ERROR = 8.0
"""Single views are called mispaired from this error on: 4 deg or 8 % of the distance; planar
poses of good real sets reach 6."""
GAIN_GROSS = 1.15
"""The rest must then fit only this many times better."""
ACCEPT_DEGREES = 2.7
"""Degrees taken for radians are believed up to this score: each number may be any of 57."""
DOUBTFUL_SCORE = 1.5
"""Where no quick reading fits better than this, every pair of conventions is fitted."""
FEW_VIEWS = 8
"""Fewer views than this are few."""
TIE = 1.25
"""Readings whose scores are within this factor fit equally well: the simpler one is named."""
MAX_SIZE_RATIO = 1.07
"""A board this many times larger or smaller than said has another size; less is reported as a
scale: printers and intrinsics are off by up to 5 %."""
SIZE_SIGMAS = 5.0
"""The difference must be this many standard deviations."""
SAME_POSE_MM = 0.02
"""Poses nearer than this are one reading of the controller: arms at rest scatter more [mm]."""
SAME_POSE_DEG = 0.002
"""The same for the angle [deg]."""
SAME_VIEW = 0.5
"""Error below which images of one pose are one view, in the units of `fit_frames`."""
OTHER_VIEW = 2.0
"""Error above which they are different views."""
LEAST_TURN_DEG = 2.0
"""RMS turn about the second axis below which conventions cannot be tested [deg]."""
SMALL_TURN_PART = 0.2
"""Hand turns below this part of the camera's look like radians read as degrees."""
PLAUSIBLE_OFF_AXIS = 1.5
"""Camera poses are taken for inverted when the board would lie this many times further off the
optical axis than inverted."""
DECISIVE = 3.0
"""A reading of a pose file is proven when the next one fits this many times worse."""


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Evidence:
    """How well one reading of the data fits."""

    hypothesis: str
    rotation_mismatch_deg: float
    """Median over the pairs of the difference of the turns of hand and camera [deg]."""
    screw_ratio: float
    """Slide of the hand / slide of the camera along the screw axes; NaN = hardly any slide."""
    view_deg: float
    """Median rotation error of the views through the fitted frames [deg]."""
    view_mm: float
    """Median distance of the board's middle from where it should be [mm]."""
    length_ratio: float
    """The hand's lengths over the camera's; 1 for right data."""
    score: float
    """Both errors over all views, capped: below 1 good, beyond 5 it does not fit."""


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Diagnosis:
    """The most plausible single fault of a set of poses."""

    fault: Fault
    sentence: str
    """What was found, with the figures."""
    advice: str
    """What to do; empty where nothing is wrong."""
    views: tuple[int, ...]
    """Rows of the views that the fault concerns; empty = all of them."""
    labels: tuple[str, ...]
    """Their names."""
    evidence: tuple[Evidence, ...]
    """What was tried, as given first, then the best first."""
    length_ratio: float
    """The hand's lengths over the camera's under the reading that fits."""
    ratio_sd: float
    """1-sigma of it, relative."""
    repaired_base_ee: Array | None = None
    """(k, 4, 4) hand poses under the reading that fits; None where nothing can be mended. Use them
    only with a loud warning."""
    repaired_cam_board: Array | None = None
    """(k, 4, 4) the board poses that belong to them."""
    repaired_rows: Int64 | None = None
    """(k, 2) row of the given hand pose and of the given board pose of every repaired view."""
    note: str = ""
    """What the repair did."""

    @property
    def harmless(self) -> bool:
        """Whether a calibration of the data as given is right (though worth a note)."""
        return self.fault in (
            "none",
            "untestable",
            "duplicated_views",
            "tool_offset",
            "base_turned",
        )


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class ReadingFit:
    """How well one reading of a pose file fits, for one place of the camera."""

    name: str
    mode: Mode
    evidence: Evidence
    penalised: float
    """The score times 1 + |ln ratio| / ln 1.5: another unit fits as well but for its lengths."""


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class ReadingProof:
    """Which reading of a pose file fits the images."""

    fits: tuple[ReadingFit, ...]
    """Every candidate for both places of the camera, the best first."""
    best: str
    best_mode: Mode
    equivalent: tuple[str, ...]
    """Other readings that give the same poses as the best, "name (mode)"."""
    ratio: float
    """Penalised score of the next best of other poses over that of the best."""
    decisive: bool
    """Whether the best fits, and far better than that one."""
    mode_sure: bool
    """Whether the size of the frames tells where the camera sits."""
    sentence: str
