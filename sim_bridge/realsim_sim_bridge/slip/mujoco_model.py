"""The compiled MuJoCo model of one hand that stands still and one object.

What makes its friction right (each was measured to be wrong without it):
- What drives the fingers is dry friction of the hand's force against a carriage that moves at the
  closing speed: a constraint, solved together with the contacts. Damping of a joint, or a velocity
  drive before its force saturates, is integrated implicitly but not seen by the contact solver:
  fingers chatter, light objects are lost while closing (by a drive of 3 cm/s most of them) and
  heavy ones slip at half of Coulomb's limit.
- 2 x 3 sphere pads a finger: a mesh finger touches at two or three points and carries no torque.
- `impratio` makes friction stiff against the normal, so that objects do not creep; the cone is
  elliptic, for a pyramid is stronger along its edges.
- A soft contact's stiffness hangs on both bodies' inertia: that of the pads is set once the model
  has been compiled (`mujoco_pads`).
- Light objects between stiff pads do not converge: mass floor.
- MuJoCo takes the greater friction of the two geoms, hence both have the contact's.
"""

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from realsim.arrays import Array, Int64
from realsim.errors import InputError
from realsim.geometry import se3
from realsim.robots.hand import Hand
from realsim_sim_bridge.slip.mujoco_approach import surface_triangles
from realsim_sim_bridge.slip.mujoco_pads import PAD_PRIORITY, set_pads
from realsim_sim_bridge.slip.stand import Stand
from realsim_sim_bridge.slip.world import Meeting, PadModel, SlipPhysics

if TYPE_CHECKING:
    from realsim_sim_bridge.slip.engines import MujocoSettings

FINGER_NAMES = ("left", "right")
LIFT_NAMES = ("left_lift", "right_lift")
LOCKED_KG = 1e7
"""Mass of a finger along z while its height is locked [kg]: at 1e6 loads creep, for it is moved,
and at 1e8 the solver is no longer exact enough."""
SIDES = (1.0, -1.0)
"""Finger 0 is at +y."""
OBJECT, HULL, STAND = "object", "hull", "stand"
CARRIAGE = "carriage"
CARRIAGE_KG_PER_N = 150.0
"""Mass of the carriage [kg per N of the hand's force]: 2 F slow it by 1.3 cm/s in a second."""
HAND_SIDE, OBJECT_SIDE = 1, 2
"""Collision bits: the hand's geoms meet the object's and nothing else."""
TABLE_SIDE = 4
"""The table meets the object's hull alone, in at most four points, and not its parts."""
STIFF = (0.99, 0.999, 0.001, 0.5, 2.0)
"""`solimp` of joint limits and of the fingers' coupling: with the default one, 2 x 70 N push the
fingers millimetres past their limits."""
FINGER_MOMENT = 3e-5
"""Moments of inertia of what only slides [kg m^2]: they do not matter."""


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class PairModel:
    """One hand and one object, compiled, with what the model itself does not keep."""

    model: Any
    """MuJoCo's `MjModel`; its world is the hand's frame `grasp`."""
    T_obj_body: Array
    """(4, 4) the object's principal frame."""
    triangles_obj: Array
    """(T, 3, 3) surface of the convex parts, object frame [m]."""
    reach_m: float
    """Greatest distance of a vertex from the centre of mass [m]."""
    geometry: Hand
    mass_kg: float
    """The object's own, which may be less than what is simulated."""
    stand: Stand | None
    """What the object stands on while the fingers close; it is off while loads are played."""
    lifting: Array | None
    """(5,) z of the fingers of an arc as a polynomial of y, the constant first; None = a slide."""
    plain: Int64
    """(20,) where MuJoCo's own row of state has what a row of `mujoco_state` holds."""
    lifts: Int64
    """(2, F) where it has position and speed of the fingers along z; F = 0 for a slide."""


def load_mujoco() -> Any:
    """Return the module `mujoco`, which comes without types."""
    import mujoco
    from mujoco import rollout  # noqa: F401  # pyright: ignore[reportUnusedImport]

    module: Any = mujoco
    return module


def compile_pair(met: Meeting, settings: "MujocoSettings") -> PairModel:
    """Compile the model.

    Raises:
        InputError: MuJoCo refuses the object.
    """
    mujoco = load_mujoco()
    body, physics, geometry, stand = met.body, met.physics, met.geometry, met.stand
    T_obj_body, moments = body.principal_frame()
    spec: Any = mujoco.MjSpec()
    _set_options(spec, physics, settings)
    for low, high in np.array(geometry.palm_boxes):
        _set_contact(_add_box(spec.worldbody, low, high, 1.0), HAND_SIDE, physics, settings)
    for finger in range(2):
        _add_finger(spec, finger, geometry, physics, settings)
    _couple(spec, FINGER_NAMES[0], FINGER_NAMES[1], [0.0, 1.0], settings)  # y0 = y1
    lifting = lift_law(geometry)
    for finger, lift in zip(FINGER_NAMES, LIFT_NAMES, strict=True):
        if lifting is not None:
            _couple(spec, lift, finger, lifting, settings)
    parts = [se3.transform(se3.invert(T_obj_body), part) for part in body.parts]
    _add_object(spec, parts, body.mass_kg, moments, physics, settings)
    _add_drive(spec, physics, settings)
    if stand is not None:
        _add_stand(spec, stand, np.concatenate(parts), settings)
    try:
        model = spec.compile()
        lifts = lift_joints(model)
        _keep_tolerance(model, [int(joint.dofadr[0]) for joint in lifts])
        if physics.pads:
            set_pads(model, int(model.body(OBJECT).id), physics.pads, settings)
        triangles = surface_triangles(body.parts)
    except (ValueError, RuntimeError) as error:
        raise InputError(
            f"MuJoCo cannot simulate the object of {len(parts)} convex parts and "
            f"{body.mass_kg:g} kg: {str(error).strip()}. Each part must be a solid of at least "
            "four points that are not in a plane, and mass and inertia those of one solid."
        ) from error
    return PairModel(
        model=model,
        T_obj_body=T_obj_body,
        triangles_obj=triangles,
        reach_m=body.reach(),
        geometry=geometry,
        mass_kg=body.mass_kg,
        stand=stand,
        lifting=lifting,
        **_columns(model, lifts),
    )


# --- Fingers on an arc: a second slide along z, coupled to the first while the hand closes --------
# The drive of such a hand locks itself (Robotiq's is a screw), so that a load along z does not open
# or close it. Coupled, it would: the joints' reaction along y is the load times the arc's slope. So
# the coupling holds while the hand closes, and the fingers' height is locked, by a mass that no
# load moves, while loads are played.


def lift_law(hand: Hand) -> Array | None:
    """Return the polynomial (5,) of a finger's z over its y [m], constant first; None = a slide."""
    if not hand.arc_radius_m:
        return None
    y = np.linspace(0.0, hand.max_opening_m / 2.0, 201)
    fit = np.polynomial.Polynomial.fit(y, hand.z_pad(2.0 * y), 4)
    return np.asarray(fit.convert().coef, dtype=np.float64)


def lift_joints(model: Any) -> list[Any]:
    """Return the joints along z of a compiled model's fingers."""
    names = {model.joint(j).name for j in range(model.njnt)}
    return [model.joint(name) for name in LIFT_NAMES if name in names]


def lock_lifts(model: Any, locked: bool, settings: "MujocoSettings") -> None:
    """Hold the fingers' height, or let it follow the arc."""
    for joint in lift_joints(model):
        at = int(joint.dofadr[0])
        model.dof_armature[at] = LOCKED_KG if locked else settings.armature_kg
        # Of bodies that only slide MuJoCo takes the sum that it made at compile time.
        model.dof_M0[at] = model.dof_armature[at] + model.body_mass[model.dof_bodyid[at]]
        follows = model.eq_obj1id == joint.id
        model.eq_active0[follows] = not locked


def _columns(model: Any, lifts: list[Any]) -> dict[str, Int64]:
    """Return the fields `plain` and `lifts` of a compiled model."""
    at = [1 + int(joint.qposadr[0]) for joint in lifts]
    speed = [1 + int(model.nq) + int(joint.dofadr[0]) for joint in lifts]
    width = 1 + int(model.nq) + int(model.nv)
    return {
        "plain": np.delete(np.arange(width), [*at, *speed]),
        "lifts": np.array([at, speed], dtype=np.int64).reshape(2, -1),
    }


def _keep_tolerance(model: Any, lifts: list[int]) -> None:
    """Let the solver be as exact as if the carriage and the locked heights were not there.

    Its tolerance is relative to the mean inertia of the model, most of which is theirs.
    """
    model.opt.tolerance *= np.delete(model.dof_M0[:-1], lifts).mean() / model.stat.meaninertia


def _set_options(spec: Any, physics: SlipPhysics, settings: "MujocoSettings") -> None:
    """Set integrator, solver and cone."""
    mujoco = load_mujoco()

    option = spec.option
    option.timestep = settings.step_s
    option.gravity = [0.0, 0.0, 0.0]
    option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    option.cone = mujoco.mjtCone.mjCONE_ELLIPTIC
    option.noslip_iterations = settings.noslip_iterations
    off = mujoco.mjtDisableBit
    # A diverged pair must not be put back to where it began, as if nothing had happened.
    option.disableflags |= int(off.mjDSBL_AUTORESET)
    # One hand and one object are one island: looking for others only costs time (5 %).
    option.disableflags |= int(off.mjDSBL_ISLAND)
    if physics.pads:
        # The spheres carry the load; more points of the finger's box cost time (7 %).
        option.disableflags |= int(off.mjDSBL_MULTICCD)


def _add_finger(
    spec: Any, finger: int, geometry: Hand, physics: SlipPhysics, settings: "MujocoSettings"
) -> None:
    """Add a finger that slides along y; its joint's position is its face's distance from y = 0."""
    mujoco = load_mujoco()

    name, side, pads = FINGER_NAMES[finger], SIDES[finger], physics.pads
    body = spec.worldbody.add_body(name=name)
    body.explicitinertial = True
    body.mass = (pads or PadModel()).finger_mass_kg
    body.inertia = [FINGER_MOMENT] * 3
    body.add_joint(
        name=name,
        type=mujoco.mjtJoint.mjJNT_SLIDE,
        axis=[0.0, side, 0.0],
        range=[0.0, geometry.max_opening_m / 2.0],
        limited=True,
        armature=settings.armature_kg,
        solref_limit=[settings.contact_time_s, 1.0],
        solimp_limit=STIFF,
    )
    if geometry.arc_radius_m:
        body.add_joint(
            name=LIFT_NAMES[finger],
            type=mujoco.mjtJoint.mjJNT_SLIDE,
            axis=[0.0, 0.0, 1.0],
            armature=LOCKED_KG,
        )
    if pads:
        for x, z in pads.centers_xz():
            pad = body.add_geom(
                type=mujoco.mjtGeom.mjGEOM_SPHERE,
                size=[pads.sphere_radius_m, 0.0, 0.0],
                pos=[x, side * pads.sphere_radius_m, z],
            )
            _set_contact(pad, HAND_SIDE, physics, settings)
            pad.priority = PAD_PRIORITY
    for low, high in np.array(geometry.finger_boxes):
        if pads:
            low[1] = max(low[1], pads.protrusion_m)
        _set_contact(_add_box(body, low, high, side), HAND_SIDE, physics, settings)
    # The sensor adds up the normal forces of the body's contacts inside its site: the whole finger.
    body.add_site(name=name, type=mujoco.mjtGeom.mjGEOM_SPHERE, size=[1.0, 0.0, 0.0])
    spec.add_sensor(
        name=name,
        type=mujoco.mjtSensor.mjSENS_TOUCH,
        objtype=mujoco.mjtObj.mjOBJ_SITE,
        objname=name,
    )


def _add_drive(spec: Any, physics: SlipPhysics, settings: "MujocoSettings") -> None:
    """Add the carriage that takes the fingers along until they resist with more than their force.

    Each finger is held to the carriage by dry friction of the hand's force; the carriage is too
    heavy to be slowed.
    """
    mujoco = load_mujoco()
    body = spec.worldbody.add_body(name=CARRIAGE)
    body.explicitinertial = True
    body.mass = CARRIAGE_KG_PER_N * physics.force_n
    body.inertia = [FINGER_MOMENT] * 3
    body.add_joint(name=CARRIAGE, type=mujoco.mjtJoint.mjJNT_SLIDE, axis=[0.0, 1.0, 0.0])
    for name in FINGER_NAMES:
        clutch = spec.add_tendon(
            name=name,
            frictionloss=physics.force_n,
            solref_friction=[settings.contact_time_s, 1.0],
            solimp_friction=STIFF,
        )
        clutch.wrap_joint(name, 1.0)
        clutch.wrap_joint(CARRIAGE, -1.0)


def _couple(
    spec: Any, led: str, leading: str, law: "Array | list[float]", settings: "MujocoSettings"
) -> None:
    """Keep one joint's position where a polynomial of another's has it, as a linkage does."""
    mujoco = load_mujoco()

    gear = spec.add_equality(
        type=mujoco.mjtEq.mjEQ_JOINT,
        objtype=mujoco.mjtObj.mjOBJ_JOINT,
        name1=led,
        name2=leading,
        solref=[settings.contact_time_s, 1.0],
        solimp=STIFF,
    )
    gear.data[:5] = [*law, *[0.0] * (5 - len(law))]


def _add_object(
    spec: Any,
    parts: list[Array],
    mass_kg: float,
    moments: Array,
    physics: SlipPhysics,
    settings: "MujocoSettings",
) -> None:
    """Add the object; its body frame is the principal one, its parts are in that frame."""
    factor = max(1.0, physics.mass_floor_kg / mass_kg)
    body = spec.worldbody.add_body(name=OBJECT)
    body.add_freejoint()
    body.explicitinertial = True
    body.mass = mass_kg * factor
    body.inertia = moments * factor
    for i, part in enumerate(parts):
        geom = _add_hull(spec, body, f"part{i}", part)
        _set_contact(geom, OBJECT_SIDE, physics, settings)


def _add_hull(spec: Any, body: Any, name: str, points: Array) -> Any:
    """Add the convex hull of points (V, 3) to a body and return its geom."""
    mujoco = load_mujoco()

    mesh = spec.add_mesh(name=name)
    mesh.uservert = points.ravel().tolist()
    # Thin parts have too little volume for MuJoCo; the body's inertia is given anyway.
    mesh.inertia = mujoco.mjtMeshInertia.mjMESH_INERTIA_SHELL
    return body.add_geom(name=name, type=mujoco.mjtGeom.mjGEOM_MESH, meshname=name)


# --- What the object stands on while the fingers close -------------------------------------------
# Table and neighbours are one mocap body, put where each pair has them. A plane meets only the hull
# of an object, so the hull of all parts stands on it: four contacts in place of dozens.


def _add_stand(spec: Any, stand: Stand, corners: Array, settings: "MujocoSettings") -> None:
    """Add the table, its neighbours, and the hull of the object's corners (V, 3) that stands."""
    mujoco = load_mujoco()

    body = spec.worldbody.add_body(name=STAND, mocap=True)
    plane = body.add_geom(
        type=mujoco.mjtGeom.mjGEOM_PLANE, size=[0.0, 0.0, 1.0], pos=[0.0, 0.0, stand.height_m]
    )
    geoms = [plane]
    geoms += [_add_hull(spec, body, f"beside{i}", p) for i, p in enumerate(stand.obstacles)]
    for geom in geoms:
        geom.friction, geom.condim = [stand.friction, 0.0, 0.0], 3
        geom.solref = [settings.contact_time_s, 1.0]
        # MuJoCo takes the friction of the geom with the higher priority, or else the greater one.
        geom.priority = 1
    hull = _add_hull(spec, spec.body(OBJECT), HULL, corners)
    hull.contype, hull.conaffinity = 0, TABLE_SIDE


def _add_box(body: Any, low: Array, high: Array, side: float) -> Any:
    """Add the box from `low` to `high`, mirrored in y if side < 0, and return its geom."""
    mujoco = load_mujoco()

    center, half = (low + high) / 2.0, (high - low) / 2.0
    return body.add_geom(
        type=mujoco.mjtGeom.mjGEOM_BOX, size=half, pos=[center[0], side * center[1], center[2]]
    )


def _set_contact(geom: Any, side: int, physics: SlipPhysics, settings: "MujocoSettings") -> None:
    """Set friction, stiffness and what the geom meets."""
    geom.contype, geom.conaffinity = side, HAND_SIDE + OBJECT_SIDE - side
    geom.condim = 3
    geom.friction = [physics.friction, 0.0, 0.0]
    if physics.pads:
        geom.solref = [settings.contact_time_s, 1.0]
