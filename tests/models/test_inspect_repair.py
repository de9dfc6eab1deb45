"""What is wrong with a mesh is found however it lies, and repaired without changing its shape."""

from dataclasses import replace

import numpy as np
import pytest

import trimesh_solids
from realsim.errors import DegenerateError
from realsim.geometry import se3
from realsim.geometry.mesh import mass_properties, merged
from realsim.geometry.mesh_shape import welded
from realsim.geometry.parts import part
from realsim.models.inspect import inspect_mesh
from realsim.models.repair import RepairConfig, repaired
from realsim.models.simplify import colors_at, deviation
from realsim.records import Mesh
from refusals import refused
from trimesh_solids import box


def solid(name="mug"):
    return replace(part(name).mesh, colors=None)


def ball(radius=0.05, center=(0.0, 0.0, 0.0), subdivisions=3):
    return trimesh_solids.ball(radius, subdivisions, center)


def inside_out(mesh):
    return replace(mesh, faces=mesh.faces[:, ::-1])


def without(mesh, rows):
    keep = np.ones(len(mesh.faces), dtype=bool)
    keep[rows] = False
    used, faces = np.unique(mesh.faces[keep], return_inverse=True)
    known = [k for k in ("vertices", "colors", "uv") if getattr(mesh, k) is not None]
    return replace(mesh, faces=faces.reshape(-1, 3), **{k: getattr(mesh, k)[used] for k in known})


def near(mesh, point, radius):
    """Return the faces with their middle within a distance of a point."""
    middle = mesh.vertices[mesh.faces].mean(axis=1)
    return np.flatnonzero(np.linalg.norm(middle - point, axis=1) < radius)


def two_sided(mesh):
    return replace(mesh, faces=np.concatenate([mesh.faces, mesh.faces[:, ::-1]]))


def open_bowl():
    """Half a ball of one layer, the opening upwards."""
    b = ball()
    return without(b, np.flatnonzero(b.vertices[b.faces].mean(axis=1)[:, 2] > 0.001))


def plate():
    xy = np.stack(np.meshgrid(np.arange(5), np.arange(5)), -1).reshape(-1, 2) * 0.02
    i = np.array([r * 5 + c for r in range(4) for c in range(4)])
    faces = np.concatenate([np.stack([i, i + 1, i + 6], -1), np.stack([i, i + 6, i + 5], -1)])
    return Mesh(vertices=np.column_stack([xy, np.zeros(25)]), faces=faces)


def soup(mesh):
    """Every corner its own vertex, as STL has it."""
    rows = mesh.faces.ravel()
    return Mesh(vertices=mesh.vertices[rows], faces=np.arange(len(rows)).reshape(-1, 3))


def some_turned(mesh):
    faces = mesh.faces.copy()
    rows = np.random.default_rng(3).choice(len(faces), len(faces) // 5, replace=False)
    faces[rows] = faces[rows][:, ::-1]
    return replace(mesh, faces=faces)


def extended(mesh, vertices, faces):
    return Mesh(
        vertices=np.concatenate([mesh.vertices, vertices]),
        faces=np.concatenate([mesh.faces, faces]),
    )


def with_bad_rows(mesh):
    n = len(mesh.vertices)
    more = [[1.0, 1.0, 1.0], mesh.vertices[0]]
    return extended(mesh, more, [*mesh.faces[:3], [0, n + 1, 1], [2, 2, 5]])


def with_fold(mesh):
    """A flap of one triangle, front and back, on an edge of the mesh."""
    a, b, _ = mesh.faces[0]
    n = len(mesh.vertices)
    tip = mesh.vertices[[a, b]].mean(axis=0) * 1.02
    return extended(mesh, [tip], [[a, b, n], [a, n, b]])


def volume(mesh):
    a, b, c = np.moveaxis(mesh.vertices[mesh.faces], 1, 0)
    return float(np.einsum("ij,ij->", a, np.cross(b, c))) / 6.0


OPEN = {"open", "non-manifold", "inconsistent winding", "duplicate faces", "folded faces"}
BROKEN = {
    "sound": (lambda: solid(), set()),
    "soup": (lambda: soup(solid()), set()),
    "inside-out": (lambda: inside_out(solid()), {"inside-out"}),
    "some turned": (lambda: some_turned(solid()), {"inconsistent winding"}),
    "small hole": (lambda: without(ball(subdivisions=4), [0]), {"open"}),
    "large hole": (lambda: without(ball(), near(ball(), [0, 0, 0.05], 0.02)), {"open"}),
    "bowl": (open_bowl, {"open"}),
    "bad rows": (
        lambda: with_bad_rows(solid()),
        {"degenerate faces", "duplicate faces", "unreferenced vertices"},
    ),
    "fold": (lambda: with_fold(ball()), {"folded faces"}),
    "one ball inside-out": (
        lambda: merged([ball(), inside_out(ball(0.04, (0.2, 0, 0)))]),
        {"several bodies", "inside-out"},
    ),
    "cavity": (lambda: merged([ball(), inside_out(ball(0.03))]), {"nested shells"}),
    "cavity filled": (lambda: merged([ball(), ball(0.03)]), {"nested shells", "inside-out"}),
    "specks": (
        lambda: merged([ball(), ball(0.001, (0.08, 0, 0), 1), ball(0.0005, (0, 0.09, 0), 1)]),
        {"stray specks"},
    ),
    "two boxes at an edge": (
        lambda: merged([box((0.1, 0.1, 0.1)), box((0.1, 0.1, 0.1), (0.1, 0.1, 0))]),
        {"non-manifold"},
    ),
    "doubled": (lambda: two_sided(solid()), {"duplicate faces", "thin sheet"}),
    "handle in a wall": (
        lambda: merged([box((0.1, 0.1, 0.01)), box((0.01, 0.01, 0.06), (0, 0, 0.028))]),
        {"several bodies"},
    ),
}
UNSOLVED = {"nested shells", "several bodies", "non-manifold"}
"""What repair says and leaves: it is the shape."""


def kinds(report):
    return {p.kind for p in report.problems}


@pytest.mark.parametrize(("make", "expected"), BROKEN.values(), ids=BROKEN)
def test_every_problem_is_found_and_no_other(make, expected):
    mesh = make()
    report = inspect_mesh(mesh)
    assert kinds(report) == expected
    assert report.is_outward == (not expected & {"inside-out", "inconsistent winding"})
    assert report.is_watertight == (not expected & OPEN)
    assert (report.boundary_edges > 0) == ("open" in expected)
    assert report.vertices == len(np.unique(mesh.vertices[mesh.faces.ravel()], axis=0))
    assert report.faces == len(mesh.faces)
    for p in report.problems:
        assert p.count > 0 and p.text.startswith(p.kind) and p.text.endswith(".")


@pytest.mark.parametrize("name", list(BROKEN))
def test_the_report_does_not_depend_on_how_the_mesh_lies(name):
    mesh = BROKEN[name][0]()
    first = inspect_mesh(mesh)
    rng = np.random.default_rng(7)
    T = se3.exp(np.array([0.7, -1.1, 0.4, 0.3, -0.2, 0.5]))
    points = np.unique(mesh.vertices, axis=0, return_inverse=True)
    # Equal positions must stay equal bit by bit, whatever order the matrix product sums in.
    moved = se3.transform(T, points[0])[points[1].reshape(-1)] * 37.0
    order, rows = rng.permutation(len(moved)), rng.permutation(len(mesh.faces))
    place = np.argsort(order)
    shifts = rng.integers(0, 3, len(rows))
    faces = place[mesh.faces[rows]]
    faces = faces[np.arange(len(faces))[:, None], (np.arange(3) + shifts[:, None]) % 3]
    assert inspect_mesh(Mesh(vertices=moved[order], faces=faces)) == first


@pytest.mark.parametrize("name", list(BROKEN))
def test_repair_is_idempotent_and_leaves_fewer_problems(name):
    make, expected = BROKEN[name]
    repair = repaired(make())
    again = repaired(repair.mesh)
    assert again.actions == () and again.mesh is repair.mesh
    left = kinds(repair.after)
    solvable = expected - UNSOLVED
    if name in ("large hole", "bowl"):
        solvable -= {"open"}
    assert left == expected - solvable
    assert kinds(repair.before) - left == solvable
    assert bool(repair.actions) == bool(solvable or name in ("soup", "two boxes at an edge"))
    assert repair.after.is_outward
    assert repair.after == inspect_mesh(repair.mesh)


def test_an_inside_out_mesh_is_repaired_to_the_original():
    mesh = solid("l_bracket")
    repair = repaired(inside_out(mesh))
    assert volume(repair.mesh) == pytest.approx(volume(mesh), rel=1e-9) and volume(mesh) > 0
    np.testing.assert_array_equal(repair.mesh.vertices, mesh.vertices)
    assert len(repair.actions) == 1 and "outward" in repair.actions[0]


def test_shells_within_shells_give_the_volume_of_the_material():
    outer, middle, inner = volume(ball()), volume(ball(0.04)), volume(ball(0.03))
    mesh = merged([inside_out(ball()), ball(0.04), inside_out(ball(0.03))])
    repair = repaired(mesh)
    assert volume(repair.mesh) == pytest.approx(outer - middle + inner, rel=1e-9)
    assert mass_properties(repair.mesh, 1.0).volume_m3 == pytest.approx(outer - middle + inner)


def test_texture_seams_stay_and_the_surface_is_closed_all_the_same():
    # Every side has its own four vertices and its own coordinates: all edges of the box are seams.
    mesh = soup(box())
    uv = np.random.default_rng(0).random((len(mesh.vertices), 2))
    texture = np.random.default_rng(1).integers(0, 256, (64, 64, 3), dtype=np.uint8)
    mesh = replace(mesh, uv=uv, texture=texture)
    assert inspect_mesh(mesh).is_watertight
    repair = repaired(inside_out(mesh))
    points = mesh.vertices[mesh.faces].mean(axis=1)
    np.testing.assert_array_equal(colors_at(repair.mesh, points), colors_at(mesh, points))
    np.testing.assert_array_equal(repair.mesh.texture, texture)
    assert len(repair.mesh.vertices) == len(mesh.vertices)
    assert len(repaired(replace(mesh, uv=np.zeros_like(uv))).mesh.vertices) == 8


def test_rims_that_meet_within_rounding_are_one():
    mesh = soup(solid())
    noise = np.random.default_rng(0).uniform(-1, 1, mesh.vertices.shape) * 1e-9
    rough = replace(mesh, vertices=mesh.vertices + noise)
    report = inspect_mesh(rough)
    assert report.is_watertight and report.problems == ()
    repair = repaired(rough)
    assert any("welded" in a for a in repair.actions)
    assert welded(repair.mesh)[0].shape == welded(solid())[0].shape
    assert deviation(repair.mesh, solid(), samples=500) < 2e-6


@pytest.mark.parametrize("textured", [False, True])
def test_small_holes_are_closed_with_the_colours_of_their_rims(textured):
    whole = ball(subdivisions=5)
    n, red = len(whole.vertices), np.array([200, 30, 60], np.uint8)
    if textured:
        uv = np.random.default_rng(0).random((n, 2))
        whole = replace(whole, uv=uv, texture=np.tile(red, (16, 16, 1)))
    else:
        whole = replace(whole, colors=np.tile(red, (n, 1)))
    holes = [near(whole, 0.05 * np.array(p), 0.0015) for p in ([0, 0, 1], [0, 1, 0], [1, 0, 0])]
    torn = without(whole, np.concatenate(holes))
    before = inspect_mesh(torn)
    assert "3 holes" in before.problems[0].text
    repair = repaired(torn)
    assert repair.after.is_watertight and repair.after.is_outward
    assert volume(repair.mesh) == pytest.approx(volume(whole), rel=1e-3)
    assert deviation(repair.mesh, whole) < 2e-4
    middle = repair.mesh.vertices[repair.mesh.faces].mean(axis=1)
    np.testing.assert_array_equal(colors_at(repair.mesh, middle), np.tile(red, (len(middle), 1)))
    kept = repaired(torn, RepairConfig(fill_size_share=0.0))
    assert kept.after.boundary_edges == before.boundary_edges


def test_specks_are_dropped_and_named_but_a_mesh_of_small_pieces_is_not():
    repair = repaired(BROKEN["specks"][0]())
    assert "dropped 2 stray specks, the largest 1.2 % of the extent" in repair.actions[0]
    np.testing.assert_allclose(repair.mesh.extent, ball().extent)
    crowd = merged([ball(0.001, (0.01 * i, 0.01 * j, 0), 0) for i in range(8) for j in range(8)])
    assert "stray specks" not in kinds(inspect_mesh(crowd))
    assert len(repaired(crowd).mesh.faces) == len(crowd.faces)


def test_what_cannot_be_an_object_is_refused():
    for flat in (plate(), two_sided(plate())):
        refused("flat", repaired, flat, error=DegenerateError)
    line = Mesh(vertices=np.array([[0.0, 0, 0], [1, 0, 0], [2, 0, 0]]), faces=[[0, 1, 2]])
    refused("no area", repaired, line, error=DegenerateError)
    assert "flat" in kinds(inspect_mesh(plate()))
    assert "flat" in kinds(inspect_mesh(line))
    assert inspect_mesh(Mesh(vertices=np.zeros((3, 3)), faces=[[0, 1, 2]])).boundary_edges == 0


def test_a_moebius_band_is_named_and_left():
    t = np.linspace(0, 2 * np.pi, 60, endpoint=False)
    w = np.repeat([-0.02, 0.02], 60)
    t = np.tile(t, 2)
    r = 0.1 + w * np.cos(t / 2)
    strip = np.stack([r * np.cos(t), r * np.sin(t), w * np.sin(t / 2)], -1)
    i = np.arange(60)
    a, b, c, d = i, 60 + i, np.append(i[1:], 60), np.append(61 + i[:-1], 0)
    faces = np.concatenate([np.stack([a, b, d], -1), np.stack([a, d, c], -1)])
    repair = repaired(Mesh(vertices=strip, faces=faces))
    for report in (repair.before, repair.after):
        assert "one-sided" in kinds(report)


def test_a_folded_sheet_has_no_volume():
    assert "thin sheet" in kinds(inspect_mesh(two_sided(open_bowl())))
    assert "thin sheet" in kinds(inspect_mesh(box((0.1, 0.08, 5e-5))))
    assert "thin sheet" not in kinds(inspect_mesh(box((0.1, 0.08, 1e-3))))
