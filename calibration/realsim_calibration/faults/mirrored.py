"""The hypothesis that the robot's poses, or the images, are mirrored."""

from dataclasses import replace

import numpy as np

from realsim.arrays import Array
from realsim.geometry import se3
from realsim_calibration.faults.hypotheses import Hypothesis, Poses, simple


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
