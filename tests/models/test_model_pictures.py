"""The sheet of a model shows what it should: the same at every size, open rims, parts, axes."""

from dataclasses import replace

import numpy as np
import pytest

from realsim.geometry import se3
from realsim.geometry.mesh import merged
from realsim.geometry.parts import part
from realsim.models import model_picture_views as views
from realsim.models.library_prepare import PrepareConfig, prepare_unscaled
from realsim.models.library_records import ModelProperties
from realsim.models.model_records import ConvexParts
from realsim.models.pictures import PANEL, figure_lines, model_sheet

UNKNOWN = ModelProperties(name="thing", verdict="accepted")
SIZE = (160, 120)


def test_open_rims_are_red_and_closed_meshes_have_none():
    mesh = part("tube").mesh
    assert views.rim_layer(mesh, 1.0).lines == ()
    cut = replace(mesh, faces=mesh.faces[np.arange(len(mesh.faces)) % 40 != 0])
    assert len(views.rim_layer(cut, 1.0).lines) > 30
    off = np.abs(model_sheet(cut, UNKNOWN).astype(int) - [224, 27, 36])
    assert np.sum(np.all(off < 12, axis=-1)) > 200


@pytest.mark.slow
def test_every_part_has_its_colour():
    cube = part("cube").mesh
    beside = replace(cube, vertices=cube.vertices + np.array([0.05, 0, 0]))
    mesh = replace(merged([cube, beside]), colors=None)
    both = (cube.vertices, beside.vertices)
    parts = ConvexParts(parts=both, volume_ratio=1.0, method="hull")
    sheet = model_sheet(mesh, UNKNOWN, parts)
    r, g, b = np.moveaxis(sheet[: sheet.shape[0] // 2, 2 * PANEL[0] :].astype(int), -1, 0)
    for stronger in (b - r, r - b):  # blue, orange
        assert np.sum((stronger > 60) & (g > 60)) > 2000


def test_a_pixel_is_as_wide_as_the_scale_bar_says():
    drawn, factor = views.drawn_size(part("cube").mesh)
    view = views.view_of(drawn.vertices, (0.0, -1.0, 0.0), SIZE)
    _, depth = views.rendered([drawn], view)
    wide_px = np.ptp(np.nonzero(depth > 0)[1]) + 1
    # Perspective: the front face is nearer than the middle, for which the bar holds.
    nearer = view.T_obj_cam[1, 3] / (view.T_obj_cam[1, 3] + 0.025 * factor)
    assert wide_px / (view.px_per_m * factor) == pytest.approx(0.05 * nearer, rel=0.02)


@pytest.mark.parametrize(
    ("name", "orders"), [("cube", {4: 3, 3: 4, 2: 6}), ("hex_nut", {6: 1, 2: 6}), ("wedge", {})]
)
def test_the_axes_of_known_shapes(name: str, orders: dict[int, int]):
    symmetries = part(name).symmetries
    found = [order for order, _, _ in views.rotation_axes(symmetries)]
    assert {n: found.count(n) for n in set(found)} == orders
    # Equivariance: where the object is put, its axes go along.
    T = se3.from_rt(se3.exp_so3([0.4, -0.9, 0.3]), [0.2, -0.1, 0.5])
    moved = views.rotation_axes(T @ symmetries @ se3.invert(T))
    for order, direction, point in moved:
        S = se3.from_rt(R := se3.exp_so3(2 * np.pi / order * direction), point - R @ point)
        assert min(np.abs(T @ A @ se3.invert(T) - S).max() for A in symmetries) < 1e-6


def test_problems_are_written_on_the_sheet():
    reason = "open: 24 boundary edges in 2 holes"
    p = prepare_unscaled(part("wedge").mesh, PrepareConfig()).properties
    p = replace(p, verdict="doubtful", reasons=(reason,))
    lines = figure_lines(part("wedge").mesh, p)
    assert ("look", reason) in lines
    assert any("no metric scale" in text for _, text in lines)
