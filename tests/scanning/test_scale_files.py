"""scale.json: what is written comes back bit for bit, and what is damaged is named."""

import json
from dataclasses import replace

import cv2
import numpy as np
import pytest

from realsim.errors import NotRigidError
from realsim.records import Mesh
from realsim.scanning.scale import files
from realsim.scanning.scale.measured import parse_measurement
from realsim.scanning.scale.measured_check import with_measurements
from realsim.scanning.scale.picture_overlays import Photograph, overlays_png
from realsim.scanning.scale.pictures import candidates_png, residuals_png, views_png
from realsim.scanning.shading import UNSEEN, ShadingConfig, diverging, shaded_views, value_paint
from refusals import refused
from scale_fits import fit_of, known_scan
from tried_grasps import assert_same


@pytest.fixture(scope="module")
def known():
    return known_scan("wedge", 1)


@pytest.fixture(scope="module")
def record(known):
    lengths = [parse_measurement("longest=500mm"), parse_measurement("between 0,0,0 0,0,1=3m")]
    fit, checks = with_measurements(fit_of(known), known.scan, lengths)
    inputs = {"key": "abc", "mesh": {"name": "wedge"}, "at": [0.1, 0.2]}
    poses = ({"index": 0, "T_world_cam": np.eye(4).tolist()},)
    return files.ScaleRecord(
        fit=fit, inputs=inputs, config={"field_cells": 96}, measured=checks, poses=poses,
        versions=files.installed_versions(),
    )  # fmt: skip


def test_a_record_comes_back_and_is_written_the_same_again(record, tmp_path):
    path = tmp_path / "scale.json"
    path.write_text(files.json_lines(files.record_to_json(record)))
    loaded = files.load_record(path)
    assert_same(loaded, record)
    assert files.json_lines(files.record_to_json(loaded)) == path.read_text()
    with pytest.raises(TypeError, match="JSON"):
        files.json_lines(files.record_to_json(replace(record, inputs={"bad": object()})))


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (lambda d: d.pop("format"), "format"),
        (lambda d: d.update(format_version=99), "Update realsim"),
        (lambda d: d["fit"].pop("sigma"), "sigma"),
        (lambda d: d["fit"].update(covariance=[[1]]), "covariance"),
        (lambda d: d["fit"].update(limits=[{"name": "x"}]), "limits.*--overwrite"),
    ],
)
def test_damage_is_named(record, change, said):
    data = files.record_to_json(record)
    change(data)
    refused(said, files.record_from_json, data)


def test_a_file_that_is_no_json_is_named(tmp_path):
    (tmp_path / "scale.json").write_text('{"format": "realsim sc')
    refused("not valid JSON", files.load_record, tmp_path / "scale.json")
    refused("does not exist", files.load_record, tmp_path / "none.json")


# --- starts -----------------------------------------------------------------------------------


def test_a_result_is_a_start(record, tmp_path):
    (tmp_path / "scale.json").write_text(files.json_lines(files.record_to_json(record)))
    start = files.load_start(tmp_path / "scale.json")
    assert start.scale == record.fit.scale
    np.testing.assert_array_equal(start.T_world_obj, record.fit.T_world_obj)


def written(tmp_path, **values):
    path = tmp_path / "start.json"
    path.write_text(json.dumps(values))
    return path


def test_a_start_is_two_values(tmp_path):
    start = files.load_start(written(tmp_path, scale=0.1, T_world_obj=np.eye(4).tolist()))
    assert start.scale == 0.1 and start.source == "given"


def test_a_start_that_is_none_is_named(tmp_path):
    path = written(tmp_path, scale=2.0, T_world_obj=np.diag([2.0, 2, 2, 1]).tolist())
    refused("never inside", files.load_start, path, error=NotRigidError)
    pose = np.eye(4).tolist()
    for scale in (-1, 0, "big", None, True):
        refused("scale", files.load_start, written(tmp_path, scale=scale, T_world_obj=pose))
    refused("shape", files.load_start, written(tmp_path, scale=1.0, T_world_obj=[1, 2, 3]))
    refused("lacks T_world_obj", files.load_start, written(tmp_path, scale=1.0))


# --- Pictures of a scale fit: colours mean what they say, and every case can be drawn.

SMALL = ShadingConfig(size_px=120)
ONE = replace(SMALL, sides_deg=((30.0, 22.0),))


@pytest.fixture(scope="module")
def mug():
    return known_scan("mug", 1)


@pytest.fixture(scope="module")
def fit(mug):
    return fit_of(mug)


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
def test_a_mesh_has_the_colour_of_its_residual(mug, value, count):
    mesh = mug.real
    picture = painted(mesh, np.full(len(mesh.vertices), value))
    drawn = np.any(picture != 255, axis=-1)
    assert 0.1 < drawn.mean() < 0.9
    assert count(picture.astype(int)) > 0.9 * drawn.sum()


@pytest.mark.slow
def test_a_scale_that_is_too_great_is_blue_and_one_too_small_is_red():
    solid = known_scan("bottle", 1)  # without an inside, whose residuals have the other sign
    pictures = (residuals_png(solid.scan, fit_of(solid, f), SMALL) for f in (1.08, 0.92))
    head, bar = 60, 150  # neither the coloured title nor the colour bar
    great, small = (decoded(png)[head:, :-bar] for png in pictures)
    assert bluish(great) > 3 * reddish(great)
    assert reddish(small) > 3 * bluish(small)


# --- figures ----------------------------------------------------------------------------------


def test_a_view_that_was_left_out_is_marked(fit):
    kept = replace(fit, views=tuple(replace(v, used=True) for v in fit.views))
    assert reddish(decoded(views_png(fit))) > reddish(decoded(views_png(kept))) + 500


def test_what_cannot_be_drawn_is_named(mug, fit):
    refused("not of each other", residuals_png, mug.scan, replace(fit, residual_mm=np.zeros(3)))
    refused("no views", views_png, replace(fit, views=()))
    refused("no candidates", candidates_png, replace(fit, candidates=()))
    refused("no photographs", overlays_png, mug.scan, fit, mug.views.intrinsics, ())


# --- overlays ---------------------------------------------------------------------------------


def test_overlays_are_drawn(mug, fit):
    count = 3
    camera = mug.views.intrinsics
    photographs = [
        Photograph(
            index=f.index, rgb=np.full((camera.height, camera.width, 3), 90, np.uint8),
            depth_m=f.depth_m, T_world_cam=f.T_world_cam,
        )
        for f in mug.views.frames[:count]
    ]  # fmt: skip
    image = decoded(overlays_png(mug.scan, fit, camera, photographs))
    yellow = (image[..., 0] > 200) & (image[..., 1] > 150) & (image[..., 2] < 90)
    assert yellow.sum() > 100 * count
