"""Analytic grasps as what the School tries: labels of an object, those that stand, a few of them.

GraspNet's labels say from which friction on a grasp closes. The School says what becomes of it.
"""

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from realsim.formats.graspnet.grasp_labels import read_grasp_labels
from realsim_sim_bridge.grasping.analytic import analytic_labels
from realsim_sim_bridge.grasping.analytic_config import AnalyticConfig
from realsim_sim_bridge.grasping.analytic_given import given_candidates, standing_labels
from realsim_sim_bridge.grasping.analytic_select import select_rows
from realsim_sim_bridge.grasping.candidates import Candidates

if TYPE_CHECKING:
    from realsim_sim_bridge.school.object_task import ObjectTask

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class AnalyticGrasps:
    """Labels of one object that the School tries where it stands."""

    candidates: Candidates
    closure_friction: Array
    """(N,) of the label: the smallest of its friction levels that closes."""
    counts: dict[str, Any]
    """How many labels there were after each step, where they came from, and which label each
    grasp is (point, view, angle, depth)."""


def analytic_grasps(
    task: "ObjectTask", config: AnalyticConfig, rng: np.random.Generator
) -> AnalyticGrasps:
    """Return labels of an object, spread over it and over the friction levels, that stand free.

    They are read where the task names a file, else computed.

    Raises:
        InputError: the file is not one of labels, or the mesh has no area.
    """
    most = max(config.levels)
    if task.labels_file is not None:
        labels = read_grasp_labels(task.labels_file, friction_at_most=most)
    else:
        labels = analytic_labels(task.mesh, rng, config)
    school = task.config
    where = (task.mesh, task.T_table_obj, task.neighbours)
    standing = standing_labels(labels, *where, school.candidates, school.hand, rng)
    chosen = standing.rows(select_rows(standing, school.max_candidates, rng))
    found, rows = given_candidates(*where, chosen.Ts_obj_grasp(), school.candidates, school.hand)
    return AnalyticGrasps(
        candidates=found,
        # Files of labels keep single precision: 0.4 comes back as 0.4.
        closure_friction=np.round(chosen.friction.astype(np.float64), 6)[rows],
        counts={
            "from": label_name(task.labels_file),
            "labels": len(labels.friction),
            "labels_standing": len(standing.friction),
            "labels_chosen": len(chosen.friction),
            "label_index": chosen.index[rows].tolist(),
        },
    )


def label_name(file: Path | None) -> str:
    """Return where labels come from, in a word."""
    return "computed" if file is None else file.name
