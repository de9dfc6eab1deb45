"""What the depth images say: points, outlines and rays, against the rendered truth."""

from dataclasses import replace

import numpy as np
import pytest

from realsim.arrays import Array
from realsim.geometry import se3
from realsim.geometry.camera import project
from realsim.geometry.distance_field import DistanceField
from realsim.scanning.scale import shape
from realsim.scanning.scale.config import ShapeConfig
from realsim.scanning.scale.evidence import ScanView
from realsim.scanning.scale.outlines import outline
from scanned_objects import Scanned, evidence_of, gathered, scanned, shape_of, true_state


def outline_px(name: str, lab: str) -> list[tuple[ScanView, Array, Array]]:
    """Return per view the true outline's pixels (N, 2) and its heights over the table (N,) [m]."""
    known, shape, evidence = scanned(name, lab), shape_of(name), evidence_of(name, lab)
    state = true_state(known, shape, evidence)
    rows = []
    for view, T in zip(evidence.views, known.views.Ts_world_cam, strict=True):
        points = outline(shape, state, T, evidence.intrinsics.fx, 400).points
        world = state.s * points @ state.R.T + state.t
        uv = project(evidence.intrinsics, se3.transform(se3.invert(T), world))
        rows.append((view, uv, world[:, 2]))
    return rows


def looked_up(image: Array, view: ScanView, uv: Array) -> Array:
    """Return the values (N,) of a crop's image at pixels (N, 2) of the whole, bilinear."""
    from scipy.ndimage import map_coordinates

    at = (uv - [view.rim.left, view.rim.top])[:, ::-1].T
    return map_coordinates(image, at, order=1, mode="nearest")


@pytest.mark.parametrize("name", ["bunny", "block"])
def test_the_signed_distance_is_zero_at_the_true_outline_within_a_pixel(name: str):
    off: list[Array] = []
    for view, uv, height in outline_px(name, "exact"):
        # What lies low over the table has no depth edge: the foot's outline is not measured.
        d = looked_up(view.rim.distance_px, view, uv[height > 0.015])
        off.append(d)
    d = np.concatenate(off)
    assert len(d) > 500
    assert abs(np.median(d)) < 0.5
    assert np.mean(np.abs(d) < 1.0) > 0.9


def test_without_noise_points_lie_on_the_object_and_on_the_table():
    known = scanned("bunny", "exact")
    field = DistanceField.from_mesh(known.real, 96)
    for view in evidence_of("bunny", "exact").views:
        world = se3.transform(view.T_world_cam, view.points)
        d = field.distance(se3.transform(se3.invert(known.T_world_obj), world))
        assert len(view.points) > 100
        assert np.abs(d).max() < 0.0015
        table = se3.transform(view.T_world_cam, view.table)
        # The object's foot, up to the height at which it is told from the table, is kept off.
        assert np.abs(table[:, 2]).max() < 1e-4
        assert len(view.table) > 100


def test_a_view_that_does_not_see_the_object_is_named():
    known = scanned("block")
    away = replace(known.frames[3], T_world_cam=known.frames[3].T_world_cam
                   @ se3.from_rt(se3.exp_so3([0, np.pi, 0]), [0, 0, 0]))  # fmt: skip
    blind = replace(known.frames[5], depth_m=np.zeros_like(known.frames[5].depth_m))
    frames = (*known.frames[:3], away, known.frames[4], blind, *known.frames[6:])
    evidence = gathered(Scanned(known.real, known.scan, replace(known.views, frames=frames)))
    assert evidence.unseen == (3, 5)
    assert [v.index for v in evidence.views] == [0, 1, 2, 4, 6, 7, 8, 9]


def test_invalid_depth_is_no_depth():
    known = scanned("block")
    spoiled = []
    for f in known.frames:
        z = f.depth_m.copy()
        z[::17, ::13], z[1::17, ::13], z[2::17, ::13] = np.nan, np.inf, -0.3
        spoiled.append(replace(f, depth_m=z))
    views = replace(known.views, frames=tuple(spoiled))
    evidence = gathered(Scanned(known.real, known.scan, views))
    assert np.isfinite(evidence.noise.per_m)
    for v in evidence.views:
        assert np.all(np.isfinite(v.points)) and np.all(v.points[:, 2] > 0)
        assert np.all(np.isfinite(v.table)) and np.all(np.isfinite(v.depth))


# --- The error of the mesh's shape: patches, their covariance, and how probable each size of it is.

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
