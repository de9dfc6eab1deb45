"""Benchmark of the review: what a click and the opening of a scene cost the server.

    uv run python benchmarks/review.py [--quick] [--json FILE] [--seed N] [--part NAME]

The server runs in a process of its own on a session of 256 views of 1280x720, 8 objects and 5,000
grasps, which is made first; a client that speaks the browser's protocol opens it and clicks.
REVIEW_SESSION names such a session that is there already; what its openings kept is deleted.

Parts and the figures they give (keys of the JSON's "figures"):
  opening  open_cpu_s          CPU of the server's process, from its start until a browser has been
                               sent the scene; nothing kept from earlier openings
           open_over_decoding  that over the CPU which decoding the photographs once with OpenCV
                               costs in the same run: a figure of one machine's mood the less
           open_warm_cpu_s     the same when the small photographs are kept (not with --quick)
           open_mb, open_sent_mb    peak of the server's resident memory; bytes sent
  big      big_open_cpu_s, big_open_mb, big_sent_mb    the same with 2 million points and all
                               5,000 grasps drawn, nothing kept
  clicks   click_ms            for how long a click keeps the server busy, the slowest kind of a
                               dozen, median of its repetitions; 100,000 points, 256 frustums
           click_median_ms     the median kind
           click_wall_ms       until the first bytes of the answer, the slowest kind
           click_first_wall_ms    the same of the first click of every kind, which also starts
                               preparing in the background for those that follow
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
from review_figures import FIGURES

from realsim.app.console import Console, cpu_seconds

PACKAGES = ("realsim", "numpy", "viser", "websockets", "isal", "opencv-python-headless")
PARTS: dict[str, tuple[str, str]] = {
    "opening": ("review_opening", "opening"),
    "clicks": ("review_clicks", "clicks"),
    "big": ("review_opening", "big_scene"),
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
    parser.add_argument("--quick", action="store_true", help="fewer clicks, no warm opening")
    parser.add_argument("--seed", type=int, default=0, help="of the session's noise and grasps")
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
    try:
        for name in arguments.parts:
            start, cpu = time.perf_counter(), cpu_seconds()
            try:
                found.take(part_of(name)(arguments.seed, arguments.quick))
            except KeyboardInterrupt:
                sys.exit(130)
            except Exception as error:
                failures[name] = f"{type(error).__name__}: {error}"
                print(f"\n{name}:\n{traceback.format_exc()}", file=sys.stderr)
            wall, cpu = time.perf_counter() - start, cpu_seconds() - cpu
            console.warn(f"{name}: {wall:.0f} s, {cpu:.0f} CPU")
    finally:
        import_module("review_opening").clean_up()
    seconds = time.perf_counter() - begin
    print_table(console, "Review", FIGURES, found)
    for name, why in failures.items():
        console.warn(f"the part {name} failed: {why}")
    console.say(f"{seconds:.0f} s, CPU {cpu_seconds():.0f} s, load {os.getloadavg()[0]:.1f}")
    if arguments.json:
        document = document_of("review", PACKAGES, FIGURES, arguments, found)
        document |= {"wall_s": round(seconds, 1), "cpu_s": round(cpu_seconds(), 1),
                     "failures": failures}  # fmt: skip
        arguments.json.write_text(json.dumps(document, indent=1, default=str))
    if failures:
        sys.exit(1)


if __name__ == "__main__":
    main()
