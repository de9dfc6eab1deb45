"""Benchmark of labels and pictures: cost, exactness, depth that looks like the sensor's.

    uv run python benchmarks/labels.py [--quick] [--json FILE] [--seed N] [--part NAME]

Parts and the figures they give (keys of the JSON's "figures"):
  cost      labels_over_cast_720p, labels_over_cast_1080p, labels_over_cast_distorted,
            labels_cpu_ms_720p, labels_cpu_ms_1080p, labels_peak_mb
                    complete label set of a frame (ids, amodal masks, visibility also beyond the
                    border, clean depth, object coordinates, normals) over one plain Open3D cast of
                    every pixel: 15 CAD meshes, 340,000 faces, 256 views
  exact     reproj_px_worst     hits through five lenses, projected again by OpenCV
            amodal_px_diff      amodal masks against renders of each object alone
            visible_px_diff_share   ids against Embree and against OpenGL, the worse of both
  pictures  rgb_cpu_s, photo_cpu_s      a frame at 1280x720, embedded and photoreal renderer
  stereo    stereo_over_labels          the stereo camera's depth over the complete label set
  depth     noise_ratio_real, holes_ratio_real
                    simulated over real, as a factor of 1 or more, the worst of all tested frames
                    (REALSIM_DATA)
  real      boundary_px_real
                    masks on real photographs from the nearest edge (REALSIM_DATA)
  generate  generate_frames_per_cpu_h   10 scenes x 256 views with all labels
"""

import argparse
from collections.abc import Callable
from importlib import import_module

import blas_threads  # noqa: F401
from figures import Figure, Found, Goal, run

PACKAGES = (
    "realsim", "numpy", "numba", "open3d-cpu", "opencv-python-headless", "mitsuba", "pyoidn",
)  # fmt: skip
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


def part(module: str, function: str) -> Callable[[argparse.Namespace], Found]:
    """Return a part that is imported when it runs.

    Mitsuba must come before others that load the same compiler, and the peak of memory is that of
    the labels alone.
    """
    return lambda a: getattr(import_module(module), function)(a.seed, a.quick)


PARTS = {
    "cost": part("labels_cost", "label_cost"),
    "exact": part("labels_exact", "exactness"),
    "pictures": part("labels_pictures", "picture_cost"),
    "stereo": part("labels_stereo", "stereo_cost"),
    "depth": part("labels_depth", "depth_real"),
    "real": part("labels_real", "real_masks"),
    "generate": part("labels_generate", "generate_cost"),
}

if __name__ == "__main__":
    run("labels", __doc__, PACKAGES, FIGURES, PARTS)
