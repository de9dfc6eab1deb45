"""Fitting one lens model after the other: sigma from the data, undetermined terms held."""

from dataclasses import dataclass, field, replace

import numpy as np

from realsim.arrays import Array
from realsim.errors import InputError
from realsim.geometry.robust import MAD_TO_SIGMA
from realsim_calibration.fit.view_system import camera_record
from realsim_calibration.lens.bundle import (
    CAMERA_TERMS,
    LensFit,
    Observations,
    Prior,
    SolverConfig,
    State,
    adjust,
)
from realsim_calibration.lens.covariance import GlobalCovariance, border_effect, global_covariance
from realsim_calibration.lens.models import MODELS, TERM_NAMES, free_terms

HOLD_ORDER = ((("k6",), ("k5",), ("k4",), ("k3",), ("k2",), ("k1",)), (("p1", "p2"),))
"""In which order terms are asked whether the views determine them."""


@dataclass(frozen=True, kw_only=True, slots=True)
class IntrinsicsConfig:
    """Choices of a camera calibration."""

    models: tuple[str, ...] = tuple(MODELS)
    """Lens models to choose from, by error on unseen views; one name alone forces it."""
    board_shape: bool = True
    """Whether the print's aspect and bending are estimated: no printed board is flat, and a lens
    fitted to a flat one is wrong by several sigmas."""
    folds: int = 5
    """Parts that the views are split into for the choice of the model."""
    fold_steps: int = 3
    """Solver steps of a fold's lens, after one Newton step from the lens of all views."""
    choice_views: int = 100
    """Views that the model is chosen on where there are more: the choice is clear by then."""
    margin_se: float = 1.0
    """Standard errors that the smallest acceptable model may be worse than the best."""
    worth: float = 0.01
    """Least relative gain in mean square error on unseen views that a larger model must bring:
    among six models one beats the others by a standard error now and then by luck."""
    least_scored_views: int = 5
    """Views from which on a choice by unseen views means something; below it `few_views_model`."""
    few_views_model: str = "k1 k2"
    """Model for fewer views: held-out errors of three views choose at random."""
    sigma_rounds: int = 5
    """Rounds of re-estimating the corners' sigma, at most."""
    sigmasettled: float = 0.02
    """Relative change of sigma from which on it stays."""
    rough_tolerance: float = 0.1
    """Predicted decrease [sigma^2] at which a fit is good enough for re-estimating sigma."""
    sigma_floor_px: float = 1e-5
    """Least sigma [px]: perfect corners exist in simulation only."""
    focal_limit: float = 0.03
    """A focal length less certain than this, relative, is refused: it is no calibration."""
    least_spread_deg: float = 6.0
    """Least angle between the board's normals of some two views, without a start: below it the
    focal length hangs on assumptions (a centred principal point, square pixels) alone."""
    prior_limit: float = 0.7
    """A term whose sigma is more than this share of its prior's was not measured: it is held."""
    border_limit_px: float = 3.0
    """A term that moves the image's border by more than this [px], by one sigma with the others
    following, is held: what it says where there are no corners is invented."""
    measured_sigmas: float = 2.0
    """A term this many sigmas from where it would be held is not held for the border's sake: the
    corners there are contradict holding it."""
    solver: SolverConfig = field(default_factory=SolverConfig)

    def __post_init__(self) -> None:
        """Check the names of the models."""
        if not self.models:
            raise InputError(f"no lens model was given; {', '.join(MODELS)} are known.")
        for name in (*self.models, self.few_views_model):
            free_terms(name)
        if self.folds < 2:
            raise InputError(f"{self.folds} folds were asked for; at least 2 are needed.")


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


def robust_sigma(fit_residuals: Array, weight: Array, floor: float) -> float:
    """Return 1.4826 times the median absolute coordinate [px]."""
    scaled = np.abs(fit_residuals) * np.sqrt(weight)[:, None]
    return max(MAD_TO_SIGMA * float(np.median(scaled)), floor)


def _unit_sigma(fit: LensFit, obs: Observations, config: IntrinsicsConfig) -> float:
    """Return the unit-weight sigma of a robust fit [px]: Huber's weights, degrees of freedom."""
    square = np.sum(fit.residuals**2, -1) * obs.weight
    limit = config.solver.huber_sigmas * fit.sigma_px
    far = np.sqrt(np.maximum(square, limit**2))
    freedom = 2 * len(square) - 6 * obs.views - int(fit.prior.free.sum())
    if freedom <= 0:
        return fit.sigma_px
    sigma = float(np.sqrt(np.sum(square * limit / far) / freedom))
    return max(sigma, config.sigma_floor_px)


def settle(
    state: State, obs: Observations, prior: Prior, sigma: float, config: IntrinsicsConfig
) -> LensFit:
    """Return the fit with its own sigma: fit roughly until sigma stays, then fit."""
    rough = replace(config.solver, tolerance=config.rough_tolerance)
    for _ in range(config.sigma_rounds):
        fit = adjust(state, obs, prior, sigma, rough)
        before, sigma, state = sigma, _unit_sigma(fit, obs, config), fit.state
        if abs(sigma / before - 1) < config.sigmasettled:
            break
    return adjust(state, obs, prior, sigma, config.solver)


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
        full = fit_model(state, obs, model_prior(prior, name, config), fit.sigma_px, config)
        found[name] = _hold_terms(obs, full, name, config)
        state = full.state
    return found


def fit_model(
    state: State, obs: Observations, prior: Prior, sigma: float, config: IntrinsicsConfig
) -> LensFit:
    """Return the fit of a model, its held terms put where they are held."""
    theta = np.where(prior.free, state.theta, prior.mean)
    start = replace(state, camera=theta[:CAMERA_TERMS], board=theta[CAMERA_TERMS:])
    return settle(start, obs, prior, sigma, config)


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
            reasons = {n: _why_refused(fit, covariance, n, obs, config) for n in names}
            if not any(reasons.values()):
                break
            refused |= {n: r or "it goes with the other one" for n, r in reasons.items()}
            prior = model_prior(fit.prior, model, config, tuple(refused))
            fit = fit_model(fit.state, obs, prior, fit.sigma_px, config)
            covariance = global_covariance(fit)
    return Candidate(
        model=model, fit=fit, covariance=covariance, opened=opened, refused=tuple(refused.items())
    )


def _why_refused(
    fit: LensFit,
    covariance: GlobalCovariance,
    name: str,
    obs: Observations,
    config: IntrinsicsConfig,
) -> str:
    """Return why a term is held, empty where it is not."""
    term = TERM_NAMES.index(name)
    sd, belief = float(covariance.sd[term]), float(fit.prior.sd[term])
    at = f"held at {fit.prior.mean[term]:g}"
    if sd > config.prior_limit * belief:
        return (
            f"the views know it to +-{sd:.2g} only, no better than it is known of any lens "
            f"(+-{belief:.2g}): {at}"
        )
    away = abs(float(fit.state.camera[term] - fit.prior.mean[term]))
    if name == "k1" or away > config.measured_sigmas * sd:
        return ""
    camera = camera_record(fit.state.camera, obs.image_size)
    effect = border_effect(camera, covariance.camera, term)
    if np.isinf(effect) and name.startswith("k"):
        return f"with it the lens folds back before the image's border: {at}"
    if np.isfinite(effect) and effect > config.border_limit_px:
        return (
            f"one sigma of it (+-{sd:.2g}) moves the image's border by {effect:.1f} px "
            f"({config.border_limit_px:g} px is the limit), because no corners are there: {at}"
        )
    return ""
