"""The process that is measured: the review's own server on a session.

    python review_server.py SESSION VOXEL_M MOST_POINTS SHOWN_POINTS

It says its address in one line of JSON, answers every line of its standard input with what it has
cost so far, and ends when that input does.
"""

import json
import sys
import time
from pathlib import Path

from realsim.review import ReviewServer
from realsim.review.content.config import SceneConfig
from realsim.store import SessionStore

KB_PER_MB = 1024


def main() -> None:
    """Serve until nobody holds the other end of the standard input."""
    folder, voxel_m, most, shown = sys.argv[1:]
    config = SceneConfig(voxel_m=float(voxel_m), most_points=int(most), shown_points=int(shown))
    server = ReviewServer(SessionStore.open(folder), port=0, reviewer="bench", config=config)
    server.start()
    print(json.dumps({"url": server.url}), flush=True)
    for _ in sys.stdin:
        # Not ru_maxrss: that one survives exec, so it would hold what made the session.
        status = Path("/proc/self/status").read_text("ascii", "replace")
        peak, now = (int(status.split(k)[1].split()[0]) / KB_PER_MB for k in ("VmHWM:", "VmRSS:"))
        cost = {"cpu_s": time.process_time(), "peak_mb": peak, "now_mb": now}
        print(json.dumps(cost), flush=True)
    server.stop()


if __name__ == "__main__":
    main()
