"""One hand and one object in PyBullet; any number of grasps are put into it one after the other.

What makes the friction right (each was measured to be wrong without it):
- `changeDynamics` with damping on a link silently drops the friction given in the same call (the
  fingers stay at 0.5). Damping is set in a call of its own, and everything is read back.
- Bullet's solver puts a flat pad's whole load on one corner: sphere pads with finite stiffness.
- `numSubSteps` multiplies the motors' force: never used; the time step is set instead.
- Friction is solved for speeds alone: what is squeezed where it is curved crawls, unless a contact
  is anchored to where it first touched.
- A light object between stiff pads does not converge: it is given a mass of at least the floor.

Pairs in one world are not independent: Bullet sorts their constraints by an unstable sort, so that
the order in which a hand's own are solved depends on the others, and closing amplifies that to
millimetres. One pair, built once and reset for every grasp, costs no more.
"""

import tempfile
import weakref
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from realsim import interop
from realsim.arrays import Array
from realsim.geometry import se3
from realsim.robots.hand import Hand
from realsim_sim_bridge.slip import bullet_shapes
from realsim_sim_bridge.slip.stand import Stand
from realsim_sim_bridge.slip.world import Meeting

if TYPE_CHECKING:
    from realsim_sim_bridge.slip.engines import BulletSettings

FINGERS = ("left_slide", "right_slide")
"""Joints of the two fingers; the first is at +y."""
LIFTS = ("left_lift", "right_lift")
LIFT_N = 1e4
"""What holds the fingers of an arc at their height [N]: their drive locks itself."""
LIFT_PULL = 0.5
"""Share of the height's error that is taken back in a step."""
FAR_AWAY = (0.0, 0.0, 50.0)
"""Where the object waits while contacts of the grasp before are forgotten [m]."""
HULL = 0
"""Link of the object that the table meets."""
LINK_MARGIN_M = 0.001
"""Bullet's collision margin of links [m]."""
AWAY = (0.0, 0.0, -50.0)
"""Where the table and the neighbours are while loads are played [m]."""
TABLE_M = (1.0, 1.0, 0.2)
"""Size of the table under the object [m]: a box, not Bullet's infinite plane, on which a resting
box starts with 27 mm/s."""


class BulletPair:
    """A hand fixed at the origin, in the grasp frame's axes, and an object."""

    def __init__(self, met: Meeting, settings: "BulletSettings") -> None:
        """Build the pair, and what the object stands on while the fingers close.

        Raises:
            RealsimError: PyBullet does not take the shape, or a setting.
        """
        self.engine = interop.pybullet_client()
        # When Python ends, its modules may be gone before this object: a finalizer runs earlier.
        weakref.finalize(self, _disconnect, self.engine)
        self.met, body, stand = met, met.body, met.stand
        self._physics, self._settings, self._geometry = met.physics, settings, met.geometry
        self.dt = 1.0 / settings.rate_hz
        self._T_obj_body, moments = body.principal_frame()
        self._mass = max(body.mass_kg, met.physics.mass_floor_kg)
        self._moments = moments * (self._mass / body.mass_kg)
        self.engine.setPhysicsEngineParameter(
            fixedTimeStep=self.dt,
            numSolverIterations=settings.iterations,
            numSubSteps=0,
            deterministicOverlappingPairs=1,
            frictionERP=settings.friction_erp,
        )
        self.engine.setGravity(0.0, 0.0, 0.0)
        with tempfile.TemporaryDirectory() as folder:
            self.hand = self._add_hand(Path(folder), met.geometry)
            T_body_obj = se3.invert(self._T_obj_body)
            parts = [se3.transform(T_body_obj, part) for part in body.parts]
            cores, margin = bullet_shapes.drawn_in(parts, settings.collision_margin_m)
            shape = self._shape(cores, Path(folder) / "object.obj")
            whole = None
            if stand is not None and len(parts) > 1:
                hull, hull_margin = bullet_shapes.drawn_in([np.concatenate(parts)], LINK_MARGIN_M)
                if hull_margin == LINK_MARGIN_M:  # what is thinner stands on its parts
                    whole = self._shape(hull, Path(folder) / "hull.obj")
            self.object = self._add_object(shape, margin, whole)
            self._stands = [] if stand is None else self._add_stand(stand, Path(folder))
        self.reach_m = body.reach()
        gravity = 0.0 if stand is None else stand.gravity
        self.weights_n = gravity * self._mass, gravity * body.mass_kg
        """Weight of the object in the engine while it stands, and its own from then [N]."""

    # --- what is in it ------------------------------------------------------------------------

    def _add_hand(self, folder: Path, geometry: Hand) -> int:
        """Load the hand; its fingers stand still until they are driven."""
        engine, settings = self.engine, self._settings
        urdf = folder / "hand.urdf"
        urdf.write_text(bullet_shapes.hand_urdf(geometry, self._physics.pads))
        hand: int = engine.loadURDF(
            str(urdf),
            [0.0, 0.0, 0.0],
            [0.0, 0.0, 0.0, 1.0],
            useFixedBase=True,
            flags=engine.URDF_USE_SELF_COLLISION_EXCLUDE_ALL_PARENTS,
        )
        names = [engine.getJointInfo(hand, j)[1].decode() for j in range(engine.getNumJoints(hand))]
        self._fingers = [names.index(name) for name in FINGERS]
        """PyBullet's link numbers of the two fingers."""
        self._lifts = [names.index(name) for name in LIFTS if name in names]
        # Never together with a link's settings: see the head of this file.
        engine.changeDynamics(hand, -1, linearDamping=0.0, angularDamping=0.0)
        wanted: dict[str, float] = {
            "lateralFriction": 1.0,
            "spinningFriction": 0.0,
            "rollingFriction": 0.0,
        }
        if self._physics.pads:
            wanted["contactStiffness"] = self._physics.pads.point_n_per_m
            wanted["contactDamping"] = settings.damping
        for finger in self._fingers:
            engine.changeDynamics(hand, finger, **wanted)
            self._check(hand, finger, wanted)
            if self._physics.pads:
                engine.changeDynamics(hand, finger, frictionAnchor=int(settings.friction_anchor))
                self._check(hand, finger, wanted)
        couple(engine, hand, self._fingers, settings.gear_erp, settings.gear_force_n)
        return hand

    def _shape(self, parts: list[Array], path: Path) -> int:
        """Return the collision shape of convex parts (V, 3), body frame, through a file."""
        path.write_text(bullet_shapes.wavefront(parts))
        return bullet_shapes.shape_in(self.engine, path, len(parts))

    def _add_object(self, shape: int, margin_m: float, whole: int | None) -> int:
        """Add the object; its frame in the engine is the principal one.

        Args:
            shape: of its parts.
            margin_m: around them [m].
            whole: shape of their hull, a link without mass that the table alone meets: in four
                points at most, where every part would touch in four.
        """
        engine = self.engine
        link = {} if whole is None else bullet_shapes.massless_link(whole, engine.JOINT_FIXED)
        obj: int = engine.createMultiBody(
            baseMass=self._mass, baseCollisionShapeIndex=shape, basePosition=FAR_AWAY, **link
        )
        engine.changeDynamics(obj, -1, linearDamping=0.0, angularDamping=0.0)
        wanted = {
            "lateralFriction": self._physics.friction,
            "spinningFriction": 0.0,
            "rollingFriction": 0.0,
            "collisionMargin": margin_m,
        }
        engine.changeDynamics(obj, -1, localInertiaDiagonal=self._moments.tolist(), **wanted)
        self._check(obj, -1, wanted)
        if whole is not None:
            # PyBullet sets a margin of the base alone; a link keeps Bullet's.
            wanted["collisionMargin"] = LINK_MARGIN_M
            engine.changeDynamics(obj, HULL, lateralFriction=self._physics.friction)
            self._check(obj, HULL, wanted)
            for link_of_hand in range(-1, engine.getNumJoints(self.hand)):
                engine.setCollisionFilterPair(self.hand, obj, link_of_hand, HULL, 0)
        return obj

    def _add_stand(self, stand: Stand, folder: Path) -> list[int]:
        """Add the table and, where there are any, the neighbours; the hand does not meet them."""
        engine, settings = self.engine, self._settings
        # Bullet multiplies the two coefficients.
        rough = {"lateralFriction": stand.friction / self._physics.friction}
        half = [size / 2.0 for size in TABLE_M]
        wanted = [(engine.createCollisionShape(engine.GEOM_BOX, halfExtents=half), rough)]
        if stand.obstacles:
            cores, margin = bullet_shapes.drawn_in(
                list(stand.obstacles), settings.collision_margin_m
            )
            beside = self._shape(cores, folder / "beside.obj")
            wanted.append((beside, rough | {"collisionMargin": margin}))
        found: list[int] = []
        for shape, values in wanted:
            body: int = engine.createMultiBody(0.0, shape, basePosition=AWAY)
            engine.changeDynamics(body, -1, **values)
            self._check(body, -1, values)
            for link in range(-1, engine.getNumJoints(self.hand)):
                engine.setCollisionFilterPair(self.hand, body, link, -1, 0)
            if engine.getNumJoints(self.object):
                # The table meets the hull alone, neighbours the parts alone.
                apart = -1 if not found else HULL
                engine.setCollisionFilterPair(self.object, body, apart, -1, 0)
            found.append(body)
        return found

    def _check(self, body: int, link: int, wanted: dict[str, float]) -> None:
        """Raise if the engine did not take a setting."""
        found = bullet_shapes.settings_in(self.engine, body, link)
        bullet_shapes.require_taken(found, wanted, f"link {link}")

    # --- what happens in it -------------------------------------------------------------------

    def put(self, T_hand_body: Array, twist: Array, fingers_m: Array, speeds: Array) -> None:
        """Put object (4, 4), its twist (6,) and fingers (2,) there; contacts are forgotten."""
        engine = self.engine
        still = [0.0, 0.0, 0.0]
        engine.resetBasePositionAndOrientation(self.object, FAR_AWAY, [0.0, 0.0, 0.0, 1.0])
        engine.resetBaseVelocity(self.object, still, still)
        engine.stepSimulation()
        position, xyzw = interop.pybullet_from_T(T_hand_body)
        engine.resetBasePositionAndOrientation(self.object, position, xyzw)
        engine.resetBaseVelocity(self.object, twist[3:].tolist(), twist[:3].tolist())
        for side, finger in enumerate(self._fingers):
            engine.resetJointState(self.hand, finger, float(fingers_m[side]), float(speeds[side]))
        for side, lift in enumerate(self._lifts):
            engine.resetJointState(
                self.hand, lift, float(self._geometry.z_pad(2 * fingers_m[side]))
            )
        self.follow_arc(still=True)

    def place_stand(self, T_hand_table: Array | None) -> None:
        """Put the table under the hand and the neighbours where they are, or all of it away."""
        self._placed: list[tuple[int, Array, Any]] = []
        for n, body in enumerate(self._stands):
            position, xyzw = AWAY, (0.0, 0.0, 0.0, 1.0)
            if T_hand_table is not None:
                T = T_hand_table
                if n == 0:
                    assert self.met.stand is not None, "a table is a stand's"
                    top = self.met.stand.height_m - TABLE_M[2] / 2.0
                    T = T @ se3.from_translation([*se3.invert(T)[:2, 3], top])
                position, xyzw = interop.pybullet_from_T(T)
            self._placed.append((body, np.array(position), xyzw))
        self.sink_stand(np.zeros(3))

    def sink_stand(self, way: Array) -> None:
        """Put table and neighbours a way (3,) from where they were placed [m], hand axes."""
        for body, position, xyzw in self._placed:
            there = (position + way).tolist()
            self.engine.resetBasePositionAndOrientation(body, there, xyzw)

    def drive(self, speed: float) -> None:
        """Let the fingers close at a speed [m/s] each, with at most the hand's force."""
        close(self.engine, self.hand, self._fingers, speed, self._physics.force_n)

    def follow_arc(self, *, still: bool = False) -> None:
        """Put the fingers of an arc where it has them in the next step; `still`: and stay there."""
        if not self._lifts:
            return
        fingers, speeds = self.fingers()
        heights = self._geometry.z_pad(2.0 * fingers)
        rising = 0.0 * speeds if still else self._geometry.slope(fingers) * speeds
        for side, lift in enumerate(self._lifts):
            self.engine.setJointMotorControl2(
                self.hand,
                lift,
                self.engine.POSITION_CONTROL,
                targetPosition=float(heights[side]),
                targetVelocity=float(rising[side]),
                positionGain=LIFT_PULL,
                velocityGain=1.0,
                force=LIFT_N,
            )

    def anchor(self, anchored: bool) -> None:
        """Let sticking contacts remember where they first touched, or not.

        Bullet anchors a contact a step before it touches: fingers that come along an arc would pull
        the object the way that they still go.
        """
        if self._lifts and self._physics.pads and self._settings.friction_anchor:
            for finger in self._fingers:
                self.engine.changeDynamics(self.hand, finger, frictionAnchor=int(anchored))

    def drag(self, rate_per_s: float) -> None:
        """Let the object's speeds decay at a rate [1/s]."""
        self.engine.changeDynamics(
            self.object, -1, linearDamping=rate_per_s, angularDamping=rate_per_s
        )

    def push(self, torque: list[float], force: list[float]) -> None:
        """Apply a torque [N m] and a force [N] at the centre of mass, for one step."""
        engine, frame = self.engine, self.engine.WORLD_FRAME
        at = engine.getBasePositionAndOrientation(self.object)[0]
        engine.applyExternalForce(self.object, -1, force, at, frame)
        engine.applyExternalTorque(self.object, -1, torque, frame)

    # --- what is seen -------------------------------------------------------------------------

    def pose(self) -> Array:
        """Return T_hand_body (4, 4)."""
        return interop.T_from_pybullet(*self.engine.getBasePositionAndOrientation(self.object))

    def twist(self) -> Array:
        """Return the object's twist (6,), hand axes."""
        linear, angular = self.engine.getBaseVelocity(self.object)
        return np.array([*angular, *linear])

    def fingers(self) -> Array:
        """Return the fingers' positions [m] and speeds [m/s] (2, 2): row 0 positions."""
        return np.array([self.engine.getJointState(self.hand, f)[:2] for f in self._fingers]).T

    def finger_forces(self) -> Array:
        """Return the normal force of each finger on the object (2,) [N]."""
        forces = np.zeros(2)
        for side, finger in enumerate(self._fingers):
            contacts = self.engine.getContactPoints(
                bodyA=self.hand, bodyB=self.object, linkIndexA=finger
            )
            forces[side] = sum(c[9] for c in contacts)
        return forces

    def settings(self) -> dict[str, float]:
        """Return what the engine says its settings are."""
        engine = self.engine
        points = len(self._physics.pads.centers_xz()) if self._physics.pads else 0
        finger = bullet_shapes.settings_in(engine, self.hand, self._fingers[0])
        held = bullet_shapes.settings_in(engine, self.object)
        moments = engine.getDynamicsInfo(self.object, -1)[2]
        parameters = engine.getPhysicsEngineParameters()
        return {
            "finger_friction": finger["lateralFriction"],
            "object_friction": held["lateralFriction"],
            "pad_stiffness_n_per_m": points * finger["contactStiffness"],
            "contact_damping": finger["contactDamping"],
            "object_mass_kg": held["mass"],
            "object_inertia_least": float(min(moments)),
            "dt_s": float(parameters["fixedTimeStep"]),
            "iterations": float(parameters["numSolverIterations"]),
            "substeps": float(parameters["numSubSteps"]),
            "force_n": abs(float(engine.getJointState(self.hand, self._fingers[0])[3])),
        }


def couple(engine: Any, hand: int, fingers: Sequence[int], erp: float, force_n: float) -> None:
    """Let a gear keep two fingers (link numbers) at the same distance from the middle."""
    gear = engine.createConstraint(
        hand, fingers[0], hand, fingers[1], engine.JOINT_GEAR, [0, 1, 0], [0, 0, 0], [0, 0, 0]
    )
    engine.changeConstraint(gear, gearRatio=-1, erp=erp, maxForce=force_n)


def close(engine: Any, hand: int, fingers: Sequence[int], speed: float, force_n: float) -> None:
    """Let fingers (link numbers) close at a speed [m/s] each, with at most a force [N]."""
    for finger in fingers:
        engine.setJointMotorControl2(
            hand, finger, engine.VELOCITY_CONTROL, targetVelocity=-speed, force=force_n
        )


def _disconnect(engine: Any) -> None:
    """Free an engine's memory."""
    if engine.isConnected():
        engine.disconnect()
