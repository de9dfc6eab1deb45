"""A hand with two fingers, from its `robot.toml`: sizes, the law of its fingers, its boxes.

The one truth that grasps, arm, physics, foreign hand frames and replays read. Everything is in
frame `grasp`, which is fixed to the palm: z = approach, y = closing axis, origin in the middle
between the pads' middles of the closed hand (of Franka's hand the tool centre point).

The fingers keep their orientation. Those of a slide move along y alone. Those of an arc hang in
parallelograms: all points of a finger run on circles of the crank's radius R, so that the middle of
a pad at y = w / 2 is at

    z_pad(w) = sqrt(R^2 - (w / 2 - a)^2) - sqrt(R^2 - a^2)

where a is the y of the crank's axis, carried over to the pad.
"""

from dataclasses import dataclass, fields
from functools import cache
from typing import Any

import numpy as np

from realsim.arrays import Array
from realsim.errors import InputError
from realsim.geometry import se3
from realsim.robots.robot_files import (
    STIFFEST_N_PER_M,
    HandFile,
    Point,
    RobotFolder,
    robot_file,
    soft_n_per_m,
)
from realsim.untrusted.own_json import from_json

Box = tuple[Point, Point]
"""Least and greatest corner [m]."""
Bar = tuple[float, float, float, float, float, float, float, float]
"""y and z of pivot, one end and the other, half the width along x, half the thickness [m]."""

FRANKA = "franka_hand"
"""The hand that is meant where none is named."""
PALM_DEPTH_M, PALM_HEIGHT_M = 0.060, 0.060
"""The palm of a hand that describes none: across the closing axis, and along the approach [m]."""


@dataclass(frozen=True, kw_only=True, slots=True)
class Hand:
    """A hand with two fingers; `asdict` of it is plain JSON."""

    name: str = FRANKA
    """The folder's name."""
    title: str
    digest: str
    """SHA-256 of the folder: two hands of one name are told apart by it."""
    max_opening_m: float
    """Distance of the pads' faces when fully open [m]."""
    finger_length_m: float
    """Length of a finger, up from its tip [m]."""
    tip_beyond_tcp_m: float
    """How far the closed fingers reach past the grasp's origin [m]."""
    finger_width_m: float
    """Width of a finger across the closing axis [m]."""
    finger_thickness_m: float
    """Thickness of a finger along the closing axis [m]."""
    pad_width_m: float
    pad_length_m: float
    """The pad along x and z [m]; its middle is the grasp's origin when the hand is closed."""
    patch_m: tuple[float, float]
    """Along x and z, what presses on a large object [m]."""
    friction: float
    """Coulomb coefficient of the pads on the objects."""
    pad_stiffness_n_per_m: float
    """Normal stiffness of one pad on which a flat object lies whole [N/m]."""
    arc_radius_m: float
    """Radius of the circle on which the pads run [m]; 0 = they slide along y."""
    arc_axis_y_m: float
    """y of that circle's middle for the pad at +y [m]."""
    palm_boxes: tuple[Box, ...]
    finger_boxes: tuple[Box, ...]
    """(F,) of the finger at +y, hand closed; the other one's are mirrored."""
    bars: tuple[Bar, ...]
    """Bars of the linkage at +y."""
    mount_z_m: float
    """z of the arm's flange [m]."""
    mount_turn_deg: float
    mass_kg: float
    finger_mass_kg: float
    least_force_n: float
    greatest_force_n: float
    force_n: float
    """Force of each finger on the object [N]: the usual one."""
    closing_speed: float
    """Greatest speed of each finger [m/s]."""
    frame_link: str
    joint: str
    joint_zero_m: float
    """As `HandFile` has them."""

    def __post_init__(self) -> None:
        """Check the numbers.

        Raises:
            InputError: some cannot be; each is named with what can.
        """
        faults = _faults(self)
        if faults:
            raise InputError(f"the hand '{self.name}': {'; '.join(faults)}.")

    @property
    def T_ee_grasp(self) -> Array:
        """(4, 4) frame `grasp` in the arm's flange, whose z points out of it [m]."""
        turn = se3.exp_so3([0.0, 0.0, np.radians(self.mount_turn_deg)])
        return se3.from_rt(turn, [0.0, 0.0, -self.mount_z_m])

    @property
    def palm_face_z_m(self) -> float:
        """Z of the palm's outermost face [m]."""
        return max(high[2] for _, high in self.palm_boxes)

    @property
    def palm_width_m(self) -> float:
        """Extent of the palm along the closing axis [m]."""
        return max(h[1] for _, h in self.palm_boxes) - min(low[1] for low, _ in self.palm_boxes)

    # --- the law of the fingers ---------------------------------------------------------------

    def z_pad(self, openings_m: Array | float) -> Array:
        """Return z of the pads' middles (N,) [m] at openings (N,) [m]; 0 for a slide."""
        w = np.asarray(openings_m, dtype=np.float64)
        if not self.arc_radius_m:
            return np.zeros_like(w)
        return self._height(w / 2.0 - self.arc_axis_y_m) - self._height(-self.arc_axis_y_m)

    def grasps_of_pads(self, Ts_a_pads: Array, widths_m: Array | float) -> Array:
        """Return T_a_grasp (N, 4, 4) of hands whose pads, closed to widths (N,) [m], stand there.

        Args:
            Ts_a_pads: (N, 4, 4) axes as of `grasp`, origin between the middles of the pads [m].
            widths_m: (N,) or one for all [m].
        """
        return along_approach(Ts_a_pads, -self.z_pad(widths_m))

    def z_range(self, least_m: Array, most_m: Array) -> tuple[Array, Array]:
        """Return the least and greatest z (N,) [m] of the pads between two openings (N,) [m]."""
        ends = self.z_pad(least_m), self.z_pad(most_m)
        top = np.maximum(*ends)
        if self.arc_radius_m:
            upright = 2.0 * self.arc_axis_y_m
            passed = (least_m <= upright) & (upright <= most_m)
            top = np.where(passed, self.z_pad(upright), top)
        return np.minimum(*ends), top

    def slope(self, fingers_m: Array | float) -> Array:
        """Return dz / dy (N,) of the finger at +y at distances (N,) of its face from y = 0 [m]."""
        y = np.asarray(fingers_m, dtype=np.float64)
        if not self.arc_radius_m:
            return np.zeros_like(y)
        return (self.arc_axis_y_m - y) / self._height(y - self.arc_axis_y_m)

    def joint_position(self, openings_m: Array | float) -> Array:
        """Return the driven joint's position (N,) at openings (N,) [m].

        Of a slide half the opening [m]; of an arc how far the crank has closed since zero [rad].
        """
        half = np.asarray(openings_m, dtype=np.float64) / 2.0
        if not self.arc_radius_m:
            return half
        return self._crank(half) - self._crank(self.joint_zero_m / 2.0)

    def _height(self, across: Array | float) -> Array:
        """Return how far above its axis the crank ends [m], so far beside it."""
        return np.sqrt(self.arc_radius_m**2 - np.asarray(across, dtype=np.float64) ** 2)

    # --- its boxes ----------------------------------------------------------------------------

    @property
    def side_boxes(self) -> int:
        """Number of boxes of each finger: its own, then one around each bar."""
        return len(self.finger_boxes) + len(self.bars)

    def boxes(self, openings_m: Array | float) -> Array:
        """Return the hand's boxes (N, B, 2, 3) [m]: palm, finger at -y, finger at +y.

        A finger's are its own, then one around each bar of the linkage as it is turned there.

        Args:
            openings_m: (N,) distances of the finger faces [m].
        """
        openings = np.atleast_1d(np.asarray(openings_m, dtype=np.float64))
        return self.swept_boxes(openings, openings)

    def swept_boxes(self, widths_m: Array, openings_m: Array) -> Array:
        """Return the boxes (N, B, 2, 3) [m] swept while the fingers close to `widths_m` (N,)."""
        palms, side = len(self.palm_boxes), self.side_boxes
        inner, outer = widths_m / 2.0, openings_m / 2.0
        low, high = self.z_range(widths_m, openings_m)
        boxes = np.empty((len(inner), palms + 2 * side, 2, 3))
        boxes[:, :palms] = np.array(self.palm_boxes)
        right, left = boxes[:, palms : palms + side], boxes[:, palms + side :]
        for k, box in enumerate(self.finger_boxes):
            left[:, k] = np.array(box)
            left[:, k, 0, 1] += inner
            left[:, k, 1, 1] += outer
            left[:, k, 0, 2] += low
            left[:, k, 1, 2] += high
        for k, bar in enumerate(self.bars, len(self.finger_boxes)):
            left[:, k] = self._bar_boxes(bar, inner, outer)
        right[...] = left
        right[..., 0, 1], right[..., 1, 1] = -left[..., 1, 1], -left[..., 0, 1]
        return boxes

    def bar_boxes(self, openings_m: Array | float) -> Array:
        """Return those of `boxes` (N, b, 2, 3) [m] that are around bars of the linkage."""
        boxes, side, own = self.boxes(openings_m), self.side_boxes, len(self.finger_boxes)
        right, left = boxes[:, -2 * side : -side], boxes[:, -side:]
        return np.concatenate([right[:, own:], left[:, own:]], axis=1)

    def _bar_boxes(self, bar: Bar, inner: Array, outer: Array) -> Array:
        """Return the boxes (N, 2, 3) around a bar while the pad goes from y = outer to inner (N,).

        An end's circle is farthest along an axis at a quarter of the turn, or where it stops.
        """
        pivot, half_width, half = np.array(bar[:2]), bar[6], bar[7]
        crank = [self._crank(y) - self._crank(0.0) for y in (outer, inner)]
        boxes = np.empty((len(inner), 2, 3))
        boxes[:, 0, 0], boxes[:, 1, 0] = -half_width, half_width
        places: list[Array] = []
        for end in (np.array(bar[2:4]) - pivot, np.array(bar[4:6]) - pivot):
            began, ended = (np.arctan2(end[1], end[0]) + turn for turn in crank)
            spans = [_cosines(began - shift, ended - shift) for shift in (0.0, np.pi / 2.0)]
            places.append(np.linalg.norm(end) * np.array(spans))
        low = np.minimum(*(place[:, 0] for place in places))
        high = np.maximum(*(place[:, 1] for place in places))
        boxes[:, 0, 1:] = (pivot[:, None] + low - half).T
        boxes[:, 1, 1:] = (pivot[:, None] + high + half).T
        return boxes

    def _crank(self, y: Array | float) -> Array:
        """Return the crank's angle from y to z [rad] where the face of the pad is at y [m]."""
        across = y - self.arc_axis_y_m
        return np.arctan2(self._height(across), across)


def _cosines(began: Array, ended: Array) -> tuple[Array, Array]:
    """Return the least and the greatest cosine (N,) between two angles (N,), began <= ended."""
    ends, turn = np.stack([np.cos(began), np.cos(ended)]), 2.0 * np.pi
    passes_0 = np.ceil(began / turn) * turn <= ended
    passes_pi = np.ceil((began - np.pi) / turn) * turn + np.pi <= ended
    return (np.where(passes_pi, -1.0, ends.min(axis=0)), np.where(passes_0, 1.0, ends.max(axis=0)))


def along_approach(Ts_a_b: Array, distances_m: Array | float) -> Array:
    """Return poses (N, 4, 4), moved along their z by distances (N,) or one for all [m]."""
    moved = np.array(Ts_a_b, dtype=np.float64)
    moved[:, :3, 3] += np.asarray(distances_m, dtype=np.float64)[..., None] * moved[:, :3, 2]
    return moved


def find_hand(name: str = FRANKA) -> Hand:
    """Return a hand by its name or its folder.

    Raises:
        InputError: there is none, or its file says what cannot be.
    """
    return _shipped(name) if name == FRANKA else hand_of(*robot_file(name, HandFile))


@cache
def _shipped(name: str) -> Hand:
    return hand_of(*robot_file(name, HandFile))


def hand_of_json(value: Any, what: str) -> Hand:
    """Return the hand of what `asdict` and JSON made of it.

    The sizes without a name that files before hands were data have are the Franka hand's.

    Raises:
        InputError: it is none.
    """
    if isinstance(value, dict) and "name" not in value:
        franka = find_hand()
        sizes = {f.name for f in fields(Hand)} & set(value)
        if sizes and all(value[n] == getattr(franka, n) for n in sizes):
            return franka
        raise InputError(f"{what} is of a hand without a name whose sizes are not the Franka's.")
    if isinstance(value, dict) and "stiffness_n_per_m" in value:  # older: of one of six points
        value = {**value, "pad_stiffness_n_per_m": 6.0 * value["stiffness_n_per_m"]}
        del value["stiffness_n_per_m"]
    return from_json(value, Hand, what)


def hand_of(file: HandFile, folder: RobotFolder) -> Hand:
    """Return the hand that a `robot.toml` describes.

    Raises:
        InputError: it says what cannot be.
    """
    width, thickness = file.finger_width_m, file.finger_thickness_m
    pad = file.pad
    pad_width = width if pad.width_m is None else pad.width_m
    pad_length = min(width, file.finger_length_m) if pad.length_m is None else pad.length_m
    tip = pad_length / 2.0 if file.tip_beyond_grasp_m is None else file.tip_beyond_grasp_m
    root = tip - file.finger_length_m
    own: Box = ((-width / 2.0, 0.0, root), (width / 2.0, thickness, tip))
    palm: tuple[Box, ...] = tuple((b.low_m, b.high_m) for b in file.palm)
    if not palm:
        depth, reach = max(width, PALM_DEPTH_M) / 2.0, file.max_opening_m / 2.0 + thickness
        palm = (((-depth, -reach, root - PALM_HEIGHT_M), (depth, reach, root)),)
    patch = pad.patch_m or (pad_width, pad_length)
    stiffness = pad.normal_stiffness_n_per_m
    back = min(low[2] for low, _ in palm)
    distance = file.mount.distance_m
    return Hand(
        name=folder.name,
        title=file.title or file.name,
        digest=folder.digest,
        max_opening_m=file.max_opening_m,
        finger_length_m=file.finger_length_m,
        tip_beyond_tcp_m=tip,
        finger_width_m=width,
        finger_thickness_m=thickness,
        pad_width_m=pad_width,
        pad_length_m=pad_length,
        patch_m=patch,
        friction=pad.friction,
        pad_stiffness_n_per_m=soft_n_per_m(patch) if stiffness is None else stiffness,
        arc_radius_m=file.arc.radius_m if file.arc else 0.0,
        arc_axis_y_m=file.arc.axis_y_m if file.arc else 0.0,
        palm_boxes=palm,
        finger_boxes=(own, *((b.low_m, b.high_m) for b in file.finger)),
        bars=tuple(
            (*b.pivot_m, *b.from_m, *b.to_m, b.half_width_m, b.half_thickness_m) for b in file.bar
        ),
        mount_z_m=back if distance is None else -distance,
        mount_turn_deg=file.mount.turn_deg,
        mass_kg=file.mass_kg,
        finger_mass_kg=file.finger_mass_kg,
        least_force_n=file.force.least_n,
        greatest_force_n=file.force.greatest_n,
        force_n=file.force.usual_n,
        closing_speed=file.closing_speed_m_s,
        frame_link=file.frame_link or folder.name,
        joint=file.joint,
        joint_zero_m=file.joint_zero_m,
    )


_RANGES = {
    "max_opening_m": (0.001, 0.5, "m"),
    "finger_length_m": (0.001, 0.5, "m"),
    "finger_width_m": (0.001, 0.3, "m"),
    "finger_thickness_m": (0.0005, 0.1, "m"),
    "pad_width_m": (0.001, 0.3, "m"),
    "pad_length_m": (0.001, 0.3, "m"),
    "arc_radius_m": (0.0, 0.5, "m"),
    "arc_axis_y_m": (-0.5, 0.5, "m"),
    "friction": (0.01, 10.0, ""),
    "pad_stiffness_n_per_m": (1e3, STIFFEST_N_PER_M, "N/m"),
    "mass_kg": (0.01, 20.0, "kg"),
    "finger_mass_kg": (0.001, 5.0, "kg"),
    "least_force_n": (0.0, 1000.0, "N"),
    "force_n": (0.1, 1000.0, "N"),
    "greatest_force_n": (0.1, 2000.0, "N"),
    "closing_speed": (0.001, 2.0, "m/s"),
}
"""What can be: numbers beyond are of another unit, or slips of the pen."""


def _faults(hand: Hand) -> list[str]:
    """Return what cannot be, each with what can and what to do."""
    faults: list[str] = []
    for name, (least, most, unit) in _RANGES.items():
        value = getattr(hand, name)
        if least <= value <= most:
            continue
        told = f"{name} is {value:g} {unit}".rstrip()
        told += f"; {least:g} to {most:g} {unit}".rstrip() + " is accepted"
        units = {"millimetres": 1e3, "centimetres": 1e2} if unit == "m" else {}
        meant = [f"{value / per:g} if {value:g} is in {what}" for what, per in units.items()
                 if least <= value / per <= most]  # fmt: skip
        told += f": write {' or '.join(meant)}" * bool(meant)
        faults.append(told)
    if not hand.least_force_n <= hand.force_n <= hand.greatest_force_n:
        faults.append(
            f"the usual force of {hand.force_n:g} N is not between the least of "
            f"{hand.least_force_n:g} N and the greatest of {hand.greatest_force_n:g} N"
        )
    for what, boxes in (("palm", hand.palm_boxes), ("finger", hand.finger_boxes)):
        for low, high in boxes:
            if not all(a < b for a, b in zip(low, high, strict=True)):
                faults.append(
                    f"a box of the {what} goes from {list(low)} to {list(high)}; each number of "
                    "low_m must be less than that of high_m"
                )
    reach = abs(hand.max_opening_m / 2.0 - hand.arc_axis_y_m), abs(hand.arc_axis_y_m)
    if hand.arc_radius_m and not max(reach) < hand.arc_radius_m:
        faults.append(
            f"the arc of radius {hand.arc_radius_m:g} m about y = {hand.arc_axis_y_m:g} m does not "
            f"reach from y = 0 to {hand.max_opening_m / 2.0:g} m, half of max_opening_m"
        )
    if hand.bars and not hand.arc_radius_m:
        faults.append("it has bars but no [arc]; bars turn with the arc's crank")
    return faults
