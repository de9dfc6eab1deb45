"""What the figures of `school.py` are, should be, and have as rivals.

Imported by `school.py`.
"""

from figures import Figure, Goal

PAPER_GRASPS_PER_S = 100 * 2198 / (7 * 86400)
"""The paper: 100 scenes of 2198 candidates in a week on one RTX 6000."""


RATE = f"paper {PAPER_GRASPS_PER_S:.2f}, a GPU"
FIGURES = {
    "bullet_grasps_per_s": Figure(unit="1/s", goal=Goal(low=6.0), rival=RATE),
    "mujoco_grasps_per_s": Figure(unit="1/s", goal=Goal(low=40.0), rival=RATE),
    "mujoco_marginal_grasps_per_s": Figure(unit="1/s", goal=Goal(low=25.0)),
    "plans_per_s": Figure(unit="1/s core", goal=Goal(low=400.0)),
    "candidates_per_s": Figure(unit="1/s core", goal=Goal(low=5000.0)),
    "candidates_above_table_per_s": Figure(unit="1/s core", goal=Goal(low=5000.0)),
    "coulomb_worst_pct": Figure(unit="%", goal=Goal(high=3.0)),
    "torque_worst_pct": Figure(unit="%", goal=Goal(high=10.0)),
    "box_score": Figure(unit="", goal=Goal(low=1.0)),
    "box_slip_mm": Figure(unit="mm", goal=Goal(high=0.2)),
    "box_slip_deg": Figure(unit="deg", goal=Goal(high=0.5)),
    "light_convergence_share": Figure(unit="", goal=Goal(low=0.97)),
    "suite_checks_failed": Figure(unit="", goal=Goal(high=0.0)),
    "fast_agree_share": Figure(unit="", goal=Goal(low=0.96)),
    "engines_agree_share": Figure(unit="", goal=Goal(low=0.95)),
    "engines_agree_marginal_share": Figure(unit="", goal=Goal(low=0.87)),
    "marginal_dropped_share": Figure(unit="", goal=Goal(low=0.20, high=0.45)),
    "marginal_speed_dropped_share": Figure(unit="", goal=Goal(low=0.20, high=0.45)),
    "acronym_balacc": Figure(unit=""),
    "rank_margin_score": Figure(unit=""),
    "rank_margin_closure": Figure(unit=""),
    "rank_score_closure": Figure(unit=""),
    "workers_scaling": Figure(unit="x"),
    "ray_nodes_scaling": Figure(unit="x"),
}
"""All keys, in the table's order. In every run they are in the JSON."""
