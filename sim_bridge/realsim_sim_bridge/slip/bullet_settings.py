"""PyBullet's settings for the slip test."""

from dataclasses import dataclass, field

from realsim_sim_bridge.slip.world import Replay


@dataclass(frozen=True, kw_only=True, slots=True)
class BulletSettings:
    """Settings that pass the validation suite; every one is read back from the engine."""

    rate_hz: float = 240.0
    """Steps per second of simulated time."""
    iterations: int = 200
    """Most solver iterations a step; at 50 the 5 cm box turns 1.9 deg instead of 0.14."""
    stiffness: float = 40000.0
    """Contact stiffness of the pads [N/m]: shares the load between spheres. At 10 kN/m they sink in
    by a millimetre, and at curved places every twentieth grasp ends otherwise than with stiff
    contacts."""
    damping: float = 1.0
    """Contact damping [N s/m]; at 100 and more the sharing is lost."""
    friction_anchor: bool = True
    """Whether a sticking contact remembers where it first touched and is pulled back there: without
    it an object that is squeezed at a curved place crawls by up to 18 mm/s, whatever the load."""
    friction_erp: float = 0.8
    """Share of the distance from there that is taken back in a step."""
    collision_margin_m: float = 0.0005
    """Bullet's margin around hulls [m], which are drawn in by it first: left at its 1 mm, every
    object is 2 mm thicker than it is."""
    gear_force_n: float = 1000.0
    """What keeps the two fingers symmetric [N], as the rack of the real hand does."""
    gear_erp: float = 0.3
    """Share of the fingers' asymmetry that is corrected per step."""
    pairs_per_world: int = 32
    """Grasps of one world; they are played one after the other."""
    replay: Replay = field(default_factory=lambda: Replay(speed=4))
    """At 8 a slide of 20 mm is played in 0.3 mm, which Bullet's creep hides."""

    @classmethod
    def reference(cls) -> "BulletSettings":
        """Return the slow settings that the fast ones are judged by."""
        return cls(iterations=400, replay=Replay())
