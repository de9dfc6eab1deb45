"""The Panda as a URDF, from the same Denavit-Hartenberg numbers as its kinematics.

Joints, limits, torques and masses are the real robot's; there is no collision geometry, because
what is moved by this arm in a simulation is watched at the hand. PyBullet reads the offsets and
angles of a URDF in single precision, so that its link frames are right to 1e-7 and not to the last
digit.
"""

import numpy as np
from numpy.typing import NDArray

from realsim_sim_bridge.arm import panda
from realsim_sim_bridge.grasping.hand import HandGeometry

Array = NDArray[np.float64]

_LINKS = (
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
    (0.735522, (0.010517, -0.004252, 0.061597),
     (0.012516, -0.000428, -0.001196, 0.010027, -0.000741, 0.004815)),
)  # fmt: skip
"""Mass [kg], centre of mass [m] and inertia ixx ixy ixz iyy iyz izz [kg m^2] of links 0 to 7:
franka_description, after Gaz et al., Dynamic identification of the Franka Emika Panda robot with
retrieval of feasible parameters using penalty-based optimization, 2019."""


FLANGE_KG = 0.001
"""Mass of the link `flange` [kg]: a mere frame, but PyBullet gives a link without mass a kilogram;
the flange's own mass is in link 7."""


def panda_urdf(geometry: HandGeometry, hand: str = "") -> str:
    """Return the URDF of the arm: links link0 to link7, joints joint1 to joint7, and link `flange`.

    Args:
        geometry: the hand, whose mounting face lies on the flange.
        hand: URDF of a hand whose first link is `palm` with the grasp frame as its own
            (`slip.hand_urdf`); its links and joints are taken over, fixed to the flange. '' = none.
    """
    links = "".join(_massive(f"link{i}", *matter) for i, matter in enumerate(_LINKS))
    joints = "".join(_joint(i) for i in range(panda.JOINTS))
    flange = _massive("flange", FLANGE_KG, (0.0, 0.0, 0.0), (1e-6, 0.0, 0.0, 1e-6, 0.0, 1e-6))
    flange += _fixed("link7", "flange", (0, 0, panda.FLANGE_M), 0.0)
    mounted = ""
    if hand:
        start, end = hand.index(">", hand.index("<robot")) + 1, hand.rindex("</robot>")
        turn = panda.HAND_TURN
        mounted = hand[start:end] + _fixed("flange", "palm", (0, 0, -geometry.mount_z_m), turn)
    return f'<robot name="panda">{links}{joints}{flange}{mounted}</robot>'


def _massive(name: str, mass: float, center: tuple[float, ...], inertia: tuple[float, ...]) -> str:
    """Return the element of a link with a mass [kg] and inertia ixx ixy ixz iyy iyz izz."""
    names = ("ixx", "ixy", "ixz", "iyy", "iyz", "izz")
    moments = " ".join(f'{name}="{value!r}"' for name, value in zip(names, inertia, strict=True))
    return (
        f'<link name="{name}"><inertial><origin xyz="{_numbers(center)}"/>'
        f'<mass value="{mass!r}"/><inertia {moments}/></inertial></link>'
    )


def _joint(number: int) -> str:
    """Return the element of the joint after link `number`: Rot_x(alpha) Trans_x(a) Trans_z(d)."""
    a, alpha, d = (float(x[number]) for x in (panda.A_M, panda.ALPHA, panda.D_M))
    # The offset along the joint's own axis, in the link before.
    at = (a, -d * float(np.sin(alpha)), d * float(np.cos(alpha)))
    limits = {
        "lower": panda.LOWER,
        "upper": panda.UPPER,
        "effort": panda.TORQUE,
        "velocity": panda.VELOCITY,
    }
    limit = " ".join(f'{name}="{float(value[number])!r}"' for name, value in limits.items())
    return (
        f'<joint name="joint{number + 1}" type="revolute"><parent link="link{number}"/>'
        f'<child link="link{number + 1}"/>'
        f'<origin xyz="{_numbers(at)}" rpy="{_numbers((alpha, 0.0, 0.0))}"/>'
        f'<axis xyz="0 0 1"/><limit {limit}/></joint>'
    )


def _fixed(parent: str, child: str, at: tuple[float, float, float], turn: float) -> str:
    """Return a fixed joint with an offset [m] and a turn about z [rad]."""
    return (
        f'<joint name="{parent}_{child}" type="fixed"><parent link="{parent}"/>'
        f'<child link="{child}"/><origin xyz="{_numbers(at)}" '
        f'rpy="{_numbers((0.0, 0.0, turn))}"/></joint>'
    )


def _numbers(values: tuple[float, ...]) -> str:
    """Return numbers as a URDF has them, with all their digits."""
    return " ".join(repr(float(value)) for value in values)
