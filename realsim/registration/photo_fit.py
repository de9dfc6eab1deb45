"""One view's poses and its depth brought together with its photograph.

Depth knows an object's distance but for an offset that all of the view share, 1/z + offset: 0.05 px
of a D405's disparity are 1 mm at 40 cm. It knows outlines to some pixels, since stereo matching
fattens them, and flat objects hardly have sides. A photograph shows outlines to fractions of a
pixel: how large all objects appear tells the offset, where their outlines lie tells the rest. With
x_k the twist of object k (camera axes, about its centre), H_k the information of its points, s_k
how its pose follows the offset, n_i, J_i the normal and the Jacobian of outline point i, d_i the
distance of the photograph's edge from it:
    sum_k (x_k - s_k o)' H_k (x_k - s_k o) + sum_i w_i (d_i - n_i.(J_i x_k + c) - rim_k)^2
      + (o / sigma_o)^2 + |c / sigma_c|^2 + sum_k (rim_k / sigma_rim)^2
is least. c (the photograph lies beside the depth) and the rims (meshes too large) move nothing.
Weights come from the residuals; an outline that fits no edge moves nothing either. What comes out
is taken only if the outlines fit clearly better and the depth, its offset taken out, no worse.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from realsim.arrays import Array, Array32
from realsim.geometry import se3
from realsim.geometry.camera import ray_table
from realsim.records import CameraIntrinsics
from realsim.registration import photo
from realsim.registration.body import Body, footprint, moved_about_center
from realsim.registration.evidence import DepthNoise
from realsim.registration.solver import PoseFit

LEAST_OFFSET_PER_M = 1e-4
"""Least 1-sigma of the offset of inverse depth [1/m]: 0.1 mm at a metre; nothing is perfect."""
AMENDED, REWEIGHTED = 2, 4
"""Times an outline is drawn again while a pose is amended, and times its edges are weighed."""


OFFSET_NOISES = 1.0
"""1-sigma of the offset of a view's inverse depth, in units of its noise k: what stereo is off
by is some hundredths of a pixel, as its noise is."""
EDGE_RIM_PX = 0.3
"""1-sigma of an object's rim [px]: a mesh that is 0.5 % too large."""
DEPTH_M = 0.0006
"""Common shift of an object's points, 1-sigma [m]."""
DEPTH_DEG = 0.4
"""Common turn of an object's points, 1-sigma [deg]."""
BLIND_M = 0.01
"""1-sigma of motions that points do not determine, of the surface [m]."""
MOST_M = 0.012
"""A pose that the photograph would move further is not moved [m]."""
BETTER_SHARE = 0.9
"""The mean distance of the edges must shrink to this share, else nothing is moved."""
CAP_PX = 3.0
"""An edge further away, or none, counts as this in that mean [px]."""
CAP_SIGMAS = 3.0
"""An edge further off than so many sigmas, or none, counts as that."""
FIT_ROUNDS = 10
"""Times the outlines are drawn again, at most: edges are sought some pixels away only."""
STILL_M = 0.0001
"""Fewer, where no object moves further than this in one of them [m]."""
UNLIKE = (0.006, 0.7, 0.7)
"""An object that the photograph moved so far [m], whose edges then lie so far from its outline
in the median [px], or whose rim is off by so much [px], is as likely another's: depth and
photograph do not tell of the same thing. Set on the second lab's seeds 1 to 3999."""
SHARP = 12.0
"""Power of the share of these limits in 1 / (1 + share^sharp), which is what is left."""


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Edges:
    """What the photograph says of one object, all others and what is common as they were fitted."""

    picture: photo.Picture
    body: Body
    others: Array32
    """(H, W) depth of all other objects; inf beside them [m]."""
    beside_px: Array
    """(2,) how far the photograph lies beside the depth [px]."""
    rim_px: float
    """Width of the object's rim [px]."""
    sigma_px: float
    """1-sigma of one edge [px]."""
    count: int
    """Points of its outline at the fit."""
    information: Array
    """(6, 6) of the object's points: twist about the box's centre in its axes, rotation first,
    turns times the radius [1/m^2]."""

    def amended(self, T_world_obj: Array, held: Array) -> tuple[Array, float]:
        """Return a pose (4, 4) amended to lie on the edges, and what they hold against it.

        Nothing is moved along the directions `held` (6, K), and else as far as the object's points
        allow it. What is held against it is half the sum of squared residuals, each capped.
        """
        free = np.linalg.svd(held)[0][:, held.shape[1] :]
        H, together = free.T @ self.information @ free, photo.TOGETHER
        y, T = np.zeros(free.shape[1]), T_world_obj
        for _ in range(AMENDED):
            A, d = self._rows(T)
            A, seen = A @ free, np.isfinite(d)
            r0 = d[seen] + A[seen] @ y
            for _ in range(REWEIGHTED):
                w = _weights(r0 - A[seen] @ y, self.sigma_px) / together
                left: Array = H + (A[seen].T * w) @ A[seen]
                y = np.asarray(np.linalg.solve(left, A[seen].T @ (w * r0)), dtype=np.float64)
            T = moved_about_center(self.body, T_world_obj, free @ y)
        _, d = self._rows(T)
        cap = CAP_SIGMAS
        r = np.minimum(np.abs(np.nan_to_num(d / self.sigma_px, nan=cap)), cap)
        mean = float(np.mean(np.square(r))) if len(r) else cap**2
        return T, 0.5 * mean * self.count / together

    def _rows(self, T_world_obj: Array) -> tuple[Array, Array]:
        """Return (N, 6) how the outline's points move along their normals, and the edges (N,)."""
        T = se3.invert(self.picture.T_world_cam) @ T_world_obj
        depth = _depth_of(self.body, self.picture.intrinsics, T)
        seen = _outline(self.picture, self.body, T, depth, self.others)
        B = np.kron(np.eye(2), T[:3, :3]) / np.repeat([self.body.radius_m, 1.0], 3)
        o = seen.outline
        return seen.J @ B, o.offsets - o.normals @ self.beside_px - self.rim_px


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class PhotoFit:
    """What came of it."""

    poses: list[Array]
    """(4, 4) each."""
    offset_per_m: float
    """Offset of the view's inverse depth [1/m], which must be removed."""
    offset_sigma_per_m: float
    """Its 1-sigma."""
    beside_px: Array
    """(2,) how far the photograph lies beside the depth [px]."""
    edges: list[Edges]
    """Per object; none where nothing was moved."""
    covariances: list[Array]
    """(6, 6) per object, of the right twist about its origin, rotation first [rad, m]."""
    edge_px: tuple[float, float]
    """Mean distance of the edges from the outlines, before and after [px]."""
    agreements: list[tuple[float, str]]
    """Per object, 0 to 1 how well depth and photograph agree on it, and in words why they do not;
    none where nothing was moved."""
    taken: bool
    """Whether anything was moved."""


@dataclass(frozen=True, eq=False, slots=True)
class _Seen:
    """The outline of one object, linearised."""

    outline: photo.Outline
    J: Array
    """(N, 6) of the distance along the normal, camera axes, about the centre [px/rad, px/m]."""
    others: Array32
    """(H, W) depth of all other objects; inf beside them [m]."""


def photo_fit(
    picture: photo.Picture, bodies: Sequence[Body], fits: Sequence[PoseFit], together: float,
    noise: DepthNoise,
) -> PhotoFit:  # fmt: skip
    """Return poses that fit depth and photograph.

    Args:
        picture: the view.
        bodies: the objects.
        fits: of their points.
        together: so many points of the fits share one error.
        noise: of the depth.
    """
    offset = max(OFFSET_NOISES * noise.per_m, LEAST_OFFSET_PER_M)
    T_cam_world = se3.invert(picture.T_world_cam)
    begin = [T_cam_world @ f.T_world_obj for f in fits]
    H = [_information(b, f, T[:3, :3], together)
         for b, f, T in zip(bodies, fits, begin, strict=True)]  # fmt: skip
    now, x = list(begin), np.zeros(3 + 7 * len(bodies))
    seen = _outlines(picture, bodies, now)
    before = _mean_px(seen, np.zeros(2))
    sigmas, C = np.ones(len(bodies)), np.eye(len(x))
    for _ in range(FIT_ROUNDS):
        last = x
        x, C, sigmas = _solved(seen, bodies, begin, H, x, offset)
        now = [_stepped(b, T, x[3 + 7 * k : 9 + 7 * k])
               for k, (b, T) in enumerate(zip(bodies, begin, strict=True))]  # fmt: skip
        seen = _outlines(picture, bodies, now)
        if np.abs(_places(x) - _places(last)).max() < STILL_M:
            break
    after = _mean_px(seen, x[1:3])
    taken = len(before) > 0 and after.mean() < BETTER_SHARE * before.mean()
    if not taken or np.linalg.norm(_places(x), axis=1).max() > MOST_M:
        return _untouched(fits, before, offset)
    edges: list[Edges] = []
    covariances: list[Array] = []
    for k, (body, s) in enumerate(zip(bodies, seen, strict=True)):
        B = np.kron(np.eye(2), now[k][:3, :3]) / np.repeat([body.radius_m, 1.0], 3)
        edges.append(
            Edges(picture=picture, body=body, others=s.others, beside_px=x[1:3],
                  rim_px=float(x[9 + 7 * k]), sigma_px=float(sigmas[k]),
                  count=len(s.outline.offsets), information=B.T @ H[k] @ B)
        )  # fmt: skip
        at = np.arange(3 + 7 * k, 9 + 7 * k)
        to_obj = se3.adjoint(se3.from_translation(body.center_obj)) @ np.kron(
            np.eye(2), now[k][:3, :3].T
        )
        covariances.append(to_obj @ C[np.ix_(at, at)] @ to_obj.T)
    return PhotoFit(
        poses=[picture.T_world_cam @ T for T in now], offset_per_m=float(x[0]),
        offset_sigma_per_m=float(np.sqrt(C[0, 0])), beside_px=x[1:3], edges=edges,
        covariances=covariances,
        agreements=_agreements(seen, _own_moves(bodies, begin, x), x),
        edge_px=(float(before.mean()), float(after.mean())), taken=True,
    )  # fmt: skip


def _places(x: Array) -> Array:
    """Return how far the objects were moved (K, 3) [m]."""
    return x[3:].reshape(-1, 7)[:, 3:6]


def _own_moves(bodies: Sequence[Body], begin: Sequence[Array], x: Array) -> Array:
    """Return how far each object was moved (K,) [m], without what the depth's offset moves it."""
    common = [x[0] * _follows(b.center(T))[3:] for b, T in zip(bodies, begin, strict=True)]
    return np.linalg.norm(_places(x) - common, axis=1)


def _agreements(seen: Sequence[_Seen], moved_m: Array, x: Array) -> list[tuple[float, str]]:
    """Return how well depth and photograph agree on every object, and in words why they do not."""
    found: list[tuple[float, str]] = []
    rims, aways = x[9::7], np.zeros(len(seen))
    for k, s in enumerate(seen):
        d = np.abs(s.outline.offsets - s.outline.normals @ x[1:3] - rims[k])
        aways[k] = float(np.nanmedian(d)) if np.isfinite(d).any() else 0.0
    most_m, most_px, most_rim_px = UNLIKE
    # Real pictures are worse than made ones, for all objects alike: what stands out is odd.
    limits = (most_m, max(most_px, 2.0 * float(np.median(aways))), most_rim_px)
    beside = np.abs(rims - np.median(rims))
    for k in range(len(seen)):
        told = (float(moved_m[k]), float(aways[k]), float(beside[k]))
        shares = np.array(told) / limits
        words = (
            f"the photograph moves it by {1e3 * told[0]:.1f} mm from where its depth lies",
            f"the photograph's edges lie {told[1]:.1f} px from its outline",
            f"the photograph shows its rim {told[2]:.1f} px from where the others' are",
        )
        left = float(np.prod(1.0 / (1.0 + shares**SHARP)))
        found.append((left, words[int(np.argmax(shares))]))
    return found


def _untouched(fits: Sequence[PoseFit], before: Array, offset_sigma: float) -> PhotoFit:
    """Return what is left where the photograph does not help."""
    mean = float(before.mean()) if len(before) else float("nan")
    return PhotoFit(
        poses=[f.T_world_obj for f in fits], offset_per_m=0.0,
        offset_sigma_per_m=offset_sigma, beside_px=np.zeros(2),
        edges=[], covariances=[], agreements=[], edge_px=(mean, mean), taken=False,
    )  # fmt: skip


def _information(body: Body, fit: PoseFit, R_cam_obj: Array, together: float) -> Array:
    """Return what an object's points say of its twist (6, 6), camera axes, about its centre."""
    scale = np.repeat([body.radius_m, 1.0], 3)
    inflation = together * max(1.0, fit.variance if fit.points else 1.0)
    own = fit.information / np.outer(scale, scale) / inflation
    own = own + np.eye(6) / BLIND_M**2
    common = np.repeat([np.radians(DEPTH_DEG) * body.radius_m, DEPTH_M], 3)
    H = np.linalg.inv(np.linalg.inv(own) + np.diag(np.square(common))) * np.outer(scale, scale)
    B = np.kron(np.eye(2), R_cam_obj)
    return B @ H @ B.T


def _outlines(
    picture: photo.Picture, bodies: Sequence[Body], Ts_cam_obj: Sequence[Array]
) -> list[_Seen]:
    """Return the outlines of all objects, each hidden by the others."""
    depths = [_depth_of(b, picture.intrinsics, T) for b, T in zip(bodies, Ts_cam_obj, strict=True)]
    out: list[_Seen] = []
    for k, (body, T) in enumerate(zip(bodies, Ts_cam_obj, strict=True)):
        others = np.min([*depths[:k], *depths[k + 1 :], np.full_like(depths[k], np.inf)], axis=0)
        out.append(_outline(picture, body, T, depths[k], others))
    return out


def _outline(
    picture: photo.Picture, body: Body, T_cam_obj: Array, depth: Array32, others: Array32
) -> _Seen:
    """Return the outline of one object."""
    o = photo.outline_of(picture, depth, others)
    at = np.round(o.pixels - o.normals).astype(np.int64)
    z = depth[at[:, 1], at[:, 0]].astype(np.float64)
    o, at, z = o.part(np.isfinite(z)), at[np.isfinite(z)], z[np.isfinite(z)]
    p = ray_table(picture.intrinsics)[at[:, 1], at[:, 0]] * z[:, None]
    J = _jacobian(o.normals, p, p - body.center(T_cam_obj), picture.intrinsics)
    return _Seen(o, J, others)


def _depth_of(body: Body, intrinsics: CameraIntrinsics, T_cam_obj: Array) -> Array32:
    """Return the depth (H, W) of a body alone [m]; inf beside it."""
    z = np.full((intrinsics.height, intrinsics.width), np.inf, np.float32)
    p = footprint(body, intrinsics, T_cam_obj, 1)
    z[p.rows, p.columns] = p.z
    return z


def _jacobian(n: Array, p: Array, q: Array, c: CameraIntrinsics) -> Array:
    """Return how outline points p (N, 3), q from the centre, move along n as the body does."""
    x, y, z = p.T
    g = np.stack([n[:, 0] * c.fx / z, n[:, 1] * c.fy / z,
                  -(n[:, 0] * c.fx * x + n[:, 1] * c.fy * y) / z**2], axis=1)  # fmt: skip
    return np.concatenate([np.cross(q, g), g], axis=1)


def _follows(center: Array) -> Array:
    """Return how a pose (6,) follows the offset of the inverse depth: p -> p / (1 + o z)."""
    return np.concatenate([np.zeros(3), -center[2] * center])


def _solved(
    seen: Sequence[_Seen], bodies: Sequence[Body], begin: Sequence[Array], H: Sequence[Array],
    x: Array, offset: float,
) -> tuple[Array, Array, Array]:  # fmt: skip
    """Return unknowns, their covariance, and every outline's 1-sigma [px].

    The unknowns: the offset, c (2), and of every object its twist (6) and rim.
    """
    size, before = len(x), x
    prior = np.zeros(size)
    prior[0], prior[1:3] = offset**-2, photo.COMMON_PX**-2
    prior[9::7] = EDGE_RIM_PX**-2
    base: Array = np.diag(prior)
    rows: list[tuple[Array, Array]] = []
    for k, (body, s) in enumerate(zip(bodies, seen, strict=True)):
        at = np.arange(3 + 7 * k, 9 + 7 * k)
        F = np.zeros((6, size))
        F[:, at], F[:, 0] = np.eye(6), -_follows(body.center(begin[k]))
        base += F.T @ H[k] @ F
        found = np.isfinite(s.outline.offsets)
        J = np.zeros((int(found.sum()), size))
        J[:, at], J[:, 1:3], J[:, 9 + 7 * k] = s.J[found], s.outline.normals[found], 1.0
        # Distances were measured from where the outline is now.
        moved = np.zeros(size)
        moved[at] = before[at]
        rows.append((J, s.outline.offsets[found] + J @ moved))
    sigmas: Array = np.full(len(bodies), photo.LEAST_PX)
    A: Array = base
    for _ in range(8):
        A, b = base.copy(), np.zeros(size)
        for k, (J, d) in enumerate(rows):
            if len(d) < photo.EDGE_POINTS:
                continue
            r = d - J @ x
            sigmas[k] = max(1.48 * float(np.median(np.abs(r))), photo.LEAST_PX)
            w = _weights(r, float(sigmas[k])) / photo.TOGETHER
            A += J.T @ (w[:, None] * J)
            b += J.T @ (w * d)
        x = np.asarray(np.linalg.solve(A, b), dtype=np.float64)
    return x, np.asarray(np.linalg.inv(A), dtype=np.float64), sigmas


def _weights(residuals: Array, sigma_px: float) -> Array:
    """Return robust weights of edges at these distances [1/px^2]: others' edges hardly count."""
    return 1.0 / np.square(1.0 + np.square(residuals / (1.5 * sigma_px))) / sigma_px**2


def _stepped(body: Body, T_cam_obj: Array, x: Array) -> Array:
    """Return a pose moved by a twist (6,) about its centre in camera axes."""
    c = se3.from_translation(body.center(T_cam_obj))
    return c @ se3.exp(x) @ se3.invert(c) @ T_cam_obj


def _mean_px(seen: Sequence[_Seen], beside_px: Array) -> Array:
    """Return the distances (N,) of all edges, what lies beside taken out [px]."""
    found = [np.abs(s.outline.offsets - s.outline.normals @ beside_px) for s in seen]
    return np.minimum(np.nan_to_num(np.concatenate([*found, np.zeros(0)]), nan=CAP_PX), CAP_PX)
