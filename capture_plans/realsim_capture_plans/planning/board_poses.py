"""Views of a flat board: poses that differ in all that a calibration lives on, and their choice."""

import numpy as np
from numpy.typing import NDArray

from realsim_capture_plans.planning.record import PlanConfig
from realsim_capture_plans.planning.viewpoints import look_at_poses

Array = NDArray[np.float64]
Ints = NDArray[np.intp]


def board_poses(
    tried: int, center: Array, normal: Array, config: PlanConfig, rng: np.random.Generator
) -> tuple[Array, Array]:
    """Return camera poses (tried, 4, 4) over a board and what they should differ in (tried, 5).

    Additive recurrence in six dimensions (Roberts' R-sequence: steps 1/g^k with g^7 = g + 1)
    spreads direction, roll, distance and aim point evenly for any number of poses.
    """
    c = config
    g = 1.5
    for _ in range(50):
        g = (1.0 + g) ** (1.0 / 7.0)
    steps = g ** -np.arange(1.0, 7.0)
    u = np.mod(rng.uniform(size=6) + np.arange(1, tried + 1)[:, None] * steps, 1.0)
    cos_tilt = 1.0 - u[:, 0] * (1.0 - np.cos(np.radians(c.board_tilt_deg)))
    sin_tilt = np.sqrt(1.0 - cos_tilt**2)
    azimuth, roll = 2 * np.pi * u[:, 1], 2 * np.pi * u[:, 2]
    distance = c.board_distance_m[0] + u[:, 3] * (c.board_distance_m[1] - c.board_distance_m[0])
    axes = plane_axes(normal)
    aim = center + (2 * u[:, 4:6] - 1.0) * c.aim_jitter_m @ axes[:2]
    direction = np.stack([np.cos(azimuth) * sin_tilt, np.sin(azimuth) * sin_tilt, cos_tilt], -1)
    eye = aim + distance[:, None] * (direction @ axes)
    poses = look_at_poses(eye, aim, roll)
    # About one unit per feature: direction over the cap, distance and aim point over their ranges.
    sideways = direction[:, :2] / np.sin(np.radians(c.board_tilt_deg))
    return poses, np.concatenate([sideways, 2 * u[:, 3:6] - 1.0], axis=1)


def spread_rolls(features: Array, roll: Array, n: int) -> Ints:
    """Return n row numbers: one of every n-th of the full turn, otherwise far from each other.

    A sector in which nothing is reachable gives its view to the rows farthest from the others.
    """
    sector = np.floor(np.mod(roll, 2 * np.pi) / (2 * np.pi) * n).astype(np.intp) % n
    nearest = np.full(len(features), np.inf)
    chosen: list[int] = []
    # The first round takes the sectors one by one, the second fills up from all rows.
    for rows in [*(sector == s for s in range(n)), *([np.ones(len(roll), dtype=bool)] * n)]:
        score = np.where(rows, nearest, -1.0)
        score[chosen] = -1.0
        best = int(np.argmax(score))
        if len(chosen) < n and score[best] >= 0:
            chosen.append(best)
            distance = np.linalg.norm(features - features[best], axis=1)
            nearest = np.minimum(nearest, distance)
    return np.array(chosen, dtype=np.intp)


def plane_axes(normal: Array) -> Array:
    """Return rows x, y, z = normal of a right-handed frame on the board."""
    helper = np.eye(3)[int(np.argmin(np.abs(normal)))]
    x = np.cross(helper, normal)
    x = x / np.linalg.norm(x)
    return np.stack([x, np.cross(normal, x), normal])


def board_roll(Ts_base_cam: Array, axes: Array) -> Array:
    """Return the roll (N,) [rad] that the board is seen at: its own x axis in the image."""
    x_cam = np.swapaxes(Ts_base_cam[:, :3, :3], -1, -2) @ axes[0]
    return np.arctan2(x_cam[:, 1], x_cam[:, 0])
