"""The ten table models: closed, convex outlines, top at z = 0, feet on the floor."""

import numpy as np
import pytest

from realsim.errors import InputError
from realsim.geometry.mesh import mass_properties
from realsim_sim_bridge.table_scenes.table_shapes import table, table_names
from realsim_sim_bridge.table_scenes.tables import floor, walls

FOOT_M = 0.005
"""The ends of slanted legs are cut square to the leg, so a corner dips below the floor [m]."""


def test_there_are_ten_kinds() -> None:
    assert len(table_names()) == 10


@pytest.mark.parametrize("name", table_names())
def test_a_table_is_closed_stands_on_the_floor_and_its_top_is_zero(name: str) -> None:
    made = table(name, np.random.default_rng(4))
    assert all(mass_properties(p.mesh, 1.0).is_watertight for p in made.parts)
    top = next(p for p in made.parts if p.role == "top")
    assert top.mesh.bounds[1, 2] == pytest.approx(0.0, abs=1e-12)
    lowest = min(p.mesh.bounds[0, 2] for p in made.parts)
    assert -made.height_m - FOOT_M <= lowest <= -made.height_m + 1e-9
    # What rises above the top surface is known to the physics.
    risen = max(p.mesh.bounds[1, 2] for p in made.parts)
    assert risen <= max((float(r[:, 2].max()) for r in made.rims), default=0.0) + 1e-9


@pytest.mark.parametrize("name", table_names())
def test_an_outline_is_convex_and_counter_clockwise(name: str) -> None:
    ring = table(name, np.random.default_rng(5)).outline
    edge = np.roll(ring, -1, axis=0) - ring
    after = np.roll(edge, -1, axis=0)
    assert np.all(edge[:, 0] * after[:, 1] - edge[:, 1] * after[:, 0] > -1e-12)


@pytest.mark.parametrize("name", table_names())
def test_objects_may_lie_only_where_no_rim_is(name: str) -> None:
    made = table(name, np.random.default_rng(6))
    low, high = made.inside.min(axis=0), made.inside.max(axis=0)
    for rim in made.rims:
        a, b = rim[:, :2].min(axis=0), rim[:, :2].max(axis=0)
        assert np.any(a >= high - 1e-9) or np.any(b <= low + 1e-9)


def test_walls_stand_behind_the_farthest_camera() -> None:
    for seed in range(20):
        wall = walls(0.7, 2.0, np.random.default_rng(seed)).mesh
        # A wall is a box about one of the axes: its nearest point is its distance.
        planes = np.abs(wall.vertices[:, :2]).reshape(-1, 8, 2).min(axis=1)
        assert np.all(planes.max(axis=1) >= 2.0)
    assert floor(0.7).mesh.bounds[1, 2] == pytest.approx(-0.7)


def test_a_table_that_is_not_known_is_named_with_those_that_are() -> None:
    with pytest.raises(InputError, match=r"no table 'desk'.*drawer_desk"):
        table("desk", np.random.default_rng(0))
