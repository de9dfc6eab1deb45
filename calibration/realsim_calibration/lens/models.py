"""The lens models that are tried, from the pinhole to the rational, and beliefs about a lens.

Which lens model predicts what it has not seen best: cross-validation over views.

A fold's lens and board come from the other folds' views. A left-out view has a pose of its own,
found from one half of its corners; the other half is predicted, and the other way round. In-sample
errors always prefer the largest model; this does not.
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from realsim.arrays import Array, Int64, Mask
from realsim.errors import DegenerateError, InputError
from realsim.records import CameraIntrinsics
from realsim_calibration.fit.view_system import camera_record, camera_vector
from realsim_calibration.lens.bundle import (
    CAMERA_TERMS,
    GLOBALS,
    LensFit,
    Observations,
    Prior,
    State,
    adjust,
    points_in_camera,
    refine_poses,
)
from realsim_calibration.lens.start import is_line

TERM_NAMES = ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")
"""Order of every camera vector and covariance (OpenCV's)."""
MODELS: dict[str, tuple[str, ...]] = {
    "pinhole": (),
    "k1": ("k1",),
    "k1 k2": ("k1", "k2"),
    "k1 k2 p1 p2": ("k1", "k2", "p1", "p2"),
    "Brown 5": ("k1", "k2", "p1", "p2", "k3"),
    "rational 8": ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6"),
}
"""Distortion terms that each model estimates, the smallest model first."""
SMALLEST_RADIUS = 0.1
"""Least half field of view (as a tangent) that the distortion's priors are scaled with."""


FOCAL_SD = 0.02
"""Focal length about the one given in `start`, relative; without a start it is free."""
ASPECT_SD = 0.004
"""fx / fy about 1 (or that of `start`), relative: pixels are square, resampled images nearly.
Without it a print that is too tall cannot be told from such a sensor unless the board rolls."""
CENTER_SD = 0.03
"""Principal point about the image's middle (or that of `start`), in longer image sides."""
RADIAL_SD = (0.25, 0.25, 0.15)
"""Displacement in the image's corner due to k1, k2, k3 (and k4, k5, k6), relative to the
corner's distance from the centre. Stated in the image's corner because k1 means nothing
without the field of view: 0.1 is nothing on a long lens and a fisheye on a wide one."""
TANGENTIAL_SD = 0.004
"""The same of p1 and p2: a lens that is off its axis or tilted."""
BOARD_ASPECT_SD = 0.003
"""Height of the print relative to its width: printers stretch the paper by up to 0.5 %."""
BOARD_WARP_SD = 0.01
"""Bending of the board, lift at its end relative to half its longer side: 1 mm at 0.1 m."""


def corner_radius(camera: Array, image_size: tuple[int, int]) -> float:
    """Return the distance of the farthest image corner from the axis, as a tangent."""
    width, height = image_size
    x = max(camera[2] + 0.5, width - 0.5 - camera[2]) / camera[0]
    y = max(camera[3] + 0.5, height - 0.5 - camera[3]) / camera[1]
    return float(max(np.hypot(x, y), SMALLEST_RADIUS))


def lens_prior(focal: float, image_size: tuple[int, int], start: CameraIntrinsics | None) -> Prior:
    """Return the prior of a lens and a board, all terms free.

    Args:
        focal: rough focal length, which sets the distortion's scale [px].
        image_size: width and height.
        start: known intrinsics, the prior's centre; None = the middle of the image, no distortion.
    """
    width, height = image_size
    mean = np.zeros(GLOBALS)
    mean[:4] = focal, focal, (width - 1) / 2, (height - 1) / 2
    if start is not None:
        mean[:CAMERA_TERMS] = camera_vector(start)
    radius = corner_radius(mean, image_size)
    k = np.array(RADIAL_SD) / radius ** np.array([2, 4, 6])
    # A point at the radius r moves by up to 3 p r^2.
    p = TANGENTIAL_SD / (3 * radius)
    f = np.inf if start is None else FOCAL_SD
    center = CENTER_SD * max(image_size)
    board = [BOARD_ASPECT_SD] + [BOARD_WARP_SD] * 3
    sd = np.array([f, f, center, center, k[0], k[1], p, p, k[2], *k, *board])
    return Prior(mean=mean, sd=sd, aspect_sd=ASPECT_SD, free=np.ones(GLOBALS, dtype=bool))


def free_terms(model: str, held: tuple[str, ...] = (), board: bool = True) -> Mask:
    """Return the mask (16,) of the globals that a model estimates.

    Args:
        model: a name in MODELS.
        held: terms that are held nevertheless.
        board: whether the board's shape is estimated.

    Raises:
        InputError: there is no such model.
    """
    if model not in MODELS:
        raise InputError(
            f"the lens model '{model}' is not known; {', '.join(repr(m) for m in MODELS)} are."
        )
    names = ("fx", "fy", "cx", "cy", *MODELS[model])
    camera = [name in names and name not in held for name in TERM_NAMES]
    return np.array(camera + [board] * (GLOBALS - CAMERA_TERMS))


TINY_PX2 = 1e-20
"""Perfect corners have errors of rounding only, which have no logarithm worth comparing [px^2]."""
HALF_POINTS = 4
"""Corners that each half of a view needs for a pose."""
FOLD_STEPS = 3
"""Solver steps of a fold's lens, after one Newton step from the lens of all views."""
MARGIN_SE = 1.0
"""Standard errors that the smallest acceptable model may be worse than the best."""
WORTH = 0.01
"""Least relative gain in mean square error on unseen views that a larger model must bring: among
six models one beats the others by a standard error now and then by luck."""
POSE_TOLERANCE = 1e-3
"""Predicted decrease [sigma^2] at which a left-out view's pose is found."""


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class ModelScore:
    """How one lens model does."""

    model: str
    terms: tuple[str, ...]
    """Distortion terms it estimates, without those that the views do not determine."""
    held_out_px: float
    """RMS 2-D error on corners of views that the lens has not seen [px]; NaN = not determined."""
    excess: float
    """Mean over views of log(mean square error / that of the best model); 0 for the best."""
    seen_px: float
    """RMS 2-D error in sample [px]."""
    chosen: bool = False


def fold_of_views(obs: Observations, folds: int) -> Int64:
    """Return the fold (views,) of every view, whatever the order they are given in.

    Views are dealt out by how far from the image's middle their corners lie, so that every fold has
    views of all parts of the image.
    """
    middle = (np.array(obs.image_size) - 1) / 2
    square = np.sum((obs.uv - middle) ** 2, -1)
    count = np.maximum(np.diff(obs.offsets), 1)
    rank = np.argsort(np.argsort(obs.per_view(square) / count, kind="stable"))
    return rank % folds


def halves(obs: Observations) -> tuple[Mask, Mask]:
    """Return which half every corner (N,) is in, and which views (views,) have two good halves."""
    rank = np.arange(len(obs.uv)) - obs.offsets[obs.view]
    second = rank % 2 == 1
    good = np.zeros(obs.views, dtype=bool)
    for i, (a, b) in enumerate(zip(obs.offsets[:-1], obs.offsets[1:], strict=True)):
        parts = [obs.flat[a:b][second[a:b] == side] for side in (False, True)]
        good[i] = all(len(p) >= HALF_POINTS and not is_line(p) for p in parts)
    return second, good


def predict_unseen(state: State, obs: Observations, sigma_px: float) -> tuple[Array, Int64]:
    """Return squared errors [px^2] of corners predicted from their view's other half, and counts.

    Args:
        state: a lens and a board that have not seen these views; poses to start from.
        obs: the views.
        sigma_px: 1-sigma of a coordinate, for the robust weights [px].

    Returns:
        (views,) sums and (views,) numbers of corners; 0 where a view is too small to be halved.
    """
    second, good = halves(obs)
    total, count = np.zeros(obs.views), np.zeros(obs.views, dtype=np.int64)
    if not good.any():
        return total, count
    part, kept = obs.only_views(good), second[good[obs.view]]
    start = state.only_views(good)
    for half in (kept, ~kept):
        posed, _ = refine_poses(start, part.only_corners(half), sigma_px, POSE_TOLERANCE)
        rest = part.only_corners(~half)
        total[good] += rest.per_view(_square_errors(posed, rest))
        count[good] += np.diff(rest.offsets)
    return total, count


def _square_errors(state: State, obs: Observations) -> Array:
    from realsim.geometry.camera import project

    uv = project(camera_record(state.camera, obs.image_size), points_in_camera(state, obs))
    return np.sum((uv - obs.uv) ** 2, -1)


def _without(fit: LensFit, train: Mask) -> State:
    """Return the fit's state after one Newton step without the views outside `train`."""
    f = fit.prior.free
    H = (fit.informations[train].sum(0) + fit.prior_information)[np.ix_(f, f)]
    scale = 1 / np.sqrt(np.maximum(np.diag(H), 1e-300))
    step = np.zeros(GLOBALS)
    # At the minimum the training views' gradient and the priors' is minus the others'.
    step[f] = scale * np.linalg.solve(
        H * scale[:, None] * scale, scale * fit.gradients[~train].sum(0)[f]
    )
    return fit.state.moved(step)


def held_out_errors(fit: LensFit, obs: Observations, folds: Int64) -> Array:
    """Return the mean squared error [px^2] of every view (views,), its lens from other folds.

    NaN where a view is too small, infinite where the others do not determine the model.
    """
    errors = np.full(obs.views, np.nan)
    for fold in range(int(folds.max()) + 1):
        test = folds == fold
        try:
            start = _without(fit, ~test)
            trained = adjust(
                start.only_views(~test), obs.only_views(~test), fit.prior, fit.sigma_px,
                most_steps=FOLD_STEPS,
            )  # fmt: skip
            state = replace(trained.state, poses=fit.state.poses[test])
            total, count = predict_unseen(state, obs.only_views(test), fit.sigma_px)
        except (DegenerateError, np.linalg.LinAlgError):
            errors[test] = np.inf
            continue
        errors[test] = np.where(count > 0, total / np.maximum(count, 1), np.nan)
    return errors


def score_models(
    fits: dict[str, tuple[LensFit, tuple[tuple[str, str], ...]]], obs: Observations, folds: Int64
) -> Iterator[ModelScore]:
    """Yield the rows of the table of models (given smallest first), the chosen one marked.

    Chosen is the smallest model whose error is within MARGIN_SE standard errors of the
    best's, or not worth the difference. Models are compared view by view, so what is common to
    all of them does not blur the choice, and in logarithms, so that one blurred view does not
    decide it.

    Args:
        fits: every model's fit, and its (term, reason) that are held.
        obs: the views.
        folds: (views,) fold of every view.
    """
    terms = {
        name: tuple(t for t in MODELS[name] if t not in dict(held))
        for name, (_, held) in fits.items()
    }
    known: dict[tuple[str, ...], Array] = {}
    for name, (fit, _) in fits.items():
        if terms[name] not in known:
            known[terms[name]] = held_out_errors(fit, obs, folds)
    errors = {name: known[terms[name]] for name in fits}
    usable = {n: e for n, e in errors.items() if np.isfinite(e).any() and not np.isinf(e).any()}
    logs = {n: np.log(np.maximum(e[np.isfinite(e)], TINY_PX2)) for n, e in usable.items()}
    best = min(logs, key=lambda n: float(logs[n].mean())) if logs else ""
    chosen = False
    for name, (fit, _) in fits.items():
        held_out, excess, se = (float("nan"),) * 3
        if name in usable:
            difference = logs[name] - logs[best]
            held_out, excess = float(np.nanmean(errors[name])), float(difference.mean())
            se = float(difference.std(ddof=1) / np.sqrt(len(difference)))
        pick = name in usable and not chosen and excess <= max(MARGIN_SE * se, WORTH)
        chosen = chosen or pick
        yield ModelScore(
            model=name,
            terms=terms[name],
            held_out_px=float(np.sqrt(held_out)),
            excess=excess,
            seen_px=float(np.sqrt(np.mean(np.sum(fit.residuals**2, -1)))),
            chosen=pick,
        )
