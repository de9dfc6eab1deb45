"""The engines behind one interface: by name, and alike where physics says that they must be."""

import sys
from dataclasses import replace

import numpy as np
import pytest

from realsim.errors import InputError
from realsim.geometry import se3
from realsim.robots.hand import find_hand
from realsim_sim_bridge.slip.bullet_world import BulletEngine
from realsim_sim_bridge.slip.engines import (
    ENGINES,
    BulletSettings,
    MujocoSettings,
    make_engine,
    settings_of,
)
from realsim_sim_bridge.slip.slip_test import SlipTrial
from realsim_sim_bridge.slip.world import Closing, Grips, Replay, SlipBody, SlipPhysics

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
