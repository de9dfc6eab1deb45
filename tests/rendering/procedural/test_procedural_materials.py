"""Procedural materials: seamless, repeatable, sane."""

import sys
from functools import lru_cache
from pathlib import Path

import cv2
import numpy as np
import pytest

from realsim.geometry.colors import light_of_bytes, luminance
from realsim.rendering.appearance import Material
from realsim.rendering.procedural import choose, noise
from realsim.rendering.procedural.texture_folder import (
    PLAIN_ROUGHNESS,
    kind_of,
    material_from_images,
)
from refusals import refused

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
    drawn = {*choose.TABLE_KINDS, *choose.OBJECT_KINDS, *choose.FLOOR_KINDS}
    assert drawn <= set(choose.KINDS)
    assert len(set(choose.TABLE_KINDS)) >= 16
    for draw in (choose.table_material, choose.object_material):
        seen = {draw(np.random.default_rng(s)).name for s in range(3)}
        assert len(seen) > 1
        assert not seen & {"carpet"}
    assert choose.floor_material(np.random.default_rng(0)).period_m >= choose.LEAST_FLOOR_PERIOD_M


def test_an_unknown_kind_is_named_with_those_there_are() -> None:
    told, rng = r"no material 'unobtainium'.*oak.*can be made", np.random.default_rng(0)
    refused(told, choose.random_material, rng, "unobtainium")


def test_the_slope_of_a_normal_is_that_of_the_height_field() -> None:
    n, period_m, height_m = 256, 0.2, 0.001
    u, _ = noise.grid(n)
    wave = np.broadcast_to(height_m * np.sin(2 * np.pi * u), (n, n)).astype(np.float32)
    normal = (noise.normals8(wave, period_m) - 128.0) / 127.0
    steepest = 2 * np.pi * height_m / period_m
    assert np.max(-normal[..., 0] / normal[..., 2]) == pytest.approx(steepest, abs=0.008)


# --- Texture packs: maps known by their names, missing ones named with what stands for them.


def write(path: Path, rgb: tuple[int, int, int], size: tuple[int, int] = (32, 32)) -> Path:
    image = np.full((*size, 3), rgb[::-1], np.uint8)
    image[: size[0] // 2] = np.clip(np.array(rgb[::-1]) + 10, 0, 255)
    assert cv2.imwrite(str(path), image)
    return path


@pytest.mark.parametrize(
    ("name", "kind"),
    [
        ("wood_table_diff_2k.jpg", "color"), ("Wood049_1K-JPG_Color.jpg", "color"),
        ("oak_BaseColor.png", "color"), ("oak-albedo.png", "color"),
        ("wood_table_rough_2k.png", "roughness"), ("Wood049_1K_Roughness.jpg", "roughness"),
        ("brick_nor_gl_4k.png", "normal"), ("Bricks_NormalGL.png", "normal"),
        ("brick_nor_dx_4k.png", "normal_dx"), ("Bricks_NormalDX.png", "normal_dx"),
        ("steel_metal.png", "metallic"), ("steel_Metalness.png", "metallic"),
        ("x_arm_1k.png", "packed"), ("x_ao_1k.png", "unused"), ("x_disp_1k.png", "unused"),
        ("x_glossiness.png", "gloss"), ("holiday.png", None),
    ],
)  # fmt: skip
def test_maps_are_known_by_the_end_of_their_names(name: str, kind: str | None) -> None:
    assert kind_of(Path(name)) == kind


def test_a_whole_pack_becomes_a_material(tmp_path: Path) -> None:
    write(tmp_path / "oak_diff_1k.png", (200, 120, 40))
    write(tmp_path / "oak_rough_1k.png", (90, 90, 90))
    write(tmp_path / "oak_nor_gl_1k.png", (128, 140, 250))
    write(tmp_path / "oak_metal_1k.png", (0, 0, 0))
    write(tmp_path / "oak_ao_1k.png", (255, 255, 255))
    notes: list[str] = []
    m = material_from_images(tmp_path, 0.4, notes=notes)
    assert m.base_color_image is not None and m.roughness_image is not None
    assert m.normal_image is not None
    assert tuple(m.base_color_image[-1, 0]) == (200, 120, 40)
    assert m.roughness_image[-1, 0] == 90 and m.roughness == 1.0
    assert tuple(m.normal_image[-1, 0]) == (128, 140, 250)
    assert m.metallic == pytest.approx(0.02, abs=0.02)
    assert m.period_m == 0.4 and m.projection == "box" and m.name == tmp_path.name
    assert notes == []


def test_directx_normals_and_gloss_are_turned_round(tmp_path: Path) -> None:
    write(tmp_path / "a_color.png", (10, 10, 10))
    write(tmp_path / "a_NormalDX.png", (100, 140, 250))
    write(tmp_path / "a_gloss.png", (60, 60, 60))
    m = material_from_images(tmp_path, 0.1)
    assert m.normal_image is not None and m.roughness_image is not None
    assert tuple(m.normal_image[-1, 0]) == (100, 115, 250)
    assert m.roughness_image[-1, 0] == 195


def test_one_picture_is_the_base_colour_and_the_rest_is_named(tmp_path: Path) -> None:
    notes: list[str] = []
    m = material_from_images(write(tmp_path / "holiday.png", (200, 120, 40)), 0.25, notes=notes)
    assert m.base_color_image is not None and m.roughness_image is None
    assert m.roughness == PLAIN_ROUGHNESS and m.metallic == 0 and m.normal_image is None
    text = " ".join(notes)
    assert "no roughness map; it is 0.6" in text
    assert "no metallic map; it is no metal" in text
    assert "no normal map; the surface is flat" in text


def test_a_wide_picture_is_repeated_and_an_odd_one_stretched_with_a_note(tmp_path: Path) -> None:
    notes: list[str] = []
    wide = material_from_images(write(tmp_path / "w.png", (9, 9, 9), (16, 32)), 0.2, notes=notes)
    assert wide.base_color_image is not None
    assert wide.base_color_image.shape == (32, 32, 3)
    assert np.array_equal(wide.base_color_image[:16], wide.base_color_image[16:])
    assert not any("stretched" in n for n in notes)
    odd = material_from_images(write(tmp_path / "o.png", (9, 9, 9), (20, 32)), 0.2, notes=notes)
    assert odd.base_color_image is not None and odd.base_color_image.shape == (32, 32, 3)
    assert any("32x20; it is stretched" in n for n in notes)


def test_sixteen_bits_and_alpha_are_read(tmp_path: Path) -> None:
    cv2.imwrite(str(tmp_path / "a_rough.png"), np.full((8, 8), 257 * 77, np.uint16))
    cv2.imwrite(str(tmp_path / "a_color.png"), np.full((8, 8, 4), (1, 2, 3, 128), np.uint8))
    m = material_from_images(tmp_path, 0.1)
    assert m.roughness_image is not None and m.base_color_image is not None
    assert m.roughness_image[0, 0] == 77
    assert tuple(m.base_color_image[0, 0]) == (3, 2, 1)


def test_bad_packs_are_named(tmp_path: Path) -> None:
    refused("holds no picture", material_from_images, tmp_path, 0.1)
    refused("does not exist", material_from_images, tmp_path / "gone", 0.1)
    refused("no picture was given", material_from_images, [], 0.1)
    a, b = write(tmp_path / "a_diff.png", (1, 1, 1)), write(tmp_path / "b_color.png", (1, 1, 1))
    refused(r"both a_diff\.png and b_color\.png are its color", material_from_images, [a, b], 0.1)
    refused("has no size", material_from_images, a, 0.0)
    rough = write(tmp_path / "c_rough.png", (1, 1, 1))
    nor = write(tmp_path / "c_nor.png", (1, 1, 1))
    refused(r"none of .* is the base colour", material_from_images, [rough, nor], 0.1)
    a.write_bytes(b"abc")
    refused("cannot be decoded", material_from_images, a, 0.1)


def test_an_exr_normal_map_without_a_reader_is_left_out_with_a_note(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "mitsuba", None)
    write(tmp_path / "a_diff.png", (1, 1, 1))
    (tmp_path / "a_nor_gl.exr").write_bytes(b"\x76\x2f\x31\x01" + bytes(100))
    notes: list[str] = []
    assert material_from_images(tmp_path, 0.1, notes=notes).normal_image is None
    assert any("realsim[photo]" in n and "flat" in n for n in notes)
