"""Where Newton's steps begin: all joints that may reach a pose, of any arm.

- Six joints whose axes have a structure that can be solved in closed form: every branch, by EAIK
  (Ostermeier, Kuelz & Althoff 2024) on the nominal arm.
- Seven joints that have such a structure while one is held: the branches at many values of it.
- Any other arm: the nearest of a table of random configurations, moved onto the pose by damped
  Newton steps inside the limits. What they find is not all there is.
"""

from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from realsim.arrays import Array
from realsim.errors import InputError
from realsim.geometry import se3
from realsim.robots.compiled_chain import chain_numbers, solve_from
from realsim.robots.limits import LimitedArm

CLOSED = 6
"""Joints of which a pose leaves none free."""
HELD_VALUES = 24
"""Values of the held joint, evenly spread between its limits."""
TRIED_VALUES = (0.31, -0.77, 1.13)
"""Values at which a held joint must leave a solvable arm [rad]; none is special for any arm."""
TABLE = 16384
"""Random configurations inside the limits."""
NEAREST = 24
"""Configurations of the table that start at each pose."""
TURN_M = 0.25
"""A rotation matrix's differences count as so many metres: half the length of a forearm."""
STEPS, TABLE_DAMPING = 18, 0.02
"""Steps of a seed from the table, and their damping."""
TRIED, BEYOND = 1000, 1.3
"""Configurations whose nearest in the table say how far a pose in reach can be from it, times."""
SAME_RAD = 1e-4
"""Seeds that end nearer than this in all joints are one."""


def seeds_of(
    chain: LimitedArm, Ts_base_ee: Array, held_values: int = HELD_VALUES
) -> tuple[Array, NDArray[np.intp]]:
    """Return joints (M, n) near to or at all known inverses of poses, and each one's pose (M,).

    Those in closed form are exact for the nominal arm and may lie outside the limits; those from
    the table are exact and inside.

    Args:
        chain: the arm.
        Ts_base_ee: (N, 4, 4) [m].
        held_values: of the held joint of a redundant arm.

    Raises:
        InputError: the arm has fewer than six joints.
    """
    if chain.joints < CLOSED:
        raise InputError(
            f"the arm '{chain.name}' has {chain.joints} joints; {CLOSED} or more are needed to "
            "reach poses in space."
        )
    held = held_joint(chain)
    if held == NO_CLOSED_FORM:
        return seeds_from_table(chain, Ts_base_ee)
    numbers = _key(chain)
    targets = se3.invert(chain.T_base_0) @ Ts_base_ee @ se3.invert(chain.T_n_ee)
    if held is None:
        return _branches(_solver(numbers, None), targets, chain.theta)
    low, high = chain.limits.lower[held], chain.limits.upper[held]
    found: list[tuple[Array, NDArray[np.intp]]] = []
    for k in range(held_values):
        q = float(low + (high - low) * (k + 0.5) / held_values)
        solver = _solver(numbers, (held, q + float(chain.theta[held])))
        joints, of = _branches(solver, targets, chain.theta)
        joints[:, held] = q
        found.append((joints, of))
    joints = np.concatenate([j for j, _ in found])
    of = np.concatenate([o for _, o in found])
    order = np.argsort(of, kind="stable")
    return joints[order], of[order]


NO_CLOSED_FORM = -1
"""What `held_joint` says of an arm that is solved from a table."""


def held_joint(chain: LimitedArm) -> int | None:
    """Return the joint that is held, None if none need be, or `NO_CLOSED_FORM`.

    Of several the last is taken, beginning at the flange.
    """
    return _held_joint(_key(chain))


def is_sampled(chain: LimitedArm) -> bool:
    """Return whether a joint is held at some values, between which solutions may be missed."""
    return held_joint(chain) not in (None, NO_CLOSED_FORM)


Key = tuple[tuple[float, ...], tuple[float, ...], tuple[float, ...]]


def _key(chain: LimitedArm) -> Key:
    return tuple(chain.alpha), tuple(chain.a), tuple(chain.d)


@lru_cache(maxsize=64)
def _held_joint(numbers: Key) -> int | None:
    joints = len(numbers[0])
    if joints == CLOSED:
        return None if _is_solvable(numbers, None) else NO_CLOSED_FORM
    if joints == CLOSED + 1:
        for held in range(joints - 1, -1, -1):
            if all(_is_solvable(numbers, (held, value)) for value in TRIED_VALUES):
                return held
    return NO_CLOSED_FORM


def _is_solvable(numbers: Key, held: tuple[int, float] | None) -> bool:
    try:
        return bool(_solver(numbers, held).hasKnownDecomposition())
    except RuntimeError:  # two axes that should meet are parallel at this value
        return False


@lru_cache(maxsize=512)
def _solver(numbers: Key, held: tuple[int, float] | None) -> Any:
    """Return EAIK's solver of a nominal arm, one joint held at a value or none."""
    from eaik.IK_DH import DhRobot

    alpha, a, d = (np.array(row) for row in numbers)
    return DhRobot(alpha, a, d) if held is None else DhRobot(alpha, a, d, [held])


def _branches(solver: Any, targets: Array, theta: Array) -> tuple[Array, NDArray[np.intp]]:
    """Return the exact solutions (M, n) of poses (N, 4, 4), and the pose of each (M,)."""
    # One thread: what asks for poses is spread over the cores itself.
    found = solver.IK_batched(list(targets), 1)
    seeds: list[Array] = []
    owner: list[int] = []
    for i, solution in enumerate(found):
        for q, is_least_squares in zip(solution.Q, solution.is_LS, strict=True):
            if not is_least_squares:
                seeds.append(q)
                owner.append(i)
    if not seeds:
        return np.zeros((0, len(theta))), np.zeros(0, dtype=np.intp)
    return np.array(seeds, dtype=np.float64) - theta, np.array(owner, dtype=np.intp)


def seeds_from_table(chain: LimitedArm, Ts_base_ee: Array) -> tuple[Array, NDArray[np.intp]]:
    """Return joints (M, n) inside the limits that reach poses (N, 4, 4), and each one's pose."""
    numbers = chain_numbers(chain)
    table, features, farthest = _table(chain)
    squares = _squares(_features(Ts_base_ee), features)
    near = np.argpartition(squares, NEAREST, axis=1)[:, :NEAREST]
    near.sort(axis=1)
    asked = np.nonzero(squares.min(axis=1) < farthest**2)[0]
    near, of = near[asked], np.repeat(asked, NEAREST)
    q = np.ascontiguousarray(table[near.ravel()])
    poses = np.ascontiguousarray(Ts_base_ee[of])
    arrived = solve_from(numbers, q, poses, STEPS, TABLE_DAMPING)
    q, of = q[arrived], of[arrived]
    keys = np.concatenate([of[:, None], np.round(q / SAME_RAD).astype(np.int64)], axis=1)
    _, first = np.unique(keys, axis=0, return_index=True)
    first.sort()
    return q[first], of[first]


_tables: dict[tuple[Any, ...], tuple[Array, Array, float]] = {}


def _table(chain: LimitedArm) -> tuple[Array, Array, float]:
    """Return configurations (K, n), the features (K, 12) of their flange poses, and a distance [m].

    A pose that is farther than that from all of them is out of reach.
    """
    limits = chain.limits
    key = (*_key(chain), *limits.lower.tolist(), *limits.upper.tolist(), chain.T_base_0.tobytes())
    if key not in _tables:
        low, high = np.maximum(limits.lower, -np.pi), np.minimum(limits.upper, np.pi)
        low, high = np.where(low < high, (low, high), (limits.lower, limits.upper))
        q = np.random.default_rng(0).uniform(low, high, (TABLE + TRIED, chain.joints))
        features = _features(chain.forward(q))
        gaps = _squares(features[TABLE:], features[:TABLE]).min(axis=1)
        _tables[key] = q[:TABLE], features[:TABLE], BEYOND * float(np.sqrt(gaps.max()))
    return _tables[key]


def _squares(a: Array, b: Array) -> Array:
    """Return squared distances (N, K) of rows (N, F) and (K, F)."""
    sums = np.einsum("kf,kf->k", b, b) - 2.0 * a @ b.T
    return sums + np.einsum("nf,nf->n", a, a)[:, None]


def _features(Ts: Array) -> Array:
    """Return position and turned axes (N, 12) [m] of poses (N, 4, 4)."""
    return np.concatenate([Ts[:, :3, 3], TURN_M * Ts[:, :3, :3].reshape(-1, 9)], axis=1)
