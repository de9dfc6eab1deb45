"""Resting poses: known answers on polyhedra, laws, bodies that roll, meshes as scans are."""

import numpy as np
import pytest

from realsim.geometry import se3
from realsim.geometry.mesh import mass_properties
from realsim.geometry.parts import part
from realsim.models.resting import SPACING_DEG, Resting, resting_orientations
from realsim.records import Mesh
from realsim.scanning.simulated import distorted
from refusals import refused


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
    import trimesh

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
