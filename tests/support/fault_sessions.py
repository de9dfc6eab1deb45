"""The benchmark's sessions with faults, for tests: `faults.FAULTS`, `faults.draw_session`."""

import importlib.util
import sys
from pathlib import Path

ROOT = Path(__file__).parents[2]


def load_benchmark():
    spec = importlib.util.spec_from_file_location(
        "calibration_faults", ROOT / "benchmarks" / "calibration_faults.py"
    )
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module
    spec.loader.exec_module(module)
    return module


faults = load_benchmark()
