"""Compiled loops are found again by what they say, wherever the file lies and whoever they call."""

import importlib.util
import os
import sys
from pathlib import Path
from types import ModuleType

import pytest

from realsim.app.config.settings import find_config
from realsim.user_cache import user_cache

CALLED = """
from realsim.compiled import njit
SHIFT = {shift}

@njit
def called(x):
    return x + SHIFT
"""
LOOP = """
from realsim.compiled import njit
{brought}

@njit(inline="always")
def loop(x):
    return 2.0 * {called}(x)

@njit
def outer(x):
    return loop(x) + 1.0
"""


BY_NAME = {"brought": "from realsim_probe_called import called", "called": "called"}
BY_MODULE = {"brought": "import realsim_probe_called", "called": "realsim_probe_called.called"}


def clone(folder: Path, shift: float, way: dict[str, str] = BY_NAME) -> ModuleType:
    """Write both files to a folder, as a clone would, and import them from there."""
    folder.mkdir(exist_ok=True)
    loaded: list[ModuleType] = []
    texts = {
        "realsim_probe_called": CALLED.format(shift=shift),
        "realsim_probe_loop": LOOP.format(**way),
    }
    for name, text in texts.items():
        (folder / f"{name}.py").write_text(text)
        spec = importlib.util.spec_from_file_location(name, folder / f"{name}.py")
        assert spec is not None and spec.loader is not None
        loaded.append(importlib.util.module_from_spec(spec))
        sys.modules[name] = loaded[-1]
        spec.loader.exec_module(loaded[-1])
    return loaded[-1]


def test_a_clone_finds_what_another_compiled(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path / "cache"))
    first, second = clone(tmp_path / "a", 1.0), None
    assert first.outer(1.0) == 5.0
    assert sum(first.outer.stats.cache_misses.values()) == 1
    second = clone(tmp_path / "b", 1.0)
    assert second.outer(1.0) == 5.0
    assert sum(second.outer.stats.cache_hits.values()) == 1


@pytest.mark.parametrize("way", [BY_NAME, BY_MODULE])
def test_a_change_in_a_called_function_s_constant_is_noticed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, way: dict[str, str]
) -> None:
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path / "cache"))
    assert clone(tmp_path / "a", 1.0, way).outer(1.0) == 5.0
    assert clone(tmp_path / "b", 10.0, way).outer(1.0) == 23.0


def test_a_home_that_cannot_be_written_compiles_all_the_same(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "file").touch()
    for variable in ("NUMBA_CACHE_DIR", "XDG_CACHE_HOME"):
        monkeypatch.setenv(variable, str(tmp_path / "file"))
    assert clone(tmp_path / "a", 1.0).outer(2.0) == 7.0
    (tmp_path / "b").mkdir()
    (tmp_path / "b/__pycache__").touch()  # nor can anything lie beside the source
    assert clone(tmp_path / "b", 1.0).outer(2.0) == 7.0
    assert list(Path(os.environ["NUMBA_CACHE_DIR"]).glob("realsim_probe_loop/*.nbi"))


def test_a_user_without_a_home_has_no_files_there(monkeypatch: pytest.MonkeyPatch) -> None:
    for variable in ("HOME", "XDG_CACHE_HOME", "XDG_CONFIG_HOME", "REALSIM_CONFIG"):
        monkeypatch.delenv(variable, raising=False)
    monkeypatch.setattr("os.getuid", lambda: 2**31 - 7)  # that the system knows nothing of
    with pytest.raises(NotADirectoryError):
        user_cache("numba").mkdir(parents=True)
    assert find_config(None) is None
