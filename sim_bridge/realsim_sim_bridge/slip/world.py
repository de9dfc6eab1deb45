"""What a physics engine must be able to do for the slip test: K hands hold K copies of one object.

The hands stand still; the load that an object feels in a moving hand is applied to it. Each pair
has a frame `world` of its own: the table's axes (gravity is -z), origin at the grasp frame's. A
hand's rotation in it is that of T_table_grasp. `body` is the object's principal frame
(`SlipBody.principal_frame`).

Twists and wrenches are rotation first: (angular, linear), (torque about the centre of mass, force),
in world axes. Wrenches are true ones: where an engine simulates a greater mass than the object has
(`SlipPhysics.mass_floor_kg`), the heavier body feels the same newtons.
"""

from abc import ABC, abstractmethod
from contextlib import AbstractContextManager
from dataclasses import dataclass, field, fields, replace
from importlib.metadata import version
from typing import Any

import numpy as np

from realsim.arrays import Array, Int64, Mask
from realsim.errors import InputError
from realsim.geometry import se3
from realsim.geometry.mesh_shape import MassProperties
from realsim.models.model_records import ConvexParts, PhysicalProperties
from realsim.records.checked_arrays import rows_of
from realsim.robots.hand import Hand
from realsim.robots.robot_files import STIFFEST_N_PER_M
from realsim_sim_bridge.slip.stand import Stand

# --- An object as the physics engines need it ----------------------------------------------------


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class SlipBody:
    """Convex parts and matter of an object."""

    parts: tuple[Array, ...]
    """Vertices (V, 3) of each convex part, object frame [m]."""
    mass_kg: float
    center_of_mass: Array
    """(3,) object frame [m]."""
    inertia: Array
    """(3, 3) about the centre of mass, object axes [kg m^2]."""

    @classmethod
    def of(cls, parts: ConvexParts, matter: PhysicalProperties | MassProperties) -> "SlipBody":
        """Return the body of convex parts and the matter of the object."""
        return cls(
            parts=parts.parts,
            mass_kg=matter.mass_kg,
            center_of_mass=np.asarray(matter.center_of_mass),
            inertia=np.asarray(matter.inertia),
        )

    def principal_frame(self) -> tuple[Array, Array]:
        """Return T_obj_body (4, 4), at the centre of mass along the principal axes, and moments."""
        moments, axes = np.linalg.eigh(self.inertia)
        if np.linalg.det(axes) < 0:
            axes[:, 0] = -axes[:, 0]
        return se3.from_rt(axes, self.center_of_mass), moments

    def reach(self) -> float:
        """Return the greatest distance of a vertex from the centre of mass [m]."""
        corners = np.concatenate(self.parts) - self.center_of_mass
        return float(np.linalg.norm(corners, axis=1).max())


# --- How the fingers touch: sphere pads, the same in every engine --------------------------------

SPREAD = 0.3
"""Distance of the outer spheres from the pad's middle, in sizes of the pad."""

STIFFNESS_N_PER_M = (1e3, STIFFEST_N_PER_M)
"""Least and greatest normal stiffness of a pad [N/m]. From 600 kN/m on PyBullet's solver leaves
Coulomb's limit with small forces, at 1 MN/m its pads are 9 % off; MuJoCo keeps to what is asked."""


@dataclass(frozen=True, kw_only=True, slots=True)
class PadModel:
    """Spheres in front of a finger's box.

    Flat pads carry their load on one corner in Bullet's solver, so that they turn like a point, and
    a mesh finger touches at two or three points in MuJoCo; six spheres share the load evenly. Their
    mean distance from the centre, 7.66 mm, is that of an evenly loaded patch of 20 x 20 mm.
    """

    sphere_radius_m: float = 0.004
    """Radius of a pad's spheres [m]."""
    protrusion_m: float = 0.0015
    """How far the spheres stand out of the finger's box [m]; at 0.3 mm the box touches too."""
    x_m: tuple[float, ...] = (-0.006, 0.006)
    """x of the spheres' centres [m]."""
    z_m: tuple[float, ...] = (-0.006, 0.0, 0.006)
    """z of the spheres' centres [m]."""
    finger_mass_kg: float = 0.1
    """Mass of a finger [kg]."""
    pad_stiffness_n_per_m: float = 200_000.0
    """Normal stiffness of one pad, all of whose spheres touch [N/m]; each has an equal share, so
    that a pad pressed at its edge is softer. The Franka Hand's; in every engine the same."""

    def __post_init__(self) -> None:
        """Check the stiffness.

        Raises:
            InputError: it is no number between the least and the greatest that can be.
        """
        least, most = STIFFNESS_N_PER_M
        if not least <= self.pad_stiffness_n_per_m <= most:
            raise InputError(
                f"pads of {self.pad_stiffness_n_per_m:g} N/m cannot be: {least:g} to {most:g} N/m "
                "is accepted, the force over how far a flat object is pressed into the whole pad; "
                "4 mm of soft silicone under 400 mm^2 have 200000."
            )

    @classmethod
    def of(cls, hand: Hand) -> "PadModel":
        """Return the spheres of a hand: the pattern of Franka's, spread over what presses."""
        x, z = (SPREAD * size for size in hand.patch_m)
        return cls(
            x_m=(-x, x),
            z_m=(-z, 0.0, z),
            finger_mass_kg=hand.finger_mass_kg,
            pad_stiffness_n_per_m=hand.pad_stiffness_n_per_m,
        )

    @property
    def greatest_n(self) -> float:
        """Force that presses a whole pad in as far as it stands out [N]."""
        return self.pad_stiffness_n_per_m * self.protrusion_m

    @property
    def point_n_per_m(self) -> float:
        """Normal stiffness of one sphere [N/m]."""
        return self.pad_stiffness_n_per_m / len(self.centers_xz())

    def centers_xz(self) -> Array:
        """Return x and z (S, 2) of the spheres' centres [m], grasp frame."""
        return np.array([[x, z] for x in self.x_m for z in self.z_m])


@dataclass(frozen=True, kw_only=True, slots=True)
class SlipPhysics:
    """What is true of hand and object in any engine."""

    force_n: float = 70.0
    """Force of each finger on the object [N]: the Franka Hand's continuous grasping force, which
    each of two facing fingers exerts."""
    friction: float = 1.0
    """Coulomb coefficient of the contact; the paper's."""
    mass_floor_kg: float = 0.2
    """Least mass of a simulated object [kg]; 0 = the true mass. A lighter one gets this mass, and
    inertia in proportion; the loads stay the true ones. Lighter ones do not converge."""
    pads: PadModel | None = field(default_factory=PadModel)
    """The sphere pads; None = the finger's bare box with the engine's default contact."""
    touch_n: float = 1.0
    """Least normal force of a finger that counts as contact [N]; a weak hand's is a tenth of its
    force."""

    @classmethod
    def of(cls, hand: Hand) -> "SlipPhysics":
        """Return what is true of a hand: its usual force, its pads and their friction."""
        return cls(force_n=hand.force_n, friction=hand.friction, pads=PadModel.of(hand))

    def __post_init__(self) -> None:
        """Check that the force does not press the pads in as far as they are thick.

        Raises:
            InputError: it does; the finger's box would carry what the pad should.
        """
        pads = self.pads
        if pads and not self.force_n <= pads.greatest_n:
            raise InputError(
                f"{self.force_n:g} N press pads of {pads.pad_stiffness_n_per_m:g} N/m in by more "
                f"than the {1e3 * pads.protrusion_m:g} mm that they stand out. At this force "
                f"{self.force_n / pads.protrusion_m:.4g} N/m or more is accepted, with these pads "
                f"{pads.greatest_n:.4g} N or less."
            )

    def with_pads(self, stiffness_n_per_m: float) -> "SlipPhysics":
        """Return the same with pads of another stiffness [N/m]; bare fingers have none to change.

        Raises:
            InputError: the stiffness cannot be, or not with this force.
        """
        pads = self.pads and replace(self.pads, pad_stiffness_n_per_m=stiffness_n_per_m)
        return replace(self, pads=pads)

    @property
    def contact_n(self) -> float:
        """Least normal force that counts as contact [N]."""
        return min(self.touch_n, 0.1 * self.force_n)


@dataclass(frozen=True, kw_only=True, slots=True)
class Closing:
    """How the fingers close."""

    speed: float = 0.1
    """Speed of each finger [m/s]: the Franka Hand's top speed."""
    table_friction: float | None = 0.4
    """Coulomb coefficient of the object with the table that it stands on and the neighbours beside
    it: wood on wood (0.25 to 0.5 in the Engineering ToolBox's table), plastics and metals on it
    are near. None = no table, no neighbours, no weight, as sets have it that do not name it."""
    release_m: float = 0.02
    """Once both fingers touch the table sinks so far, at most, until nothing moves any more [m]:
    what they squeeze onto it finds its hold in them, or none, as the hand begins to rise. If table
    and neighbours were gone at once, it would be shot out of the fingers. What slides farther fails
    the lift in any case: 2 cm is its limit."""
    release_speed: float = 0.1
    """How fast it sinks [m/s]: the lift is at 0.14 m/s where the hand has risen by 2 cm."""
    drag_per_s: float = 40.0
    """Where there is no table (a specimen, grasps of other data sets), the object is weightless
    and its speed decays at this rate [1/s]: mu g / v, what the friction of 0.4 does to an object
    that moves with a finger. Without it a weightless object flies off the first finger that touches
    it, and the outcome is chance."""
    settle_s: float = 0.2
    """Time at full force after the last finger can have arrived [s]."""
    sample_s: float = 0.02
    """How often the object is looked at [s]."""
    settled_m: float = 8e-6
    """Closing ends when both fingers press and nothing moved more than this in a sample [m]."""
    lost_m: float = 0.05
    """An object that moved so far is lost [m]."""

    @property
    def release_s(self) -> float:
        """Longest time that the table sinks [s]."""
        return self.release_m / self.release_speed

    @classmethod
    def of(cls, hand: Hand) -> "Closing":
        """Return how a hand closes: at its top speed, but at no more than was validated."""
        return cls(speed=min(hand.closing_speed, cls().speed))


@dataclass(frozen=True, eq=False, slots=True)
class Meeting:
    """What meets in every pair of a world."""

    body: SlipBody
    physics: SlipPhysics
    geometry: Hand
    stand: Stand | None = None
    """What the objects stand on while the fingers close; None = they are free."""


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Grips:
    """Where K hands are on K copies of the object."""

    Ts_table_grasp: Array
    """(K, 4, 4) where the object stands [m]; the place matters only where there is a `Stand`."""
    Ts_obj_grasp: Array
    """(K, 4, 4) [m]."""
    openings_m: Array
    """(K,) distance of the finger faces before closing [m]."""

    def rows(self, rows: Int64 | Mask | slice) -> "Grips":
        """Return some of them."""
        return rows_of(self, rows)


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class PairStates:
    """Positions and speeds of K pairs: enough to go on from, in this world or another."""

    Ts_world_body: Array
    """(K, 4, 4) [m]; NaN = the pair has been removed, or (`put`) stays where it is."""
    twists: Array
    """(K, 6) angular [rad/s] and linear velocity of the centre of mass [m/s], world axes."""
    fingers_m: Array
    """(K, 2) distance of each finger's face from the middle [m]; finger 0 is at +y."""
    finger_speeds: Array
    """(K, 2) [m/s], positive = opening."""

    def rows(self, rows: Int64 | Mask) -> "PairStates":
        """Return some of them."""
        return rows_of(self, rows)

    @classmethod
    def unknown(cls, count: int) -> "PairStates":
        """Return states of which nothing is known: NaN."""
        shapes = {"Ts_world_body": (4, 4), "twists": (6,), "fingers_m": (2,), "finger_speeds": (2,)}
        return cls(**{name: np.full((count, *shape), np.nan) for name, shape in shapes.items()})

    def set_rows(self, rows: Int64, states: "PairStates") -> None:
        """Put the states of some pairs in the place of these rows."""
        for f in fields(self):
            getattr(self, f.name)[rows] = getattr(states, f.name)


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Motion:
    """What was seen of K pairs; NaN after one was removed or lost, or closed and came to rest."""

    Ts_world_body: Array
    """(K, S, 4, 4) [m]."""
    finger_n: Array
    """(K, S, 2) normal force of each finger on the object [N]."""
    times_s: Array
    """(S,) simulated time of each sample since the start of the play [s]; the last is its end."""


class HandWorld(AbstractContextManager["HandWorld"]):
    """K pairs of hand and object in an engine. Leaving the context frees the engine's memory."""

    dt: float
    """Time between two wrenches of `play` [s]."""
    alive: Mask
    """(K,) pairs that have not been removed."""

    @abstractmethod
    def close(self, closing: Closing) -> Motion:
        """Close all hands on their objects and press with the hand's force from then.

        The objects stand as the world's `Stand` says, or are weightless where there is none.
        Before the first `close` or `put` the objects are where the grips say and fingers are open.
        """

    @abstractmethod
    def play(self, wrenches: Array, sample: int, lost_m: float) -> Motion:
        """Apply wrenches (K, T, 6), one a time step, and return what is seen every `sample` steps.

        The fingers press with the hand's force. A pair whose object moved more than `lost_m` [m]
        need not be simulated further: its later samples may be NaN.
        """

    @abstractmethod
    def states(self) -> PairStates:
        """Return where everything is now."""

    @abstractmethod
    def put(self, states: PairStates) -> None:
        """Put pairs there, with fingers that press with the hand's force; rows of NaN stay."""

    def remove(self, rows: Mask) -> None:
        """Take pairs (K,) out of the world."""
        self.alive &= ~rows

    @abstractmethod
    def settings(self) -> dict[str, float]:
        """Return what the engine says its settings are: read back from it, not what was asked for.

        At least: 'finger_friction', 'object_friction', 'dt_s', 'object_mass_kg', 'force_n'.
        """


class Engine(ABC):
    """A physics engine with its settings; cheap to make, may keep compiled models of bodies."""

    name: str
    """'pybullet' or 'mujoco': of its package, too."""
    settings: Any
    """`BulletSettings` or `MujocoSettings`."""

    @property
    def pairs_per_world(self) -> int:
        """How many pairs its worlds should hold."""
        return self.settings.pairs_per_world

    @property
    def replay(self) -> "Replay":
        """How much faster than they were its loads are played."""
        return self.settings.replay

    def version(self) -> str:
        """Return the engine's version."""
        return version(self.name)

    @abstractmethod
    def world(self, met: Meeting, grips: Grips) -> HandWorld:
        """Return a world with these pairs."""


@dataclass(frozen=True, kw_only=True, slots=True)
class Replay:
    """Playing loads faster than they were.

    Sticking does not depend on the rate, so the same forces are played `speed` times as fast; a
    stage in which an object moved more than the triggers is played again at true speed from where
    it began. Sliding distances shrink with the square of the speed, hence the small triggers.
    """

    speed: int = 1
    """1 = every stage at true speed."""
    trigger_m: float = 0.3e-3
    trigger_deg: float = 0.5
