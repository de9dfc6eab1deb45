"""What is known of the unknowns of the joint fit before any point is looked at.

A camera in the hand shares hand-eye and depth bias with all other views of it, and is off by what
the arm is off by; a camera that stands still is as sure as its calibration says, and has a depth
bias of its own.
"""

from collections.abc import Sequence

import numpy as np

from realsim.arrays import Array, Mask
from realsim.geometry.normal_equations import System, add_prior, covariances
from realsim.records.calibration import DepthBias
from realsim.registration.refinement.config import RefineConfig
from realsim.registration.refinement.equations import BIAS, HAND_EYE, TABLE_AT, State, object_at
from realsim.registration.views import ViewPoints

OF_VIEW, KINDS = 7, (3, 3, 1)
"""Unknowns of a view: a turn, a shift, an offset of its inverse depth."""
OF_FIXED = 8
"""Where a camera stands still: a scale of its inverse depth, too."""
LEAST_SIGMA = (np.radians(1e-3), 1e-5, 1e-5)
"""Least prior 1-sigma of a turn [rad], a shift [m], an offset [1/m]: nothing is perfect."""
FIXED = 1e-9
"""1-sigma of an unknown that is held [its unit]."""


def add_priors(
    system: System, state: State, views: Sequence[ViewPoints], config: RefineConfig, sigmas: Array
) -> None:
    """Add what is known of hand-eye, views, bias and table, and hold what nothing says.

    Args:
        system: added to.
        state: where the unknowns stand.
        views: whose camera each is.
        config: settings.
        sigmas: of the hand's views, as `said_sigmas` gives them.
    """
    p = config.prior
    hand = np.repeat([np.radians(p.hand_eye_deg), p.hand_eye_mm / 1e3], 3)
    add_prior(system, HAND_EYE, state.hand_eye, np.diag(1.0 / np.square(hand)))
    own = view_precisions(views, sigmas, config)
    system.D[:] += own
    system.d[:] -= np.einsum("vi,vij->vj", state.views, own)
    W = _bias_precision(config.bias, config)
    said = np.array([config.bias.scale, config.bias.offset_per_m])
    add_prior(system, BIAS, state.bias - said, W)
    free = 1.0 / np.radians(config.free_turn_deg) ** 2
    for k in range(len(state.poses)):
        turn, shift = np.split(object_at(k), 2)
        system.A[turn, turn] += free
        # An object without points stays where it is.
        system.A[shift, shift] += 1.0
    system.A[TABLE_AT, TABLE_AT] += 1.0


def _bias_precision(bias: DepthBias, config: RefineConfig) -> Array:
    """Return the prior's precision (2, 2) of a depth bias: its calibration's, or a usual one."""
    if not config.fit_bias:
        return np.eye(2) / FIXED**2
    C = bias.covariance
    if not np.any(C):
        C = np.diag([config.unmeasured_scale**2, config.unmeasured_offset_per_m**2])
    return np.asarray(np.linalg.inv(C), np.float64)


def view_precisions(views: Sequence[ViewPoints], sigmas: Array, config: RefineConfig) -> Array:
    """Return the prior's precision (V, n, n) of every view's unknowns.

    A camera that stands still is as sure as its calibration says; a camera in the hand has no scale
    of its own.
    """
    n = OF_VIEW if all(v.fixed is None for v in views) else OF_FIXED
    W = np.zeros((len(views), n, n))
    W[:, :OF_VIEW, :OF_VIEW] = np.diag(
        1.0 / np.square(np.repeat(np.maximum(sigmas, LEAST_SIGMA), KINDS))
    )
    W[:, OF_VIEW:, OF_VIEW:] = 1.0 / FIXED**2
    for k, view in enumerate(views):
        if (camera := view.fixed) is not None:
            said = np.array([np.radians(camera.sigma_deg), camera.sigma_mm / 1e3])
            twist = np.repeat(np.maximum(said, LEAST_SIGMA[:2]), KINDS[:2])
            W[k, :6, :6] = np.diag(1.0 / np.square(twist))
            # The bias has its scale first, a view its offset.
            W[k, 6:, 6:] = _bias_precision(camera.bias, config)[::-1, ::-1]
    return W


def learn_sigmas(
    system: System, state: State, hand: Mask, config: RefineConfig, sigmas: Array
) -> Array:
    """Return the 1-sigma of the turns and shifts of the hand's views [rad, m]: one step of EM."""
    p = config.prior
    if not p.learn_views or np.count_nonzero(hand) < p.learn_from:
        return sigmas
    C = covariances(system).views
    spread = (np.square(state.views) + np.diagonal(C, axis1=1, axis2=2))[hand, :OF_VIEW]
    found = np.sqrt([part.mean() for part in np.split(spread, np.cumsum(KINDS)[:-1], axis=1)])
    said = said_sigmas(config)
    return np.clip(found, p.learn_factor[0] * said, p.learn_factor[1] * said)


def said_sigmas(config: RefineConfig) -> Array:
    """Return the 1-sigma of a view's turn [rad], shift [m] and offset [1/m] before it is learnt."""
    p = config.prior
    return np.array([np.radians(p.view_deg), p.view_mm / 1e3, p.view_offset_per_m])
