"""Symmetries: laws of the group, exact shapes, scans with shape error, and what breaks them.

Resting poses: known answers on polyhedra, laws, bodies that roll, meshes as scans are.
"""

import math
from dataclasses import replace

import numpy as np
import pytest
import trimesh

from real_data import DATA, needs
from realsim.geometry import se3
from realsim.geometry.mesh import diameter, mass_properties, symmetry_transforms, transformed
from realsim.geometry.parts import object_model, part
from realsim.models import symmetry
from realsim.models.reading import read_scan
from realsim.models.resting import SPACING_DEG, Resting, resting_orientations
from realsim.models.symmetry import SymmetryConfig, find_symmetries, with_found_symmetries
from realsim.models.symmetry_search import closed, group, turn
from realsim.records import Mesh, ObjectModel
from realsim.scanning.simulated import distorted
from refusals import refused
from trimesh_solids import ball, solid

PHI = (1 + math.sqrt(5)) / 2
YCBV_MODELS = DATA / "scenes/ycbv_mini/models"


def hull(points, size_m=0.05):
    return solid(trimesh.convex.convex_hull(size_m * np.asarray(points, dtype=float)))


def ring(n, z, twist=0.0):
    t = 2 * np.pi * np.arange(n) / n + twist
    return np.stack([np.cos(t), np.sin(t), np.full(n, z)], -1)


def slowly(quick, *slow):
    """Return the names as parameters, all but the first marked slow."""
    return [quick, *(pytest.param(n, marks=pytest.mark.slow) for n in slow)]


def subdivided(mesh, rng, times, noise_m):
    """Return the same surface with more, unequal triangles and moved vertices."""
    shape = trimesh.Trimesh(mesh.vertices, mesh.faces)
    for _ in range(times):
        some = rng.permutation(len(shape.faces))[: len(shape.faces) * 2 // 3]
        shape = shape.subdivide(some)
    shape.merge_vertices()
    shape.vertices = shape.vertices + rng.normal(0, noise_m, shape.vertices.shape)
    return solid(shape)


def same_motions(A, B, mesh, share=0.01):
    """Whether each motion of A is one of B, judged by where it puts the mesh's vertices."""
    v = mesh.vertices[:: max(1, len(mesh.vertices) // 40)]
    a, b = se3.transform(A, v), se3.transform(B, v)
    gaps = np.linalg.norm(a[:, None] - b[None], axis=-1).max(-1)
    return np.all(gaps.min(1) <= share * diameter(mesh))


def as_model(mesh, found):
    return ObjectModel(
        obj_id=1, name="x", mesh=mesh, symmetries=found.discrete, symmetry_axes=found.axes
    )


# --- known answers ------------------------------------------------------------------------------


@pytest.mark.parametrize("name", slowly("t_profile", "cube", "cylinder_can", "hex_nut"))
def test_the_symmetries_of_shipped_parts_are_found(name):
    model = part(name)
    found = find_symmetries(model.mesh)
    assert len(found.discrete) == len(model.symmetries)
    assert len(found.axes) == len(model.symmetry_axes)
    assert found.worst_m < 1e-4
    # The whole set, discrete times steps, not only its size; a flip about x is one about any
    # line across a continuous axis, so that the steps are compared at 2 degrees.
    known = symmetry_transforms(model, math.radians(2))
    ours = symmetry_transforms(as_model(model.mesh, found), math.radians(2))
    assert len(ours) == len(known)
    allowed = 0.02 if found.axes else 1e-3
    assert same_motions(known, ours, model.mesh, allowed)
    assert same_motions(ours, known, model.mesh, allowed)
    for axis, point in found.axes:
        assert np.allclose(axis, [0, 0, 1], atol=1e-3)
        assert np.allclose(np.asarray(point)[:2], 0, atol=5e-5)


SHAPES = {
    # name: points of a hull, discrete elements, continuous axes, equals its mirror image
    "icosahedron": (
        [np.roll((0, a, b * PHI), k) for a in (1, -1) for b in (1, -1) for k in range(3)],
        60, 0, True,
    ),
    "12 chiral corners": (group("tetrahedral") @ [1.0, 0.45, 0.15], 12, 0, False),
    "pyramid": (np.concatenate([ring(7, 0.0), [[0, 0, 1.2]]]), 7, 0, True),
}  # fmt: skip


@pytest.mark.parametrize("name", slowly("pyramid", "icosahedron", "12 chiral corners"))
def test_point_groups_are_found_wherever_the_shape_lies(name):
    points, discrete, axes, mirror = SHAPES[name]
    T = se3.random_transform(np.random.default_rng(1), 1)[0]
    found = find_symmetries(transformed(hull(points), T))
    assert (len(found.discrete), len(found.axes)) == (discrete, axes)
    assert found.is_mirror_symmetric is mirror
    assert found.worst_m < 1e-4


@pytest.mark.slow
def test_a_sphere_has_three_axes_as_bop_has_no_other_form():
    found = find_symmetries(ball(0.04, 3, (0.3, 0, 0.1)))
    assert len(found.discrete) == 1 and len(found.axes) == 3
    directions = np.array([axis for axis, _ in found.axes])
    assert np.allclose(directions @ directions.T, np.eye(3), atol=1e-9)
    assert np.allclose([point for _, point in found.axes], [0.3, 0, 0.1], atol=2e-4)
    assert found.is_mirror_symmetric


def test_a_random_hull_has_no_symmetry():
    found = find_symmetries(hull(np.random.default_rng(3).normal(size=(12, 3))))
    assert np.array_equal(found.discrete, np.eye(4)[None])
    assert found.axes == () and found.worst_m == 0 and not found.is_mirror_symmetric


# --- laws ---------------------------------------------------------------------------------------


def test_the_discrete_symmetries_are_a_group():
    S = find_symmetries(part("knob").mesh).discrete
    assert np.array_equal(S[0], np.eye(4))
    products = (S[:, None] @ S[None]).reshape(-1, 4, 4)
    for T in np.concatenate([products, np.linalg.inv(S)]):
        assert np.abs(S - T).max(axis=(1, 2)).min() < 1e-9
    gaps = np.abs(S[:, None] - S[None]).max(axis=(2, 3)) + np.eye(len(S))
    assert gaps.min() > 0.01


@pytest.mark.parametrize("name", slowly("t_profile", "cone"))
def test_symmetries_move_with_the_mesh_and_grow_with_it(name):
    mesh = part(name).mesh
    T = se3.from_rt(se3.random_rotation(np.random.default_rng(5)), [4.0, -2.0, 1.0])
    big = transformed(replace(mesh, vertices=3.0 * mesh.vertices), T)
    plain, moved = find_symmetries(mesh), find_symmetries(big)
    assert len(moved.discrete) == len(plain.discrete)
    assert len(moved.axes) == len(plain.axes)
    assert moved.is_mirror_symmetric == plain.is_mirror_symmetric
    grown = plain.discrete.copy()
    grown[:, :3, 3] *= 3.0
    if not plain.axes:
        assert same_motions(T @ grown @ se3.invert(T), moved.discrete, big, 1e-3)
    for (a, p), (b, q) in zip(plain.axes, moved.axes, strict=True):
        direction, point = T[:3, :3] @ a, se3.transform(T, 3.0 * np.array([p]))[0]
        assert abs(direction @ b) > math.cos(math.radians(0.1))
        assert np.linalg.norm(np.cross(q - point, direction)) < 1e-3


def test_groups_have_as_many_elements_as_the_books_say():
    for order in (2, 7):
        assert len(group("cyclic", order)) == order
        assert len(group("dihedral", order)) == 2 * order
    sizes = {"tetrahedral": 12, "octahedral": 24, "icosahedral": 60}
    assert {name: len(group(name)) for name in sizes} == sizes
    refused("more than 240", closed, [turn((0, 0, 1), 1.0), turn((1, 0, 0), 0.7)], error=Exception)


# --- scans --------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", slowly("u_channel", "gear"))
def test_one_percent_of_shape_error_hides_no_symmetry(name):
    model = part(name)
    mesh = distorted(model.mesh, 0.01, np.random.default_rng(21))
    found = find_symmetries(mesh)
    assert len(found.discrete) == len(model.symmetries)
    assert len(found.axes) == len(model.symmetry_axes)
    # It is the axis of the true shape, within what the distortion leaves of it.
    known = symmetry_transforms(model, math.radians(2))
    ours = symmetry_transforms(as_model(mesh, found), math.radians(2))
    assert same_motions(known, ours, mesh, 0.06)


def test_uneven_triangles_and_noise_change_nothing():
    model = part("wedge")
    found = find_symmetries(subdivided(model.mesh, np.random.default_rng(4), 3, 0.0003))
    assert len(found.discrete) == len(model.symmetries) and found.axes == ()
    # Half a degree and half a millimetre, although nothing but the surface tells the axes.
    assert same_motions(model.symmetries, found.discrete, model.mesh, 0.01)


def test_a_hole_in_the_mesh_is_no_obstacle():
    mesh = part("bowl").mesh
    centers = mesh.vertices[mesh.faces].mean(axis=1)
    seen = np.linalg.norm(centers - centers[200], axis=1) > 0.005
    found = find_symmetries(replace(mesh, faces=mesh.faces[seen]))
    assert len(found.axes) == 1 and len(found.discrete) == 1


YCBV = {
    # id: discrete elements, continuous axes of the shape. BOP lists 13, 16, 19, 20 and 21.
    13: (1, 1), 16: (8, 0), 19: (2, 0),
    2: (4, 0),  # a bulging box; BOP leaves it out for its print
    10: (1, 0),
}  # fmt: skip


@pytest.mark.slow
@pytest.mark.real
@needs(YCBV_MODELS)
@pytest.mark.parametrize("obj_id", YCBV)
def test_scanned_objects_have_the_symmetries_that_bop_lists(obj_id):
    found = find_symmetries(read_scan(YCBV_MODELS / f"obj_{obj_id:06d}.ply", "mm").mesh)
    assert (len(found.discrete), len(found.axes)) == YCBV[obj_id]


def test_a_feature_that_breaks_a_symmetry_is_seen_and_the_near_symmetry_named():
    mug = find_symmetries(part("mug").mesh)
    assert len(mug.discrete) == 1 and mug.axes == () and mug.is_mirror_symmetric
    assert any("mm at most" in text and "% of the surface" in text for text in mug.near)
    # A can with a bump of 5 mm on one side: no turn is left, and all are nearly one.
    can = part("cylinder_can").mesh
    v = can.vertices.copy()
    near = np.linalg.norm(v - v[np.argmax(v[:, 0])], axis=1) < 0.012
    v[near, 0] += 0.006
    bumped = find_symmetries(replace(can, vertices=v))
    assert bumped.axes == () and len(bumped.near) > 0


def test_tolerances_decide_and_grams_of_millimetres_are_refused():
    square = hull(np.array(list(np.ndindex(2, 2, 2))) * [1.0, 1.02, 2.0] - 0.5)
    assert len(find_symmetries(square).discrete) == 8
    found = find_symmetries(square, SymmetryConfig(tolerance=0.002, greatest_tolerance=0.002))
    assert len(found.discrete) == 4 and "turn by 1/4" in " ".join(found.near)
    refused("shares of the diameter", SymmetryConfig, tolerance=1.3)


# --- appearance ---------------------------------------------------------------------------------


def test_a_texture_that_breaks_a_symmetry_is_told():
    # A box with a texture whose every texel is red on one half of the height.
    box = part("box").mesh
    height = (box.vertices[:, 2] - box.vertices[:, 2].min()) / np.ptp(box.vertices[:, 2])
    uv = np.stack([np.full(len(height), 0.5), 0.02 + 0.96 * height], -1)
    texture = np.full((64, 4, 3), 200, dtype=np.uint8)
    texture[32:] = (200, 20, 20)
    painted = Mesh(vertices=box.vertices, faces=box.faces, uv=uv, texture=texture)
    assert find_symmetries(painted).texture_breaks
    plain = replace(painted, texture=np.full((64, 4, 3), 200, dtype=np.uint8))
    assert not find_symmetries(plain).texture_breaks
    colors = np.where((height > 0.5)[:, None], np.uint8(200), np.array([200, 20, 20], np.uint8))
    assert find_symmetries(replace(part("box").mesh, colors=colors)).texture_breaks


def test_a_shape_that_differs_from_its_mirror_image_is_told():
    duck = find_symmetries(object_model("duck").mesh)
    assert not duck.is_mirror_symmetric and len(duck.discrete) == 1
    assert find_symmetries(part("wedge").mesh).is_mirror_symmetric


def test_an_undeclared_symmetry_is_taken_where_nothing_tells_it(tmp_path, monkeypatch):
    bar = hull([*ring(6, -2.0), *ring(6, 2.0)], 0.02)
    model = ObjectModel(obj_id=1, name="bar", mesh=bar)
    found, words = with_found_symmetries(model, tmp_path)
    assert len(found.symmetries) == 12 and found.symmetry_axes == () and "12 ways" in words
    assert with_found_symmetries(found, tmp_path) == (found, "")

    symmetry._memory.clear()
    monkeypatch.setattr(symmetry, "find_symmetries", lambda *_: pytest.fail("it was kept"))
    again, same_words = with_found_symmetries(model, tmp_path)
    np.testing.assert_array_equal(again.symmetries, found.symmetries)
    assert same_words == words
    monkeypatch.undo()

    # One end red: no flip, no symmetry for a photograph.
    colors = np.where(bar.vertices[:, 2:] > 0, [255, 0, 0], [0, 0, 0]).astype(np.uint8)
    painted, words = with_found_symmetries(replace(model, mesh=replace(bar, colors=colors)), None)
    assert len(painted.symmetries) == 1 and "photograph" in words


# --- resting poses ------------------------------------------------------------------------------


def _down(resting: tuple[Resting, ...]) -> np.ndarray:
    """Return the directions (K, 3), in the mesh's axes, that point down."""
    return np.stack([-r.R[2] for r in resting])


def _fine_box(extent: tuple[float, float, float], n: int) -> Mesh:
    """Return a box whose faces are divided n x n, every face with vertices of its own."""
    u = np.linspace(-0.5, 0.5, n + 1)
    a, b = np.meshgrid(u, u, indexing="ij")
    index = np.arange((n + 1) ** 2).reshape(n + 1, n + 1)
    quads = np.stack([index[:-1, :-1], index[1:, :-1], index[1:, 1:], index[:-1, 1:]], -1)
    quads = quads.reshape(-1, 4)
    triangles = np.concatenate([quads[:, [0, 1, 2]], quads[:, [0, 2, 3]]])
    vertices, faces = [], []
    for axis in range(3):
        for side in (1.0, -1.0):
            p = np.empty((len(a.ravel()), 3))
            p[:, axis] = 0.5 * side
            p[:, (axis + 1) % 3], p[:, (axis + 2) % 3] = a.ravel(), b.ravel()
            faces.append((triangles if side > 0 else triangles[:, ::-1]) + len(vertices) * len(p))
            vertices.append(p)
    return Mesh(
        vertices=np.concatenate(vertices) * extent, faces=np.concatenate(faces).astype(np.int32)
    )


def test_a_box_has_six_poses_with_the_solid_angles_of_its_faces() -> None:
    extent = np.array([0.10, 0.06, 0.04])
    resting = resting_orientations(_fine_box((0.10, 0.06, 0.04), 1))
    assert len(resting) == 6
    for r in resting:
        axis = int(np.argmax(np.abs(r.R[2])))
        h, (a, b) = 0.5 * extent[axis], np.delete(extent, axis)
        # Solid angle of a rectangle a x b at the distance h over its middle.
        share = np.arctan(a * b / (2 * h * np.sqrt(4 * h * h + a * a + b * b))) / np.pi
        assert abs(r.R[2]).max() == pytest.approx(1.0)
        assert r.probability == pytest.approx(share, rel=1e-6)
        assert r.height == pytest.approx(extent[axis])
        assert r.center_height == pytest.approx(h)
    assert [r.probability for r in resting] == sorted(r.probability for r in resting)[::-1]


@pytest.mark.parametrize("name", ["l_bracket", "wedge"])
def test_poses_and_probabilities_are_those_of_trimesh(name: str) -> None:
    mesh = part(name).mesh
    solid = trimesh.Trimesh(mesh.vertices, mesh.faces)
    T, chance = solid.compute_stable_poses(sigma=0, n_samples=1, threshold=0.0)
    resting = resting_orientations(mesh)
    near = np.array(_down(resting) @ -T[:, 2, :3].T)
    assert near.max(0).min() > np.cos(np.radians(2.0))
    share = np.bincount(np.argmax(near, axis=0), chance, minlength=len(resting))
    np.testing.assert_allclose([r.probability for r in resting], share / share.sum(), atol=0.02)


@pytest.mark.parametrize("name", ["l_bracket", "mug"])
def test_every_tilt_lifts_the_centre_of_mass(name: str) -> None:
    mesh = part(name).mesh
    center = mass_properties(mesh, 1.0).center_of_mass
    lowest = {}
    for r in resting_orientations(mesh):
        if r.basin not in lowest or r.center_height < lowest[r.basin].center_height:
            lowest[r.basin] = r
    around = np.linspace(0, 2 * np.pi, 36, endpoint=False)
    for r in lowest.values():
        tilts = np.stack([np.cos(around), np.sin(around), 0 * around], -1) * np.radians(0.5)
        ups = (se3.exp_so3(tilts) @ r.R)[:, 2]
        heights = -np.min((mesh.vertices - center) @ ups.T, axis=0)
        # A basin may be a ring on which the body rolls: level, but for its facets.
        assert heights.min() > r.center_height - 2e-3 * mesh.extent.max()


def test_turning_and_scaling_the_mesh_changes_nothing_but_its_frame() -> None:
    mesh = part("t_profile").mesh
    R = se3.random_rotation(np.random.default_rng(3))
    moved = Mesh(vertices=1000 * mesh.vertices @ R.T + 5.0, faces=mesh.faces)
    before, after = resting_orientations(mesh), resting_orientations(moved)
    assert len(before) == len(after)
    near = _down(before) @ R.T @ _down(after).T
    match = np.argmax(near, axis=1)
    assert near.max(1).min() > 1 - 1e-6
    for r, k in zip(before, match, strict=True):
        assert after[k].probability == pytest.approx(r.probability, abs=1e-6)
        assert after[k].height == pytest.approx(1000 * r.height, rel=1e-6)


def test_a_lying_cylinder_is_represented_all_around() -> None:
    resting = resting_orientations(part("cylinder_can").mesh)
    lying = np.array([d for d in _down(resting) if abs(d[2]) < 0.1])
    angles = np.sort(np.degrees(np.arctan2(lying[:, 1], lying[:, 0])))
    gaps = np.diff(np.append(angles, angles[0] + 360))
    assert gaps.max() < 2 * SPACING_DEG
    assert len({r.basin for r in resting}) == 3


def test_a_scan_with_thousands_of_facets_rests_like_the_shape() -> None:
    rng = np.random.default_rng(1)
    exact = _fine_box((0.10, 0.06, 0.04), 24)
    wobble = exact.vertices + 1.5e-4 * rng.standard_normal(exact.vertices.shape)
    scan = distorted(Mesh(vertices=wobble, faces=exact.faces), 0.01, rng)
    resting = resting_orientations(scan)
    truth = np.concatenate([np.eye(3), -np.eye(3)])
    near = np.max(_down(resting) @ truth.T, axis=1)
    likely = np.array([r.probability for r in resting])
    assert likely[near > np.cos(np.radians(12.0))].sum() > 0.95
    assert np.max(truth @ _down(resting).T, axis=1).min() > np.cos(np.radians(12.0))
    assert len(resting) < 40


def test_an_open_or_inside_out_mesh_rests_like_the_closed_one() -> None:
    box = _fine_box((0.10, 0.06, 0.04), 1)
    for faces in (box.faces[2:], box.faces[:, ::-1]):
        resting = resting_orientations(Mesh(vertices=box.vertices, faces=faces))
        closed = resting_orientations(box)
        got = sorted(r.probability for r in resting)
        np.testing.assert_allclose(got, sorted(r.probability for r in closed), atol=1e-6)


def test_a_flat_mesh_and_impossible_settings_are_refused() -> None:
    flat = Mesh(
        vertices=np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0]]),
        faces=np.array([[0, 1, 2]], dtype=np.int32),
    )
    refused("flat", resting_orientations, flat)
