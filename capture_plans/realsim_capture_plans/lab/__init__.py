"""The simulated lab: a UR5, a D405 and a table in software, with a truth nobody is told."""

from realsim_capture_plans.lab.lab import SimulatedLab
from realsim_capture_plans.lab.truth import LabConfig, LabTruth, load_truth

__all__ = ["LabConfig", "LabTruth", "SimulatedLab", "load_truth"]
