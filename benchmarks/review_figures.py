"""What the figures of `review.py` are and should be."""

from figures import Figure, Goal

FIGURES = {
    "click_ms": Figure(unit="ms", goal=Goal(high=150.0)),
    "click_median_ms": Figure(unit="ms"),
    "click_wall_ms": Figure(unit="ms"),
    "click_first_wall_ms": Figure(unit="ms"),
    "open_cpu_s": Figure(unit="s", goal=Goal(high=5.0)),
    "open_over_decoding": Figure(unit="x", goal=Goal(high=1.0)),
    "open_warm_cpu_s": Figure(unit="s"),
    "open_mb": Figure(unit="MB", goal=Goal(high=600.0)),
    "open_sent_mb": Figure(unit="MB"),
    "big_open_cpu_s": Figure(unit="s", goal=Goal(high=5.0)),
    "big_open_mb": Figure(unit="MB", goal=Goal(high=600.0)),
    "big_sent_mb": Figure(unit="MB"),
}
