"""Which joint is an arm's elbow, where the arm is stretched, and to which side it bends.

The elbow alone changes how far the wrist is from the shoulder. Changing its side leads through the
stretched arm and takes several seconds.
"""

from collections.abc import Callable
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from realsim.arrays import Array
from realsim.robots.kinematics import DhChain

SHOULDER, BEFORE_FLANGE = 1, 2
"""Links whose distance counts: the first, which the second joint turns about, and so many before
the flange, where most arms have the middle of their wrist."""
SAMPLES = 16
"""Configurations over which an arm's elbow is looked for."""
LEAST_M2 = 1e-6
"""A joint that changes the square of the distance by less is no elbow [m^2]."""


def bend(chain: DhChain, joints: Array) -> Array:
    """Return (...) how far the arm is bent at joints (..., n): -1 to 1, 0 where it is stretched.

    The sign is the side. An arm without an elbow has 1 everywhere.
    """
    found = elbow_of(chain)
    return np.ones(joints.shape[:-1]) if found is None else np.sin(joints[..., found[0]] - found[1])


@lru_cache(maxsize=16)
def elbow_of(chain: DhChain) -> tuple[int, float] | None:
    """Return the elbow's number, from 0, and the angle at which the arm is stretched [rad]."""
    q = np.random.default_rng(0).uniform(-np.pi, np.pi, (SAMPLES, chain.joints))
    nominal = chain.nominal()
    waves = [wave_of(lambda q: _apart_m2(nominal, q), q, k) for k in range(chain.joints)]
    elbow = int(np.argmax([np.abs(wave).mean() for wave in waves]))
    wave = waves[elbow]
    return (elbow, float(np.angle(wave.mean()))) if np.abs(wave).mean() > LEAST_M2 else None


def reach_m(chain: DhChain) -> float:
    """Return how far the wrist is from the shoulder where the arm is stretched [m]."""
    straight = np.zeros((1, chain.joints))
    found = elbow_of(chain)
    if found is not None:
        straight[:, found[0]] = found[1]
    return float(np.sqrt(_apart_m2(chain.nominal(), straight)[0]))


def _apart_m2(chain: DhChain, q: Array) -> Array:
    frames = chain.link_frames(q)[..., :3, 3]
    return np.sum((frames[..., -1 - BEFORE_FLANGE, :] - frames[..., SHOULDER, :]) ** 2, axis=-1)


def wave_of(value: Callable[[Array], Array], q: Array, k: int) -> NDArray[np.complex128]:
    """Return B exp(i phi) (N,) of a value that goes with joint k as A + B cos(q_k - phi).

    Args:
        value: takes joints (N, n), returns (N,).
        q: (N, n) [rad]; joint k is turned.
        k: the joint.
    """
    at: list[Array] = []
    for angle in (0.0, np.pi / 2, np.pi):
        turned = q.copy()
        turned[:, k] = angle
        at.append(value(turned))
    return (at[0] - at[2]) / 2 + 1j * (at[1] - (at[0] + at[2]) / 2)


def raised(chain: DhChain, joints: Array) -> Array:
    """Return joints (N, n) with the arm stretched up: where an elbow may change its side."""
    tall = joints.copy()
    found = elbow_of(chain)
    low, high = chain.limits.lower, chain.limits.upper
    if found is not None:
        tall[:, found[0]] = np.clip(found[1], low[found[0]], high[found[0]])
    wave = wave_of(lambda q: chain.link_frames(q)[:, -1 - BEFORE_FLANGE, 2, 3], tall, SHOULDER)
    tall[:, SHOULDER] = np.clip(np.angle(wave), low[SHOULDER], high[SHOULDER])
    return tall
