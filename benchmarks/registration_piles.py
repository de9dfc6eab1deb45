"""Heaps of objects: dropped one after the other with PyBullet until all are at rest.

Imported by `registration_cases.py`. Objects lean on each other, some rest on others, and some are
in no pose that is stable on a table. Contacts are those of convex parts, which hold the mesh; the
world is ten times as large as it seems, because the engine's margins are made for metres.
"""

import tempfile
from collections.abc import Mapping, Sequence
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from realsim.arrays import Array
from realsim.geometry import se3
from realsim.geometry.mesh import mass_properties
from realsim.models.convex import convex_parts
from realsim.models.convex_worker import ConvexConfig
from realsim.records import ObjectModel, ObjectPose

SCALE = 10.0
"""Metres of the engine per metre."""
GRAVITY = 9.81
STEP_S = 1 / 480
"""Step of the real world [s]; the engine's is sqrt(SCALE) longer."""
HEAP_M = 0.09
"""Objects are dropped with their middle in a disc of this radius [m]."""
RING_M = 0.13
"""A wall around the heap while it is made keeps balls and cans from rolling off [m]; it is taken
away, and what leant on it finds its rest."""
RING_SIDES = 24
KEPT_M = 0.19
"""What rolled farther than this from the middle is taken away [m]."""
GAP_M = 0.01
"""An object is let go this far over everything else [m]."""
BETWEEN_S = 0.35
"""From one object to the next [s]."""
SETTLE_S = 3.0
"""After the last one [s]."""
CALM_S = 1.0
"""Then so long with motion damped, so that nothing rocks for ever [s]."""
DAMPING = 0.9
FRICTION, ROLLING = 0.6, 3e-4
"""Coefficients of sliding [-] and rolling [m of the engine]."""
PARTS = ConvexConfig(thresholds=(0.1,), max_parts=24, time_limit_s=20.0)
"""Coarse parts will do: hollows stay hollow."""


@cache
def _parts(model: ObjectModel, keep: Path | None) -> tuple[Array, ...]:
    """Return the convex parts (V, 3) of a model."""
    cache_folder = None if keep is None else keep / "convex"
    if cache_folder is not None:
        cache_folder.mkdir(parents=True, exist_ok=True)
    found = convex_parts(model.mesh, PARTS, cache_folder)
    return tuple(np.asarray(part, dtype=np.float64) for part in found.parts)


def _obj_text(parts: Sequence[Array]) -> str:
    """Return the hulls of parts (V, 3) as an .obj of several objects, one hull each."""
    from scipy.spatial import ConvexHull

    lines: list[str] = []
    first = 1
    for n, v in enumerate(parts):
        lines.append(f"o part_{n}")
        lines += [f"v {x:.6f} {y:.6f} {z:.6f}" for x, y, z in v]
        lines += [f"f {a + first} {b + first} {c + first}" for a, b, c in ConvexHull(v).simplices]
        first += len(v)
    return "\n".join(lines) + "\n"


def _body(p: Any, client: int, model: ObjectModel, middle: Array, keep: Path | None) -> int:
    """Return the engine's number of an object whose frame is moved to its centre of mass."""
    with tempfile.NamedTemporaryFile("w", suffix=".obj") as file:
        file.write(_obj_text([SCALE * (v - middle) for v in _parts(model, keep)]))
        file.flush()
        shape = p.createCollisionShape(p.GEOM_MESH, fileName=file.name, physicsClientId=client)
    body = p.createMultiBody(0.1, shape, physicsClientId=client)
    p.changeDynamics(
        body, -1, lateralFriction=FRICTION, rollingFriction=ROLLING, spinningFriction=ROLLING,
        restitution=0.0, physicsClientId=client,
    )  # fmt: skip
    return int(body)


def piled(
    models: Mapping[int, ObjectModel], rng: np.random.Generator, keep: Path | None
) -> tuple[ObjectPose, ...]:
    """Return where objects come to rest that are dropped onto a heap.

    Args:
        models: what is dropped, one of each, in random order.
        rng: of order, places and turns.
        keep: folder in which convex parts are kept; None = made anew.
    """
    import pybullet as p

    client = p.connect(p.DIRECT)
    try:
        # Lengths are SCALE times as great, so times are sqrt(SCALE) times as long.
        p.setGravity(0, 0, -GRAVITY, physicsClientId=client)
        p.setTimeStep(STEP_S * np.sqrt(SCALE), physicsClientId=client)
        p.setPhysicsEngineParameter(numSolverIterations=150, physicsClientId=client)
        ground = p.createCollisionShape(p.GEOM_PLANE, physicsClientId=client)
        table = p.createMultiBody(0, ground, physicsClientId=client)
        p.changeDynamics(table, -1, lateralFriction=FRICTION, physicsClientId=client)
        ring = _ring(p, client)
        middles = {i: mass_properties(m.mesh, 1000.0).center_of_mass for i, m in models.items()}
        bodies: dict[int, int] = {}
        for obj_id in rng.permutation(sorted(models)):
            i = int(obj_id)
            bodies[i] = _body(p, client, models[i], middles[i], keep)
            _let_go(p, client, bodies[i], [b for k, b in bodies.items() if k != i], rng)
            _run(p, client, BETWEEN_S)
        for side in ring:
            p.removeBody(side, physicsClientId=client)
        _run(p, client, SETTLE_S)
        for body in bodies.values():
            p.changeDynamics(
                body, -1, linearDamping=DAMPING, angularDamping=DAMPING, physicsClientId=client
            )
        _run(p, client, CALM_S)
        poses: list[ObjectPose] = []
        for i in sorted(bodies):
            T = _pose(p, client, bodies[i]) @ se3.from_translation(-middles[i])
            at = se3.transform(T, middles[i][None])[0]
            if np.linalg.norm(at[:2]) < KEPT_M:
                lifted = _lifted(T, models[i])
                poses.append(ObjectPose(obj_id=i, instance=len(poses), T_world_obj=lifted))
        return tuple(poses)
    finally:
        p.disconnect(physicsClientId=client)


def _ring(p: Any, client: int) -> list[int]:
    """Return the sides of the wall around the heap."""
    thick, high = 0.02, 0.5
    half = [SCALE * v for v in (thick / 2, (RING_M + thick) * np.pi / RING_SIDES, high / 2)]
    shape = p.createCollisionShape(p.GEOM_BOX, halfExtents=half, physicsClientId=client)
    sides: list[int] = []
    for angle in 2 * np.pi * np.arange(RING_SIDES) / RING_SIDES:
        out = SCALE * (RING_M + thick / 2)
        side = p.createMultiBody(
            0, shape, basePosition=[out * np.cos(angle), out * np.sin(angle), half[2]],
            baseOrientation=p.getQuaternionFromEuler([0, 0, angle]), physicsClientId=client,
        )  # fmt: skip
        p.changeDynamics(side, -1, lateralFriction=0.0, physicsClientId=client)
        sides.append(int(side))
    return sides


def _let_go(p: Any, client: int, body: int, others: list[int], rng: np.random.Generator) -> None:
    """Put a body over all others, turned anyhow."""
    quaternion = rng.standard_normal(4)
    around, out = rng.uniform(0, 2 * np.pi), HEAP_M * np.sqrt(rng.random())
    at = SCALE * out * np.array([np.cos(around), np.sin(around), 0.0])
    p.resetBasePositionAndOrientation(
        body, [*at], (quaternion / np.linalg.norm(quaternion)).tolist(), physicsClientId=client
    )
    tops = [p.getAABB(b, -1, physicsClientId=client)[1][2] for b in others]
    low = p.getAABB(body, -1, physicsClientId=client)[0][2]
    up = max([0.0, *tops]) + SCALE * GAP_M - low
    _, orientation = p.getBasePositionAndOrientation(body, physicsClientId=client)
    p.resetBasePositionAndOrientation(body, [at[0], at[1], up], orientation, physicsClientId=client)


def _run(p: Any, client: int, seconds: float) -> None:
    """Let time pass [s of the real world]."""
    for _ in range(round(seconds / STEP_S)):
        p.stepSimulation(physicsClientId=client)


def _pose(p: Any, client: int, body: int) -> Array:
    """Return where a body is (4, 4) [m]."""
    at, xyzw = p.getBasePositionAndOrientation(body, physicsClientId=client)
    R = np.reshape(p.getMatrixFromQuaternion(xyzw), (3, 3))
    U, _, Vt = np.linalg.svd(R)
    return se3.from_rt(U @ Vt, np.asarray(at) / SCALE)


def _lifted(T: Array, model: ObjectModel) -> Array:
    """Return the pose (4, 4) lifted out of the table, into which contacts may press it."""
    low = float(se3.transform(T, model.mesh.vertices)[:, 2].min())
    return se3.from_translation([0.0, 0.0, max(0.0, -low)]) @ T
