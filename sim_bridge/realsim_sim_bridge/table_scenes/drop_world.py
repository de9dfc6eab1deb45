"""The engine in which objects fall: a table that ends at its rim, and bodies that come and go.

Everything is in the table's frame. A body's frame in the engine is its principal one, at its centre
of mass. Settings are given one kind a call, because damping and friction in one call lose each
other, and the mass is read back.
"""

import tempfile
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from realsim import interop
from realsim.arrays import Array
from realsim.errors import RealsimError
from realsim.geometry import se3
from realsim.models.convex import collision_obj
from realsim_sim_bridge.slip.bullet_shapes import drawn_in, shape_in
from realsim_sim_bridge.slip.world import SlipBody
from realsim_sim_bridge.table_scenes.config import DropConfig
from realsim_sim_bridge.table_scenes.tables import TableModel

GRAVITY = 9.81
"""[m/s^2]."""
PLATE_M = 0.5
"""Thickness of the table top in the engine [m]: deeper than anything sinks, so that it is pushed
out upwards."""


@dataclass(frozen=True, eq=False, slots=True)
class _Body:
    """A body in the engine."""

    number: int
    T_body_obj: Array
    hull: Array
    """(V, 3) corners of its parts in the object's frame [m]."""


class DropWorld:
    """A table and the bodies on it; leaving the context frees the engine."""

    def __init__(self, table: TableModel, config: DropConfig) -> None:
        """Build the table."""
        self.config = config
        self.bodies: dict[int, _Body] = {}
        """Key of an object -> its body."""
        self._engine = interop.pybullet_client()
        self._folder = tempfile.TemporaryDirectory(prefix="realsim_drop_")
        self._shapes = 0
        self._rolling = 0.0
        self._rate_hz = 0.0
        self.falling()
        self._engine.setGravity(0.0, 0.0, -GRAVITY)
        rim = table.outline
        plate = np.concatenate(
            [np.column_stack([rim, np.full(len(rim), z)]) for z in (-PLATE_M, 0.0)]
        )
        self._statics = [self._static([plate])]
        self._statics += [self._static([rim]) for rim in table.rims]

    def __enter__(self) -> "DropWorld":
        """Return the world."""
        return self

    def __exit__(self, *_: object) -> None:
        """Close the engine."""
        self._engine.disconnect()
        self._folder.cleanup()

    # --- settings -----------------------------------------------------------------------------

    def falling(self) -> None:
        """Take the settings for falling: fewer steps, and balls that stop rolling."""
        self._set(self.config.rate_hz, self.config.iterations, self.config.rolling)

    def resting(self) -> None:
        """Take the Robot School's settings: finer steps, no rolling friction, no damping."""
        self._set(self.config.rest_rate_hz, self.config.rest_iterations, 0.0)

    def _set(self, rate_hz: float, iterations: int, rolling: float) -> None:
        self._engine.setPhysicsEngineParameter(
            fixedTimeStep=1.0 / rate_hz, numSolverIterations=iterations, numSubSteps=0,
            deterministicOverlappingPairs=1, solverResidualThreshold=0.0,
        )  # fmt: skip
        found = self._engine.getPhysicsEngineParameters()
        if abs(float(found["fixedTimeStep"]) * rate_hz - 1.0) > 1e-9:
            raise RealsimError(f"PyBullet refused {rate_hz:g} steps a second.")
        self._rate_hz, self._rolling = rate_hz, rolling
        for body in self.bodies.values():
            self._roll(body.number)

    def _roll(self, number: int) -> None:
        damping = 0.04 if self._rolling > 0 else 0.0  # Bullet's own, while falling
        self._engine.changeDynamics(number, -1, linearDamping=damping, angularDamping=damping)
        self._engine.changeDynamics(
            number, -1, rollingFriction=self._rolling, spinningFriction=self._rolling
        )

    # --- bodies -------------------------------------------------------------------------------

    def _shape(self, parts: list[Array]) -> tuple[int, float]:
        """Return a collision shape of convex parts and the margin that makes it as large."""
        cores, margin = drawn_in(parts, self.config.margin_m)
        self._shapes += 1
        path = Path(self._folder.name) / f"shape{self._shapes}.obj"
        path.write_bytes(collision_obj(cores))
        return shape_in(self._engine, path, len(parts)), margin

    def _static(self, parts: list[Array]) -> int:
        shape, margin = self._shape(parts)
        body: int = self._engine.createMultiBody(0.0, shape)
        self._engine.changeDynamics(body, -1, collisionMargin=margin)
        self._rough(body)
        return body

    def _rough(self, body: int) -> None:
        self._engine.changeDynamics(
            body, -1, lateralFriction=float(np.sqrt(self.config.friction)), restitution=0.0
        )

    def add(self, key: int, solid: SlipBody, T_table_obj: Array) -> None:
        """Put an object somewhere, at rest."""
        T_obj_body, moments = solid.principal_frame()
        T_body_obj = se3.invert(T_obj_body)
        shape, margin = self._shape([se3.transform(T_body_obj, p) for p in solid.parts])
        position, xyzw = interop.pybullet_from_T(T_table_obj @ T_obj_body)
        number: int = self._engine.createMultiBody(solid.mass_kg, shape, -1, position, xyzw)
        self._engine.changeDynamics(number, -1, collisionMargin=margin)
        self._engine.changeDynamics(
            number, -1, mass=solid.mass_kg, localInertiaDiagonal=moments.tolist()
        )
        self._rough(number)
        self._roll(number)
        held = float(self._engine.getDynamicsInfo(number, -1)[0])
        if abs(held - solid.mass_kg) > 1e-9 * max(1.0, solid.mass_kg):
            raise RealsimError(f"PyBullet holds a mass of {held:g} kg, not {solid.mass_kg:g} kg.")
        self.bodies[key] = _Body(number, T_body_obj, np.concatenate(solid.parts))

    def remove(self, key: int) -> None:
        """Take an object away."""
        self._engine.removeBody(self.bodies.pop(key).number)

    # --- what happens -------------------------------------------------------------------------

    @property
    def dt(self) -> float:
        """Time of a step [s]."""
        return 1.0 / self._rate_hz

    def step(self, seconds: float) -> None:
        """Let time pass [s], in whole steps, one at least."""
        for _ in range(max(1, round(seconds * self._rate_hz))):
            self._engine.stepSimulation()

    def pose(self, key: int) -> Array:
        """Return T_table_obj (4, 4) of an object [m]."""
        body = self.bodies[key]
        position, xyzw = self._engine.getBasePositionAndOrientation(body.number)
        return interop.T_from_pybullet(position, xyzw) @ body.T_body_obj

    def points(self, key: int) -> Array:
        """Return the corners (V, 3) of an object's convex parts where it is [m]."""
        return se3.transform(self.pose(key), self.bodies[key].hull)

    def heights(self) -> dict[int, float]:
        """Return the height of every object's centre of mass [m]."""
        engine = self._engine
        return {
            k: float(engine.getBasePositionAndOrientation(b.number)[0][2])
            for k, b in self.bodies.items()
        }

    def speeds(self) -> dict[int, tuple[float, float]]:
        """Return speed [m/s] and turning [rad/s] of every object."""
        out: dict[int, tuple[float, float]] = {}
        for key, body in self.bodies.items():
            linear, angular = self._engine.getBaseVelocity(body.number)
            out[key] = float(np.linalg.norm(linear)), float(np.linalg.norm(angular))
        return out

    def deepest(self) -> tuple[float, int, int]:
        """Return the greatest penetration [m] and the two objects; -1 is the table."""
        worst = (0.0, -1, -1)
        rows = [(-1, n) for n in self._statics] + [(k, b.number) for k, b in self.bodies.items()]
        for i, (key_a, a) in enumerate(rows):
            for key_b, b in rows[max(i + 1, len(self._statics)) :]:
                for point in self._engine.getClosestPoints(a, b, 0.0):
                    if -float(point[8]) > worst[0]:
                        worst = (-float(point[8]), key_a, key_b)
        return worst
