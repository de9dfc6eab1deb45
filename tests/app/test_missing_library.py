"""A missing library of the system is named with its Debian package, not with a traceback."""

import sys

import pytest

from realsim import app
from realsim.app.cli import main
from realsim.app.config import applied


def test_a_missing_shared_library_ends_with_what_to_install(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def missing(*_: object, **__: object) -> None:
        raise ImportError(
            "libstdc++.so.6: cannot open shared object file: No such file or directory",
            name="pinocchio",
        )

    monkeypatch.setattr(applied, "apply_config", missing)
    monkeypatch.setattr(sys, "argv", ["realsim", "config", "show"])
    with pytest.raises(SystemExit) as stop:
        main()
    assert stop.value.code == 2
    said = capsys.readouterr().err
    assert "pinocchio" in said and "libstdc++6" in said and "apt-get install" in said
    assert "realsim doctor" in said


@pytest.mark.parametrize(("module", "mended"), [("numba", True), ("realsim.nowhere", False)])
def test_a_missing_package_ends_with_what_to_install_and_a_bug_with_its_place(
    module: str, mended: bool, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def missing(*_: object, **__: object) -> None:
        raise ModuleNotFoundError(f"No module named '{module}'", name=module)

    monkeypatch.setattr(applied, "apply_config", missing)
    monkeypatch.setattr(sys, "argv", ["realsim", "config", "show"])
    with pytest.raises(SystemExit if mended else ModuleNotFoundError) as stop:
        app.main()
    if mended:
        assert getattr(stop.value, "code", None) == 2
        said = capsys.readouterr().err
        assert "numba is not installed" in said and "uv sync" in said and "realsim doctor" in said
