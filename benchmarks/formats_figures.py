"""What the figures of `formats.py` are, should be, and have as rivals."""

from figures import Figure, Goal
from formats_round_trips import BOUND_MM

FIGURES = {
    "write_frames_per_s": Figure(unit="1/s", goal=Goal(low=15.0)),
    "jpeg_frames_per_s": Figure(unit="1/s", goal=Goal(low=40.0)),
    "copy_frames_per_s": Figure(unit="1/s"),
    "bytes_over_cv2": Figure(unit="x"),
    "bop_headers_s": Figure(unit="s", goal=Goal(high=2.0)),
    "bop_list_s": Figure(unit="s"),
    "graspnet_headers_s": Figure(unit="s"),
    "mutated_files": Figure(unit=""),
    "mutated_tracebacks": Figure(unit="", goal=Goal(high=0.0)),
    "mutated_nan": Figure(unit="", goal=Goal(high=0.0)),
    "mutated_hangs": Figure(unit="", goal=Goal(high=0.0)),
    "mutated_memory": Figure(unit="", goal=Goal(high=0.0)),
    "mutated_crashes": Figure(unit="", goal=Goal(high=0.0)),
    "export_peak_mb": Figure(unit="MB", goal=Goal(high=1000.0)),
    "resume_s": Figure(unit="s"),
    "graspnet_export_peak_mb": Figure(unit="MB", goal=Goal(high=1000.0)),
    "graspnet_resume_s": Figure(unit="s"),
    "bop_round_trip_diff": Figure(unit="", goal=Goal(high=0.0)),
    "graspnet_round_trip_diff": Figure(unit="", goal=Goal(high=0.0)),
    "graspnet_meta_diff": Figure(unit=""),
    "bop_graspnet_mm": Figure(
        unit="mm", goal=Goal(high=round(BOUND_MM, 4)), rival=f"bound {BOUND_MM:.3f}"
    ),
    "bop_graspnet_deg": Figure(unit="deg"),
    "acronym_mm": Figure(unit="mm"),
    "acronym_deg": Figure(unit="deg"),
    "graspgen_mm": Figure(unit="mm"),
    "graspgen_deg": Figure(unit="deg"),
    "isaac_mm": Figure(unit="mm"),
    "isaac_deg": Figure(unit="deg"),
    "graspgroup_mm": Figure(unit="mm"),
    "graspgroup_deg": Figure(unit="deg"),
}
"""All keys, in the table's order. In every run they are in the JSON."""
