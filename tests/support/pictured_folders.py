"""Folders of pictures with robot poses as labs keep them, rendered once."""

from functools import cache

import numpy as np
from PIL import Image

from pictured_targets import TARGETS, picture, pose
from realsim.arrays import Array, UInt8
from realsim.geometry import se3

VIEWS = 10
X = se3.from_rt(se3.exp_so3([0.05, -0.1, 1.2]), [0.02, -0.06, 0.05])
"""T_ee_cam."""
Z = se3.from_rt(np.diag([1.0, -1.0, -1.0]), [0.4, 0.1, 0.02])
"""T_base_board."""


@cache
def pictures(name: str = "chessboard", seed: int = 0) -> tuple[list[UInt8], Array]:
    """Return ten pictures (H, W) of a target and the hand's poses (10, 4, 4) [m]."""
    rng, target = np.random.default_rng(seed), TARGETS[name]
    shots: list[UInt8] = []
    hands: list[Array] = []
    for k in range(VIEWS):
        T = pose(target, rng.uniform(8, 40), 36.0 * k, rng.uniform(-80, 80), rng.uniform(0.4, 0.48))
        shots.append(picture(target, T, rng, noise=2.0))
        hands.append(Z @ se3.invert(T) @ se3.invert(X))
    return shots, np.array(hands)


def save_pictures(folder, shots, pattern="{:02d}.png"):
    """Write pictures under numbered names; return their paths."""
    paths = [folder / pattern.format(k) for k in range(len(shots))]
    for path, shot in zip(paths, shots, strict=True):
        path.parent.mkdir(parents=True, exist_ok=True)
        Image.fromarray(shot).save(path, compress_level=1)
    return paths
