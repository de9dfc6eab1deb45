"""Completion in a real bash: commands, options, choices, plans and files, quickly."""

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from typed_commands import realsim

BASH = shutil.which("bash")
PLAN = "ur5_d405_hemisphere_256"


@pytest.fixture(scope="module")
def shim(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a program `realsim`, as an installation has."""
    folder = tmp_path_factory.mktemp("bin")
    program = folder / "realsim"
    program.write_text(f"#!{sys.executable}\nfrom realsim.app.cli import main\nmain()\n")
    program.chmod(0o755)
    return folder


def bash(shim: Path, script: str, cwd: Path) -> str:
    assert BASH is not None
    done = subprocess.run(
        [BASH, "--norc", "-c", f'eval "$(realsim completion bash)"\n{script}'],
        capture_output=True, text=True, cwd=cwd, timeout=120,
        env=os.environ | {"PATH": f"{shim}:{os.environ['PATH']}"},
    )  # fmt: skip
    assert done.returncode == 0 and "Traceback" not in done.stderr, done.stderr
    return done.stdout


def completed(shim: Path, cwd: Path, *words: str) -> list[str]:
    """Return what bash offers for the last of the words."""
    typed = " ".join(f"'{w}'" for w in ("realsim", *words))
    script = (
        f"COMP_WORDS=({typed})\nCOMP_CWORD={len(words)}\n"
        "compopt() { :; }\n"  # readline's own, which only knows what a person types
        "_realsim_completion realsim\nprintf '%s\\n' \"${COMPREPLY[@]}\""
    )
    return bash(shim, script, cwd).split()


@pytest.mark.parametrize(
    ("words", "offered"),
    [
        (("scho",), ["school"]),
        (("scan", "s"), ["show", "scale", "sfm"]),
        (("register", "--find"), ["--find-all"]),
        (("register", "--method", "t"), ["top-down"]),
        (("capture", "out", "--plan", "shipped", ":", "ur"), [PLAN]),
        (("capture", "out", "--plan", "shipped", ":", "xyz"), []),
        (("capture", "out", "--plan", ""), [f"shipped:{PLAN}", "mine.json"]),
    ],
    ids=" ".join,
)
def test_bash_completes(
    words: tuple[str, ...], offered: list[str], shim: Path, tmp_path: Path
) -> None:
    (tmp_path / "mine.json").write_text("{}")
    assert completed(shim, tmp_path, *words) == offered


def test_bash_completes_files_where_a_file_is_wanted(shim: Path, tmp_path: Path) -> None:
    script = (
        'COMP_WORDS=(realsim check de)\nCOMP_CWORD=2\ncompopt() { echo "files: $*"; }\n'
        "_realsim_completion realsim"
    )
    assert bash(shim, script, tmp_path).split() == ["files:", "-o", "default"]


@pytest.mark.parametrize("shell", ["bash", "zsh", "fish"])
def test_every_shell_has_its_script(shell: str, tmp_path: Path) -> None:
    done = realsim("completion", shell)
    assert done.returncode == 0 and f"_REALSIM_COMPLETE={shell}_complete" in done.stdout
    parser = shutil.which(shell)
    if parser is not None:
        script = tmp_path / "script"
        script.write_text(done.stdout)
        assert subprocess.run([parser, "-n", script]).returncode == 0
