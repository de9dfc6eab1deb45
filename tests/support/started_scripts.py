"""Scripts of a test's own that run in a process of their own, and may be killed."""

import os
import subprocess
import sys
from pathlib import Path


def started(folder: Path, script: str, *arguments: object) -> "subprocess.Popen[str]":
    """Start a script, which may import what lies in tests/support; its output can be read."""
    path = folder / "script.py"
    path.write_text(script)
    return subprocess.Popen(
        [sys.executable, path, *map(str, arguments)],
        env=os.environ | {"PYTHONPATH": str(Path(__file__).parent)},
        stdout=subprocess.PIPE,
        text=True,
    )
