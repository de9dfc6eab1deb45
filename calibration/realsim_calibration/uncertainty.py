"""How far the estimate may be off, and how well it predicts views it has not seen.

Everything is one Newton step from the joint fit. With H the information of the whole graph (robot
errors eliminated), H_i and c_i the information and negative gradient of view i, the fit without
view i is

    theta_-i = theta - (H - H_i)^-1 c_i .

The covariance is the cluster-robust (jackknife, CR3) one over views plus the priors' own share,

    J = (n - 1) / n  sum_i (theta_-i - theta)(theta_-i - theta)^T  +  H^-1 Lambda H^-1 ,

because the error of a robot pose is shared by all corners of a view: corners are not independent
observations, views are. From few views J itself is noisy; it is averaged with the graph's marginal
covariance H^-1 scaled to the same size, kappa = tr(H_X J_X) / 6 on the block of X:

    Cov = (J + max(kappa, 1) H^-1) / 2 + Cov_sys .

Neither sees an error that all views share: an arm's kinematic error is a smooth function of its
pose, part of which looks exactly like another hand-eye. Cov_sys considers it (Schmidt): a robot
error e_i of view i acts like a change Ad(X^-1) e_i of X in that view alone, so it moves the fit by

    dtheta = H^-1 sum_i H_i[:, X] Ad(X^-1) e_i ,    e_i = B_i w ,    w ~ N(0, P) ,

with B_i an error constant in the tool and linear in the pose's features (position, rotation
matrix), as in the robot error map of the joint formulation. P has the size of the residuals that
are seen through the robot pose, times the share of their variance that is taken to be smooth.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from realsim.errors import DegenerateError
from realsim.geometry import se3
from realsim.records import CameraIntrinsics
from realsim_calibration.joint_solve import (
    JointFit,
    JointState,
    ViewCorners,
    camera_of,
    view_residuals,
)

Array = NDArray[np.float64]
SMOOTH_SHARE = 0.25
"""Share of the residuals' variance that is taken to be a smooth kinematic error. With it the
normalised error squared of the simulated lab (joint zeros 0.2 mrad, links 0.1 mm, 8 seeds) has a
median near 3 and a maximum near 13 for 6 degrees of freedom; with none it was 20 and 204."""
FEATURE_SD_FLOOR = 1e-6
"""A feature of the pose that varies less [m or 1] does not vary."""


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Uncertainty:
    """Covariances and predictions of one joint fit."""

    covariance: Array
    """(25, 25) of theta = X, Z, camera, scale; the honest one."""
    marginal: Array
    """(25, 25) H^-1, which trusts the noise model of the graph."""
    inflation: float
    """kappa: mean ratio of the two variances of X."""
    seen_px: Array
    """(views,) RMS of each view through the robot pose, e_i = 0 [px]."""
    unseen_px: Array
    """(views,) the same predicted by the fit without the view [px]."""


def estimate_uncertainty(
    fit: JointFit, views: list[ViewCorners], intrinsics0: CameraIntrinsics
) -> Uncertainty:
    """Return covariances and leave-one-view-out predictions.

    Raises:
        DegenerateError: the fit falls apart when one view is left out.
    """
    H = fit.informations.sum(0) + fit.prior
    try:
        marginal = np.linalg.inv(H)
        away = -np.linalg.solve(H - fit.informations, fit.pulls[..., None])[..., 0]
    except np.linalg.LinAlgError as error:
        raise DegenerateError(
            "hand-eye: without one of the views the fit is no longer determined. Add views."
        ) from error
    n = len(views)
    jackknife = (n - 1) / n * away.T @ away + marginal @ fit.prior @ marginal
    x = slice(0, 6)
    kappa = float(np.trace(np.linalg.solve(marginal[x, x], jackknife[x, x])) / 6)
    covariance = (jackknife + max(kappa, 1.0) * marginal) / 2
    seen_px = np.array([_px(v, fit.state, intrinsics0) for v in views])
    covariance += _systematic(fit, views, marginal, float(np.sqrt(np.mean(seen_px**2))))
    return Uncertainty(
        covariance=(covariance + covariance.T) / 2,
        marginal=marginal,
        inflation=kappa,
        seen_px=seen_px,
        unseen_px=np.array(
            [_px(v, moved(fit.state, a), intrinsics0) for v, a in zip(views, away, strict=True)]
        ),
    )


def _systematic(fit: JointFit, views: list[ViewCorners], marginal: Array, rms_px: float) -> Array:
    """Return Cov_sys (25, 25): what a smooth robot error of the residuals' size does to the fit."""
    A = np.stack([v.T_base_ee for v in views])
    to_cam = se3.adjoint(se3.invert(fit.state.T_ee_cam))
    features = np.concatenate([A[:, :3, 3], A[:, :3, :3].reshape(-1, 9)], axis=1)
    features = (features - features.mean(0)) / np.maximum(features.std(0), FEATURE_SD_FLOOR)
    influence = marginal @ fit.informations[:, :, :6] @ to_cam  # (views, 25, 6): dtheta / d e_i
    T_board_cam = se3.invert(fit.state.T_base_board) @ A @ fit.state.T_ee_cam
    distance = float(np.median(np.linalg.norm(T_board_cam[:, :3, 3], axis=1)))
    rad = np.sqrt(SMOOTH_SHARE) * rms_px / fit.state.camera[0]
    sd = np.repeat([rad, rad * distance], 3)
    constant = influence.sum(0) * sd
    total = constant @ constant.T
    # Linear errors are in base axes, rotation and translation alike; e_i is in the tool's.
    to_tool = np.zeros((len(A), 6, 6))
    to_tool[:, :3, :3] = to_tool[:, 3:, 3:] = np.swapaxes(A[:, :3, :3], 1, 2)
    in_base = influence @ to_tool
    for column in features.T:
        effect = np.einsum("n,nij->ij", column, in_base) * sd / np.sqrt(features.shape[1])
        total = total + effect @ effect.T
    return total


def moved(state: JointState, step: Array) -> JointState:
    """Return the state after a step (25,) of theta; robot errors stay."""
    return JointState(
        T_ee_cam=state.T_ee_cam @ se3.exp(step[:6]),
        T_base_board=state.T_base_board @ se3.exp(step[6:12]),
        camera=state.camera + step[12:24],
        scale=state.scale + float(step[24]),
        errors=state.errors,
    )


def _px(view: ViewCorners, state: JointState, intrinsics0: CameraIntrinsics) -> float:
    """Return a view's reprojection RMS through the robot pose [px]."""
    camera = camera_of(state.camera, intrinsics0)
    X, Z = state.T_ee_cam, state.T_base_board
    r, _ = view_residuals(view, X, Z, np.eye(4), camera, state.scale)
    return float(np.sqrt(np.mean(np.sum(r.reshape(-1, 2) ** 2, -1))))
