"""What is missing is named with what installs it, not with a traceback."""

import sys

import pytest

from realsim import app
from realsim.app.config import applied

SHARED = "libstdc++.so.6: cannot open shared object file: No such file or directory"


@pytest.mark.parametrize(
    ("missing", "words"),
    [
        (ImportError(SHARED, name="pinocchio"), ("pinocchio", "libstdc++6", "apt-get install")),
        (ModuleNotFoundError("No module named 'numba'", name="numba"),
         ("numba is not installed", "uv sync")),
        (ModuleNotFoundError("No module named 'realsim.nowhere'", name="realsim.nowhere"), ()),
    ],
    ids=lambda of: getattr(of, "name", ""),
)  # fmt: skip
def test_what_is_missing_ends_with_what_to_install_and_a_bug_with_its_place(
    missing: ImportError, words: tuple[str, ...],
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str],
) -> None:  # fmt: skip
    def load(*_: object, **__: object) -> None:
        raise missing

    monkeypatch.setattr(applied, "apply_config", load)
    monkeypatch.setattr(sys, "argv", ["realsim", "config", "show"])
    with pytest.raises(SystemExit if words else ModuleNotFoundError) as stop:
        app.main()
    if words:
        assert getattr(stop.value, "code", None) == 2
        said = capsys.readouterr().err
        assert all(w in said for w in (*words, "realsim doctor"))
