"""What the figures of `scale.py` are and should be.

Imported by `scale.py`. A case that failed counts as an error of 1000 %, is not covered by its
interval, and is not 'accepted'.
"""

from collections.abc import Sequence
from dataclasses import asdict, dataclass, field
from typing import Any, Literal

import numpy as np
from figures import Figure, Goal, median_of, share_of

Kind = Literal["exact", "distorted", "cold"]
KINDS: tuple[Kind, ...] = ("exact", "distorted", "cold")
"""Exact mesh from a rough start; distorted from a rough start; distorted from no start."""
FAILED_PCT = 1000.0
"""Error of a case that failed [%]: beyond every limit."""
WRONG_PCT = 5.0
"""A cold result with a greater error should be flagged, one below it should not [%]."""
COVERING = 1.96

FIGURES = {
    "scale_median_pct_exact": Figure(unit="%", goal=Goal(high=0.25)),
    "within1pct_exact": Figure(unit="", goal=Goal(low=0.95)),
    "within2pct_exact": Figure(unit="", goal=Goal(low=1.0)),
    "worst_pct_exact": Figure(unit="%", goal=Goal(high=2.0)),
    "scale_median_pct_distorted": Figure(unit="%", goal=Goal(high=0.7)),
    "within2pct_distorted": Figure(unit="", goal=Goal(low=0.90)),
    "worst_pct": Figure(unit="%", goal=Goal(high=4.0)),
    "cold_median_pct": Figure(unit="%", goal=Goal(high=0.8)),
    "cold_within2pct": Figure(unit="", goal=Goal(low=0.88)),
    "cold_flagged_share": Figure(unit="", goal=Goal(low=1.0)),
    "false_alarm_share": Figure(unit="", goal=Goal(high=0.05)),
    "cpu_s_per_object": Figure(unit="s", goal=Goal(high=3.0)),
    "interval_coverage": Figure(unit="", goal=Goal(low=0.90, high=0.98)),
    "sfm_scale_pct": Figure(unit="%", goal=Goal(high=0.5)),
    "tsdf_median_mm": Figure(unit="mm", goal=Goal(high=0.8)),
}  # fmt: skip


@dataclass(frozen=True, kw_only=True, slots=True)
class Row:
    """One fit of one case, or the rival on it."""

    name: str
    seed: int
    kind: str
    """'exact', 'distorted', 'cold'; the rival's are 'open3d fused_exact' and so on."""
    error_pct: float = FAILED_PCT
    """Signed error of the scale [%]."""
    sigma_pct: float = float("nan")
    """What the fit says of it, 1-sigma [%]."""
    verdict: str = "failed"
    cpu_s: float = float("nan")
    failure: str = ""
    """What was raised; empty if nothing was."""
    said: dict[str, Any] = field(default_factory=dict[str, Any])
    """Reasons, checks, limits and notes of the fit."""

    @property
    def error(self) -> float:
        """The error without its sign [%]."""
        return abs(self.error_pct)

    @property
    def covered(self) -> bool:
        """Whether the truth lies in the fit's 95 % interval of the scale."""
        # error = s / true - 1 and sigma is a share of s.
        return self.error <= COVERING * self.sigma_pct * (1 + self.error_pct / 100)

    def plain(self) -> dict[str, Any]:
        """Return it as JSON values; what is not finite is null."""
        values = asdict(self)
        return {k: None if isinstance(v, float) and not np.isfinite(v) else v
                for k, v in values.items()} | {"covered": self.covered}  # fmt: skip


def figures_of(rows: Sequence[Row]) -> tuple[dict[str, float], dict[str, str]]:
    """Return the figures of all fits and rivals, and what each was taken over."""
    by: dict[str, list[Row]] = {}
    for row in rows:
        by.setdefault(row.kind, []).append(row)
    exact, distorted, cold = (by.get(kind, []) for kind in KINDS)
    errors: dict[Kind, list[float]] = {k: [r.error for r in by.get(k, [])] for k in KINDS}

    def within(kind: Kind, limit: float) -> float:
        return share_of([e <= limit for e in errors[kind]])

    wrong = [r for r in cold if r.error > WRONG_PCT]
    right = [r for r in cold if r.error <= WRONG_PCT]
    trusted = [r for r in cold if r.verdict == "accepted"]
    cpu = [r.cpu_s for r in (*exact, *distorted) if np.isfinite(r.cpu_s)]
    judged = [*exact, *distorted, *trusted]
    figures = {
        "scale_median_pct_exact": median_of(errors["exact"]),
        "within1pct_exact": within("exact", 1.0),
        "within2pct_exact": within("exact", 2.0),
        "worst_pct_exact": max(errors["exact"], default=float("nan")),
        "scale_median_pct_distorted": median_of(errors["distorted"]),
        "within2pct_distorted": within("distorted", 2.0),
        "worst_pct": max(errors["distorted"], default=float("nan")),
        "cold_median_pct": median_of(errors["cold"]),
        "cold_within2pct": within("cold", 2.0),
        "cold_flagged_share": share_of([r.verdict != "accepted" for r in wrong] or [True]),
        "false_alarm_share": share_of([r.verdict != "accepted" for r in right] or [False]),
        "cpu_s_per_object": median_of(cpu),
        "cpu_s_per_object_max": max(cpu, default=float("nan")),
        "cpu_s_cold": median_of([r.cpu_s for r in cold if np.isfinite(r.cpu_s)]),
        "interval_coverage": share_of([r.covered for r in judged]),
        "interval_coverage_exact": share_of([r.covered for r in exact]),
        "interval_coverage_distorted": share_of([r.covered for r in distorted]),
        "interval_coverage_cold": share_of([r.covered for r in trusted]),
        "accepted_exact": share_of([r.verdict == "accepted" for r in exact]),
        "accepted_distorted": share_of([r.verdict == "accepted" for r in distorted]),
        "failures": float(sum(bool(r.failure) for r in rows)),
    }
    over = {
        "cold_flagged_share": f"{len(wrong)} wrong by more than {WRONG_PCT:g} %",
        "false_alarm_share": f"{len(right)} right within {WRONG_PCT:g} %",
        "interval_coverage": f"{len(judged)} intervals",
        "interval_coverage_cold": f"{len(trusted)} accepted",
    }
    for view in ("fused", "topdown"):
        for kind in ("exact", "distorted"):
            part = [r.error for r in by.get(f"open3d {view}_{kind}", [])]
            key = f"open3d_{view}_median_pct"
            figures[key if kind == "exact" else f"{key}_distorted"] = median_of(part)
            figures[f"open3d_{view}_within2pct_{kind}"] = share_of([e <= 2.0 for e in part])
            over[key] = "exact shape, as scale_median_pct_exact"
    return figures, over


def told(rows: Sequence[Row]) -> list[str]:
    """Return a line an object with the errors of all seeds, and what failed; '!' = not accepted."""
    lines: list[str] = []
    for name in dict.fromkeys(r.name for r in rows):
        cells = [
            f"{r.kind} {r.error_pct:+.2f}" + ("" if r.verdict in ("accepted", "none") else "!")
            for r in rows
            if r.name == name
        ]
        lines.append(f"{name} [%]: {', '.join(cells)}")
    return lines + [f"{r.name}, seed {r.seed}, {r.kind} failed: {r.failure}"
                    for r in rows if r.failure]  # fmt: skip
