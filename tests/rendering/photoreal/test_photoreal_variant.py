"""Which variant renders, what is said when it is not the fast one, and that seeds reproduce."""

import json
import sys
from pathlib import Path

import numpy as np
import pytest

from llvm_library import NEEDS_LLVM
from plain_meshes import box
from realsim.errors import InputError, MissingLibraryError
from realsim.geometry import se3
from realsim.records import CameraIntrinsics
from realsim.rendering.appearance import Environment
from realsim.rendering.photoreal import PhotorealConfig, PhotorealRenderer, find_llvm, llvm_probe
from realsim.rendering.photoreal.tracing import denoised
from realsim.rendering.rays import PlacedMesh

CAMERA = CameraIntrinsics(width=48, height=36, fx=50.0, fy=50.0, cx=23.5, cy=17.5)
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
    llvm_probe._find_llvm.cache_clear()  # pyright: ignore[reportPrivateUsage]
    return tmp_path / "cache" / "realsim" / "llvm_libraries.json"


def test_the_same_seed_gives_the_same_bytes() -> None:
    config = PhotorealConfig(variant="scalar", samples=4)
    first, second = (PhotorealRenderer(scene(), SKY, config) for _ in range(2))
    a = first.render(CAMERA, VIEW, np.random.default_rng(5)).rgb
    other = first.render(CAMERA, VIEW, np.random.default_rng(6)).rgb
    assert np.array_equal(a, second.render(CAMERA, VIEW, np.random.default_rng(5)).rgb)
    assert not np.array_equal(a, other)


@NEEDS_LLVM
@pytest.mark.slow
def test_both_variants_make_the_same_picture() -> None:
    a, b = (
        PhotorealRenderer(scene(), SKY, PhotorealConfig(variant=v, samples=64)).render(CAMERA, VIEW)
        for v in ("llvm", "scalar")
    )
    config = PhotorealConfig(variant="llvm", samples=64)
    assert np.array_equal(a.rgb, PhotorealRenderer(scene(), SKY, config).render(CAMERA, VIEW).rgb)
    difference = np.abs(a.rgb.astype(float) - b.rgb.astype(float))
    assert np.median(difference) <= 1 and difference.mean() < 2
    assert np.allclose(a.depth_m, b.depth_m, rtol=1e-5, atol=0)


def test_the_denoiser_keeps_even_light_even_up_to_the_corners() -> None:
    even = np.full((45, 60, 3), 0.4, np.float32)
    noisy = even * np.random.default_rng(0).uniform(0.9, 1.1, even.shape).astype(np.float32)
    normal = np.broadcast_to(np.array([0, 0, 1], np.float32), even.shape)
    clean = denoised(noisy, even, normal)
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
    assert np.array_equal(renderer.render(CAMERA, VIEW).rgb, without.render(CAMERA, VIEW).rgb)


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
    kept = json.loads(verdicts.read_text())
    assert len(kept) == 1  # only the one that had to be tried


def test_a_verdict_is_kept_until_the_library_changes(
    tmp_path: Path, verdicts: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(llvm_probe, "_try_out", lambda library: "it ended")
    library = tmp_path / "libLLVM.so.21.0"
    library.write_bytes(b"not a library")
    patterns = (f"{tmp_path}/libLLVM*.so*",)
    assert find_llvm(patterns).library is None
    kept = json.loads(verdicts.read_text())
    verdicts.write_text(json.dumps(dict.fromkeys(kept, "")))  # as if it had worked
    llvm_probe._find_llvm.cache_clear()  # pyright: ignore[reportPrivateUsage]
    assert find_llvm(patterns).library == library
    library.write_bytes(b"another file")
    llvm_probe._find_llvm.cache_clear()  # pyright: ignore[reportPrivateUsage]
    assert find_llvm(patterns).library is None


def test_llvm_asked_for_and_not_there_is_an_error_that_offers_the_other(
    tmp_path: Path, verdicts: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delitem(sys.modules, "drjit", raising=False)
    monkeypatch.setattr(llvm_probe, "library_patterns", lambda: (f"{tmp_path}/libLLVM*.so*",))
    with pytest.raises(InputError, match=r"'llvm' was asked for.*libllvm19.*'scalar'"):
        PhotorealRenderer([], SKY, PhotorealConfig(variant="llvm", samples=1))
    assert not verdicts.exists()


def test_without_llvm_the_scalar_variant_renders_and_says_so(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    from realsim.rendering.photoreal import variant

    monkeypatch.setattr(variant, "_prepare_llvm", lambda: "no library was found")
    renderer = PhotorealRenderer([], SKY, PhotorealConfig(samples=1))
    assert renderer.variant == "scalar_rgb"
    assert any("without LLVM" in n and "no library was found" in n for n in renderer.notes)


def test_without_mitsuba_the_extra_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "mitsuba", None)
    with pytest.raises(MissingLibraryError, match=r"realsim\[photo\]"):
        PhotorealRenderer([], SKY, PhotorealConfig(variant="scalar", samples=1))


@pytest.mark.parametrize(
    "bad", [{"samples": 0}, {"max_depth": 0}, {"psf_px": -1.0}, {"variant": "cuda"}]
)
def test_a_config_out_of_range_is_named(bad: dict[str, object]) -> None:
    with pytest.raises(InputError, match=str(next(iter(bad.values())))):
        PhotorealConfig(**bad)  # pyright: ignore[reportArgumentType]
