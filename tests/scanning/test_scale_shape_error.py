"""The error of the mesh's shape: patches, their covariance, and how probable each size of it is."""

import numpy as np

from realsim.arrays import Array
from realsim.scanning.scale import shape
from realsim.scanning.scale.config import ShapeConfig
from scanned_objects import shape_of

CONFIG = ShapeConfig()


def patches_of(name: str) -> shape.SurfacePatches:
    return shape_of(name).patches


def modes_of(middles: Array, areas: Array) -> Array:
    """Return shift, turn and growth (7, K, 3) about the surface's middle, by hand."""
    q = middles - areas @ middles
    turns = [np.cross(e, q) for e in np.eye(3)]
    return np.stack([*(np.tile(e, (len(q), 1)) for e in np.eye(3)), *turns, q])


def test_area_weighted_sums_of_the_seven_modes_are_zero():
    """Drawn fields are conditioned by hand (Matheron's rule); their normal parts have this law."""
    patches, length = patches_of("mug"), 0.03
    x, n, a = patches.middles, patches.normals, patches.areas
    k = len(x)
    r = np.sqrt(3) * np.linalg.norm(x[:, None] - x, axis=2) / length
    full = np.kron((1 + r) * np.exp(-r), np.eye(3))
    W = (modes_of(x, a) * a[:, None]).reshape(7, -1)
    conditioned = full - full @ W.T @ np.linalg.solve(W @ full @ W.T, W @ full)
    # All seven sums are zero in every draw ...
    np.testing.assert_allclose(W @ conditioned @ W.T, 0.0, atol=1e-12)
    # ... and what a camera sees of such a field is what the patches' covariance says.
    N = np.zeros((k, 3 * k))
    N[np.repeat(np.arange(k), 3), np.arange(3 * k)] = n.ravel()
    np.testing.assert_allclose(
        shape.covariance_of(patches, length), N @ conditioned @ N.T, atol=1e-8
    )


def drawn(name: str, sigma: float, noise: float, seed: int) -> tuple[Array, Array]:
    """Return information and right side of offsets drawn with 1-sigma, seen with noise [m]."""
    patches = patches_of(name)
    length = CONFIG.lengths[0] * shape.INNER_EXTENT
    S = shape.covariance_of(patches, length)
    S += CONFIG.nugget * shape.within_share(patches, length) ** 2 * np.eye(len(S))
    rng = np.random.default_rng(seed)
    w, V = np.linalg.eigh(S)
    offsets = sigma * V @ (np.sqrt(np.clip(w, 0, None)) * rng.standard_normal(len(w)))
    return np.eye(len(w)) / noise**2, (offsets + noise * rng.standard_normal(len(w))) / noise**2


def test_a_larger_distortion_gives_a_larger_sigma_of_the_right_size():
    means: list[float] = []
    for sigma in (1.5e-4, 4e-4, 1.3e-3, 3.5e-3):
        found = [
            sum(m.probability * m.sigma_m for m in shape.shape_models(
                patches_of("bunny"), *drawn("bunny", sigma, 1e-4, seed), (1.0, shape.INNER_EXTENT),
                CONFIG,
            ))
            for seed in range(8)
        ]  # fmt: skip
        means.append(float(np.mean(found)))
        assert 0.6 * sigma < means[-1] < 1.7 * sigma
    assert np.all(np.diff(means) > 0)


def test_log_probabilities_are_those_of_the_measured_offsets():
    """log p is that of y ~ N(0, S + noise^2) but for a constant."""
    noise, patches = 3e-4, patches_of("block")
    information, offered = drawn("block", 1e-3, noise, 3)
    y = offered * noise**2
    models = shape.shape_models(patches, information, offered, (1.0, shape.INNER_EXTENT), CONFIG)
    log_p = []
    for m in models:
        C = m.covariance + noise**2 * np.eye(len(y))
        log_p.append(-0.5 * np.linalg.slogdet(C)[1] - 0.5 * y @ np.linalg.solve(C, y))
    p = np.exp(np.array(log_p) - max(log_p))
    np.testing.assert_allclose([m.probability for m in models], p / p.sum(), atol=1e-9)
