"""Normal equations H x = b of least squares: adding rows, eliminating views, covariances.

Unknowns are shared ones and six of every view. No two views share an equation, so their unknowns
are eliminated one by one (Schur's complement): what is left is as small for 256 views as for 3.
"""

from dataclasses import dataclass

import numpy as np

from realsim.arrays import Array, Int64
from realsim.compiled import njit


@njit(inline="always")
def add_row(H: Array, b: Array, J: Array, w: float, r: float) -> None:
    """Add a residual r with derivatives J (n,) and weight w to H (upper triangle) and b."""
    for c in range(len(J)):
        b[c] -= w * J[c] * r
        for d in range(c, len(J)):
            H[c, d] += w * J[c] * J[d]


def symmetric(H: Array) -> Array:
    """Return the full matrices (..., n, n) of upper triangles."""
    return H + np.swapaxes(np.triu(H, 1), -1, -2)


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


def add_prior(system: System, at: slice | Int64, value: Array, W: Array) -> None:
    """Add that shared unknowns, which stand at `value`, are zero with the precision W."""
    rows = np.arange(len(system.a))[at]
    system.A[np.ix_(rows, rows)] += W
    system.a[rows] -= W @ value


def without_views(system: System) -> tuple[Array, Array]:
    """Return the normal matrix (S, S) and right side (S,) of the shared unknowns alone."""
    BD = system.B @ np.linalg.inv(system.D)
    A = system.A - np.einsum("vij,vkj->ik", BD, system.B)
    return A, system.a - np.einsum("vij,vj->i", BD, system.d)


def view_steps(system: System, shared: Array) -> Array:
    """Return the step of the views (V, 6), given that of the shared unknowns (S,)."""
    left = system.d - np.einsum("vij,i->vj", system.B, shared)
    return np.einsum("vij,vj->vi", np.linalg.inv(system.D), left)


def solve(system: System) -> tuple[Array, Array]:
    """Return the step of the shared unknowns (S,) and of the views (V, 6)."""
    A, a = without_views(system)
    s = inverse(A) @ a
    return s, view_steps(system, s)


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Covariances:
    """The inverse of the normal matrix, in pieces."""

    shared: Array
    """(S, S)."""
    cross: Array
    """(V, S, 6) of shared unknowns and a view's."""
    views: Array
    """(V, 6, 6)."""


def covariances(system: System, beyond: Array | float = 0.0) -> Covariances:
    """Return the covariance of all unknowns that are asked for.

    Args:
        system: the equations, priors included.
        beyond: (S, S) what the shared unknowns are unsure of beyond what the equations say; it is
            carried to the views, which follow from the shared unknowns.
    """
    own = np.linalg.inv(system.D)
    BD = system.B @ own
    shared = inverse(without_views(system)[0]) + beyond
    cross = -shared @ BD
    views = own - np.swapaxes(BD, 1, 2) @ cross
    return Covariances(shared=shared, cross=cross, views=views)


def inverse(A: Array) -> Array:
    """Return the inverse of a normal matrix whose unknowns have very different units."""
    scale = np.sqrt(np.maximum(np.diag(A), 1e-12))
    return np.linalg.inv(A / np.outer(scale, scale)) / np.outer(scale, scale)
