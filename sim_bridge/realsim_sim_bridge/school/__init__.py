"""Robot School: which grasps the arm reaches and physics holds, and how well."""

from realsim_sim_bridge.school.cache_folder import SchoolResult
from realsim_sim_bridge.school.config import SchoolConfig
from realsim_sim_bridge.school.school import run_school, run_school_results
from realsim_sim_bridge.slip.score import ScoreLimits, recompute_scores

__all__ = [
    "SchoolConfig",
    "SchoolResult",
    "ScoreLimits",
    "recompute_scores",
    "run_school",
    "run_school_results",
]
