"""A scene in PyBullet: the table, what stands still, and the objects as bodies of convex parts.

Everything happens in the table's frame: z up, the table's top at z = 0. A body's frame in the
engine is its principal one, at its centre of mass (`SlipBody.principal_frame`). What is set is read
back: `changeDynamics` loses settings without a word (damping and friction in one call, for one).
"""

import tempfile
from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path

import numpy as np

from realsim import interop
from realsim.arrays import Array
from realsim.errors import InputError
from realsim.geometry import se3
from realsim.models.convex import ConvexConfig, convex_parts
from realsim.models.model_records import KnownSolid
from realsim.records import ObjectPose
from realsim_sim_bridge.scenes.school_scene import SchoolScene, Support
from realsim_sim_bridge.slip.bullet_shapes import drawn_in_shape, require_taken, settings_in
from realsim_sim_bridge.slip.world import SlipBody

# --- Settings under which a box on a table rests; each is read back from the engine --------------


FRICTION = 1.0
"""Coulomb coefficient of every contact; the paper's. Bullet multiplies the two bodies', so each
gets its square root."""
GRAVITY = 9.81
"""[m/s^2]."""
RATE_HZ = 480.0
"""Steps per second: at 240 a 10 g part under a 2 kg one is pressed out from under it within
2 s; at 480 it shifts by 0.2 mm."""
ITERATIONS = 300
"""Solver iterations a step, which also are for stacks: weight is handed down part by part."""
COLLISION_MARGIN_M = 0.0005
"""Bullet's skin around every hull [m], for which the hulls are drawn in (`drawn_in`): contacts
rest within it, where normals are right, and a box still stands within 0.01 mm of its place."""
TABLE_REACH_M = 2.0
"""The table ends so far beyond the outermost object [m]: only what rolls away falls off."""
TABLE_DEPTH_M = 1.0
"""Thickness of the table [m]: deeper than anything sinks, so that it is pushed out upwards. A
box, not Bullet's infinite plane, on which a resting box starts with 27 mm/s."""
THIN_RATIO, FAT_RATIO = 0.90, 1.10
"""Convex parts of a smaller share of the mesh's volume are named: bodies sink into each other; of a
larger: they meet too early."""


TABLE = "the table"


class TableWorld:
    """The scene's bodies in an engine of their own; leaving the context frees it."""

    dt = 1.0 / RATE_HZ
    """Length of a step [s]."""

    def __init__(self, scene: SchoolScene, cache: Path | None = None) -> None:
        """Build the world.

        Args:
            scene: objects, supports and table.
            cache: folder for the convex parts of supports' meshes.

        Raises:
            InputError: a URDF that PyBullet cannot read, or a support's mesh that is flat.
            RealsimError: the engine did not take a setting.
        """
        self.scene = scene
        self.notes = list(_of_solids(scene))
        self.names: dict[int, str] = {}
        """Body number in the engine -> what it is."""
        self.bodies: dict[int, int] = {}
        """Instance -> body number."""
        self.statics: list[int] = []
        """Body numbers of the table and the supports."""
        self._Ts_obj_body: dict[int, Array] = {}
        self._engine = interop.pybullet_client()
        with ExitStack() as on_failure:
            # Not `.disconnect` itself: BulletClient ends its connection when the name is looked up.
            on_failure.callback(self._close)
            self._set_engine()
            self._add_table()
            with tempfile.TemporaryDirectory() as folder:
                for support in scene.supports:
                    self._add_support(support, Path(folder), cache)
                names = scene.names()
                for o in scene.scene.objects:
                    self._add_object(o, scene.solids[o.obj_id], names[o.instance], Path(folder))
            on_failure.pop_all()

    def __enter__(self) -> "TableWorld":
        """Return the world."""
        return self

    def __exit__(self, *_: object) -> None:
        """Close the engine."""
        self._close()

    def _close(self) -> None:
        self._engine.disconnect()

    # --- what is in it ------------------------------------------------------------------------

    def _set_engine(self) -> None:
        wanted: dict[str, float] = {
            "fixedTimeStep": 1.0 / RATE_HZ,
            "numSolverIterations": ITERATIONS,
            # Substeps multiply motors' forces, and ending early would make bodies depend on others.
            "numSubSteps": 0,
        }
        self._engine.setPhysicsEngineParameter(
            **wanted, deterministicOverlappingPairs=1, solverResidualThreshold=0.0
        )
        self._engine.setGravity(0.0, 0.0, -GRAVITY)
        found = self._engine.getPhysicsEngineParameters()
        require_taken(found, wanted, "the engine")

    def _add_table(self) -> None:
        T = self.scene.T_table_world
        at = np.array([(T @ o.T_world_obj)[:2, 3] for o in self.scene.scene.objects])
        low, high = at.min(axis=0), at.max(axis=0)
        reach = (high - low) / 2.0 + TABLE_REACH_M
        depth = TABLE_DEPTH_M
        shape = self._engine.createCollisionShape(
            self._engine.GEOM_BOX, halfExtents=[*reach.tolist(), depth / 2.0]
        )
        middle: list[float] = ((low + high) / 2.0).tolist()
        body: int = self._engine.createMultiBody(0.0, shape, basePosition=[*middle, -depth / 2.0])
        self._add_static(body, TABLE)

    def _add_support(self, support: Support, folder: Path, cache: Path | None) -> None:
        T = self.scene.T_table_world @ support.T_world_support
        position, xyzw = interop.pybullet_from_T(T)
        if support.urdf is not None:
            try:
                with interop.quiet_output():
                    body: int = self._engine.loadURDF(
                        str(support.urdf.resolve()), position, xyzw, useFixedBase=True
                    )
            except self._engine.error as error:
                raise InputError(
                    f"PyBullet cannot read the support '{support.name}' from {support.urdf} "
                    f"({error}). A URDF with collision shapes is needed, its meshes beside it."
                ) from error
        else:
            assert support.mesh is not None
            try:
                parts = convex_parts(support.mesh, ConvexConfig(), cache)
            except InputError as error:
                raise InputError(f"the support '{support.name}' is no solid: {error}") from error
            if not THIN_RATIO <= parts.volume_ratio <= FAT_RATIO:
                self.notes.append(_blown_up(f"the support '{support.name}'", parts.volume_ratio))
            path = folder / f"support{len(self.statics)}.obj"
            shape, margin = drawn_in_shape(self._engine, path, parts.parts, COLLISION_MARGIN_M)
            body = self._engine.createMultiBody(0.0, shape, -1, position, xyzw)
            self._engine.changeDynamics(body, -1, collisionMargin=margin)
        self._add_static(body, support.name)

    def _add_static(self, body: int, name: str) -> None:
        wanted = self._contact()
        for link in range(-1, self._engine.getNumJoints(body)):
            self._engine.changeDynamics(body, link, **wanted)
            require_taken(settings_in(self._engine, body, link), wanted, name)
        self.statics.append(body)
        self.names[body] = name

    def _add_object(self, o: ObjectPose, solid: KnownSolid, name: str, folder: Path) -> None:
        slip_body = SlipBody.of(solid.parts, solid.matter)
        T_obj_body, moments = slip_body.principal_frame()
        T_body_obj = se3.invert(T_obj_body)
        parts = [se3.transform(T_body_obj, part) for part in slip_body.parts]
        path = folder / f"object{o.instance}.obj"
        shape, margin = drawn_in_shape(self._engine, path, parts, COLLISION_MARGIN_M)
        T = self.scene.T_table_world @ o.T_world_obj @ T_obj_body
        position, xyzw = interop.pybullet_from_T(T)
        mass = slip_body.mass_kg
        body: int = self._engine.createMultiBody(mass, shape, -1, position, xyzw)
        # Alone: given together with other settings, damping can make them be lost.
        self._engine.changeDynamics(body, -1, linearDamping=0.0, angularDamping=0.0)
        wanted = self._contact() | {"mass": mass, "collisionMargin": margin}
        self._engine.changeDynamics(body, -1, localInertiaDiagonal=moments.tolist(), **wanted)
        held = self._engine.getDynamicsInfo(body, -1)[2]
        found = settings_in(self._engine, body) | {f"inertia {i}": held[i] for i in range(3)}
        wanted |= {f"inertia {i}": float(moments[i]) for i in range(3)}
        require_taken(found, wanted, name)
        self.bodies[o.instance] = body
        self.names[body] = name
        self._Ts_obj_body[o.instance] = T_obj_body

    def _contact(self) -> dict[str, float]:
        return {
            "lateralFriction": float(np.sqrt(FRICTION)),
            "restitution": 0.0,
            "rollingFriction": 0.0,
            "spinningFriction": 0.0,
        }

    # --- what happens in it -------------------------------------------------------------------

    def step(self) -> None:
        """Let one time step pass."""
        self._engine.stepSimulation()

    def pose(self, instance: int) -> Array:
        """Return T_table_obj (4, 4) of an object [m]."""
        position, xyzw = self._engine.getBasePositionAndOrientation(self.bodies[instance])
        return interop.T_from_pybullet(position, xyzw) @ se3.invert(self._Ts_obj_body[instance])

    def centers(self) -> Array:
        """Return the centres of mass (K, 3) in the table's frame, in the scene's order [m]."""
        engine = self._engine
        return np.array([engine.getBasePositionAndOrientation(b)[0] for b in self.bodies.values()])

    def twists(self) -> Array:
        """Return angular [rad/s] and linear velocity of the centre of mass [m/s] (K, 6)."""
        rows = [self._engine.getBaseVelocity(b) for b in self.bodies.values()]
        return np.array([[*angular, *linear] for linear, angular in rows])

    def distance(self, body_a: int, body_b: int, reach_m: float) -> float:
        """Return the least distance of two bodies [m], < 0 = penetration, inf = beyond reach."""
        points = self._engine.getClosestPoints(body_a, body_b, reach_m)
        return min((float(p[8]) for p in points), default=float("inf"))

    def settings(self) -> dict[str, float]:
        """Return the engine's own settings, read back, and the first object's."""
        found = self._engine.getPhysicsEngineParameters()
        held = settings_in(self._engine, next(iter(self.bodies.values())))
        return {
            "dt_s": float(found["fixedTimeStep"]),
            "iterations": float(found["numSolverIterations"]),
            "gravity": -float(found["gravityAccelerationZ"]),
            "contact_friction": held["lateralFriction"] ** 2,
            "collision_margin_m": held["collisionMargin"],
        }


def _of_solids(scene: SchoolScene) -> Iterator[str]:
    """Yield what is doubtful about the objects' shapes: no volume, parts too large."""
    for obj_id in sorted({o.obj_id for o in scene.scene.objects}):
        solid, name = scene.solids[obj_id], f"'{scene.models[obj_id].name}'"
        if solid.matter.volume_of != "mesh":
            yield (
                f"the mesh of {name} is not closed and has no volume of its own: that of its "
                f"{solid.matter.volume_of} stands for it ({1e3 * solid.matter.mass_kg:.0f} g). "
                "Repair it: `realsim scan import`."
            )
        elif not THIN_RATIO <= solid.parts.volume_ratio <= FAT_RATIO:
            yield _blown_up(name, solid.parts.volume_ratio)


def _blown_up(name: str, ratio: float) -> str:
    if ratio > 1:
        return (
            f"the convex parts of {name} are {ratio:.2f} times as large as its mesh: it touches "
            "others before its surface does, and its hollow is smaller."
        )
    return f"the convex parts of {name} are only {ratio:.2f} of its mesh: others sink into it."
