"""How sure the refined poses are: of every object in world, in every view, and in pixels.

Object and camera errors are correlated: a camera that is off by a millimetre moves all objects in
its image alike. The covariance of an object seen from a view therefore needs all three: the
object's, the cameras', and what they have in common.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from realsim.arrays import Array
from realsim.geometry import se3
from realsim.records import CameraIntrinsics
from realsim.registration.body import Body
from realsim.registration.refinement import equations
from realsim.registration.refinement.refine import Refined

TINY = 1e-16
"""A variance far below any that counts [rad^2, m^2]."""
PIXEL_SAMPLES = 40
"""Points of the surface over which the pixel uncertainty is averaged."""


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class SeenPose:
    """One object in one view."""

    T_cam_obj: Array
    """(4, 4)."""
    covariance: Array
    """(6, 6) of the right perturbation in the object's frame, rotation first [rad, m]."""
    sigma_px: float
    """RMS over the object's points of their 1-sigma in the image [px]; NaN = behind the camera."""


def object_covariance(refined: Refined, body: Body, k: int) -> Array:
    """Return the covariance (6, 6) of T_world_obj: right perturbation, rotation first [rad, m]."""
    at = equations.object_at(k)
    # T exp(xi) with xi about the object's origin: T c exp(eta) c^-1, xi = Ad(c) eta.
    Ad = se3.adjoint(se3.from_translation(body.center_obj))
    return _symmetric(Ad @ refined.covariance.shared[np.ix_(at, at)] @ Ad.T)


def common_and_own(refined: Refined, bodies: Sequence[Body]) -> tuple[Array, Array]:
    """Return the covariance of what all objects have in common, and of what is each one's own.

    Common is the move M x of everything on the table, about the middle of the objects and in world
    axes, that is most likely behind the objects' moves y of covariance C (generalised least
    squares): x = (M' C^-1 M)^-1 M' C^-1 y. What is left of y is each object's own.

    Returns:
        (6, 6), and (K, 6, 6) about the objects' centres in their axes [rad, m].
    """
    C = refined.covariance.shared[equations.OBJECTS :, equations.OBJECTS :]
    moves = equations.moves_of_all(bodies, refined.state)[equations.OBJECTS :]
    weighted = np.linalg.solve(C + TINY * np.eye(len(C)), moves)
    nearest = np.linalg.solve(moves.T @ weighted, weighted.T)
    left = np.eye(len(C)) - moves @ nearest
    own = (left @ C @ left.T).reshape(len(bodies), 6, len(bodies), 6)
    return (
        _symmetric(nearest @ C @ nearest.T),
        np.stack([_symmetric(own[k, :, k]) for k in range(len(bodies))]),
    )


def seen_poses(
    refined: Refined, bodies: Sequence[Body], intrinsics: CameraIntrinsics
) -> list[list[SeenPose]]:
    """Return for every object its pose in every view, cameras' uncertainty included.

    Of a camera that stands still the pixels are counted as if it were the one in the hand.
    """
    return [_seen(refined, body, k, intrinsics) for k, body in enumerate(bodies)]


def _seen(refined: Refined, body: Body, k: int, intrinsics: CameraIntrinsics) -> list[SeenPose]:
    """Return one object's pose in every view."""
    C = refined.covariance
    picked = np.concatenate([equations.object_at(k), equations.HAND_EYE_AT])
    T_centre = equations.centre_pose(body, refined.poses[k])
    Ms = se3.invert(T_centre) @ refined.cameras
    Ad = se3.adjoint(Ms)
    # Columns: object, hand-eye, view. The twist of T_cam_obj is xi_o - Ad(M) (hand-eye + view).
    common = refined.state.common
    hand = -Ad if common is None else -common[:, None, None] * Ad
    J = np.concatenate([np.tile(np.eye(6), (len(Ms), 1, 1)), hand, -Ad], axis=2)
    joint = np.empty((len(Ms), 18, 18))
    joint[:, :12, :12] = C.shared[np.ix_(picked, picked)]
    joint[:, :12, 12:] = C.cross[:, picked, :6]
    joint[:, 12:, :12] = np.swapaxes(C.cross[:, picked, :6], 1, 2)
    joint[:, 12:, 12:] = C.views[:, :6, :6]
    centre = J @ joint @ np.swapaxes(J, 1, 2)
    back = se3.adjoint(se3.from_translation(body.center_obj))
    axes = [(np.asarray(a), np.asarray(p) - body.center_obj) for a, p in body.model.symmetry_axes]
    every = max(1, len(body.samples) // PIXEL_SAMPLES)
    q = body.samples[::every] - body.center_obj
    out: list[SeenPose] = []
    for v in range(len(Ms)):
        out.append(
            SeenPose(
                T_cam_obj=se3.invert(refined.cameras[v]) @ refined.poses[k],
                covariance=_symmetric(back @ centre[v] @ back.T),
                sigma_px=_sigma_px(
                    se3.invert(Ms[v]), without_turns(centre[v], axes, q), q, intrinsics
                ),
            )
        )
    return out


def without_turns(
    C: Array, axes: Sequence[tuple[Sequence[float] | Array, Sequence[float] | Array]], q: Array
) -> Array:
    """Return a covariance (6, 6) without turns about axes of continuous symmetry.

    Nothing is seen of such a turn s. Of a twist x the part P x is left that moves the points
    q (N, 3) least: P = I - s s^T M / (s^T M s), M the mean of the points' squared motion.
    """
    G = np.concatenate([-se3.hat(q), np.tile(np.eye(3), (len(q), 1, 1))], axis=2)
    M = np.mean(np.swapaxes(G, 1, 2) @ G, axis=0)
    for axis, place in axes:
        turn = np.concatenate([axis, -np.cross(axis, place)])
        P = np.eye(6) - np.outer(turn, turn @ M) / (turn @ M @ turn)
        C = P @ C @ P.T
    return C


def _sigma_px(T_cam_centre: Array, C: Array, q: Array, intrinsics: CameraIntrinsics) -> float:
    """Return the RMS 1-sigma in the image of points q (N, 3) of the centred frame [px].

    The lens is taken for straight: its distortion changes a sigma by a few per cent.
    """
    p = se3.transform(T_cam_centre, q)
    p = p[p[:, 2] > 0]
    if len(p) == 0:
        return float("nan")
    q = q[: len(p)] if len(p) == len(q) else se3.transform(se3.invert(T_cam_centre), p)
    z = p[:, 2]
    P = np.zeros((len(p), 2, 3))
    P[:, 0, 0], P[:, 0, 2] = intrinsics.fx / z, -intrinsics.fx * p[:, 0] / z**2
    P[:, 1, 1], P[:, 1, 2] = intrinsics.fy / z, -intrinsics.fy * p[:, 1] / z**2
    # A twist moves q by omega x q + v.
    G = np.concatenate([-se3.hat(q), np.tile(np.eye(3), (len(q), 1, 1))], axis=2)
    J = P @ T_cam_centre[:3, :3] @ G
    return float(np.sqrt(np.mean(np.trace(J @ C @ np.swapaxes(J, 1, 2), axis1=1, axis2=2))))


def _symmetric(C: Array) -> Array:
    """Return the symmetric part: rounding must not make a covariance lopsided."""
    return 0.5 * (C + C.T)
