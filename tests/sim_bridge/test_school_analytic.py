"""Analytic grasps in the School: those of the labels are tried, with the labels' friction."""

from dataclasses import replace

import numpy as np

from realsim.formats.graspnet.grasp_labels import write_grasp_labels
from realsim.formats.grasps.scene_grasps import executed
from realsim.geometry.parts import part
from realsim_sim_bridge.grasping.analytic import AnalyticConfig, analytic_labels
from realsim_sim_bridge.school import SchoolConfig
from realsim_sim_bridge.school.school import run_school
from realsim_sim_bridge.slip.engines import MujocoSettings
from refusals import refused
from school_sessions import NAMES, scene

LABELS = AnalyticConfig(points=40, view_step=2)
MODELS = {part(n).obj_id: part(n) for n in NAMES}


def config_of(**changed):
    config = SchoolConfig(max_candidates=12, analytic=LABELS)
    return replace(config, slip=replace(config.slip, engine=MujocoSettings()), **changed)


def test_labels_are_tried_and_keep_their_friction():
    sets = run_school(scene(), MODELS, config_of(), workers=1)
    for s in sets:
        friction = s.measures["closure_friction"]
        assert 0 < len(s) <= 12 and executed(s).any()
        assert np.all(np.isin(friction, LABELS.levels))
        assert s.parameters["analytic"]["from"] == "computed"
    assert len({float(f) for s in sets for f in s.measures["closure_friction"]}) > 1


def test_labels_of_a_file_are_taken_instead_and_told_apart(tmp_path):
    files = {}
    for obj_id, model in MODELS.items():
        files[obj_id] = tmp_path / f"{obj_id - 1:03d}_labels.npz"
        labels = analytic_labels(model.mesh, np.random.default_rng(3), LABELS)
        write_grasp_labels(files[obj_id], labels)
    cache = tmp_path / "cache"
    sets = run_school(
        scene(), MODELS, config_of(), workers=1, cache=cache, label_files=files, restart=True
    )
    for s in sets:
        assert s.parameters["analytic"]["from"] == files[s.obj_id].name
        assert executed(s).any()
    refused("labels", run_school, scene(), MODELS, config_of(), workers=1, cache=cache)
