"""The stiffness of the sphere pads in a compiled MuJoCo model.

A contact of constant impedance d, whose reference acceleration is -b v - k r at a depth r, carries

    f = (-b v - k r - a) / R        R = (1 - d) A / d

A is MuJoCo's estimate of the inverse inertia, `body_invweight0` of both bodies added up. At rest
f = K r with K = k / R: every K > 0 has its d = K A / (K A + k), while k and b, which say how fast
that is reached, follow from the step alone. Friction creeps at R / (impratio b) per newton.
"""

from typing import TYPE_CHECKING, Any

import numpy as np

from realsim.arrays import Int64
from realsim.errors import InputError
from realsim_sim_bridge.slip.world import PadModel

if TYPE_CHECKING:
    from realsim_sim_bridge.slip.engines import MujocoSettings

PAD_PRIORITY = 1
"""Priority of the spheres' geoms: the higher one decides a contact's friction and stiffness
alone."""
SPHERE = 2
"""mjGEOM_SPHERE; no other geom is one."""
PAD_STEPS = 2.0
"""Time constant of the pads' contacts [steps], critically damped: MuJoCo integrates no faster."""
IMPEDANCES = (1e-4, 0.9999)
"""MuJoCo takes no impedance beyond these (mjMINIMP, mjMAXIMP)."""
TAKEN = 1e-6
"""Greatest relative error of a stiffness read back."""


def set_pads(model: Any, held: int, pads: PadModel, settings: "MujocoSettings") -> None:
    """Give the pads' contacts their stiffness, and their friction its creep.

    Args:
        model: compiled.
        held: number of the object's body.
        pads: whose spheres have `PAD_PRIORITY`.
        settings: step and creep.

    Raises:
        InputError: the step is too long for so stiff a pad.
    """
    time_s = PAD_STEPS * settings.step_s
    k, b = time_s**-2.0, 2.0 / time_s
    spheres = _spheres(model)
    load = pads.point_n_per_m * _inverse_inertia(model, held)
    d = load / (load + k)
    # Negative numbers are taken as they are, but for a division by d.
    model.geom_solref[spheres] = -k * d, -b * d
    model.geom_solimp[spheres, :2] = d
    model.opt.impratio = max(1.0, settings.creep_n_s_per_m * k / (pads.point_n_per_m * b))
    found = pad_stiffness(model, held)
    if not abs(found - pads.pad_stiffness_n_per_m) <= TAKEN * pads.pad_stiffness_n_per_m:
        raise InputError(
            f"MuJoCo would press pads of {pads.pad_stiffness_n_per_m:g} N/m as if they had "
            f"{found:.4g} N/m at a step of {settings.step_s:g} s; {found:.4g} N/m or less is "
            "accepted there. Give a shorter step_s."
        )


def pad_stiffness(model: Any, held: int) -> float:
    """Return the normal stiffness of one pad by the compiled model [N/m]; 0 = it has no pads."""
    spheres = _spheres(model)
    if len(spheres) == 0:
        return 0.0
    d = float(model.geom_solimp[spheres[0], 0])
    k, d = -float(model.geom_solref[spheres[0], 0]) / d, float(np.clip(d, *IMPEDANCES))
    return len(spheres) / 2 * k * d / ((1.0 - d) * _inverse_inertia(model, held))


def _spheres(model: Any) -> Int64:
    """Return the numbers of the pads' geoms."""
    return np.nonzero((model.geom_priority == PAD_PRIORITY) & (model.geom_type == SPHERE))[0]


def _inverse_inertia(model: Any, held: int) -> float:
    """Return MuJoCo's estimate for a contact of sphere and object [1/kg]."""
    finger = int(model.geom_bodyid[_spheres(model)[0]])
    return float(model.body_invweight0[[finger, held], 0].sum())
