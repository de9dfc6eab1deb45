"""Height grids and height templates: laws and known answers on real meshes."""

import numpy as np
import pytest

from realsim.geometry import se3
from realsim.geometry.parts import part
from realsim.records import Mesh, ObjectModel, SupportPlane
from realsim.registration.evidence import Cloud
from realsim.registration.search.height_grid import GridConfig, height_grid
from realsim.registration.search.templates import TemplateConfig, model_templates

PLANE = SupportPlane(T_world_table=np.eye(4))
FEW = TemplateConfig(rays=1000)


@pytest.fixture
def rng():
    return np.random.default_rng(0)


def cloud_of(points):
    towards = np.broadcast_to([0.0, 0.0, 1.0], points.shape)
    return Cloud(points=points, towards=towards, sigmas=np.full(len(points), 1e-3))


def table_and_block(rng, n=60_000):
    """A table of 30 cm with a block of 6 x 4 cm, 5 cm high, about (0.05, 0.02)."""
    xy = rng.uniform(-0.15, 0.15, (n, 2))
    on = np.all(np.abs(xy - [0.05, 0.02]) < [0.03, 0.02], axis=1)
    return np.c_[xy, np.where(on, 0.05, 0.0) + rng.normal(0, 3e-4, n)]


def test_the_table_is_zero_and_the_block_has_its_height(rng):
    grid = height_grid(cloud_of(table_and_block(rng)), PLANE, GridConfig())
    xy = grid.centers()
    inside = np.all(np.abs(xy - [0.05, 0.02]) < [0.027, 0.017], axis=-1)
    outside = np.any(np.abs(xy - [0.05, 0.02]) > [0.033, 0.023], axis=-1)
    assert np.nanmax(np.abs(grid.heights[inside] - 0.05)) < 1e-3
    assert np.nanmax(np.abs(grid.heights[outside])) < 1e-3


def rebuilt(mesh, templates, d):
    """The template's points as the mesh, put down by the same pose, shows them from above."""
    from realsim.rendering.rays import PlacedMesh, RayScene

    T = se3.from_rt(templates.rotations[d], templates.offsets[d])
    scene = RayScene([PlacedMesh(0, mesh, T)], center=np.zeros(3))
    p = templates.points[d].astype(float)
    start = np.c_[p[:, :2], np.full(len(p), 1.0)]
    t, _ = scene.first_hits(start, np.tile(np.float32([0, 0, -1]), (len(p), 1)))
    return p[:, 2], 1.0 - t


@pytest.mark.parametrize("name", ["mug", "wedge"])
def test_template_heights_are_those_of_the_placed_mesh(name):
    model = part(name)
    templates = model_templates(model, FEW, None)
    for d in range(len(templates.rotations)):
        said, seen = rebuilt(model.mesh, templates, d)
        assert np.median(np.abs(said - seen)) < 1e-5
        placed = model.mesh.vertices @ templates.rotations[d].T + templates.offsets[d]
        assert abs(placed[:, 2].min()) < 1e-9  # stands on the table
        # the reference point is the middle of the footprint's box
        assert np.allclose(placed.min(0)[:2], -placed.max(0)[:2], atol=1e-9)


def test_a_box_rests_on_three_sides_and_looks_the_same_after_half_a_turn():
    size = np.array([0.04, 0.06, 0.10])
    corners = np.array([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)]) * size
    import trimesh

    hull = trimesh.Trimesh(corners).convex_hull
    mesh = Mesh(vertices=np.array(hull.vertices), faces=np.array(hull.faces, np.int32))
    center = size / 2
    half = np.stack([np.diag(d) for d in ([1, 1, 1], [1, -1, -1], [-1, 1, -1], [-1, -1, 1])])
    S = se3.from_rt(half.astype(float), center - half @ center)
    known = model_templates(ObjectModel(obj_id=1, name="b", mesh=mesh, symmetries=S), FEW, None)
    unknown = model_templates(ObjectModel(obj_id=1, name="b", mesh=mesh), FEW, None)
    assert len(known.rotations) == 3
    assert len(unknown.rotations) == 6
    assert set(known.yaw_counts) == {12} and set(unknown.yaw_counts) == {24}
    assert np.isclose(known.probabilities.sum(), unknown.probabilities.sum())
    heights = sorted(float(p[:, 2].mean()) for p in known.points)
    assert np.allclose(heights, size, atol=1e-6)


def test_kept_templates_are_the_same_and_a_damaged_file_is_computed_again(tmp_path):
    model = part("knob")
    first = model_templates(model, FEW, tmp_path)
    (path,) = tmp_path.glob("templates_*.npz")
    written = path.read_bytes()
    again = model_templates(model, FEW, tmp_path)
    path.write_bytes(written[: len(written) // 2])
    mended = model_templates(model, FEW, tmp_path)
    assert path.read_bytes() == written
    for other in (again, mended):
        for name in ("rotations", "offsets", "points", "outside", "yaw_counts", "symmetries"):
            assert np.array_equal(getattr(first, name), getattr(other, name))
    model_templates(model, TemplateConfig(rays=1001), tmp_path)
    assert len(list(tmp_path.iterdir())) == 2  # another config is another file
