"""One PyBullet world in which K hands, fixed in space, hold K copies of one object.

What makes the friction right (each was measured to be wrong without it):
- `changeDynamics` with damping on a link silently drops the friction given in the same call (the
  fingers stay at 0.5). Damping is set in a call of its own, and the friction is read back.
- Bullet's solver puts a flat pad's whole load on one corner: sphere pads with finite stiffness.
- `numSubSteps` multiplies the motors' force: never used; the time step is set instead.
- A light object between stiff pads does not converge: its mass is raised to a floor and all loads
  are divided by the same factor, so that weight and inertial forces stay the true ones.
"""

import tempfile
from dataclasses import dataclass, field
from pathlib import Path
from types import TracebackType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from realsim import interop
from realsim.errors import RealsimError
from realsim.geometry import se3
from realsim_sim_bridge.school.hand import HandGeometry, PadModel, hand_urdf

Array = NDArray[np.float64]
FINGERS = (0, 1)
"""PyBullet's link numbers of the two fingers."""


@dataclass(frozen=True, kw_only=True, slots=True)
class SlipPhysics:
    """The engine's settings and the hand's force."""

    force_n: float = 70.0
    """Force of each finger on the object [N]: the Franka Hand's continuous grasping force, which
    each of two facing fingers exerts."""
    friction: float = 1.0
    """Coulomb coefficient of the contact; the paper's. Bullet multiplies the two materials', so the
    fingers have 1."""
    rate_hz: float = 240.0
    """Steps per second of simulated time."""
    iterations: int = 100
    """Solver iterations a step; at 50 the 5 cm box turns 1.9 deg instead of 0.14."""
    mass_floor_kg: float = 0.2
    """Least mass of a simulated object [kg]; 0 = the true mass. Lighter ones do not converge."""
    pads: PadModel | None = field(default_factory=PadModel)
    """The sphere pads; None = the finger's bare box with the engine's default contact."""
    gear_force_n: float = 1000.0
    """What keeps the two fingers symmetric [N], as the rack of the real hand does."""
    gear_erp: float = 0.3
    """Share of the fingers' asymmetry that is corrected per step."""
    touch_n: float = 1.0
    """Least normal force of a finger that counts as contact [N]: far below the closing force, above
    the solver's rest."""


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class SlipBody:
    """An object as the engine needs it: convex parts and mass."""

    parts: tuple[Array, ...]
    """Vertices (V, 3) of each convex part, object frame [m]."""
    mass_kg: float
    center_of_mass: Array
    """(3,) object frame [m]."""
    inertia: Array
    """(3, 3) about the centre of mass, object axes [kg m^2]."""

    def principal_frame(self) -> tuple[Array, Array]:
        """Return T_obj_body (4, 4), at the centre of mass along the principal axes, and moments."""
        moments, axes = np.linalg.eigh(self.inertia)
        if np.linalg.det(axes) < 0:
            axes[:, 0] = -axes[:, 0]
        return se3.from_rt(axes, self.center_of_mass), moments


class SlipWorld:
    """K pairs of hand and object; a context manager that owns the engine."""

    def __init__(
        self,
        body: SlipBody,
        Ts_table_grasp: Array,
        Ts_obj_grasp: Array,
        openings_m: Array,
        physics: SlipPhysics,
        geometry: HandGeometry,
    ) -> None:
        """Build the world.

        Args:
            body: the object.
            Ts_table_grasp: (K, 4, 4); its rotation is kept, so that gravity is -z for every pair.
            Ts_obj_grasp: (K, 4, 4) grasps [m].
            openings_m: (K,) distance of the finger faces before closing [m].
            physics: the engine's settings.
            geometry: sizes of the hand.
        """
        with interop.quiet_output():
            import pybullet
            from pybullet_utils.bullet_client import BulletClient

            self._engine: Any = BulletClient(connection_mode=pybullet.DIRECT)
        self._physics = physics
        self.dt = 1.0 / physics.rate_hz
        self._T_obj_body, self._moments = body.principal_frame()
        self.mass = body.mass_kg
        self._load_factor = max(1.0, physics.mass_floor_kg / body.mass_kg)
        self._engine.setPhysicsEngineParameter(
            fixedTimeStep=self.dt,
            numSolverIterations=physics.iterations,
            numSubSteps=0,
            deterministicOverlappingPairs=1,
        )
        self.Ts_world_hand = self._place(Ts_table_grasp, body)
        with tempfile.TemporaryDirectory() as folder:
            urdf = Path(folder) / "hand.urdf"
            urdf.write_text(hand_urdf(geometry, physics.pads))
            self._hands = [
                self._add_hand(urdf, T, opening)
                for T, opening in zip(self.Ts_world_hand, openings_m, strict=True)
            ]
            shape = self._shape(body, Path(folder))
        Ts_world_obj = self.Ts_world_hand @ se3.invert(Ts_obj_grasp)
        self._objects = [self._add_object(shape, T) for T in Ts_world_obj]
        self.alive: NDArray[np.bool_] = np.ones(len(self._hands), dtype=np.bool_)

    def __enter__(self) -> "SlipWorld":
        """Return the world."""
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        """Close the engine."""
        self._engine.disconnect()

    # --- what is in it ------------------------------------------------------------------------

    def _place(self, Ts_table_grasp: Array, body: SlipBody) -> Array:
        """Return T_world_hand (K, 4, 4): the given rotations, far apart on a grid."""
        corners = np.concatenate(body.parts)
        reach = float(np.linalg.norm(corners - body.center_of_mass, axis=1).max())
        pitch = 1.0 + 4.0 * reach
        side = int(np.ceil(np.sqrt(len(Ts_table_grasp))))
        k = np.arange(len(Ts_table_grasp))
        at = np.stack([k % side * pitch, k // side * pitch, np.zeros(len(k))], -1)
        return se3.from_rt(Ts_table_grasp[:, :3, :3], at)

    def _add_hand(self, urdf: Path, T_world_hand: Array, opening_m: float) -> int:
        """Load a hand, open; its fingers do not move until `close_fingers`."""
        engine, physics = self._engine, self._physics
        position, xyzw = interop.pybullet_from_T(T_world_hand)
        hand: int = engine.loadURDF(
            str(urdf),
            position,
            xyzw,
            useFixedBase=True,
            flags=engine.URDF_USE_SELF_COLLISION_EXCLUDE_ALL_PARENTS,
        )
        # Never together with a link's settings: see the head of this file.
        engine.changeDynamics(hand, -1, linearDamping=0.0, angularDamping=0.0)
        for finger in FINGERS:
            engine.resetJointState(hand, finger, opening_m / 2.0)
            settings: dict[str, float] = {
                "lateralFriction": 1.0,
                "spinningFriction": 0.0,
                "rollingFriction": 0.0,
            }
            if physics.pads:
                settings["contactStiffness"] = physics.pads.stiffness
                settings["contactDamping"] = physics.pads.damping
            engine.changeDynamics(hand, finger, **settings)
            self._check_friction(hand, finger, 1.0)
            engine.setJointMotorControl2(
                hand, finger, engine.VELOCITY_CONTROL, targetVelocity=0.0, force=physics.force_n
            )
        gear = engine.createConstraint(
            hand, 0, hand, 1, engine.JOINT_GEAR, [0, 1, 0], [0, 0, 0], [0, 0, 0]
        )
        engine.changeConstraint(
            gear, gearRatio=-1, erp=physics.gear_erp, maxForce=physics.gear_force_n
        )
        return hand

    def _shape(self, body: SlipBody, folder: Path) -> int:
        """Return the collision shape, in the body's principal frame; all copies share it."""
        T_body_obj = se3.invert(self._T_obj_body)
        path = folder / "parts.obj"
        path.write_text(_wavefront([se3.transform(T_body_obj, part) for part in body.parts]))
        shape: int = self._engine.createCollisionShape(
            self._engine.GEOM_MESH, fileName=str(path), meshScale=[1.0, 1.0, 1.0]
        )
        if shape < 0:
            raise RealsimError(
                f"PyBullet refused the collision shape of {len(body.parts)} convex parts."
            )
        return shape

    def _add_object(self, shape: int, T_world_obj: Array) -> int:
        """Add a copy of the object; its frame in the engine is the principal one."""
        position, xyzw = interop.pybullet_from_T(T_world_obj @ self._T_obj_body)
        factor = self._load_factor
        obj: int = self._engine.createMultiBody(
            baseMass=self.mass * factor,
            baseCollisionShapeIndex=shape,
            basePosition=position,
            baseOrientation=xyzw,
        )
        self._engine.changeDynamics(obj, -1, linearDamping=0.0, angularDamping=0.0)
        self._engine.changeDynamics(
            obj,
            -1,
            localInertiaDiagonal=(self._moments * factor).tolist(),
            lateralFriction=self._physics.friction,
            spinningFriction=0.0,
            rollingFriction=0.0,
        )
        self._check_friction(obj, -1, self._physics.friction)
        return obj

    def _check_friction(self, body: int, link: int, expected: float) -> None:
        """Raise if the engine did not take the friction."""
        found = float(self._engine.getDynamicsInfo(body, link)[1])
        if abs(found - expected) > 1e-9:
            raise RealsimError(
                f"PyBullet holds the friction {found} for link {link} instead of {expected}; its "
                "results would be wrong. Was changeDynamics called with damping on a link?"
            )

    # --- what happens in it -------------------------------------------------------------------

    def close_fingers(self, speed: float) -> None:
        """Let all fingers close at `speed` [m/s] each and press with the hand's force from then."""
        for k in np.nonzero(self.alive)[0]:
            for finger in FINGERS:
                self._engine.setJointMotorControl2(
                    self._hands[k],
                    finger,
                    self._engine.VELOCITY_CONTROL,
                    targetVelocity=-speed,
                    force=self._physics.force_n,
                )

    def set_acceleration(self, field_m_s2: Array) -> None:
        """Set what every free mass feels (3,) [m/s^2]: gravity minus the hand's acceleration."""
        self._engine.setGravity(*(field_m_s2 / self._load_factor).tolist())

    def push(self, k: int, force: Array, torque: Array) -> None:
        """Apply a force (3,) [N] at object k's centre of mass and a torque (3,), for one step."""
        engine, obj = self._engine, self._objects[k]
        at = engine.getBasePositionAndOrientation(obj)[0]
        engine.applyExternalForce(obj, -1, force.tolist(), at, engine.WORLD_FRAME)
        engine.applyExternalTorque(obj, -1, torque.tolist(), engine.WORLD_FRAME)

    def step(self) -> None:
        """Advance by dt."""
        self._engine.stepSimulation()

    def Ts_world_body(self) -> Array:
        """Return the objects' principal frames (K, 4, 4); NaN where removed."""
        Ts = np.full((len(self._objects), 4, 4), np.nan)
        for k in np.nonzero(self.alive)[0]:
            position, xyzw = self._engine.getBasePositionAndOrientation(self._objects[k])
            Ts[k] = interop.T_from_pybullet(position, xyzw)
        return Ts

    def inertia_world(self, k: int) -> Array:
        """Return object k's true inertia (3, 3) about its centre of mass, world axes."""
        xyzw = self._engine.getBasePositionAndOrientation(self._objects[k])[1]
        R = interop.R_from_quaternion_xyzw(xyzw)
        return R @ np.diag(self._moments) @ R.T

    def finger_forces(self) -> Array:
        """Return the normal force of each finger on its object (K, 2) [N]; 0 where removed."""
        forces = np.zeros((len(self._hands), 2))
        for k in np.nonzero(self.alive)[0]:
            for finger in FINGERS:
                contacts = self._engine.getContactPoints(
                    bodyA=self._hands[k], bodyB=self._objects[k], linkIndexA=finger
                )
                forces[k, finger] = sum(c[9] for c in contacts)
        return forces

    def remove(self, k: int) -> None:
        """Take pair k out of the world."""
        self._engine.removeBody(self._objects[k])
        self._engine.removeBody(self._hands[k])
        self.alive[k] = False


def _wavefront(parts: list[Array]) -> str:
    """Return an OBJ with one group per part; the engine takes the convex hull of each.

    The faces only name the vertices: a hull is made of points.
    """
    lines: list[str] = []
    first = 1
    for i, part in enumerate(parts):
        lines.append(f"o part{i}")
        lines += [f"v {x:.9g} {y:.9g} {z:.9g}" for x, y, z in part.tolist()]
        lines += [f"f {first} {first + j} {first + j + 1}" for j in range(1, len(part) - 1)]
        first += len(part)
    return "\n".join(lines) + "\n"
