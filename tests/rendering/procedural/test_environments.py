"""Skies and rooms: formulas that are kept, light that adds up, a grey card that is mid-grey."""

from itertools import pairwise

import numpy as np
import pytest

from realsim.geometry.colors import luminance
from realsim.rendering.appearance import Environment
from realsim.rendering.procedural import rooms, skies
from realsim.rendering.procedural.choose import random_environment

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
