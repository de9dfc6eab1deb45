"""The motions of the four stages, as the load an object feels in a hand that stands still.

The hand is fixed and its motion is replayed as inertial forces: an object of mass m at c, held by a
hand with acceleration a and turning about an axis through p with angle theta(t), feels in the
hand's frame

    F = m (R(theta)^T g - a - alpha x (c - p) - omega x (omega x (c - p)))
    M = -(I alpha + omega x I omega)

(d'Alembert; the Coriolis term is zero as long as the object does not slide). The profiles' values
are chosen here because the paper gives none: docs/decisions/0005-slip-test-parameters.md.
"""

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from realsim.arrays import Array, Int64
from realsim.geometry import se3
from realsim.records import STAGES


@dataclass(frozen=True, kw_only=True, slots=True)
class SlipMotion:
    """Amplitudes, frequencies and durations of the stages."""

    gravity: float = 9.81
    """[m/s^2], along -z of the table."""
    lift_height_m: float = 0.20
    """Vertical displacement [m]; the paper's."""
    lift_s: float = 1.0
    """Duration of the minimum-jerk lift [s]: peak 0.375 m/s and 1.15 m/s^2."""
    lift_hold_s: float = 0.15
    """Rest after the lift [s]."""
    oscillation_m: float = 0.05
    """Amplitude of the horizontal oscillation [m], from the middle to either end."""
    oscillation_hz: float = 1.5
    """Frequency [Hz]: with 5 cm a peak of 4.4 m/s^2, a third of the Panda's Cartesian limit."""
    oscillation_cycles: int = 2
    """Cycles along the table's x, and as many along its y."""
    pendulum_deg: float = 60.0
    """Joint 5 goes to +this, to -this and back [deg], cut at the joint's limits."""
    pendulum_s: float = 3.2
    """Duration of the whole swing [s]: peak 2.45 rad/s, the Panda's limit is 2.61."""


def min_jerk(distance: float, duration_s: float, t: Array) -> tuple[Array, Array, Array]:
    """Return position, speed and acceleration (T,) of a minimum-jerk move at times t (T,)."""
    u = np.clip(t / duration_s, 0.0, 1.0)
    position = distance * u**3 * (10 - 15 * u + 6 * u**2)
    speed = distance / duration_s * 30 * u**2 * (1 - u) ** 2
    acceleration = distance / duration_s**2 * 60 * u * (1 - u) * (1 - 2 * u)
    return position, speed, acceleration


def _times(duration_s: float, dt: float) -> Array:
    """Return the times (T,) [s] at which the steps of a duration start."""
    return np.arange(round(duration_s / dt), dtype=np.float64) * dt


def lift_acceleration(motion: SlipMotion, dt: float) -> Array:
    """Return the hand's acceleration (T, 3) [m/s^2] during the lift, table axes."""
    t = _times(motion.lift_s + motion.lift_hold_s, dt)
    a = np.zeros((len(t), 3))
    a[:, 2] = min_jerk(motion.lift_height_m, motion.lift_s, t)[2]
    return a


def oscillation_acceleration(motion: SlipMotion, dt: float) -> Array:
    """Return the hand's acceleration (T, 3) [m/s^2] during the oscillation, table axes.

    x(t) = A (1 - cos 2 pi f t): from rest to rest within whole cycles, 2 A from end to end.
    """
    omega = 2 * np.pi * motion.oscillation_hz
    n = round(motion.oscillation_cycles / motion.oscillation_hz / dt)
    wave = motion.oscillation_m * omega**2 * np.cos(omega * np.arange(n) * dt)
    a = np.zeros((2 * n, 3))
    a[:n, 0], a[n:, 1] = wave, wave
    return a


def pendulum_angle(motion: SlipMotion, dt: float, low: float, high: float) -> Array:
    """Return angle, speed and acceleration (3, T) of joint 5: 0 -> high -> low -> 0 [rad]."""
    quarter = motion.pendulum_s / 4
    moves = ((0.0, high, quarter), (high, low, 2 * quarter), (low, 0.0, quarter))
    pieces: list[Array] = []
    for start, end, duration in moves:
        t = _times(duration, dt)
        position, speed, acceleration = min_jerk(end - start, duration, t)
        pieces.append(np.stack([start + position, speed, acceleration]))
    return np.concatenate(pieces, axis=1)


def pendulum_wrenches(
    angles: Array, axes: Array, arms: Array, inertias: Array, mass: float, gravity: float
) -> Array:
    """Return wrenches (K, T, 6) on objects in hands that turn about joint 5.

    Args:
        angles: (K, 3, T) angle, speed and acceleration of each joint.
        axes: (K, 3) unit axes, world axes at the stage's start.
        arms: (K, 3) from the axis to the centre of mass [m].
        inertias: (K, 3, 3) about the centre of mass, world axes [kg m^2].
        mass: [kg].
        gravity: [m/s^2] along -z.
    """
    theta, speed, acceleration = (angles[:, i, :, None] for i in range(3))
    axis = axes[:, None, :]
    g = np.array([0.0, 0.0, -gravity])
    # g in the hand's frame is exp(-axis theta) g (Rodrigues).
    cos, sin = np.cos(theta), np.sin(theta)
    along = np.sum(axis * g, axis=-1, keepdims=True)
    turned = cos * g - sin * np.cross(axis, g) + (1 - cos) * axis * along
    omega, alpha = speed * axis, acceleration * axis
    arm = arms[:, None, :]
    force = mass * (turned - np.cross(alpha, arm) - np.cross(omega, np.cross(omega, arm)))
    spin = np.einsum("kij,ktj->kti", inertias, omega)
    torque = -(np.einsum("kij,ktj->kti", inertias, alpha) + np.cross(omega, spin))
    return np.concatenate([torque, force], axis=-1)


def field_wrenches(acceleration: Array, mass: float, gravity: float, count: int) -> Array:
    """Return wrenches (K, T, 6) in hands that are moved with an acceleration (T, 3) [m/s^2].

    Args:
        acceleration: (T, 3) of all hands, table axes [m/s^2].
        mass: [kg].
        gravity: [m/s^2] along -z.
        count: number of hands K.
    """
    wrench = np.zeros((len(acceleration), 6))
    wrench[:, 3:] = mass * (np.array([0.0, 0.0, -gravity]) - acceleration)
    return np.broadcast_to(wrench, (count, *wrench.shape))


# --- What the objects feel in each stage of the slip test ----------------------------------------


if TYPE_CHECKING:
    from realsim_sim_bridge.slip.slip_test import SlipTrial


def stage_wrenches(
    stage: int, trial: "SlipTrial", Ts_world_body: Array, motion: SlipMotion, dt: float
) -> Array:
    """Return the true wrenches (K, T, 6) of a stage, one every `dt` of the hand's motion.

    Args:
        stage: number in STAGES, not 0.
        trial: the K grasps.
        Ts_world_body: (K, 4, 4) where the objects are when the stage starts.
        motion: amplitudes and durations.
        dt: [s]; an engine that steps k times finer than this plays k times too slowly.
    """
    mass = trial.body.mass_kg
    name = STAGES[stage]
    if name == "lift":
        lift = lift_acceleration(motion, dt)
        return field_wrenches(lift, mass, motion.gravity, len(trial))
    if name == "oscillate":
        shake = oscillation_acceleration(motion, dt)
        return field_wrenches(shake, mass, motion.gravity, len(trial))
    sweep = np.radians(motion.pendulum_deg)
    low, high = np.clip(trial.swing_ranges, -sweep, sweep).T
    angles = np.stack(
        [pendulum_angle(motion, dt, a, b) for a, b in zip(low.tolist(), high.tolist(), strict=True)]
    )
    R = trial.Ts_table_grasp[:, :3, :3]
    axes = np.einsum("kij,kj->ki", R, trial.swing_axes)
    points = np.einsum("kij,kj->ki", R, trial.swing_points)
    moments = trial.body.principal_frame()[1]
    turned = Ts_world_body[:, :3, :3]
    inertias = np.einsum("kij,j,klj->kil", turned, moments, turned)
    return pendulum_wrenches(
        angles, axes, Ts_world_body[:, :3, 3] - points, inertias, mass, motion.gravity
    )


LOAD_DT_S = 1.0 / 12.0
"""Times at which a swing's loads are looked at [s]: ten in a quarter of it."""


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Loads:
    """What the object feels in the stages, in the grasp frame."""

    wrenches: Array
    """(N, L, 6) torque about the centre of mass [N m] and force [N]."""
    stage: Int64
    """(L,) number in STAGES; 0 = its weight at rest."""

    def about_grasp(self, centers: Array, at: Int64 | None = None) -> Array:
        """Return wrenches (N, L, 6) about the grasp's origin; `at`: some of each grasp's (N, l).

        Args:
            centers: (N, 3) the centre of mass, grasp frame [m].
            at: (N, l) numbers of loads; None = all.
        """
        chosen = self.wrenches if at is None else np.take_along_axis(
            self.wrenches, at[:, :, None], axis=1
        )  # fmt: skip
        moved = chosen.copy()
        moved[..., :3] += np.cross(centers[:, None], chosen[..., 3:])
        return moved


def stage_loads(
    trial: "SlipTrial", motion: SlipMotion, Ts_world_body: Array | None = None
) -> Loads:
    """Return the loads of the stages that decide, and the weight at rest.

    What a grasp bears is convex, and it bears nothing: of a lift the greatest load decides, of an
    oscillation the ends of both waves, of a swing those at points in time.

    Args:
        trial: N grasps.
        motion: of the stages.
        Ts_world_body: (N, 4, 4) where the objects are; None = as the grasps have them.
    """
    R = trial.Ts_table_grasp[:, :3, :3]
    if Ts_world_body is None:
        T_obj_body = trial.body.principal_frame()[0]
        Ts_world_body = np.broadcast_to(np.eye(4), trial.Ts_obj_grasp.shape).copy()
        Ts_world_body[:, :3, :] = R @ (se3.invert(trial.Ts_obj_grasp) @ T_obj_body)[:, :3, :]
    rest = np.zeros((len(trial), 1, 6))
    rest[..., 5] = -trial.body.mass_kg * motion.gravity
    found, stage = [rest], [0]
    for k in range(1, len(STAGES)):
        wrenches = stage_wrenches(k, trial, Ts_world_body, motion, LOAD_DT_S)
        if STAGES[k] == "lift":
            # A multiple of the weight, the same one for all grasps.
            most = int(np.argmax(lift_acceleration(motion, LOAD_DT_S)[:, 2]))
            wrenches = wrenches[:, [most]]
        elif STAGES[k] == "oscillate":
            half, other = round(0.5 / motion.oscillation_hz / LOAD_DT_S), wrenches.shape[1] // 2
            wrenches = wrenches[:, [0, half, other, other + half]]
        found.append(wrenches)
        stage += [k] * wrenches.shape[1]
    world = np.concatenate(found, axis=1)
    pairs = world.reshape(*world.shape[:2], 2, 3) @ R[:, None]
    return Loads(wrenches=pairs.reshape(world.shape), stage=np.array(stage))
