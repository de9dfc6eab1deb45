"""What the figures of `calibration.py` should be, and over how many trials they are taken."""

from dataclasses import dataclass

from figures import Goal

COVERED = Goal(low=0.93, high=0.97)
GOALS = {
    "heldout_ratio_geomean": Goal(low=5.5),
    "heldout_ratio_min": Goal(low=1.0),
    "rtde_px": Goal(high=0.40),
    "rosi_px": Goal(high=1.25),
    "muligheder_px": Goal(high=1.25),
    "swapped_px_ratio": Goal(high=1.25),
    "swapped_named_share": Goal(low=1.0, high=1.0),
    "koch_mm": Goal(high=1.65),
    "koch_median_mm": Goal(high=1.1),
    "solve_cpu_s": Goal(high=1.2),
    "crb_ratio": Goal(high=1.2),
    "coverage95": COVERED,
    "coverage95_white": COVERED,
    "coverage95_kinematic": COVERED,
    "coverage95_unknown_arm": COVERED,
    "faults_named_share": Goal(low=1.0, high=1.0),
    "corner_rms_px": Goal(high=0.10),
    "corner_rms_strong_px": Goal(high=0.22),
}


@dataclass(frozen=True, kw_only=True, slots=True)
class Size:
    """How much is run."""

    seeds: int
    """Seeds of the folds."""
    swapped_folds: int
    """Folds per seed with swapped poses."""
    trials: int
    """Coverage trials per robot."""
    crb_trials: int
    fault_trials: int
    """Sessions per fault."""
    corner_views: int
    """Pictures per target and level."""
    time_repeats: int
    koch_plain: int
    """Views of the pose set that are left out without joints as well."""


FULL = Size(
    seeds=4, swapped_folds=5, trials=200, crb_trials=40, fault_trials=10, corner_views=6,
    time_repeats=3, koch_plain=20,
)  # fmt: skip
QUICK = Size(
    seeds=1, swapped_folds=1, trials=6, crb_trials=1, fault_trials=1, corner_views=1,
    time_repeats=1, koch_plain=0,
)  # fmt: skip
