"""The engines by name."""

from dataclasses import dataclass, field

from realsim.errors import InputError
from realsim.interop import offer
from realsim_sim_bridge.slip.world import Engine, Replay

# --- PyBullet's settings for the slip test -------------------------------------------------------


@dataclass(frozen=True, kw_only=True, slots=True)
class BulletSettings:
    """Settings that pass the validation suite; every one is read back from the engine."""

    rate_hz: float = 240.0
    """Steps per second of simulated time."""
    iterations: int = 200
    """Most solver iterations a step; at 50 the 5 cm box turns 1.9 deg instead of 0.14."""
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


# --- MuJoCo's settings for the slip test ---------------------------------------------------------


@dataclass(frozen=True, kw_only=True, slots=True)
class MujocoSettings:
    """Settings that pass the validation suite."""

    step_s: float = 0.002
    """Time step [s]."""
    creep_n_s_per_m: float = 1.2e6
    """Load over the speed at which a sphere that sticks creeps [N s/m]: with 80 % of 70 N a cube
    moves 0.04 mm in 5 s. `impratio` follows from it, the pads' stiffness and the step."""
    noslip_iterations: int = 0
    """Passes of the solver that removes what slip is left; not needed against so little creep."""
    armature_kg: float = 0.4
    """Reflected inertia of a finger's drive [kg]; chosen, not measured. Without it as many objects
    are closed on."""
    contact_time_s: float = 0.004
    """Time constant of joint limits, of the fingers' coupling and of contacts beside the pads [s]:
    two steps of 2 ms, the stiffest that MuJoCo integrates."""
    pairs_per_world: int = 48
    """Pairs of one rollout."""
    replay: Replay = field(default_factory=lambda: Replay(speed=4))

    @classmethod
    def reference(cls) -> "MujocoSettings":
        """Return the slow settings that the fast ones are judged by."""
        return cls(step_s=0.001, replay=Replay())


ENGINES = ("pybullet", "mujoco")


def make_engine(settings: BulletSettings | MujocoSettings) -> Engine:
    """Return the engine that the settings are of.

    Raises:
        InputError: MuJoCo is asked for and not installed.
    """
    if isinstance(settings, BulletSettings):
        from realsim_sim_bridge.slip.bullet_world import BulletEngine

        return BulletEngine(settings)
    try:
        import mujoco  # noqa: F401  # pyright: ignore[reportUnusedImport]
    except ImportError:
        raise InputError(
            "MuJoCo is not installed; it is the Robot School's second engine. "
            f"{offer('mujoco')}, or use the engine pybullet."
        ) from None
    from realsim_sim_bridge.slip.mujoco_world import MujocoEngine

    return MujocoEngine(settings)


def settings_of(name: str, *, reference: bool = False) -> BulletSettings | MujocoSettings:
    """Return an engine's settings by its name.

    Args:
        name: 'pybullet' or 'mujoco'.
        reference: the slow ones that the fast ones are judged by.

    Raises:
        InputError: no engine of that name.
    """
    if name == "pybullet":
        return BulletSettings.reference() if reference else BulletSettings()
    if name == "mujoco":
        return MujocoSettings.reference() if reference else MujocoSettings()
    raise InputError(f"there is no engine '{name}'; there are: {', '.join(ENGINES)}.")
