"""Derivatives against finite differences; normal equations against dense ones."""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
import pytest

from realsim.arrays import Array
from realsim.geometry import se3
from realsim.geometry.normal_equations import System, covariances, solve
from realsim.geometry.parts import part
from realsim.geometry.seen_surface import seen_distances
from realsim.registration.body import Body
from realsim.registration.refinement.equations import (
    BIAS,
    BLOCK,
    HAND_EYE,
    OBJECTS,
    TABLE,
    TABLE_AT,
    TABLE_ROWS,
    Blocks,
    State,
    add_blocks,
    assemble,
    centre_pose,
    object_at,
    step_state,
)
from realsim.registration.refinement.points import exact_residuals, thin_share
from realsim.registration.refinement.priors import OF_FIXED, OF_VIEW
from table_scenes import body_at

TINY_M = 1e-9
"""A residual so small that the ray meets the surface at the point itself."""
STEP = 1e-5


@pytest.fixture(scope="module")
def box() -> Body:
    return body_at(part("box"), 64, 200)


# --- derivatives ---------------------------------------------------------------------------------


@dataclass
class OnePoint:
    """One measured point, the plane it lies on, and where everything stands."""

    state: State
    claimed: Array
    point_cam: Array
    on: Array
    normal: Array
    bodies: list[Body]

    @property
    def of_table(self) -> bool:
        return not self.bodies

    def T_world_body(self, state: State) -> Array:
        if not self.of_table:
            return state.poses[0]
        assert state.T_world_table is not None
        return state.T_world_table

    def residual(self, state: State) -> float:
        """r = g . (M p - s) in the body's frame, as `refine` sees it."""
        M = se3.invert(self.T_world_body(state)) @ state.cameras(self.claimed)[0]
        p = se3.transform(M, state.corrected(self.point_cam[None], 0))[0]
        return float(self.normal @ (p - self.on))

    def row(self) -> tuple[Array, Array]:
        """dr / d(shared), dr / d(view), from the code's blocks."""
        T = self.T_world_body(self.state)
        M = se3.invert(T) @ self.state.cameras(self.claimed)
        place = se3.transform(M[0], self.state.corrected(self.point_cam[None], 0))
        center = np.zeros(3) if self.of_table else self.bodies[0].center_obj
        H, b = np.zeros((1, BLOCK, BLOCK)), np.zeros((1, BLOCK))
        kernels = np.zeros(1)
        add_blocks(
            (place, np.array([TINY_M]), self.normal[None]), np.zeros(1, np.int32),
            (center, *seen_from(M)), (np.ones(1), np.ones(1)), (H, b), kernels,
        )  # fmt: skip
        assert kernels[0] == pytest.approx(1.0)
        H = H + np.swapaxes(np.triu(H, 1), 1, 2)
        own, rows = (TABLE_AT, TABLE_ROWS) if self.of_table else (object_at(0), tuple(range(6)))
        Ms, common = se3.from_translation(-center) @ M, self.state.common
        blocks = Blocks(H=H, b=b, Ms=Ms, own=own, rows=rows, common=common)
        n = self.state.views.shape[1]
        system = assemble([blocks], OBJECTS + 6 * len(self.bodies), n)
        return -system.a / TINY_M, -system.d[0] / TINY_M


def some_point(rng: np.random.Generator, body: Body | None, bias=(1.0, 0.0)) -> OnePoint:
    T_world_cam = se3.look_at(rng.uniform([-0.2, -0.2, 0.25], [0.2, 0.2, 0.4]), [0, 0, 0.02])
    point_cam = np.append(rng.uniform(-0.25, 0.25, 2), 1.0) * rng.uniform(0.25, 0.4)
    T = se3.random_transform(rng, spread=0.1)
    state = State(
        poses=T[None] if body is not None else np.zeros((0, 4, 4)),
        T_world_table=T, hand_eye=np.zeros(6), views=np.zeros((1, OF_VIEW)), bias=np.array(bias),
    )  # fmt: skip
    normal = np.array([0.0, 0.0, 1.0])
    if body is not None:
        normal = rng.normal(size=3)
        normal /= np.linalg.norm(normal)
    bodies = [] if body is None else [body]
    point = OnePoint(state, T_world_cam[None], point_cam, np.zeros(3), normal, bodies)
    # A point whose ray is nearly in the surface says nothing of the depth: look at it from above.
    ray = (se3.invert(T) @ T_world_cam)[:3, :3] @ point_cam
    cosine = abs(ray @ normal) / np.linalg.norm(ray)
    return point if cosine > 0.2 else some_point(rng, body, bias)


def seen_from(Ms: Array) -> tuple[Array, Array]:
    """Where the cameras (V, 4, 4) are, and in which direction they look."""
    return np.ascontiguousarray(Ms[:, :3, 3]), np.ascontiguousarray(Ms[:, :3, 2])


def numeric(point: OnePoint, unknowns: int, apply: Callable[[Array], State]) -> Array:
    """Central differences of the residual over a step of `unknowns` numbers."""
    out = np.zeros(unknowns)
    for k in range(unknowns):
        x = np.zeros(unknowns)
        x[k] = STEP
        out[k] = (point.residual(apply(x)) - point.residual(apply(-x))) / (2 * STEP)
    return out


def checked_row(point: OnePoint) -> tuple[Array, Array]:
    """The derivatives by shared and view's unknowns, which are those of the residual."""
    shared, view = point.row()
    nothing, no_view = np.zeros(len(shared)), np.zeros((1, len(view)))
    state, bodies = point.state, point.bodies
    expected = numeric(point, len(shared), lambda x: step_state(state, bodies, x, no_view))
    np.testing.assert_allclose(shared, expected, atol=1e-6)
    expected = numeric(point, len(view), lambda x: step_state(state, bodies, nothing, x[None]))
    np.testing.assert_allclose(view, expected, atol=1e-6)
    return shared, view


def test_derivatives_of_an_object_are_those_of_the_residual(box: Body):
    shared, view = checked_row(some_point(np.random.default_rng(0), box))
    assert (len(shared), len(view)) == (OBJECTS + 6, OF_VIEW)
    assert np.linalg.norm(shared[OBJECTS:]) > 0.5


def test_a_camera_that_stands_still_has_no_part_in_hand_eye_and_bias(box: Body):
    point = some_point(np.random.default_rng(5), box, bias=(1.003, 0.004))
    still = replace(point.state, views=np.zeros((1, OF_FIXED)), common=np.zeros(1))
    shared, view = checked_row(replace(point, state=still))
    assert not np.any(shared[: TABLE.start])
    assert np.linalg.norm(shared[OBJECTS:]) > 0.5
    assert len(view) == OF_FIXED and abs(view[7]) > 0.05


def test_derivatives_of_the_table_are_those_of_the_residual():
    shared, view = checked_row(some_point(np.random.default_rng(100), None))
    assert (len(shared), len(view)) == (OBJECTS, OF_VIEW)
    assert shared[TABLE][2] == pytest.approx(-1.0)


def test_noise_of_a_point_is_not_in_its_derivative(box: Body):
    # The same ray with another depth: its residual changes, where it meets the surface does not.
    T_world_cam = se3.look_at([0.2, 0.1, 0.3], [0, 0, 0])
    eye = T_world_cam[:3, 3]
    foot, normal = np.array([0.01, -0.02, 0.0]), np.array([0.0, 0.0, 1.0])
    rows: list[Array] = []
    for beyond in (-3e-3, -1e-9, 3e-3):
        place = foot + beyond * (foot - eye) / np.linalg.norm(foot - eye)
        r = float(normal @ (place - foot))
        H, b = np.zeros((1, BLOCK, BLOCK)), np.zeros((1, BLOCK))
        add_blocks(
            (place[None], np.array([r]), normal[None]), np.zeros(1, np.int32),
            (np.array([0.0, 0.0, -0.02]), *seen_from(T_world_cam[None])),
            (np.ones(1), np.full(1, 1e6)), (H, b), np.zeros(1),
        )  # fmt: skip
        rows.append(-b[0] / r)
    np.testing.assert_allclose(rows[0], rows[2], rtol=1e-6, atol=1e-9)
    np.testing.assert_allclose(rows[0], rows[1], rtol=1e-4, atol=1e-6)


# --- residuals -----------------------------------------------------------------------------------


def residuals(exact: bool, body: Body, points_cam: Array, T_obj_cam: Array) -> tuple[Array, ...]:
    """Return places, distances and normals by the triangles, or by the field."""
    views, Ms, eyes = np.zeros(len(points_cam), np.int32), T_obj_cam[None], T_obj_cam[None, :3, 3]
    eyes = np.ascontiguousarray(eyes)
    if exact:
        return exact_residuals(body, points_cam, views, Ms, eyes)
    return seen_distances(body.field.lattice, 1.0, points_cam, views, (Ms, eyes), False)


@pytest.mark.parametrize("exact", [False, True])
def test_residual_is_the_distance_along_the_normal(box: Body, exact: bool):
    rng = np.random.default_rng(1)
    T_obj_cam = se3.look_at([0.15, 0.2, 0.3], box.center_obj)
    inner = np.abs(box.samples - box.center_obj) < 0.5 * box.model.mesh.extent - 0.006
    towards = T_obj_cam[:3, 3] - box.samples
    seen = (np.sum(towards * box.normals, axis=1) > 0.1) & (inner.sum(1) == 2)
    assert seen.sum() > 20
    beyond = rng.uniform(-2e-3, 2e-3, seen.sum())
    points_obj = box.samples[seen] + beyond[:, None] * box.normals[seen]
    points_cam = se3.transform(se3.invert(T_obj_cam), points_obj)
    places, distances, normals = residuals(exact, box, points_cam, T_obj_cam)
    np.testing.assert_allclose(places, points_obj, atol=1e-12)
    np.testing.assert_allclose(distances, beyond, atol=2e-5 if not exact else 1e-6)
    np.testing.assert_allclose(normals, box.normals[seen], atol=0.02 if not exact else 1e-5)


@pytest.mark.parametrize("exact", [False, True])
def test_point_behind_a_thin_wall_belongs_to_the_side_that_was_seen(exact: bool):
    mug = body_at(part("mug"), 64, 4000)
    assert thin_share(mug, 3.0) > 0.2 > thin_share(mug, 0.5)
    # Outer wall, seen from outside; the points lie a little more than the wall behind it.
    radial = mug.samples[:, :2] / np.linalg.norm(mug.samples[:, :2], axis=1, keepdims=True)
    outside = np.sum(radial * mug.normals[:, :2], axis=1) > 0.99
    middle = np.abs(mug.samples[:, 2] - mug.center_obj[2]) < 0.02
    away = mug.samples[:, 0] < -0.02  # the handle is elsewhere
    some = np.flatnonzero(outside & middle & away)[:40]
    assert len(some) > 5
    eye = np.array([-0.4, 0.0, mug.center_obj[2]])
    T_obj_cam = se3.look_at(eye, mug.center_obj)
    facing = (eye - mug.samples[some]) @ np.array([-1.0, 0, 0]) > 0
    assert facing.all()
    depth = 0.0025
    points = mug.samples[some] - depth * mug.normals[some]
    points_cam = se3.transform(se3.invert(T_obj_cam), points)
    _, distances, normals = residuals(exact, mug, points_cam, T_obj_cam)
    assert np.median(np.sum(normals * mug.normals[some], axis=1)) > 0.98
    assert np.median(distances) == pytest.approx(-depth, abs=4e-4 if not exact else 1e-4)


# --- normal equations ----------------------------------------------------------------------------


def random_system(seed: int, objects: int, views: int, each: int = 15) -> System:
    """Return the assembled blocks of random rows, with priors."""
    rng = np.random.default_rng(seed)
    Ms = se3.random_transform(rng, (objects + 1) * views).reshape(objects + 1, views, 4, 4)
    parts: list[Blocks] = []
    for k in range(objects + 1):
        A, r = rng.normal(size=(views, each, 8)), rng.normal(size=(views, each))
        if k == objects:
            A[..., [2, 3, 4]] = 0.0  # what does not move a plane
        H, b = np.einsum("vni,vnj->vij", A, A), -np.einsum("vni,vn->vi", A, r)
        own, used = (object_at(k), tuple(range(6))) if k < objects else (TABLE_AT, TABLE_ROWS)
        parts.append(Blocks(H=H, b=b, Ms=Ms[k], own=own, rows=used))
    n = OBJECTS + 6 * objects
    system = assemble(parts, n)
    add = np.full(n, 0.01)
    add[HAND_EYE], add[BIAS] = 2.0, 11.0
    system.A[np.arange(n), np.arange(n)] += add
    system.D[:] += 4.0 * np.eye(6)
    return system


def of_views(system: System) -> list[slice]:
    """Return where the unknowns of each view are."""
    S = len(system.A)
    return [slice(S + 6 * v, S + 6 * v + 6) for v in range(len(system.D))]


def dense(system: System) -> tuple[Array, Array]:
    S, size = len(system.A), len(system.A) + 6 * len(system.D)
    N, n = np.zeros((size, size)), np.zeros(size)
    N[:S, :S], n[:S] = system.A, system.a
    for v, at in enumerate(of_views(system)):
        N[:S, at], N[at, :S] = system.B[v], system.B[v].T
        N[at, at], n[at] = system.D[v], system.d[v]
    return N, n


def test_elimination_of_views_is_the_dense_solution():
    system = random_system(3, 4, 5)
    N, n = dense(system)
    np.testing.assert_allclose(N, N.T, atol=1e-9)
    S = len(system.A)
    shared, views = solve(system)
    x = np.linalg.solve(N, n)
    np.testing.assert_allclose(np.concatenate([shared, views.ravel()]), x, rtol=1e-8, atol=1e-10)
    C, found = np.linalg.inv(N), covariances(system)
    np.testing.assert_allclose(found.shared, C[:S, :S], rtol=1e-8, atol=1e-10)
    for v, at in enumerate(of_views(system)):
        np.testing.assert_allclose(found.cross[v], C[:S, at], rtol=1e-8, atol=1e-10)
        np.testing.assert_allclose(found.views[v], C[at, at], rtol=1e-8, atol=1e-10)


# --- state ---------------------------------------------------------------------------------------


def test_an_object_turns_about_its_centre_and_cameras_about_themselves(box: Body):
    rng = np.random.default_rng(5)
    T = se3.random_transform(rng)
    state = State(
        poses=T[None], T_world_table=None, hand_eye=np.zeros(6), views=np.zeros((2, 6)),
        bias=np.array([1.0, 0.0]),
    )  # fmt: skip
    shared = np.zeros(OBJECTS + 6)
    shared[OBJECTS : OBJECTS + 3] = [0.1, -0.2, 0.05]
    after = step_state(state, [box], shared, np.zeros((2, 6)))
    np.testing.assert_allclose(box.center(after.poses[0]), box.center(T), atol=1e-12)
    turned = centre_pose(box, T) @ se3.exp(shared[OBJECTS:])
    np.testing.assert_allclose(centre_pose(box, after.poses[0]), turned, atol=1e-12)
    xi = rng.normal(size=6)
    claimed = se3.random_transform(rng, 2)
    held = step_state(state, [box], np.r_[xi, np.zeros(OBJECTS)], np.stack([-xi, np.zeros(6)]))
    cameras = held.cameras(claimed)
    np.testing.assert_allclose(cameras[0], claimed[0], atol=1e-12)
    np.testing.assert_allclose(cameras[1], claimed[1] @ se3.exp(xi), atol=1e-12)
