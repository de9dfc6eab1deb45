"""Pictures of a scale fit: colours mean what they say, and every case can be drawn."""

from dataclasses import replace

import cv2
import numpy as np
import pytest

from realsim.records import Mesh
from realsim.scanning.scale.picture_overlays import Photograph, overlays_png
from realsim.scanning.scale.pictures import candidates_png, residuals_png, views_png
from realsim.scanning.shading import UNSEEN, ShadingConfig, diverging, shaded_views, value_paint
from refusals import refused
from scale_fits import fit_of, known_scan

SMALL = ShadingConfig(size_px=120)
ONE = replace(SMALL, sides_deg=((30.0, 22.0),))


@pytest.fixture(scope="module")
def known():
    return known_scan("mug", 1)


@pytest.fixture(scope="module")
def fit(known):
    return fit_of(known)


def decoded(png: bytes) -> np.ndarray:
    image = cv2.imdecode(np.frombuffer(png, np.uint8), cv2.IMREAD_COLOR)
    assert image is not None
    return image[..., ::-1].astype(int)


def reddish(image: np.ndarray) -> int:
    return int(np.sum(image[..., 0] - image[..., 2] > 40))


def bluish(image: np.ndarray) -> int:
    return int(np.sum(image[..., 2] - image[..., 0] > 40))


# --- colours ----------------------------------------------------------------------------------


def test_red_is_outside_blue_is_inside_grey_is_unseen():
    red, white, blue, grey = diverging(np.array([1.0, 0.0, -1.0, np.nan]), 1.0)
    assert red[0] > red[2] + 50 and blue[2] > blue[0] + 50
    assert np.all(white > 240) and tuple(grey) == UNSEEN
    np.testing.assert_array_equal(*diverging(np.array([7.0, 1.0]), 1.0))


def painted(mesh: Mesh, values: np.ndarray) -> np.ndarray:
    (picture,) = shaded_views(mesh, value_paint(values, 1.0), ONE)
    return picture


@pytest.mark.parametrize(("value", "count"), [(1.0, reddish), (-1.0, bluish)])
def test_a_mesh_has_the_colour_of_its_residual(known, value, count):
    mesh = known.real
    picture = painted(mesh, np.full(len(mesh.vertices), value))
    drawn = np.any(picture != 255, axis=-1)
    assert 0.1 < drawn.mean() < 0.9
    assert count(picture.astype(int)) > 0.9 * drawn.sum()


@pytest.mark.slow
def test_a_scale_that_is_too_great_is_blue_and_one_too_small_is_red():
    solid = known_scan("bottle", 1)  # without an inside, whose residuals have the other sign
    great, small = (
        decoded(residuals_png(solid.scan, fit_of(solid, f), SMALL)) for f in (1.08, 0.92)
    )
    head, bar = 60, 150  # neither the coloured title nor the colour bar
    great, small = great[head:, :-bar], small[head:, :-bar]
    assert bluish(great) > 3 * reddish(great)
    assert reddish(small) > 3 * bluish(small)


# --- figures ----------------------------------------------------------------------------------


def test_a_view_that_was_left_out_is_marked(fit):
    kept = replace(fit, views=tuple(replace(v, used=True) for v in fit.views))
    assert reddish(decoded(views_png(fit))) > reddish(decoded(views_png(kept))) + 500


def test_what_cannot_be_drawn_is_named(known, fit):
    refused("not of each other", residuals_png, known.scan, replace(fit, residual_mm=np.zeros(3)))
    refused("no views", views_png, replace(fit, views=()))
    refused("no candidates", candidates_png, replace(fit, candidates=()))
    refused("no photographs", overlays_png, known.scan, fit, known.views.intrinsics, ())


# --- overlays ---------------------------------------------------------------------------------


def test_overlays_are_drawn(known, fit):
    count = 3
    camera = known.views.intrinsics
    photographs = [
        Photograph(
            index=f.index, rgb=np.full((camera.height, camera.width, 3), 90, np.uint8),
            depth_m=f.depth_m, T_world_cam=f.T_world_cam,
        )
        for f in known.views.frames[:count]
    ]  # fmt: skip
    image = decoded(overlays_png(known.scan, fit, camera, photographs))
    yellow = (image[..., 0] > 200) & (image[..., 1] > 150) & (image[..., 2] < 90)
    assert yellow.sum() > 100 * count
