"""What a scale fit adds to registration's equations: derivatives are the residuals' differences."""

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import pytest

from realsim.arrays import Array
from realsim.geometry import se3
from realsim.geometry.camera import project
from realsim.geometry.distance_field import DistanceField
from realsim.geometry.normal_equations import System, symmetric
from realsim.registration.refinement.equations import OBJECTS, TABLE_AT, Blocks, Offsets, assemble
from realsim.scanning.scale import equations, shape
from realsim.scanning.scale.config import ScaleConfig, ShapeConfig
from realsim.scanning.scale.evidence import ScanView
from realsim.scanning.scale.outlines import COLUMNS, Rims, add_outline, outline
from realsim.scanning.scale.shape import ScanShape
from realsim.scanning.scale.state import OBJECT, PATCHES, RIM, SIZE, ScaleState, moved_state
from scanned_objects import Scanned, evidence_of, gathered, scanned, shape_of, true_state
from table_faults import without_any_depth

STEP = 1e-6
SHARED = PATCHES + 1
"""Unknowns of one patch: registration's, size, outlines' offset, the patch's offset."""


def posed(rng: np.random.Generator) -> ScaleState:
    """Return an object of about 90 mm anywhere, seen by one camera."""
    T = se3.from_rt(se3.random_rotation(rng), rng.uniform(-0.3, 0.3, 3))
    return ScaleState(
        s=0.9, poses=T[None], hand_eye=np.zeros(6), views=np.zeros((1, 6)),
        bias=np.array([1.0, 0.0]), rim=0.0,
        T_world_table=T @ se3.from_rt(se3.exp_so3(0.3 * rng.standard_normal(3)), [0, 0, -0.05]),
    )  # fmt: skip


def camera_looking_at(point: Array, rng: np.random.Generator) -> Array:
    eye = point + rng.uniform(0.25, 0.45) * (d := rng.standard_normal(3)) / np.linalg.norm(d)
    return se3.look_at(eye, point) @ se3.from_translation(rng.uniform(-0.04, 0.04, 3))


def differences(residual, state: ScaleState) -> Array:
    """Return the central differences (SHARED + 6,) of residual(state), of a view's twist last."""
    out = np.zeros(SHARED + 6)
    for k in range(SHARED + 6):
        step = np.zeros(SHARED + 6)
        step[k] = STEP
        plus, minus = (
            residual(moved_state(state, sign * step[:SHARED], sign * step[None, SHARED:]))
            for sign in (1.0, -1.0)
        )
        out[k] = (plus - minus) / (2 * STEP)
    return out


def row_of(system: System, at: int = PATCHES, sign: float = 1.0) -> tuple[float, Array]:
    """Return residual and derivatives of a system that one measurement made.

    Args:
        system: its equations.
        at: an unknown by which the derivative is one, the patch's own for example...
        sign: ...or minus one.
    """
    joint = np.block([[system.A, system.B[0]], [system.B[0].T, system.D[0]]])
    right = np.concatenate([system.a, system.d[0]])
    w = joint[at, at]
    J = sign * joint[at] / w
    np.testing.assert_allclose(joint, w * np.outer(J, J), rtol=1e-6, atol=1e-7 * w)
    np.testing.assert_allclose(right, sign * J * right[at], rtol=1e-6, atol=1e-9 * w)
    return -sign * float(right[at]) / w, J


def surface_row(shape: ScanShape, state: ScaleState, T: Array, point: Array) -> tuple[float, Array]:
    """Return the row of one measured point (3,) of the object, in camera axes."""
    views = np.zeros(1, np.int32)
    held = equations.Round(
        points=point[None], views=views, variance=np.full(1, 1e-8), crowding=np.ones(1),
        ids=np.zeros(1, np.int64), rims=Rims(points=[], ids=[], factors=[]),
    )  # fmt: skip
    seen, Ms = equations.object_distances(shape, state, state.cameras(T[None]), point[None], views)
    blocks, kernels = equations.surface_blocks(seen, Ms, held, (np.zeros(1), 1e6, 0.0))
    if kernels[0] == 0.0:
        return np.nan, np.full(SHARED + 6, np.nan)
    r, J = row_of(assemble([blocks], SHARED), PATCHES, -1.0)
    assert r == pytest.approx(seen[1][0], abs=1e-9)
    return r, J


def seen_points(shape: ScanShape, state: ScaleState, T: Array, n: int) -> Iterator[Array]:
    """Yield points (3,) in camera axes at which the field is zero, seen by the camera."""
    eye, R = T[:3, 3], T[:3, :3]
    aim = (state.s * shape.samples @ state.R.T + state.t - eye) @ R
    rays = (aim / aim[:, 2:])[np.random.default_rng(5).permutation(len(aim))[:n]]
    depths = shape.cast(eye, (rays @ R.T).astype(np.float32), state.s, state.R, state.t)
    for ray, depth in zip(rays, depths.astype(np.float64), strict=True):
        z, r = depth, np.inf
        for _ in range(6):  # Newton along the ray to the interpolated field's own zero
            if not np.isfinite(z):
                break
            r, J = surface_row(shape, state, T, z * ray)
            along = J[-3:] @ ray
            z = z - r / along if abs(along) > 0.3 else np.nan
        if np.isfinite(z) and abs(r) < 1e-8:
            yield z * ray


def test_surface_derivatives_are_the_differences_of_the_residual():
    shape, rng = shape_of("mug"), np.random.default_rng(2)
    state = posed(rng)
    T = camera_looking_at(state.t, rng)
    compared = points = 0
    for point in seen_points(shape, state, T, 30):
        points += 1
        _, J = surface_row(shape, state, T, point)
        numeric = differences(lambda s, p=point: surface_row(shape, s, T, p)[0], state)
        numeric[PATCHES] = -1.0
        # At the border of two cells of the grid there is no derivative.
        compared += np.allclose(J, numeric, atol=2e-3)
        assert not J[[*range(TABLE_AT[0], OBJECTS), RIM]].any()
    assert points > 8 and compared > 0.85 * points


def test_the_noise_of_a_point_is_not_in_its_derivatives():
    """Neither the camera's, the bias's, the object's nor the size's: errors in variables."""
    shape, rng = shape_of("block"), np.random.default_rng(6)
    state = posed(rng)
    top = np.array([0.01, -0.005, shape.vertices[:, 2].max()])
    eye = se3.transform(state.poses[0], state.s * top + [0.12, 0.05, 0.3])[0]
    point = se3.transform(state.poses[0], state.s * top)[0]
    T = se3.look_at(eye, point) @ se3.from_translation([0.01, -0.02, 0.0])
    p = se3.transform(se3.invert(T), point)[0]
    r, exact = surface_row(shape, state, T, p)
    assert abs(r) < 2e-6
    for error in (-2e-3, -5e-4, 5e-4):
        r, J = surface_row(shape, state, T, p * (1 + error / p[2]))
        assert abs(r) > 3e-4
        np.testing.assert_allclose(J, exact, atol=3e-5)


def test_table_derivatives_are_the_differences_of_the_height():
    evidence, config = evidence_of("block", "exact"), ScaleConfig()

    def row(state: ScaleState, T: Array, point: Array) -> tuple[float, Array]:
        one = replace(evidence, views=(replace(evidence.views[0], table=point[None]),))
        blocks = equations.table_blocks(one, state, state.cameras(T[None]), config)
        return row_of(assemble([blocks], SHARED), TABLE_AT[2], -1.0)

    for seed in range(3):
        rng = np.random.default_rng(seed)
        state = posed(rng)
        on_table = se3.transform(state.table, np.array([*rng.uniform(-0.1, 0.1, 2), 0.0]))[0]
        eye = se3.transform(state.table, np.array([*rng.uniform(-0.2, 0.2, 2), 0.3]))[0]
        T = se3.look_at(eye, on_table) @ se3.from_translation([0.01, -0.02, 0.0])
        point = se3.transform(se3.invert(T), on_table)[0]
        r, J = row(state, T, point)
        assert abs(r) < 1e-9
        numeric = differences(lambda s, T=T, p=point: row(s, T, p)[0], state)
        np.testing.assert_allclose(J, numeric, atol=1e-5)
        assert not J[[*OBJECT, SIZE, RIM]].any()
        _, noisy = row(state, T, 1.003 * point)  # by a millimetre
        np.testing.assert_allclose(noisy, J, atol=1e-9)


def outline_row(
    state: ScaleState, T: Array, point: Array, image: tuple[Array, float], distortion: Array
) -> tuple[float, Array]:
    """Return the row of one point of the outline against a plane of signed distances."""
    normal, c = image
    H, b, Hd = np.zeros((1, COLUMNS, COLUMNS)), np.zeros((1, COLUMNS)), np.zeros((1, COLUMNS, 1))
    information, right = np.zeros(1), np.zeros(1)
    left, top, size = 120.0, 20.0, (330, 400)
    v, u = np.mgrid[: size[0], : size[1]]
    distance = (normal[0] * (u + left) + normal[1] * (v + top) - c).astype(np.float32)
    Ms = se3.invert(state.poses[0]) @ state.cameras(T[None])
    add_outline(
        state.s * point[None], Ms[0], np.concatenate([[324.0, 324.0, 319.5, 179.5], distortion]),
        (distance, np.ones(size, np.float32), left, top), (np.ones(1), state.rim, 1.0),
        (5.0, 1e6, 0.0, False), (np.zeros(1, np.int64), np.zeros(1)),
        (H[0], b[0], Hd[0], information, right),
    )  # fmt: skip
    w = information[0]
    at, known = np.array([PATCHES]), information / w
    offsets = Offsets(coupling=Hd / w, information=known, right=right / w, at=at)
    further = np.array([SIZE, RIM])
    blocks = Blocks(
        H=symmetric(H) / w, b=b / w, Ms=Ms, own=OBJECT, further=further, offsets=offsets
    )
    return row_of(assemble([blocks], SHARED))


@pytest.mark.parametrize("lens", [0.0, 1.0])
def test_outline_derivatives_are_the_differences_of_the_distance(lens: float):
    distortion = lens * np.array([-0.055, 0.06, 2e-4, -1e-4, -0.02, 0, 0, 0])
    # The lens is taken for straight in the derivative: a few per cent of it.
    share = 1e-5 if lens == 0 else 0.05
    for seed in range(2):
        rng = np.random.default_rng(seed)
        state = posed(rng)
        T = camera_looking_at(state.t, rng)
        point = rng.uniform(-0.05, 0.05, 3)
        normal = rng.standard_normal(2)
        normal /= np.linalg.norm(normal)
        # The image is so shifted that the point lies on the outline but for a rounding.
        far, _ = outline_row(state, T, point, (normal, 0.0), distortion)
        z = se3.transform(se3.invert(T), state.s * state.R @ point + state.t)[0, 2]
        image = (normal, far / (z / 324.0))
        r, J = outline_row(state, T, point, image, distortion)
        assert abs(r) < 1e-7
        given = (T, point, image, distortion)
        numeric = differences(lambda s, given=given: outline_row(s, *given)[0], state)
        numeric[PATCHES] = 1.0  # where the real surface lies outside, so does the outline
        np.testing.assert_allclose(J, numeric, atol=1e-4 + share * np.abs(J).max())
        assert not J[6:OBJECTS].any()


def test_contact_derivatives_are_the_differences_of_the_lowest_points_height():
    shape, config = shape_of("scalene"), ScaleConfig()
    state = posed(np.random.default_rng(1))
    offsets = np.zeros(len(shape.patches.areas))

    def row(state: ScaleState) -> tuple[float, Array]:
        n = PATCHES + len(offsets)
        system = System(A=np.zeros((n, n)), a=np.zeros(n), B=np.zeros((1, n, 6)),
                        D=np.zeros((1, 6, 6)), d=np.zeros((1, 6)))  # fmt: skip
        equations.add_contact(shape, state, offsets, (0.0, config), system)
        J = np.sqrt(np.diag(system.A)) * np.sign(system.A[SIZE]) * np.sign(system.A[SIZE, SIZE])
        w = 1.0 / config.prior.contact_m**2
        T = se3.invert(state.T_world_table) @ state.poses[0]
        height = float(se3.transform(T, state.s * shape.hull)[:, 2].min())
        sign = np.sign(shape.hull[np.argmin(shape.hull @ T[2, :3])] @ T[2, :3])
        np.testing.assert_allclose(system.a, -sign * J * np.sqrt(w) * height, rtol=1e-6)
        return height, sign * J / np.sqrt(w)

    _, J = row(state)
    numeric = differences(lambda s: row(s)[0], state)
    np.testing.assert_allclose(J[:PATCHES], numeric[:PATCHES], atol=1e-6)
    assert np.count_nonzero(J[PATCHES:]) == 1 and J[PATCHES:].sum() == pytest.approx(-1.0)


# --- What the depth images say: points, outlines and rays, against the rendered truth.


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
        off.append(looked_up(view.rim.distance_px, view, uv[height > 0.015]))
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
    T = known.frames[3].T_world_cam @ se3.exp([0, np.pi, 0, 0, 0, 0])
    away = replace(known.frames[3], T_world_cam=T)
    blind = without_any_depth(known.frames[5])
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
    seen = N @ conditioned @ N.T
    np.testing.assert_allclose(shape.covariance_of(patches, length), seen, atol=1e-8)


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
