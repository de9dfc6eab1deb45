"""Benchmark of capture: speed, import; kills and full disks are in `reliability.py`.

    uv run python benchmarks/capture.py [--quick] [--json FILE] [--part NAME]

Figures (keys of the JSON's "figures"):
  speed   capture_ms_per_view   CPU of a 1280x720 view beyond rendering, checks and files included;
          of which capture_checks_ms_per_view is all but storing; capture_wall_ms_per_view,
          capture_mb_per_view and what else `capture_speed` says
  import  import_mb_per_s   of a 500 MB bag per CPU second, PNG writing included
          import_peak_mb    greatest memory of the importing process; both the worst container's,
          and KIND_cpu_s ... of each
"""

import blas_threads  # noqa: F401
from figures import Figure, Goal, run

KINDS = ("ros1", "sqlite3", "mcap")
"""Containers of a recording."""
ROW = {
    "cpu_s": "s", "open_cpu_s": "s", "wall_s": "s", "peak_mb": "MB", "frames": "",
    "with_joints": "", "bag_mb": "MB", "mb_per_s": "MB/s",
}  # fmt: skip
"""What is measured of the import of each container."""
FIGURES = {
    "capture_ms_per_view": Figure(unit="ms", goal=Goal(high=40)),
    **{
        f"capture_{key}": Figure(unit=unit)
        for key, unit in {
            "checks_ms_per_view": "ms", "render_ms_per_view": "ms", "wall_ms_per_view": "ms",
            "mb_per_view": "MB", "frames_retaken": "", "views_noted": "",
        }.items()
    },
    "import_mb_per_s": Figure(unit="MB/s", goal=Goal(low=100)),
    "import_peak_mb": Figure(unit="MB", goal=Goal(high=500)),
    **{f"{kind}_{key}": Figure(unit=unit) for kind in KINDS for key, unit in ROW.items()},
}  # fmt: skip
PARTS = {"speed": "capture_speed:speed", "import": "capture_import:imports"}

if __name__ == "__main__":
    packages = ("realsim", "numpy", "opencv-python-headless", "rosbags", "isal")
    run("capture", __doc__, packages, FIGURES, PARTS)
