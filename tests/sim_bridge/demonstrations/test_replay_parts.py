"""What a replay is made of: the configuration read back, the watched engine, the fall."""

import json
from dataclasses import asdict, replace

import numpy as np
import pytest

from held_boxes import held_box
from realsim.geometry import se3
from realsim.geometry.mesh import mass_properties
from realsim_sim_bridge.demonstrations.attempt_motion import fall
from realsim_sim_bridge.demonstrations.school_settings import school_config_of, tried_body
from realsim_sim_bridge.demonstrations.slip_replay import RecordedEngine, replay_grasp
from realsim_sim_bridge.school import run_school_results
from realsim_sim_bridge.school.object_slips import stand_of
from realsim_sim_bridge.school.sweep import SweepConfig
from realsim_sim_bridge.slip.engines import make_engine, settings_of
from refusals import refused
from school_scenes import CONFIG, at, model, scene, small_worlds
from tried_grasps import plain_grasps
from trimesh_solids import box


def test_a_configuration_comes_back_from_the_parameters():
    slip = replace(CONFIG.slip, engine=settings_of("pybullet"))
    base = replace(CONFIG, slip=slip, second_engine=settings_of("mujoco"), sweep=SweepConfig())
    assert school_config_of(tried_with(stored_config(base))) == base


def stored_config(config):
    return json.loads(json.dumps(asdict(config)))


def tried_with(stored):
    return plain_grasps(0, parameters={"config": stored})


def test_a_configuration_of_another_version_is_refused():
    gone, new, other_type = (stored_config(CONFIG) for _ in range(3))
    del gone["slip"]
    new["slip"]["physics"]["glue"] = 1.0
    other_type["slip"]["physics"]["friction"] = "much"
    refused("slip is not there", school_config_of, tried_with(gone))
    refused("glue", school_config_of, tried_with(new))
    refused("friction is str", school_config_of, tried_with(other_type))


def test_a_field_that_a_version_did_not_have_takes_its_default():
    stored = stored_config(CONFIG)
    del stored["slip"]["headroom_m"], stored["sweep"]
    sizes = "max_opening_m finger_length_m tip_beyond_tcp_m finger_width_m finger_thickness_m"
    stored["hand"] = {n: stored["hand"][n] for n in [*sizes.split(), "mount_z_m"]}
    del stored["reach"]["arm"]  # the Panda's, before arms had names
    stored["reach"]["joint7_samples"] = stored["reach"].pop("held_values")
    # Franka's, before names.
    assert school_config_of(tried_with(stored)) == CONFIG
    stored["hand"]["mount_z_m"] = -0.15
    refused("without a name", school_config_of, tried_with(stored))


def test_a_box_that_is_dropped_lands_on_its_face():
    T = se3.from_translation([0.0, 0.0, 0.12])
    Ts = fall(held_box(0.1), T, np.zeros(6), [], np.array([0.0, 0.1, 1.0]))
    np.testing.assert_allclose(Ts[0], T, atol=1e-6)
    assert Ts[1, 2, 3] == pytest.approx(0.12 - 0.5 * 9.81 * 0.1**2, abs=3e-3)
    assert Ts[2, 2, 3] == pytest.approx(0.025, abs=1e-3)
    np.testing.assert_allclose(Ts[2, :3, :3], np.eye(3), atol=0.02)


def test_a_thrown_box_flies_on_and_lands_on_what_stands_there():
    twist = np.array([0, 0, 0, 0.5, 0, 0.0])
    block = box((0.2, 0.2, 0.05), (0.07, 0, 0.025)).vertices
    T = se3.from_translation([0.0, 0, 0.2])
    Ts = fall(held_box(0.1), T, twist, [block], np.array([0.1, 1.0]))
    assert Ts[0, 0, 3] == pytest.approx(0.05, abs=2e-3)
    assert Ts[1, 2, 3] == pytest.approx(0.075, abs=2e-3)


@pytest.mark.slow
def test_a_replay_in_bullet_ends_as_the_school_did():
    config = small_worlds(replace(CONFIG, max_candidates=4))
    physics = replace(config.slip.physics, friction=0.3, force_n=6.0)
    config = replace(config, slip=replace(config.slip, physics=physics))
    (result,) = run_school_results(scene(at(0.0, 0.0)), {1: model()}, config, workers=1)
    s, attempts = result.grasp_set, result.trajectories
    assert attempts is not None
    T_table_obj = se3.from_translation([0, 0, 0.025])
    engine = RecordedEngine(make_engine(config.slip.engine))
    body = tried_body(s, model(), T_table_obj, school_config_of(s), None, None)
    assert body.mass_kg == pytest.approx(mass_properties(model().mesh, 1000.0).mass_kg)
    stand = stand_of(config.slip, T_table_obj, body, [])
    for row in attempts.rows.tolist():
        lifted = attempts.joints_rad[attempts.attempt(row)][-1]
        replay = replay_grasp(s, row, lifted, T_table_obj, body, config, engine, stand)
        assert replay.agrees, replay.disagreement
        assert len(replay.stages) == int((~np.isnan(s.slip_m[row])).sum())
        for stage in replay.stages:
            assert np.all(np.diff(stage.times_s) > 0)
            np.testing.assert_allclose(np.linalg.det(stage.Ts_grasp_obj[:, :3, :3]), 1.0, atol=1e-6)
        ends = [st.Ts_grasp_obj[-1] for st in replay.stages[:-1]]
        for end, stage in zip(ends, replay.stages[1:], strict=True):
            np.testing.assert_array_equal(end, stage.Ts_grasp_obj[0])
