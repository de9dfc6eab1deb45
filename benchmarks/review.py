"""Benchmark of the review: what a click and the opening of a scene cost the server.

    uv run python benchmarks/review.py [--quick] [--json FILE] [--seed N] [--part NAME]

The server runs in a process of its own on a session of 256 views of 1280x720, 8 objects and 5,000
grasps, which is made first; a client that speaks the browser's protocol opens it and clicks.
With --quick
the session has 96 views, and every kind is clicked twice. REVIEW_SESSION names such a session that
is there already; what its openings kept is deleted.

Parts and the figures they give (keys of the JSON's "figures"):
  opening  open_cpu_s          CPU of the server's process, from its start until a browser has been
                               sent the scene; nothing kept from earlier openings
           open_over_decoding  that over the CPU which decoding the photographs once with OpenCV
                               costs in the same run: a figure of one machine's mood the less
           open_warm_cpu_s     the same when the small photographs are kept
           open_mb, open_sent_mb    peak of the server's resident memory; bytes sent
  big      big_open_cpu_s, big_open_mb, big_sent_mb    the same with 2 million points and all
                               5,000 grasps drawn, nothing kept
  windows  windows_growth      resident memory after 60 more windows were opened and closed, one by
                               one, over that after the first
  clicks   click_ms            for how long a click keeps the server busy, the slowest kind of a
                               dozen, median of its repetitions; 100,000 points, 256 frustums
           click_median_ms     the median kind
           click_wall_ms       until the first bytes of the answer, the slowest kind
           click_first_wall_ms    the same of the first click of every kind, which also starts
                               preparing in the background for those that follow
  page     first_frame_s       from the address until the scene of 24 views is in the middle of a
                               window of 1280x800, in Chromium without a graphics card
           scene_share         share of this window that no panel covers
           report_first_photo_px    where the report's first picture begins
           console_errors      what the browser calls an error, on both pages
"""

import atexit

import blas_threads  # noqa: F401
from figures import Figure, Goal, run
from review_opening import clean_up

PACKAGES = ("realsim", "numpy", "viser", "websockets", "isal", "opencv-python-headless")
FIGURES = {
    "windows_growth": Figure(unit="x", goal=Goal(high=1.15)),
    "click_ms": Figure(unit="ms", goal=Goal(high=50.0)),
    "click_median_ms": Figure(unit="ms"),
    "click_wall_ms": Figure(unit="ms"),
    "click_first_wall_ms": Figure(unit="ms"),
    "open_cpu_s": Figure(unit="s", goal=Goal(high=3.0)),
    "open_over_decoding": Figure(unit="x", goal=Goal(high=1.0)),
    "open_warm_cpu_s": Figure(unit="s"),
    "open_mb": Figure(unit="MB", goal=Goal(high=400.0)),
    "open_sent_mb": Figure(unit="MB"),
    "big_open_cpu_s": Figure(unit="s", goal=Goal(high=4.5)),
    "big_open_mb": Figure(unit="MB", goal=Goal(high=400.0)),
    "big_sent_mb": Figure(unit="MB"),
    "first_frame_s": Figure(unit="s", goal=Goal(high=2.5)),
    "scene_share": Figure(unit="", goal=Goal(low=0.75)),
    "report_first_photo_px": Figure(unit="px", goal=Goal(high=900.0)),
    "console_errors": Figure(unit="", goal=Goal(high=0.0)),
}
PARTS = {
    "opening": "review_opening:opening",
    "clicks": "review_clicks:clicks",
    "big": "review_opening:big_scene",
    "windows": "review_opening:windows",
    "page": "review_page:page",
}

if __name__ == "__main__":
    atexit.register(clean_up)
    run("review", str(__doc__), PACKAGES, FIGURES, PARTS)
