"""Benchmark of formats: speed of writing and opening, memory, damaged files, round trips.

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
  damage   mutated_files, and how many of them end in mutated_tracebacks, mutated_nan,
           mutated_hangs (> 5 s), mutated_memory (> 1 GB), mutated_crashes
  export   export_peak_mb, graspnet_export_peak_mb    memory of 100,000 frames beyond the imports
           resume_s, graspnet_resume_s    going on with an export that is all there
  trips    bop_round_trip_diff, graspnet_round_trip_diff    numbers and images that differ after
                                the way through a session; graspnet_meta_diff: in meta files
           bop_graspnet_mm, bop_graspnet_deg    BOP -> GraspNet -> BOP by four decimals, the worst
           FORMAT_mm, FORMAT_deg    grasps written and read: acronym, graspgen, isaac, graspgroup

Real frames are measured too where REALSIM_DATA is.
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
from formats_figures import FIGURES

from realsim.app.console import Console, cpu_seconds

PACKAGES = ("realsim", "numpy", "isal", "opencv-python-headless", "pillow", "h5py")
PARTS: dict[str, tuple[str, str]] = {
    "images": ("formats_images", "write_speed"),
    "headers": ("formats_headers", "header_cost"),
    "export": ("formats_export", "export_memory"),
    "trips": ("formats_round_trips", "round_trips"),
    "damage": ("formats_damage", "damage"),
}
"""Part -> module and function: imported when it runs."""


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
    parser.add_argument("--quick", action="store_true", help="fewer frames, fewer mutations")
    parser.add_argument("--seed", type=int, default=0, help="of noise, grasps and mutations")
    parser.add_argument("--frames", type=int, default=0, help="of the larger BOP export")
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
    if arguments.frames:
        import formats_export

        formats_export.FRAMES = arguments.frames
    for name in arguments.parts:
        start, cpu = time.perf_counter(), cpu_seconds()
        try:
            found.take(part_of(name)(arguments.seed, arguments.quick))
        except KeyboardInterrupt:
            sys.exit(130)
        except Exception as error:
            failures[name] = f"{type(error).__name__}: {error}"
            print(f"\n{name}:\n{traceback.format_exc()}", file=sys.stderr)
        console.warn(f"{name}: {time.perf_counter() - start:.0f} s, {cpu_seconds() - cpu:.0f} CPU")
    seconds = time.perf_counter() - begin
    print_table(console, "Formats", FIGURES, found)
    for name, why in failures.items():
        console.warn(f"the part {name} failed: {why}")
    console.say(f"{seconds:.0f} s, CPU {cpu_seconds():.0f} s, load {os.getloadavg()[0]:.1f}")
    if arguments.json:
        document = document_of("formats", PACKAGES, FIGURES, arguments, found)
        document |= {"wall_s": round(seconds, 1), "cpu_s": round(cpu_seconds(), 1),
                     "failures": failures}  # fmt: skip
        arguments.json.write_text(json.dumps(document, indent=1, default=str))
    if failures:
        sys.exit(1)


if __name__ == "__main__":
    main()
