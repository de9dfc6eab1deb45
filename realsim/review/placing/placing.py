"""Placing an object by hand: steps along axes, clicked points, down onto the table."""

from dataclasses import dataclass
from typing import Literal, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from realsim.arrays import Array
from realsim.errors import InputError
from realsim.geometry import se3
from realsim.records import Mesh, SupportPlane

Axis = Literal["x", "y", "z"]
Kind = Literal["move", "turn"]
Frame = Literal["table", "object", "camera"]
AXES: tuple[Axis, ...] = ("x", "y", "z")
LEAST_ACROSS_M = 0.002
"""Clicked points must spread this far (RMS) across the line through them [m]: a click is good to
2 mm, and with less than that the turn about the line is anybody's guess."""
LEAST_ACROSS_SHARE = 0.08
"""The same as a share of their spread along it."""
DISTANCE_SHARE = 0.25
"""By how much of their distance two clicked pairs may disagree."""
DISTANCE_M = (0.004, 0.010)
"""They may at least and at most by so much [m]: two clicks of 2 to 3 mm each differ by no more."""


class Moved(NamedTuple):
    """How far one pose is from another."""

    mm: float
    """Motion of the object's middle [mm]."""
    deg: float
    """Turn [deg]."""


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class PointFit:
    """A pose from clicked points."""

    T_world_obj: Array
    """(4, 4)."""
    rms_m: float
    """RMS distance of the pairs in that pose [m]."""
    words: str
    """How well the points fit, for a person."""


def middle_of(mesh: Mesh) -> Array:
    """Return the object's middle (3,): the centre of its bounds, in its own frame [m]."""
    return mesh.bounds.mean(0)


def nudged(
    T_world_obj: ArrayLike,
    axis: Axis,
    amount: float,
    kind: Kind,
    frame: Frame,
    *,
    T_world_table: ArrayLike | None = None,
    T_world_cam: ArrayLike | None = None,
    pivot_obj: ArrayLike | None = None,
) -> Array:
    """Return the pose (4, 4) after one step along, or turn about, an axis of a frame.

    Args:
        T_world_obj: (4, 4) before.
        axis: of the frame.
        amount: of a move [m], of a turn [rad]; negative goes the other way.
        kind: a turn goes about the axis through the pivot, which stays where it is.
        frame: whose axis is meant.
        T_world_table: (4, 4) the table; None = the world's axes.
        T_world_cam: (4, 4) the camera; needed for its frame.
        pivot_obj: (3,) what a turn is about, in the object's frame [m]: its middle (`middle_of`).

    Raises:
        InputError: an axis, a kind or a frame that is not known, an amount that is not finite, no
            camera for the camera's frame, or a turn without a pivot.
    """
    T = se3.check_rigid(T_world_obj, "the pose of the object")
    if axis not in AXES:
        raise InputError(f"the axis is '{axis}'; x, y or z is accepted.")
    if not np.isfinite(amount):
        raise InputError(f"the step is {amount}; a finite number of metres or radians is needed.")
    direction = _axes_of(frame, T, T_world_table, T_world_cam)[:, AXES.index(axis)]
    if kind == "move":
        return se3.from_rt(T[:3, :3], T[:3, 3] + amount * direction)
    if kind != "turn":
        raise InputError(f"the step is a '{kind}'; move or turn is accepted.")
    if pivot_obj is None:
        raise InputError("a turn needs the point it is about; give the object's middle as pivot.")
    pivot = np.asarray(pivot_obj, dtype=np.float64).reshape(3)
    R = _orthonormal(se3.exp_so3(amount * direction) @ T[:3, :3])
    return se3.from_rt(R, T[:3, :3] @ pivot + T[:3, 3] - R @ pivot)


def _axes_of(
    frame: Frame, T_world_obj: Array, T_world_table: ArrayLike | None, T_world_cam: ArrayLike | None
) -> Array:
    """Return the axes (3, 3) of a frame in world, one a column."""
    if frame == "object":
        return T_world_obj[:3, :3]
    if frame == "table":
        if T_world_table is None:
            return np.eye(3)
        return se3.check_rigid(T_world_table, "the pose of the table")[:3, :3]
    if frame != "camera":
        raise InputError(f"the frame is '{frame}'; table, object or camera is accepted.")
    if T_world_cam is None:
        raise InputError("a step along the camera's axes needs a camera; stand in one first.")
    return se3.check_rigid(T_world_cam, "the pose of the camera")[:3, :3]


def _orthonormal(R: Array) -> Array:
    """Return the nearest rotation (3, 3): a hundred small steps must not add up their rounding."""
    U, _, Vt = np.linalg.svd(R)
    return U @ Vt


def moved(T_before: ArrayLike, T_after: ArrayLike, mesh: Mesh) -> Moved:
    """Return how far an object was moved: its middle, and its turn.

    Args:
        T_before: (4, 4) T_world_obj.
        T_after: (4, 4) T_world_obj.
        mesh: the object.
    """
    before = np.asarray(T_before, dtype=np.float64)
    after = np.asarray(T_after, dtype=np.float64)
    D = after - before
    step = D[:3, :3] @ middle_of(mesh) + D[:3, 3]
    return Moved(
        mm=1e3 * float(np.linalg.norm(step)),
        deg=float(np.degrees(se3.angle(before[:3, :3].T @ after[:3, :3]))),
    )


def on_table(T_world_obj: ArrayLike, mesh: Mesh, plane: SupportPlane) -> Array:
    """Return the pose (4, 4) lowered or raised along the table's normal until it touches.

    Args:
        T_world_obj: (4, 4) before.
        mesh: the object.
        plane: the table.
    """
    T = se3.check_rigid(T_world_obj, "the pose of the object")
    up = plane.T_world_table[:3, 2]
    heights = (se3.transform(T, mesh.vertices) - plane.T_world_table[:3, 3]) @ up
    return se3.from_rt(T[:3, :3], T[:3, 3] - float(heights.min()) * up)


def from_points(points_obj: ArrayLike, points_world: ArrayLike) -> PointFit:
    """Return the pose that brings points of the object onto points of the scene.

    Rigid least squares (Kabsch 1976; Umeyama 1991 for the sign): with both sets centred and
    U S V^T = sum world obj^T, R = U diag(1, 1, det(U V^T)) V^T.

    Args:
        points_obj: (N, 3) clicked on the model, in its own frame [m]; three or more.
        points_world: (N, 3) the same points clicked in the scene [m].

    Raises:
        InputError: fewer than three pairs, numbers that are not finite, points (nearly) on one
            line, or two points whose distance on the model is not that in the scene.
    """
    obj, world = _pairs(points_obj, points_world)
    _check_spread(obj, "on the model")
    _check_spread(world, "in the scene")
    _check_distances(obj, world)
    mean_obj, mean_world = obj.mean(0), world.mean(0)
    U, _, Vt = np.linalg.svd((world - mean_world).T @ (obj - mean_obj))
    R = U @ np.diag([1.0, 1.0, np.sign(np.linalg.det(U @ Vt))]) @ Vt
    T = se3.from_rt(R, mean_world - R @ mean_obj)
    off = np.linalg.norm(se3.transform(T, obj) - world, axis=1)
    rms = float(np.sqrt(np.mean(np.square(off))))
    worst = int(np.argmax(off))
    words = (
        f"placed by {len(obj)} points, which fit to {1e3 * rms:.1f} mm (RMS); the worst, point "
        f"{worst + 1}, is off by {1e3 * off[worst]:.1f} mm"
    )
    return PointFit(T_world_obj=T, rms_m=rms, words=words)


def _pairs(points_obj: ArrayLike, points_world: ArrayLike) -> tuple[Array, Array]:
    """Return both sets as (N, 3), checked."""
    obj = np.atleast_2d(np.asarray(points_obj, dtype=np.float64))
    world = np.atleast_2d(np.asarray(points_world, dtype=np.float64))
    if obj.shape != world.shape or obj.ndim != 2 or obj.shape[1] != 3:
        raise InputError(
            f"points of the shapes {obj.shape} (model) and {world.shape} (scene) are no pairs; "
            "(N, 3) of each is accepted. Click every point once on the model and once in the scene."
        )
    if len(obj) < 3:
        raise InputError(f"{len(obj)} points do not hold an object; click at least 3 on each side.")
    if not (np.all(np.isfinite(obj)) and np.all(np.isfinite(world))):
        raise InputError("a clicked point is not finite; click it again.")
    return obj, world


def _check_spread(points: Array, where: str) -> None:
    """Refuse points (N, 3) that lie on one line, or nearly: the turn about it would be a guess."""
    spread = np.linalg.svd(points - points.mean(0), compute_uv=False) / np.sqrt(len(points))
    needed = max(LEAST_ACROSS_M, LEAST_ACROSS_SHARE * float(spread[0]))
    if spread[1] < needed:
        raise InputError(
            f"the points {where} lie nearly on one line: they spread {1e3 * spread[0]:.1f} mm "
            f"along it and {1e3 * spread[1]:.1f} mm across; {1e3 * needed:.1f} mm are needed. "
            "Click points that make a wide triangle."
        )


def _check_distances(obj: Array, world: Array) -> None:
    """Refuse pairs whose distances disagree by more than clicks are off by: one is a wrong point.

    Raises:
        InputError: names the pair that disagrees most.
    """
    a, b = np.triu_indices(len(obj), 1)
    on_model = np.linalg.norm(obj[a] - obj[b], axis=1)
    in_scene = np.linalg.norm(world[a] - world[b], axis=1)
    beyond = np.abs(on_model - in_scene) - np.clip(DISTANCE_SHARE * on_model, *DISTANCE_M)
    k = int(np.argmax(beyond))
    if beyond[k] > 0:
        allowed = float(np.clip(DISTANCE_SHARE * on_model[k], *DISTANCE_M))
        raise InputError(
            f"points {a[k] + 1} and {b[k] + 1} lie {1e3 * on_model[k]:.1f} mm apart on the model "
            f"but {1e3 * in_scene[k]:.1f} mm in the scene; {1e3 * allowed:.1f} mm of difference "
            "are accepted. One of them is another place of the object: click it again."
        )
