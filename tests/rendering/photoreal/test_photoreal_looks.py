"""Materials look as the records say: images the right way up, paint, normals, projection."""

import json
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from llvm_library import NEEDS_LLVM
from plain_meshes import box, square
from realsim.errors import MissingLibraryError
from realsim.geometry import se3
from realsim.geometry.colors import srgb_decoded
from realsim.records import CameraIntrinsics
from realsim.rendering.appearance import Environment, Material
from realsim.rendering.embedded.materials import PLAIN_COLORS
from realsim.rendering.photoreal import PhotorealConfig, PhotorealRenderer, find_llvm, variant
from realsim.rendering.photoreal.renderer import denoised
from realsim.rendering.rays import PlacedMesh
from refusals import refused

CAMERA = CameraIntrinsics(width=32, height=32, fx=32.0, fy=32.0, cx=15.5, cy=15.5)
FROM_ABOVE = se3.look_at([0.0, 0.0, 1.0], [0.0, 0.0, 0.0])
"""Looking straight down, the picture's right is the world's x and its top the world's y."""
WHITE_ROOM = Environment(panorama=np.full((4, 8, 3), 0.5, np.float32))
HUE = 0.12
"""The coat adds some white; a wrong image or paint is 0.3 or more off."""
COLORS = np.array([[[220, 30, 30], [30, 220, 30]], [[30, 30, 220], [220, 220, 30]]], np.uint8)


def picture(placed: PlacedMesh, sky: Environment = WHITE_ROOM) -> np.ndarray:
    config = PhotorealConfig(variant="scalar", samples=16, denoise=False, psf_px=0)
    return PhotorealRenderer([placed], sky, config).render(CAMERA, FROM_ABOVE).rgb.astype(float)


def quadrants(rgb: np.ndarray) -> np.ndarray:
    return np.array([[rgb[4:12, 4:12].mean((0, 1)), rgb[4:12, 20:28].mean((0, 1))],
                     [rgb[20:28, 4:12].mean((0, 1)), rgb[20:28, 20:28].mean((0, 1))]])  # fmt: skip


def hues(colors: np.ndarray) -> np.ndarray:
    linear = srgb_decoded(np.asarray(colors, float) / 255.0)
    return linear / linear.sum(-1, keepdims=True)


def test_a_texture_s_first_row_is_at_the_top_of_v() -> None:
    image = np.repeat(np.repeat(COLORS, 16, 0), 16, 1)
    own = PlacedMesh(0, replace(square(), texture=image), np.eye(4))
    material = Material(base_color=(1, 1, 1), base_color_image=image, projection="uv")
    for placed in (own, PlacedMesh(0, square(), np.eye(4), material)):
        assert np.abs(hues(quadrants(picture(placed))) - hues(COLORS)).max() < HUE


def test_box_projection_repeats_the_image_every_period_along_the_face() -> None:
    image = np.repeat(np.repeat(COLORS, 16, 0), 16, 1)
    material = Material(base_color=(1, 1, 1), base_color_image=image, period_m=1.0)
    mesh = replace(square(), uv=None)
    # u = x and v = y: half a tile further the image begins anew, so quadrants change places.
    seen = quadrants(picture(PlacedMesh(0, mesh, np.eye(4), material)))
    assert np.abs(hues(seen) - hues(COLORS[::-1, ::-1])).max() < HUE
    halved = Material(base_color=(1, 1, 1), base_color_image=image, period_m=0.5)
    seen = quadrants(picture(PlacedMesh(0, mesh, np.eye(4), halved)))
    assert np.ptp(seen, axis=(0, 1)).max() < 12  # a whole tile in each quadrant


def test_vertex_colours_and_paints_are_seen_as_they_are() -> None:
    color = np.array([200, 60, 90], np.uint8)
    mesh = replace(square(), colors=np.tile(color, (4, 1)))
    seen = picture(PlacedMesh(0, mesh, np.eye(4)))[8:24, 8:24].mean((0, 1))
    assert np.abs(hues(seen) - hues(color)).max() < HUE
    seen = picture(PlacedMesh(13, square(), np.eye(4)))[8:24, 8:24].mean((0, 1))
    assert np.abs(hues(seen) - hues(np.array(PLAIN_COLORS[13 % len(PLAIN_COLORS)]))).max() < HUE


def tilted(x: float, y: float) -> np.ndarray:
    normal = np.array([x, y, 1.0]) / np.linalg.norm([x, y, 1.0])
    return np.tile(np.round(128 + 127 * normal).astype(np.uint8), (4, 4, 1))


def lit_from(x: float, y: float) -> Environment:
    return Environment(panorama=np.zeros((4, 8, 3), np.float32), sun=(0.5, 0.5, 0.5),
                       sun_direction=(x, y, 1.0), sun_radius_deg=0)  # fmt: skip


@pytest.mark.parametrize(("axis", "mirrored"), [(0, True), (1, False)])
def test_a_normal_image_tilts_the_surface_towards_u_and_v(axis: int, mirrored: bool) -> None:
    uv = square().uv * [-1, 1] + [1, 0] if mirrored else square().uv
    tilt = np.eye(2)[axis] * 0.5
    material = Material(base_color=(0.8, 0.8, 0.8), roughness=1.0, projection="uv",
                        normal_image=tilted(*tilt))  # fmt: skip
    placed = PlacedMesh(0, replace(square(), uv=uv), np.eye(4), material)
    along = tilt * (-1 if mirrored and axis == 0 else 1)
    facing = picture(placed, lit_from(*along))[8:24, 8:24].mean()
    averted = picture(placed, lit_from(*-along))[8:24, 8:24].mean()
    assert facing > 1.25 * averted


def test_metal_mirrors_the_room_in_its_own_colour() -> None:
    sky = np.zeros((16, 32, 3), np.float32)
    sky[:4] = 0.6  # the ceiling, which a level mirror shows to a camera above it
    metal = Material(base_color=(0.9, 0.45, 0.1), roughness=0.04, metallic=1.0)
    seen = picture(PlacedMesh(0, square(), np.eye(4), metal), Environment(panorama=sky))
    light = srgb_decoded(seen[10:22, 10:22].mean((0, 1)) / 255)
    assert np.abs(light - 0.6 * np.array(metal.base_color)).max() < 0.04


def test_a_material_that_needs_coordinates_on_a_mesh_without_is_named() -> None:
    mesh = replace(square(), uv=None)
    material = Material(base_color_image=COLORS, projection="uv", name="label")
    placed, config = [PlacedMesh(4, mesh, np.eye(4), material)], PhotorealConfig(variant="scalar")
    refused("label.*box", PhotorealRenderer, placed, WHITE_ROOM, config)


# --- Which variant renders, what is said when it is not the fast one, and that seeds reproduce.

VARIANT_CAMERA = CameraIntrinsics(width=48, height=36, fx=50.0, fy=50.0, cx=23.5, cy=17.5)
VIEW = se3.look_at([0.2, -0.25, 0.3], [0, 0, 0])
SKY = Environment(
    panorama=np.linspace(0.2, 0.9, 8 * 16 * 3, dtype=np.float32).reshape(8, 16, 3),
    sun=(0.4, 0.4, 0.35),
)


def scene() -> list[PlacedMesh]:
    return [PlacedMesh(-1, box((1.0, 1.0, 0.02)), se3.from_translation([0, 0, -0.01])),
            PlacedMesh(2, box((0.1, 0.1, 0.1)), se3.from_translation([0, 0, 0.05]))]  # fmt: skip


@pytest.fixture
def verdicts(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The search begins from nothing: no library named, no verdict kept."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    monkeypatch.delenv("DRJIT_LIBLLVM_PATH", raising=False)
    variant._find_llvm.cache_clear()  # pyright: ignore[reportPrivateUsage]
    return tmp_path / "cache" / "realsim" / "llvm_libraries.json"


def test_the_same_seed_gives_the_same_bytes() -> None:
    config = PhotorealConfig(variant="scalar", samples=4)
    first, second = (PhotorealRenderer(scene(), SKY, config) for _ in range(2))
    a = first.render(VARIANT_CAMERA, VIEW, np.random.default_rng(5)).rgb
    other = first.render(VARIANT_CAMERA, VIEW, np.random.default_rng(6)).rgb
    assert np.array_equal(a, second.render(VARIANT_CAMERA, VIEW, np.random.default_rng(5)).rgb)
    assert not np.array_equal(a, other)


@NEEDS_LLVM
@pytest.mark.slow
def test_both_variants_make_the_same_picture() -> None:
    a, again, b = (
        PhotorealRenderer(scene(), SKY, PhotorealConfig(variant=v, samples=64)).render(
            VARIANT_CAMERA, VIEW
        )
        for v in ("llvm", "llvm", "scalar")
    )
    assert np.array_equal(a.rgb, again.rgb)
    difference = np.abs(a.rgb.astype(float) - b.rgb.astype(float))
    assert np.median(difference) <= 1 and difference.mean() < 2
    assert np.allclose(a.depth_m, b.depth_m, rtol=1e-5, atol=0)


def test_the_denoiser_keeps_even_light_even_up_to_the_corners() -> None:
    even = np.full((45, 60, 3), 0.4, np.float32)
    noisy = even * np.random.default_rng(0).uniform(0.9, 1.1, even.shape).astype(np.float32)
    clean = denoised(noisy, even, np.broadcast_to(np.array([0, 0, 1], np.float32), even.shape))
    assert clean.shape == even.shape
    assert np.abs(clean / even - 1).max() < 0.06


def test_without_the_denoiser_the_picture_comes_with_a_note(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setitem(sys.modules, "pyoidn", None)
    config = PhotorealConfig(variant="scalar", samples=1)
    renderer = PhotorealRenderer(scene(), SKY, config)
    assert any("realsim[photo]" in note for note in renderer.notes)
    plain = PhotorealConfig(variant="scalar", samples=1, denoise=False)
    without = PhotorealRenderer(scene(), SKY, plain)
    assert without.notes == ()
    a, b = (r.render(VARIANT_CAMERA, VIEW).rgb for r in (renderer, without))
    assert np.array_equal(a, b)


def test_a_search_that_finds_nothing_says_where_it_looked_and_how_to_get_one(
    tmp_path: Path, verdicts: Path
) -> None:
    search = find_llvm((f"{tmp_path}/libLLVM*.so*",))
    assert search.library is None
    for part in (str(tmp_path), "libllvm19", "karellen-llvm-core", "DRJIT_LIBLLVM_PATH"):
        assert part in str(search)
    assert not verdicts.exists()


def test_libraries_that_cannot_work_are_named_with_the_reason(
    tmp_path: Path, verdicts: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name in ("libLLVM-15.so.1", "libLLVM.so.20.1"):
        (tmp_path / name).write_bytes(b"not a library")
    monkeypatch.setenv("DRJIT_LIBLLVM_PATH", str(tmp_path / "absent.so"))
    search = find_llvm((f"{tmp_path}/libLLVM*.so*",))
    assert search.library is None
    assert [r.split(": ")[0].rsplit("/")[-1] for r in search.rejected] == [
        "absent.so", "libLLVM.so.20.1", "libLLVM-15.so.1",
    ]  # fmt: skip
    assert "no such file" in search.rejected[0]
    assert "trial picture ended with" in search.rejected[1]
    assert "too old" in search.rejected[2]
    assert len(json.loads(verdicts.read_text())) == 1  # only the one that had to be tried


def test_a_verdict_is_kept_until_the_library_changes(
    tmp_path: Path, verdicts: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(variant, "_try_out", lambda library: "it ended")
    library = tmp_path / "libLLVM.so.21.0"
    library.write_bytes(b"not a library")
    patterns = (f"{tmp_path}/libLLVM*.so*",)
    assert find_llvm(patterns).library is None
    kept = json.loads(verdicts.read_text())
    verdicts.write_text(json.dumps(dict.fromkeys(kept, "")))  # as if it had worked
    variant._find_llvm.cache_clear()  # pyright: ignore[reportPrivateUsage]
    assert find_llvm(patterns).library == library
    library.write_bytes(b"another file")
    variant._find_llvm.cache_clear()  # pyright: ignore[reportPrivateUsage]
    assert find_llvm(patterns).library is None


def test_llvm_asked_for_and_not_there_is_an_error_that_offers_the_other(
    tmp_path: Path, verdicts: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delitem(sys.modules, "drjit", raising=False)
    monkeypatch.setattr(variant, "library_patterns", lambda: (f"{tmp_path}/libLLVM*.so*",))
    told, config = "'llvm' was asked for.*libllvm19.*'scalar'", PhotorealConfig(variant="llvm")
    refused(told, PhotorealRenderer, [], SKY, config)
    assert not verdicts.exists()


def test_without_llvm_the_scalar_variant_renders_and_says_so(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    prepared = "realsim.rendering.photoreal.variant._prepare_llvm"
    monkeypatch.setattr(prepared, lambda: "no library was found")
    renderer = PhotorealRenderer([], SKY, PhotorealConfig(samples=1))
    assert renderer.variant == "scalar_rgb"
    assert any("without LLVM" in n and "no library was found" in n for n in renderer.notes)


def test_without_mitsuba_the_extra_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "mitsuba", None)
    config = PhotorealConfig(variant="scalar", samples=1)
    refused(r"realsim\[photo\]", PhotorealRenderer, [], SKY, config, error=MissingLibraryError)


@pytest.mark.parametrize(
    "bad", [{"samples": 0}, {"max_depth": 0}, {"psf_px": -1.0}, {"variant": "cuda"}]
)
def test_a_config_out_of_range_is_named(bad: dict[str, object]) -> None:
    refused(str(next(iter(bad.values()))), PhotorealConfig, **bad)  # pyright: ignore[reportArgumentType]
