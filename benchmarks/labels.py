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

import os

for variable in ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ.setdefault(variable, "1")

import argparse
import json
import sys
import time
import traceback
from collections.abc import Callable
from importlib import import_module
from pathlib import Path

from figures import Found, document_of, print_table
from labels_figures import FIGURES

from realsim.app.console import Console

PACKAGES = (
    "realsim",
    "numpy",
    "numba",
    "open3d-cpu",
    "opencv-python-headless",
    "mitsuba",
    "pyoidn",
)
PARTS: dict[str, tuple[str, str]] = {
    "cost": ("labels_cost", "label_cost"),
    "exact": ("labels_exact", "exactness"),
    "pictures": ("labels_pictures", "picture_cost"),
    "stereo": ("labels_stereo", "stereo_cost"),
    "depth": ("labels_depth", "depth_real"),
    "real": ("labels_real", "real_masks"),
    "generate": ("labels_generate", "generate_cost"),
}
"""Part -> module and function: imported when it runs, because Mitsuba must come before others that
load the same compiler, and the peak of memory is that of the labels alone."""


def part_of(name: str) -> Callable[[int, bool], Found]:
    """Return the function that measures a part."""
    module, function = PARTS[name]
    return getattr(import_module(module), function)


def arguments_of() -> argparse.Namespace:
    """Return the command line."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawTextHelpFormatter
    )
    parser.add_argument("--json", type=Path, help="write the figures here")
    parser.add_argument("--quick", action="store_true", help="every figure from fewer frames")
    parser.add_argument("--seed", type=int, default=0, help="of materials and scenes")
    parser.add_argument(
        "--part", action="append", dest="parts", choices=list(PARTS), help="run this one alone"
    )
    arguments = parser.parse_args()
    arguments.parts = arguments.parts or list(PARTS)
    return arguments


def main() -> None:
    """Run the parts, print the table, write the JSON."""
    arguments = arguments_of()
    console = Console()
    begin = time.perf_counter()
    found = Found()
    failures: dict[str, str] = {}
    for name in arguments.parts:
        start = time.perf_counter()
        try:
            found.take(part_of(name)(arguments.seed, arguments.quick))
        except KeyboardInterrupt:
            sys.exit(130)
        except Exception as error:
            failures[name] = f"{type(error).__name__}: {error}"
            print(f"\n{name}:\n{traceback.format_exc()}", file=sys.stderr)
        console.warn(f"{name}: {time.perf_counter() - start:.0f} s")
    seconds = time.perf_counter() - begin
    print_table(console, "Labels and pictures", FIGURES, found)
    for name, why in failures.items():
        console.warn(f"the part {name} failed: {why}")
    console.say(f"{seconds:.0f} s, load {os.getloadavg()[0]:.1f}")
    if arguments.json:
        document = document_of("labels", PACKAGES, FIGURES, arguments, found)
        document |= {"wall_s": round(seconds, 1), "failures": failures}
        arguments.json.write_text(json.dumps(document, indent=1, default=str))
    if failures:
        sys.exit(1)


if __name__ == "__main__":
    main()
