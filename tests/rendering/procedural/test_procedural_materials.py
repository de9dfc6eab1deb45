"""Procedural materials: seamless, repeatable, sane."""

from functools import lru_cache

import numpy as np
import pytest

from realsim.errors import InputError
from realsim.geometry.colors import light_of_bytes, luminance
from realsim.rendering.appearance import Material
from realsim.rendering.procedural import choose, noise

EVERY_KIND = [
    pytest.param(kind, marks=() if k % 4 == 0 else pytest.mark.slow)
    for k, kind in enumerate(choose.KINDS)
]


@lru_cache(maxsize=128)
def made(kind: str, seed: int) -> Material:
    return choose.random_material(np.random.default_rng(seed), kind)


def images(material: Material) -> dict[str, np.ndarray]:
    found = {
        "color": material.base_color_image,
        "roughness": material.roughness_image,
        "normal": material.normal_image,
    }
    return {name: image for name, image in found.items() if image is not None}


def seam(image: np.ndarray, axis: int) -> tuple[float, float]:
    """Return the mean step across the wrap-around and the largest mean step inside."""
    value = image.astype(float)
    step = np.abs(np.roll(value, -1, axis) - value)
    mean = np.moveaxis(step, axis, 0).reshape(image.shape[axis], -1).mean(1)
    return float(mean[-1]), float(mean[:-1].max())


@pytest.mark.parametrize("kind", EVERY_KIND)
def test_every_kind_tiles_without_a_seam(kind: str) -> None:
    for name, image in images(made(kind, 0)).items():
        for axis in (0, 1):
            wrap, inside = seam(image, axis)
            assert wrap <= 1.02 * inside + 0.05, (kind, name, axis, wrap, inside)


def test_the_seam_of_a_cropped_tile_is_found() -> None:
    # The law above would be worth nothing if it did not see a tile that does not close.
    image = choose.random_material(np.random.default_rng(0), "concrete").base_color_image
    assert image is not None
    wrap, inside = seam(image[:400, :400], 0)
    assert wrap > 1.5 * inside


@pytest.mark.parametrize("kind", choose.KINDS[::12])
def test_the_same_seed_gives_the_same_bytes_and_another_seed_others(kind: str) -> None:
    a, c = images(made(kind, 0)), images(made(kind, 1))
    b = images(choose.random_material(np.random.default_rng(0), kind))
    assert a.keys() == b.keys()
    assert all(np.array_equal(a[name], b[name]) for name in a)
    assert a["color"].shape != c["color"].shape or not np.array_equal(a["color"], c["color"])


@pytest.mark.parametrize("kind", EVERY_KIND)
def test_reflectances_are_those_of_real_things(kind: str) -> None:
    m = made(kind, 0)
    assert m.base_color_image is not None
    side = m.base_color_image.shape[0]
    assert m.base_color_image.shape == (side, side, 3)
    assert 256 <= side <= 1024
    mean = float(luminance(light_of_bytes(m.base_color_image)).mean())
    # Between charcoal and fresh snow.
    assert 0.008 < mean < 0.9
    assert 0.01 <= m.period_m <= 1.0
    assert np.mean(np.all(m.base_color_image == 255, -1)) < 0.02
    if m.normal_image is not None:
        n = (m.normal_image.astype(np.float64) - 128.0) / 127.0
        np.testing.assert_allclose(np.linalg.norm(n, axis=-1), 1.0, atol=0.02)
        assert n[..., 2].min() > 0.1
        np.testing.assert_allclose(n.mean((0, 1))[:2], 0.0, atol=0.02)


def test_choices_draw_only_what_suits() -> None:
    assert set(choose.TABLE_KINDS) | set(choose.OBJECT_KINDS) | set(choose.FLOOR_KINDS) <= set(
        choose.KINDS
    )
    assert len(set(choose.TABLE_KINDS)) >= 16
    for draw in (choose.table_material, choose.object_material):
        seen = {draw(np.random.default_rng(s)).name for s in range(3)}
        assert len(seen) > 1
        assert not seen & {"carpet"}
    assert choose.floor_material(np.random.default_rng(0)).period_m >= choose.LEAST_FLOOR_PERIOD_M


def test_an_unknown_kind_is_named_with_those_there_are() -> None:
    with pytest.raises(InputError, match=r"no material 'unobtainium'.*oak.*can be made"):
        choose.random_material(np.random.default_rng(0), "unobtainium")


def test_the_slope_of_a_normal_is_that_of_the_height_field() -> None:
    n, period_m, height_m = 256, 0.2, 0.001
    u, _ = noise.grid(n)
    wave = np.broadcast_to(height_m * np.sin(2 * np.pi * u), (n, n)).astype(np.float32)
    normal = (noise.normals8(wave, period_m) - 128.0) / 127.0
    steepest = 2 * np.pi * height_m / period_m
    assert np.max(-normal[..., 0] / normal[..., 2]) == pytest.approx(steepest, abs=0.008)
