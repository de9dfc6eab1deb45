"""The normal equations of the joint fit: derivatives against differences, and honest statistics."""

from dataclasses import dataclass

import numpy as np
import pytest
from numpy.typing import NDArray

from realsim.geometry import se3
from realsim.scanning.scale.accumulate import BLOCK, add_outline, add_surface, add_table
from realsim.scanning.scale.config import PriorConfig
from realsim.scanning.scale.equations import TABLE_SIGMA_M
from realsim.scanning.scale.shape import ScanShape
from realsim.scanning.scale.state import (
    BIAS,
    HAND_EYE,
    RIM,
    TABLE,
    State,
    all_points,
    moved_all,
    symmetric,
    table_points,
)
from scanned_objects import evidence_of, scanned, shape_of, true_state

Array = NDArray[np.float64]
STEP = 1e-6
WIDE = 1e12
"""A kernel so wide that every weight is one."""
LOCAL = {
    **{k: k for k in range(7)}, **{7 + k: HAND_EYE + k for k in range(6)},
    **{13 + k: TABLE + k for k in range(3)}, 16: BIAS, 17: RIM,
}  # fmt: skip
"""The unknowns of a view's block, and where they stand in a step of the joint fit."""


@dataclass
class Row:
    """What one measurement added: its residual, derivatives, and the patch's share."""

    r: float
    J: Array
    patch: Array
    """Derivative of the residual by the patch's offset (1,)."""


def unit_step(local: int, size: float) -> Array:
    x = np.zeros(18 + 6)
    x[LOCAL[local]] = size
    return x


def difference(residual, state: State, pivot: Array, local: int) -> float:
    """Return the central difference of residual(state) by one unknown of the block.

    NaN where the differences to both sides disagree: at a kink there is no derivative.
    """
    minus, here, plus = (
        residual(moved_all(state, unit_step(local, h), pivot)) for h in (-STEP, 0.0, STEP)
    )
    if not abs(plus - 2 * here + minus) < 1e-3 * STEP:
        return np.nan
    return (plus - minus) / (2 * STEP)


def posed(rng: np.random.Generator) -> State:
    """Return an object of about 90 mm anywhere, seen by one camera anywhere."""
    return State(
        s=0.9, R=se3.random_rotation(rng), t=rng.uniform(-0.3, 0.3, 3), hand_eye=np.zeros(6),
        views=np.zeros((1, 6)), bias=0.0, rim=0.0,
        T_world_table=se3.from_rt(se3.random_rotation(rng), rng.uniform(-0.2, 0.2, 3)),
    )  # fmt: skip


def camera_looking_at(point: Array, rng: np.random.Generator) -> Array:
    z = rng.standard_normal(3)
    z /= np.linalg.norm(z)
    x = np.cross(z, rng.standard_normal(3))
    x /= np.linalg.norm(x)
    R = np.stack([x, np.cross(z, x), z], -1)
    return se3.from_rt(R, point - rng.uniform(0.25, 0.45) * z + rng.uniform(-0.04, 0.04, 3))


def surface_row(shape: ScanShape, state: State, T: Array, p_cam: Array, offset: float = 0.0) -> Row:
    """Return the row of one measured point (3,)."""
    H, b, Hd = np.zeros((1, BLOCK, BLOCK)), np.zeros((1, BLOCK)), np.zeros((1, 1, BLOCK))
    D, e, out = np.zeros(1), np.zeros(1), (np.zeros(1), np.zeros(1))
    p = p_cam * (1.0 + state.bias * p_cam[2])
    add_surface(
        (shape.field.grid, shape.field.origin, shape.field.cell), state.pose,
        (T @ se3.exp(state.hand_eye))[None],
        (p[None], np.zeros(1, np.int64), np.ones(1), np.full(1, WIDE)),
        (np.zeros(1, np.int64), np.full(1, offset)), (H, b, Hd, D, e), out,
    )  # fmt: skip
    J = -Hd[0, 0]
    if D[0] > 0:
        np.testing.assert_allclose(symmetric(H[0]), np.outer(J, J), atol=1e-9)
        np.testing.assert_allclose(b[0], -J * out[0][0], atol=1e-12)
        assert e[0] == pytest.approx(D[0] * out[0][0], abs=1e-15)
    return Row(float(out[0][0]), J, np.array([-D[0]]))


def seen_points(shape: ScanShape, state: State, T: Array, n: int) -> tuple[Array, Array]:
    """Return rays (n, 3) of z = 1 that meet the object, and the depths where the field is zero."""
    rng = np.random.default_rng(5)
    aim = (state.s * shape.samples @ state.R.T + state.t - T[:3, 3]) @ T[:3, :3]
    rays = (aim / aim[:, 2:])[rng.permutation(len(aim))[: 4 * n]]
    z = shape.cast(T[:3, 3], (rays @ T[:3, :3].T).astype(np.float32), *state.pose).astype(float)
    rays, z = rays[np.isfinite(z)], z[np.isfinite(z)]
    for _ in range(6):  # Newton along the ray to the interpolated field's own zero
        m = (z[:, None] * rays @ T[:3, :3].T + T[:3, 3] - state.t) @ state.R / state.s
        d, g = shape.field.distance_gradient(m)
        along = np.sum((g @ state.R.T) * (rays @ T[:3, :3].T), axis=1)
        z = z - np.clip(state.s * d / np.where(np.abs(along) > 0.2, along, np.inf), -2e-3, 2e-3)
    done = (np.abs(d) < 1e-9) & (np.abs(along) > 0.3)
    assert done.sum() >= n
    return rays[done][:n], z[done][:n]


def agree(shape: ScanShape, state: State, T: Array, points: Array, unknowns: list[int]) -> int:
    """Check the derivatives of points (N, 3) where they exist; return how many were compared."""
    compared = 0
    for p in points:
        row = surface_row(shape, state, T, p)
        m = (se3.transform(T, p)[0] - state.t) @ state.R / state.s
        # Points that were followed through a wall have the distance to a tangent plane instead.
        if not abs(row.r - state.s * float(shape.field.distance(m[None])[0])) < 1e-9:
            continue
        for k in unknowns:
            numeric = difference(
                lambda s, p=p: surface_row(shape, s, T, p).r, state, np.zeros(3), k
            )
            if np.isfinite(numeric):
                compared += 1
                # The grid holds float32: 1e-8 of a tenth over a cell of a millimetre.
                assert row.J[k] == pytest.approx(numeric, abs=2e-4), k
        # The table and the outline's offset move no point of the surface.
        assert not row.J[[13, 14, 15, 17]].any()
        assert row.patch[0] == -1.0
    return compared


@pytest.mark.parametrize("name", ["bunny", "mug"])
def test_surface_derivatives_are_the_differences_of_the_residual(name: str):
    shape = shape_of(name)
    unknowns = [*range(13), 16]
    for seed in range(2):
        rng = np.random.default_rng(seed)
        state = posed(rng)
        T = camera_looking_at(state.t, rng)
        rays, depths = seen_points(shape, state, T, 20)
        points = depths[:, None] * rays
        assert agree(shape, state, T, points, unknowns) > 0.8 * len(points) * len(unknowns)


def test_object_derivatives_hold_off_the_surface_too():
    shape, rng = shape_of("bunny"), np.random.default_rng(4)
    state = posed(rng)
    T = camera_looking_at(state.t, rng)
    rays, depths = seen_points(shape, state, T, 30)
    for error in (-0.0015, 0.0015):
        points = (depths + error)[:, None] * rays
        assert agree(shape, state, T, points, [*range(7)]) > 0.3 * len(points) * 7


def face_point(rng: np.random.Generator) -> tuple[ScanShape, State, Array, Array, float]:
    """Return a block seen from above one face, a ray that meets its middle, and the depth there."""
    shape = shape_of("block")
    state = posed(rng)
    top = state.t + state.s * state.R @ [0, 0, shape.vertices[:, 2].max()]
    normal = state.R[:, 2]
    eye = top + 0.3 * normal + 0.12 * state.R[:, 0] + 0.05 * state.R[:, 1]
    z = (top - eye) / np.linalg.norm(top - eye)
    x = np.cross(z, normal) / np.linalg.norm(np.cross(z, normal))
    T = se3.from_rt(np.stack([x, np.cross(z, x), z], -1), eye)
    ray = np.array([0.02, -0.015, 1.0])
    depth = ((top - eye) @ normal) / (T[:3, :3] @ ray @ normal)
    return shape, state, T, ray, float(depth)


def test_the_noise_of_a_point_is_not_in_the_derivatives_by_camera_and_bias():
    rng = np.random.default_rng(6)
    shape, state, T, ray, z = face_point(rng)
    exact = surface_row(shape, state, T, z * ray)
    assert abs(exact.r) < 2e-6
    for error in (-2e-3, -5e-4, 5e-4):
        noisy = surface_row(shape, state, T, (z + error) * ray)
        assert abs(noisy.r) > 3e-4
        np.testing.assert_allclose(noisy.J[7:13], exact.J[7:13], atol=2e-5)
        assert noisy.J[16] == pytest.approx(exact.J[16], abs=1e-5)
        # Nor in that by the scale: r - s g.m is the distance of the face from the centre.
        assert noisy.J[6] == pytest.approx(exact.J[6], abs=1e-5)


def test_the_patch_offset_is_in_the_kernel_and_not_in_the_residual():
    shape, state, T, ray, z = face_point(np.random.default_rng(7))
    plain = surface_row(shape, state, T, (z - 1e-3) * ray)
    moved = surface_row(shape, state, T, (z - 1e-3) * ray, offset=5e-4)
    assert moved.r == plain.r
    np.testing.assert_array_equal(moved.J, plain.J)
    # The kernel is centred on what the offset predicts.
    H, b, Hd = np.zeros((1, BLOCK, BLOCK)), np.zeros((1, BLOCK)), np.zeros((1, 1, BLOCK))
    out = (np.zeros(1), np.zeros(1))
    for offset, reach in ((plain.r, 1.0), (plain.r + 2e-4, (1 - 0.25) ** 2), (plain.r + 1e-3, 0)):
        add_surface(
            (shape.field.grid, shape.field.origin, shape.field.cell), state.pose, T[None],
            ((z - 1e-3) * ray[None], np.zeros(1, np.int64), np.ones(1), np.full(1, 4e-4**2)),
            (np.zeros(1, np.int64), np.full(1, offset)),
            (H, b, Hd, np.zeros(1), np.zeros(1)), out,
        )  # fmt: skip
        assert out[1][0] == pytest.approx(reach, abs=1e-9)


def test_a_point_on_the_side_that_the_camera_cannot_see_is_drawn_to_the_near_side():
    """Points within a thin wall must not pull the far side of it."""
    shape = shape_of("mug")
    thin = shape.field.distance(shape.samples - 0.5e-3 / 0.1 * shape.normals)
    rng = np.random.default_rng(8)
    state = posed(rng)
    checked = 0
    for k in np.flatnonzero(thin > -4e-3)[::10]:
        n = state.R @ shape.normals[k]
        p = state.t + state.s * state.R @ shape.samples[k]
        eye = p + 0.3 * n
        T = camera_at(eye, -n, rng)
        behind = (p - 0.0025 * n - eye) @ T[:3, :3]  # too far by more than half a wall
        row = surface_row(shape, state, T, behind)
        if np.isfinite(row.r):
            checked += 1
            assert row.r == pytest.approx(-0.0025, abs=8e-4)
    assert checked > 20


def camera_at(eye: Array, z: Array, rng: np.random.Generator) -> Array:
    x = np.cross(z, rng.standard_normal(3))
    x /= np.linalg.norm(x)
    return se3.from_rt(np.stack([x, np.cross(z, x), z], -1), eye)


def table_row(state: State, T: Array, p_cam: Array, pivot_table: Array) -> Row:
    """Return the row of one table point; the pivot is fixed on the table."""
    W = state.T_world_table
    H, b = np.zeros((1, BLOCK, BLOCK)), np.zeros((1, BLOCK))
    p = p_cam * (1.0 + state.bias * p_cam[2])
    o = se3.transform(W, pivot_table)[0]
    camera = T @ se3.exp(state.hand_eye)
    add_table(
        (W[:3, 2].copy(), W[:3, 0].copy(), W[:3, 1].copy(), o), camera[None],
        (p[None], np.zeros(1, np.int64), np.ones(1)), WIDE, H, b,
    )  # fmt: skip
    r = float(W[:3, 2] @ (se3.transform(camera, p)[0] - o))
    J = np.sqrt(np.diag(H[0])) * np.sign(symmetric(H[0])[15] * -1)
    np.testing.assert_allclose(symmetric(H[0]), np.outer(J, J), atol=1e-12)
    np.testing.assert_allclose(b[0], -J * r, atol=1e-12)
    return Row(r, J, np.zeros(1))


def test_table_derivatives_are_the_differences_of_the_height():
    pivot = np.array([0.03, -0.02, 0.0])
    for seed in range(10):
        rng = np.random.default_rng(seed)
        state = posed(rng)
        W = state.T_world_table
        on_table = se3.transform(W, np.array([*rng.uniform(-0.1, 0.1, 2), 0.0]))[0]
        T = camera_at(on_table + 0.3 * W[:3, 2] + 0.1 * W[:3, 0], -W[:3, 2], rng)
        p_cam = se3.transform(se3.invert(T), on_table)[0]
        row = table_row(state, T, p_cam, pivot)
        assert abs(row.r) < 1e-12
        at = se3.transform(W, pivot)[0]
        for k in range(7, 17):
            numeric = difference(lambda s, T=T, p=p_cam: table_row(s, T, p, pivot).r, state, at, k)
            assert row.J[k] == pytest.approx(numeric, abs=1e-7), k
        assert not row.J[:7].any() and row.J[17] == 0
        # Noise along the ray changes neither the camera's derivatives nor the bias's.
        noisy = table_row(state, T, 1.01 * p_cam, pivot)
        np.testing.assert_allclose(noisy.J[7:13], row.J[7:13], atol=1e-12)
        assert noisy.J[16] == pytest.approx(row.J[16], abs=1e-12)


def outline_row(
    state: State, T: Array, point: Array, image: tuple[Array, float], distortion: Array
) -> Row:
    """Return the row of one point of the outline against a plane of signed distances."""
    normal, c = image
    H, b, Hd = np.zeros((BLOCK, BLOCK)), np.zeros(BLOCK), np.zeros((1, BLOCK))
    D, e = np.zeros(1), np.zeros(1)
    camera = np.concatenate([[324.0, 324.0, 319.5, 179.5], distortion])
    left, top, size = 120.0, 20.0, (330, 400)
    v, u = np.mgrid[: size[0], : size[1]]
    distance = (normal[0] * (u + left) + normal[1] * (v + top) - c).astype(np.float32)
    add_outline(
        state.pose, T @ se3.exp(state.hand_eye), camera,
        (distance, np.ones(size, np.float32), left, top),
        (point[None], np.ones(1), state.rim, 1.0), (5.0, 1e6, 0.0, False),
        (np.zeros(1, np.int64), np.zeros(1)), (H, b, Hd, D, e),
    )  # fmt: skip
    assert D[0] > 0
    J = Hd[0] / D[0]
    np.testing.assert_allclose(symmetric(H), D[0] * np.outer(J, J), rtol=1e-6, atol=1e-7 * D[0])
    r = -e[0] / D[0]
    np.testing.assert_allclose(b, -D[0] * J * r, rtol=1e-6, atol=1e-9 * D[0])
    return Row(float(r), J, np.array([1.0]))


@pytest.mark.parametrize("lens", [0.0, 1.0])
def test_outline_derivatives_are_the_differences_of_the_distance(lens: float):
    distortion = lens * np.array([-0.055, 0.06, 2e-4, -1e-4, -0.02, 0, 0, 0])
    # The lens is taken for straight in the derivative: a few per cent of it.
    share = 1e-5 if lens == 0 else 0.05
    for seed in range(8):
        rng = np.random.default_rng(seed)
        state = posed(rng)
        T = camera_looking_at(state.t, rng)
        point = rng.uniform(-0.05, 0.05, 3)
        normal = rng.standard_normal(2)
        normal /= np.linalg.norm(normal)
        # The image is so shifted that the point lies on the outline but for a rounding.
        far = outline_row(state, T, point, (normal, 0.0), distortion)
        z = se3.transform(se3.invert(T), state.s * state.R @ point + state.t)[0, 2]
        image = (normal, far.r / (z / 324.0))
        row = outline_row(state, T, point, image, distortion)
        assert abs(row.r) < 1e-7
        for k in (*range(13), 17):
            numeric = difference(
                lambda s, T=T, p=point, i=image: outline_row(s, T, p, i, distortion).r,
                state,
                np.zeros(3),
                k,
            )
            size = np.linalg.norm(row.J[k // 3 * 3 : k // 3 * 3 + 3]) if k < 13 else 0
            assert row.J[k] == pytest.approx(numeric, abs=1e-4 + share * max(size, 0.05)), k
        assert not row.J[[13, 14, 15, 16]].any()


def test_an_outline_point_counts_only_outside_where_told_so():
    rng = np.random.default_rng(3)
    state = posed(rng)
    T = camera_looking_at(state.t, rng)
    for distance, counts in ((-4.0, False), (2.9, False), (3.1, True), (30.0, True)):
        D = np.zeros(1)
        rim = (np.full((360, 640), distance, np.float32), np.full((360, 640), 99, np.float32))
        add_outline(
            state.pose, T, np.array([324.0, 324, 319.5, 179.5, *np.zeros(8)]), (*rim, 0.0, 0.0),
            (np.zeros((1, 3)), np.ones(1), 3.0, 1.0), (0.0, 1e6, 0.0, True),
            (np.zeros(1, np.int64), np.zeros(1)),
            (np.zeros((18, 18)), np.zeros(18), np.zeros((1, 18)), D, np.zeros(1)),
        )  # fmt: skip
        assert (D[0] > 0) == counts


def noisy_step(
    seed: int, name: str, noise: float = 1.0, flat_m: float = 1e-5
) -> tuple[Array, Array, Array]:
    """Return the step of everything at the truth, its sigmas, and the Fisher share of them.

    Points are exact but for white noise along their rays, of the size that the weights say.
    """
    shape, evidence = shape_of(name), evidence_of(name, "exact")
    state = true_state(scanned(name, "exact"), shape, evidence)
    cameras = state.cameras(evidence.views)
    draws = np.random.default_rng(seed)
    points, view_of = all_points(evidence.views)
    table, table_view = table_points(evidence.views)
    sigma_z = 0.0069 * np.square(points[:, 2])
    table_z = 0.0069 * np.square(table[:, 2])
    local = (np.einsum("nij,nj->ni", cameras[view_of][:, :3, :3], points)
             + cameras[view_of][:, :3, 3] - state.t) @ state.R / state.s  # fmt: skip
    _, g = shape.field.distance_gradient(local)
    ray = np.einsum("nij,nj->ni", cameras[view_of][:, :3, :3], points / points[:, 2:])
    cosine = np.abs(np.sum((g @ state.R.T) * ray, axis=1))
    # What is seen at a grazing angle is left out: there the field's cells bend the surface.
    keep = cosine > 0.4
    points, view_of, sigma = points[keep], view_of[keep], (sigma_z * cosine)[keep]
    n = len(points)
    noisy = points * (1 + sigma_z[keep] * noise * draws.standard_normal(n) / points[:, 2])[:, None]
    W = evidence.plane.T_world_table
    slant = np.abs(np.einsum("nij,i,nj->n", cameras[table_view][:, :3, :3], W[:3, 2],
                             table / table[:, 2:]))  # fmt: skip
    error = noise * table_z * draws.standard_normal(len(table))
    seen = table * (1 + error / table[:, 2])[:, None]
    V = len(evidence.views)
    H, b = np.zeros((V, BLOCK, BLOCK)), np.zeros((V, BLOCK))
    add_surface(
        (shape.field.grid, shape.field.origin, shape.field.cell), state.pose, cameras,
        (noisy, view_of, 1 / sigma**2, np.full(n, WIDE)), (np.zeros(n, np.int64), np.zeros(1)),
        (H, b, np.zeros((V, 1, BLOCK)), np.zeros(1), np.zeros(1)), (np.zeros(n), np.zeros(n)),
    )  # fmt: skip
    add_table(
        (W[:3, 2].copy(), W[:3, 0].copy(), W[:3, 1].copy(), W[:3, 3].copy()), cameras,
        (seen, table_view, (table_z * slant) ** 2 + flat_m**2), WIDE, H, b,
    )  # fmt: skip
    F, right = symmetric(H.sum(0))[:17, :17], b.sum(0)[:17]
    p = PriorConfig()
    prior = np.zeros(17)
    prior[:3] = 1 / 0.3**2
    prior[7:13] = 1 / np.repeat([np.radians(p.hand_eye_deg), p.hand_eye_mm / 1e3], 3) ** 2
    prior[13:16], prior[16] = 1e-3, 1 / p.bias_per_m**2
    G = F + np.diag(prior)
    C = np.linalg.inv(G)
    return C @ right, np.sqrt(np.diag(C)), np.sqrt(np.diag(C @ F @ C))


@pytest.mark.parametrize("name", ["block", "bunny"])
def test_noise_of_the_points_does_not_pass_for_bias_hand_eye_or_scale(name: str):
    """Errors in variables: at the truth the step is noise of the covariance's size, with mean zero.

    A noisy point in its own derivative shifts the weakly seen unknowns by the same amount in every
    draw: with thousands of points by many sigma.
    """
    # What the field's cells alone ask for is no noise, and the same in every draw.
    clean = noisy_step(0, name, noise=0.0)[0]
    rows = [noisy_step(seed, name) for seed in range(12)]
    steps = np.stack([r[0] for r in rows]) - clean
    sampled = rows[0][2]
    z = steps / sampled
    mean, spread = z.mean(0) * np.sqrt(len(z)), z.std(0, ddof=1)
    weak = [6, *range(7, 13), 16]
    assert np.all(np.abs(mean[weak]) < 4.0), dict(zip(weak, mean[weak].round(1), strict=True))
    assert np.all((spread > 0.5) & (spread < 1.7)), spread.round(2)
    assert np.sqrt(np.mean(np.square(z))) == pytest.approx(1.0, abs=0.25)


def test_the_observable_directions_are_known_better_than_before():
    _, sigma, _ = noisy_step(0, "bunny", flat_m=TABLE_SIGMA_M)
    p = PriorConfig()
    assert sigma[6] < 0.01  # the scale
    assert np.all(sigma[7:10] < np.radians(p.hand_eye_deg))
    assert np.all(sigma[10:13] < p.hand_eye_mm / 1e3)
    assert sigma[16] < p.bias_per_m
