"""The chain as a pinocchio model, and shapes as coal geometry on it."""

from dataclasses import dataclass
from typing import Any

import numpy as np

from realsim.arrays import Array
from realsim.geometry import se3
from realsim.interop import import_pinocchio
from realsim.robots.kinematics import DhChain
from realsim.robots.shapes import Shape

Pair = tuple[int, int]
DIGITS = 7
"""Decimals of a distance [m]. coal stops within 1e-6 m, and its last digits hang on where in memory
a body lies: with them, the same plan made twice in a process has two hashes."""


def pinocchio_model(chain: DhChain) -> tuple[Any, Array]:
    """Return the chain as a pinocchio model, and (n + 1, 4, 4) where link i is in joint i [m].

    Joint i turns about z of frame i - 1; frame i is `Tz(d) Tx(a) Rx(alpha)` behind it, the last one
    the flange. Frame 0 is the world, which is the base.
    """
    pin = import_pinocchio()

    model, n = pin.Model(), chain.joints
    frames = np.tile(np.eye(4), (n + 1, 1, 1))
    theta, alpha = chain.theta + chain.delta_theta, chain.alpha + chain.delta_alpha
    a, d = chain.a + chain.delta_a, chain.d + chain.delta_d
    behind = chain.T_base_0
    for i in range(n):
        zero = se3.from_rt(se3.exp_so3([0.0, 0.0, theta[i]]), np.zeros(3))
        model.addJoint(i, pin.JointModelRZ(), pin.SE3(behind @ zero), f"joint {i + 1}")
        behind = se3.from_rt(se3.exp_so3([alpha[i], 0.0, 0.0]), [a[i], 0.0, d[i]])
        frames[i + 1] = behind if i + 1 < n else behind @ chain.T_n_ee
    return model, frames


def coal_shape(shape: Shape, cover_m: float = 0.0) -> Any:
    """Return a shape as coal's, with a cover of this thickness all round it [m]."""
    import coal  # pyright: ignore[reportMissingImports]

    size = shape.size_m
    if shape.kind == "convex":
        assert shape.points is not None  # Shape checks it
        corners = coal.StdVec_Vec3s()
        corners.extend(list(shape.points))
        geometry = coal.Convex.convexHull(corners, True, "Qt")
    else:
        makers = {
            "box": coal.Box,
            "capsule": coal.Capsule,
            "cylinder": coal.Cylinder,
            "sphere": coal.Sphere,
        }
        geometry = makers[shape.kind](*size)
    if cover_m > 0:
        geometry.setSweptSphereRadius(cover_m)
    return geometry


@dataclass(frozen=True, eq=False, slots=True)
class Body:
    """One shape in the model."""

    shape: Shape
    role: str
    """'link', 'mount', 'table' or 'scene'."""
    cover_m: float = 0.0

    @property
    def part(self) -> str:
        """What messages call it."""
        return self.shape.part

    @property
    def frame(self) -> int:
        """The DH frame that it moves with."""
        return self.shape.frame


class Geometry:
    """Bodies on a chain, asked for the distances of pairs of them."""

    def __init__(self, chain: DhChain, placements: Array, bodies: tuple[Body, ...]) -> None:
        """Place the bodies: links in their physical frames, everything else in the DH frames."""
        pin = import_pinocchio()

        self.model, frames = pinocchio_model(chain)
        self.geometry = pin.GeometryModel()
        for k, body in enumerate(bodies):
            at = frames[body.frame]
            if body.role == "link":
                at = at @ placements[body.frame]
            self.geometry.addGeometryObject(
                pin.GeometryObject(
                    f"{k} {body.part}",
                    body.frame,
                    pin.SE3(at @ body.shape.T_frame_shape),
                    coal_shape(body.shape, body.cover_m),
                )
            )

    def with_pairs(self, pairs: list[Pair]) -> "PairDistances":
        """Return these pairs, ready to be asked."""
        return PairDistances(self.model, self.geometry, pairs)


class PairDistances:
    """Some pairs of a geometry; keeps pinocchio's working memory."""

    def __init__(self, model: Any, geometry: Any, pairs: list[Pair]) -> None:
        """Copy the geometry with these pairs only."""
        pin = import_pinocchio()

        self.model = model
        self.data = model.createData()
        self.geometry = geometry.copy()
        self.geometry.removeAllCollisionPairs()
        for first, second in pairs:
            self.geometry.addCollisionPair(pin.CollisionPair(first, second))
        self.work = self.geometry.createData()
        _forget(self.work.distanceRequests)
        self._results = [self.work.distanceResults[k] for k in range(len(pairs))]
        self._distances = pin.computeDistances

    def __call__(self, joints: Array) -> Array:
        """Return the distances (N, P) [m] of the pairs at joints (N, n); negative = penetration."""
        rows = np.empty((len(joints), len(self._results)))
        for row, q in zip(rows, np.ascontiguousarray(joints), strict=True):
            self._distances(self.model, self.data, self.geometry, self.work, q)
            row[:] = [result.min_distance for result in self._results]
        return np.round(rows, DIGITS)


class Collider:
    """Is any pair nearer than a margin? Bounding boxes first, then coal, until the first hit."""

    def __init__(self, pairs: PairDistances, margin_m: float) -> None:
        """Set the margin for every pair."""
        pin = import_pinocchio()

        self._pairs = pairs
        work = pairs.geometry.createData()
        for request in work.collisionRequests:
            request.security_margin = margin_m
        _forget(work.collisionRequests)
        # With about twenty bodies, testing all bounding boxes takes half as long as a tree of them.
        self._boxes = pin.BroadPhaseManager_NaiveCollisionManager(pairs.model, pairs.geometry, work)
        self._work = work
        self._data = pairs.model.createData()
        self._collide = pin.computeCollisions

    def __call__(self, q: Array) -> bool:
        """Return whether any pair is nearer than the margin at joints q (n,)."""
        return bool(self._collide(self._pairs.model, self._data, self._boxes, q, True))


def _forget(requests: Any) -> None:
    """Let every question start anew: pinocchio starts from the last answer's direction."""
    import coal  # pyright: ignore[reportMissingImports]

    for request in requests:
        request.gjk_initial_guess = coal.GJKInitialGuess.DefaultGuess
        request.enable_cached_gjk_guess = False
