"""An arm as a URDF, from the same Denavit-Hartenberg numbers as its kinematics.

Joints, limits and torques are the description's; there is no collision geometry, because what is
moved by this arm in a simulation is watched at the hand. PyBullet reads the offsets and angles of a
URDF in single precision, so that its link frames are right to 1e-7 and not to the last digit.
"""

from collections.abc import Iterable

from scipy.spatial.transform import Rotation

from realsim.arrays import Array
from realsim.geometry import se3
from realsim.robots.arm import RobotArm
from realsim.robots.hand import Hand

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
