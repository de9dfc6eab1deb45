"""Boxes that a hand holds from above, ready for the slip test."""

from itertools import product

import numpy as np

from realsim.geometry import se3
from realsim_sim_bridge.slip.slip_test import SlipTrial
from realsim_sim_bridge.slip.world import SlipBody

DOWN = np.array([[1.0, 0.0, 0.0], [0.0, -1.0, 0.0], [0.0, 0.0, -1.0]])
SIDE = 0.05


def held_box(mass, length=SIDE):
    """A box `length` long along its x, held across the 5 cm of its y."""
    half = np.array([length, SIDE, SIDE]) / 2
    corners = np.array(list(product((-1.0, 1.0), repeat=3))) * half
    squares = (2 * half) ** 2
    inertia = np.diag(mass / 12 * (squares.sum() - squares))
    return SlipBody(parts=(corners,), mass_kg=mass, center_of_mass=np.zeros(3), inertia=inertia)


def held_from_above(body, off_m=(0.0,)):
    """Grasps from above, each `off_m` beside the centre of mass along x."""
    n = len(off_m)
    Ts = np.repeat(se3.from_rt(DOWN, np.zeros(3))[None], n, axis=0)
    Ts[:, 0, 3] = off_m
    return SlipTrial(
        body=body, Ts_obj_grasp=Ts, Ts_table_grasp=Ts, openings_m=np.full(n, SIDE + 0.008),
        swing_axes=np.tile([0.0, 1.0, 0.0], (n, 1)),
        swing_points=np.tile([-0.088, 0.0, -0.21], (n, 1)),
        swing_ranges=np.tile([-2.0, 2.0], (n, 1)),
    )  # fmt: skip
