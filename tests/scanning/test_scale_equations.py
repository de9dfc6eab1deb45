"""What a scale fit adds to registration's equations: derivatives are the residuals' differences."""

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import pytest

from realsim.arrays import Array
from realsim.geometry import se3
from realsim.geometry.normal_equations import System, symmetric
from realsim.registration.refinement.equations import OBJECTS, TABLE_AT, Blocks, Offsets, assemble
from realsim.scanning.scale import equations
from realsim.scanning.scale.config import ScaleConfig
from realsim.scanning.scale.outlines import COLUMNS, Rims, add_outline
from realsim.scanning.scale.shape import ScanShape
from realsim.scanning.scale.state import OBJECT, PATCHES, RIM, SIZE, ScaleState, moved_state
from scanned_objects import evidence_of, shape_of

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
    offsets = Offsets(
        coupling=Hd / w, information=information / w, right=right / w, at=np.array([PATCHES])
    )
    blocks = Blocks(
        H=symmetric(H) / w, b=b / w, Ms=Ms, own=OBJECT, further=np.array([SIZE, RIM]),
        offsets=offsets,
    )  # fmt: skip
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
        numeric = differences(
            lambda s, T=T, p=point, i=image: outline_row(s, T, p, i, distortion)[0], state
        )
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
