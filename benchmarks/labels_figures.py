"""What the figures of `labels.py` are, should be, and have as rivals."""

from figures import Figure, Goal

PAPER_FRAMES_PER_GPU_H = 100 * 256 / (7 * 24)
"""The paper: 100 scenes of 256 views in a week on one RTX 6000, grasps included."""
FIGURES = {
    "labels_over_cast_720p": Figure(unit="x", goal=Goal(high=0.75)),
    "labels_over_cast_1080p": Figure(unit="x", goal=Goal(high=0.75)),
    "labels_over_cast_distorted": Figure(unit="x"),
    "labels_cpu_ms_720p": Figure(unit="ms"),
    "labels_cpu_ms_1080p": Figure(unit="ms"),
    "labels_peak_mb": Figure(unit="MB", goal=Goal(high=1500.0)),
    "reproj_px_worst": Figure(unit="px", goal=Goal(high=1e-3)),
    "amodal_px_diff": Figure(unit="px", goal=Goal(high=0.0)),
    "visible_px_diff_share": Figure(unit="", goal=Goal(high=1e-4)),
    "rgb_cpu_s": Figure(unit="s", goal=Goal(high=2.0)),
    "photo_cpu_s": Figure(unit="s", rival="prototype 12"),
    "stereo_over_labels": Figure(unit="x", goal=Goal(high=5.0)),
    "noise_ratio_real": Figure(unit="x", goal=Goal(high=1.5)),
    "holes_ratio_real": Figure(unit="x", goal=Goal(high=1.5)),
    "boundary_px_real": Figure(unit="px"),
    "generate_frames_per_cpu_h": Figure(
        unit="1/h", rival=f"paper {PAPER_FRAMES_PER_GPU_H:.0f} per GPU hour, grasps included"
    ),
}
"""All keys, in the table's order. In every run they are in the JSON."""
