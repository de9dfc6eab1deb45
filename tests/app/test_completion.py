"""Completion in a real bash: commands, options, choices, plans and files, quickly."""

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

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


def test_bash_knows_the_command(shim: Path, tmp_path: Path) -> None:
    assert "-F _realsim_completion realsim" in bash(shim, "complete -p realsim", tmp_path)


@pytest.mark.parametrize(
    ("words", "offered"),
    [
        (("scho",), ["school"]),
        (("plan",), ["plan", "plan-show", "plan-convert"]),
        (("school", "se"), ["settle"]),
        (("scan", "s"), ["show", "scale", "sfm"]),
        (("register", "--find"), ["--find-all"]),
        (("register", "--method", "t"), ["top-down"]),
        (("school", "run", "--engine", "m"), ["mujoco"]),
        (("config", "t"), ["template"]),
        (("completion", "z"), ["zsh"]),
        (("plan-show", "ship"), [f"shipped:{PLAN}"]),
        (("capture", "out", "--plan", "shipped", ":", "ur"), [PLAN]),
        (("capture", "out", "--plan", "shipped", ":"), [PLAN]),
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
def test_every_shell_has_its_script(shell: str, shim: Path, tmp_path: Path) -> None:
    done = subprocess.run([shim / "realsim", "completion", shell], capture_output=True, text=True)
    assert done.returncode == 0 and f"_REALSIM_COMPLETE={shell}_complete" in done.stdout
    parser = shutil.which(shell)
    if parser is not None:
        script = tmp_path / "script"
        script.write_text(done.stdout)
        assert subprocess.run([parser, "-n", script]).returncode == 0


def test_another_shell_is_refused_with_those_that_there_are(shim: Path) -> None:
    done = subprocess.run([shim / "realsim", "completion", "csh"], capture_output=True, text=True)
    assert done.returncode == 2 and "zsh" in done.stderr


@pytest.mark.parametrize("line", ["realsim ", "realsim register --f", "realsim plan-show ship"])
def test_an_answer_costs_less_than_a_third_of_a_second(line: str) -> None:
    code = (
        "import time\nfrom realsim.app.cli import main\n"
        "try: main()\nfinally:\n import sys\n sys.stderr.write(f'CPU {time.process_time()}')"
    )
    words = line.split(" ")
    environment = os.environ | {
        "_REALSIM_COMPLETE": "bash_complete",
        "COMP_WORDS": line,
        "COMP_CWORD": str(len(words) - 1),
    }
    times: list[float] = []
    for _ in range(3):
        done = subprocess.run(
            [sys.executable, "-c", code], capture_output=True, text=True, env=environment
        )
        assert done.stdout, done.stderr
        times.append(float(done.stderr.rpartition("CPU ")[2]))
    assert min(times) < 0.3
