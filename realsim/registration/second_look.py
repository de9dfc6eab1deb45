"""What only a joint fit shows to be wrong with its inputs; then it is made again without them.

A plane that lies on objects alone is no table. A view whose camera had to be moved much further
than the others' has depth beside its image, or the pose of another moment. An object that is
rejected pulls the cameras all the same.
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from realsim.arrays import Array
from realsim.geometry import se3
from realsim.records import ObjectModel, ObjectPose, SupportPlane
from realsim.registration.body import Body
from realsim.registration.config import RegistrationConfig
from realsim.registration.intake import Intake
from realsim.registration.judge import Defect
from realsim.registration.many_views import ManyViews
from realsim.registration.view_agreement import ViewFinding
from realsim.registration.view_checks import check_views

NO_TABLE = "what looked like a table is seen on the objects only"
"""Why there is no plane."""
POINTS = 20_000
"""Points of all views that are asked where the plane is seen."""
ON_TABLE_M = 0.003
"""A point so near to the plane is on it [m]."""
BESIDE_M = 0.012
"""A point so far from all objects is beside them [m]."""
CELL_M = 0.01
"""Cells by which areas on the plane are measured [m]."""
LEAST_BESIDE = 1.0
"""Least area of a table that is seen beside the placed objects, as a share of what all wanted
ones cover: an invented one lies on the objects, or on some that were not placed."""
ODD_M = 0.0015
"""A view is odd whose camera was moved by so much, seen at the objects [m]."""
ODD_FACTOR = 3.5
"""It was moved by so many times the median of all views, too. One view whose depth lay 9 px
beside its image moved 4.2 times as far, because it pulls the others along. Of 144 sound views
none moved more than 3.0 times as far, nor by more than 0.9 mm."""
MOST_ODD = 0.25
"""Share of the views that may be odd: of more, the others are no measure."""
MOVED_M = 0.0015
"""If all cameras were moved by so much in the median, that is told [m]: an arm is not so
coarse."""
UNSURE_M = 0.003
"""If by more, which is what a right pose may be off, no pose is accepted [m]: cameras follow a
model of another size, and then everything fits it."""
EXPLAINED_SIGMAS = 5.0
"""So many sigmas per axis of what the arm, or a hand that holds the camera, is said to be off
by are no reason to doubt."""


def is_beside_objects(
    many: ManyViews, bodies: Sequence[Body], plane: SupportPlane, wanted: Sequence[ObjectModel]
) -> bool:
    """Return whether the plane is seen beside the objects, as a table is.

    Args:
        many: the joint fit.
        bodies: the objects that were placed.
        plane: what may be a table.
        wanted: the models of all objects that should be there.
    """
    every = max(1, sum(len(v.points) for v in many.views) // POINTS)
    points = np.concatenate([
        se3.transform(v.T_world_cam, v.points[::every].astype(np.float64)) for v in many.views
    ])  # fmt: skip
    there = se3.transform(se3.invert(plane.T_world_table), points)
    is_on = np.abs(there[:, 2]) < ON_TABLE_M
    on = points[is_on]
    beside = np.ones(len(on), dtype=np.bool_)
    for body, T in zip(bodies, many.poses, strict=True):
        near = np.linalg.norm(on - body.center(T), axis=1) < body.radius_m + BESIDE_M
        d = body.field.distance(on[near], se3.invert(T))
        beside[near] &= d > BESIDE_M
    cells = np.unique(np.floor(there[is_on][beside][:, :2] / CELL_M), axis=0)
    covered = sum(float(np.prod(np.sort(m.mesh.extent)[1:])) for m in wanted)
    return len(cells) * CELL_M**2 >= LEAST_BESIDE * covered


def camera_moves(many: ManyViews, bodies: Sequence[Body]) -> Array:
    """Return by how much each view of the hand alone was moved (F,), at the objects' middle [m]."""
    cameras = many.hand_cameras
    middle = np.mean([b.center(T) for b, T in zip(bodies, many.poses, strict=True)], axis=0)
    x = many.refined.state.views[: len(cameras), :6]
    at = np.einsum("vji,vj->vi", cameras[:, :3, :3], middle - cameras[:, :3, 3])
    return np.linalg.norm(x[:, 3:] + np.cross(x[:, :3], at), axis=1)


def odd_views(intake: Intake, moves: Array, least_views: int) -> list[ViewFinding]:
    """Return the views whose cameras had to be moved much further than the others'."""
    usual = float(np.median(moves))
    odd = moves > max(ODD_M, ODD_FACTOR * usual)
    count = int(np.count_nonzero(odd))
    if count > MOST_ODD * len(moves) or len(moves) - count < least_views:
        return []
    return [
        ViewFinding(
            index=frame.index, kind="objects_off", exclude=True,
            words=f"view {frame.index}: its camera would have to be {1e3 * move:.1f} mm from where "
            f"it is said to be for its depth to fit ({1e3 * usual:.1f} mm in the median view): its "
            "depth lies beside its photograph, or its pose is of another moment. It is left out.",
        )
        for frame, move, is_odd in zip(intake.frames, moves, odd, strict=True) if is_odd
    ]  # fmt: skip


def without_views(intake: Intake, odd: Sequence[ViewFinding]) -> Intake:
    """Return the intake without the odd views, with what is said of them."""
    gone = {f.index for f in odd}
    kept = [k for k, f in enumerate(intake.frames) if f.index not in gone]
    return replace(
        intake, frames=tuple(intake.frames[k] for k in kept),
        views=tuple(intake.views[k] for k in kept), findings=(*intake.findings, *odd),
    )  # fmt: skip


def views_off(intake: Intake, many: ManyViews, bodies: Sequence[Body]) -> list[ViewFinding]:
    """Return the views that do not fit the registered objects, their cameras refined."""
    found = check_views(
        many.hand_views, many.plane, intake.noise, bodies=bodies,
        Ts_world_obj=many.poses,
    )  # fmt: skip
    known = {f.index for f in intake.findings}
    return [f for f in found if f.kind == "objects_off" and f.index not in known]


def far_moved(moves: Array, config: RegistrationConfig) -> list[ViewFinding]:
    """Return that all cameras were moved far, if they were: 'cameras_far' if no arm explains it."""
    usual = float(np.median(moves))
    if usual < MOVED_M:
        return []
    words = (
        f"each camera had to be moved by {1e3 * usual:.1f} mm on its own (median) for the depth of "
        "all views to agree: the depth is scaled or does not lie on the colour image's pixels, the "
        "camera's lens is another's, the robot's poses are coarse, or a model is larger or smaller "
        "than its object (`--no-cameras` registers without moving them and names its size). Poses "
        "fit the depth; look at the outlines on the photographs before you use them."
    )
    explained_m = EXPLAINED_SIGMAS * (config.arm_sigma_mm or 0.0) / 1e3
    kind = "cameras_far" if usual > max(UNSURE_M, explained_m) else "cameras_moved"
    return [ViewFinding(index=None, kind=kind, words=words, exclude=False)]


def unsure(placed: Sequence[ObjectPose], found: Sequence[Defect]) -> tuple[ObjectPose, ...]:
    """Return the objects; where the cameras were moved too far for it, none is accepted."""
    words = "the cameras had to be moved by more than a right pose may be off, until it fitted"
    if not any(f.kind == "cameras_far" for f in found):
        return tuple(placed)
    return tuple(
        replace(o, verdict="doubtful", reasons=(*o.reasons, words))
        if o.verdict == "accepted"
        else o
        for o in placed
    )
