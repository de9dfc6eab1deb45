"""Benchmark of capture: speed, kills and full disks, import; the three scripts one after the other.

    uv run python benchmarks/capture.py [--quick] [--json FILE]

Figures (keys of the JSON's "figures"), goals in brackets:
  capture_ms_per_view  CPU of a 1280x720 view beyond rendering, checks and files included (<= 40)
  kills, kills_with_loss   SIGKILLs at random moments, and those that lost a sealed view (60, 0)
  import_mb_per_s      of a 500 MB bag per CPU second, PNG writing included (>= 100)
  import_peak_mb       greatest memory of the importing process (< 500)
and what `capture_speed.py`, `capture_kills.py` and `capture_import.py` print besides.
"""

import argparse
import json
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

PARTS = ("capture_speed", "capture_kills", "capture_import")
KEYS = (
    "capture_ms_per_view", "kills", "kills_with_loss", "import_mb_per_s", "import_peak_mb",
)  # fmt: skip


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--quick", action="store_true", help="fewer views, kills and bytes")
    parser.add_argument("--json", type=Path)
    args = parser.parse_args()
    figures: dict[str, Any] = {}
    parts: dict[str, Any] = {}
    with tempfile.TemporaryDirectory() as folder:
        for part in PARTS:
            file = Path(folder) / f"{part}.json"
            script = Path(__file__).with_name(f"{part}.py")
            command = [sys.executable, str(script), "--json", str(file)]
            subprocess.run([*command, *(["--quick"] if args.quick else [])], check=True)
            parts[part] = json.loads(file.read_text())
            figures |= parts[part]["figures"]
    print()
    for key in KEYS:
        print(f"{key:<22} {figures[key]:.4g}")
    if args.json:
        document = {"benchmark": "capture", "figures": figures, "parts": parts}
        args.json.write_text(json.dumps(document, indent=2))


if __name__ == "__main__":
    main()
