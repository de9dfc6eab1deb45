"""What a person is told about poses that depth does not agree with."""

from collections.abc import Sequence

import numpy as np

from realsim.registration.odometry.faults import PoseFault
from realsim.registration.odometry.mismatch import Mismatch

AXES = ("x (to the image's right)", "y (down in the image)", "z (along the line of sight)")


def fault_words(fault: PoseFault, numbers: Sequence[int]) -> str:
    """Return a sentence about a wrong view, or about what changed from a view on."""
    size = f"{fault.mm:.1f} mm / {fault.deg:.1f} deg"
    view = numbers[fault.place]
    if fault.kind == "view":
        return (
            f"view {view}: its depth disagrees with its robot pose by {size}; its neighbours "
            "agree: it was taken while moving, or image and pose are not of the same view."
        )
    either = " (it may as well be " if fault.alternative else ""
    if fault.kind == "mount":
        axis = AXES[int(np.argmax(np.abs(fault.twist[:3])))]
        other = f"{either}the table or the robot's base that was moved)" if either else ""
        return (
            f"from view {view} on: the camera's mount slipped by about {size}, mostly about its "
            f"axis {axis}{other}; fix it, and calibrate again from view {view} on."
        )
    other = f"{either}the camera's mount that slipped)" if either else ""
    return (
        f"from view {view} on: the table, the robot's base or all objects were moved by about "
        f"{size}{other}; treat the views from {view} on as another scene."
    )


def mismatch_words(mismatch: Mismatch, numbers: Sequence[int]) -> str:
    """Return a sentence about images at wrong poses."""
    view = numbers[mismatch.place]
    if mismatch.kind == "swapped":
        return f"the images (or poses) of views {view} and {numbers[mismatch.other]} are swapped."
    if mismatch.kind == "other":
        return (
            f"view {view}: its image fits the pose of view {numbers[mismatch.other]}; image and "
            "pose are not of the same view."
        )
    by = abs(mismatch.other)
    ahead = mismatch.other > 0
    lost = "an image was skipped" if ahead else "a pose was skipped, or an image came twice"
    return (
        f"from view {view} on: every image fits the pose {by} {'later' if ahead else 'earlier'} in "
        f"the list; {lost} there."
    )


def unmatched_words(view: int) -> str:
    """Return a sentence about a view that could be aligned with none."""
    return (
        f"view {view}: its depth fits nothing that the views around it see; it is of another "
        "scene, something was moved, or its pose is off by more than 3 cm."
    )
