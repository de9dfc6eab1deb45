"""Benchmark of formats: speed of writing and opening, memory, round trips.

    uv run python benchmarks/formats.py [--quick] [--json FILE] [--seed N] [--part NAME]
                                        [--frames N]

Parts and the figures they give (keys of the JSON's "figures"):
  images   write_frames_per_s   colour and depth as PNG per CPU second at 1280x720, in files with
                                checksums; the slowest kind of frame
           jpeg_frames_per_s    colour as JPEG of quality 95, depth as PNG
           copy_frames_per_s    frames whose files have the format: copied byte for byte
           bytes_over_cv2       size over OpenCV's at its level 3, the worst kind of frame
  headers  bop_headers_s, graspnet_headers_s    opening a scene and asking for all frames: 1000 of
                                BOP, 256 of GraspNet, 15 objects each
           bop_list_s           `realsim import --list` of the BOP data set
  export   export_peak_mb, graspnet_export_peak_mb    memory of 100,000 frames beyond the imports
           resume_s, graspnet_resume_s    going on with an export that is all there
  trips    bop_round_trip_diff, graspnet_round_trip_diff    numbers and images that differ after
                                the way through a session; graspnet_meta_diff: in meta files
           bop_graspnet_mm, bop_graspnet_deg    BOP -> GraspNet -> BOP by the XML, the worst
           FORMAT_mm, FORMAT_deg    grasps written and read: acronym, graspgen, isaac, graspgroup

Real frames are measured too where REALSIM_DATA is. Damaged files are in `reliability.py`.
"""

import argparse
from collections.abc import Callable
from importlib import import_module

import blas_threads  # noqa: F401
from figures import Figure, Found, Goal, run
from formats_round_trips import BOUND_MM

PACKAGES = ("realsim", "numpy", "isal", "opencv-python-headless", "pillow", "h5py")
FIGURES = {
    "write_frames_per_s": Figure(unit="1/s", goal=Goal(low=15.0)),
    "jpeg_frames_per_s": Figure(unit="1/s", goal=Goal(low=40.0)),
    "copy_frames_per_s": Figure(unit="1/s"), "bytes_over_cv2": Figure(unit="x"),
    "bop_headers_s": Figure(unit="s", goal=Goal(high=2.0)), "bop_list_s": Figure(unit="s"),
    "graspnet_headers_s": Figure(unit="s"),
    "export_peak_mb": Figure(unit="MB", goal=Goal(high=1000.0)), "resume_s": Figure(unit="s"),
    "graspnet_export_peak_mb": Figure(unit="MB", goal=Goal(high=1000.0)),
    "graspnet_resume_s": Figure(unit="s"),
    "bop_round_trip_diff": Figure(unit="", goal=Goal(high=0.0)),
    "graspnet_round_trip_diff": Figure(unit="", goal=Goal(high=0.0)),
    "graspnet_meta_diff": Figure(unit=""),
    "bop_graspnet_mm": Figure(
        unit="mm", goal=Goal(high=BOUND_MM), rival="0.0866 by graspnetAPI's four decimals"
    ),
    "bop_graspnet_deg": Figure(unit="deg"), "acronym_mm": Figure(unit="mm"),
    "acronym_deg": Figure(unit="deg"), "graspgen_mm": Figure(unit="mm"),
    "graspgen_deg": Figure(unit="deg"), "isaac_mm": Figure(unit="mm"),
    "isaac_deg": Figure(unit="deg"), "graspgroup_mm": Figure(unit="mm"),
    "graspgroup_deg": Figure(unit="deg"),
}  # fmt: skip
"""All keys, in the table's order. In every run they are in the JSON."""


def part(module: str, function: str) -> Callable[[argparse.Namespace], Found]:
    """Return what imports and runs a part when its turn comes."""

    def call(arguments: argparse.Namespace) -> Found:
        loaded = import_module(module)
        if arguments.frames and hasattr(loaded, "FRAMES"):
            loaded.FRAMES = arguments.frames
        return getattr(loaded, function)(arguments.seed, arguments.quick)

    return call


def frames_option(parser: argparse.ArgumentParser) -> None:
    """Add how large the export is."""
    parser.add_argument("--frames", type=int, default=0, help="of the larger BOP export")


PARTS = {
    "images": part("formats_images", "write_speed"),
    "headers": part("formats_headers", "header_cost"),
    "export": part("formats_export", "export_memory"),
    "trips": part("formats_round_trips", "round_trips"),
}

if __name__ == "__main__":
    run("formats", __doc__ or "", PACKAGES, FIGURES, PARTS, options=frames_option)
