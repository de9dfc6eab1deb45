"""What is wrong with a set of hand and board poses? A test of conventions that needs no hand-eye.

For right data A_i X C_i = Z with two constant frames, whatever they are. Where they do not exist,
the poses are read in every way that people and programs confuse: inverted, by another convention of
rotation, in another unit, paired with other images, boards turned round, things moved half-way. The
reading that fits, far better than the data as given, is the fault; where none does, that is said.

The hypothesis that the robot's poses, or the images, are mirrored.
"""

from collections.abc import Sequence
from dataclasses import replace
from itertools import product

import numpy as np
from numpy.typing import ArrayLike

from realsim.arrays import Array, Int64
from realsim.errors import InputError
from realsim.geometry import se3
from realsim.records import Target
from realsim_calibration.faults import diagnosis, pairing
from realsim_calibration.faults.frame_fit import FrameFit, fit_frames, hand_side, mismatch
from realsim_calibration.faults.hypotheses import (
    Hypothesis,
    Poses,
    evidence_of,
    flipped_boards,
    inverted,
    moved,
    option_of,
    paired_otherwise,
    reread_as_degrees,
    reread_rotations,
    simple,
    size_name,
)
from realsim_calibration.faults.pairing import Groups, find_copies
from realsim_calibration.faults.tool_offset import tool_offset
from realsim_calibration.fit.closed_forms import MIN_VIEWS, motions, pose_stacks, principal_turns
from realsim_calibration.results import Mode


def mirrored(p: Poses) -> list[Hypothesis]:
    """Return the hypotheses that an axis is mirrored: of the positions, the rotations, or both.

    A left-handed frame turns T into S T S with one sign of S flipped. Which axis it is cannot be
    told then, because two flips are a half turn, which X and Z take up; where only positions or
    only rotations are mirrored it can. Images that are mirrored left to right look the same, too:
    following the advice for poses then gives a camera that looks backwards.
    """
    R, t = p.T[:, :3, :3], p.T[:, :3, 3]
    found: list[Hypothesis] = []
    for k, axis in enumerate("xyz"):
        S = np.eye(3)
        S[k, k] = -1.0
        turned, moved = S @ R @ S, t @ S
        found += [
            _hypothesis(p, R, moved, f"the {axis} axis of the positions is mirrored",
                        f"Correct the export: the sign of {axis} in the positions."),
            _hypothesis(p, turned, t, f"the {axis} axis of the rotations is mirrored",
                        f"Correct the export: the sign of {axis} in the rotations; turns about the "
                        "two other axes go the other way."),
        ]  # fmt: skip
        if axis == "z":
            found.append(_hypothesis(
                p, turned, moved,
                "the poses are read as left-handed: an axis of the robot's frames is mirrored (x, "
                "y or z, the poses cannot tell which), or all images are mirrored left to right",
                "Look at writing in an image first. If it is mirrored, flip the images back. If "
                "not, export right-handed poses; or, with S = diag(1, 1, -1), give S t as position "
                "and S R S as rotation.",
            ))  # fmt: skip
    return found


def _hypothesis(p: Poses, R: Array, t: Array, what: str, advice: str) -> Hypothesis:
    return replace(
        simple(p, "mirrored_axis", what, se3.from_rt(R, t), p.C),
        sentence=f"Hand and camera agree when {what}.",
        advice=advice,
        note="the axis was turned round.",
    )


UNITS = (("millimetres", 1000.0), ("centimetres", 100.0), ("inches", 39.3701))
"""Units of length that are taken for metres."""
UNIT_TOLERANCE = 1.15
"""A ratio of lengths within this factor of a unit is that unit."""
LISTED = 12
"""Rows of evidence that are kept."""


def diagnose(
    Ts_base_ee: ArrayLike,
    Ts_cam_board: ArrayLike,
    *,
    labels: Sequence[str] | None = None,
    target: Target | None = None,
    nominal: ArrayLike | None = None,
    mode: Mode = "eye_in_hand",
) -> diagnosis.Diagnosis:
    """Return the most plausible single fault of the poses, with evidence and, if possible, repair.

    Args:
        Ts_base_ee: (n, 4, 4) the controller's poses as they were read [m].
        Ts_cam_board: (n, 4, 4) board poses in the camera [m].
        labels: names of the views; their rows where not given.
        target: the printed target: for its middle, its size in messages, whether it can be turned.
        nominal: (n, 4, 4) T_base_flange by the nominal kinematics [m], for the tool offset.
        mode: where the camera is said to sit.

    Raises:
        InputError: stacks of different lengths, or fewer than four views.
        NotRigidError: a pose is not rigid.
    """
    T = se3.check_rigid(Ts_base_ee, "Ts_base_ee")
    C = se3.check_rigid(Ts_cam_board, "Ts_cam_board")
    T, C = pose_stacks(T, C, "diagnosis", least=MIN_VIEWS + 1)
    names = tuple(str(k) for k in (labels if labels is not None else range(len(T))))
    if len(names) != len(T):
        raise InputError(f"diagnosis: {len(names)} labels for {len(T)} views.")
    middle = np.zeros(3) if target is None else target.points_board.mean(0)
    p = Poses(T=T, C=C, eye_in_hand=mode == "eye_in_hand", middle=middle, labels=names,
              target=target)  # fmt: skip
    rows, copied = _without_copies(p, find_copies(T, C, middle))
    if copied is not None and copied.fault == "unknown":
        return _diagnosis(p, copied, ())
    part = replace(p, T=T[rows], C=C[rows], labels=tuple(names[k] for k in rows))
    known = None if nominal is None else np.asarray(nominal, dtype=np.float64)[rows]
    found, tried = _search(part, known)
    views = tuple(int(rows[k]) for k in found.views)
    found = replace(found, rows=rows[found.rows], views=views)
    if copied is not None:
        if found.fault in ("none", "tool_offset", "base_turned"):
            found = replace(copied, fit=found.fit)
        else:
            found = replace(found, sentence=f"{found.sentence} Also: {copied.sentence}")
    return _diagnosis(p, found, tried)


def _diagnosis(p: Poses, h: Hypothesis, tried: Sequence[Hypothesis]) -> diagnosis.Diagnosis:
    table: list[diagnosis.Evidence] = []
    for other in tried:
        if len(other.T) >= MIN_VIEWS and other.name not in {e.hypothesis for e in table}:
            table.append(evidence_of(other, p.eye_in_hand))
    mended = bool(h.note)
    return diagnosis.Diagnosis(
        fault=h.fault, sentence=h.sentence, advice=h.advice, views=h.views,
        labels=tuple(p.labels[k] for k in h.views), evidence=tuple(table[:LISTED]),
        length_ratio=h.fit.length_ratio, ratio_sd=h.fit.ratio_sd,
        repaired_base_ee=h.T if mended else None, repaired_cam_board=h.C if mended else None,
        repaired_rows=h.rows if mended else None, note=h.note,
    )  # fmt: skip


def _without_copies(
    p: Poses, groups: dict[diagnosis.Fault, Groups]
) -> tuple[Int64, Hypothesis | None]:
    """Return the rows that repeat nothing, and what the others are."""
    n = len(p.T)
    every = np.arange(n)
    if not any(groups.values()):
        return every, None
    unsure = (*groups["frozen_pose"], *groups["repeated_image"])
    doubtful = {row for group in unsure for row in group}
    spare = {row for g in groups["duplicated_views"] for row in g[1:]}
    sure = np.array([k for k in range(n) if k not in doubtful | spare], dtype=np.int64)
    kept = list(sure)
    if doubtful and len(sure) > MIN_VIEWS:
        fit = p.fit(p.T[sure], p.C[sure])
        errors = np.diag(mismatch(fit, hand_side(p.T, p.eye_in_hand), p.C))
        gate = max(pairing.RATIO * fit.usual, pairing.SWAP_FLOOR)
        for group in unsure:
            best = min(group, key=lambda k: errors[k])
            kept += [best] if errors[best] <= gate else []
    rows = np.array(sorted(set(kept) - spare), dtype=np.int64)
    fault: diagnosis.Fault = next(kind for kind, found in groups.items() if found)
    text = {
        "frozen_pose": ("share one hand pose to the last digit although their images differ: the "
                        "controller delivered an old pose", "Read the pose after the arm has "
                        "stopped and check that it changed, or leave these views out."),
        "repeated_image": ("share one image although their hand poses differ",
                           "Save every image anew, or leave these views out."),
        "duplicated_views": ("are the same view twice: pose and image are equal",
                             "Leave the copies out: they count a view twice, so the stated sigma "
                             "is too small."),
    }[fault]  # fmt: skip
    named = tuple(sorted(set(range(n)) - set(rows.tolist())))
    groups_text = "; ".join(p.names(g) for g in groups[fault])
    enough = len(rows) > MIN_VIEWS
    use = rows if enough else every
    return use, Hypothesis(
        fault=fault if enough else "unknown", name=fault.replace("_", " "),
        fit=p.fit(p.T[use], p.C[use]), score=0.0, T=p.T[use], C=p.C[use],
        rows=np.stack([use, use], -1), sentence=f"Views {groups_text} {text[0]}.",
        advice=text[1], views=named, note="the views named were left out." if enough else "",
    )  # fmt: skip


def _search(p: Poses, nominal: Array | None) -> tuple[Hypothesis, list[Hypothesis]]:
    """Return what is wrong with the poses, and all that was tried, as given first."""
    given = simple(p, "none", "as given", p.T, p.C)
    if (reason := _untestable(p)) is not None:
        return replace(given, fault="untestable", sentence=reason[0], advice=reason[1]), [given]
    if given.score <= diagnosis.SURE_SCORE and given.fit.errors.max() <= pairing.FLOOR:
        return _sound(p, given, nominal), [given]
    tried = [inverted(p), *mirrored(p)]
    tried += [h for h in (flipped_boards(p), paired_otherwise(p), moved(p))
              if h is not None]  # fmt: skip
    tried += reread_rotations(p, thorough=False)
    best = _best(given, tried)
    # Slow but complete, for poses too few or too parallel for a vote.
    if given.score > diagnosis.ACCEPT_SCORE and _doubtful(best):
        tried += reread_rotations(p, thorough=True)
        best = _best(given, tried)
    if best is None and given.score > diagnosis.ACCEPT_SCORE:
        tried += reread_as_degrees(p)
        best = _best(given, tried)
    listed = [given, *sorted(tried, key=lambda h: h.score)]
    if best is not None:
        figures = (
            f" Median error of the views as given {given.fit.usual_deg:.2f} deg, "
            f"{_mm(given)}; so {best.fit.usual_deg:.2f} deg, {_mm(best)}."
        )
        if best.fault == "tool_change" and nominal is not None:
            offset = tool_offset(p.T, nominal)
            if offset.known and len(offset.offsets) > 1:
                figures += f" {offset.sentence}"
        return replace(best, sentence=best.sentence + figures), listed
    if given.score <= diagnosis.ACCEPT_SCORE:
        return _sound(p, given, nominal), listed
    return _unknown(given, tried), listed


def _unknown(given: Hypothesis, tried: Sequence[Hypothesis]) -> Hypothesis:
    """Return that no reading fits, with the figures of the best."""
    second = min(tried, key=lambda h: h.score)
    return replace(
        given, fault="unknown",
        sentence=f"Hand and camera do not agree (median error of the views "
        f"{given.fit.usual_deg:.1f} deg, {_mm(given)}), and none of {len(tried)} other readings "
        f"fits; the best, {second.name}, leaves {second.fit.usual_deg:.1f} deg, {_mm(second)}.",
        advice="Check that images and poses belong to the same session, that the board (or, with a "
        "fixed camera, the board in the hand) did not move, and how the rotation is written.",
    )  # fmt: skip


def _mm(h: Hypothesis) -> str:
    ratio = h.fit.length_ratio
    length = h.fit.usual_mm * (1e-3 if ratio < 0.02 else 1.0)
    return f"{length:.1f} mm" if length < 1e4 else "metres"


def _doubtful(best: Hypothesis | None) -> bool:
    return best is None or (
        best.fault in ("rotation_reading", "radians_as_degrees")
        and best.score > diagnosis.DOUBTFUL_SCORE
    )


def _best(given: Hypothesis, tried: Sequence[Hypothesis]) -> Hypothesis | None:
    """Return the reading that fits far better than the given one, the simplest of equals."""
    gain = diagnosis.GAIN if len(given.T) >= diagnosis.FEW_VIEWS else diagnosis.GAIN_FEW
    fitting = [
        h
        for h in tried
        if h.score <= diagnosis.ACCEPT_SCORE
        and h.score * (gain if h.gain is None else h.gain) < given.score
    ]
    if not fitting:
        return None
    limit = diagnosis.TIE * min(h.score for h in fitting)
    return next(h for h in fitting if h.score <= limit)


def _untestable(p: Poses) -> tuple[str, str] | None:
    """Return why conventions cannot be tested, None where they can."""
    second = [np.degrees(principal_turns(m.turns)[0][1]) for m in motions(p.T, p.C)]
    if max(second) >= diagnosis.LEAST_TURN_DEG:
        return None
    return (
        f"Hand and camera turn by only {second[0]:.2f} and {second[1]:.2f} deg (RMS) about their "
        "second axis: the poses cannot tell one convention from another.",
        "Add views that turn the hand by 20 deg or more about two different axes.",
    )


def _sound(p: Poses, given: Hypothesis, nominal: Array | None) -> Hypothesis:
    """Return the faults that leave the frames consistent: units, sizes, tool offsets; or none."""
    ratio, sd = given.fit.length_ratio, given.fit.ratio_sd
    for unit, factor in UNITS:
        if factor / UNIT_TOLERANCE < ratio < factor * UNIT_TOLERANCE:
            T = p.T.copy()
            T[:, :3, 3] /= factor
            return _unit(p, "robot_unit", "hand poses", unit, ratio, T, p.C)
        if factor / UNIT_TOLERANCE < 1 / ratio < factor * UNIT_TOLERANCE:
            C = p.C.copy()
            C[:, :3, 3] /= factor
            return _unit(p, "board_unit", "board poses", unit, ratio, p.T, C)
    off = abs(np.log(ratio))
    if off > np.log(diagnosis.MAX_SIZE_RATIO) and off > diagnosis.SIZE_SIGMAS * sd:
        C = p.C.copy()
        C[:, :3, 3] *= ratio
        h = simple(p, "board_size", "board scaled", p.T, C)
        return replace(
            h,
            sentence=f"The board has another size: {size_name(p.target, ratio)} (the hand moves "
            f"{ratio:.4f} +- {ratio * sd:.4f} times as far as the camera, which is right for it "
            "at 1).",
            advice="Measure the board over several squares and give its true size (--board ..., "
            f"{option_of(p.target, ratio)}). If the size given is right, the unit of the hand "
            "poses is wrong.",
            note="the board poses were scaled.",
        )
    scale = (
        f"Lengths of hand and camera have the ratio {ratio:.4f} +- {ratio * sd:.4f}; 1 is right."
    )
    text = (
        f"Hand and camera agree: median error of the views {given.fit.usual_deg:.2f} deg, "
        f"{_mm(given)}. {scale}"
    )
    none = replace(given, fault="none", sentence=text)
    return none if nominal is None else _with_tool(p, none, nominal)


def _with_tool(p: Poses, none: Hypothesis, nominal: Array) -> Hypothesis:
    """Return what the nominal kinematics add to sound poses."""
    offset = tool_offset(p.T, nominal)
    fault: diagnosis.Fault = "none"
    if offset.known and offset.active:
        fault = "tool_change" if len(offset.offsets) > 1 else "tool_offset"
    elif offset.known and offset.base_turned:
        fault = "base_turned"
    if fault == "none":
        return replace(none, sentence=f"{none.sentence} {offset.sentence}")
    return replace(
        none, fault=fault, sentence=f"{offset.sentence} {none.sentence}", advice=offset.advice
    )


def _unit(
    p: Poses, fault: diagnosis.Fault, what: str, unit: str, ratio: float, T: Array, C: Array,
) -> Hypothesis:  # fmt: skip
    h = simple(p, fault, f"{what} in {unit}", T, C)
    return replace(
        h, sentence=f"The {what} are in {unit}, not in metres: the hand moves {ratio:.4g} times as "
        "far as the camera, and 1 is right.",
        advice="Convert them to metres.", note=f"the {what} were converted to metres.",
    )  # fmt: skip


def prove_reading(
    candidates: Sequence[tuple[str, ArrayLike]],
    Ts_cam_board: ArrayLike,
    *,
    target: Target | None = None,
) -> diagnosis.ReadingProof:
    """Return which reading of a pose file fits the images, for both places of the camera.

    A fixed camera with the poses T is the same equation as a camera in the hand with T inverted:
    such readings are listed as equivalent, and only the size of the frames (a camera or board in
    the hand is nearer than one in the base) says which is likely.

    Args:
        candidates: (name, (n, 4, 4) T_base_ee) of every reading.
        Ts_cam_board: (n, 4, 4) board poses.
        target: for the middle of the board.

    Raises:
        InputError: no candidate, or stacks of different lengths.
    """
    C = se3.check_rigid(Ts_cam_board, "Ts_cam_board").reshape(-1, 4, 4)
    if not candidates:
        raise InputError("prove_reading: no reading was given; at least one is needed.")
    middle = np.zeros(3) if target is None else target.points_board.mean(0)
    modes: tuple[Mode, Mode] = ("eye_in_hand", "eye_to_hand")
    entries: list[tuple[diagnosis.ReadingFit, Array, bool]] = []
    read = [(name, se3.check_rigid(T, name).reshape(-1, 4, 4)) for name, T in candidates]
    # The inverse read for the other place of the camera is the same equation: it is fitted once.
    fits: dict[bytes, FrameFit] = {}
    for (name, T), mode in product(read, modes):
        A = hand_side(T, mode == "eye_in_hand")
        key = (np.round(A, 9) + 0.0).tobytes()
        fit = fits.get(key) or fit_frames(A, C, middle)
        fits[key] = fit
        h = Hypothesis(fault="none", name=f"{name} ({mode})", fit=fit, score=fit.score, T=A,
                       C=C, rows=np.zeros((0, 2), dtype=np.int64))  # fmt: skip
        x, z = np.linalg.norm(fit.X[:3, 3]), np.linalg.norm(fit.Z[:3, 3])
        # What sits in the hand is nearer to it than what stands in the base.
        natural = bool(x < z if mode == "eye_in_hand" else z < x)
        penalised = fit.score * (1 + abs(float(np.log(fit.length_ratio))) / np.log(1.5))
        row = diagnosis.ReadingFit(name=name, mode=mode, evidence=evidence_of(h, True),
                         penalised=penalised)  # fmt: skip
        entries.append((row, A, natural))
    entries.sort(key=lambda e: e[0].penalised * (1.0 if e[2] else 1.01))
    return _proof(entries)


def _proof(entries: list[tuple[diagnosis.ReadingFit, Array, bool]]) -> diagnosis.ReadingProof:
    best, A, natural = entries[0]
    same = [
        e for e in entries[1:]
        if np.allclose(e[1][:, :3, :3], A[:, :3, :3], atol=1e-6)
        and np.allclose(e[1][:, :3, 3], A[:, :3, 3], rtol=1e-6, atol=1e-6)
    ]  # fmt: skip
    others = [e for e in entries[1:] if all(e is not s for s in same)]
    runner = others[0][0] if others else None
    ratio = runner.penalised / max(best.penalised, 1e-12) if runner else float("inf")
    fits = best.evidence.score <= diagnosis.ACCEPT_SCORE
    decisive = bool(fits and ratio >= diagnosis.DECISIVE)
    e = best.evidence
    text = (
        f"Read as {best.name}, {best.mode.replace('_', ' ')}, hand and camera agree to "
        f"{e.view_deg:.2f} deg and {e.view_mm:.1f} mm (median of the views), lengths have the "
        f"ratio {e.length_ratio:.4g}"
    )
    if runner:
        text += f"; the next best, {runner.name} ({runner.mode}), fits {ratio:.1f} times worse"
    text += ". "
    if not fits:
        text += "No reading fits. "
    elif not decisive:
        text += "That is not decisive: say how the poses are written. "
    twin = "a fixed camera" if best.mode == "eye_in_hand" else "a camera in the hand"
    if not natural:
        text += (
            f"The same poses inverted would fit {twin} exactly as well; the size of the frames "
            "speaks against this place of the camera: say where it sits."
        )
    return diagnosis.ReadingProof(
        fits=tuple(entry[0] for entry in entries), best=best.name, best_mode=best.mode,
        equivalent=tuple(f"{s[0].name} ({s[0].mode})" for s in same),
        ratio=float(ratio), decisive=decisive, mode_sure=natural, sentence=text.strip(),
    )  # fmt: skip
