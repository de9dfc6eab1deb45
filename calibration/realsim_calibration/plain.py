"""The camera's place for programs that know no robot map, chosen by what unseen views say.

Such a program moves the arm to a pose, takes the controller's word for it, and multiplies with one
fixed X. Candidates are the joint fits without a map (`effective.plain_fits`) and the closed forms
with the lens as given and the board as drawn; each predicts views that it has not seen, without a
map. The closed forms are fitted anew without groups of views only where they might win: in sample
they are never worse than on unseen views.
"""

from dataclasses import dataclass

import numpy as np

from realsim.arrays import Array
from realsim.errors import DegenerateError
from realsim.geometry import se3
from realsim.records import CameraIntrinsics
from realsim_calibration.fit.closed_forms import CLOSED_FORMS
from realsim_calibration.fit.robust_fit import Solution
from realsim_calibration.fit.view_system import camera_record
from realsim_calibration.screening import Screened, stacks, view_px

GROUPS = 20
"""Views are left out one by one, or in so many groups."""


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Plain:
    """X, Z and the lens that serve a program without a robot map."""

    name: str
    """The chosen one of `scores`."""
    scores: tuple[tuple[str, float], ...]
    """(candidate, RMS of the unseen views without a map [px])."""
    X: Array
    covariance: Array
    """(6, 6) of X, absolute."""
    here_covariance: Array
    """(6, 6) of X, for this arm as it moves here."""
    Z: Array
    intrinsics: CameraIntrinsics


def choose_plain(
    solution: Solution, screened: Screened, intrinsics0: CameraIntrinsics
) -> Plain:  # fmt: skip
    """Return the candidate of least held-out error.

    Covariances are those of the joint fit without a map; another candidate's distance from it is
    added as if it were an error.

    Args:
        solution: the joint fits.
        screened: the views that took part, and the closed forms' errors in sample.
        intrinsics0: the lens of the closed forms.
    """
    scores = {fit.name: fit.held_out_px for fit in solution.plain}
    fit = min(solution.plain, key=lambda f: f.held_out_px)
    X, Z = fit.state.X, fit.state.Z
    camera = camera_record(fit.state.camera, (intrinsics0.width, intrinsics0.height))
    name, best = fit.name, fit.held_out_px
    for closed, in_sample in screened.starts:
        scores[closed] = in_sample
        if in_sample >= best:
            continue
        scores[closed] = _held_out_px(closed, screened, intrinsics0)
        if scores[closed] < best:
            name, best, camera = closed, scores[closed], intrinsics0
            X, Z = CLOSED_FORMS[closed](*stacks(screened.candidates))
    off = se3.log(se3.invert(solution.alone.X) @ X)
    apart = np.outer(off, off)
    return Plain(
        name=name, scores=tuple(scores.items()), X=X, Z=Z, intrinsics=camera,
        covariance=solution.alone_covariance[:6, :6] + apart,
        here_covariance=solution.alone_here_covariance + apart,
    )  # fmt: skip


def _held_out_px(closed: str, screened: Screened, intrinsics: CameraIntrinsics) -> float:
    """Return the RMS [px] of all views, each predicted by a closed form without its group."""
    A, C = stacks(screened.candidates)
    groups = np.arange(len(A)) % min(GROUPS, len(A))
    px: list[Array] = []
    for group in range(int(groups.max()) + 1):
        try:
            X, Z = CLOSED_FORMS[closed](A[groups != group], C[groups != group])
        except DegenerateError:
            return float("inf")
        left = [c for c, g in zip(screened.candidates, groups, strict=True) if g == group]
        px.append(view_px(left, X, Z, intrinsics))
    return float(np.sqrt(np.mean(np.concatenate(px) ** 2)))
