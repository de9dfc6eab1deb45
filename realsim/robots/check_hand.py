"""What can be proven of a hand's description without the hand."""

from pathlib import Path
from xml.etree.ElementTree import Element

import numpy as np

from realsim.arrays import Array
from realsim.errors import InputError, MissingLibraryError
from realsim.geometry import se3
from realsim.robots.check_arm import Finding
from realsim.robots.hand import Hand, hand_of
from realsim.robots.robot_files import HandFile, RobotFolder, robot_file
from realsim.robots.urdf import floats, mimicked, origin_of
from realsim.untrusted.xml_tree import read_xml

MEET_M = 1e-3
"""Closed pads that are farther apart do not meet [m]."""
PATH_M = 2e-4
"""Greatest distance of the URDF's pads from the law [m]."""
TURN_DEG = 0.5
"""Fingers that turn by more on the way do not keep their orientation [deg]."""
FARTHEST_M = 1.0
"""No hand is longer [m]."""
LEAST_FREE_M = 0.005
"""Fingers stand out of the palm by this at the least [m]."""
STEPS = 101
"""Positions of the driven joint at which the URDF's pads are looked at."""


def check_hand(name: str) -> tuple[Hand, list[Finding]]:
    """Return a hand and what was found of it.

    Args:
        name: of a robot, or its folder.

    Raises:
        InputError: its files do not make a hand.
    """
    file, folder = robot_file(name, HandFile)
    hand = hand_of(file, folder)
    return hand, [
        _pads_meet(hand),
        _pads_on_fingers(hand),
        _opening(hand),
        _mount(hand),
        _mass(hand),
        *_urdf(file, hand, folder),
    ]


def _pads_meet(hand: Hand) -> Finding:
    gap = 2.0 * min(low[1] for low, _ in hand.finger_boxes)
    found = f"the closed fingers are {1e3 * gap:.1f} mm apart"
    if abs(gap) <= MEET_M:
        return Finding(what="pads meet", found=found)
    why = f"they stand {-1e3 * gap:.1f} mm inside one another" if gap < 0 else found
    return Finding(
        what="pads meet", found=why, is_right=False,
        advice="When the hand is closed the faces of its pads lie on y = 0: let low_m of the "
        "[[finger]] boxes begin at y = 0 or behind, one of them at 0.",
    )  # fmt: skip


def _pads_on_fingers(hand: Hand) -> Finding:
    low, high = hand.finger_boxes[0]
    out = max(
        hand.pad_width_m / 2 - high[0], hand.pad_length_m / 2 - high[2],
        low[2] + hand.pad_length_m / 2,
    )  # fmt: skip
    found = f"{1e3 * hand.pad_width_m:g} x {1e3 * hand.pad_length_m:g} mm"
    pressed = f"{1e-3 * hand.pad_stiffness_n_per_m:.4g} kN/m"
    if out <= 1e-6:
        return Finding(what="pads", found=f"{found}, inside the fingers' boxes; {pressed}")
    return Finding(
        what="pads", found=f"{found}, {1e3 * out:.1f} mm beyond the fingers' boxes", is_right=False,
        advice="A pad is no wider than the finger, and its middle is the origin: make it smaller, "
        "or the finger, or tip_beyond_grasp_m, longer.",
    )  # fmt: skip


def _opening(hand: Hand) -> Finding:
    rise = -1e3 * float(hand.z_pad(hand.max_opening_m))
    law = f"on an arc, {rise:.1f} mm farther back when open" if hand.arc_radius_m else "on a slide"
    return Finding(
        what="opening and force",
        found=f"0 to {1e3 * hand.max_opening_m:g} mm, {law}; {hand.least_force_n:g} to "
        f"{hand.greatest_force_n:g} N, usually {hand.force_n:g}",
    )


def _mount(hand: Hand) -> Finding:
    back = min(low[2] for low, _ in hand.palm_boxes)
    found = f"flange {-1e3 * hand.mount_z_m:.1f} mm behind the grasp, turned by "
    found += f"{hand.mount_turn_deg:g} deg"
    if -hand.mount_z_m > FARTHEST_M or abs(hand.mount_turn_deg) > 360.0:
        return Finding(
            what="mount", found=f"{found}; that is no hand in metres", is_right=False,
            advice=f"distance_m of [mount] is in metres, at most {FARTHEST_M:g}; turn_deg is at "
            "most a whole turn.",
        )  # fmt: skip
    if hand.palm_face_z_m > hand.tip_beyond_tcp_m - LEAST_FREE_M:
        return Finding(
            what="mount", found=f"the palm reaches to z = {1e3 * hand.palm_face_z_m:.1f} mm, the "
            f"fingers to {1e3 * hand.tip_beyond_tcp_m:.1f} mm", is_right=False,
            advice="Nothing fits between the fingers: the [[palm]] boxes end before the fingers' "
            "tips. The origin of `grasp` is between the pads' middles, z points out of the hand.",
        )  # fmt: skip
    if hand.mount_z_m <= back + 1e-6:
        return Finding(what="mount", found=found)
    return Finding(
        what="mount", found=f"{found}; the palm reaches {1e3 * (hand.mount_z_m - back):.1f} mm "
        "farther back, into the arm", is_right=False,
        advice="distance_m of [mount] is from the flange to the origin of `grasp`: at least to the "
        "back of the [[palm]] boxes.",
    )  # fmt: skip


def _mass(hand: Hand) -> Finding:
    found = f"{hand.mass_kg:g} kg, of it {hand.finger_mass_kg:g} kg a finger"
    return Finding(
        what="mass", found=found, is_right=2.0 * hand.finger_mass_kg < hand.mass_kg,
        advice="mass_kg is the whole hand's, both fingers in it.",
    )  # fmt: skip


# --- the law against the URDF's own joints --------------------------------------------------------


def _urdf(file: HandFile, hand: Hand, folder: RobotFolder) -> list[Finding]:
    """Compare the pads of the URDF, moved through its mimic joints, with the law."""
    if not file.urdf:
        return []
    try:
        path = folder.file(file.urdf, "the URDF")
    except MissingLibraryError as error:
        return [Finding(what="URDF", found=f"not looked at: {error}")]
    if len(file.urdf_pads) != 2:
        raise InputError(
            f"{folder.path}: urdf_pads is {list(file.urdf_pads)}; the links of both pads, at +y "
            "and -y, are needed with urdf."
        )
    Ts = pad_frames(path, (file.urdf_pads[0], file.urdf_pads[1]))
    faces = se3.transform(Ts, np.array([file.urdf_pad_face_m]))[..., 0, :]
    openings, error_m = path_error(hand, faces)
    R = np.swapaxes(Ts[:1, ..., :3, :3], -1, -2) @ Ts[..., :3, :3]
    turn = float(np.degrees(se3.angle(R).max()))
    gap = float(openings.min())
    return [
        Finding(
            what="URDF, pads meet", found=f"its pads come to {1e3 * gap:.2f} mm",
            is_right=gap <= MEET_M,
            advice="Set the limits of the driven joint, or urdf_pad_face_m, so that they meet.",
        ),
        Finding(
            what="URDF, pads' path", found=f"within {1e3 * error_m:.3f} mm of the law",
            is_right=error_m <= PATH_M,
            advice="The law is of another hand than the URDF: look at [arc], urdf_pads, and the "
            "multiplier and offset of the mimic joints.",
        ),
        Finding(
            what="URDF, orientation", found=f"its pads turn by {turn:.2f} deg on the way",
            is_right=turn <= TURN_DEG,
            advice="Fingers that turn are no hand of this kind; or a mimic joint has another sign.",
        ),
    ]  # fmt: skip


def path_error(hand: Hand, faces: Array) -> tuple[Array, float]:
    """Return how far pads are apart (S,) and their greatest distance from the law [m].

    Args:
        hand: with the law.
        faces: (S, 2, 3) middles of both pads' faces, in any fixed frame [m].
    """
    between = faces[:, 0] - faces[:, 1]
    widest = int(np.argmax(np.linalg.norm(between, axis=1)))
    closing = between[widest] / np.linalg.norm(between[widest])
    openings = between @ closing
    nearest = int(np.argmin(openings))
    middles = faces.mean(axis=1) - faces[nearest].mean(axis=0)
    across = middles - np.outer(middles @ closing, closing)
    law = hand.z_pad(openings) - hand.z_pad(openings[nearest])
    # The approach is where the pads go when they open, with the law's sign.
    back = across[widest]
    length = float(np.linalg.norm(back))
    approach = np.sign(law[widest] or 1.0) * back / length if length > 0 else np.zeros(3)
    beside = np.linalg.norm(across - np.outer(across @ approach, approach), axis=1)
    return openings, float(np.hypot(across @ approach - law, beside).max())


def pad_frames(path: Path, pads: tuple[str, str]) -> Array:
    """Return the frames (S, 2, 4, 4) of two links of a URDF in its root while its joint is driven.

    Raises:
        InputError: no such link, a mimic joint that points nowhere, or limits that are missing.
    """
    root = read_xml(path)
    joints = {j.get("name", ""): j for j in root.findall("joint")}
    above = {_link(j, "child"): j for j in joints.values()}
    links = {link.get("name", "") for link in root.findall("link")}
    frames: list[Array] = []
    for pad in pads:
        if pad not in links:
            raise InputError(f"{path}: urdf_pads names '{pad}'; its links: {', '.join(links)}.")
        T, link = np.tile(np.eye(4), (STEPS, 1, 1)), pad
        while link in above:
            joint = above[link]
            T = origin_of(joint, str(path)) @ _motion(path, joint, joints) @ T
            link = _link(joint, "parent")
        frames.append(T)
    return np.stack(frames, axis=1)


def _link(joint: Element, end: str) -> str:
    element = joint.find(end)
    return "" if element is None else element.get("link", "")


def _motion(path: Path, joint: Element, joints: dict[str, Element]) -> Array:
    """Return the motions (S, 4, 4) of a joint."""
    if joint.get("type") == "fixed":
        return np.eye(4)
    named = joint.find("axis")
    text = "1 0 0" if named is None else named.get("xyz", "1 0 0")
    axis = floats(text, (3,), f"the axis of a joint of {path}")
    q = _positions(path, joint, joints)
    if joint.get("type") == "prismatic":
        return se3.from_rt(np.eye(3), q[:, None] * axis)
    return se3.from_rt(se3.exp_so3(q[:, None] * axis), np.zeros(3))


def _positions(path: Path, joint: Element, joints: dict[str, Element]) -> Array:
    """Return the positions (S,) of a joint, through the joints that it mimics."""
    scale, offset = 1.0, 0.0
    for _ in joints:
        name, mimic = joint.get("name", ""), joint.find("mimic")
        if mimic is None:
            limit = joint.find("limit")
            ends = [None if limit is None else limit.get(end) for end in ("lower", "upper")]
            if None in ends:
                raise InputError(f"{path}: the joint '{name}' has no limits; lower and upper are.")
            low, high = floats(" ".join(map(str, ends)), (2,), f"the limits of '{name}' in {path}")
            return offset + scale * np.linspace(low, high, STEPS)
        asked = mimicked(mimic, name, joints, path)
        text = f"{mimic.get('multiplier', '1')} {mimic.get('offset', '0')}"
        factor, shift = floats(text, (2,), f"the mimic of '{name}' in {path}")
        scale, offset, joint = scale * factor, offset + scale * shift, joints[asked]
    raise InputError(f"{path}: the joint '{joint.get('name', '')}' mimics itself through others.")
