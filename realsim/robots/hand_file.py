"""The `robot.toml` of a hand, as `realsim.robots.hand` reads it."""

from typing import Literal

from realsim.robots.robot_files import RobotFile
from realsim.untrusted.own_json import OwnFile

Point = tuple[float, float, float]


STIFFEST_N_PER_M = 5e5
"""Greatest normal stiffness of a pad with which both engines pass the validation suite [N/m]."""


def soft_n_per_m(patch_m: tuple[float, float]) -> float:
    """Return the normal stiffness of 4 mm of silicone over a patch [N/m]: E A / t.

    Silicone of Shore A 40 has E = 2.0 MPa (lg E = 0.0235 S - 0.6403, Larson 2016, Dow Corning
    11-3716); the layer is taken to be free to bulge. Shore A 30 to 50 and 2 to 4 mm span 0.6 to 3.4
    times as much. Large patches get `STIFFEST_N_PER_M`.
    """
    return min(2.0e6 * patch_m[0] * patch_m[1] / 4e-3, STIFFEST_N_PER_M)


class PadFile(OwnFile, frozen=True, kw_only=True):
    """The pads, as a `robot.toml` has them."""

    width_m: float | None = None
    """Along x [m]; the finger's own width where it is left away."""
    length_m: float | None = None
    """Along z, about the middle of the pad [m]; as long as wide, but no longer than the finger."""
    patch_m: tuple[float, float] | None = None
    """Along x and z, what presses on a large object [m]; the whole pad where it is left away."""
    friction: float = 1.0
    """Coulomb coefficient on the objects; 1.0 is the paper's."""
    normal_stiffness_n_per_m: float | None = None
    """Stiffness of one pad on which a flat object lies whole [N/m]; `soft_n_per_m` where left
    away."""


class ArcFile(OwnFile, frozen=True, kw_only=True):
    """The circle on which the pads run."""

    radius_m: float
    """Distance of the crank's two joints [m]."""
    axis_y_m: float
    """y of the crank's axis, moved as the crank's other end is to the middle of the pad's face [m];
    for the finger at +y."""


class BoxFile(OwnFile, frozen=True, kw_only=True):
    """A box in frame `grasp`."""

    low_m: Point
    high_m: Point


class BarFile(OwnFile, frozen=True, kw_only=True):
    """A bar of the linkage at +y that turns with the crank."""

    pivot_m: tuple[float, float]
    """y and z of the axis about which it turns, as the crank does [m], frame `grasp`."""
    from_m: tuple[float, float]
    to_m: tuple[float, float]
    """y and z of its ends when the hand is closed [m]."""
    half_width_m: float
    """Along x [m]."""
    half_thickness_m: float
    """Around the line between its ends [m]."""


class MountFile(OwnFile, frozen=True, kw_only=True):
    """How the hand sits on an arm's flange."""

    distance_m: float | None = None
    """From the flange to the origin of `grasp` [m]; to the palm's back where it is left away."""
    turn_deg: float = 0.0
    """Turn of `grasp` about the flange's z [deg], as the hand's maker mounts it."""


class ForceFile(OwnFile, frozen=True, kw_only=True):
    """Force of each finger on the object."""

    least_n: float = 1.0
    greatest_n: float = 140.0
    usual_n: float = 70.0
    """What the slip test uses unless it is told another [N]."""


class HandFile(RobotFile, frozen=True, kw_only=True):
    """The `robot.toml` of a hand: four numbers are needed, everything else has a stated default."""

    kind: Literal["hand"] = "hand"
    max_opening_m: float
    """Distance of the pads when fully open [m]."""
    finger_length_m: float
    """Up from the tip [m]."""
    finger_width_m: float
    """Across the closing axis [m]."""
    finger_thickness_m: float
    """Along the closing axis [m]."""
    tip_beyond_grasp_m: float | None = None
    """How far the tip reaches past the middle of the pad [m]; half the pad where left away."""
    pad: PadFile = PadFile()
    arc: ArcFile | None = None
    """None = the fingers slide along y."""
    palm: tuple[BoxFile, ...] = ()
    """What does not move; one box behind the fingers where it is left away."""
    finger: tuple[BoxFile, ...] = ()
    """What else the finger at +y is made of besides the box of the sizes above, hand closed."""
    bar: tuple[BarFile, ...] = ()
    mount: MountFile = MountFile()
    force: ForceFile = ForceFile()
    mass_kg: float = 0.7
    """Mass of the whole hand [kg]; the default is about Franka's."""
    finger_mass_kg: float = 0.1
    """Mass of a finger as the physics moves it [kg]."""
    closing_speed_m_s: float = 0.1
    """Greatest speed of each finger [m/s]; the default is Franka's."""
    frame_link: str = ""
    """Link of its URDF at the mounting face, z = approach, y = closing; the folder's name where it
    is left away."""
    joint: str = ""
    """Joint that drives it, as its URDF calls it; '' = not known."""
    joint_zero_m: float = 0.0
    """Opening at which that joint is at 0 [m]: of an arc, whose joint closes it."""
    urdf: str = ""
    """The hand's URDF; '' = none. `realsim robots check` compares its pads' path with the law."""
    urdf_pads: tuple[str, ...] = ()
    """The links of its pads, at +y and -y."""
    urdf_pad_face_m: Point = (0.0, 0.0, 0.0)
    """Middle of the first pad's face in that link's frame [m]."""
