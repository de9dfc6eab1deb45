"""Covariances of reconstructed cameras, and which of them disagree with the robot by more.

A free reconstruction may be moved, turned and scaled as a whole; its cameras' covariance is that
of what is left after a similarity to the robot ("inner constraints", Triggs et al., section 9).
"""

from dataclasses import replace

import numpy as np

from realsim.arrays import Array
from realsim.geometry import se3
from realsim.scanning.sfm.bundle import Bundle, picture_information, prior_sigmas
from realsim.scanning.sfm.config import AlignmentConfig, MappingConfig, RobotNoise
from realsim.scanning.sfm.result import Alignment, Geometry, ViewResidual

LEAST_REDUNDANCY = 0.05
"""Share of a prior's variance that a test of it is left with, at least: where the pictures know
nothing of a camera, its residual is zero and so is its variance."""
MIDDLE_CHI2 = 5.348
"""Median of chi^2 with six degrees of freedom."""


def view_residuals(
    names: tuple[str, ...], errors: Array, total: Array, weights: Array, config: AlignmentConfig
) -> tuple[ViewResidual, ...]:
    """Return every view's distance from the robot, tested against its covariance.

    Args:
        names: of the views.
        errors: (V, 6) of each camera against the robot's [rad, m].
        total: (V, 6, 6) their covariances; raised together until the median view fits.
        weights: (V,) with which the views count.
        config: probability of a false alarm.
    """
    from scipy.stats import chi2

    squares = np.einsum("vi,vi->v", errors, np.linalg.solve(total, errors[..., None])[..., 0])
    squares = squares / max(1.0, float(np.median(squares)) / MIDDLE_CHI2)
    limit = float(chi2.isf(config.outlier_probability / len(names), 6))
    mm = 1e3 * np.linalg.norm(errors[:, 3:], axis=1)
    deg = np.degrees(np.linalg.norm(errors[:, :3], axis=1))
    return tuple(
        ViewResidual(
            name=n, offset_mm=float(a), turn_deg=float(b), weight=float(w), chi2=float(q),
            outlier=bool(q > limit),
        )
        for n, a, b, w, q in zip(names, mm, deg, weights, squares, strict=True)
    )  # fmt: skip


def tested_freely(
    alignment: Alignment, found: Geometry, robot: dict[str, Array], config: AlignmentConfig,
    mapping: MappingConfig,
) -> tuple[Alignment, Array]:  # fmt: skip
    """Return the alignment with its views tested, and the cameras' covariances (V, 6, 6).

    Args:
        alignment: of a free reconstruction.
        found: the reconstruction in metres and in the robot's world.
        robot: camera poses by name, of those that have one.
        config: noise of the robot, probability.
        mapping: loss of the observations.
    """
    own = free_covariance(found, config.noise, mapping)
    place = {n: k for k, n in enumerate(found.names)}
    rows = [place[v.name] for v in alignment.views]
    prior = np.diag(prior_sigmas(config.noise) ** 2)
    hand = np.stack([robot[v.name] for v in alignment.views]) @ se3.exp(alignment.hand_eye_twist)
    errors = se3.log(se3.invert(hand) @ found.Ts_world_cam[rows])
    return _replaced(alignment, errors, own[rows] + prior, config), own


def tested_refined(
    alignment: Alignment, bundle: Bundle, priors: Array, config: AlignmentConfig
) -> Alignment:
    """Return the alignment with the views of a refinement tested.

    A residual of a prior has the covariance Sigma - C of the prior's less the result's (Baarda).

    Args:
        alignment: of the refined cameras to the robot's, in the order of the bundle's views.
        bundle: the refinement.
        priors: (V, 4, 4) the robot's camera poses.
        config: noise of the robot, probability.
    """
    sigmas = bundle.prior_factor * prior_sigmas(config.noise)
    hand = priors @ se3.exp(bundle.hand_eye_twist)
    errors = se3.log(se3.invert(hand) @ bundle.geometry.Ts_world_cam)
    relative = _relative_covariances(bundle) / sigmas / sigmas[:, None]
    values, vectors = np.linalg.eigh(np.eye(6) - relative)
    left = np.einsum("vij,vj,vkj->vik", vectors, np.maximum(values, LEAST_REDUNDANCY), vectors)
    return _replaced(alignment, errors, left * sigmas * sigmas[:, None], config)


def free_covariance(geometry: Geometry, noise: RobotNoise, config: MappingConfig) -> Array:
    """Return each camera's covariance (V, 6, 6) about the best similarity [rad, m].

    Args:
        geometry: metric.
        noise: gives the ratio of metres to radians.
        config: loss of the observations.
    """
    views = len(geometry.names)
    unit = np.tile(prior_sigmas(noise), views)
    G = np.linalg.qr(_gauge(geometry) / unit[:, None])[0]
    information = picture_information(geometry, config) * unit * unit[:, None]
    within = information + float(np.trace(information)) / len(unit) * (G @ G.T)
    values, vectors = np.linalg.eigh(within)
    # A camera that no point holds has no information at all: a metre, not infinity.
    values = np.maximum(values, float(unit[3:6].min()) ** 2)
    left = np.eye(len(unit)) - G @ G.T
    C = left @ (vectors / values) @ vectors.T @ left * unit * unit[:, None]
    blocks = C.reshape(views, 6, views, 6)
    return np.stack([blocks[k, :, k] for k in range(views)])


def _gauge(geometry: Geometry) -> Array:
    """Return the right perturbations (6 V, 7) that a turn, a shift and a growth amount to."""
    T = geometry.Ts_world_cam
    Rt = np.swapaxes(T[:, :3, :3], 1, 2)
    away = T[:, :3, 3] - T[:, :3, 3].mean(0)
    J = np.zeros((len(T), 6, 7))
    J[:, :3, :3] = Rt
    J[:, 3:, :3] = -Rt @ se3.hat(away)
    J[:, 3:, 3:6] = Rt
    J[:, 3:, 6] = np.einsum("vij,vj->vi", Rt, away)
    return J.reshape(-1, 7)


def _relative_covariances(bundle: Bundle) -> Array:
    """Return the covariances (V, 6, 6) of the cameras less the hand-eye that they share."""
    C, n = bundle.covariance, len(bundle.covariance) - 6
    shared = C[n:, n:]
    rows: list[Array] = []
    for k in range(0, n, 6):
        cross = C[k : k + 6, n:]
        rows.append(C[k : k + 6, k : k + 6] + shared - cross - cross.T)
    return np.stack(rows)


def _replaced(
    alignment: Alignment, errors: Array, total: Array, config: AlignmentConfig
) -> Alignment:
    names = tuple(v.name for v in alignment.views)
    weights = np.array([v.weight for v in alignment.views])
    return replace(alignment, views=view_residuals(names, errors, total, weights, config))
