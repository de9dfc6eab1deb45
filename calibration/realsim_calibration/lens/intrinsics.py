"""Camera calibration: the lens from pictures of a printed target, with its covariance and limits.

    report = calibrate_intrinsics(detections, target)
    report.intrinsics, report.sd, report.held_out, report.warnings

The steps: corners of all views, checked - Zhang's start - bundle adjustment with the print's shape
- outliers out - is the focal length determined at all? - every lens model, the terms that the views
do not determine held and named - choice of the model on unseen views - covariance by view.
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from realsim.errors import DegenerateError
from realsim.geometry import se3
from realsim.records import CameraIntrinsics, Target
from realsim_calibration.fit.view_system import camera_record, camera_vector
from realsim_calibration.lens.bundle import CAMERA_TERMS, LensFit, Observations, Prior, adjust
from realsim_calibration.lens.checks import intrinsics_checks
from realsim_calibration.lens.covariance import global_covariance
from realsim_calibration.lens.fit import (
    SIGMA_FLOOR_PX,
    Candidate,
    IntrinsicsConfig,
    fit_candidates,
    model_prior,
    robust_sigma,
    settle,
)
from realsim_calibration.lens.models import (
    MODELS,
    ModelScore,
    fold_of_views,
    halves,
    lens_prior,
    score_models,
)
from realsim_calibration.lens.observations import ROUNDS, Corners, find_outliers, gather
from realsim_calibration.lens.report import (
    GOOD_TILT_DEG,
    IntrinsicsReport,
    LensView,
    measure_coverage,
)
from realsim_calibration.lens.start import choose_twins, start_state, view_errors
from realsim_calibration.results import BoardShape
from realsim_calibration.views import TargetDetection

REFERENCE = "Brown 5"
"""The model that everybody expects: its undetermined terms are named even where a smaller one is
chosen, and it says how uncertain the lens is where there were no corners."""
TILT_ADVICE = (
    "Add views that tilt the board by 30 deg about two axes (towards you, away from you, to the "
    "left, to the right), or give the factory's intrinsics (`--intrinsics`; `start` in Python)."
)
FOLDS = 5
"""Parts that the views are split into for the choice of the model."""
CHOICE_VIEWS = 100
"""Views that the model is chosen on where there are more: the choice is clear by then."""
LEAST_SCORED_VIEWS = 5
"""Views from which on a choice by unseen views means something; below it FEW_VIEWS_MODEL."""
FEW_VIEWS_MODEL = "k1 k2"
"""Model for fewer views: held-out errors of three views choose at random."""
FOCAL_LIMIT = 0.03
"""A focal length less certain than this, relative, is refused: it is no calibration."""
LEAST_SPREAD_DEG = 6.0
"""Least angle between the board's normals of some two views, without a start: below it the focal
length hangs on assumptions (a centred principal point, square pixels) alone."""


def calibrate_intrinsics(
    detections: Sequence[TargetDetection],
    target: Target,
    *,
    names: Sequence[str] | None = None,
    start: CameraIntrinsics | None = None,
    config: IntrinsicsConfig | None = None,
) -> IntrinsicsReport:
    """Return a camera's intrinsics from views of a printed target.

    Args:
        detections: the target's points in every image; images without any may be among them.
        target: the print, in metres; its size does not matter to the lens.
        names: the views' names for messages; their numbers where None.
        start: intrinsics known beforehand (the factory's): the fit starts there and its priors are
            centred there. With them a single view is enough for what it can tell.
        config: the choices.

    Raises:
        InputError: image sizes differ, points do not belong to the target or the image, no view.
        DegenerateError: the views do not determine the focal length; the message says what to add.
    """
    config = config or IntrinsicsConfig()
    corners = gather(detections, target, names, start)
    _require_views(corners, start)
    corners, fit, prior, how = _first_fit(corners, start, config)
    corners, fit = _clean(corners, fit, start)
    _check_focal(corners, fit, start, config)
    candidates = fit_candidates(corners.obs, fit, prior, config)
    model, scores = _choose_model(corners.obs, candidates)
    chosen = candidates[model]
    # What the lens may do where there are no corners is what the wider model would do there.
    wider = candidates[REFERENCE] if _is_wider(REFERENCE, model, candidates) else chosen
    report = _report(corners, target, chosen, wider)
    report = replace(report, held_out=scores, start=how)
    return replace(report, checks=intrinsics_checks(report, prior, start))


def _is_wider(name: str, model: str, candidates: dict[str, Candidate]) -> bool:
    order = list(candidates)
    return name in order and order.index(name) > order.index(model)


def _require_views(corners: Corners, start: CameraIntrinsics | None) -> None:
    """Raise unless enough views are left: two, or one with known intrinsics.

    Raises:
        DegenerateError: they are not.
    """
    n = corners.obs.views
    if n >= (2 if start is None else 1):
        return
    reasons = [f"{m}: {r}" for m, r in zip(corners.names, corners.reasons, strict=True) if r]
    if n == 1 and not reasons:
        raise DegenerateError(
            f"camera fit: one view ({corners.name_of(0)}) does not determine a lens. {TILT_ADVICE}"
        )
    shown = "; ".join(reasons[:4]) + ("; ..." if len(reasons) > 4 else "")
    raise DegenerateError(
        f"camera fit: {n} of {len(corners.names)} views can be used ({shown}), which does not "
        "determine a lens. Is the target described as printed (rows, columns, order of the points) "
        f"and whole in the image? {TILT_ADVICE}"
    )


def _first_fit(
    corners: Corners, start: CameraIntrinsics | None, config: IntrinsicsConfig
) -> tuple[Corners, LensFit, Prior, str]:
    """Return a fit with a flexible lens to find outliers with, and the prior of all models.

    Views that fit no camera at all are left out.
    """
    given = None if start is None else camera_vector(start)
    state, how = start_state(corners.obs, given)
    errors = view_errors(state, corners.obs)
    fits = np.isfinite(errors)
    if not fits.all():
        corners = corners.without(~fits, "its corners fit no camera: wrongly found or numbered")
        _require_views(corners, start)
        state, errors = state.only_views(fits), errors[fits]
    obs = corners.obs
    prior = lens_prior(float(state.camera[0]), obs.image_size, start)
    # The misfit of the closed form is taken for noise.
    sigma = max(float(np.median(errors)), SIGMA_FLOOR_PX)
    fit = adjust(state, obs, model_prior(prior, "k1", config), sigma)
    # The beliefs about the distortion need the focal length, which is known well enough by now.
    prior = lens_prior(float(fit.state.camera[0]), obs.image_size, start)
    sigma = robust_sigma(fit.residuals, obs.weight)
    state = choose_twins(fit.state, obs, sigma)
    fit = settle(state, obs, model_prior(prior, "Brown 5", config), sigma)
    return corners, fit, prior, how


def _clean(
    corners: Corners, fit: LensFit, start: CameraIntrinsics | None
) -> tuple[Corners, LensFit]:
    """Return corners and fit without outlier corners and views, which are named."""
    for _ in range(ROUNDS):
        cleaned, keep_views = find_outliers(corners, fit)
        if cleaned is None:
            break
        corners = cleaned
        _require_views(corners, start)
        fit = settle(fit.state.only_views(keep_views), corners.obs, fit.prior, fit.sigma_px)
    return corners, fit


def _check_focal(
    corners: Corners, fit: LensFit, start: CameraIntrinsics | None, config: IntrinsicsConfig
) -> None:
    """Raise unless the views determine the focal length; a start's prior always does.

    Raises:
        DegenerateError: they do not.
    """
    if start is not None:
        return
    coverage = measure_coverage(corners.obs.uv, corners.obs.image_size, fit.state.poses)
    n = corners.obs.views
    if coverage.normal_spread_deg < LEAST_SPREAD_DEG:
        tilt = float(np.median(coverage.tilt_deg))
        how = (
            "face the board squarely" if tilt < GOOD_TILT_DEG / 2
            else f"see the board under the same angle ({tilt:.0f} deg)"
        )  # fmt: skip
        raise DegenerateError(
            f"camera fit: all {n} views {how} (its normals differ by "
            f"{coverage.normal_spread_deg:.1f} deg at most, {LEAST_SPREAD_DEG:g} deg are "
            f"needed), so the focal length cannot be told from the distance. {TILT_ADVICE}"
        )
    prior = model_prior(fit.prior, "k1", config)
    simple = settle(fit.state, corners.obs, prior, fit.sigma_px)
    camera = simple.state.camera
    relative = float(np.max(global_covariance(simple).sd[:2] / camera[:2]))
    if not relative < FOCAL_LIMIT:
        raise DegenerateError(
            f"camera fit: {n} views leave the focal length uncertain by {relative:.1%} (1 sigma; "
            f"{FOCAL_LIMIT:.0%} is the limit), tilts reach "
            f"{float(coverage.tilt_deg.max()):.0f} deg. {TILT_ADVICE}"
        )


def _choose_model(
    obs: Observations, candidates: dict[str, Candidate]
) -> tuple[str, tuple[ModelScore, ...]]:
    """Return the model and the table of all; the table is empty where views are too few."""
    order = list(candidates)
    _, good = halves(obs)
    if int(good.sum()) < LEAST_SCORED_VIEWS:
        return FEW_VIEWS_MODEL if FEW_VIEWS_MODEL in order else order[0], ()
    # Dealing the views out like folds takes some from every part of the image.
    parts = -(-obs.views // CHOICE_VIEWS)
    keep = fold_of_views(obs, parts) == 0
    some = obs.only_views(keep)
    folds = fold_of_views(some, min(FOLDS, some.views))
    fits = {name: (c.fit.only_views(keep, obs), c.refused) for name, c in candidates.items()}
    table = tuple(score_models(fits, some, folds))
    return next((s.model for s in table if s.chosen), order[0]), table


def _report(
    corners: Corners, target: Target, chosen: Candidate, wider: Candidate
) -> IntrinsicsReport:
    """Return the report; the table, the start and the checks are left out."""
    obs, fit, cov = corners.obs, chosen.fit, chosen.covariance
    terms = tuple(t for t in MODELS[chosen.model] if t not in dict(chosen.refused))
    to_middle = se3.from_translation(-np.append(corners.middle, 0.0))
    views: list[LensView] = []
    place = {int(i): k for k, i in enumerate(corners.indices)}
    for i, (name, reason) in enumerate(zip(corners.names, corners.reasons, strict=True)):
        cut = slice(0, 0)
        T = np.full((4, 4), np.nan)
        if i in place:
            k = place[i]
            cut = slice(int(obs.offsets[k]), int(obs.offsets[k + 1]))
            T = fit.state.poses[k] @ to_middle
        r = fit.residuals[cut]
        rms = float(np.sqrt(np.mean(np.sum(r**2, -1)))) if len(r) else float("nan")
        views.append(
            LensView(
                index=i, name=name, used=i in place, reason=reason, uv=obs.uv[cut], residuals=r,
                rms_px=rms, T_cam_board=T, outliers=corners.outliers.get(i, ()),
            )
        )  # fmt: skip
    return IntrinsicsReport(
        target=target,
        intrinsics=camera_record(fit.state.camera, obs.image_size),
        covariance=cov.camera,
        open_covariance=wider.opened.camera,
        inflation=cov.inflation,
        model=chosen.model,
        terms=terms,
        held_out=(),
        refused=tuple(r for r in wider.refused if r[0] not in terms),
        sigma_px=fit.sigma_px,
        rms_px=float(np.sqrt(np.mean(np.sum(fit.residuals**2, -1)))),
        views=tuple(views),
        coverage=measure_coverage(obs.uv, obs.image_size, fit.state.poses),
        board=BoardShape.fitted(
            target,
            np.concatenate([[1.0], fit.state.board]),
            np.concatenate([[0.0], cov.sd[CAMERA_TERMS:]]),
        ),
        start="",
        checks=(),
    )
