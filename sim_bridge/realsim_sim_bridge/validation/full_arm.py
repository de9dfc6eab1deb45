"""The same grasps carried by a whole Panda in PyBullet, with gravity on and nothing replayed.

The hand that stands still feels loads that were computed; here nothing is: seven joints under
position control move a hand with the same pads, and the object has its true mass. What the two have
in common is the hand's motion alone.

An arm as a URDF, from the same Denavit-Hartenberg numbers as its kinematics.

Joints, limits and torques are the description's; there is no collision geometry, because what is
moved by this arm in a simulation is watched at the hand. PyBullet reads the offsets and angles of a
URDF in single precision, so that its link frames are right to 1e-7 and not to the last digit.
"""

import tempfile
from collections.abc import Iterable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from realsim import interop
from realsim.arrays import Array
from realsim.geometry import se3
from realsim.records import STAGES
from realsim.robots.arm import RobotArm
from realsim.robots.compiled_chain import follow_lines
from realsim.robots.hand import Hand, find_hand
from realsim_sim_bridge.slip.bullet_pair import LIFT_N, LIFT_PULL, close, couple
from realsim_sim_bridge.slip.bullet_shapes import hand_urdf
from realsim_sim_bridge.slip.motion import SlipMotion, min_jerk, pendulum_angle
from realsim_sim_bridge.slip.score import ScoreLimits
from realsim_sim_bridge.slip.slip_test import SlipConfig, run_slip_test
from realsim_sim_bridge.slip.world import Engine
from realsim_sim_bridge.validation.config import ValidationConfig
from realsim_sim_bridge.validation.loads import with_hand
from realsim_sim_bridge.validation.report import CheckResult
from realsim_sim_bridge.validation.specimens import READY, SIDE_M, cube, panda, ready_trial

PANDA_LINKS = (
    (0.629769, (-0.041018, -0.00014, 0.049974),
     (0.00315, 8.2904e-07, 0.00015, 0.00388, 8.2299e-06, 0.004285)),
    (4.970684, (0.003875, 0.002081, -0.04762),
     (0.70337, -0.000139, 0.006772, 0.70661, 0.019169, 0.009117)),
    (0.646926, (-0.003141, -0.02872, 0.003495),
     (0.007962, -0.003925, 0.010254, 0.02811, 0.000704, 0.025995)),
    (3.228604, (0.027518, 0.039252, -0.066502),
     (0.037242, -0.004761, -0.011396, 0.036155, -0.012805, 0.01083)),
    (3.587895, (-0.05317, 0.104419, 0.027454),
     (0.025853, 0.007796, -0.001332, 0.019552, 0.008641, 0.028323)),
    (1.225946, (-0.011953, 0.041065, -0.038437),
     (0.035549, -0.002117, -0.004037, 0.029474, 0.000229, 0.008627)),
    (1.666555, (0.060149, -0.014117, -0.010517),
     (0.001964, 0.000109, -0.001158, 0.004354, 0.000341, 0.005433)),
    (0.735522, (0.010517, -0.004252, 0.061597 - 0.107),
     (0.012516, -0.000428, -0.001196, 0.010027, -0.000741, 0.004815)),
)  # fmt: skip
"""Mass [kg], centre of mass [m] and inertia ixx ixy ixz iyy iyz izz [kg m^2] of links 0 to 7:
franka_description, after Gaz et al., Dynamic identification of the Franka Emika Panda robot with
retrieval of feasible parameters using penalty-based optimization, 2019. Link i's frame lies on
joint i's axis beside the next one; of link 7 it is the flange."""
FLANGE = (0.001, (0.0, 0.0, 0.0), (1e-6, 0.0, 0.0, 1e-6, 0.0, 1e-6))
"""Mass, centre and inertia of the link `flange`: a mere frame, but PyBullet gives a link without
mass a kilogram; the flange's own mass is in link 7."""


def arm_urdf(
    arm: RobotArm,
    geometry: Hand,
    hand: str = "",
    links: tuple[tuple[float, tuple[float, ...], tuple[float, ...]], ...] = PANDA_LINKS,
) -> str:
    """Return the URDF of an arm: links link0 to linkn, joints joint1 to jointn, and `flange`.

    Args:
        arm: its chain, limits and torques.
        geometry: the hand, whose mounting face lies on the flange.
        hand: URDF of a hand whose first link is `palm` with the grasp frame as its own
            (`slip.hand_urdf`); its links and joints are taken over, fixed to the flange. '' = none.
        links: mass, centre of mass and inertia of base and links, as `PANDA_LINKS`.
    """
    chain, limits = arm.chain, arm.chain.limits
    text = "".join(_massive(f"link{i}", *matter) for i, matter in enumerate(links))
    behind = chain.T_base_0
    for i in range(arm.joints):
        T = behind @ se3.from_rt(se3.exp_so3([0, 0, chain.theta[i]]), [0.0, 0.0, chain.d[i]])
        limit = " ".join(
            f'{name}="{float(value)!r}"'
            for name, value in (
                ("lower", limits.lower[i]), ("upper", limits.upper[i]),
                ("effort", arm.torque[i]), ("velocity", limits.speed[i]),
            )
        )  # fmt: skip
        text += _jointed(
            f"joint{i + 1}", f"link{i}", f"link{i + 1}", T, f'<axis xyz="0 0 1"/><limit {limit}/>'
        )
        behind = se3.from_rt(se3.exp_so3([chain.alpha[i], 0, 0]), [chain.a[i], 0.0, 0.0])
    text += _massive("flange", *FLANGE)
    text += _jointed("flange", f"link{arm.joints}", "flange", behind @ chain.T_n_ee)
    if hand:
        start, end = hand.index(">", hand.index("<robot")) + 1, hand.rindex("</robot>")
        text += hand[start:end] + _jointed("hand", "flange", "palm", geometry.T_ee_grasp)
    return f'<robot name="{arm.folder.name}">{text}</robot>'


def _massive(name: str, mass: float, center: tuple[float, ...], inertia: tuple[float, ...]) -> str:
    """Return the element of a link with a mass [kg] and inertia ixx ixy ixz iyy iyz izz."""
    names = ("ixx", "ixy", "ixz", "iyy", "iyz", "izz")
    moments = " ".join(f'{name}="{value!r}"' for name, value in zip(names, inertia, strict=True))
    return (
        f'<link name="{name}"><inertial><origin xyz="{_numbers(center)}"/>'
        f'<mass value="{mass!r}"/><inertia {moments}/></inertial></link>'
    )


def _jointed(name: str, parent: str, child: str, T: Array, turning: str = "") -> str:
    """Return the element of a joint at T (4, 4) in its parent; `turning` = fixed if ''."""
    yaw, pitch, roll = Rotation.from_matrix(T[:3, :3]).as_euler("ZYX").tolist()
    return (
        f'<joint name="{name}" type="{"revolute" if turning else "fixed"}"><parent '
        f'link="{parent}"/><child link="{child}"/><origin xyz="{_numbers(T[:3, 3])}" '
        f'rpy="{_numbers((roll, pitch, yaw))}"/>{turning}</joint>'
    )


def _numbers(values: Iterable[float]) -> str:
    """Return numbers as a URDF has them, with all their digits."""
    return " ".join(repr(float(value)) for value in values)


# --- The joint angles of a Panda that move its hand as each stage of the slip test does ----------


def stage_joints(stage: int, q: Array, motion: SlipMotion, dt: float) -> Array:
    """Return the joints' path (T, 7) [rad] of a stage, from q (7,) on."""
    if STAGES[stage] == "pendulum":
        sweep = np.radians(motion.pendulum_deg)
        j = panda().swing_joint
        low, high = np.clip(panda().swing_in_grasp(q)[2], -sweep, sweep)
        path = np.tile(q, (round(motion.pendulum_s / dt), 1))
        angle = pendulum_angle(motion, dt, float(low), float(high))[0]
        path[: len(angle), j] += angle[: len(path)]
        return path
    if STAGES[stage] == "lift":
        t = dt * np.arange(1.0, round((motion.lift_s + motion.lift_hold_s) / dt) + 1)
        return _along(q, 2, min_jerk(motion.lift_height_m, motion.lift_s, t)[0])
    count = round(motion.oscillation_cycles / motion.oscillation_hz / dt)
    phase = 2 * np.pi * motion.oscillation_hz * dt * np.arange(1, count + 1)
    wave = motion.oscillation_m * (1.0 - np.cos(phase))
    return np.concatenate([_along(q, axis, wave) for axis in (0, 1)])


def _along(q: Array, axis: int, distances: Array) -> Array:
    """Return joint angles (T, 7) that carry the hand along an axis of the base, T distances [m]."""
    T = panda().forward(q)[None]
    return follow_lines(panda().numbers, q[None], T, np.eye(3)[[axis]], distances)[0][0]


RATE_HZ = 1000.0
"""Steps per second: the arm carries true masses, for which the hand's steps are too long."""
STIFFNESS, DAMPING = 1e5, 10.0
"""Stiffness and damping of the pads [N/m, N s/m]. In a hand that turns, Bullet's friction makes the
velocities equal of two points that lie as far apart as pad and object overlap; at 10000 N/m and 70
N these are 1.2 of 25 mm, and the object lags behind the hand by 5 % of its turn. A hand at rest
knows no such lag."""
ITERATIONS = 100
"""Iterations of the solver, each step."""
GEAR_ERP, GEAR_FORCE_N = 0.3, 1000.0
"""What keeps the two fingers symmetric: share of the error taken back per step, and force [N]."""
CLOSE_S = 0.5
"""Time for closing [s]: the fingers arrive within 0.1 s."""
HEADROOM_M = 0.004
"""The fingers start this far from the cube [m]."""
PULL = 0.3
"""Share of a joint's error that its control takes back per step."""


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class CarriedCube:
    """What a cube did in the hand of a moving arm."""

    slip_m: Array
    """(4,) by stage: NaN = not executed, inf = lost."""
    slip_rad: Array
    """(4,)."""
    tracking_rad: float
    """Greatest error of a joint while it followed its path."""

    @property
    def passed(self) -> bool:
        """Whether all four stages were passed."""
        limits = ScoreLimits()
        held = (self.slip_m <= limits.slip_m) & (self.slip_rad <= np.radians(limits.slip_deg))
        return bool(held.all())


def arm_checks(engine: Engine, config: ValidationConfig) -> list[CheckResult]:
    """Return how far the engine's hand that stands still agrees with an arm that moves."""
    labels = config.labels
    same, slip_m, turn_rad, tracking = 0, 0.0, 0.0, 0.0
    told: list[str] = []
    R_down = se3.from_rt(panda().forward(READY)[:3, :3], np.zeros(3))
    for mass, force_n, friction, beside_m in labels.arm_cases:
        slip = with_hand(config.slip, force_n, friction)
        T_obj_pads = se3.from_translation([beside_m, 0.0, 0.0])
        T_obj_grasp = config.hand.grasps_of_pads(T_obj_pads[None], SIDE_M)[0]
        arm = carry_cube(mass, T_obj_grasp, slip, config.hand)
        trial = ready_trial(cube(mass), T_obj_grasp[None], R_down[None], SIDE_M + 2 * HEADROOM_M)
        hand = run_slip_test(trial, slip, geometry=config.hand, engine=engine)
        agree = arm.passed == bool(hand.passed[0])
        same += agree
        tracking = max(tracking, arm.tracking_rad)
        verdict = ("held" if arm.passed else "dropped") if agree else "DIFFERENT"
        told.append(
            f"{mass:g} kg, {force_n:g} N, mu {friction:g}, {1e3 * beside_m:g} mm: {verdict}"
        )
        if arm.passed and hand.passed[0]:
            slip_m = max(slip_m, float(np.abs(arm.slip_m - hand.slip_m[0]).max()))
            turn_rad = max(turn_rad, float(np.abs(arm.slip_rad - hand.slip_rad[0]).max()))
    followed = f"the arm's joints within {np.degrees(tracking):.2f} deg of their path"
    return [
        CheckResult(
            group="full_arm", name="full arm, labels",
            what="share of boxes with the same label in the hand alone and in PyBullet's whole arm",
            measured=same / len(labels.arm_cases), unit="", limit=1.0, at_least=True,
            detail="; ".join(told),
        ),
        CheckResult(
            group="full_arm", name="full arm, slip",
            what="difference of slip in a stage between the hand alone and the whole arm",
            measured=1e3 * slip_m, unit="mm", limit=1e3 * labels.arm_slip_m, detail=followed,
        ),
        CheckResult(
            group="full_arm", name="full arm, turn",
            what="difference of turn in a stage between the hand alone and the whole arm",
            measured=float(np.degrees(turn_rad)), unit="deg", limit=labels.arm_turn_deg,
            detail=followed,
        ),
    ]  # fmt: skip


def carry_cube(mass_kg: float, T_obj_grasp: Array, config: SlipConfig, hand: Hand) -> CarriedCube:
    """Close on a weightless cube in the ready pose, turn gravity on and play the stages.

    Args:
        mass_kg: of the cube.
        T_obj_grasp: (4, 4) where it is grasped; the hand points down, the cube as it comes [m].
        config: the hand's force and friction, and the motions.
        hand: what grasps, on a mount that puts its frame `grasp` where Franka's is.
    """
    usual = find_hand()
    hand = replace(hand, mount_z_m=usual.mount_z_m, mount_turn_deg=usual.mount_turn_deg)
    slip_m, slip_rad = np.full(len(STAGES), np.nan), np.full(len(STAGES), np.nan)
    limits = ScoreLimits()
    with _ArmWorld(mass_kg, T_obj_grasp, config, hand) as world:
        q, tracking = READY.copy(), 0.0
        for stage in range(len(STAGES)):
            if stage == 0:
                path = np.tile(q, (round(CLOSE_S / world.dt), 1))
                world.close_fingers(config.closing.speed)
            else:
                world.set_gravity(config.motion.gravity)
                path = stage_joints(stage, q, config.motion, world.dt)
            slip_m[stage], slip_rad[stage], error = world.follow(
                path, q, config.sample_s, config.lost_m
            )
            q, tracking = path[-1], max(tracking, error)
            if not (
                slip_m[stage] <= limits.slip_m and np.degrees(slip_rad[stage]) <= limits.slip_deg
            ):
                break
    return CarriedCube(slip_m=slip_m, slip_rad=slip_rad, tracking_rad=tracking)


class _ArmWorld:
    """An arm with a hand and a cube in PyBullet."""

    def __init__(self, mass_kg: float, T_obj_grasp: Array, config: SlipConfig, hand: Hand) -> None:
        self._engine = interop.pybullet_client()
        self._config, self._hand, self.dt = config, hand, 1.0 / RATE_HZ
        self._engine.setPhysicsEngineParameter(
            fixedTimeStep=self.dt, numSolverIterations=ITERATIONS, numSubSteps=0,
            deterministicOverlappingPairs=1, solverResidualThreshold=0.0,
        )  # fmt: skip
        self._engine.setGravity(0.0, 0.0, 0.0)
        self._add_arm()
        self._add_cube(mass_kg, panda().forward(READY) @ se3.invert(T_obj_grasp))

    def __enter__(self) -> "_ArmWorld":
        return self

    def __exit__(self, *_: object) -> None:
        self._engine.disconnect()

    def close_fingers(self, speed: float) -> None:
        """Let the fingers close at `speed` [m/s] and press with the hand's force from then."""
        close(self._engine, self._arm, self._fingers, speed, self._config.physics.force_n)

    def set_gravity(self, gravity: float) -> None:
        """Turn gravity on [m/s^2]."""
        self._engine.setGravity(0.0, 0.0, -gravity)

    def follow(
        self, path: Array, q: Array, sample_s: float, lost_m: float
    ) -> tuple[float, float, float]:
        """Follow angles (T, 7) from q (7,); return slip [m], turn and tracking error [rad]."""
        engine, start = self._engine, self._in_hand()
        speeds = np.diff(np.vstack([q, path]), axis=0) / self.dt
        slip = turn = tracking = 0.0
        for t, (target, speed) in enumerate(zip(path.tolist(), speeds.tolist(), strict=True), 1):
            engine.setJointMotorControlArray(
                self._arm, self._joints, engine.POSITION_CONTROL, targetPositions=target,
                targetVelocities=speed, forces=panda().arm.torque.tolist(),
                positionGains=[PULL] * len(q), velocityGains=[1.0] * len(q),
            )  # fmt: skip
            self._follow_arc()
            engine.stepSimulation()
            if t % max(1, round(sample_s / self.dt)) == 0 or t == len(path):
                now = self._in_hand()
                slip = max(slip, float(np.linalg.norm(now[:3, 3] - start[:3, 3])))
                turn = max(turn, float(se3.angle(start[:3, :3].T @ now[:3, :3])))
                states = engine.getJointStates(self._arm, self._joints)
                errors = [abs(s[0] - a) for s, a in zip(states, target, strict=True)]
                tracking = max(tracking, *errors)
                if slip > lost_m:
                    return float("inf"), float("inf"), tracking
        return slip, turn, tracking

    def _follow_arc(self) -> None:
        """Put fingers on an arc where it has them in the next step."""
        for carrier, finger in self._carriers:
            y = self._engine.getJointState(self._arm, finger)[0]
            self._engine.setJointMotorControl2(
                self._arm, carrier, self._engine.POSITION_CONTROL,
                targetPosition=float(self._hand.z_pad(2.0 * y)), positionGain=LIFT_PULL,
                velocityGain=1.0, force=LIFT_N,
            )  # fmt: skip

    def _in_hand(self) -> Array:
        """Return the cube's pose (4, 4) in the grasp frame, as the engine has both."""
        link = self._engine.getLinkState(self._arm, self._palm, computeForwardKinematics=1)
        hand = interop.T_from_pybullet(link[4], link[5])
        cube = interop.T_from_pybullet(*self._engine.getBasePositionAndOrientation(self._cube))
        return se3.invert(hand) @ cube

    def _add_arm(self) -> None:
        """Load the arm in its ready pose with its hand open."""
        engine, physics = self._engine, self._config.physics
        with tempfile.TemporaryDirectory() as folder:
            urdf = Path(folder) / "arm.urdf"
            hand = hand_urdf(self._hand, physics.pads)
            urdf.write_text(arm_urdf(panda().arm, self._hand, hand))
            self._arm: int = engine.loadURDF(
                str(urdf),
                useFixedBase=True,
                flags=engine.URDF_USE_SELF_COLLISION_EXCLUDE_ALL_PARENTS
                | engine.URDF_USE_INERTIA_FROM_FILE,
            )
        count = engine.getNumJoints(self._arm)
        names = [engine.getJointInfo(self._arm, j) for j in range(count)]
        link = {info[12].decode(): j for j, info in enumerate(names)}
        self._joints = [link[f"link{i + 1}"] for i in range(panda().joints)]
        self._fingers, self._palm = (link["left"], link["right"]), link["palm"]
        carriers = [link[n] for n in ("left_carrier", "right_carrier") if n in link]
        self._carriers = list(zip(carriers, self._fingers, strict=False))
        """What carries a finger along z, and the finger; none but of an arc."""
        for carrier, _ in self._carriers:
            z = self._hand.z_pad(SIDE_M + 2 * HEADROOM_M)
            engine.resetJointState(self._arm, carrier, float(z))
        # Never together with a link's settings: PyBullet then drops these.
        engine.changeDynamics(self._arm, -1, linearDamping=0.0, angularDamping=0.0)
        for joint, angle in zip(self._joints, READY.tolist(), strict=True):
            engine.resetJointState(self._arm, joint, angle)
        for finger in self._fingers:
            engine.resetJointState(self._arm, finger, SIDE_M / 2 + HEADROOM_M)
            engine.changeDynamics(
                self._arm, finger, lateralFriction=1.0, spinningFriction=0.0, rollingFriction=0.0
            )
            if physics.pads:
                engine.changeDynamics(
                    self._arm, finger,
                    contactStiffness=STIFFNESS, contactDamping=DAMPING,
                )  # fmt: skip
        couple(engine, self._arm, self._fingers, GEAR_ERP, GEAR_FORCE_N)

    def _add_cube(self, mass_kg: float, T_base_cube: Array) -> None:
        """Add the cube, weightless until gravity is turned on."""
        engine = self._engine
        position, xyzw = interop.pybullet_from_T(T_base_cube)
        shape: int = engine.createCollisionShape(engine.GEOM_BOX, halfExtents=[SIDE_M / 2] * 3)
        self._cube: int = engine.createMultiBody(
            baseMass=mass_kg, baseCollisionShapeIndex=shape, basePosition=position,
            baseOrientation=xyzw,
        )  # fmt: skip
        engine.changeDynamics(self._cube, -1, linearDamping=0.0, angularDamping=0.0)
        engine.changeDynamics(
            self._cube, -1, lateralFriction=self._config.physics.friction, spinningFriction=0.0,
            rollingFriction=0.0,
        )  # fmt: skip
