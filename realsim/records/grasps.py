"""What physics said of the grasps of one object.

What the arm did in each attempt at a grasp: joint angles over time.
"""

from collections.abc import Iterable
from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np

from realsim.arrays import Array, Int64, Mask
from realsim.errors import InputError
from realsim.geometry import se3
from realsim.records.checked_arrays import freeze, frozen

STAGES = ("close", "lift", "oscillate", "pendulum")
"""The four stages of the slip test, in order."""
FEW_DRAWS, LARGE_ERROR = 8, 0.1
"""With fewer draws or a larger standard error a p_hold is marked where it is shown."""


@dataclass(frozen=True, kw_only=True, slots=True)
class Measure:
    """What one column of a grasp set's measures says."""

    meaning: str
    unit: str = "1"
    by_stage: bool = False
    """True: one value a stage (N, 4); False: one a grasp (N,)."""
    is_share: bool = False
    """Whether its values are within [0, 1]: probabilities and shares of something."""


def _share(meaning: str) -> Measure:
    return Measure(meaning=meaning, is_share=True)


MEASURES = {
    "force_n": Measure(
        unit="N",
        meaning="least normal force of the weaker finger; NaN = not executed",
        by_stage=True,
    ),
    "duration_s": Measure(
        unit="s", meaning="time until the stage ended or the object was lost", by_stage=True
    ),
    "second_score": Measure(meaning="the score by the second engine"),
    "second_base_score": Measure(meaning="the base score by the second engine"),
    "second_slip_m": Measure(unit="m", meaning="slip by the second engine", by_stage=True),
    "second_slip_rad": Measure(unit="rad", meaning="turn by the second engine", by_stage=True),
    "confidence": _share("agreement of the two engines, 0 to 1: 1 - |difference of the scores|"),
    "least_friction": Measure(
        meaning="smallest friction at which all four stages are passed; inf = at none tried"
    ),
    "least_force_n": Measure(
        unit="N", meaning="smallest finger force at which all four stages are passed; inf likewise"
    ),
    "margin": _share("share of the swept frictions and forces at which it is passed"),
    "stiffness_share": Measure(
        meaning="share of the swept stiffnesses of the pads at which it is passed"
    ),
    "ferrari_canny": Measure(
        meaning="radius of the largest ball in the hull of the contact wrenches"
    ),
    "closure_friction": Measure(
        meaning="smallest friction of GraspNet's levels that closes; inf = none"
    ),
    "dexnet_closure": Measure(meaning="1 = force closure as Dex-Net tests it, 0 = none"),
    "score_paper": _share(
        "share of the stages passed in a row by the paper's limits, those of closing too"
    ),
    "safety": Measure(
        meaning="load that the closed grasp bears over the stage's peak load; close: the weight",
        by_stage=True,
    ),
    "p_hold": _share("probability that a robot lifts the object and holds it"),
    "p_hold_error": _share("standard error of p_hold by its draws"),
    "p_hold_draws": Measure(meaning="number of draws behind p_hold"),
    "share_blocked": _share("share of draws whose fingers touch while open"),
    "share_missed": _share("share of draws in which a pad meets nothing"),
    "share_skewed": _share("share of draws whose pads meet the object outside the friction cone"),
    "share_overloaded": _share(
        "share of draws in which a stage's load is greater than the grasp bears"
    ),
    "share_palm": _share("share of draws whose palm touches; it fails none"),
}
"""The columns that a grasp set may carry besides its score. NaN = not measured."""
LABEL_MEASURES = ("p_hold", "p_hold_error", "p_hold_draws", "safety")
"""What frames and episodes say of a grasp beside its score."""


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class GraspSet:
    """The grasp candidates of one object instance and what physics said of each.

    Frame `grasp`: origin between the fingertips, z = approach, y = closing axis.
    """

    obj_id: int
    instance: int
    Ts_obj_grasp: Array
    """(N, 4, 4) grasp in object [m]."""
    widths_m: Array
    """(N,) distance of the two contacts along the closing axis [m]."""
    scores: Array
    """(N,) in [0, 1]; NaN = not tried."""
    base_scores: Array
    """(N,) 0, 0.25, 0.5, 0.75 or 1: the stage reached; NaN = not tried."""
    slip_m: Array
    """(N, 4) slip relative to the gripper in each stage [m]; NaN = not executed, inf = lost."""
    slip_rad: Array
    """(N, 4) rotation relative to the gripper in each stage [rad]; NaN, inf likewise."""
    reachable: Mask
    """(N,) whether the arm has a collision-free trajectory to closure."""
    failures: tuple[str, ...]
    """(N,) why the grasp stopped where it stopped; '' = passed all."""
    measures: dict[str, Array] = field(default_factory=dict[str, Array])
    """What else was measured of each grasp, by the names of `MEASURES`."""
    parameters: dict[str, Any] = field(default_factory=dict[str, Any])
    """Everything the scores depend on, as plain JSON values."""

    def __post_init__(self) -> None:
        """Check that all arrays speak of the same grasps and freeze them."""
        T = np.asarray(self.Ts_obj_grasp, dtype=np.float64).reshape(-1, 4, 4)
        n = len(T)
        if n:
            T = se3.check_rigid(T, f"grasps of instance {self.instance}")
        object.__setattr__(self, "Ts_obj_grasp", frozen(T, np.float64, (n, 4, 4), "Ts_obj_grasp"))
        freeze(self, widths_m=(n,), scores=(n,), base_scores=(n,))
        for name in ("slip_m", "slip_rad"):
            value = np.asarray(getattr(self, name), dtype=np.float64).reshape(n, len(STAGES))
            object.__setattr__(self, name, frozen(value, np.float64, (n, len(STAGES)), name))
        freeze(self, np.bool_, reachable=(n,))
        object.__setattr__(self, "measures", _checked_measures(self.measures, n))
        if len(self.failures) != n:
            raise InputError(f"{len(self.failures)} failure notes for {n} grasps.")

    def __len__(self) -> int:
        """Return the number of grasps."""
        return len(self.Ts_obj_grasp)

    @property
    def hand(self) -> tuple[str, str]:
        """Name and digest of the hand that the grasps are of; without one they are Franka's."""
        config = self.parameters.get("config")
        told = config.get("hand") if isinstance(config, dict) else None
        return hand_named(told)

    @property
    def Ts_obj_pads(self) -> Array:
        """(N, 4, 4) the grasps, origin between the middles of the closed pads [m].

        The grasps themselves, but for hands whose pads run on an arc.
        """
        heights = self.parameters.get("pad_heights_m")
        if heights is None:
            return self.Ts_obj_grasp
        pads = np.array(self.Ts_obj_grasp)
        pads[:, :3, 3] += np.array(heights, dtype=np.float64)[:, None] * pads[:, :3, 2]
        return pads

    @property
    def label(self) -> Literal["p_hold", "score"]:
        """What the grasps are coloured, ranked and filtered by: p_hold if any has one."""
        known = self.measures.get("p_hold", np.zeros(0))
        return "p_hold" if np.any(~np.isnan(known)) else "score"

    @property
    def labels(self) -> Array:
        """(N,) value of `label` in [0, 1]; NaN = not known. Out of reach nothing is held: 0."""
        if self.label == "score":
            return self.scores
        p = self.measures["p_hold"]
        out_of_reach = ~self.reachable & (self.scores == 0)
        return np.where(np.isnan(p) & out_of_reach, 0.0, p)

    @property
    def unsure(self) -> Mask:
        """(N,) whether p_hold is known of too few draws, or with too large an error."""
        nothing = np.full(len(self), np.nan)
        few = self.measures.get("p_hold_draws", nothing) < FEW_DRAWS
        few |= self.measures.get("p_hold_error", nothing) > LARGE_ERROR
        return few & ~np.isnan(self.measures.get("p_hold", nothing))

    @property
    def good(self) -> Mask:
        """(N,) whether the grasp is good: score >= 0.5."""
        return np.nan_to_num(self.scores, nan=-1.0) >= 0.5


def joined_measure(sets: Iterable[GraspSet], name: str) -> Array:
    """Return a measure of all sets (N,) or (N, 4), one after the other; NaN = not measured."""
    stages = (len(STAGES),) * MEASURES[name].by_stage
    parts = [s.measures.get(name, np.full((len(s), *stages), np.nan)) for s in sets]
    return np.concatenate([np.zeros((0, *stages)), *parts])


def label_words(sets: Iterable[GraspSet]) -> str:
    """Return by what the grasps of several sets are coloured: 'p_hold', 'score', or both."""
    used = {s.label for s in sets if not np.all(np.isnan(s.labels))}
    return "p_hold, else score" if len(used) > 1 else "".join(used) or "score"


def hand_named(told: Any) -> tuple[str, str]:
    """Return name and digest of a hand as a set's parameters have it; "" = no digest."""
    known = told if isinstance(told, dict) else {}
    return str(known.get("name", "franka_hand")), str(known.get("digest", ""))


def require_one_hand(sets: Iterable[GraspSet], where: str) -> None:
    """Check that the sets are of one hand.

    Raises:
        InputError: they are of two; both are named.
    """
    hands = {s.hand: s.instance for s in sets}
    names = {name for name, _ in hands}
    told = [f"{name} ({digest[:8]})" if digest else name for name, digest in hands]
    versions = {digest for _, digest in hands if digest}
    if len(names) > 1 or len(versions) > 1:
        raise InputError(
            f"{where} mixes grasps of the hands {' and '.join(told)}; grasps of one hand are kept "
            "together. Run `realsim school` again with one --hand, or keep the others elsewhere."
        )


def _checked_measures(measures: dict[str, Array], n: int) -> dict[str, Array]:
    """Return the measures as private read-only arrays.

    Raises:
        InputError: one of an unknown name, or of another number of grasps.
    """
    checked: dict[str, Array] = {}
    for name, values in measures.items():
        if name not in MEASURES:
            known = ", ".join(MEASURES)
            raise InputError(f"'{name}' is no measure of a grasp; there are: {known}.")
        shape = (n, len(STAGES)) if MEASURES[name].by_stage else (n,)
        checked[name] = frozen(values, np.float64, shape, name)
    return checked


PHASES = ("reach", "approach", "close", "lift", "oscillate", "pendulum")
"""The parts of an attempt, in order: from home to the pre-grasp, straight on, and the stages."""


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class GraspTrajectories:
    """The attempts of one grasp set; samples of attempt a are starts[a] to starts[a + 1]."""

    rows: Int64
    """(A,) row of the grasp set that each attempt belongs to, increasing."""
    starts: Int64
    """(A + 1,) first sample of each attempt; the last is the number of samples."""
    time_s: Array
    """(S,) since the attempt's start [s], not decreasing within an attempt."""
    joints_rad: Array
    """(S, J) angles of the arm's joints [rad]."""
    opening_m: Array
    """(S,) commanded distance of the finger faces [m]."""
    phase: Int64
    """(S,) number in PHASES."""

    def __post_init__(self) -> None:
        """Check that everything fits together and freeze it."""
        joints = np.asarray(self.joints_rad, dtype=np.float64)
        if joints.ndim != 2:
            raise InputError(
                f"joints_rad has the shape {joints.shape}; (samples, joints) is expected."
            )
        n, s = len(self.rows), len(joints)
        freeze(self, np.int64, rows=(n,), starts=(n + 1,), phase=(s,))
        freeze(self, joints_rad=joints.shape, time_s=(s,), opening_m=(s,))
        for name in ("time_s", "opening_m", "joints_rad"):
            if not np.isfinite(getattr(self, name)).all():
                raise InputError(f"{name} of the attempts has NaN or infinite numbers.")
        if np.any(np.diff(self.rows) <= 0):
            raise InputError("the rows of attempts do not increase; each grasp has one attempt.")
        counts = np.diff(self.starts)
        if self.starts[0] != 0 or self.starts[-1] != s or np.any(counts < 0):
            raise InputError(
                f"the starts of {n} attempts do not cover their {s} samples from 0 to the end."
            )
        if s and not (self.phase.min() >= 0 and self.phase.max() < len(PHASES)):
            raise InputError(f"a phase is not one of 0 to {len(PHASES) - 1}: {', '.join(PHASES)}.")

    def __len__(self) -> int:
        """Return the number of attempts."""
        return len(self.rows)

    def attempt(self, row: int) -> slice | None:
        """Return the samples of a grasp set's row, or None if it was not attempted."""
        at = int(np.searchsorted(self.rows, row))
        if at == len(self.rows) or self.rows[at] != row:
            return None
        return slice(int(self.starts[at]), int(self.starts[at + 1]))
