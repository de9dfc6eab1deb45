"""What a lost object does: it falls onto the table, among the others.

The slip test ends where an object is lost; what a camera sees after that is made here, by PyBullet:
the object's convex parts with its true matter fall under gravity, the others stand still as the
hulls of their meshes, and the hand is not in the way any more.
"""

import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from realsim import interop
from realsim.arrays import Array
from realsim.geometry import se3
from realsim.models.convex import collision_obj
from realsim_sim_bridge.slip.bullet_shapes import drawn_in
from realsim_sim_bridge.slip.world import SlipBody

RATE_HZ = 960.0
"""Steps per second: at Bullet's own 240 an object sinks 8 mm into the table as it lands."""
ITERATIONS = 100
"""Solver iterations a step: resting contacts of hulls need more than Bullet's 50."""
FRICTION = 0.5
"""Coulomb coefficient of object and table: wood on plastic."""
MARGIN_M = 0.0005
"""Bullet's margin around hulls [m], which are drawn in by it first; the slip test's."""
GRAVITY = 9.81
"""[m/s^2], along -z of the table."""
TABLE_M = 4.0
"""Edge of the table [m]: nothing falls off it in a second."""


def fall(
    body: SlipBody, T_table_obj: Array, twist: Array, others: Sequence[Array], times_s: Array
) -> Array:
    """Return where a lost object is (S, 4, 4), table frame [m].

    Args:
        body: the object's convex parts and matter.
        T_table_obj: (4, 4) where it is lost [m].
        twist: (6,) its angular [rad/s] and linear velocity of the centre of mass [m/s], table axes.
        others: corners (V, 3) of what else stands there, each taken as its convex hull, table frame
            [m].
        times_s: (S,) since it was lost, not decreasing [s].
    """
    with interop.quiet_output():
        import pybullet
        from pybullet_utils.bullet_client import BulletClient

        engine: Any = BulletClient(connection_mode=pybullet.DIRECT)
    try:
        with tempfile.TemporaryDirectory(prefix="realsim_fall_") as folder:
            number = _build(engine, Path(folder), body, T_table_obj, twist, others)
            return _poses(engine, number, se3.invert(body.principal_frame()[0]), times_s)
    finally:
        engine.disconnect()


def _build(
    engine: Any,
    folder: Path,
    body: SlipBody,
    T_table_obj: Array,
    twist: Array,
    others: Sequence[Array],
) -> int:
    """Put everything into the engine and return the object's number."""
    engine.setPhysicsEngineParameter(
        fixedTimeStep=1.0 / RATE_HZ, numSolverIterations=ITERATIONS, numSubSteps=0,
        deterministicOverlappingPairs=1,
    )  # fmt: skip
    engine.setGravity(0.0, 0.0, -GRAVITY)
    half = TABLE_M / 2.0
    table = engine.createCollisionShape(engine.GEOM_BOX, halfExtents=[half, half, 0.25])
    statics = [engine.createMultiBody(0.0, table, -1, [0.0, 0.0, -0.25])]
    for k, corners in enumerate(others):
        shape, margin = _shape(engine, folder / f"other{k}.obj", [corners])
        statics.append(engine.createMultiBody(0.0, shape))
        engine.changeDynamics(statics[-1], -1, collisionMargin=margin)
    T_obj_body, moments = body.principal_frame()
    parts = [se3.transform(se3.invert(T_obj_body), part) for part in body.parts]
    shape, margin = _shape(engine, folder / "object.obj", parts)
    position, xyzw = interop.pybullet_from_T(T_table_obj @ T_obj_body)
    number: int = engine.createMultiBody(body.mass_kg, shape, -1, position, xyzw)
    # Damping never in one call with friction: PyBullet then drops the friction.
    engine.changeDynamics(number, -1, linearDamping=0.0, angularDamping=0.1)
    engine.changeDynamics(number, -1, localInertiaDiagonal=moments.tolist(), collisionMargin=margin)
    for each in (*statics, number):
        # Bullet multiplies the two.
        engine.changeDynamics(each, -1, lateralFriction=float(np.sqrt(FRICTION)))
    engine.resetBaseVelocity(number, twist[3:].tolist(), twist[:3].tolist())
    return number


def _shape(engine: Any, path: Path, parts: Sequence[Array]) -> tuple[int, float]:
    """Return a collision shape of convex parts and the margin that makes it as large."""
    cores, margin = drawn_in(list(parts), MARGIN_M)
    path.write_bytes(collision_obj(cores))
    shape: int = engine.createCollisionShape(engine.GEOM_MESH, fileName=str(path))
    return shape, margin


def _poses(engine: Any, number: int, T_body_obj: Array, times_s: Array) -> Array:
    """Let time pass and return T_table_obj (S, 4, 4) at the times."""
    Ts = np.empty((len(times_s), 4, 4))
    done = 0
    for k, time_s in enumerate(times_s.tolist()):
        while done < round(time_s * RATE_HZ):
            engine.stepSimulation()
            done += 1
        position, xyzw = engine.getBasePositionAndOrientation(number)
        Ts[k] = interop.T_from_pybullet(position, xyzw) @ T_body_obj
    return Ts
