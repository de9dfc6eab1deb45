"""Skies and rooms: formulas that are kept, light that adds up, a grey card that is mid-grey."""

import sys
from itertools import pairwise
from pathlib import Path

import cv2
import numpy as np
import pytest

from realsim.geometry.colors import luminance
from realsim.rendering.appearance import Environment
from realsim.rendering.procedural import rooms, skies
from realsim.rendering.procedural.choose import random_environment
from realsim.rendering.procedural.hdri import _mended, read_environment, split_sun
from realsim.rendering.procedural.skies import card_light, directions, solid_angles, sunny_sky
from refusals import refused

SEEDS = (0, 3, 5, 8, 15)


@pytest.fixture(scope="module")
def drawn() -> list[Environment]:
    return [random_environment(np.random.default_rng(s)) for s in SEEDS]


def test_a_grey_card_lying_flat_comes_out_mid_grey(drawn: list[Environment]) -> None:
    for e in drawn:
        # Counted here by brute force, over all texels.
        view, size = skies.directions(e.panorama.shape[0]), skies.solid_angles(e.panorama.shape[0])
        up = np.maximum(view[..., 2], 0) * size[:, None]
        sky = np.einsum("hw,hwc->c", up, e.panorama.astype(float)) / np.pi
        toward = np.array(e.sun_direction) / np.linalg.norm(e.sun_direction)
        card = 0.18 * (sky + max(toward[2], 0) * np.array(e.sun)) * e.exposure
        assert float(luminance(card)) == pytest.approx(0.18, rel=1e-3)
        # The white balance leaves at most a cast.
        assert card.max() / card.min() < 1.6


def test_the_same_seed_gives_the_same_surroundings(drawn: list[Environment]) -> None:
    again = random_environment(np.random.default_rng(SEEDS[2]))
    assert np.array_equal(again.panorama, drawn[2].panorama)
    assert again.sun == drawn[2].sun
    assert again.exposure == drawn[2].exposure
    assert len({e.panorama.tobytes() for e in drawn}) == len(drawn)


def test_panoramas_close_around_the_horizon(drawn: list[Environment]) -> None:
    for e in drawn:
        step = np.abs(np.roll(e.panorama, -1, 1) - e.panorama).mean((0, 2))
        assert step[-1] <= 1.05 * step[:-1].max() + 1e-6


def test_there_are_skies_with_suns_and_rooms(drawn: list[Environment]) -> None:
    names = " ".join(e.name for e in drawn)
    for word in ("room", "overcast", "clear sky", "golden hour"):
        assert word in names
    for e in drawn:
        assert e.panorama.shape == (256, 512, 3)
        if "room" in e.name or "overcast" in e.name:
            assert max(e.sun) == 0
        else:
            assert max(e.sun) > 0
            assert e.sun_direction[2] > 0


@pytest.mark.parametrize(("turbidity", "elevation"), [(2.2, 65.0), (6.0, 10.0)])
def test_the_clear_sky_is_preethams(turbidity: float, elevation: float) -> None:
    up = np.radians(elevation)
    sun = np.array([np.cos(up), 0.0, np.sin(up)])
    overhead = skies.clear_sky(np.array([0.0, 0.0, 1.0]), sun, turbidity)
    wanted = skies.zenith(np.pi / 2 - up, turbidity)[0]
    assert float(luminance(overhead)) == pytest.approx(wanted, rel=0.02)
    near, away = (
        skies.clear_sky(np.array([s * np.cos(up), 0.0, np.sin(up)]), sun, turbidity)
        for s in (1.0, -1.0)
    )
    assert luminance(near) > 2 * luminance(away)
    assert overhead[2] > 1.2 * overhead[0]  # blue


def test_the_zenith_luminance_of_a_known_sky() -> None:
    # T = 2, sun 45 deg: chi = (4/9 - 1/60) pi/2 = 0.671952; 3.1196 tan(chi) + 1.9882 = 4.4678.
    chi = (4 / 9 - 2 / 120) * np.pi / 2
    assert skies.zenith(np.pi / 4, 2.0)[0] == pytest.approx(3.1196 * np.tan(chi) + 1.9882)
    assert skies.zenith(np.pi / 4, 2.0)[0] == pytest.approx(4.468, abs=0.02)


def test_a_low_sun_is_redder_and_weaker() -> None:
    high, low = skies.sun_light(60.0, 3.0), skies.sun_light(5.0, 3.0)
    assert luminance(low) < 0.5 * luminance(high)
    assert low[0] / low[2] > 2 * high[0] / high[2]
    # About 80 to 110 klx reach the ground from a high sun.
    assert 75 < np.pi * luminance(high) < 115


def test_an_overcast_sky_is_three_times_brighter_overhead() -> None:
    rows = luminance(skies.overcast_sky(np.random.default_rng(1)).panorama).mean(1)
    horizon = rows[100]
    up = np.cos(np.pi * 100.5 / 256)
    assert rows[:8].mean() / horizon == pytest.approx(3 / (1 + 2 * up), rel=0.12)


def test_black_bodies_go_from_orange_to_blue() -> None:
    ratio = [skies.planck(k)[0] / skies.planck(k)[2] for k in (2000, 2700, 4000, 6500, 10000)]
    assert all(a > b for a, b in pairwise(ratio))
    np.testing.assert_allclose(skies.planck(6504), 1.0, atol=0.06)  # near D65, which is white
    assert float(luminance(skies.planck(2700))) == pytest.approx(1.0)


def test_lamps_light_a_card_as_much_as_their_form_factor_says() -> None:
    # A lamp of 2 x 2 m, 2 m overhead: form factor by the formula for a parallel square.
    panel = rooms.Panel(face=5, low=np.array([-1.0, -1.0]), high=np.array([1.0, 1.0]),
                        radiance=np.ones(3))  # fmt: skip
    low, high = np.array([-4.0, -4.0, -1.0]), np.array([4.0, 4.0, 1.0])
    got = rooms._on_face(4, np.zeros((1, 2)), low, high, [panel])
    x = 1 / np.sqrt(1 + 4.0)
    np.testing.assert_allclose(got[0], 4 / (2 * np.pi) * 2 * x * np.arctan(x), rtol=0.03)


# --- The user's panoramas: light kept, suns taken out, faults named.


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
    black = write_hdr(tmp_path / "black.hdr", np.zeros((64, 128, 3)))
    refused("black all over", read_environment, black)
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
    import mitsuba

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
    monkeypatch.setitem(sys.modules, "mitsuba", None)
    (tmp_path / "sky.exr").write_bytes(b"\x76\x2f\x31\x01" + bytes(100))
    refused(r"realsim\[photo\].*convert.*\.hdr", read_environment, tmp_path / "sky.exr")
