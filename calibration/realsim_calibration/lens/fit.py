"""Fitting one lens model after the other: sigma from the data, undetermined terms held."""

from dataclasses import dataclass, replace

import numpy as np

from realsim.arrays import Array
from realsim.errors import InputError
from realsim.geometry.robust import MAD_TO_SIGMA
from realsim_calibration.fit.view_system import camera_record
from realsim_calibration.lens.bundle import (
    CAMERA_TERMS,
    HUBER_SIGMAS,
    LensFit,
    Observations,
    Prior,
    State,
    adjust,
)
from realsim_calibration.lens.covariance import GlobalCovariance, border_effect, global_covariance
from realsim_calibration.lens.models import MODELS, TERM_NAMES, free_terms

HOLD_ORDER = ((("k6",), ("k5",), ("k4",), ("k3",), ("k2",), ("k1",)), (("p1", "p2"),))
"""In which order terms are asked whether the views determine them."""
SIGMA_ROUNDS = 5
"""Rounds of re-estimating the corners' sigma, at most."""
SIGMA_SETTLED = 0.02
"""Relative change of sigma from which on it stays."""
ROUGH_TOLERANCE = 0.1
"""Predicted decrease [sigma^2] at which a fit is good enough for re-estimating sigma."""
SIGMA_FLOOR_PX = 1e-5
"""Least sigma [px]: perfect corners exist in simulation only."""
PRIOR_LIMIT = 0.7
"""A term whose sigma is more than this share of its prior's was not measured: it is held."""
BORDER_LIMIT_PX = 3.0
"""A term that moves the image's border by more than this [px], by one sigma with the others
following, is held: what it says where there are no corners is invented."""
MEASURED_SIGMAS = 2.0
"""A term this many sigmas from where it would be held is not held for the border's sake: the
corners there are contradict holding it."""


@dataclass(frozen=True, kw_only=True, slots=True)
class IntrinsicsConfig:
    """Choices of a camera calibration."""

    models: tuple[str, ...] = tuple(MODELS)
    """Lens models to choose from, by error on unseen views; one name alone forces it."""
    board_shape: bool = True
    """Whether the print's aspect and bending are estimated: no printed board is flat, and a lens
    fitted to a flat one is wrong by several sigmas."""

    def __post_init__(self) -> None:
        """Check the names of the models."""
        if not self.models:
            raise InputError(f"no lens model was given; {', '.join(MODELS)} are known.")
        for name in self.models:
            free_terms(name)


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Candidate:
    """One lens model fitted to all views."""

    model: str
    fit: LensFit
    """With the undetermined terms held."""
    covariance: GlobalCovariance
    opened: GlobalCovariance
    """With all of the model's terms free, under their priors."""
    refused: tuple[tuple[str, str], ...]
    """(term, reason) of the terms that are held."""


def robust_sigma(fit_residuals: Array, weight: Array) -> float:
    """Return 1.4826 times the median absolute coordinate [px]."""
    scaled = np.abs(fit_residuals) * np.sqrt(weight)[:, None]
    return max(MAD_TO_SIGMA * float(np.median(scaled)), SIGMA_FLOOR_PX)


def _unit_sigma(fit: LensFit, obs: Observations) -> float:
    """Return the unit-weight sigma of a robust fit [px]: Huber's weights, degrees of freedom."""
    square = np.sum(fit.residuals**2, -1) * obs.weight
    limit = HUBER_SIGMAS * fit.sigma_px
    far = np.sqrt(np.maximum(square, limit**2))
    freedom = 2 * len(square) - 6 * obs.views - int(fit.prior.free.sum())
    if freedom <= 0:
        return fit.sigma_px
    sigma = float(np.sqrt(np.sum(square * limit / far) / freedom))
    return max(sigma, SIGMA_FLOOR_PX)


def settle(state: State, obs: Observations, prior: Prior, sigma: float) -> LensFit:
    """Return the fit with its own sigma: fit roughly until sigma stays, then fit."""
    for _ in range(SIGMA_ROUNDS):
        fit = adjust(state, obs, prior, sigma, tolerance=ROUGH_TOLERANCE)
        before, sigma, state = sigma, _unit_sigma(fit, obs), fit.state
        if abs(sigma / before - 1) < SIGMA_SETTLED:
            break
    return adjust(state, obs, prior, sigma)


def model_prior(
    prior: Prior, model: str, config: IntrinsicsConfig, held: tuple[str, ...] = ()
) -> Prior:
    """Return a prior with the terms of a model free, but for those that are held."""
    return replace(prior, free=free_terms(model, held, config.board_shape))


def fit_candidates(
    obs: Observations, fit: LensFit, prior: Prior, config: IntrinsicsConfig
) -> dict[str, Candidate]:
    """Return every model fitted to all views, smallest first, undetermined terms held."""
    found: dict[str, Candidate] = {}
    state = fit.state
    for name in (name for name in MODELS if name in config.models):
        full = fit_model(state, obs, model_prior(prior, name, config), fit.sigma_px)
        found[name] = _hold_terms(obs, full, name, config)
        state = full.state
    return found


def fit_model(state: State, obs: Observations, prior: Prior, sigma: float) -> LensFit:
    """Return the fit of a model, its held terms put where they are held."""
    theta = np.where(prior.free, state.theta, prior.mean)
    start = replace(state, camera=theta[:CAMERA_TERMS], board=theta[CAMERA_TERMS:])
    return settle(start, obs, prior, sigma)


def _hold_terms(obs: Observations, fit: LensFit, model: str, config: IntrinsicsConfig) -> Candidate:
    """Return the model with the terms held that the views do not determine.

    Radial terms go from the highest order down, until one is determined: a lower one without a
    higher one is a lens, the other way round is not. p1 and p2 go together.
    """
    covariance = opened = global_covariance(fit)
    refused: dict[str, str] = {}
    for order in HOLD_ORDER:
        for names in order:
            if not set(names) <= set(MODELS[model]):
                continue
            reasons = {n: _why_refused(fit, covariance, n, obs) for n in names}
            if not any(reasons.values()):
                break
            refused |= {n: r or "it goes with the other one" for n, r in reasons.items()}
            prior = model_prior(fit.prior, model, config, tuple(refused))
            fit = fit_model(fit.state, obs, prior, fit.sigma_px)
            covariance = global_covariance(fit)
    return Candidate(
        model=model, fit=fit, covariance=covariance, opened=opened, refused=tuple(refused.items())
    )


def _why_refused(fit: LensFit, covariance: GlobalCovariance, name: str, obs: Observations) -> str:
    """Return why a term is held, empty where it is not."""
    term = TERM_NAMES.index(name)
    sd, belief = float(covariance.sd[term]), float(fit.prior.sd[term])
    at = f"held at {fit.prior.mean[term]:g}"
    if sd > PRIOR_LIMIT * belief:
        return (
            f"the views know it to +-{sd:.2g} only, no better than it is known of any lens "
            f"(+-{belief:.2g}): {at}"
        )
    away = abs(float(fit.state.camera[term] - fit.prior.mean[term]))
    if name == "k1" or away > MEASURED_SIGMAS * sd:
        return ""
    camera = camera_record(fit.state.camera, obs.image_size)
    effect = border_effect(camera, covariance.camera, term)
    if np.isinf(effect) and name.startswith("k"):
        return f"with it the lens folds back before the image's border: {at}"
    if np.isfinite(effect) and effect > BORDER_LIMIT_PX:
        return (
            f"one sigma of it (+-{sd:.2g}) moves the image's border by {effect:.1f} px "
            f"({BORDER_LIMIT_PX:g} px is the limit), because no corners are there: {at}"
        )
    return ""
