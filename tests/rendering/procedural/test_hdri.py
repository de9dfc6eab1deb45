"""The user's panoramas: light kept, suns taken out, faults named."""

from pathlib import Path

import cv2
import numpy as np
import pytest

from realsim.errors import InputError
from realsim.geometry.colors import luminance
from realsim.rendering.procedural.hdri import read_environment, split_sun
from realsim.rendering.procedural.skies import card_light, directions, solid_angles, sunny_sky
from refusals import refused


def write_hdr(path: Path, rgb: np.ndarray) -> Path:
    assert cv2.imwrite(str(path), np.ascontiguousarray(rgb[..., ::-1].astype(np.float32)))
    return path


def sky_with_sun(height: int = 256, radius_deg: float = 0.8, peak: float = 4e4) -> np.ndarray:
    e = sunny_sky(np.random.default_rng(3), 40.0, 3.0, 0.0)
    panorama = cv2.resize(e.panorama, (2 * height, height), interpolation=cv2.INTER_AREA)
    near = directions(height) @ np.array(e.sun_direction) > np.cos(np.radians(radius_deg))
    panorama[near] = peak * np.array([1.0, 0.9, 0.7])
    return panorama


def irradiance(panorama: np.ndarray, normal: np.ndarray) -> np.ndarray:
    view, size = directions(panorama.shape[0]), solid_angles(panorama.shape[0])
    weight = np.maximum(view @ normal, 0) * size[:, None]
    return np.einsum("hw,hwc->c", weight, panorama.astype(float))


def test_the_sun_that_is_taken_out_leaves_all_light_as_it_was() -> None:
    panorama = sky_with_sun()
    rest, sun, toward, radius = split_sun(panorama)
    assert min(sun) > 0
    assert 0.4 < radius < 1.6
    assert rest.max() < 0.05 * panorama.max()
    for normal in ([0, 0, 1], [0.6, 0, 0.8], list(toward)):
        n = np.array(normal) / np.linalg.norm(normal)
        after = irradiance(rest, n) + np.pi * max(n @ np.array(toward), 0) * np.array(sun)
        np.testing.assert_allclose(after, irradiance(panorama, n), rtol=3e-3)


def test_the_sun_is_found_where_it_was_put() -> None:
    e = sunny_sky(np.random.default_rng(3), 40.0, 3.0, 0.0)
    _, _, toward, _ = split_sun(sky_with_sun())
    assert np.degrees(np.arccos(np.array(toward) @ np.array(e.sun_direction))) < 0.5


def test_a_sky_without_a_sun_and_a_broad_lamp_stay_as_they_are() -> None:
    e = sunny_sky(np.random.default_rng(3), 40.0, 3.0, 0.0)
    for panorama in (e.panorama, sky_with_sun(radius_deg=15.0, peak=100.0)):
        rest, sun, _, _ = split_sun(panorama)
        assert max(sun) == 0
        assert np.array_equal(rest, panorama)


def test_an_hdr_file_is_read_with_its_sun_and_mid_grey(tmp_path: Path) -> None:
    path = write_hdr(tmp_path / "sky.hdr", sky_with_sun())
    notes: list[str] = []
    e = read_environment(path, notes=notes)
    assert max(e.sun) > 0
    assert "sun 40 deg" in " ".join(notes)
    card = 0.18 * card_light(e.panorama, e.sun, e.sun_direction) * e.exposure
    assert float(luminance(card)) == pytest.approx(0.18, rel=1e-6)
    assert read_environment(path, exposure=0.5).exposure == 0.5


def test_columns_are_turned_round_because_viewers_turn_clockwise(tmp_path: Path) -> None:
    panorama = np.full((64, 128, 3), 0.1, np.float32)
    panorama[20:40, 10:20] = (1.0, 0.0, 0.0)
    e = read_environment(write_hdr(tmp_path / "a.hdr", panorama))
    view = directions(64)
    red = e.panorama[..., 0] > 0.5
    # A little to the right of the left border is a little clockwise of +x: towards -y.
    assert view[red][:, 1].max() < 0
    assert view[red][:, 0].min() > 0


def test_large_panoramas_are_reduced_with_their_light(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    big = cv2.resize(rng.uniform(0.2, 2, (60, 120, 3)).astype(np.float32), (2100, 1050))
    notes: list[str] = []
    e = read_environment(write_hdr(tmp_path / "big.hdr", big), exposure=1.0, notes=notes)
    assert e.panorama.shape == (1024, 2048, 3)
    assert "reduced from 2100x1050" in " ".join(notes)
    want = irradiance(big, np.array([0, 0, 1.0]))
    np.testing.assert_allclose(irradiance(e.panorama, np.array([0, 0, 1.0])), want, rtol=0.01)


def test_values_that_are_no_light_are_named_and_mended() -> None:
    from realsim.rendering.procedural.hdri import _mended

    bad = np.ones((4, 8, 3), np.float32)
    bad[0, 0], bad[1, 1, 0], bad[2, 2] = np.nan, np.inf, -3.0
    notes: list[str] = []
    out = _mended(bad, Path("x.exr"), notes)
    assert "3 not a number, 1 infinite, 3 negative" in notes[0]
    assert np.isfinite(out).all()
    assert out.min() == 0
    assert out[1, 1, 0] == 1
    clean: list[str] = []
    _mended(np.ones((4, 8, 3), np.float32), Path("x.exr"), clean)
    assert clean == []


def test_bad_files_are_named(tmp_path: Path) -> None:
    square = write_hdr(tmp_path / "square.hdr", np.ones((64, 64, 3)))
    refused(r"64x64.*twice as wide", read_environment, square)
    with pytest.raises(InputError, match="black all over"):
        read_environment(write_hdr(tmp_path / "black.hdr", np.zeros((64, 128, 3))))
    refused("does not exist", read_environment, tmp_path / "gone.hdr")
    refused(r"'\.pdf' is no picture", read_environment, tmp_path / "x.pdf")
    for name in ("cut.hdr", "cut.png", "empty.hdr"):
        data = (tmp_path / "square.hdr").read_bytes()[:60] if "cut" in name else b""
        (tmp_path / name).write_bytes(data)
        refused("cannot be decoded", read_environment, tmp_path / name)
    (tmp_path / "not.exr").write_bytes(b"hello")
    refused("not an OpenEXR file", read_environment, tmp_path / "not.exr")
    refused("positive number", read_environment, square, exposure=-1.0)


def test_openexr_is_read_where_mitsuba_is_installed(tmp_path: Path) -> None:
    mitsuba = pytest.importorskip("mitsuba")
    if mitsuba.variant() is None:
        mitsuba.set_variant("scalar_rgb")
    panorama = sky_with_sun(64, 3.0)
    mitsuba.Bitmap(panorama).write(str(tmp_path / "sky.exr"))
    a = read_environment(tmp_path / "sky.exr", exposure=1.0)
    b = read_environment(write_hdr(tmp_path / "sky.hdr", panorama), exposure=1.0)
    np.testing.assert_allclose(a.panorama, b.panorama, rtol=0.02, atol=0.02 * panorama.mean())
    np.testing.assert_allclose(a.sun, b.sun, rtol=0.02)


def test_openexr_without_a_reader_says_what_to_do(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    import sys

    monkeypatch.setitem(sys.modules, "mitsuba", None)
    (tmp_path / "sky.exr").write_bytes(b"\x76\x2f\x31\x01" + bytes(100))
    refused(r"realsim\[photo\].*convert.*\.hdr", read_environment, tmp_path / "sky.exr")
