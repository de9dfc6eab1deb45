"""The normal equations of all unknowns, put together from the blocks, solved view by view.

Shared unknowns: 6 of every object (right twist about its centre), 3 of the table (two tilts and the
height), 2 of the depth's bias, 6 of the hand-eye. Every view has 6 more. No two views share an
equation, so their unknowns are eliminated one by one (Schur's complement); what is left is as small
for 256 views as for 3.

With A the row of a block (see `blocks`): object -A, table -A[0, 1, 5], camera A Ad(M) where
M = T_body_cam, because M exp(xi) = exp(Ad(M) xi) M.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from realsim.geometry import se3

Array = NDArray[np.float64]
TABLE_ROWS = (0, 1, 5)
"""Of the table's twist: turns about its x and y, shift along its z."""
HAND_EYE, BIAS, TABLE = slice(0, 6), slice(6, 8), slice(8, 11)
"""Where shared unknowns stand; the objects follow, six each."""
OBJECTS = 11


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Blocks:
    """What the points of one body said."""

    H: Array
    """(V, 8, 8), symmetric."""
    b: Array
    """(V, 8)."""
    Ms: Array
    """(V, 4, 4) T_body_cam, the body's frame moved to its centre."""


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class System:
    """Normal equations: shared unknowns s, and of every view v."""

    A: Array
    """(S, S) of s."""
    a: Array
    """(S,) right side."""
    B: Array
    """(V, S, 6) coupling."""
    D: Array
    """(V, 6, 6) of the views."""
    d: Array
    """(V, 6) right side."""


def assembled(objects: list[Blocks], table: Blocks | None) -> System:
    """Return the normal equations without any prior."""
    first = objects[0] if objects else table
    assert first is not None, "there is something to fit"
    V, S = len(first.H), OBJECTS + 6 * len(objects)
    system = System(
        A=np.zeros((S, S)), a=np.zeros(S), B=np.zeros((V, S, 6)), D=np.zeros((V, 6, 6)),
        d=np.zeros((V, 6)),
    )  # fmt: skip
    for k, blocks in enumerate(objects):
        at = OBJECTS + 6 * k
        _add(system, blocks, np.arange(at, at + 6), np.arange(6))
    if table is not None:
        _add(system, table, np.arange(TABLE.start, TABLE.stop), np.array(TABLE_ROWS))
    return system


def _add(system: System, blocks: Blocks, own: NDArray[np.int64], rows: NDArray[np.int64]) -> None:
    """Add the blocks of one body, whose unknowns are `own` and use `rows` of the twist."""
    Ad = se3.adjoint(blocks.Ms)
    H, b = blocks.H[:, :6, :6], blocks.b[:, :6]
    bias = np.arange(BIAS.start, BIAS.stop)
    hand = np.arange(HAND_EYE.start, HAND_EYE.stop)
    Hc = H @ Ad
    cc = np.swapaxes(Ad, 1, 2) @ Hc
    cb = np.swapaxes(Ad, 1, 2) @ blocks.H[:, :6, 6:]
    cd = np.einsum("vji,vj->vi", Ad, b)
    A, B = system.A, system.B
    A[np.ix_(own, own)] += H.sum(0)[np.ix_(rows, rows)]
    A[np.ix_(bias, bias)] += blocks.H[:, 6:, 6:].sum(0)
    A[np.ix_(hand, hand)] += cc.sum(0)
    for left, right, value in (
        (own, bias, -blocks.H[:, :6, 6:].sum(0)[rows]),
        (own, hand, -Hc.sum(0)[rows]),
        (hand, bias, cb.sum(0)),
    ):
        A[np.ix_(left, right)] += value
        A[np.ix_(right, left)] += value.T
    system.a[own] -= b.sum(0)[rows]
    system.a[bias] += blocks.b[:, 6:].sum(0)
    system.a[hand] += cd.sum(0)
    B[:, own] -= Hc[:, rows]
    B[:, bias] += np.swapaxes(cb, 1, 2)
    B[:, hand] += cc
    system.D[:] += cc
    system.d[:] += cd


def solved(system: System) -> tuple[Array, Array]:
    """Return the step of the shared unknowns (S,) and of the views (V, 6)."""
    inverse = np.linalg.inv(system.D)
    BD = system.B @ inverse
    A = system.A - np.einsum("vij,vkj->ik", BD, system.B)
    a = system.a - np.einsum("vij,vj->i", BD, system.d)
    s = _inverse(A) @ a
    views = np.einsum("vij,vj->vi", inverse, system.d - np.einsum("vij,i->vj", system.B, s))
    return s, views


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Covariances:
    """The inverse of the normal matrix, in pieces."""

    shared: Array
    """(S, S)."""
    cross: Array
    """(V, S, 6) of shared unknowns and a view's."""
    views: Array
    """(V, 6, 6)."""


def covariances(system: System) -> Covariances:
    """Return the covariance of all unknowns that are asked for."""
    inverse = np.linalg.inv(system.D)
    BD = system.B @ inverse
    shared = _inverse(system.A - np.einsum("vij,vkj->ik", BD, system.B))
    cross = -shared @ BD
    views = inverse - np.swapaxes(BD, 1, 2) @ cross
    return Covariances(shared=shared, cross=cross, views=views)


def _inverse(A: Array) -> Array:
    """Return the inverse of a normal matrix whose unknowns have very different units."""
    scale = np.sqrt(np.maximum(np.diag(A), 1e-12))
    return np.linalg.inv(A / np.outer(scale, scale)) / np.outer(scale, scale)
