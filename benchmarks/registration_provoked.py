"""Wrong poses that somebody insists on: may any of them be accepted?

Imported by the registration benchmark. In every round some objects of a scene are claimed to be
where they are not, the others are known well. Twice: the claims go through the whole registration,
which may not seek these objects anywhere else; and they are given to refinement and judgement as if
a search had found them ('judged ...'; no pairwise contrast there, so no near-symmetric ones). What
is put right all the same is not wrong any more and does not count.
"""

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
from registration_cases import moved_start, stream
from registration_errors import rows_of
from registration_figures import Done, Row
from registration_methods import Given, registered

from realsim.arrays import Array
from realsim.geometry import se3
from realsim.records import ObjectModel, ObjectPose
from realsim.registration.body import make_body
from realsim.registration.intake import take_in
from realsim.registration.judge import Poses, judge_objects
from realsim.registration.many_views import comparer_on, register_many
from realsim.registration.search.records import Region, Wanted

ROUNDS = 3
JUDGED_ROUNDS = 2
KINDS = ("near", "slid", "turned", "near", "place")
"""One of each in a round: half a turn about an axis of its own or half a step of its symmetry; slid
over the table; turned about any axis; on the place of another object."""
JUDGED_KINDS = ("slid", "turned", "place", "slid", "turned")
SLID_M = (0.010, 0.030)
TURNED_DEG = (15.0, 60.0)
INSISTED = (0.002, 2.0)
"""What is claimed is right to so much, it is said [m, deg]."""
NEAR_OFF = (0.005, 3.0)
"""Starts of the other objects are off by this [m, deg]."""


def _middle(model: ObjectModel) -> Array:
    low, high = model.mesh.bounds
    return 0.5 * (low + high)


def wrong_pose(g: Given, k: int, kind: str, rng: np.random.Generator) -> Array:
    """Return a wrong pose (4, 4) of object k."""
    true = g.scene.truth[k]
    model = g.models[true.obj_id]
    T, c = true.T_world_obj, _middle(model)
    if kind == "slid":
        angle, length = rng.uniform(0, 2 * np.pi), rng.uniform(*SLID_M)
        return se3.from_translation([length * np.cos(angle), length * np.sin(angle), 0.0]) @ T
    if kind == "place":
        other = g.scene.truth[int(rng.choice([j for j in range(len(g.scene.truth)) if j != k]))]
        to = se3.transform(other.T_world_obj, _middle(g.models[other.obj_id])[None])[0]
        yaw = se3.exp_so3([0.0, 0.0, rng.uniform(0, 2 * np.pi)])
        R = yaw @ T[:3, :3]
        return se3.from_rt(R, to - R @ c)
    if kind == "near":
        steps = max(2, len(model.symmetries))
        angle = np.pi if rng.random() < 0.5 else np.pi / steps * 2
        axis = np.eye(3)[int(rng.integers(3))]
    else:
        angle = np.radians(rng.uniform(*TURNED_DEG))
        axis = rng.standard_normal(3)
        axis /= np.linalg.norm(axis)
    R = se3.exp_so3(angle * axis)
    return T @ se3.from_rt(R, c - R @ c)


def provoked(g: Given, rounds: int = ROUNDS, judged_rounds: int = JUDGED_ROUNDS) -> Done:
    """Return what came of the wrong claims.

    Args:
        g: the scene.
        rounds: registrations with wrong claims.
        judged_rounds: judgements of wrong poses as if a search had found them.
    """
    rng = stream(g.key.seed, "provoked")
    rows: list[Row] = []
    for _ in range(rounds):
        kinds = _kinds(g, KINDS, rng)
        wanted: list[Wanted] = []
        for k, T in enumerate(_claims(g, kinds, rng)):
            true = g.scene.truth[k]
            radius, turn = INSISTED if k in kinds else (2 * NEAR_OFF[0], 2 * NEAR_OFF[1])
            at = se3.transform(T, _middle(g.models[true.obj_id])[None])[0]
            region = Region(center_world=at, radius_m=radius, R_world_obj=T[:3, :3], turn_deg=turn)
            wanted.append(
                Wanted(obj_id=true.obj_id, instance=true.instance, region=region, T_start=T)
            )
        found, _ = registered(g, wanted)
        every = rows_of("claimed", g.key.seed, g.scene, found.scene.objects)
        rows += [replace(row, part=kinds.get(k, "beside")) for k, row in enumerate(every)]
    for _ in range(judged_rounds):
        kinds = _kinds(g, JUDGED_KINDS, rng)
        objects = _judged(g, _claims(g, kinds, rng))
        every = rows_of("judged", g.key.seed, g.scene, objects)
        rows += [
            replace(row, part=f"judged {kinds[k]}" if k in kinds else "beside")
            for k, row in enumerate(every)
        ]
    return Done(rows=tuple(rows))


def _kinds(g: Given, kinds: Sequence[str], rng: np.random.Generator) -> dict[int, str]:
    """Return which objects are claimed wrongly, and how."""
    count = min(len(kinds), len(g.scene.truth))
    picked = rng.choice(len(g.scene.truth), count, replace=False)
    return {int(k): kind for k, kind in zip(picked, kinds, strict=False)}


def _claims(g: Given, kinds: Mapping[int, str], rng: np.random.Generator) -> list[Array]:
    """Return the claimed poses (4, 4) of all objects."""
    return [
        wrong_pose(g, k, kinds[k], rng)
        if k in kinds
        else moved_start(true, g.models[true.obj_id], NEAR_OFF, rng).T_world_obj
        for k, true in enumerate(g.scene.truth)
    ]


def _judged(g: Given, claims: Sequence[Array]) -> list[ObjectPose]:
    """Return claims refined and judged as if a search had found them."""
    c = g.config
    intake = take_in(g.scene.intrinsics, g.scene.frames, c)
    bodies = [
        make_body(replace(true, T_world_obj=T), g.models[true.obj_id], c.field_cells, c.samples,
                  c.field_folder)
        for true, T in zip(g.scene.truth, claims, strict=True)
    ]  # fmt: skip
    many = register_many(intake, bodies, [None] * len(bodies), intake.plane, c)
    comparer = comparer_on(intake, many.frames, many.plane, bodies, many.poses)
    given = Poses(
        bodies=bodies, poses=many.poses, clouds=many.clouds, covariances=list(many.covariances),
        blind=[0] * len(bodies), contrasts=[None] * len(bodies), cameras=many.refined.cameras,
        plane=many.plane, known=(), with_starts=False,
    )  # fmt: skip
    return judge_objects(replace(intake, views=many.views), given, comparer, c).objects
