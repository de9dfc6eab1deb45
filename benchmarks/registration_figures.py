"""What the figures of `registration.py` are and should be.

Imported by `registration.py`. An object that was not found, or whose scene failed, counts as an
error beyond every limit; what crashed is named.
"""

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from typing import Any

import numpy as np
from figures import Goal, median_of, share_of

LOST_MM = 1000.0
"""Error of an object that was not found [mm]."""
RIGHT_MM = 3.0
"""A pose with a smaller MSSD is right [mm]."""
SEARCHED = ("rough", "cold", "unknown", "piles")
PROVOKED = (
    "slid", "turned", "near", "place", "absent", "judged slid", "judged turned", "judged place",
)  # fmt: skip
"""Wrong poses that are given as results; models that are wanted and not there."""

GOALS = {
    "mssd_mm_256": Goal(high=0.12), "mssd_p90_mm_256": Goal(high=0.3),
    "rough_share_under_3mm": Goal(low=0.98), "cold_share_under_3mm": Goal(low=0.96),
    "unknown_share_under_3mm": Goal(low=0.94), "false_object_share": Goal(high=0.01),
    "pile_share_under_3mm": Goal(low=0.88), "wrong_flagged_share": Goal(low=0.99),
    "false_alarm_share": Goal(high=0.05), "reproj_px_before": Goal(),
    "reproj_px_after": Goal(high=0.2), "reproj_p90_px_after": Goal(high=0.5),
    "camera_mm_after": Goal(high=0.2), "camera_deg_after": Goal(high=0.025),
    "biased_mssd_mm": Goal(high=0.22), "biased_reproj_px": Goal(high=0.25),
    "ratio_mssd_vs_topdown": Goal(low=20.0), "ratio_adds_vs_topdown": Goal(low=10.0),
    "total_cpu_s": Goal(high=25.0), "pile_cpu_s": Goal(high=60.0),
    "mesh_cache_cpu_s": Goal(high=2.0), "peak_mb": Goal(high=2000.0),
    "real_start_spread_mm": Goal(high=1.0), "real_start_spread_deg": Goal(high=0.5),
    "real_dz_mm_ours": Goal(), "real_dz_mm_truth": Goal(), "real_shift_named_share": Goal(low=1.0),
}  # fmt: skip


@dataclass(frozen=True, kw_only=True, slots=True)
class Row:
    """One object in one run."""

    seed: int
    part: str
    """'rough', 'cold', ..., 'rival p2l fine', ...; of `PROVOKED` a wrong pose that was given."""
    name: str
    """Name of the object."""
    mssd_mm: float = LOST_MM
    adds_mm: float = LOST_MM
    verdict: str = "not placed"
    extra: bool = False
    """It was found where it is not: a false object."""
    failure: str = ""
    """What was raised; empty if nothing was."""
    said: dict[str, Any] = field(default_factory=dict[str, Any])
    """Checks and reasons."""

    @property
    def right(self) -> bool:
        """Whether the pose is right."""
        return not self.extra and self.mssd_mm < RIGHT_MM

    def plain(self) -> dict[str, Any]:
        """Return it as JSON values."""
        return asdict(self)


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Done:
    """What came of a job."""

    rows: tuple[Row, ...] = ()
    samples: Mapping[str, Sequence[float]] = field(default_factory=dict[str, list[float]])
    """Figure -> values of views and objects, put together over all scenes."""
    figures: Mapping[str, float] = field(default_factory=dict[str, float])
    """Figures that are complete."""
    notes: tuple[str, ...] = ()
    """Sentences for a person."""


def _percentile_90(values: Sequence[float]) -> float:
    return float(np.percentile(values, 90)) if len(values) else float("nan")


def _of(rows: Sequence[Row], part: str) -> list[Row]:
    """Return the rows of one part that stand for an object of the scene."""
    return [r for r in rows if r.part == part and not r.extra]


def figures_of(
    rows: Sequence[Row], samples: Mapping[str, Sequence[float]]
) -> tuple[dict[str, float], dict[str, str]]:
    """Return the figures of all scenes, and what each was taken over."""
    refined = [r.mssd_mm for r in _of(rows, "refined")]
    figures = {"mssd_mm_256": median_of(refined), "mssd_p90_mm_256": _percentile_90(refined)}
    over = {"mssd_mm_256": f"{len(refined)} objects"}
    for part in SEARCHED:
        mine = _of(rows, part)
        key = f"{'pile' if part == 'piles' else part}_share_under_3mm"
        figures[key] = share_of([r.right for r in mine])
        wrong = sum(not r.right for r in mine)
        over[key] = f"{len(mine)} objects, {wrong} not right"
    unknown = [r for r in rows if r.part == "unknown" and r.verdict != "not placed"]
    figures["false_object_share"] = share_of([r.extra for r in unknown])
    over["false_object_share"] = f"{len(unknown)} objects found"
    figures |= _sampled(samples)
    biased = [r.mssd_mm for r in _of(rows, "biased")]
    figures["biased_mssd_mm"] = median_of(biased)
    over["biased_mssd_mm"] = f"{len(biased)} objects"
    _add_flags(rows, figures, over)
    _add_ratios(rows, figures, over)
    figures["failures"] = float(sum(bool(r.failure) for r in rows))
    return figures, over


def _sampled(samples: Mapping[str, Sequence[float]]) -> dict[str, float]:
    """Return the figures of views."""
    return {
        "reproj_px_before": median_of(samples.get("px_before", ())),
        "reproj_p90_px_before": _percentile_90(samples.get("px_before", ())),
        "reproj_px_after": median_of(samples.get("px_after", ())),
        "reproj_p90_px_after": _percentile_90(samples.get("px_after", ())),
        "camera_mm_before": median_of(samples.get("camera_mm_before", ())),
        "camera_deg_before": median_of(samples.get("camera_deg_before", ())),
        "camera_mm_after": median_of(samples.get("camera_mm_after", ())),
        "camera_deg_after": median_of(samples.get("camera_deg_after", ())),
        "biased_reproj_px": median_of(samples.get("biased_px_after", ())),
        "biased_camera_mm": median_of(samples.get("biased_camera_mm_after", ())),
        "biased_camera_deg": median_of(samples.get("biased_camera_deg_after", ())),
    }


def _add_flags(rows: Sequence[Row], figures: dict[str, float], over: dict[str, str]) -> None:
    """Add how verdicts and truth agree, over what was registered and what was provoked."""
    found = [r for r in rows if r.part in (*SEARCHED, "refined", "biased") and not r.failure]
    own = [r for r in found if not r.right]
    provoked = [r for r in rows if r.part in PROVOKED and not r.right and not r.failure]
    right = [r for r in found if r.right]
    flagged = [r.verdict != "accepted" for r in own]
    false = [r.verdict != "accepted" for r in provoked]
    figures["wrong_flagged_share"] = share_of([*flagged, *false])
    over["wrong_flagged_share"] = f"{len(own)} registered wrong and {len(provoked)} provoked"
    figures["wrong_flagged_share_registered"] = share_of(flagged)
    figures["wrong_flagged_share_provoked"] = share_of(false)
    for kind in PROVOKED:
        mine = [r.verdict != "accepted" for r in provoked if r.part == kind]
        key = f"flagged_share_{kind.replace(' ', '_')}"
        figures[key] = share_of(mine)
        over[key] = f"{len(mine)}"
    figures["false_alarm_share"] = share_of([r.verdict != "accepted" for r in right])
    over["false_alarm_share"] = f"{len(right)} right"
    for part in (*SEARCHED, "refined"):
        mine = [r.verdict != "accepted" for r in right if r.part == part]
        figures[f"false_alarm_share_{part}"] = share_of(mine)


def _add_ratios(rows: Sequence[Row], figures: dict[str, float], over: dict[str, str]) -> None:
    """Add every variant of the paper's way, and the best of them against the refined result."""
    variants = sorted({r.part for r in rows if r.part.startswith("rival ")})
    for variant in variants:
        mine = _of(rows, variant)
        key = variant.replace(" ", "_")
        figures[f"{key}_mssd_mm"] = median_of([r.mssd_mm for r in mine])
        figures[f"{key}_adds_mm"] = median_of([r.adds_mm for r in mine])
    refined = _of(rows, "refined")
    ours = median_of([r.mssd_mm for r in refined]), median_of([r.adds_mm for r in refined])
    figures["adds_mm_256"] = ours[1]
    for start in ("fine", "rough"):
        keys = [v.replace(" ", "_") for v in variants if v.endswith(start)]
        for n, error in enumerate(("mssd", "adds")):
            best = min((figures[f"{k}_{error}_mm"] for k in keys), default=float("nan"))
            name = f"ratio_{error}_vs_topdown" + ("" if start == "fine" else "_rough")
            figures[name] = best / ours[n] if ours[n] > 0 else float("nan")
            over[name] = f"best of {len(keys)} variants: {best:.3g} mm, from a {start} start"


def per_part(rows: Sequence[Row]) -> list[list[str]]:
    """Return a table: for every part and seed the objects, those not right, and the median."""
    table: list[list[str]] = []
    for part in dict.fromkeys(r.part for r in rows):
        for seed in sorted({r.seed for r in rows if r.part == part}):
            mine = [r for r in rows if r.part == part and r.seed == seed]
            true = [r for r in mine if not r.extra]
            wrong = [
                f"{r.name} {r.mssd_mm:.1f}{'' if r.verdict == 'accepted' else '!'}"
                for r in true if not r.right
            ]  # fmt: skip
            wrong += [f"false {r.name}" for r in mine if r.extra]
            if not part.startswith("rival"):
                wrong += [
                    f"({r.name} {r.verdict})"
                    for r in true if r.right and r.verdict != "accepted"
                ]  # fmt: skip
            text = ", ".join(wrong[:6]) + (f", {len(wrong) - 6} more" if len(wrong) > 6 else "")
            table.append([
                part, str(seed), str(len(true)), str(sum(r.right for r in true)),
                f"{median_of([r.mssd_mm for r in true]):.3f}",
                f"{_percentile_90([r.mssd_mm for r in true]):.3f}", text,
            ])  # fmt: skip
    return table
