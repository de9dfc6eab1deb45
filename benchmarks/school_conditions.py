"""The two conditions under which the school's benchmark tries grasps.

plain       the school's own: 70 N, friction 1, 1000 kg/m^3; almost anything that both fingers
            touch is held.
marginal    500 kg/m^3, friction 0.3, and for every object the force at which friction carries a
            fixed multiple of its weight: a part of the grasps drops it, as the load is off centre.
"""

from dataclasses import replace

from realsim_sim_bridge.slip.engines import settings_of
from realsim_sim_bridge.slip.score import ScoreLimits
from realsim_sim_bridge.slip.slip_test import SlipConfig

CONDITIONS = ("plain", "marginal")
MARGINAL_DENSITY = 500.0
"""[kg/m^3]."""
MARGINAL_FRICTION = 0.3
MARGINAL_FACTOR = 6.0
"""The force is this many weights over the friction, so two fingers carry twelve weights, and the
load's lever drops a third of these objects; with half of it, nearly half."""
PATIENT = ScoreLimits(slip_m=0.05, slip_deg=360.0)
"""Under these a grasp is held whose object is between both fingers at the end of all stages,
however far it slipped."""


def marginal_force_n(mass_kg: float) -> float:
    """Return the force of each finger [N]; never more than the hand's."""
    config = SlipConfig()
    force = MARGINAL_FACTOR * mass_kg * config.motion.gravity / MARGINAL_FRICTION
    return min(force, config.physics.force_n)


def slip_config(
    engine: str, condition: str, mass_kg: float, *, reference: bool = False
) -> SlipConfig:
    """Return the slip test of an object.

    Args:
        engine: 'pybullet' or 'mujoco'.
        condition: one of `CONDITIONS`.
        mass_kg: of the object.
        reference: with the slow settings.
    """
    config = SlipConfig(engine=settings_of(engine, reference=reference))
    if condition == "plain":
        return config
    force_n = marginal_force_n(mass_kg)
    physics = replace(config.physics, friction=MARGINAL_FRICTION, force_n=force_n)
    return replace(config, physics=physics)
