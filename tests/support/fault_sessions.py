"""Benchmarks that are tested: `faults.FAULTS`, `faults.draw_session`, `losses.fit_losses`."""

import importlib.util
import sys
from pathlib import Path

ROOT = Path(__file__).parents[2]


def load_benchmark(name):
    spec = importlib.util.spec_from_file_location(name, ROOT / "benchmarks" / f"{name}.py")
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module
    spec.loader.exec_module(module)
    return module


faults, losses = load_benchmark("calibration_faults"), load_benchmark("labels_losses")
