"""The closed loops of links of Robotiq's hands, and how far their hands' arcs are from them."""

import numpy as np
from scipy.optimize import brentq

from realsim.robots.check_hand import path_error
from realsim.robots.hand import find_hand

LOOPS = {
    "robotiq_2f85": {
        "crank": (0.0376009, 0.0430400), "rocker": (0.0371170, 0.0434560),
        "coupler": (0.0179014, -0.0065146), "pad": (0.0255, 0.03242),
    },
    "robotiq_2f140": {
        "crank": (0.0646366, 0.0763028), "rocker": (0.0646366, 0.0763028),
        "coupler": (0.0179014, -0.0065146), "pad": (0.0309703, 0.0457554),
    },
}  # fmt: skip
"""Links of the finger at +y when the joint is at 0 [m]: the middles of the holes in the meshes of
airo-models 0.0.12 (2F-85) and robosuite 1.5.2 (2F-140), and where the face of the pad is."""
CRANK_AXIS, ROCKER_AXIS = np.array([0.0306011, 0.054904]), np.array([0.0127, 0.06142])
"""In the frame of the hand's base [m]; robosuite's and airo-models'."""


def turned(v, angle):
    c, s = np.cos(angle), np.sin(angle)
    return np.array([c * v[0] - s * v[1], s * v[0] + c * v[1]])


def four_bar(name, angles):
    """Return the middles (S, 2, 3) of both pads' faces when the loop of links is closed."""
    links = {key: np.array(v) for key, v in LOOPS[name].items()}
    length = np.linalg.norm(links["rocker"])
    faces = []
    for angle in angles:
        end = CRANK_AXIS + turned(links["crank"], angle)

        def open_by(turn, end=end):
            return np.linalg.norm(end - turned(links["coupler"], turn) - ROCKER_AXIS) - length

        turn = brentq(open_by, -0.2, 0.2)
        y, z = end + turned([-links["pad"][0], links["pad"][1]], turn)
        faces.append([[0.0, y, z], [0.0, -y, z]])
    return np.array(faces)


def arc_error_mm(name):
    """Return how far the arc is from the four-bar linkage, over the whole stroke [mm]."""
    hand = find_hand(name)
    faces = four_bar(name, np.linspace(-0.1, 0.85, 300))
    width = faces[:, 0, 1] - faces[:, 1, 1]
    stroke = (width >= -1e-4) & (width <= hand.max_opening_m + 1e-3)
    assert width[stroke].max() >= hand.max_opening_m and width[stroke].min() < 1e-3
    return 1e3 * path_error(hand, faces[stroke])[1]
