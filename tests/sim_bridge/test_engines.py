"""The engines behind one interface: by name, and alike where physics says that they must be."""

import sys
from dataclasses import replace

import numpy as np
import pytest

from realsim.errors import InputError
from realsim.geometry import se3
from realsim.robots.hand import find_hand
from realsim.robots.robot_files import names_of
from realsim_sim_bridge.slip.bullet_world import BulletEngine
from realsim_sim_bridge.slip.engines import (
    ENGINES,
    BulletSettings,
    MujocoSettings,
    make_engine,
    settings_of,
)
from realsim_sim_bridge.slip.mujoco_model import lift_law
from realsim_sim_bridge.slip.slip_test import SlipConfig, SlipTrial, run_slip_test
from realsim_sim_bridge.slip.world import Closing, Grips, Replay, SlipBody, SlipPhysics
from realsim_sim_bridge.validation.specimens import cube_trial

DOWN = np.array([[1.0, 0.0, 0.0], [0.0, -1.0, 0.0], [0.0, 0.0, -1.0]])


def ellipsoid():
    """Return a convex body, curved everywhere, of half axes 30, 22 and 36 mm and 100 g."""
    rng = np.random.default_rng(0)
    points = rng.normal(size=(300, 3))
    points *= np.array([0.030, 0.022, 0.036]) / np.linalg.norm(points, axis=1, keepdims=True)
    inertia = 0.1 / 5 * np.diag([0.0018, 0.0022, 0.0014])
    return SlipBody(parts=(points,), mass_kg=0.1, center_of_mass=np.zeros(3), inertia=inertia)


def askew(n):
    """Return grasps of the ellipsoid beside its middle and turned."""
    Ts = np.stack(
        [
            se3.from_rt(DOWN @ se3.exp_so3([0.1 * k, 0.2, 0.0]), [0.006, 0.0, 0.012])
            for k in range(n)
        ]
    )
    return SlipTrial(
        body=ellipsoid(),
        Ts_obj_grasp=Ts,
        Ts_table_grasp=Ts,
        openings_m=np.full(n, 0.06),
        swing_axes=np.tile([0.0, 1.0, 0.0], (n, 1)),
        swing_points=np.tile([-0.088, 0.0, -0.21], (n, 1)),
        swing_ranges=np.tile([-2.0, 2.0], (n, 1)),
    )


def crawl_mm(settings):
    """Return how far an object crawls in a second that is squeezed, and nothing else."""
    trial = askew(3)
    grips = Grips(
        Ts_table_grasp=trial.Ts_table_grasp,
        Ts_obj_grasp=trial.Ts_obj_grasp,
        openings_m=trial.openings_m,
    )
    with BulletEngine(settings).world(trial.body, grips, SlipPhysics(), find_hand()) as world:
        world.close(Closing())
        seen = world.play(np.zeros((3, 240, 6)), 60, 1.0).Ts_world_body[:, :, :3, 3]
    return 1e3 * np.linalg.norm(seen[:, -1] - seen[:, 0], axis=-1).max()


def test_an_engine_is_known_by_its_name_and_another_is_refused():
    for name in ENGINES:
        assert make_engine(settings_of(name)).name == name
        assert settings_of(name, reference=True).replay == Replay()
    with pytest.raises(
        InputError, match="there is no engine 'bullet'; there are: pybullet, mujoco"
    ):
        settings_of("bullet")


def test_without_mujoco_its_package_is_named(monkeypatch):
    monkeypatch.setitem(sys.modules, "mujoco", None)  # what Python itself does for `import` to fail
    with pytest.raises(InputError, match=r"realsim\[mujoco\]"):
        make_engine(MujocoSettings())


def test_what_is_squeezed_at_a_curved_place_does_not_crawl():
    anchored = crawl_mm(BulletSettings())
    assert anchored < 0.02
    assert crawl_mm(replace(BulletSettings(), friction_anchor=False)) > max(0.1, 10 * anchored)


@pytest.mark.parametrize("name", sorted(names_of("hand")))
@pytest.mark.parametrize("engine", ENGINES)
def test_every_hand_carries_a_cube_through_all_stages(engine, name):
    """And while an arc closes the object goes no farther than its pads rise as they sink in."""
    if engine == "mujoco":
        pytest.importorskip("mujoco")
    hand = find_hand(name)
    config = replace(SlipConfig.of(hand), engine=settings_of(engine))
    assert config.physics.force_n == hand.force_n and config.physics.friction == hand.friction
    slips = run_slip_test(cube_trial(0.125, DOWN[None], hand), config, geometry=hand)
    assert slips.passed.all(), slips.failures
    assert slips.slip_m[0].max() < 0.2e-3 + 0.4e-3 * abs(hand.slope(0.025))
    assert slips.force_n[0, 0] == pytest.approx(hand.force_n, rel=0.02)


def test_pads_of_an_arc_are_where_it_has_them_while_they_close():
    pytest.importorskip("mujoco")
    hand = find_hand("robotiq_2f140")
    trial = cube_trial(0.125, DOWN[None], hand)
    y = np.linspace(0.0, hand.max_opening_m / 2, 50)
    law = np.polynomial.Polynomial(lift_law(hand))
    np.testing.assert_allclose(law(y), hand.z_pad(2 * y), atol=5e-5)
    grips = replace(trial.grips(0.004), openings_m=np.array([0.12]))
    with BulletEngine(BulletSettings()).world(
        trial.body, grips, SlipPhysics.of(hand), hand
    ) as world:
        pair = world._pair
        world._take(0)
        pair.drive(0.1)
        for step in range(90):
            pair.follow_arc()
            pair.engine.stepSimulation()
            lifts = [pair.engine.getJointState(pair.hand, lift)[0] for lift in pair._lifts]
            off = np.abs(lifts - hand.z_pad(2 * pair.fingers()[0])).max()
            assert off < (1e-4 if step > 5 else 1e-3)  # the fingers begin to move at once
        assert 0.0245 < pair.fingers()[0].min() < 0.0255  # it has arrived
