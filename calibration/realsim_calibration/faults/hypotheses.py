"""Readings of the poses that would make hand and camera agree, each with its fit and sentence."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from realsim.arrays import Array, Rows
from realsim.geometry import se3
from realsim.records import CharucoBoard, Chessboard, CircleGrid, TagBoard, Target
from realsim_calibration.faults import diagnosis, pairing
from realsim_calibration.faults.frame_fit import FrameFit, fit_frames, hand_side, mismatch
from realsim_calibration.faults.gates import rotation_mismatch_deg, screw_ratio
from realsim_calibration.faults.half_turns import synchronise_half_turns
from realsim_calibration.faults.pairing import Pairing, find_move, find_pairing
from realsim_calibration.faults.rotation_readings import (
    FINALISTS,
    Reread,
    every_reading,
    reading_of,
    reread,
    reread_degrees,
)
from realsim_calibration.faults.tool_offset import describe_offset
from realsim_calibration.fit.closed_forms import motions


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Poses:
    """What is diagnosed."""

    T: Array
    """(n, 4, 4) hand poses as given."""
    C: Array
    """(n, 4, 4) board poses as given."""
    eye_in_hand: bool
    middle: Array
    """(3,) the board's middle in its frame."""
    labels: tuple[str, ...]
    target: Target | None

    def fit(self, T: Array, C: Array) -> FrameFit:
        """Return the frames of other hand and board poses of this session."""
        return fit_frames(hand_side(T, self.eye_in_hand), C, self.middle)

    def names(self, rows: Sequence[int]) -> str:
        """Return the names of rows for a sentence, long runs shortened."""
        rows = sorted(rows)
        runs: list[list[int]] = []
        for r in rows:
            if runs and r == runs[-1][-1] + 1:
                runs[-1].append(r)
            else:
                runs.append([r])
        parts = [
            f"{self.labels[run[0]]} to {self.labels[run[-1]]}" if len(run) > 2
            else ", ".join(self.labels[r] for r in run)
            for run in runs
        ]  # fmt: skip
        return ", ".join(parts)


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Hypothesis:
    """One reading of the data and how it fits."""

    fault: diagnosis.Fault
    name: str
    """For the table of evidence."""
    fit: FrameFit
    score: float
    """The fit's, views that are left out counted as hardly agreeing."""
    T: Array
    """(k, 4, 4) hand poses under this reading."""
    C: Array
    """(k, 4, 4) board poses under this reading."""
    rows: Rows
    """(k, 2) rows of the given poses that they come from."""
    sentence: str = ""
    advice: str = ""
    views: tuple[int, ...] = ()
    note: str = ""
    gain: float | None = None
    """How many times better than as given it must fit; None = as configured."""


def evidence_of(h: Hypothesis, eye_in_hand: bool) -> diagnosis.Evidence:
    """Return the row of the table for a hypothesis."""
    A = hand_side(h.T, eye_in_hand)
    ratio = h.fit.length_ratio
    # Camera lengths that are a thousandth of the hand's number are metres, others millimetres.
    unit = 1.0 if ratio < SMALL_RATIO else 1e3
    return diagnosis.Evidence(
        hypothesis=h.name,
        rotation_mismatch_deg=rotation_mismatch_deg(A, h.C),
        screw_ratio=screw_ratio(A, h.C),
        view_deg=h.fit.usual_deg,
        view_mm=unit * 1e-3 * h.fit.usual_mm,
        length_ratio=ratio,
        score=h.score,
    )


SNAPS = 2
"""How often degrees known modulo 2 pi are chosen anew with better frames."""
SMALL_RATIO = 0.02
"""Length ratios below this belong to a board in millimetres."""


def _whole(n: int) -> Rows:
    return np.stack([np.arange(n), np.arange(n)], -1)


def simple(p: Poses, fault: diagnosis.Fault, name: str, T: Array, C: Array) -> Hypothesis:
    """Return a hypothesis that keeps every view, still without words."""
    fit = p.fit(T, C)
    return Hypothesis(
        fault=fault, name=name, fit=fit, score=fit.score, T=T, C=C, rows=_whole(len(T))
    )


def _off_axis(C: Array, middle: Array) -> tuple[bool, float]:
    """Return whether the board is in front of every camera, and its median angle off the axis."""
    q = C[:, :3, :3] @ middle + C[:, :3, 3]
    angle = np.arctan2(np.linalg.norm(q[:, :2], axis=-1), q[:, 2])
    return bool(np.all(q[:, 2] > 0)), float(np.median(angle))


def inverted(p: Poses) -> Hypothesis:
    """Return the hypothesis that hand or camera poses are inverted.

    Inverted hand poses, inverted camera poses and a camera at the other place fit equally well. The
    camera's are to blame where the board lies behind it, or far off its axis, unless inverted.
    """
    other = se3.invert(p.C)
    front, off = _off_axis(p.C, p.middle)
    other_front, other_off = _off_axis(other, p.middle)
    behind = other_front and not front
    aside = other_front and front and off > diagnosis.PLAUSIBLE_OFF_AXIS * other_off
    if behind or aside:
        where = "behind the camera" if behind else f"{np.degrees(off):.0f} deg off its axis"
        return replace(
            simple(p, "camera_inverted", "camera poses inverted", p.T, other),
            sentence="The camera poses are inverted: they fit as T_board_cam, and as given the "
            f"board would lie {where}.",
            advice="Give T_cam_board, which maps points of the board into the camera (what "
            "solvePnP returns).",
            note="the camera poses were inverted.",
        )  # fmt: skip
    h = simple(p, "robot_inverted", "hand poses inverted", se3.invert(p.T), p.C)
    x, z = (float(np.linalg.norm(T[:3, 3])) for T in (h.fit.X, h.fit.Z))
    likely = "the file holds T_ee_base"
    if p.eye_in_hand:
        other_way = "the camera stands still and sees the board in the hand"
        places = (
            f"the camera sits {_mm(x, h)} from the tool and the board {_mm(z, h)} from the base"
        )
    else:
        other_way = "the camera sits in the hand and the board stands still"
        places = (
            f"the camera stands {_mm(x, h)} from the base and the board {_mm(z, h)} from the tool"
        )
    mode = "eye_to_hand" if p.eye_in_hand else "eye_in_hand"
    flag = "give --eye-to-hand" if p.eye_in_hand else "leave --eye-to-hand out"
    flag += f" (or, among --cameras, say NAME={'fixed' if p.eye_in_hand else 'hand'})"
    remedy = (
        "add ',inverted' to the reading that was told or given, as in --reading matrix,m,inverted "
        "where it is matrix,m (Python: give T_base_ee)"
    )
    other_remedy = f"{flag} (Python: mode='{mode}')"
    # What is in the hand is nearer to it than what stands in the base.
    if (x > z) == p.eye_in_hand:
        likely, other_way = other_way, likely
        remedy, other_remedy = other_remedy, remedy
    return replace(
        h, sentence="The hand poses are inverted: hand and camera agree when every hand pose is "
        f"inverted. Either {likely}, or {other_way}: poses alone cannot tell the two apart. "
        f"With them inverted {places}, which speaks for the first.",
        advice=f"Say which it is. For the first: {remedy}. For the second: {other_remedy}.",
        note="the hand poses were inverted.",
    )  # fmt: skip


def _mm(length: float, h: Hypothesis) -> str:
    scale = 1.0 if h.fit.length_ratio > 300 else 1e3
    return f"{length * scale:.0f} mm"


def flipped_boards(p: Poses) -> Hypothesis | None:
    """Return the hypothesis that some boards were read turned by 180 deg."""
    if not isinstance(p.target, (Chessboard, CircleGrid)):
        return None
    turns = synchronise_half_turns(p.T, p.C, p.middle)
    if not turns.flips.any():
        return None
    views = tuple(int(k) for k in np.flatnonzero(turns.flips))
    name = f"{len(views)} boards turned by 180 deg"
    return replace(
        simple(p, "board_flips", name, p.T, turns.repaired),
        sentence=f"{len(views)} of {len(p.T)} boards were read turned by 180 deg: views "
        f"{p.names(views)}. The difference of the turns of hand and camera falls from "
        f"{turns.before_deg:.1f} to {turns.after_deg:.2f} deg RMS when they are turned back.",
        advice="The target looks the same turned by 180 deg. Use one that does not: a ChArUco or "
        "tag board, or a chessboard whose inner corners are even one way and odd the other.",
        views=views, note="the boards were turned back about their middle.",
    )  # fmt: skip


def reread_rotations(p: Poses, *, thorough: bool) -> list[Hypothesis]:
    """Return the hypotheses that the hand's rotations were decoded by another convention.

    Args:
        p: the poses.
        thorough: fit every pair of conventions instead of the few that win the vote.
    """
    D = se3.invert(p.C) if p.eye_in_hand else p.C
    R, t = p.T[:, :3, :3], p.T[:, :3, 3]
    readings = every_reading(R) if thorough else reread(R, t, D)
    found = [
        _reread(p, "rotation_reading", r,
                f"Hand and camera agree when what was read as {r.read_as} is read as {r.meant}.")
        for r in readings
    ]  # fmt: skip
    hand, cam = (float(np.sqrt(np.mean(np.sum(m.turns**2, -1)))) for m in motions(p.T, p.C))
    if hand < diagnosis.SMALL_TURN_PART * cam:
        scale = float(np.degrees(1.0))
        readings = every_reading(R, scale) if thorough else reread(R, t, D, scale)
        found += [
            _reread(p, "radians_as_degrees", r,
                    f"Angles in radians were taken for degrees: the hand turns by "
                    f"{np.degrees(hand):.2f} deg (RMS of the pairs), the camera by "
                    f"{np.degrees(cam):.1f}; times 180 / pi, read as {r.meant}, they agree.")
            for r in readings
        ]  # fmt: skip
    found.sort(key=lambda h: h.score)
    return found[:FINALISTS]


def reread_as_degrees(p: Poses) -> list[Hypothesis]:
    """Return the hypotheses that numbers in degrees were taken for radians.

    They are named but not mended: a degree is known modulo 2 pi only, so that the first and the
    last angle of all views may be off by the same multiple, which X and Z take up unseen. Because
    the readings have so much freedom, they must fit better than others.
    """
    D = se3.invert(p.C) if p.eye_in_hand else p.C
    found: list[Hypothesis] = []
    for r in reread_degrees(p.T[:, :3, :3], p.T[:, :3, 3], D):
        h = _reread(p, "degrees_as_radians", r,
                    "Angles in degrees were taken for radians: hand and camera agree when the "
                    f"numbers are read as {r.meant}.")  # fmt: skip
        for _ in range(SNAPS):
            if r.snap is None:
                break
            Rs = r.snap(_predicted_rotations(p, h))
            h = _reread(p, "degrees_as_radians", replace(r, Rs=Rs), h.sentence)
        found.append(h)
    return [
        replace(h, note="", advice=f"{h.advice} The poses as decoded have lost the degrees.")
        for h in found
        if h.score <= diagnosis.ACCEPT_DEGREES
    ]


def _predicted_rotations(p: Poses, h: Hypothesis) -> Array:
    """Return the hand rotations (n, 3, 3) that the fitted frames and the images predict."""
    back = np.swapaxes(h.fit.X[:3, :3] @ p.C[:, :3, :3], -1, -2)
    A = h.fit.Z[:3, :3] @ back
    return A if p.eye_in_hand else np.swapaxes(A, -1, -2)


def _reread(p: Poses, fault: diagnosis.Fault, r: Reread, sentence: str) -> Hypothesis:
    T = se3.from_rt(r.Rs, p.T[:, :3, 3])
    reading = reading_of(r.meant)
    flag = "" if reading is None else f": --reading {reading} (mm for m if the file holds them)"
    return replace(
        simple(p, fault, r.name, T, p.C), sentence=sentence,
        advice=f"Read the rotations as {r.meant}{flag}.",
        note=f"the rotations were read as {r.name}.",
    )  # fmt: skip


def paired_otherwise(p: Poses) -> Hypothesis | None:
    """Return the hypothesis that images and hand poses were paired wrongly."""
    found = find_pairing(hand_side(p.T, p.eye_in_hand), p.C, p.middle)
    if found is None:
        return None
    n, kept = len(p.C), len(found.rows)
    dropped = n - kept
    penalty = pairing.FLOOR**2 * dropped
    score = float(np.sqrt((found.fit.score**2 * kept + penalty) / n))
    fault, name, sentence, views = _pairing_text(p, found)
    if fault == "none":
        return None
    A = hand_side(p.T, p.eye_in_hand)
    bad = np.diag(mismatch(found.fit, A, p.C))[list(views)]
    # A few views among many hardly move the score, but each is far off by itself.
    gross = fault != "shifted_pairing" and bool(np.all(bad > diagnosis.GROSS_ERROR))
    return Hypothesis(
        gain=diagnosis.GAIN_GROSS if gross else None,
        fault=fault, name=name, fit=found.fit, score=score, T=p.T[found.rows[:, 0]],
        C=p.C[found.rows[:, 1]], rows=found.rows, sentence=sentence, views=views,
        advice="Pair by file name or time stamp, never by position in a list: a failed detection "
        "moves every later image." if fault == "shifted_pairing" else
        "Check which image belongs to which pose, and calibrate again.",
        note=f"{kept} of {n} images were paired anew with the poses that they fit.",
    )  # fmt: skip


def _pairing_text(p: Poses, found: Pairing) -> tuple[diagnosis.Fault, str, str, tuple[int, ...]]:
    """Return fault, name, sentence and views of a pairing; "none" where it is the given one."""
    shifts = found.shifts
    if shifts.any():
        starts = [0, *(int(k) + 1 for k in np.flatnonzero(np.diff(shifts)))]
        parts: list[str] = []
        for k, start in enumerate(starts):
            s = int(shifts[start])
            stop = starts[k + 1] if k + 1 < len(starts) else len(shifts)
            which = p.names(range(start, stop))
            way = f"the pose {abs(s)} {'later' if s > 0 else 'earlier'}" if s else "their own pose"
            parts.append(f"images {which} fit {way}")
        begin = "" if shifts[0] else f" from view {p.labels[starts[1]]} on"
        return (
            "shifted_pairing", f"pairing shifted{begin}",
            f"Images and hand poses are shifted against each other{begin}: {'; '.join(parts)}.",
            tuple(int(k) for k in np.flatnonzero(shifts)),
        )  # fmt: skip
    pairs = " and ".join(f"{p.labels[a]} with {p.labels[b]}" for a, b in found.swapped)
    if found.swapped and not found.strays:
        views = tuple(sorted(row for pair in found.swapped for row in pair))
        return (
            "swapped_images", f"images {pairs} swapped",
            f"Images were swapped: {pairs}. Exchanged, they fit like the others.", views,
        )  # fmt: skip
    if found.strays:
        place = dict(found.elsewhere)
        texts = [
            f"{p.labels[k]} (fits the pose of {p.labels[place[k]]})" if k in place else p.labels[k]
            for k in found.strays
        ]
        more = f" Images {pairs} are swapped as well." if found.swapped else ""
        run = list(range(found.strays[0], len(shifts)))
        if len(run) > 2 and list(found.strays) == run:
            more += (
                f" From {p.labels[run[0]]} on none fits: a detection may have failed there and "
                "shifted the rest of the list."
            )
        return (
            "mispaired_image", f"without views {p.names(found.strays)}",
            f"The images of these views do not belong to their hand poses: {', '.join(texts)}; the "
            f"other {len(found.rows)} views agree.{more}",
            tuple(sorted({*found.strays, *(r for pair in found.swapped for r in pair)})),
        )  # fmt: skip
    return "none", "", "", ()


def moved(p: Poses) -> Hypothesis | None:
    """Return the hypothesis that camera, tool or board was moved within the session."""
    A = hand_side(p.T, p.eye_in_hand)
    m = find_move(A, p.C, p.middle)
    if m is None:
        return None
    T = p.T.copy()
    A = A.copy()
    A[m.start :] = A[m.start :] @ se3.invert(m.step) if m.frame == "X" else m.step @ A[m.start :]
    T[m.start :] = A[m.start :] if p.eye_in_hand else se3.invert(A[m.start :])
    hand = (m.frame == "X") == p.eye_in_hand
    fault: diagnosis.Fault = (
        "tool_change" if hand else "board_moved" if p.eye_in_hand else "camera_moved"
    )
    what = {
        "tool_change": f"{'camera' if p.eye_in_hand else 'board'} sits elsewhere in the hand",
        "board_moved": "board stands elsewhere",
        "camera_moved": "camera stands elsewhere",
    }[fault]
    cause = (
        "the tool offset (TCP) of the controller was changed, or the mount slipped" if hand
        else "it was moved during the session"
    )  # fmt: skip
    # T' = T S on the hand's right: poses after the start are of a point S beyond the earlier one.
    S = m.step if m.frame == "X" else se3.invert(m.step)
    text = describe_offset(S).replace("in the flange", "in the tool").replace("flange", "tool")
    how = text if hand else f"by {1e3 * np.linalg.norm(m.step[:3, 3]):.1f} mm"
    fit = fit_frames(A, p.C, p.middle)
    views = tuple(range(m.start, len(p.T)))
    return Hypothesis(
        fault=fault, name=f"{what} from view {p.labels[m.start]} on", fit=fit, score=m.score, T=T,
        C=p.C, rows=_whole(len(T)),
        sentence=f"From view {p.labels[m.start]} on the {what} ({how}): {cause}."
        + (" These views turn too little to tell whether it was the hand's side or the other that "
           "moved." if m.either else ""),
        advice="Calibrate each stretch of views for itself, or repeat the session.",
        views=views, note="the later hand poses were carried back by the fitted move.",
    )  # fmt: skip


def size_name(target: Target | None, ratio: float) -> str:
    """Return "the square is 19.06 mm, not 35 mm" for a target that is `ratio` times as large."""
    what, length, _ = _length_of(target)
    if not what:
        return f"the board is {ratio:.4g} times as large as said"
    return f"the {what} is {1e3 * length * ratio:.4g} mm, not {1e3 * length:.4g} mm"


def option_of(target: Target | None, ratio: float) -> str:
    """Return what --board says of a target that is `ratio` times as large: "square=19.06mm"."""
    _, length, word = _length_of(target)
    return f"{word}={1e3 * length * ratio:.4g}mm" if word else "its size"


def _length_of(target: Target | None) -> tuple[str, float, str]:
    """Return what a target's size is called, the size [m], and its word in --board."""
    if isinstance(target, TagBoard):
        return "tag's edge", target.tag_size_m, "tag"
    if isinstance(target, (Chessboard, CharucoBoard)):
        return "square", target.square_m, "square"
    if isinstance(target, CircleGrid):
        return "grid's pitch", target.pitch_m, "pitch"
    return "", 0.0, ""
