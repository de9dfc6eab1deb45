"""What is done about a fault in the data: refuse it with advice, mend it, or drop single views."""

from collections.abc import Sequence

from realsim.arrays import Array
from realsim.errors import InputError, UnitError
from realsim.records import Check, Target
from realsim_calibration.detect.visible import DRAWN
from realsim_calibration.faults.diagnose import diagnose
from realsim_calibration.faults.diagnosis import Diagnosis
from realsim_calibration.faults.half_turns import HalfTurns, synchronise_half_turns
from realsim_calibration.faults.motion_check import check_motion
from realsim_calibration.fit.closed_forms import MIN_VIEWS
from realsim_calibration.results import Mode
from realsim_calibration.views import TargetDetection

SINGLE_VIEWS = (
    "mispaired_image", "swapped_images", "frozen_pose", "repeated_image", "duplicated_views",
)  # fmt: skip
"""Faults of single views: these are dropped and named, the others are sound."""
RATIO_OFF = 0.01
"""Lengths of hand and camera that differ by more than this are worth a word."""
UNITS = ("robot_unit", "board_unit", "board_size")
"""Faults of a length."""
SHOWN = 4
"""Rows of evidence in a message."""


def examine(
    Ts_base_ee: Array, Ts_cam_board: Array, labels: Sequence[str], target: Target,
    mode: Mode, nominal: Array | None,
) -> Diagnosis | None:  # fmt: skip
    """Return the diagnosis of the poses, None where there are too few to say anything.

    Raises:
        UnitError: a length is wrong by a unit or the board has another size.
        InputError: another fault that concerns the whole set.
    """
    if len(Ts_base_ee) < MIN_VIEWS + 1:
        return None
    found = diagnose(
        Ts_base_ee, Ts_cam_board, labels=labels, target=target, nominal=nominal, mode=mode,
    )  # fmt: skip
    if found.harmless or found.fault in (*SINGLE_VIEWS, "board_flips"):
        return found
    kind = UnitError if found.fault in UNITS else InputError
    raise kind("hand-eye: " + told(found))


def told(found: Diagnosis) -> str:
    """Return a diagnosis as a paragraph: what, what to do, the figures of what fits better."""
    given = found.evidence[:1]
    better = [e for e in found.evidence[1:SHOWN] if e.score < given[0].score]
    rows = "; ".join(
        f"{e.hypothesis}: {e.view_deg:.2f} deg, {e.view_mm:.1f} mm" for e in (*given, *better)
    )
    tried = f"Misfit of the views: {rows}." if rows else ""
    return " ".join(part for part in (found.sentence, found.advice, tried) if part)


def check_of(found: Diagnosis | None, indices: Sequence[int]) -> Check:
    """Return the check that reports a diagnosis; `indices` are the views' numbers."""
    if found is None:
        return Check(
            name="conventions",
            verdict="unknown",
            sentence="too few views to test conventions and pairing.",
            advice="Take 24 views.",
        )
    off = abs(found.length_ratio - 1)
    good = found.fault in ("none", "tool_offset", "base_turned") and off <= RATIO_OFF
    advice = found.advice
    if off > RATIO_OFF and not advice:
        advice = (
            "Lengths differ: measure the target's squares, and check the camera's focal length "
            "and that the poses are the controller's."
        )
    # Single views are dropped, whatever could have mended them.
    done = f"Left out: {len(found.views)}." if found.fault in SINGLE_VIEWS else found.note
    return Check(
        name="conventions",
        verdict="good" if good else "warn",
        sentence=" ".join(part for part in (found.sentence, done) if part),
        advice=advice,
        value=found.evidence[0].rotation_mismatch_deg if found.evidence else float("nan"),
        unit="deg",
        views=tuple(indices[k] for k in found.views),
    )


def drawings_check(found: Sequence[tuple[int, TargetDetection]]) -> tuple[Check, ...]:
    """Return the check of what is drawn over the target in (view's number, its points)."""
    why = {k: r for k, seen in found for r in seen.rejected if r.startswith(DRAWN)}
    if not why:
        return ()
    sentence, _, advice = next(iter(why.values())).partition(". ")
    return (
        Check(
            name="drawings", verdict="warn", sentence=f"{len(why)} of {len(found)} images: "
            f"{sentence}.", advice=f"{advice}.", value=len(why), views=tuple(why),
        ),
    )  # fmt: skip


def motion_check_of(
    Ts_base_ee: Array, Ts_cam_board: Array, middle: Array, *, eye_in_hand: bool
) -> Check:
    """Return the check of what the motion determines."""
    motion = check_motion(Ts_base_ee, Ts_cam_board, middle, eye_in_hand=eye_in_hand)
    turns = ", ".join(f"{turn:.0f}" for turn in motion.turns_deg)
    place = ", ".join(f"{sd:.2f}" for sd in motion.sd_mm)
    good = (
        f"the hand turns by {turns} deg about its three principal axes (RMS over pairs of views); "
        f"with 1 mm and 0.1 deg per view that allows +-{place} mm along the camera's x, y, z."
    )
    return Check(
        name="motion",
        verdict="warn" if motion.sentences else "good",
        sentence=" ".join(motion.sentences) or good,
        value=float(motion.sd_mm.max()),
        unit="mm",
    )


def half_turned(Ts_base_ee: Array, Ts_cam_board: Array, target: Target) -> HalfTurns | None:
    """Return which boards were numbered from the wrong end, None where the target tells."""
    if not target.half_turn or len(Ts_base_ee) < MIN_VIEWS:
        return None
    points = target.points_board
    turns = synchronise_half_turns(Ts_base_ee, Ts_cam_board, points.mean(0))
    return turns if turns.flips.any() and turns.decisive else None


def renumbered(detection: TargetDetection, target: Target) -> TargetDetection:
    """Return the detection of a target seen turned by 180 deg: its points counted from the end."""
    last = len(target.points_board) - 1
    return TargetDetection(
        point_ids=last - detection.point_ids,
        uv=detection.uv,
        image_size=detection.image_size,
        sd_px=detection.sd_px,
        rejected=detection.rejected,
    )
