"""The normal equations of everything that is fitted together, from points of many views.

What one body's points say in one view is a block: the twist xi = [omega, v] of the view's points in
the body's frame about its centre, and further columns. A point p of the camera becomes m = M p,
M = T_body_cam, and with g the surface's normal and r = g.(m - s) its distance,
    m' = exp(xi) m:             dr/domega = m x g,   dr/dv = g
    1/z' = scale/z + offset:    dr/dscale = -L,      dr/doffset = -L z,   L = g.(m - eye)
    a body exp(lambda) as large (about the origin of its frame):    dr/dlambda = -g.m
where z is the depth along the camera's axis, not the range, which is a third more at the border.

The noise of a point is in its residual. Were it in the derivative too, the two would be correlated
and hardly visible directions would be pulled by many sigma (errors in variables); so derivatives
are taken where the point's ray meets the surface.

All other unknowns follow from the block by adjoints. With A the row of a block's twist: object -A,
table -A[0, 1, 5], camera A Ad(M), because M exp(xi) = exp(Ad(M) xi) M. Shared unknowns are 6 of the
hand-eye, 2 of the depth's bias, 3 of the table (two tilts and the height), 6 of every object (right
twist about its centre); then whatever the caller adds: the sizes of objects, offsets of patches of
the surface, an offset of outlines. Every view has 6 more (see `geometry.normal_equations`), or 7:
what a stereo camera's disparity is off by wanders, and is an offset of the view's inverse depth. A
camera that stands still is one view; it has no part in hand-eye and bias, and a scale of its own.

To fit a size too (the body's frame at its centre, as large as the body now is):
    places, distances, normals = seen_distances(lattice, size, points, views, cameras, edges)
    add_blocks(..., system=(H, b))    with blocks of 9 columns instead of 8, the last is the size's
    Blocks(..., own=object_at(0), further=np.append(BIAS_AT, place of the size's logarithm))
    system = assembled(blocks of all bodies, number of shared unknowns); add priors to A and a
    shared, views = solved(system); C = covariances(system)
Alone, with all cameras held, its 7 unknowns have the sum of H over views, bias columns left out.
Terms of another kind (outlines) fill blocks of their own; those of no view (contact) add to A, a.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from realsim.arrays import Array, Array32, Int32, Int64
from realsim.compiled import njit
from realsim.geometry import se3
from realsim.geometry.normal_equations import System, add_row
from realsim.geometry.robust import tukey
from realsim.registration.body import Body

HAND_EYE, BIAS, TABLE = slice(0, 6), slice(6, 8), slice(8, 11)
"""Where shared unknowns stand; the objects follow, six each."""
OBJECTS = 11
TABLE_ROWS = (0, 1, 5)
"""Rows of the table's twist: turns about its x and y, shift along its z."""
BIAS_AT: Int64 = np.arange(BIAS.start, BIAS.stop)
TABLE_AT: Int64 = np.arange(TABLE.start, TABLE.stop)
HAND_EYE_AT: Int64 = np.arange(HAND_EYE.start, HAND_EYE.stop)
BLOCK = 8
"""Columns of a block: twist and bias. A ninth is the logarithm of the body's size."""
SCALE, OFFSET = 6, 7
"""The block's columns of the inverse depth's scale and offset, which a view may have of its own."""
LEAST_ALONG = 0.15
"""Least cosine between ray and normal at which the ray is followed to the surface."""


def object_at(k: int) -> Int64:
    """Return the places (6,) of an object's twist among the shared unknowns."""
    return np.arange(OBJECTS + 6 * k, OBJECTS + 6 * k + 6)


@njit
def add_blocks(
    surface: tuple[Array, Array, Array],
    views: Int32,
    frame: tuple[Array, Array, Array],
    precision: tuple[Array, Array],
    system: tuple[Array, Array],
    kernels: Array,
) -> float:
    """Add a body's points to the blocks of their views; return the weighted sum of squares.

    Args:
        surface: places (N, 3) in the body's frame, distances (N,), normals (N, 3), as from
            `seen_distances`. NaN = not used.
        views: (N,).
        frame: the body's centre (3,), and of the cameras in the body's frame the place (V, 3) and
            the unit direction (V, 3) in which they look.
        precision: weight (N,) [1/m^2], and the square (N,) of the distance at which Tukey's kernel
            ends [m^2].
        system: H (V, n, n) upper triangles and b (V, n), added to; n = 8, or 9 with a size.
        kernels: (N,) filled with Tukey's weights; 0 = not used.
    """
    places, distances, normals = surface
    center, eyes, axes = frame
    weight, reach = precision
    H, b = system
    J = np.empty(b.shape[1])
    total = 0.0
    for i in range(len(places)):
        kernels[i] = 0.0
        r = distances[i]
        if np.isnan(r):
            continue
        q = r * r / reach[i]
        if q >= 1.0:
            continue
        kernels[i] = tukey(q)
        w = kernels[i] * weight[i]
        k = views[i]
        fill_row(J, (places[i], r, normals[i]), (center, eyes[k], axes[k]))
        add_row(H[k], b[k], J, w, r)
        total += w * r * r
    return total


@njit(inline="always")
def fill_row(
    J: Array, point: tuple[Array, float, Array], frame: tuple[Array, Array, Array]
) -> None:
    """Fill in the derivatives J (8 or 9,) of one point's distance.

    Args:
        J: filled in.
        point: place (3,) in the body's frame, distance, normal (3,).
        frame: the body's centre, the camera's place in the body's frame and its direction, (3,).
    """
    place, r, g = point
    center, eye, axis = frame
    gx, gy, gz = g[0], g[1], g[2]
    ex, ey, ez = eye[0], eye[1], eye[2]
    x, y, z = place[0] - ex, place[1] - ey, place[2] - ez
    far = np.sqrt(x * x + y * y + z * z)
    along = gx * x + gy * y + gz * z
    deep = axis[0] * x + axis[1] * y + axis[2] * z
    f = 1.0 - r / along if abs(along) > LEAST_ALONG * far else 1.0
    x, y, z = ex + f * x - center[0], ey + f * y - center[1], ez + f * z - center[2]
    J[0], J[1], J[2] = y * gz - z * gy, z * gx - x * gz, x * gy - y * gx
    J[3], J[4], J[5] = gx, gy, gz
    J[6] = -f * along
    J[7] = -f * along * f * deep
    if len(J) > BLOCK:
        J[8] = -(gx * x + gy * y + gz * z)


@njit
def add_offsets(
    surface: tuple[Array, Array, Array],
    views: Int32,
    frame: tuple[Array, Array, Array],
    weights: Array,
    patches: Int64,
    system: tuple[Array, Array, Array],
) -> None:
    """Add what the points say of offsets of the surface: r - delta of the patch a point lies in.

    Args:
        surface: as of `add_blocks`; distances with the offsets in them.
        views: likewise.
        frame: likewise.
        weights: (N,) kernel and precision of every point [1/m^2]; 0 = not used.
        patches: (N,) the patch of every point.
        system: coupling (V, n, K) to the columns of the blocks, information (K,) and right side
            (K,) of the offsets, added to.
    """
    places, distances, normals = surface
    center, eyes, axes = frame
    coupling, information, right = system
    J = np.empty(coupling.shape[1])
    for i in range(len(places)):
        w, r, k, n = weights[i], distances[i], views[i], patches[i]
        if w <= 0.0:
            continue
        fill_row(J, (places[i], r, normals[i]), (center, eyes[k], axes[k]))
        information[n] += w
        right[n] += w * r
        for c in range(len(J)):
            coupling[k, c, n] -= w * J[c]


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Offsets:
    """How the blocks of one body hang together with offsets of its surface."""

    coupling: Array
    """(V, n, K)."""
    information: Array
    """(K,) diagonal: a point lies in one patch."""
    right: Array
    """(K,)."""
    at: Int64
    """(K,) places among the shared unknowns."""


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Blocks:
    """What the points of one body said, and which unknowns they speak of."""

    H: Array
    """(V, n, n), symmetric: twist, and n - 6 further columns."""
    b: Array
    """(V, n)."""
    Ms: Array
    """(V, 4, 4) T_body_cam, the body's frame moved to its centre."""
    own: Int64
    """Places of the body's own unknowns among the shared ones."""
    rows: tuple[int, ...] = (0, 1, 2, 3, 4, 5)
    """Which components of the twist these are."""
    further: Int64 = field(default_factory=BIAS_AT.copy)
    """(n - 6,) places of the further columns."""
    offsets: Offsets | None = None
    """None = the surface is as the model says."""
    common: Array | None = None
    """(V,) 1 where a view shares hand-eye and depth bias, 0 where its camera stands still and has
    its own; None = all share them."""


def assemble(bodies: Sequence[Blocks], unknowns: int, of_view: int = 6) -> System:
    """Return the normal equations without any prior.

    Args:
        bodies: what the points of each say.
        unknowns: how many are shared.
        of_view: how many every view has: 6 of its twist, 7 with an offset of its inverse depth, or
            8 with a scale of it, too.
    """
    V, S = len(bodies[0].H), unknowns
    system = System(
        A=np.zeros((S, S)), a=np.zeros(S), B=np.zeros((V, S, of_view)),
        D=np.zeros((V, of_view, of_view)), d=np.zeros((V, of_view)),
    )  # fmt: skip
    for blocks in bodies:
        _add(system, blocks)
    return system


def _add(system: System, blocks: Blocks) -> None:
    """Add the blocks of one body."""
    own, rows, more, hand = blocks.own, np.array(blocks.rows), blocks.further, HAND_EYE_AT
    H, b = blocks.H, blocks.b
    # Columns of a block by unknowns of its view: the camera's twist, the inverse depth's offset.
    G = np.zeros((*b.shape, system.d.shape[1]))
    G[:, :6, :6] = se3.adjoint(blocks.Ms)
    G[:, OFFSET, 6:7] = 1.0
    G[:, SCALE, 7:] = 1.0
    back = np.swapaxes(G, 1, 2)
    HG = H @ G
    cc = back @ HG
    cd = np.einsum("vji,vj->vi", G, b)
    A, B = system.A, system.B
    A[np.ix_(own, own)] += H[:, :6, :6].sum(0)[np.ix_(rows, rows)]
    system.a[own] -= b[:, :6].sum(0)[rows]
    B[:, own] -= HG[:, rows]
    system.D[:] += cc
    system.d[:] += cd
    if blocks.common is not None:
        # What follows is of the unknowns that a camera which stands still has no part in.
        H, HG, cc = (blocks.common[:, None, None] * M for M in (H, HG, cc))
        b, cd = (blocks.common[:, None] * x for x in (b, cd))
    A[np.ix_(more, more)] += H[:, 6:, 6:].sum(0)
    A[np.ix_(hand, hand)] += cc.sum(0)[:6, :6]
    _couple(A, own, more, -H[:, :6, 6:].sum(0)[rows])
    _couple(A, own, hand, -HG.sum(0)[rows, :6])
    _couple(A, hand, more, HG.sum(0)[6:, :6].T)
    system.a[more] += b[:, 6:].sum(0)
    system.a[hand] += cd.sum(0)[:6]
    B[:, more] += HG[:, 6:]
    B[:, hand] += cc[:, :6]
    if (offsets := blocks.offsets) is not None:
        at, total = offsets.at, offsets.coupling.sum(0)
        ck = back @ offsets.coupling
        A[at, at] += offsets.information
        system.a[at] += offsets.right
        _couple(A, own, at, -total[rows])
        _couple(A, more, at, total[6:])
        _couple(A, hand, at, ck.sum(0)[:6])
        B[:, at] += np.swapaxes(ck, 1, 2)


def _couple(A: Array, left: Int64, right: Int64, value: Array) -> None:
    """Add a piece of a symmetric matrix on both sides of its diagonal."""
    A[np.ix_(left, right)] += value
    A[np.ix_(right, left)] += value.T


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class State:
    """Objects, table, cameras' errors and the depth's bias."""

    poses: Array
    """(K, 4, 4) T_world_obj."""
    T_world_table: Array | None
    """(4, 4)."""
    hand_eye: Array
    """(6,) twist of every camera [rad, m]."""
    views: Array
    """(V, 7) further twist of each, and the offset of its inverse depth [rad, m, 1/m]; (V, 6) where
    that is the same for all, (V, 8) where some have a scale of their own."""
    bias: Array
    """(2,) scale and offset [1/m] of the inverse depth."""
    common: Array | None = None
    """(V,) as of `Blocks`."""

    @property
    def in_hand(self) -> Array:
        """(V,) 1 where a camera is in the hand, 0 where it stands still."""
        return np.ones(len(self.views)) if self.common is None else self.common

    def cameras(self, claimed: Array) -> Array:
        """Return the cameras (V, 4, 4) as they stand now, from what is said of them."""
        return claimed @ se3.exp(np.outer(self.in_hand, self.hand_eye) + self.views[:, :6])

    def scales(self) -> Array:
        """Return the scale of the inverse depth of every view (V,)."""
        hand = self.in_hand
        return hand * self.bias[0] + (1.0 - hand) + self.views[:, 7:].sum(axis=1)

    def offsets(self) -> Array:
        """Return the offset of the inverse depth of every view (V,) [1/m]."""
        return self.in_hand * self.bias[1] + self.views[:, 6:7].sum(axis=1)

    def corrected(self, points: Array | Array32, views: int | Int32) -> Array:
        """Return points (N, 3) in the axes of their views' cameras without the depth's bias."""
        scale, offset = (np.reshape(of[views], (-1, 1)) for of in (self.scales(), self.offsets()))
        return np.asarray(points / (scale + offset * points[:, 2:]), np.float64)


def centre_pose(body: Body, T_world_obj: Array) -> Array:
    """Return the pose (4, 4) of the body's frame moved to the centre of its box."""
    return T_world_obj @ se3.from_translation(body.center_obj)


def moves_of_all(bodies: Sequence[Body], state: State) -> Array:
    """Return how the shared unknowns (S, 6) change if everything on the table moves as one.

    The six are turns about the middle of the objects' centres and shifts, in world axes.
    """
    centres = np.array([centre_pose(b, T) for b, T in zip(bodies, state.poses, strict=True)])
    if len(centres) == 0:
        return np.zeros((OBJECTS, 6))
    middle = se3.from_translation(centres[:, :3, 3].mean(axis=0))
    moves = np.zeros((OBJECTS + 6 * len(centres), 6))
    moves[OBJECTS:] = se3.adjoint(se3.invert(centres) @ middle).reshape(-1, 6)
    if state.T_world_table is not None:
        moves[TABLE] = se3.adjoint(se3.invert(state.T_world_table) @ middle)[list(TABLE_ROWS)]
    return moves


def step_state(state: State, bodies: list[Body], shared: Array, views: Array) -> State:
    """Return the state after one step.

    Args:
        state: before.
        bodies: the objects.
        shared: (11 + 6 K,) see `equations`.
        views: (V, 6 to 8).
    """
    poses = [
        centre_pose(b, T) @ se3.exp(shared[object_at(k)])
        @ se3.from_translation(-b.center_obj)
        for k, (b, T) in enumerate(zip(bodies, state.poses, strict=True))
    ]  # fmt: skip
    table = state.T_world_table
    if table is not None:
        xi = np.zeros(6)
        xi[list(TABLE_ROWS)] = shared[TABLE]
        table = table @ se3.exp(xi)
    return replace(
        state,
        poses=np.stack(poses) if poses else state.poses,
        T_world_table=table,
        hand_eye=state.hand_eye + shared[HAND_EYE],
        views=state.views + views,
        bias=state.bias + shared[BIAS],
    )
