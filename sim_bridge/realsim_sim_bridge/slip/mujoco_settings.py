"""MuJoCo's settings for the slip test."""

from dataclasses import dataclass, field

from realsim_sim_bridge.slip.world import Replay


@dataclass(frozen=True, kw_only=True, slots=True)
class MujocoSettings:
    """Settings that pass the validation suite."""

    step_s: float = 0.002
    """Time step [s]."""
    impratio: float = 3000.0
    """Stiffness of friction against that of the normal: at 1000 a load of 80 % of the limit creeps
    0.1 mm in 5 s, at 100 0.2 mm."""
    noslip_iterations: int = 0
    """Passes of the solver that removes what slip is left; not needed at a high `impratio`."""
    armature_kg: float = 0.4
    """Reflected inertia of a finger's drive [kg]; chosen, not measured. Without it as many objects
    are closed on."""
    contact_time_s: float = 0.004
    """Time constant of contacts, joint limits and of the fingers' coupling [s]: two steps of 2 ms,
    the stiffest that MuJoCo integrates."""
    pairs_per_world: int = 48
    """Pairs of one rollout."""
    replay: Replay = field(default_factory=lambda: Replay(speed=4))

    @classmethod
    def reference(cls) -> "MujocoSettings":
        """Return the slow settings that the fast ones are judged by."""
        return cls(step_s=0.001, replay=Replay())
