"""What a person should know of several cameras calibrated together."""

from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np

from realsim.records import Check
from realsim_calibration.cameras.results import ROBOT_BASE, CamerasReport
from realsim_calibration.lens.observations import named
from realsim_calibration.results import HandEyeReport

TOGETHER_MM = (2.0, 6.0)
"""Board's middle seen by two cameras at once: as the held-out limits of one camera."""
FEW_VIEWS = (4, 1)
"""Views of a camera: its place then rests on few of them."""
NAMED = 4


def rig_checks(report: CamerasReport) -> tuple[Check, ...]:
    """Return the checks of the cameras together."""
    return (*_few_views(report), *_pairs(report), *_arm(report), *_odd(report), *_base(report))


def armless_checks(
    checks: Sequence[Check], own: HandEyeReport, reference: str
) -> tuple[Check, ...]:
    """Return a camera's checks where no arm gives metres or a base: what they say of one goes.

    Args:
        checks: as of a camera with an arm.
        own: the camera's report.
        reference: the camera that all places are in; empty for that camera itself.
    """
    kept = [c for c in checks if c.name not in {"uncertainty elsewhere", "board size"}]
    place = Check(
        name="uncertainty", verdict="good", value=own.here_mm, unit="mm",
        sentence=f"in camera '{reference}' its place is known to {own.here_mm:.2f} mm and "
        f"{own.here_deg:.3f} deg (1 sigma, worst axis); the board's size, which no arm's metres "
        "prove, is part of it.",
        advice="Measure the board's squares with a calliper.",
    )  # fmt: skip
    return tuple(
        replace(place, verdict=c.verdict) if c.name == "uncertainty" else c
        for c in kept
        if reference or c.name != "uncertainty"
    )


def _few_views(r: CamerasReport) -> Iterator[Check]:
    for camera, own in zip(r.rig.cameras, r.cameras, strict=True):
        used = sum(v.used for v in r.views if v.camera == camera.name)
        if used < FEW_VIEWS[0]:
            yield Check(
                name="few views", verdict="warn", value=used,
                sentence=f"camera '{camera.name}' is placed by {used} view{'s' * (used != 1)} "
                f"only (1 sigma {own.sigma_mm:.2f} mm).",
                advice="Let it see the board at more instants.",
            )  # fmt: skip


def _pairs(r: CamerasReport) -> Iterator[Check]:
    for pair in r.pairs:
        if not np.isfinite(pair.apart_mm) or pair.apart_mm <= TOGETHER_MM[0]:
            continue
        bad = pair.apart_mm > TOGETHER_MM[1]
        yield Check(
            name="pair", verdict="bad" if bad else "warn", value=pair.apart_mm, unit="mm",
            sentence=f"cameras '{pair.names[0]}' and '{pair.names[1]}' see the board "
            f"{pair.apart_mm:.2f} mm apart (RMS of {pair.together} instants; worst: "
            f"{pair.worst}).",
            advice="Are their images of the same moment? Look at the instant named.",
        )  # fmt: skip


def _arm(r: CamerasReport) -> Iterator[Check]:
    if not r.bad_arm:
        return
    names = named(r.bad_arm, NAMED)
    yield Check(
        name="arm poses", verdict="warn", value=len(r.bad_arm),
        sentence=f"all cameras contradict the arm's pose at {names}; there the cameras "
        "alone were used.",
        advice="Was the arm still moving, or is it another instant's pose?",
    )  # fmt: skip


def _odd(r: CamerasReport) -> Iterator[Check]:
    odd = r.disagreeing()
    if not odd:
        return
    names = named([f"{v.name} ({v.unseen_px:.2f} px)" for v in odd], NAMED)
    yield Check(
        name="views that disagree", verdict="warn", value=len(odd),
        sentence=f"predicted three times worse than their camera's other views: {names}.",
        advice="Check these images: is one blurred, did the board move, was the arm at rest?",
        views=tuple(v.instant for v in odd),
    )  # fmt: skip


def _base(r: CamerasReport) -> Iterator[Check]:
    if r.reference == ROBOT_BASE:
        return
    yield Check(
        name="reference", verdict="warn",
        sentence=f"no arm ties the cameras to a robot: all places are in camera "
        f"'{r.reference}'.",
        advice="If you need the robot's base, let the arm carry a board in view "
        "(--held-board), or add a camera in the hand.",
    )  # fmt: skip
